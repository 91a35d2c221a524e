"""What one test shows whatever its units and signs: peak, unloading slope, fullness of the loading curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .signal import differences, median

CONTACT = 0.005
"""Share of the peak force at which contact counts as made. Low, because soft particles deform much under little force:
cellulose takes a quarter of its displacement below 3 % of its force."""
CONTACT_NOISE = 4.0  # the same in standard deviations of the force's noise, where that is more
LOADED = 4.0
"""Multiple of the force at which contact counts as made that no reading before contact reaches. Unloadings after it are
part of the test; a first cycle below it, 2 % of the peak, is taken for part of the approach."""
UNLOADING = (0.9, 0.5)
"""Shares of the peak force between which unloading is taken as a line: below, the unloading of a plastic contact bends
(Oliver and Pharr 1992); above, it still creeps."""
LEAST_RETREAT = 0.2  # share of the displacement that must be given back for the lost work to count
CORRELATION = 0.6
"""Least correlation of force and displacement from contact to peak, over forces not reached before: without a particle
it is less, in loading of any material more than 0.8."""
MOST_SAMPLES = 4000  # longer records are thinned: enough for features of a curve's size


@dataclass(frozen=True)
class CurveFeatures:
    """One test with forces and displacements counted positive in compression; NaN where it does not show a feature.

    Attributes:
        force_sign: -1 where the forces are negative in compression, else 1.
        displacement_sign: -1 where the displacements fall as the load rises, else 1.
        force_mN: the largest force.
        displacement_um: displacement from contact to there.
        slope_mN_per_um: slope at the beginning of unloading.
        fullness: area below the loading curve as a share of the box of its peak [-], 1 / (1 + n) for a power n of the
            displacement; above one half where stiffness falls.
        loss: share of the work of loading that unloading does not give back [-]; negative where more came back.
        loading_s: time from a tenth to nine tenths of the peak force [s].
        interval_s: median time between two samples [s].
    """

    force_sign: int
    displacement_sign: int
    force_mN: float
    displacement_um: float
    slope_mN_per_um: float
    fullness: float
    loss: float
    loading_s: float
    interval_s: float


def curve_features(time_s: np.ndarray, force_mN: np.ndarray, displacement_um: np.ndarray) -> CurveFeatures | None:
    """The features of one test; None for a record that shows no loading or holds values that are not finite."""
    step = -(-len(time_s) // MOST_SAMPLES)
    time, force, displacement = (np.asarray(v, float)[::step] for v in (time_s, force_mN, displacement_um))
    if len(time) < 2 or not all(np.isfinite(v).all() for v in (time, force, displacement)):
        return None
    force, displacement = _without_spikes(force), _without_spikes(displacement)
    with np.errstate(all="ignore"):
        force_sign, rise = _compression_positive(force)
        peak = int(np.argmax(rise))
        if not (np.isfinite(rise[peak]) and rise[peak] > 0):
            return None
        begins_at_peak = peak < 0.05 * len(rise)
        contact, base = (0, 0.0) if begins_at_peak else _contact(rise[: peak + 1])
        load = rise - base
        part = slice(peak, None) if begins_at_peak else slice(contact, peak + 1)
        together = _correlation(load[part], displacement[part])
        if abs(together) < CORRELATION:
            return None
        displacement_sign = 1 if together > 0 else -1
        depth = displacement_sign * displacement
        height = float(load[peak])
        way = float(abs(depth[peak]) if begins_at_peak else depth[peak] - depth[contact])
        fullness = loading_s = loss = np.nan
        rows = contact + np.flatnonzero(load[contact : peak + 1] >= np.maximum.accumulate(load[contact : peak + 1]))
        if not begins_at_peak and way > 0:
            fullness = float(np.trapezoid(load[rows], depth[rows])) / (height * way)
            first, last = (rows[np.argmax(load[rows] >= share * height)] for share in (0.1, 0.9))
            loading_s = float(time[last] - time[first])
            if depth[peak] - depth[peak:].min() > LEAST_RETREAT * way and fullness > 0:
                loss = 1 + float(np.trapezoid(load[peak:], depth[peak:])) / (fullness * height * way)
        return CurveFeatures(
            force_sign,
            displacement_sign,
            force_mN=height,
            displacement_um=way if way > 0 else np.nan,
            slope_mN_per_um=_unloading_slope(load[peak:], depth[peak:]),
            fullness=fullness,
            loss=loss,
            loading_s=loading_s,
            interval_s=median(differences(time)),
        )


def _without_spikes(values: np.ndarray) -> np.ndarray:
    """Running median of five, so that one wild reading is no peak."""
    if len(values) < 9:
        return values
    out = values.copy()
    out[2:-2] = np.partition(np.lib.stride_tricks.sliding_window_view(values, 5), 2, axis=1)[:, 2]
    out[:2], out[-2:] = median(values[:5]), median(values[-5:])
    return out


def _noise(values: np.ndarray) -> float:
    """Standard deviation of white noise on a smooth course."""
    if len(values) < 8:
        return 0.0
    # Second differences of white noise of deviation 1 have variance 1 + 4 + 1.
    return 1.4826 * median(np.abs(differences(values, 2))) / np.sqrt(6.0)


def _compression_positive(force: np.ndarray) -> tuple[int, np.ndarray]:
    """The sign of compression, and forces that count positive in it; zeros where the record shows no loading."""
    low, high = float(force.min()), float(force.max())
    if min(abs(low), abs(high)) > 0.5 * (high - low) and low * high > 0:
        # Far from zero all the time: a large offset, or a preload without a test.
        return 1, np.zeros_like(force)
    sign = 1 if high >= -low else -1
    return sign, sign * force


def _contact(rise: np.ndarray) -> tuple[int, float]:
    """The last sample before the force first rises for good, and the force there; later unloadings do not count."""
    noise = _noise(rise)
    base = float(rise.min()) + 2 * noise  # the least of some hundred readings lies about two deviations below
    level = max(CONTACT * (float(rise[-1]) - base), CONTACT_NOISE * noise)
    first_rise = int(np.argmax(rise - base >= LOADED * level))
    below = np.flatnonzero(rise[:first_rise] <= base + level)
    return (int(below[-1]) if len(below) and below[-1] < len(rise) - 1 else 0), base


def _correlation(load: np.ndarray, depth: np.ndarray) -> float:
    """Of the samples whose load was not reached before (or is not again, where the record only unloads)."""
    if load[0] <= load[-1]:
        virgin = load >= np.maximum.accumulate(load)
        load, depth = load[virgin], depth[virgin]
    if not (np.ptp(load) > 0 and np.ptp(depth) > 0):
        return 0.0
    a, b = (load - load.mean()) / np.ptp(load), (depth - depth.mean()) / np.ptp(depth)
    return float((a @ b) / np.sqrt((a @ a) * (b @ b)))


def _unloading_slope(load: np.ndarray, depth: np.ndarray) -> float:
    """Slope of the first unloading; NaN where none is seen, or the displacement goes on as the force falls."""
    begin, end = (share * load[0] for share in UNLOADING)
    if not (load < begin).any():
        return np.nan
    first = int(np.argmax(load < begin))
    deep = np.flatnonzero(load[first:] < end)
    last = first + int(deep[0] if len(deep) else np.argmin(load[first:]))
    fall, back = float(load[first] - load[last]), float(depth[first] - depth[last])
    if last - first < 3 or fall < 0.1 * load[0] or back <= 3 * _noise(depth):
        return np.nan
    return fall / back
