"""Faults of tests and instruments: found, reported in words, and corrected where the record allows.

`check_tests` looks for spikes, stuck channels, lost loading, breakage, the zero of force (`force_zero`) and channels at
the end of their range (`saturation`), in this order; each check sees what those before it left. A test in which nothing
is found stays what it is, to the last bit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .findings import Finding, joined
from .force_zero import NOT_TARED, shared_zero, zero_of_force
from .plausibility import wrong_signs
from .pull_off import pulled_off
from .saturation import censor_displacement, censor_force
from .schema import Campaign, Checked, Control, Curve, check_campaign
from .segments import find_segments
from .signal import differences, median, point_noise, quantile, runs, stretches

# Every threshold is such that no sound record reaches it.
SPIKE_NOISE = 15.0  # standard deviations; of 1e6 normal readings the farthest lies at 5, the rest is for other noise
SPIKE_STEPS = 5.0  # steps between neighbours; a turning point of a ramp lies within 3 steps of the running median
SPIKE_READ_OUT = 2.5  # smallest steps of the read-out
SPIKE_RANGE = 0.02  # of the channel's range from 5 to 95 %
STUCK_READINGS = 6  # repeats at least; also three times the repeats elsewhere, as of a coarse read-out
STUCK_CATCH_UP = 0.5  # share of the ramp's progress in that time that the jump behind the repeats makes up for
STUCK_JUMP = 2.5  # times any step near it: a coarse read-out jumps by one step at a time
BEGINS_AT = 0.95  # share of the largest force that the first readings of a record without loading reach
LOSS_OF_FORCE = 0.25  # of the largest force; settling and rotation of ceramic pebbles lose up to a tenth at once
LOSS_READINGS = 3  # within which this force is lost
LOSS_PACE = 5.0  # times the pace of force elsewhere
LOSS_FROM = 0.05  # of the largest force: below it, the platens bounce on asperities
LOSS_NOISE = 10.0  # standard deviations of the noise
GOES_ON = 0.5  # of the platens' speed before; in unloading they part, and creep at its start is slower than loading

SPIKES = Finding(
    "spikes", "info", "single readings of CHANNEL ({}) lie far from their neighbours and are left out", code="spike"
)
STUCK = Finding(
    "stuck readings",
    "info",
    "{} readings of CHANNEL repeat the previous reading while the test continues, and are left out",
    "Look for a loose cable or a full buffer of the logger",
    code="stuck",
)
NO_LOADING = Finding(
    "loading",
    "warning",
    "the record begins at its largest force ({} mN), so its loading is missing",
    "Join the loading part of the test to it: some test machines store the two separately",
    code="no loading",
)
BROKE = Finding(
    "breakage",
    "warning",
    "the particle broke at {} mN (the force falls by {} % at once); its record counts up to there",
    "Use a lower maximum load for this batch, or leave this particle out",
    code="broke",
)
GIVES_WAY = Finding(
    "breakage",
    "info",
    "force falls after {} mN while the platens keep closing (the particle gives way or slips): {} readings are left "
    "out",
    "Check whether the particle has broken; if so, load it less",
    code="gives way",
)


def check_tests(campaign: Campaign, *, zero_mN: tuple[float, float] | None = None) -> Campaign:
    """The campaign with the faults of its tests found, corrected where the record allows, and reported.

    Its curves hold the readings that count, with the zero of force taken off; `raw` is the campaign that was given, and
    `campaign_findings` says what was found. One that was checked already comes back as it is. Records that begin in
    contact have the zero of force and its error `zero_mN`, or the file's own.
    """
    check_campaign(campaign)
    if campaign.raw is not None:
        return campaign
    if wrong_signs(campaign):
        return replace(campaign, raw=campaign)  # what looks like air or breakage is the test read backwards
    control = campaign.metadata.control
    curves = tuple(_check_test(curve, control, zero_mN, len(campaign)) for curve in campaign.curves)
    zero = shared_zero(curves, NOT_TARED) if zero_mN is None else None
    if zero is not None:
        return check_tests(campaign, zero_mN=zero)
    return replace(campaign, curves=curves, raw=campaign)


def campaign_findings(campaign: Campaign) -> tuple[Finding, ...]:
    """What `check_tests` found in a campaign and which particles stuck to the platens, one finding for all alike."""
    check_campaign(campaign)
    each = {}
    for name, sizes, curve in zip(campaign.particles, campaign.diameters_um, campaign.curves, strict=True):
        faults = () if curve.checked is None else curve.checked.findings
        each[name] = (*faults, *pulled_off(curve, sizes))
    return joined(each)


def _check_test(curve: Curve, control: Control | None, zero_mN: tuple[float, float] | None, tests: int) -> Curve:
    clean, rows = curve, np.arange(len(curve))
    found: list[Finding] = []

    def leave_out(gone: np.ndarray, finding: Finding) -> None:
        nonlocal clean, rows
        if gone.any():
            found.append(finding)
            rows, keep = rows[~gone], ~gone
            clean = Curve(clean.time_s[keep], clean.force_mN[keep], clean.displacement_um[keep])

    for wrong, finding in ((spikes, SPIKES), (stuck, STUCK)):
        for channel, name in (("force_mN", "force"), ("displacement_um", "displacement")):
            gone = wrong(getattr(clean, channel))
            of_channel = replace(finding, sentence=finding.sentence.replace("CHANNEL", name))
            leave_out(gone, of_channel.of(int(gone.sum())))
    if begins_at_peak(clean):
        found.append(NO_LOADING.of(float(clean.force_mN[0])))
    if (broke := breakage(clean)) is not None:
        last, lost = broke
        leave_out(np.arange(len(clean)) > last, BROKE.of(float(clean.force_mN[last]), 100 * lost))
    gone = gives_way(clean, control)
    leave_out(gone, GIVES_WAY.of(float(clean.force_mN[np.argmax(gone) - 1]), int(gone.sum())))
    value, sd = 0.0, 0.0
    if (zero := zero_of_force(clean, control, zero_mN, tests)) is not None:
        value, sd = zero.value, zero.sd
        found += [] if zero.finding is None else [zero.finding]
        clean = replace(clean, force_mN=clean.force_mN - zero.path)
    compared, force_sd = np.ones(len(clean), bool), np.zeros(len(clean))
    if (seen := censor_force(clean)) is not None:
        clean, kept = seen
        rows, compared, force_sd = rows[kept.rows], kept.compared, kept.force_sd_mN
        found += kept.findings
    if (hidden := censor_displacement(clean)) is not None:
        found.append(hidden[1])
        compared = compared & ~hidden[0]
    if not found and zero is None:
        return curve
    return replace(clean, checked=Checked(rows, compared, value, sd, force_sd, tuple(found)))


def spikes(values: np.ndarray) -> np.ndarray:
    """Which readings, one or two at a time, lie far from the median of the seven around them; booleans."""
    count = len(values)
    if count < 12:
        return np.zeros(count, bool)
    around = np.lib.stride_tricks.sliding_window_view(_edged(values, 3, 3), 7)
    middle = np.partition(around, 3, axis=1)[:, 3]
    moves = np.abs(differences(values))
    # The pace nearby, but not so near that the reading itself shifts the median.
    pace = _edged(np.abs(differences(middle)), 10, 11)
    windows = np.lib.stride_tricks.sliding_window_view(pace, 21)[:count]
    local = np.maximum(windows[:, :6].max(axis=1), windows[:, 15:].max(axis=1))
    spread = quantile(values, 0.95) - quantile(values, 0.05)
    least = max(SPIKE_NOISE * point_noise(values), SPIKE_RANGE * spread, 1e-300)
    far = np.abs(values - middle) > np.maximum(least, SPIKE_STEPS * np.maximum(median(moves), local))
    far[[0, 1, -2, -1]] = False  # at the ends the median of the neighbours is no middle
    if moves.any():  # one step of a coarse read-out is none
        far &= np.abs(values - middle) > SPIKE_READ_OUT * float(moves[moves > 0].min())
    # Three or more in a row are no error of the read-out but something that happened.
    for start, stop in stretches(far):
        if stop - start > 2:
            far[start:stop] = False
    return far


def _edged(values: np.ndarray, before: int, behind: int) -> np.ndarray:
    """Numbers with their first and last one repeated; `numpy.pad` takes ten times as long."""
    return np.concatenate((np.full(before, values[0]), values, np.full(behind, values[-1])))


def stuck(values: np.ndarray) -> np.ndarray:
    """Which readings only repeat the one before, and are made up for by a jump behind them; booleans."""
    found = np.zeros(len(values), bool)
    starts, stops = runs(values)
    lengths = stops - starts
    if len(lengths) < 8:
        return found
    steps = np.abs(differences(values))
    typical = median(steps[steps > 0])
    for i in np.flatnonzero(lengths >= max(STUCK_READINGS, 3 * quantile(lengths, 0.9))).tolist():
        start, stop = int(starts[i]), int(stops[i])
        near = np.concatenate([steps[max(start - 20, 0) : max(start - 1, 0)], steps[stop : stop + 20]])
        if start == 0 or stop >= len(values) or not len(near):
            continue
        caught_up = STUCK_CATCH_UP * (stop - start) * median(near)
        if steps[stop - 1] > max(caught_up, STUCK_JUMP * max(typical, float(np.max(near)))):
            found[start + 1 : stop] = True
    return found


def begins_at_peak(curve: Curve) -> bool:
    """Whether a record has lost its loading: it begins at its largest force and unloads."""
    force = curve.force_mN
    largest, first = float(force.max()), median(force[:3])
    # One that ends there as well never unloads; one with the sign of its force reversed has no largest force.
    return first > 0.5 * float(-force.min()) and first >= BEGINS_AT * largest > 2 * median(force[-3:])


def breakage(curve: Curve) -> tuple[int, float] | None:
    """The last reading before the particle broke, and the share of its force that it lost at once; None if it held."""
    # The force falls within a few readings, much faster than elsewhere, while the platens do not separate, and does not
    # come back at once. A jump of displacement under load control is no sign of it: many particles pop in.
    force, path, time = curve.force_mN, curve.displacement_um, curve.time_s
    count = len(force)
    if count < 12:
        return None
    load = force - force.min()
    reached = np.maximum.accumulate(load)
    back = _way_back(path)
    steps, interval = np.abs(differences(force)), differences(time)
    moving = steps > 0.05 * max(median(steps), 1e-300)
    pace = median(steps[moving] / np.maximum(interval[moving], 1e-300)) if moving.any() else 0.0
    least = LOSS_NOISE * point_noise(force)
    found = []
    for width in range(1, LOSS_READINGS + 1):
        drop = force[:-width] - force[width:]
        with np.errstate(over="ignore"):  # at the first readings, which are not judged
            share = drop / np.maximum(reached[:-width], 1e-300)
        fast = drop > LOSS_PACE * pace * (time[width:] - time[:-width])
        sudden = (share > LOSS_OF_FORCE) & fast & (path[width:] - path[:-width] > -back)
        sudden &= (reached[:-width] > LOSS_FROM * reached[-1]) & (drop > least)
        for i in np.flatnonzero(sudden).tolist():
            later = slice(i + width, min(i + width + 50, count))
            weak = load[later] < (1 - LOSS_OF_FORCE) * load[i]
            goes_on = bool(np.any(weak & (path[later] > path[i] + back)))
            ends = count - i - width <= 10 and bool(np.all(path[i + width :] > path[i] - back))
            if goes_on or ends:
                found.append((i, float(share[i])))
                break
    first = min(found, key=lambda one: one[0], default=None)
    return first if first is not None and first[0] >= 8 else None


def gives_way(curve: Curve, control: Control | None) -> np.ndarray:
    """Which readings come after the particle gave way or slipped, until its force is back; booleans."""
    # Force falls while the platens go on closing at about the speed they had. In unloading they separate or, of a stiff
    # particle that creeps, stand still.
    force, path, time = curve.force_mN, curve.displacement_um, curve.time_s
    found = np.zeros(len(curve), bool)
    if len(curve) < 12:
        return found
    back = _way_back(path)
    for segment in find_segments(curve, control=control):
        start, last = segment.start, segment.stop - 1
        if segment.kind != "unload" or start == 0 or found[start] or last == start:
            continue
        risen = np.flatnonzero(force[: start + 1] <= 0.5 * force[start])
        before = int(risen[-1]) if len(risen) else 0
        way, gone = path[last] - path[start], path[start] - path[before]
        # Both speeds times both durations: a clock that stood still divides nothing.
        as_fast = way * (time[start] - time[before]) > GOES_ON * gone * (time[last] - time[start])
        if gone > 0 and way > back and as_fast and float(np.min(path[start : last + 1])) > path[start] - back:
            again = np.flatnonzero(force[last:] >= force[start])
            found[start + 1 : last + int(again[0]) if len(again) else len(curve)] = True
    return found


def _way_back(path: np.ndarray) -> float:
    """How far displacement must move to have moved at all [um], never nil."""
    return max(4 * point_noise(path), 1e-3 * float(np.ptp(path)), 1e-303)
