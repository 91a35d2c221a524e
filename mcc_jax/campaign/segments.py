"""Cutting a test into approach, load, hold, unload and reload.

The signal that the test machine controls is cut at its turning points: a turn counts once the signal has gone back by
more than its noise and more than a small share of its range. A hold is where it stays within a narrow band for several
times longer than the neighbouring ramps need to cross it. What comes before the force begins to rise is the approach.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple, cast, get_args

import numpy as np

from .. import arguments
from .._errors import InputError
from .schema import CHANNELS, Control, Curve, remembered
from .signal import branch_envelope, median, noise_level, steady_clock, stretches, turning_points, two_lines

CONTACT = 0.01  # share of the range of force up to which the beginning may count as approach
BEGINS_LOADED = 0.05  # share of the range of force from which a record begins under load; less is the dip of adhesion
SMALLEST_TURN = 0.005  # least depth of a turn, as a share of the signal's range
TURN_NOISE = 8.0  # the same in standard deviations of the noise
BAND = 0.0025  # height that a ramp must pass to be none of a hold, as a share of the range; or four deviations
SLOWNESS = 6.0  # times longer than the ramps next to it that a hold takes for the width of the band
HOLD_SAMPLES = 4  # of a hold, at least

SegmentKind = Literal["approach", "load", "hold", "unload", "reload"]


@dataclass(frozen=True)
class Segment:
    """A stretch of a curve, samples `start` to `stop - 1`.

    The kind is "approach" before contact, "load" beyond any force reached before, "hold" while the controlled quantity
    stands still, "unload", or "reload" up to the greatest force reached before.
    """

    kind: SegmentKind
    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start


def find_segments(curve: Curve, *, control: Control | None = None) -> tuple[Segment, ...]:
    """Cut a test into segments that follow each other without gap or overlap.

    A reload that goes beyond the greatest force reached before is cut there: what follows is virgin "load". Where the
    force stays at its lowest level while the platen moves away, that is "unload", too. A turning point begins the next.

    By default the controlled quantity is judged from the data: displacement where it stands still while the force
    relaxes, else force. A curve without a point, or with one that is not finite, raises `InputError`.
    """
    if control is not None:
        arguments.choice(control, get_args(Control), "control")
    return remembered(curve, ("segments", control), lambda: _found(curve, control))


def contact_index(segments: Sequence[Segment]) -> int:
    """The first reading behind the approach; 0 of a record without one."""
    return segments[0].stop if segments[0].kind == "approach" and len(segments) > 1 else 0


class Hold(NamedTuple):
    """Samples `start` to `stop - 1`, where the signal stands at `level`."""

    start: int
    stop: int
    level: float


class Drive:
    """A signal from 0 to 1, so that nothing depends on units, with its noise, turning points and, per branch between
    them, its direction and its monotone envelope, made rising."""

    def __init__(self, values: np.ndarray, clock: np.ndarray) -> None:
        values = np.asarray(values, float)
        span = float(np.ptp(values))
        self.moves = span > 0
        self.values = values = (values - values.min()) / span if self.moves else np.zeros(len(values))
        self.clock = clock
        self.noise = noise_level(values, 1.0)
        self.band = max(BAND, 4 * self.noise)
        self.turns = turning_points(values, max(SMALLEST_TURN, TURN_NOISE * self.noise))
        self.branches = list(pairwise(self.turns))
        self.signs = [1 if values[b] >= values[a] else -1 for a, b in self.branches]
        self.envelopes = [
            branch_envelope(sign * values[a : b + 1]) for (a, b), sign in zip(self.branches, self.signs, strict=True)
        ]

    def holds(self) -> list[Hold]:
        """All stretches where the signal stands still, in order, not overlapping."""
        if not self.moves:
            return []
        found = [hold for turn in range(len(self.turns)) if (hold := self._hold_at_turn(turn)) is not None]
        for branch in range(len(self.branches)):
            found += self._holds_within(branch)
        kept: list[Hold] = []
        for hold in sorted(found, key=lambda hold: hold.start):
            start = max(hold.start, kept[-1].stop) if kept else hold.start
            if hold.stop - start >= HOLD_SAMPLES:
                kept.append(hold._replace(start=start))
        return kept

    def _crossing(self, branch: int, level: float) -> float:
        """The index (fractional) at which a branch, counted in its own direction, passes a level."""
        envelope = self.envelopes[branch]
        k = int(np.searchsorted(envelope, level))
        if k in (0, len(envelope)):
            return float(self.turns[branch] + min(k, len(envelope) - 1))
        low, high = envelope[k - 1], envelope[k]
        return float(self.turns[branch] + k - 1 + (level - low) / (high - low))

    def _time(self, index: float) -> float:
        """The clock at a fractional index."""
        k = min(int(index), len(self.clock) - 2)
        return float(self.clock[k] + (index - k) * (self.clock[k + 1] - self.clock[k]))

    def _index(self, time: float) -> int:
        """The sample nearest to a time on the clock."""
        k = min(max(int(np.searchsorted(self.clock, time)), 1), len(self.clock) - 1)
        return k if self.clock[k] - time <= time - self.clock[k - 1] else k - 1

    def _edge(self, branch: int, level: float, at: int, *, rising: bool) -> tuple[float, float]:
        """The time at which a branch's ramp, drawn on straight, meets a level, and the time it takes for one band."""
        envelope, away = self.envelopes[branch], -1 if rising else 1
        near_level = level + away * self.band
        far_level = min(max(level + away * 3 * self.band, envelope[0]), envelope[-1])
        near, far = self._time(self._crossing(branch, near_level)), self._time(self._crossing(branch, far_level))
        # One band's crossing is blurred by noise; two are taken where the branch is deep enough.
        pace = abs(near - far) * self.band / max(abs(near_level - far_level), 0.5 * self.band)
        turn, meets = float(self.clock[at]), near - away * pace
        return (min(meets, turn) if rising else max(meets, turn)), pace

    def _hold_at_turn(self, turn: int) -> Hold | None:
        at, left, right = self.turns[turn], turn - 1, turn
        has_left, has_right = turn > 0, turn < len(self.turns) - 1
        # Towards the turn the signal rises on the left branch and, seen backwards in time, on the right one.
        sign = self.signs[left] if has_left else -self.signs[right]
        top = sign * self.values[at]
        near_start = self._crossing(left, top - self.band) if has_left else float(at)
        near_stop = self._crossing(right, -(top - self.band)) if has_right else float(at)
        inside = sign * self.values[int(np.ceil(near_start)) : int(near_stop) + 1]
        level = median(inside) if len(inside) else top
        start, before = self._edge(left, level, at, rising=True) if has_left else (float(self.clock[at]), 0.0)
        stop, after = self._edge(right, -level, at, rising=False) if has_right else (float(self.clock[at]), 0.0)
        if stop - start <= SLOWNESS * max(before, after):
            return None
        return Hold(self._index(start), self._index(stop) + (0 if has_right else 1), sign * level)

    def _holds_within(self, branch: int) -> list[Hold]:
        """Stretches inside a branch that take much longer for one band than the bands before and behind."""
        envelope = self.envelopes[branch]
        offset, count = self.turns[branch], len(envelope)
        clock = self.clock[offset : offset + count]
        ahead = np.searchsorted(envelope, envelope + self.band, side="right")
        further = np.searchsorted(envelope, envelope + 3 * self.band, side="right")
        behind = np.searchsorted(envelope, envelope - 2 * self.band, side="left") - 1
        there = clock[np.minimum(ahead, count - 1)]
        after = (clock[np.minimum(further, count - 1)] - there) / 2
        before = (clock - clock[np.maximum(behind, 0)]) / 2
        stay = there - clock
        slow = (behind >= 0) & (further < count) & (stay > (SLOWNESS + 1) * np.maximum(before, after))
        found = []
        for first, last in stretches(slow):
            # The longest stay of the run begins at the hold itself, or less than one band before.
            best = first + int(np.argmax(stay[first:last]))
            level = median(envelope[best : ahead[best]])
            entry, _ = self._edge(branch, level, offset + int(ahead[best]) - 1, rising=True)
            leave, _ = self._edge(branch, level, offset + best, rising=False)
            found.append(Hold(self._index(entry), self._index(leave), self.signs[branch] * level))
        return [hold for hold in found if hold.stop - hold.start >= HOLD_SAMPLES]


