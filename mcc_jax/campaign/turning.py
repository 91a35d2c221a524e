"""The force at which each branch of a test begins, with its error: where the ramps before and behind it meet, or the
mean of the hold between them. The largest of many noisy readings lies above the force from which the law unloads."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .._format import described
from .schema import Curve
from .segments import Segment
from .signal import Line, median, noise_level

# Share of the peak force within which readings on both sides give the turning point: bent ramps are parabolas there
SHARE = 0.1
MOST = 41  # readings on each side at most; more say nothing new against the bend
CURVED = 9  # readings from which on a parabola is drawn through them, not a straight line
LEAST = 4  # fewer readings draw no line: the reading itself is taken
TREND = 4.0  # standard errors; a hold that changes by more relaxes, and its mean says nothing
INSIDE = 3.0  # robust standard deviations from its median within which readings are of a hold
FITS = 2.0  # times the noise that readings may scatter about a line; else fewer of them, nearer the turn, are taken
RESOLVED = 1e-6  # noise below this share of the peak is none: the reading itself is exact
APART = 6.0  # standard deviations; an estimate further from the reading is refused
# Deviations by which a reading near the turn misses the lines that meet there if the tip is rounded (a sharp one in
# 0.2 % of the cases): the largest reading is nearer to it then. Rounding within half a reading cannot be seen.
ROUNDED = 3.5


class TurningForces(NamedTuple):
    """The forces of a test as a law is to be compared with them; every array of shape (n,)."""

    force: np.ndarray  # [mN], readings, and the estimate where many repeat one force (holds, turning points)
    peak: np.ndarray  # force from which the branch of each point starts [mN]; on virgin loading its own force
    error: np.ndarray  # standard error of `peak` in standard errors of a reading; 0 on virgin loading
    reading: np.ndarray  # whether a point's force is a reading of its own

    __repr__ = described()


def turning_forces(curve: Curve, segments: tuple[Segment, ...]) -> TurningForces:
    """Estimate the force at which every branch of a test, cut by `find_segments`, begins."""
    time, raw = np.asarray(curve.time_s, float), np.asarray(curve.force_mN, float)
    force, peak = raw.copy(), raw.copy()
    error, reading = np.zeros(len(raw)), np.ones(len(raw), bool)
    level, level_error = None, 0.0
    noise = noise_level(raw, float(np.ptp(raw)))
    # Turning points that saturated were worked out with an error of their own: nothing around them improves on that.
    share = 0.0 if np.any(curve.worked_out) else SHARE
    for k, part in enumerate(segments):
        rows = slice(part.start, part.stop)
        if part.kind == "approach":
            continue
        if part.kind == "load":
            before, before_error, level = level, level_error, None
            if k + 1 < len(segments):
                level, level_error = _level(time, raw, part, segments[k + 1], noise, share)
                force[rows] = peak[rows] = np.minimum(raw[rows], level)
            if before is not None:  # up to the force reached before, loading goes along the last branch
                elastic = part.start + np.flatnonzero(force[rows] <= before)
                peak[elastic], error[elastic] = before, before_error
            continue
        if level is None:  # the record begins behind its peak
            level, level_error = float(raw[part.start]), 1.0
            if len(part) >= LEAST:
                level = max(float(Line.through(time[rows][:MOST], raw[rows][:MOST]).at(time[part.start])), level)
        peak[rows], error[rows] = level, level_error
        force[rows] = np.minimum(raw[rows], level)
        if part.kind == "reload" and k + 1 < len(segments) and segments[k + 1].kind == "load":
            beyond = part.start + np.flatnonzero(raw[rows] > level)
            force[beyond] = peak[beyond] = raw[beyond]
            error[beyond] = 0.0
        if segments[k - 1].kind == "load":
            # A hold repeats the force at which it began; of a turning point that is its first point alone.
            held = _held(time, raw, part, noise) if part.kind == "hold" else None
            if held is None:
                held = np.array([part.start])
            force[held], reading[held] = level, False
            ramp = slice(part.start, held[0])  # the end of the ramp, within the band that a hold is known by
            force[ramp] = peak[ramp] = np.minimum(raw[ramp], level)
            error[ramp] = 0.0
    return TurningForces(force, peak, error, reading)


def _level(
    time: np.ndarray, raw: np.ndarray, up: Segment, after: Segment, noise: float, share: float
) -> tuple[float, float]:
    """The force at which loading ends, and its standard error in those of a reading."""
    hold = after.kind == "hold"
    held = _held(time, raw, after, noise) if hold and share else None
    if held is not None:
        return float(np.mean(raw[held])), 1 / np.sqrt(len(held))
    largest = float(raw[up.start : min(after.start + 1, after.stop)].max())
    if noise <= RESOLVED * abs(largest):
        return largest, 1.0
    turn = float(time[after.start])
    near = raw > (1 - share) * largest
    before, behind = _run(near, up.start, up.stop, -1), _run(near, after.start, after.stop, 1)
    if hold:  # a relaxing force: only the ramp shows where it began
        rising = _fitted(time, raw, before, turn, noise)
        if rising is None or _fitted(time, raw, behind, turn, noise) is None:
            return largest, 1.0
        level, variance = rising.at(0.0)
        return (
            (largest, 1.0) if abs(level - largest) > APART * noise else (float(level), min(float(variance) ** 0.5, 1.0))
        )
    # The readings next to the turn may be on either side of it: first without them, then each where it belongs.
    rising, falling = _fitted(time, raw, before[:-1], turn, noise), _fitted(time, raw, behind[1:], turn, noise)
    if rising is None or falling is None:
        return largest, 1.0
    ahead, following = time[max(after.start - 1, up.start)], time[min(after.start + 1, len(time) - 1)]
    step = max(turn - float(ahead), float(following) - turn)
    both = np.concatenate([before, behind])
    early = time[both] < turn + _meeting(rising, falling, step)
    parts = [_fitted(time, raw, both[side], turn, noise) for side in (early, ~early)]
    if parts[0] is not None and parts[1] is not None:
        rising, falling = parts[0], parts[1]
    meet = _meeting(rising, falling, step)
    (one, first), (other, second) = rising.at(meet), falling.at(meet)
    steep, down = rising.slope(meet), falling.slope(meet)
    # Where two lines meet: each is weighed by the slope of the other.
    weight = down / (down - steep) if steep > 0 > down else 0.5
    level, variance = weight * one + (1 - weight) * other, weight**2 * first + (1 - weight) ** 2 * second
    # Between two readings the force rises further than the larger of them, but not past the readings themselves.
    if not abs(level - largest) <= APART * noise + step * max(steep, -down, 0.0):
        return largest, 1.0
    for row in range(max(up.start, after.start - 2), min(after.start + 3, after.stop)):
        at = float(time[row]) - turn
        there, error = rising.at(at) if at < meet else falling.at(at)
        if abs(raw[row] - there) > ROUNDED * noise * np.sqrt(1 + error):
            return largest, 1.0
    return float(level), float(min(np.sqrt(variance), 1.0))


def _meeting(rising: _Ramp, falling: _Ramp, step: float) -> float:
    """When the ramps before and behind a turning point come closest to each other, from the turning reading on."""
    instants = np.linspace(-step, step, 41)
    return float(instants[int(np.argmin(np.abs(rising.at(instants)[0] - falling.at(instants)[0])))])


def _run(near: np.ndarray, start: int, stop: int, direction: int) -> np.ndarray:
    """Rows of the unbroken run of `near` at the end (-1) or the beginning (1) of a segment."""
    order = np.arange(start, stop)[::direction]
    return np.sort(order[np.logical_and.accumulate(near[order])][:MOST])


def _held(time: np.ndarray, raw: np.ndarray, part: Segment, noise: float) -> np.ndarray | None:
    """Rows of a hold at one force, without readings of the ramps next to it; None where the force relaxes."""
    force = raw[part.start : part.stop]
    away = np.abs(force - median(force))
    sd = 1.4826 * median(away)
    rows = part.start + np.flatnonzero(away <= INSIDE * sd)
    if len(rows) < LEAST:  # too few to show what they scatter about: those as high as the highest
        return part.start + np.flatnonzero(force >= force.max() - INSIDE * noise)
    line = Line.through(time[rows], raw[rows])
    return rows if line.spread == 0 or sd == 0 or abs(line.slope) <= TREND * line.slope_sd else None


class _Ramp(NamedTuple):
    """A line or parabola of force over the time from a turning point, and its covariance for readings of variance 1."""

    values: np.ndarray
    covariance: np.ndarray
    unit: float

    def at(self, time: Any) -> tuple[Any, Any]:
        """Force and variance, at one time or several."""
        x = (np.asarray(time)[..., None] / self.unit) ** np.arange(len(self.values))
        return x @ self.values, np.sum(x @ self.covariance * x, axis=-1)

    def slope(self, time: float) -> float:
        k = np.arange(1, len(self.values))
        return float((k * (time / self.unit) ** (k - 1)) @ self.values[1:] / self.unit)


def _fitted(time: np.ndarray, raw: np.ndarray, rows: np.ndarray, turn: float, noise: float) -> _Ramp | None:
    """The course through as many of the rows nearest the turning point as it follows to within the noise."""
    while len(rows) >= LEAST and np.ptp(time[rows]) > 0:
        x, force = time[rows] - turn, raw[rows]
        unit = float(np.abs(x).max())
        design = np.vander(x / unit, 3 if len(rows) >= CURVED else 2, increasing=True)
        values, _, rank, _ = np.linalg.lstsq(design, force, rcond=None)
        left = force - design @ values
        if rank == design.shape[1] and left @ left <= (FITS * noise) ** 2 * len(rows):
            return _Ramp(values, np.linalg.inv(design.T @ design), unit)
        rows = np.sort(rows[np.argsort(np.abs(x), kind="stable")[: len(rows) // 2]])
    return None
