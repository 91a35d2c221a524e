"""Noise, turning points, lines and monotone envelopes of a measured signal."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

# Samples between turns from which on third differences give the noise: at most a quarter straddle a turn
LONG_BRANCH = 16
DEEP_TURN = 0.1  # share of the range that noise does not reach, for a first look at how quickly a signal turns
MANY_TURNS = 8  # more turning points make a signal one of quick cycles
SPREAD_OF_PEAKS = 1.5  # the extremes of white noise scatter by about two thirds of its standard deviation
LEAST_SAMPLES = 8  # fewer do not give noise by third differences
LEAST_PEAKS = 16  # fewer turning points do not give it by how peaks repeat
SMALLEST_STEP = 1e-9  # share of the range below which a difference of two readings is rounding of the arithmetic
WHOLE_STEP = 0.01  # a difference counts as a whole number of smallest steps if it is so close to one
WHOLE_SHARE = 0.95  # of the differences must, for a read-out's step: of continuous readings 2 * WHOLE_STEP do by chance
JUMPS = 0.1  # share of those differences that follow a rest, of a coarse read-out; a ramp out of a hold jumps once
LONGEST_GAP = 5.0  # typical intervals that a gap of the clock counts for at most: nothing was seen in it
SHORTEST_GAP = 0.2  # and a repeated time, at least: two readings are two


def noise_level(values: np.ndarray, span: float) -> float:
    """Standard deviation of a signal's noise, given its range: differences that no smooth course has, plus rounding."""
    rounding = _resolution(values, span) / 2
    third = differences(values, 3)
    if len(values) < LEAST_SAMPLES or (scatter := _scatter(third)) == 0:
        return rounding
    # Of hundreds of quick cycles the noise is no more than what the differences between two turning points show, nor
    # than what cycles that repeat do from one to the next.
    turns = np.array(turning_points(values, DEEP_TURN * span))
    if len(turns) > MANY_TURNS and len(values) < LONG_BRANCH * (len(turns) - 1):
        near = turns[:, None] - np.arange(4)
        away = np.ones(len(third), bool)
        away[near[(near >= 0) & (near < len(third))]] = False
        if away.sum() >= max(LEAST_SAMPLES, len(third) // 8):
            scatter = min(scatter, _scatter(third[away]))
        inner = values[turns[1:-1]]
        if len(inner) >= LEAST_PEAKS:
            repeated = max(_scatter(differences(ends, 3)) for ends in (inner[::2], inner[1::2]))
            scatter = min(scatter, SPREAD_OF_PEAKS * repeated)
    return float(np.hypot(scatter, rounding))


def _scatter(third: np.ndarray) -> float:
    """Standard deviation of white noise with such third differences; at 1 their variance is 1 + 9 + 9 + 1."""
    return 1.4826 * median(np.abs(third)) / np.sqrt(20.0)


def _resolution(values: np.ndarray, span: float) -> float:
    """The step of a read-out that is rounded so coarsely that it stays and jumps; else 0."""
    steps = np.abs(differences(values))
    moves = steps > SMALLEST_STEP * span
    if not moves.any():
        return 0.0
    smallest = float(steps[moves].min())
    multiples = steps[moves] / smallest
    whole = np.round(multiples)
    if np.mean(np.abs(multiples - whole) < WHOLE_STEP) <= WHOLE_SHARE:
        return 0.0
    # Even ramps also have few steps; but one that starts out of a hold jumps once, a rounded one again and again.
    jumps = np.count_nonzero(moves[1:] & ~moves[:-1])
    return smallest if jumps > JUMPS * len(multiples) or len(np.unique(whole)) > 2 else 0.0


def point_noise(values: np.ndarray) -> float:
    """Standard deviation from reading to reading: second differences cancel any smooth course."""
    if len(values) < 4:
        return 0.0
    second = differences(values, 2)
    return float(median(np.abs(second - median(second))) / 0.6745 / np.sqrt(6))


def differences(values: np.ndarray, order: int = 1) -> np.ndarray:
    """As `numpy.diff`, in a quarter of the time for some hundred readings: every test is asked for dozens."""
    for _ in range(order):
        values = values[1:] - values[:-1]
    return values


def quantile(values: np.ndarray, share: float) -> float:
    """A quantile of numbers of shape (n,), n >= 1, in a tenth of the time that NumPy's takes for a few hundred."""
    ordered = np.sort(values)
    at = share * (len(ordered) - 1)
    low = int(at)
    one, other = float(ordered[low]), float(ordered[min(low + 1, len(ordered) - 1)])
    return one if one == other else one + (at - low) * (other - one)


def median(values: np.ndarray) -> float:
    """The median of numbers of shape (n,), n >= 1."""
    return quantile(values, 0.5)


def runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where stretches of readings that are equal to the last digit start, and where they stop."""
    edges = np.concatenate(([0], np.flatnonzero(values[1:] != values[:-1]) + 1, [len(values)]))
    return edges[:-1], edges[1:]


def stretches(chosen: np.ndarray) -> list[tuple[int, int]]:
    """Stretches [start, stop) of consecutive readings that are chosen by booleans of shape (n,), n >= 1."""
    starts, stops = runs(chosen)
    first = 0 if chosen[0] else 1  # every other run is chosen
    return list(zip(starts[first::2].tolist(), stops[first::2].tolist(), strict=True))


class Line(NamedTuple):
    """A straight line through n points by least squares."""

    slope: float
    x: float  # mean of the points, as is y
    y: float
    spread: float  # sum of squares of x about its mean; where it is nil, so is the slope
    left: np.ndarray  # residuals, shape (n,)

    @classmethod
    def through(cls, x: np.ndarray, y: np.ndarray) -> Line:
        """The line through points of shape (n,)."""
        away, level = x - x.mean(), float(y.mean())
        spread = float(away @ away)
        slope = float(away @ y) / spread if spread > 0 else 0.0
        return cls(slope, float(x.mean()), level, spread, y - level - slope * away)

    def at(self, x: Any) -> Any:
        """Its value at x."""
        return self.y + self.slope * (x - self.x)

    @property
    def sd(self) -> float:
        """Standard deviation of the points about it."""
        return float(np.sqrt(self.left @ self.left / (len(self.left) - 2)))

    @property
    def slope_sd(self) -> float:
        """Standard error of the slope."""
        return float(self.sd / np.sqrt(self.spread))


def steady_clock(time: np.ndarray) -> np.ndarray:
    """A strictly increasing clock in units of the typical interval: gaps are shortened and repeats spread."""
    steps = differences(time)
    if not (steps > 0).any():
        return np.arange(len(time), dtype=float)
    intervals = np.minimum(steps / median(steps[steps > 0]), LONGEST_GAP)
    return np.concatenate(([0.0], np.cumsum(np.maximum(intervals, SHORTEST_GAP))))


def turning_points(values: np.ndarray, depth: float) -> list[int]:
    """Indices of the first sample, the turning points deeper than `depth`, and the last sample."""
    # Of the local extremes, the pair with the smallest difference goes first, until every difference left is at least
    # `depth`; pairs that are smaller than both their neighbours go together.
    last = len(values) - 1
    steps = differences(values)
    moving = np.flatnonzero(steps)
    down = steps[moving] < 0
    turns = moving[1:][down[1:] != down[:-1]]
    index = np.concatenate(([0], turns, [last]))
    while len(index) > 2:
        ranges = np.abs(differences(values[index]))
        if ranges.min() >= depth:
            break
        left = np.concatenate(([np.inf], ranges[:-1]))
        right = np.concatenate((ranges[1:], [np.inf]))
        smallest = np.flatnonzero((ranges < depth) & (ranges <= left) & (ranges < right))
        if not len(smallest):
            smallest = np.array([int(np.argmin(ranges))])
        drop = np.zeros(len(index), bool)
        # At the ends only the end itself goes: what remains begins (or ends) with the other one's turn.
        drop[smallest] = True
        drop[smallest + 1] = True
        if smallest[0] == 0:
            drop[1] = len(ranges) == 1
        if smallest[-1] == len(ranges) - 1:
            drop[-2] = False
        index = index[~drop]
    inner = [int(i) for i in index if 0 < i < last]
    # A turn left at the very first or last samples bounds a stretch that is itself no deeper than noise.
    while inner and abs(values[inner[0]] - values[0]) < depth:
        inner.pop(0)
    while inner and abs(values[inner[-1]] - values[-1]) < depth:
        inner.pop()
    return [0, *inner, last]


def branch_envelope(values: np.ndarray) -> np.ndarray:
    """A never falling signal through the middle of a rising, noisy one, shape (n,)."""
    highest = np.maximum.accumulate(values)
    lowest = np.minimum.accumulate(values[::-1])[::-1]
    return (highest + lowest) / 2


def two_lines(x: np.ndarray, y: np.ndarray) -> int:
    """The index at which a second straight line best takes over from a first, by least squares; shapes (n,), n >= 8."""
    x, y = x - x.mean(), y - y.mean()
    count = np.arange(1, len(x) + 1)
    sums = np.cumsum(np.stack([x, y, x * x, x * y, y * y]), axis=1)
    cuts = slice(2, len(x) - 3)
    left = _left(count[cuts], sums[:, cuts])
    right = _left(len(x) - count[cuts], sums[:, -1:] - sums[:, cuts])
    return 3 + int(np.argmin(left + right))


def _left(count: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """The residual square of lines through so many points, by their sums of x, y, x^2, x y and y^2."""
    sx, sy, sxx, sxy, syy = sums
    xx, xy, yy = sxx - sx * sx / count, sxy - sx * sy / count, syy - sy * sy / count
    flat = xx <= 1e-12 * np.abs(sxx)
    return np.maximum(yy - np.where(flat, 0.0, xy * xy / np.where(flat, 1.0, xx)), 0.0)