def _found(curve: Curve, control: Control | None) -> tuple[Segment, ...]:
    if not len(curve) or not all(np.isfinite(getattr(curve, name)).all() for name in CHANNELS):
        raise InputError("the curve has no point, or one that is not finite")
    clock = steady_clock(np.asarray(curve.time_s, float))
    drive = Drive(curve.force_mN, clock)
    if not drive.moves:
        return (Segment("hold", 0, len(curve)),)
    chosen, holds = drive, drive.holds()
    if control is None:
        holds = [hold for hold in holds if not _moves_away(hold, drive, curve.displacement_um)]
    if control != "load":
        other = Drive(curve.displacement_um, clock)
        # Stiff unloading may drown in the displacement's noise; then only the force knows of it.
        if len(other.turns) >= len(drive.turns):
            other_holds = other.holds()
            relaxing = [hold for hold in other_holds if _relaxes(hold, drive)]
            if control == "displacement" or (
                2 * len(relaxing) > len(other_holds) and (not _covered(relaxing, holds) or _sags(holds, drive))
            ):
                chosen, holds = other, other_holds
    onset = 0 if _begins_loaded(drive) else _contact_onset(drive, curve.displacement_um)
    return _assemble(chosen, holds, drive, onset)


def _begins_loaded(force: Drive) -> bool:
    """Whether the record begins under load and unloads first."""
    return bool(force.signs and force.signs[0] < 0 and force.values[0] > BEGINS_LOADED)


