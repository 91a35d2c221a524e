"""A channel at the end of its range: readings that repeat the extreme while the other channel goes on.

Such readings are censored: the true value lies beyond. Displacement is what the law is compared in, so readings at the
end of its range are simply not compared. Force is what the law is driven with, and its largest value decides the whole
unloading: there the turning point is taken from what still moves. The loading curve below the end of the range, in the
law's own form

.. math:: F = k_1 x - k_3 x^3 + k_5 x^5, \\qquad x = (d - z) / D_e

is fitted by least squares in displacement (the noise is there), and read at the largest displacement; the covariance of
the fit and the noise of the turning point give the force's standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from .findings import Finding
from .schema import Curve
from .signal import Line, differences, point_noise, quantile, runs

REPEATS = 4  # readings that repeat the extreme, at least; two equal ones around a turning point are not rare
COARSE = 3.0  # and this many times as many as the channel repeats elsewhere: a coarse read-out repeats every value
STEPS = 2.0  # of its read-out that the channel itself would have gone on by, at least, at its pace before
GOES_ON = 0.5
"""Share of its pace before that the other channel keeps up to where it comes farthest, at least: in a hold it stands
still, or creeps. One that comes farther and then back while the readings repeat has passed a turning point: in a hold
it would not, so there its pace does not matter."""
BEFORE = 12  # readings that give the pace: fewer do not, more reach into another part of the ramp
ERRORS = 3.0  # standard deviations by which it must come farther; without any advance one stretch in 1000 does
NEAR_END = 3.0  # standard deviations below the end within which only low readings are left; one in 700 lies beyond
FITTED_FROM = 0.25  # of the end of the range: below, asperities deform, not the particle
TRUSTED = 0.25
"""Share of the end of the range by which the turning point may lie beyond it: of simulated tests clipped at 98, 95, 90
and 85 % the intervals of the modulus hold the truth; farther on nobody has looked."""


FORCE_RANGE = Finding(
    "saturation",
    "warning",
    "force stands at {} mN, the end of its range, for {} readings, which are left out",
    "Measure with a load cell of a larger range",
    code="force range",
)
TURNING_POINT = replace(
    FORCE_RANGE,
    sentence="force stands at {} mN, the end of its range, for {} readings while the platens go on; they are left out "
    "and the turning point is taken from the displacement ({} +- {} mN)",
)
FAR_BEYOND = replace(
    TURNING_POINT,
    level="error",
    sentence=f"{TURNING_POINT.sentence}, too far beyond the range to be relied on",
)
DISPLACEMENT_RANGE = Finding(
    "saturation",
    "warning",
    "displacement stands at {} um, the end of its range, for {} readings while the force goes on; they are not "
    "compared with the law",
    "Measure with a larger range of displacement",
    code="displacement range",
)


class CensoredForce(NamedTuple):
    """A test whose force channel saturated.

    Attributes:
        curve: the readings below the end of the range, and one turning point for each stretch at it that goes beyond
            any displacement reached before.
        rows: which readings of the given curve these are.
        compared: False at the turning points.
        force_sd_mN: standard deviation of the force at the turning points, 0 elsewhere [mN].
        finding: in words.
    """

    curve: Curve
    rows: np.ndarray
    compared: np.ndarray
    force_sd_mN: np.ndarray
    finding: Finding


def plateaus(values: np.ndarray, other: np.ndarray, time: np.ndarray, noise: float) -> list[tuple[int, int]]:
    """Stretches [start, stop) at the largest value of a channel during which the other, of this noise, goes on."""
    count = len(values)
    if count < 12:
        return []
    starts, stops = runs(values)
    last = values[starts] == values.max()
    at_end = list(zip(starts[last].tolist(), stops[last].tolist(), strict=True))
    elsewhere = (stops - starts)[~last]
    if not at_end or not len(elsewhere):
        return []
    usual = quantile(elsewhere, 0.9)
    moves = np.abs(differences(values))
    step = float(moves[moves > 0].min())
    found = []
    for start, stop in at_end:
        length = stop - start
        if length < max(REPEATS, COARSE * usual) or start < 4:
            continue
        before = np.arange(max(start - BEFORE, 0), start)
        line = Line.through(time[before], other[before])
        # How far the other channel comes, and by how much it comes back, as means of three readings.
        part, when = (np.convolve(x[start:stop], np.ones(3) / 3, "valid") for x in (other, time))
        top = int(np.argmax(part >= part.max() - noise / np.sqrt(3)))  # around a turn it hardly moves
        elapsed, advance = float(when[top] - time[start - 1]), float(part[top] - line.at(time[start - 1]))
        error = noise * np.sqrt(1 / 3 + 4 / len(before))
        turned = float(part[top] - part[-1]) > ERRORS * error
        goes_on = advance > GOES_ON * line.slope * elapsed
        # A coarse read-out rests at its last step while the true value stays below the next one.
        if Line.through(time[before], values[before]).slope * elapsed < STEPS * step:
            continue
        if line.slope > 0 and elapsed > 0 and advance > ERRORS * error and (goes_on or turned):
            found.append((start, stop))
    if not found:
        return []
    # Other stretches at the same end of the range are at it, too, however short.
    return [one for one in at_end if one[1] - one[0] >= 2 or one in found]


def censor_force(curve: Curve) -> CensoredForce | None:
    """The test, its zero of force taken off, with the turning points that its force channel did not see; None if there
    are none.
    """
    force, path = curve.force_mN, curve.displacement_um
    noise = point_noise(path)
    found = plateaus(force, path, curve.time_s, noise)
    if not found:
        return None
    end = float(force.max())
    hidden = np.zeros(len(force), bool)
    for start, stop in found:
        hidden[start:stop] = True
    fitted = _loading(force, path, hidden, found[0][0], end)
    before = slice(max(found[0][0] - BEFORE, 0), found[0][0])
    way = float(np.ptp(path[before]))
    pace = float(np.ptp(force[before])) / way if way > 0 else 0.0  # [mN/um]
    new_force, new_path, sd = force.copy(), path.copy(), np.zeros(len(force))
    turning = np.zeros(len(force), bool)
    reached = -np.inf
    for start, stop in found:
        reached = max(reached, float(np.max(path[:start])))
        row = start + int(np.argmax(path[start:stop]))
        top = _turning(path[start:stop], row - start, noise)
        if top <= reached:
            continue  # reloading that stays below what was reached before: elastic, the history does not change
        value, error = (np.nan, np.nan) if fitted is None else fitted.at(top, noise)
        if not end <= value < np.inf:
            value, error = end, noise * pace
        new_force[row], new_path[row], sd[row], turning[row] = value, top, error, True
        reached = top
    finding = _finding(end, int(hidden.sum()), new_force[turning], sd[turning])
    keep = ~hidden | turning
    checked = Curve(curve.time_s[keep], new_force[keep], new_path[keep])
    return CensoredForce(checked, np.flatnonzero(keep), ~turning[keep], sd[keep], finding)


def censor_displacement(curve: Curve) -> tuple[np.ndarray, Finding] | None:
    """Which readings of displacement stand at the end of its range, and a note; None if there are none."""
    found = plateaus(curve.displacement_um, curve.force_mN, curve.time_s, point_noise(curve.force_mN))
    if not found:
        return None
    path = curve.displacement_um
    # Of the readings within the noise of the end only those that the noise brought below it are left: they lie too low.
    rows = np.zeros(len(curve), bool)
    for start, stop in found:
        rows[start:stop] = True
    rows |= path >= float(path.max()) - NEAR_END * point_noise(path[~rows])
    return rows, DISPLACEMENT_RANGE.of(float(path.max()), int(rows.sum()))


def _finding(end: float, count: int, largest: np.ndarray, sds: np.ndarray) -> Finding:
    if not len(largest):
        return FORCE_RANGE.of(end, count)
    top, sd = float(largest.max()), float(sds.max())
    far = top > (1 + TRUSTED) * end or not sd < 0.5 * TRUSTED * end
    return (FAR_BEYOND if far else TURNING_POINT).of(end, count, top, sd)


def _turning(part: np.ndarray, top: int, noise: float) -> float:
    """The largest displacement of a stretch: of the readings within the noise of the largest, their mean.

    The largest of several noisy readings lies too high; the mean of those near it does not by more than the noise's
    share that the turn itself leaves.
    """
    near = np.abs(np.arange(len(part)) - top) <= 2
    close = part[near & (part > part[top] - 2.5 * noise)]
    return float(np.mean(close)) if noise > 0 else float(part[top])


@dataclass(frozen=True)
class _Loading:
    """Loading in the law's form, F = k1 x - k3 x^3 + k5 x^5, x = d / scale - zero, fitted below the range's end."""

    parameters: np.ndarray  # zero, k1, k3, k5
    covariance: np.ndarray
    scale_um: float

    def at(self, path: float, noise: float) -> tuple[float, float]:
        """Force at a displacement, and its standard deviation [mN]."""
        x = path / self.scale_um - self.parameters[0]
        powers, slope = _powers(x), _slopes(x) @ self.parameters[1:]
        gradient = np.array([-slope, *powers])
        variance = max(gradient @ self.covariance @ gradient, 0.0) + (slope / self.scale_um * noise) ** 2
        return float(powers @ self.parameters[1:]), float(np.sqrt(variance))


def _powers(x: np.ndarray | float) -> np.ndarray:
    return np.stack([x, -np.power(x, 3), np.power(x, 5)], -1)


def _slopes(x: np.ndarray | float) -> np.ndarray:
    return np.stack([np.ones_like(x), -3 * np.square(x), 5 * np.power(x, 4)], -1)


def _loading(force: np.ndarray, path: np.ndarray, hidden: np.ndarray, start: int, end: float) -> _Loading | None:
    """The loading curve before the force channel saturates for the first time."""
    from scipy.optimize import least_squares

    before = slice(start)
    virgin = (path[before] >= np.maximum.accumulate(path[before])) & (force[before] >= FITTED_FROM * end)
    rows = np.flatnonzero(virgin & ~hidden[before])
    if len(rows) < 8:
        return None
    f, d = force[rows], path[rows]
    scale = float(d[-1] - d[0]) / (1 - FITTED_FROM)
    if not scale > 0:
        return None

    def misfit(parameters: np.ndarray) -> np.ndarray:  # in displacement, where the noise is
        x = d / scale - parameters[0]
        slope = np.maximum(_slopes(x) @ parameters[1:] / scale, 1e-3 * end / scale)
        return (_powers(x) @ parameters[1:] - f) / slope

    first = d[0] / scale - FITTED_FROM
    begin = np.concatenate([[first], np.linalg.lstsq(_powers(d / scale - first), f, rcond=None)[0]])
    found = least_squares(misfit, begin, x_scale=np.maximum(np.abs(begin), 1e-3), max_nfev=100)
    variance = float(np.sum(found.fun**2) / max(len(d) - 4, 1))
    return _Loading(found.x, variance * np.linalg.pinv(found.jac.T @ found.jac), scale)
