"""The signal that drives a test: its turning points, and the stretches where it stands still."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .signal import branch_envelope, median, noise_level, stretches, turning_points

SMALLEST_TURN = 0.005  # least depth of a turn, as a share of the signal's range
TURN_NOISE = 8.0  # the same in standard deviations of the noise
BAND = 0.0025  # height that a ramp must pass to be none of a hold, as a share of the range; or four deviations
SLOWNESS = 6.0  # times longer than the ramps next to it that a hold takes for the width of the band
HOLD_SAMPLES = 4  # of a hold, at least


class Hold(NamedTuple):
    """Samples `start` to `stop - 1`, where the signal stands at `level`."""

    start: int
    stop: int
    level: float


class Drive:
    """A signal with its noise, turning points and, per branch between them, its monotone envelope."""

    def __init__(self, values: np.ndarray, clock: np.ndarray) -> None:
        span = float(np.ptp(values))
        # From 0 to 1 (or 0 alone), so that nothing depends on units or on how small the numbers are.
        self.values = (values - values.min()) / span if span > 0 else np.zeros(len(values))
        self.clock = clock
        self.span = 1.0 if span > 0 else 0.0
        values = self.values
        self.noise = noise_level(values, self.span)
        self.band = max(BAND * self.span, 4 * self.noise)
        turn = max(SMALLEST_TURN * self.span, TURN_NOISE * self.noise)
        self.turns = turning_points(values, turn)
        # A rising or falling signal per branch, made rising by its sign.
        self.signs = [1 if values[b] >= values[a] else -1 for a, b in zip(self.turns, self.turns[1:], strict=False)]
        self.envelopes = [
            branch_envelope(sign * values[a : b + 1])
            for a, b, sign in zip(self.turns, self.turns[1:], self.signs, strict=False)
        ]

    def crossing(self, branch: int, level: float) -> float:
        """The index (fractional) at which a branch, counted in its own direction, passes a level."""
        envelope = self.envelopes[branch]
        k = int(np.searchsorted(envelope, level))
        if k <= 0 or k >= len(envelope):
            return float(self.turns[branch] + min(max(k, 0), len(envelope) - 1))
        low, high = envelope[k - 1], envelope[k]
        return float(self.turns[branch] + k - 1 + (level - low) / (high - low))

    def time(self, index: float) -> float:
        """The clock at a fractional index."""
        k = min(int(index), len(self.clock) - 2)
        return float(self.clock[k] + (index - k) * (self.clock[k + 1] - self.clock[k]))

    def index(self, time: float) -> int:
        """The sample nearest to a time on the clock."""
        k = int(np.searchsorted(self.clock, time))
        if k <= 0 or k >= len(self.clock):
            return min(max(k, 0), len(self.clock) - 1)
        return k if self.clock[k] - time <= time - self.clock[k - 1] else k - 1

    def holds(self) -> list[Hold]:
        """All stretches where the signal stands still, in order, not overlapping."""
        found: list[Hold] = []
        if not self.span > 0:
            return found
        for turn in range(len(self.turns)):
            hold = self._hold_at_turn(turn)
            if hold is not None:
                found.append(hold)
        for branch in range(len(self.signs)):
            found += self._holds_within(branch)
        found.sort(key=lambda hold: hold.start)
        kept: list[Hold] = []
        for hold in found:
            start = max(hold.start, kept[-1].stop) if kept else hold.start
            if hold.stop - start >= HOLD_SAMPLES:
                kept.append(Hold(start, hold.stop, hold.level))
        return kept

    def _hold_at_turn(self, turn: int) -> Hold | None:
        at = self.turns[turn]
        left, right = turn - 1, turn
        has_left, has_right = turn > 0, turn < len(self.turns) - 1
        # Towards the turn the signal rises on the left branch and, seen backwards in time, on the right one.
        sign = self.signs[left] if has_left else -self.signs[right]
        top = sign * self.values[at]
        near_start = self.crossing(left, top - self.band) if has_left else float(at)
        near_stop = self.crossing(right, -(top - self.band)) if has_right else float(at)
        inside = sign * self.values[int(np.ceil(near_start)) : int(near_stop) + 1]
        level = median(inside) if len(inside) else top
        start, before = self._edge(left, level, at, rising=True) if has_left else (float(self.clock[at]), 0.0)
        stop, after = self._edge(right, -level, at, rising=False) if has_right else (float(self.clock[at]), 0.0)
        if stop - start <= SLOWNESS * max(before, after):
            return None
        first, last = self.index(start), self.index(stop)
        return Hold(first, last + (0 if has_right else 1), sign * level)

    def _edge(self, branch: int, level: float, at: int, *, rising: bool) -> tuple[float, float]:
        """The time at which a branch's ramp, drawn on straight, meets a level, and the time it takes for one band."""
        envelope = self.envelopes[branch]
        if rising:
            near_level, far_level = level - self.band, max(level - 3 * self.band, envelope[0])
        else:
            near_level, far_level = level + self.band, min(level + 3 * self.band, envelope[-1])
        near, far = self.time(self.crossing(branch, near_level)), self.time(self.crossing(branch, far_level))
        # One band's crossing is blurred by noise; two are taken where the branch is deep enough.
        pace = abs(near - far) * self.band / max(abs(near_level - far_level), 0.5 * self.band)
        turn = float(self.clock[at])
        return (min(near + pace, turn) if rising else max(near - pace, turn)), pace

    def _holds_within(self, branch: int) -> list[Hold]:
        """Stretches inside a branch that take much longer for one band than the bands before and behind."""
        envelope = self.envelopes[branch]
        offset, sign = self.turns[branch], self.signs[branch]
        clock = self.clock[offset : offset + len(envelope)]
        count = len(envelope)
        ahead = np.searchsorted(envelope, envelope + self.band, side="right")
        further = np.searchsorted(envelope, envelope + 3 * self.band, side="right")
        behind = np.searchsorted(envelope, envelope - 2 * self.band, side="left") - 1
        whole = (behind >= 0) & (further < count)
        stay = clock[np.minimum(ahead, count - 1)] - clock
        after = (clock[np.minimum(further, count - 1)] - clock[np.minimum(ahead, count - 1)]) / 2
        before = (clock - clock[np.maximum(behind, 0)]) / 2
        slow = whole & (stay > (SLOWNESS + 1) * np.maximum(before, after))
        found = []
        for first, last in stretches(slow):
            # The longest stay of the run begins at the hold itself, or less than one band before.
            best = first + int(np.argmax(stay[first:last]))
            level = median(envelope[best : ahead[best]])
            entry, _ = self._edge(branch, level, offset + int(ahead[best]) - 1, rising=True)
            leave, _ = self._edge(branch, level, offset + int(best), rising=False)
            hold = Hold(self.index(entry), self.index(leave), sign * level)
            if hold.stop - hold.start >= HOLD_SAMPLES:
                found.append(hold)
        return found
