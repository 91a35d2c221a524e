"""The zero of force: what the load cell reads, and drifts by, before the platens touch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from .findings import Finding
from .schema import Campaign, Control, Curve
from .segments import contact_index, find_segments
from .signal import Line, differences, median, point_noise, two_lines

AIR_READINGS = 5  # before contact, at least: fewer do not give the zero's error
AIR_SAID = 3.0  # standard deviations from which on an offset is reported
AIR_SHARE = 1e-3  # of the largest force, likewise: below it no answer moves by a tenth of its error
DRIFT_SAID = 5.0  # standard deviations of its slope from which on a drift before contact is reported
DRIFT_SLOWER = 0.1  # of loading's slope: a straight rise before loading is a drift up to here, as is any straight fall
DRIFT_LIKE = 0.7  # up to this share it may be one, and is reported; first contact of asperities is not straight
OTHER_STIFFNESS = 1.5  # factor in force over displacement; with less, only the speed of the test machine changed
START_SHARE = 0.1  # of the largest force, up to which a drift is looked for: no preload is larger, and loading bends

CHECK = "zero of force"
OFFSET = Finding(CHECK, "info", "force reads {} mN before contact; this was taken off", code="offset")
DRIFT = Finding(
    CHECK,
    "warning",
    "force drifts by {} mN before contact; the zero at contact ({} mN) was taken off, with this drift as its error",
    "Let the load cell settle before a test",
    code="drift",
)
PERHAPS_DRIFT = Finding(
    CHECK,
    "warning",
    "force changes linearly by {} mN before loading starts; it is counted as contact, but would be a drift of the load "
    "cell if the platens did not touch yet",
    "Cut these readings off if the platens did not touch yet, and let the load cell settle before a test",
    code="possible drift",
)
NOT_TARED = Finding(
    CHECK,
    "warning",
    "force begins at {} mN without a reading before contact; {} mN was taken off",
    "Tare the load cell, and begin before contact",
    code="not tared",
)
OPEN = Finding(
    CHECK,
    "info",
    "force begins at {} mN without a reading before contact: a preload, or a load cell that was not tared",
    "Distinguish the two by readings before contact",
    code="preload or not tared",
)


class ZeroOfForce(NamedTuple):
    """The zero of force of a test [mN]."""

    path: np.ndarray | float  # what to take off: at each reading, shape (n,), or the same at all
    value: float  # at contact
    sd: float
    finding: Finding | None


def zero_of_force(
    curve: Curve, control: Control | None, zero_mN: tuple[float, float] | None, tests: int
) -> ZeroOfForce | None:
    """The force that is read before contact; None if nothing shows another zero than the file's own.

    `zero_mN` is the zero that all tests share, if they do, and its error; `tests` how many the campaign has.
    Without a drift it is the readings' mean. With a drift it is their line over time up to contact, and its value there
    from then on; the drift during the test is unknown, so its change before contact is the error.
    """
    contact, change = _air_until(curve, control)
    least = AIR_SHARE * float(np.ptp(curve.force_mN))
    if contact is None:
        # A rise before loading that is too quick to be taken for a drift, and too straight for a contact.
        if abs(change) > least:
            return ZeroOfForce(0.0, 0.0, 0.0, PERHAPS_DRIFT.of(change))
        return _begins_elsewhere(curve, zero_mN, least, tests)
    # The last readings before the platens touch may already feel the first asperities.
    stop = max(AIR_READINGS, int(0.9 * contact))
    air, when = curve.force_mN[:stop], curve.time_s[:stop]
    mean, sd, line = float(np.mean(air)), float(np.std(air, ddof=1)), Line.through(when, air)
    least = AIR_SHARE * max(float(np.max(curve.force_mN) - mean), 1e-300)
    error = 0.0
    if sd > 0 and line.spread > 0:
        change = abs(line.slope * float(when[-1] - when[0]))
        if abs(line.slope) > DRIFT_SAID * line.slope_sd * _inflation(line.left) and change > least:
            path = line.at(np.minimum(curve.time_s, curve.time_s[contact - 1]))
            error = float(np.hypot(line.sd / np.sqrt(len(air)), change / np.sqrt(12)))
            return ZeroOfForce(path, float(path[-1]), error, DRIFT.of(change, float(path[-1])))
        error = float(sd / np.sqrt(len(air)) * _inflation(air - mean))
    reported = abs(mean) > max(AIR_SAID * error, least)
    return ZeroOfForce(mean, mean, error, OFFSET.of(mean) if reported else None)


def unusual(tests: int) -> float:
    """Standard deviations that the farthest of so many noisy readings passes as rarely as one alone passes `AIR_SAID`
    (Sidak 1967, J. Am. Stat. Assoc. 62, 626): of many tests a few begin far from zero by chance."""
    normal = NormalDist()
    return normal.inv_cdf(normal.cdf(AIR_SAID) ** (1 / tests))


def open_zero(campaign: Campaign) -> tuple[float, float] | None:
    """The zero of force [mN] and its error, if checked tests were not tared of which some may have been preloaded."""
    zero = shared_zero(campaign.curves, OPEN)
    return zero if zero is not None and zero[0] > 0 else None


def shared_zero(curves: Sequence[Curve], needed: Finding) -> tuple[float, float] | None:
    """The zero that all checked tests share, and its error [mN]; None if they share none, or none has this finding.

    Every test of one load cell begins within a step of its ramp above its zero: the line of first readings over first
    steps, weighted by the step, meets the zero where the step is nil. Of two tests it is the lowest reading.
    """
    checked = [curve.checked for curve in curves]
    if all(one.code != needed.code for each in checked if each is not None for one in each.findings):
        return None
    taken_off = [0.0 if one is None else one.force_zero_mN for one in checked]
    begins = np.array([curve.force_mN[0] + off for curve, off in zip(curves, taken_off, strict=True)])
    steps = np.array([_first_steps(curve) for curve in curves])
    noise = max(point_noise(curve.force_mN) for curve in curves)
    chance = unusual(len(curves)) * noise
    lowest = int(np.argmin(begins))
    zero, error = float(begins[lowest]), float(steps[lowest] / np.sqrt(12))
    if len(curves) > 2 and np.all(steps > noise):
        line = Line.through(1 / steps, begins / steps)
        if line.spread > 0 and line.slope_sd < error and line.slope <= zero + chance:
            zero, error = line.slope, max(line.slope_sd, noise / np.sqrt(len(steps)))
    return (zero, error) if np.all(begins - zero <= steps + chance) else None


def _first_steps(curve: Curve) -> float:
    """By how much force grows from one reading to the next where a record begins [mN]."""
    return median(np.abs(differences(curve.force_mN[: AIR_READINGS + 1])))


def _begins_elsewhere(
    curve: Curve, zero_mN: tuple[float, float] | None, least: float, tests: int
) -> ZeroOfForce | None:
    """A record in contact whose first reading is below zero, or more than a step of the ramp above it."""
    first = float(curve.force_mN[0])
    if zero_mN is not None:
        zero, error = zero_mN
        return ZeroOfForce(zero, zero, error, NOT_TARED.of(first, zero) if zero < 0 else None)
    least = max(least, unusual(tests) * point_noise(curve.force_mN))
    # A record that begins far from zero has lost its loading, and shows no zero at all.
    if -least <= first <= _first_steps(curve) + least or abs(first) > START_SHARE * float(curve.force_mN.max()):
        return None
    if first < 0:  # not tared: the error is as large as the reading itself, unless all tests share a zero
        return ZeroOfForce(first, first, -first, NOT_TARED.of(first, first))
    return ZeroOfForce(0.0, 0.0, 0.0, OPEN.of(first))  # not tared or a preload: the file's own zero stays


def _inflation(scatter: np.ndarray) -> float:
    """How much larger the error of a mean of autocorrelated readings is, by their lag-1 correlation."""
    lag = min(max(float(scatter[1:] @ scatter[:-1] / max(scatter @ scatter, 1e-300)), 0.0), 0.9)
    return float(np.sqrt((1 + lag) / (1 - lag)))


def _air_until(curve: Curve, control: Control | None) -> tuple[int | None, float]:
    """Number of readings before contact; if too few, None, and what may be a drift of force [mN] before it."""
    contact = contact_index(find_segments(curve, control=control))
    if contact > AIR_READINGS:
        return contact, 0.0
    ahead = slow_start(curve)
    if ahead is None:
        return None, 0.0
    line, stop, share = ahead
    change = line.slope * float(curve.time_s[stop - 1] - curve.time_s[0])
    if share > DRIFT_SLOWER:
        return None, change
    # The approach is looked for again without the drift.
    drift = line.at(np.minimum(curve.time_s, curve.time_s[stop - 1]))
    contact = contact_index(find_segments(replace(curve, force_mN=curve.force_mN - drift), control=control))
    return (contact if contact > AIR_READINGS else None), change


def slow_start(curve: Curve) -> tuple[Line, int, float] | None:
    """A straight and slower course of force before loading, of a load cell that drifts: the line, how many readings it
    has, and its slope as a share of loading's."""
    force, time, path = curve.force_mN, curve.time_s, curve.displacement_um
    first = int(np.argmax(force > force[0] + START_SHARE * (force.max() - force[0])))
    if first < 2 * AIR_READINGS + 4:
        return None
    kink = two_lines(time[: first + 1], force[: first + 1])
    if kink <= AIR_READINGS or kink > first - 3:
        return None
    ahead, behind = slice(kink), slice(kink, first + 1)
    if not (time[kink - 1] > time[0] and time[first] > time[kink]):
        return None
    slow, fast = (Line.through(time[rows], force[rows]) for rows in (ahead, behind))
    way, on = (Line.through(time[rows], path[rows]).slope for rows in (ahead, behind))
    error = point_noise(force) * np.sqrt(1 / slow.spread + 1 / fast.spread)
    share, pace = slow.slope / max(fast.slope, 1e-300), way / max(on, 1e-300)
    distinct = fast.slope - slow.slope > DRIFT_SAID * error and share <= DRIFT_LIKE
    # A slower speed of the test machine bends force and displacement alike.
    only_slower = pace > 0 and share > 0 and 1 / OTHER_STIFFNESS < share / pace < OTHER_STIFFNESS
    straight = np.std(slow.left) <= 2 * point_noise(force[ahead]) + 1e-12 * float(np.ptp(force))
    return (slow, kink, share) if distinct and straight and not only_slower else None
