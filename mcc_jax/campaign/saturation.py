"""A channel at the end of its range: readings that repeat the extreme while the other channel goes on.

Displacement is what the law is compared in, so its readings at the end of the range are not compared. Force is what the
law is driven with, and its largest value decides the whole unloading: the loading curve below the end of the range

.. math:: F = k_1 x - k_3 x^3 + k_5 x^5, \\qquad x = (d - z) / D_e

is fitted by least squares in displacement (the noise is there), and read at the largest displacement; the covariance of
the fit and the noise of the turning point give the force's standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .findings import Finding
from .schema import Checked, Curve
from .signal import Line, differences, point_noise, quantile, runs

REPEATS = 4  # readings that repeat the extreme, at least; two equal ones around a turning point are not rare
COARSE = 3.0  # and this many times as many as the channel repeats elsewhere: a coarse read-out repeats every value
STEPS = 2.0  # of its read-out that the channel itself would have gone on by, at least, at its pace before
# Share of its pace before that the other channel keeps up, unless it turns: in a hold it stands still or creeps
GOES_ON = 0.5
BEFORE = 12  # readings that give the pace: fewer do not, more reach into another part of the ramp
ERRORS = 3.0  # standard deviations by which it must come farther; without any advance one stretch in 1000 does
NEAR_END = 3.0  # standard deviations below the end within which only low readings are left; one in 700 lies beyond
FITTED_FROM = 0.25  # of the end of the range: below, asperities deform, not the particle
# Share of the range by which a turn may lie beyond it: intervals of the modulus hold the truth up to there
TRUSTED = 0.25

FORCE_RANGE = Finding(
    "saturation",
    "warning",
    "force stays at {} mN, the end of its range, for {} readings, which are left out",
    "Measure with a load cell of a larger range",
    code="force range",
)
TURNING_POINT = replace(
    FORCE_RANGE,
    sentence="force stays at {} mN, the end of its range, for {} readings while the platens go on; they are left out "
    "and the turning point is taken from the displacement ({} +- {} mN)",
)
FAR_BEYOND = replace(
    TURNING_POINT, level="error", sentence=f"{TURNING_POINT.sentence}, too far beyond the range to be relied on"
)
DISPLACEMENT_RANGE = Finding(
    "saturation",
    "warning",
    "displacement stays at {} um, the end of its range, for {} readings while the force goes on; they are not "
    "compared with the law",
    "Measure with a larger range of displacement",
    code="displacement range",
)


def plateaus(values: np.ndarray, other: np.ndarray, time: np.ndarray, noise: float) -> list[tuple[int, int]]:
    """Stretches [start, stop) at the largest value of a channel during which the other, of this noise, goes on."""
    starts, stops = runs(values)
    last = values[starts] == values.max()
    elsewhere = (stops - starts)[~last]
    if len(values) < 12 or not len(elsewhere):
        return []
    at_end = list(zip(starts[last].tolist(), stops[last].tolist(), strict=True))
    least = max(REPEATS, COARSE * quantile(elsewhere, 0.9))
    moves = np.abs(differences(values))
    step = float(moves[moves > 0].min())

    def goes_on(start: int, stop: int) -> bool:
        before = np.arange(max(start - BEFORE, 0), start)
        line = Line.through(time[before], other[before])
        # How far the other channel comes, and by how much it comes back, as means of three readings.
        part, when = (np.convolve(x[start:stop], np.ones(3) / 3, "valid") for x in (other, time))
        top = int(np.argmax(part >= part.max() - noise / np.sqrt(3)))  # around a turn it hardly moves
        elapsed, advance = float(when[top] - time[start - 1]), float(part[top] - line.at(time[start - 1]))
        error = ERRORS * noise * np.sqrt(1 / 3 + 4 / len(before))
        # A coarse read-out rests at its last step while the true value stays below the next one.
        if Line.through(time[before], values[before]).slope * elapsed < STEPS * step:
            return False
        keeps_pace, turned = advance > GOES_ON * line.slope * elapsed, part[top] - part[-1] > error
        return bool(line.slope > 0 and elapsed > 0 and advance > error and (keeps_pace or turned))

    found = [one for one in at_end if one[1] - one[0] >= least and one[0] >= 4 and goes_on(*one)]
    # Other stretches at the same end of the range are at it, too, however short.
    return [one for one in at_end if one[1] - one[0] >= 2] if found else []


def censor_force(curve: Curve) -> tuple[Curve, Checked] | None:
    """The test, its zero of force taken off, without the readings at the end of the force channel's range, but for one
    turning point, not to be compared, for each stretch of them that goes beyond any displacement reached before; None
    if there are none."""
    force, path = curve.force_mN, curve.displacement_um
    noise = point_noise(path)
    found = plateaus(force, path, curve.time_s, noise)
    if not found:
        return None
    end, hidden = float(force.max()), _inside(found, len(force))
    fitted = _loading(force, path, hidden, noise)
    before = slice(max(found[0][0] - BEFORE, 0), found[0][0])
    way = float(np.ptp(path[before]))
    pace = float(np.ptp(force[before])) / way if way > 0 else 0.0  # [mN/um]
    new_force, new_path, sd = force.copy(), path.copy(), np.zeros(len(force))
    turning = np.zeros(len(force), bool)
    reached = -np.inf
    for start, stop in found:
        reached = max(reached, float(np.max(path[:start])))
        row = start + int(np.argmax(path[start:stop]))
        top = float(path[row])
        if noise > 0:
            # The largest of noisy readings lies too high; the mean of those near it only by what the turn leaves.
            near = path[max(row - 2, start) : min(row + 3, stop)]
            top = float(np.mean(near[near > top - 2.5 * noise]))
        if top <= reached:
            continue  # reloading that stays below what was reached before: elastic, the history does not change
        value, error = (np.nan, np.nan) if fitted is None else fitted(top)
        if not end <= value < np.inf:
            value, error = end, noise * pace
        new_force[row], new_path[row], sd[row], turning[row] = value, top, error, True
        reached = top
    finding = FORCE_RANGE.of(end, int(hidden.sum()))
    if turning.any():
        largest, error = float(new_force[turning].max()), float(sd.max())
        far = largest > (1 + TRUSTED) * end or not error < 0.5 * TRUSTED * end
        finding = (FAR_BEYOND if far else TURNING_POINT).of(*finding.numbers, largest, error)
    keep = ~hidden | turning
    seen = Curve(curve.time_s[keep], new_force[keep], new_path[keep])
    return seen, Checked(np.flatnonzero(keep), ~turning[keep], 0.0, 0.0, sd[keep], (finding,))


def censor_displacement(curve: Curve) -> tuple[np.ndarray, Finding] | None:
    """Which readings of displacement are at the end of its range, and that in words; None if there are none."""
    path = curve.displacement_um
    found = plateaus(path, curve.force_mN, curve.time_s, point_noise(curve.force_mN))
    if not found:
        return None
    # Of the readings within the noise of the end only those that the noise brought below it are left: they lie too low.
    rows = _inside(found, len(curve))
    rows |= path >= float(path.max()) - NEAR_END * point_noise(path[~rows])
    return rows, DISPLACEMENT_RANGE.of(float(path.max()), int(rows.sum()))


def _inside(stretches: list[tuple[int, int]], count: int) -> np.ndarray:
    """Which of so many readings lie in stretches [start, stop)."""
    rows = np.arange(count)
    return np.any([(start <= rows) & (rows < stop) for start, stop in stretches], axis=0)


_POWERS, _SIGNS = np.array([1, 3, 5]), np.array([1, -1, 1])


def _loading(
    force: np.ndarray, path: np.ndarray, hidden: np.ndarray, noise: float
) -> Callable[[float], tuple[float, float]] | None:
    """Force at a displacement of this noise, and its standard deviation [mN], by the loading curve before the force
    channel saturates for the first time; None if there is too little of it."""
    from scipy.optimize import least_squares

    before, end = slice(int(np.argmax(hidden))), float(force.max())
    virgin = (path[before] >= np.maximum.accumulate(path[before])) & (force[before] >= FITTED_FROM * end)
    f, d = force[before][virgin], path[before][virgin]
    scale = float(d[-1] - d[0]) / (1 - FITTED_FROM) if len(d) >= 8 else 0.0
    if not scale > 0:
        return None

    def terms(x: np.ndarray) -> np.ndarray:
        return _SIGNS * x[..., None] ** _POWERS

    def slopes(x: np.ndarray) -> np.ndarray:
        return _SIGNS * _POWERS * x[..., None] ** (_POWERS - 1) / scale

    def misfit(numbers: np.ndarray) -> np.ndarray:  # in displacement, where the noise is
        x = d / scale - numbers[0]
        return (terms(x) @ numbers[1:] - f) / np.maximum(slopes(x) @ numbers[1:], 1e-3 * end / scale)

    first = d[0] / scale - FITTED_FROM
    begin = np.concatenate([[first], np.linalg.lstsq(terms(d / scale - first), f, rcond=None)[0]])
    found = least_squares(misfit, begin, x_scale=np.maximum(np.abs(begin), 1e-3), max_nfev=100)
    covariance = np.sum(found.fun**2) / max(len(d) - 4, 1) * np.linalg.pinv(found.jac.T @ found.jac)

    def at(displacement: float) -> tuple[float, float]:
        x = np.asarray(displacement / scale - found.x[0])
        slope = slopes(x) @ found.x[1:]
        gradient = np.array([-scale * slope, *terms(x)])
        variance = max(gradient @ covariance @ gradient, 0.0) + (slope * noise) ** 2
        return float(terms(x) @ found.x[1:]), float(np.sqrt(variance))

    return at