def _moves_away(hold: Hold, force: Drive, displacement: np.ndarray) -> bool:
    """Whether a stretch of constant force is just the platen moving out of (or without) contact."""
    if hold.level > max(0.05, force.band):
        return False
    clock, stop = force.clock, hold.stop - 1
    rate = abs(displacement[stop] - displacement[hold.start]) / max(clock[stop] - clock[hold.start], 1e-300)
    typical = np.ptp(displacement) / max(clock[-1] - clock[0], 1e-300)
    return bool(rate > 0.5 * typical)


def _relaxes(hold: Hold, force: Drive) -> bool:
    """Whether the force decays towards rest in a stretch of constant displacement."""
    part = force.values[hold.start : hold.stop]
    third = len(part) // 3
    begin, middle, end = (median(some) for some in (part[: max(third // 3, 1)], part[third : 2 * third], part[-third:]))
    if begin - end < max(0.01, 3 * force.noise) or begin - end > 0.6 * begin:
        return False
    # Stiff unloading also leaves the displacement as it was, but it goes on at the pace of a ramp.
    pace = float(np.abs(np.diff(force.values[force.turns])).sum() / force.clock[-1])
    span = float(force.clock[hold.stop - 1] - force.clock[hold.start]) / 2
    slows = middle - end < 0.45 * (begin - middle) and middle - end < 0.25 * pace * span
    return slows and end < middle + max(0.25 * (begin - middle), force.noise)


def _covered(holds: list[Hold], by: list[Hold]) -> bool:
    """Whether most of the samples of `holds` lie in `by`."""
    total = sum(hold.stop - hold.start for hold in holds)
    shared = sum(max(0, min(a.stop, b.stop) - max(a.start, b.start)) for a in holds for b in by)
    return shared > 0.8 * total


def _sags(holds: list[Hold], force: Drive) -> bool:
    """Whether the force falls, beyond doubt, within most of the stretches that seem constant."""
    parts = [(force.values[hold.start : hold.stop], (hold.stop - hold.start) // 3) for hold in holds]
    falls = [
        median(part[:third]) - median(part[-third:]) > max(6 * force.noise / np.sqrt(third), 0.2 * force.band)
        for part, third in parts
    ]
    return bool(2 * sum(falls) > len(holds))


def _contact_onset(force: Drive, displacement: np.ndarray) -> int:
    """The index at which the force begins to rise; 0 if the curve begins in contact."""
    # Up to a small force, a flat stretch and a rise lie far below the line from first to last point, a smooth rise not.
    values, least = force.values, 10 * force.noise
    rise = max(CONTACT, least)
    peak = next((b for a, b in force.branches if values[b] - values[a] > 1.5 * rise), None)
    if peak is None:
        return 0
    before = values[: peak + 1]
    base = median(before[before <= before.min() + rise / 2])
    onset = 0
    while True:
        stop = int(np.flatnonzero(before <= base + rise)[-1]) + 1
        along = _bend(values[:stop], rise, (force.clock, displacement))
        # Some samples of the rise must be seen to distinguish it from what precedes it, also where it is steep.
        stop = min(stop + 8, peak + 1)
        if along is None or stop < 8:
            return onset
        onset = two_lines(along[:stop], values[:stop])
        # A lower limit brings the bend closer to the contact, as far as noise and sampling allow.
        smaller = max(2 * (values[onset] - base), least)
        if smaller > 0.7 * rise or stop - onset < 20:
            return onset
        rise = smaller


def _bend(values: np.ndarray, rise: float, abscissae: tuple[np.ndarray, ...]) -> np.ndarray | None:
    """The abscissa over which the values bend most clearly from flat to rising, or None."""
    if len(values) < 4:
        return None
    lower = np.minimum.accumulate(values[::-1])[::-1]
    height = np.minimum((lower - lower[0]) / rise, 1)
    best, bent = 0.5, None
    for whole in abscissae:
        along = whole[: len(values)]
        low, high = along.min(), along[-1]
        depth = float(((along - low) / (high - low) - height).max()) if high > low else 0.0
        if depth > best:
            best, bent = depth, whole
    return bent


def _assemble(drive: Drive, holds: list[Hold], force: Drive, onset: int) -> tuple[Segment, ...]:
    """Kinds by direction, holds and the greatest force so far; neighbours of one kind become one."""
    count = len(drive.values)
    kinds = np.empty(count, dtype="U8")
    reached, virgin, unloaded = -np.inf, -np.inf, False
    if _begins_loaded(force):
        # Up to the force at which the record begins to unload nothing is virgin any more.
        reached = virgin = float(force.values[0]) - 2 * force.noise
        unloaded = True
    crossed = -1
    for (a, b), sign in zip(drive.branches, drive.signs, strict=True):
        if sign < 0:
            # The turning point belongs to what starts there, unless it is all that went beyond the peaks before.
            kinds[a + (crossed == a and unloaded) : b + 1] = "unload"
            unloaded = unloaded or reached > -np.inf
            continue
        part = force.values[a : b + 1]
        top = int(np.argmax(part))
        # The greatest of many samples lies above the course by about two deviations of the noise.
        level = float(part[top]) - 2 * force.noise
        crossed = a
        if unloaded:
            # A peak that only repeats those before exceeds them by noise, at most; peaks that creep add up.
            beyond = level > virgin + force.band + 2 * force.noise
            crossed = a + int(np.searchsorted(branch_envelope(part[: top + 1]), reached)) if beyond else b + 1
        kinds[a:crossed] = "reload"
        kinds[crossed : b + 1] = "load"
        reached = max(reached, level)
        if crossed <= b:
            virgin = reached
    for hold in holds:
        kinds[hold.start : hold.stop] = "hold"
        if onset > 0 and hold.start < onset < hold.stop:
            onset = hold.stop  # waiting without force ends where the force rises, which the hold shows better
    kinds[:onset] = "approach"
    cuts = np.flatnonzero(kinds[1:] != kinds[:-1]) + 1
    edges = [0, *cuts.tolist(), count]
    return tuple(Segment(cast(SegmentKind, str(kinds[a])), a, b) for a, b in pairwise(edges))
