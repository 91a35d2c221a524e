"""Cutting a test into approach, load, hold, unload and reload.

The signal that the test machine controls (force or displacement) is cut at its turning points, found by hysteresis: a
turn counts once the signal has gone back by more than the noise and more than a small share of its range. Around
and between turning points, a hold is where the signal dwells: it stays within a narrow band for several times
longer than the neighbouring ramps need to cross that band. What comes before the force begins to rise is the
approach. All thresholds are shares of the curve's own range, or multiples of its own noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, cast, get_args

import numpy as np

from .. import arguments
from .._errors import InputError
from .excursions import Drive, Hold
from .schema import Control, Curve, remembered
from .signal import branch_envelope, median, steady_clock, two_lines
from .validate import check_finite

SegmentKind = Literal["approach", "load", "hold", "unload", "reload"]


@dataclass(frozen=True)
class Segment:
    """A stretch of a curve, samples `start` to `stop - 1`.

    Attributes:
        kind: "approach" before contact, "load" beyond any force reached before, "hold" while the controlled
            quantity stands still, "unload", or "reload" up to the greatest force reached before.
        start: index of the first sample.
        stop: index behind the last sample.
    """

    kind: SegmentKind
    start: int
    stop: int

    def __post_init__(self) -> None:
        arguments.choice(self.kind, get_args(SegmentKind), "kind")
        for name in ("start", "stop"):
            object.__setattr__(self, name, arguments.whole(getattr(self, name), name))
        if self.stop < self.start:
            raise InputError(f"a segment from sample {self.start} stops at {self.stop}, before it starts")

    def __len__(self) -> int:
        return self.stop - self.start


CONTACT = 0.01  # share of the range of force up to which the beginning may count as approach
BEGINS_LOADED = 0.05
"""Share of the range of force from which on a record that begins by unloading begins under load: less is the dip by
which adhesion pulls the platens together."""


def find_segments(curve: Curve, *, control: Control | None = None) -> tuple[Segment, ...]:
    """Cut a test into segments that follow each other without gap or overlap.

    A reload that goes beyond the greatest force reached before is cut there: what follows is virgin "load". A pause
    that left no samples (a gap in time) is no segment of its own. Where the force stays at its lowest level while
    the platen moves away, that is still "unload". Small cycles that drown in noise are not found: a turn must be
    deeper than eight times the noise's standard deviation, which is estimated from the curve. A turning point belongs
    to the segment that starts there.

    Args:
        curve: the test, raw.
        control: the controlled quantity. By default it is judged from the data: displacement where it stands still
            while the force relaxes, else force.

    Returns:
        The segments in order, from 0 to the number of samples. A curve without a point or with one that is not finite,
        and a control that does not exist, raise `InputError`.
    """
    if control is not None:
        arguments.choice(control, get_args(Control), "control")
    return remembered(curve, ("segments", control), lambda: _found(curve, control))


def _found(curve: Curve, control: Control | None) -> tuple[Segment, ...]:
    """The segments of a curve, see `find_segments`."""
    if not len(curve):
        raise InputError("the curve has no point", remedy="Give a test with two points or more.")
    for name in ("time_s", "force_mN", "displacement_um"):
        check_finite(getattr(curve, name), f"the {name} of a curve", InputError)
    force, displacement = np.asarray(curve.force_mN, float), np.asarray(curve.displacement_um, float)
    clock = steady_clock(np.asarray(curve.time_s, float))
    drive = Drive(force, clock)
    if not drive.span > 0:
        return (Segment("hold", 0, len(force)),)
    chosen, holds = drive, drive.holds()
    if control is None:
        holds = [hold for hold in holds if not _moves_away(hold, drive, displacement, clock)]
    if control != "load":
        other = Drive(displacement, clock)
        # Stiff unloading may drown in the displacement's noise; then only the force knows of it.
        if len(other.turns) >= len(drive.turns):
            other_holds = other.holds()
            relaxing = [hold for hold in other_holds if _relaxes(hold, drive)]
            if control == "displacement" or (
                2 * len(relaxing) > len(other_holds) and (not _covered(relaxing, holds) or _sags(holds, drive))
            ):
                chosen, holds = other, other_holds
    onset = 0 if _begins_loaded(drive) else _contact_onset(drive, displacement, clock)
    return _assemble(chosen, holds, drive, onset)


def summarise_segments(curve: Curve, segments: tuple[Segment, ...]) -> list[dict[str, Any]]:
    """One row per segment for printing: its kind and number of samples, and its first and last time, force and
    displacement."""
    rows: list[dict[str, Any]] = []
    for part in segments:
        row: dict[str, Any] = {"kind": part.kind, "samples": len(part)}
        for first, last, values in (
            ("start_s", "stop_s", curve.time_s),
            ("force_from_mN", "force_to_mN", curve.force_mN),
            ("displacement_from_um", "displacement_to_um", curve.displacement_um),
        ):
            row |= {first: float(values[part.start]), last: float(values[part.stop - 1])}
        rows.append(row)
    return rows


def contact_index(segments: Sequence[Segment]) -> int:
    """The first reading behind the approach; 0 of a record without one."""
    return segments[0].stop if segments[0].kind == "approach" and len(segments) > 1 else 0


def _begins_loaded(force: Drive) -> bool:
    """Whether the record begins under load and unloads first."""
    return bool(force.signs and force.signs[0] < 0 and force.values[0] > BEGINS_LOADED * force.span)


def _moves_away(hold: Hold, force: Drive, displacement: np.ndarray, clock: np.ndarray) -> bool:
    """Whether a stretch of constant force is just the platen moving out of (or without) contact."""
    if hold.level > force.values.min() + max(0.05 * force.span, force.band):
        return False
    stop = min(hold.stop, len(clock)) - 1
    rate = abs(displacement[stop] - displacement[hold.start]) / max(clock[stop] - clock[hold.start], 1e-300)
    typical = np.ptp(displacement) / max(clock[-1] - clock[0], 1e-300)
    return bool(rate > 0.5 * typical)


def _relaxes(hold: Hold, force: Drive) -> bool:
    """Whether the force decays towards rest in a stretch of constant displacement."""
    part = force.values[hold.start : hold.stop]
    third = max(len(part) // 3, 1)
    begin = median(part[: max(third // 3, 1)])
    middle, end = (median(some) if len(some) else np.nan for some in (part[third : 2 * third], part[-third:]))
    if begin - end < max(0.01 * force.span, 3 * force.noise) or begin - end > 0.6 * (begin - force.values.min()):
        return False
    # Stiff unloading also leaves the displacement as it was, but it goes on at the pace of a ramp.
    turns = force.values[np.array(force.turns)]
    pace = float(np.abs(np.diff(turns)).sum() / force.clock[-1])
    span = float(force.clock[min(hold.stop, len(force.clock)) - 1] - force.clock[hold.start]) / 2
    slows = middle - end < 0.45 * (begin - middle) and middle - end < 0.25 * pace * span
    return slows and end < middle + max(0.25 * (begin - middle), force.noise)


def _covered(holds: list[Hold], by: list[Hold]) -> bool:
    """Whether most of the samples of `holds` lie in `by`."""
    total = sum(hold.stop - hold.start for hold in holds)
    shared = sum(max(0, min(a.stop, b.stop) - max(a.start, b.start)) for a in holds for b in by)
    return shared > 0.8 * total


def _sags(holds: list[Hold], force: Drive) -> bool:
    """Whether the force falls, beyond doubt, within most of the stretches that seem constant."""
    count = 0
    for hold in holds:
        third = max((hold.stop - hold.start) // 3, 1)
        part = force.values[hold.start : hold.stop]
        fall = median(part[:third]) - median(part[-third:])
        count += fall > max(6 * force.noise / np.sqrt(third), 0.2 * force.band)
    return bool(2 * count > len(holds))


def _contact_onset(force: Drive, displacement: np.ndarray, clock: np.ndarray) -> int:
    """The index at which the force begins to rise; 0 if the curve begins in contact.

    Up to a small force, a flat stretch followed by a rise lies far below the straight line from its first to its
    last point; a smooth rise from the first sample on does not.
    """
    values, least = force.values, 10 * force.noise
    rise = max(CONTACT * force.span, least)
    peaks = (
        b
        for a, b, sign in zip(force.turns, force.turns[1:], force.signs, strict=False)
        if sign > 0 and values[b] - values[a] > 1.5 * rise
    )
    peak = next(peaks, None)
    if peak is None:
        return 0
    before = values[: peak + 1]
    base = median(before[before <= before.min() + rise / 2])
    onset = 0
    while True:
        stop = int(np.flatnonzero(before <= base + rise)[-1]) + 1
        along = _bend(values[:stop], rise, (clock, displacement))
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
    for a, b, sign in zip(drive.turns, drive.turns[1:], drive.signs, strict=False):
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
