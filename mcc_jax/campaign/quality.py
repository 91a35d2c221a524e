"""What the tester did in each test: told in words, and modelled where the record allows.

`check_tests` goes over every test in this order. Each step sees what the steps before it left.

1. single readings far from all their neighbours (spikes) are left out;
2. readings that repeat while the test goes on, and then catch up in one jump (a stuck channel), are left out;
3. a sudden loss of force (the particle broke) ends the record;
4. the mean force in the air before contact is the zero of force: it is taken off, its error is kept;
5. readings at the end of a channel's range are not compared with the law (`saturation`).

A test in which nothing is found stays what it is, to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from .._format import described
from .findings import Finding
from .plausibility import wrong_signs
from .saturation import SaturationOptions, censor_displacement, censor_force
from .schema import Campaign, Checked, Control, Curve, Note
from .segments import find_segments
from .signal import differences, median, point_noise, quantile, runs, two_lines
from .validate import check_campaign


@dataclass(frozen=True)
class QualityOptions:
    """What counts as a fault of the tester. Each number is chosen so that no honest record can reach it.

    Attributes:
        spike_noise: a reading is a spike from so many standard deviations of the noise on. Of 1e6 normal readings the
            farthest lies at 5; the rest is for noise that is not normal.
        spike_steps: and from so many times the step between neighbouring readings on: a turning point of a ramp lies
            within 3 steps of the median of the seven readings around it, and every half of a cycle has some readings.
        spike_read_out: and from so many of the smallest steps of the read-out on.
        spike_range: and from this share of the channel's range (5 to 95 %) on.
        stuck_readings: readings that repeat, at least; also three times as many as the channel repeats elsewhere, which
            is what a coarse read-out does.
        stuck_catch_up: share of the ramp's progress in that time which the jump behind them makes up for, at least.
        begins_at: a record begins at its largest force if its first readings reach this share of it.
        stuck_jump: and this jump is so many times larger than any step near it, at least: a coarse read-out jumps by
            one step at a time.
        loss_of_force: share of the largest force that a breaking particle loses, at least. Settling and rotation of
            ceramic pebbles lose up to a tenth at once.
        loss_readings: within so many readings, at most.
        loss_pace: and so many times faster than the force changes elsewhere, at least.
        loss_from: and from this share of the largest force on: below it, the platens bounce on asperities.
        loss_noise: and so many standard deviations of the noise, at least.
        air_readings: readings in the air, at least: fewer do not give the zero's error.
        air_said: an offset is told from so many standard deviations on,
        air_share: and from this share of the largest force on: below it no answer moves by a tenth of its error.
        drift_said: a drift in the air is told from so many standard deviations of its slope on, and from `air_share`.
        drift_slower: a straight rise in front of the loading is a drift if its slope is this share of the loading's, at
            most, as is any straight fall; the first contact of asperities is not straight.
        drift_like: up to this share it may be one, and is told.
        other_stiffness: if force over displacement is not another one there, by this factor, only the tester's speed
            was.
        start_share: of the largest force, in front of which such a rise is looked for: farther on loading itself bends.
        saturation: when a channel counts as saturated.
    """

    spike_noise: float = 15.0
    spike_steps: float = 5.0
    spike_read_out: float = 2.5
    spike_range: float = 0.02
    stuck_readings: int = 6
    stuck_catch_up: float = 0.5
    stuck_jump: float = 2.5
    begins_at: float = 0.95
    loss_of_force: float = 0.25
    loss_readings: int = 3
    loss_pace: float = 5.0
    loss_from: float = 0.05
    loss_noise: float = 10.0
    air_readings: int = 5
    air_said: float = 3.0
    air_share: float = 1e-3
    drift_said: float = 5.0
    drift_slower: float = 0.1
    drift_like: float = 0.7
    other_stiffness: float = 1.5
    start_share: float = 0.1
    saturation: SaturationOptions = field(default_factory=SaturationOptions)

    __repr__ = described()


def check_tests(campaign: Campaign, options: QualityOptions | None = None) -> Campaign:
    """The campaign with what its testers did found, corrected where the record allows, and told.

    Args:
        campaign: raw tests. One that was checked already comes back as it is.
        options: what counts as a fault.

    Returns:
        A campaign whose curves hold the readings that count, with the zero of force taken off; `raw` is the campaign
        that was given, and `campaign_findings` says what was found.

    Raises:
        InputError: if names, shapes or values of a campaign made in memory are unfit.
    """
    check_campaign(campaign)
    if campaign.raw is not None:
        return campaign
    options = options or QualityOptions()
    if wrong_signs(campaign):
        return replace(campaign, raw=campaign)  # what looks like air or breakage is the test read backwards
    control = campaign.metadata.control
    curves = tuple(check_test(curve, control, options) for curve in campaign.curves)
    return replace(campaign, curves=curves, raw=campaign)


def check_test(curve: Curve, control: Control | None, options: QualityOptions) -> Curve:
    """One test, checked; see the top of the file for the steps."""
    notes: list[Note] = []
    rows = np.arange(len(curve))
    for channel, name in ((curve.force_mN, "force"), (curve.displacement_um, "displacement")):
        far = spikes(channel[rows], options)
        if far.any():
            notes.append(_spike_note(name, int(far.sum())))
            rows = rows[~far]
    for channel, name in ((curve.force_mN, "force"), (curve.displacement_um, "displacement")):
        repeated = stuck(channel[rows], options)
        if repeated.any():
            notes.append(_stuck_note(name, int(repeated.sum())))
            rows = rows[~repeated]
    clean = _taken(curve, rows)
    if begins_at_peak(clean, options):
        notes.append(_begins_note(float(clean.force_mN[0])))
    broke = breakage(clean, options)
    if broke is not None:
        last, lost = broke
        notes.append(_breakage_note(float(curve.force_mN[rows[last]]), lost))
        rows = rows[: last + 1]
    clean = _taken(curve, rows)
    zero = zero_of_force(clean, control, options)
    if zero is not None:
        notes += zero.notes
        clean = replace(clean, force_mN=clean.force_mN - zero.path)
    seen = censor_force(clean, options.saturation)
    compared = np.ones(len(clean), bool)
    force_sd = np.zeros(len(clean))
    if seen is not None:
        clean, rows, compared, force_sd = seen.curve, rows[seen.rows], seen.compared, seen.force_sd_mN
        notes.append(seen.note)
    hidden = censor_displacement(clean, options.saturation)
    if hidden is not None:
        compared &= ~hidden.rows
        notes.append(hidden.note)
    if not notes and zero is None:
        return curve
    taken_off, error = (0.0, 0.0) if zero is None else (zero.value, zero.sd)
    return replace(clean, checked=Checked(rows, compared, taken_off, error, force_sd, tuple(notes)))


def _taken(curve: Curve, rows: np.ndarray) -> Curve:
    if len(rows) == len(curve):
        return curve
    return Curve(curve.time_s[rows], curve.force_mN[rows], curve.displacement_um[rows])


# ---- single steps ----------------------------------------------------------------------------------------------------


def spikes(values: np.ndarray, options: QualityOptions) -> np.ndarray:
    """Which readings, one or two at a time, lie far from the median of the seven around them; booleans."""
    count = len(values)
    if count < 12:
        return np.zeros(count, bool)
    around = np.lib.stride_tricks.sliding_window_view(_edged(values, 3, 3), 7)
    middle = np.partition(around, 3, axis=1)[:, 3]
    low, high = quantile(values, 0.05), quantile(values, 0.95)
    moves = np.abs(differences(values))
    step = median(moves)
    # The pace nearby, but not so near that the reading itself shifts the median.
    pace = _edged(np.abs(differences(middle)), 10, 11)
    windows = np.lib.stride_tricks.sliding_window_view(pace, 21)[:count]
    local = np.maximum(windows[:, :6].max(axis=1), windows[:, 15:].max(axis=1))
    least = max(options.spike_noise * point_noise(values), options.spike_range * (high - low))
    least = np.maximum(least, options.spike_steps * np.maximum(step, local))
    far = np.abs(values - middle) > np.maximum(least, 1e-300)
    far[[0, 1, -2, -1]] = False  # at the ends the median of the neighbours is no middle
    if moves.any():  # one step of a coarse read-out is none
        far &= np.abs(values - middle) > options.spike_read_out * float(moves[moves > 0].min())
    if not far.any():
        return far
    # Three or more in a row are no slip of the read-out but something that happened.
    edges = np.flatnonzero(np.diff(np.concatenate([[0], far.astype(int), [0]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start > 2:
            far[start:stop] = False
    return far


def _edged(values: np.ndarray, before: int, behind: int) -> np.ndarray:
    """Numbers with their first and last one repeated."""
    return np.concatenate((np.full(before, values[0]), values, np.full(behind, values[-1])))


def stuck(values: np.ndarray, options: QualityOptions) -> np.ndarray:
    """Which readings only repeat the one before, and are made up for by a jump behind them; booleans."""
    found = np.zeros(len(values), bool)
    starts, stops = runs(values)
    lengths = stops - starts
    least = max(options.stuck_readings, 3 * quantile(lengths, 0.9))
    if len(lengths) < 8 or lengths.max() < least:
        return found
    steps = np.abs(differences(values))
    typical = median(steps[steps > 0])
    long = lengths >= least
    for start, stop in zip(starts[long].tolist(), stops[long].tolist(), strict=True):
        if start == 0 or stop >= len(values):
            continue
        before, after = steps[max(start - 20, 0) : start - 1], steps[stop : stop + 20]
        near = np.concatenate([before, after])
        if not len(near):
            continue
        pace = median(near)
        jump = steps[stop - 1]
        if jump > options.stuck_catch_up * (stop - start) * pace and jump > options.stuck_jump * max(
            typical, float(np.max(near))
        ):
            found[start + 1 : stop] = True
    return found


def begins_at_peak(curve: Curve, options: QualityOptions) -> bool:
    """Whether a record has lost its loading: it begins at its largest force and unloads."""
    force = curve.force_mN
    largest, first = float(force.max()), median(force[:3])
    # One that ends there as well never unloads; one with the sign of its force reversed has no largest force.
    return first > 0.5 * float(-force.min()) and first >= options.begins_at * largest > 2 * median(force[-3:])


def breakage(curve: Curve, options: QualityOptions) -> tuple[int, float] | None:
    """The last reading before the particle broke, and the share of its force that it lost at once; None if it held.

    A particle that breaks loses force while the platens do not part: the force falls within a few readings, much faster
    than elsewhere, and at the same or a larger displacement it does not come back at once. A jump of displacement under
    load control is no sign of it: a law that is not monotone snaps through, and many particles pop in.
    """
    force, path, time = curve.force_mN, curve.displacement_um, curve.time_s
    count = len(force)
    if count < 12:
        return None
    base = float(np.min(force))
    reached = np.maximum.accumulate(force - base)
    noise = point_noise(path)
    travel = max(float(np.ptp(path)), 1e-300)
    back = max(4 * noise, 1e-3 * travel)
    steps = np.abs(differences(force))
    interval = differences(time)
    moving = steps > 0.05 * max(median(steps), 1e-300)
    pace = median(steps[moving] / np.maximum(interval[moving], 1e-300)) if moving.any() else 0.0
    least = options.loss_noise * point_noise(force)
    first: tuple[int, float] | None = None
    for width in range(1, options.loss_readings + 1):
        drop = force[:-width] - force[width:]
        with np.errstate(over="ignore"):  # at the first readings, which are not judged
            share = drop / np.maximum(reached[:-width], 1e-300)
        fast = drop > options.loss_pace * pace * (time[width:] - time[:-width])
        sudden = (share > options.loss_of_force) & fast & (path[width:] - path[:-width] > -back)
        sudden &= (reached[:-width] > options.loss_from * reached[-1]) & (drop > least)
        for i in np.flatnonzero(sudden):
            if first is not None and i >= first[0]:
                break
            later = slice(i + width, min(i + width + 50, count))
            weak = force[later] - base < (1 - options.loss_of_force) * (force[i] - base)
            goes_on = bool(np.any(weak & (path[later] > path[i] + back)))
            ends = count - i - width <= 10 and bool(np.all(path[i + width :] > path[i] - back))
            if goes_on or ends:
                first = int(i), float(share[i])
                break
    if first is None or first[0] < 8:
        return None
    return first


@dataclass(frozen=True)
class ZeroOfForce:
    """What the force channel reads without contact.

    Attributes:
        path: what to take off at each reading [mN]; constant from contact on.
        value: the zero at contact [mN].
        sd: its standard deviation [mN].
        notes: what there is to say of it.
    """

    path: np.ndarray
    value: float
    sd: float
    notes: tuple[Note, ...] = ()


def zero_of_force(curve: Curve, control: Control | None, options: QualityOptions) -> ZeroOfForce | None:
    """The force that is read in the air before contact; None if there are no such readings.

    Without a drift it is the readings' mean, with the error of a mean of readings that hang together (as of an
    autoregressive process of order 1). With a drift it is their straight line over time up to contact, and the line's
    value there from then on; what the drift did during the test nobody knows, so its change in the air is the error.
    """
    contact, ahead = air_until(curve, control, options)
    if contact is None:
        return _perhaps_drift(curve, ahead, options)
    # The last readings before the platens touch may already feel the first asperities.
    stop = max(options.air_readings, int(0.9 * contact))
    air, when = curve.force_mN[:stop], curve.time_s[:stop]
    mean, sd = float(np.mean(air)), float(np.std(air, ddof=1))
    largest = max(float(np.max(curve.force_mN) - mean), 1e-300)
    flat = np.full(len(curve), mean)
    centred = when - when.mean()
    spread = float(np.sum(centred**2))
    if not (sd > 0 and spread > 0):
        return ZeroOfForce(flat, mean, 0.0, _offset_notes(mean, 0.0, largest, options))
    slope = float(np.sum(centred * air) / spread)
    left = air - mean - slope * centred
    slope_sd = float(np.std(left, ddof=2) / np.sqrt(spread)) * _inflation(left)
    change = slope * float(when[-1] - when[0])
    if abs(slope) > options.drift_said * slope_sd and abs(change) > options.air_share * largest:
        at = np.minimum(curve.time_s, curve.time_s[contact - 1]) - when.mean()
        path = mean + slope * at
        error = float(np.hypot(np.std(left, ddof=2) / np.sqrt(len(air)), abs(change) / np.sqrt(12)))
        note = Note(
            "zero of force",
            "look",
            "force drifts by {} mN in the air before contact; the zero at contact ({} mN) was taken off, with this "
            "drift as its error",
            (abs(change), float(path[-1])),
            "Let the load cell settle before a test",
        )
        return ZeroOfForce(path, float(path[-1]), error, (note,))
    error = sd / np.sqrt(len(air)) * _inflation(air - mean)
    return ZeroOfForce(flat, mean, float(error), _offset_notes(mean, error, largest, options))


def _perhaps_drift(curve: Curve, ahead: SlowStart | None, options: QualityOptions) -> ZeroOfForce | None:
    """A rise in front of the loading which is too quick to be taken for a drift, and too straight for a contact."""
    if ahead is None or abs(ahead.change) <= options.air_share * float(np.ptp(curve.force_mN)):
        return None
    note = Note(
        "zero of force",
        "look",
        "force goes straight by {} mN in front of the loading; it is counted as contact, but would be a drift of the "
        "load cell if the platens did not touch yet",
        (ahead.change,),
        "Cut these readings off if the platens did not touch yet, and let the load cell settle before a test",
    )
    return ZeroOfForce(np.zeros(len(curve)), 0.0, 0.0, (note,))


def _inflation(scatter: np.ndarray) -> float:
    """How much larger the error of a mean is since readings hang together, by their lag-1 correlation."""
    lag = float(np.sum(scatter[1:] * scatter[:-1]) / max(np.sum(scatter**2), 1e-300))
    lag = min(max(lag, 0.0), 0.9)
    return float(np.sqrt((1 + lag) / (1 - lag)))


def _offset_notes(zero: float, error: float, largest: float, options: QualityOptions) -> tuple[Note, ...]:
    if abs(zero) <= options.air_said * error or abs(zero) <= options.air_share * largest:
        return ()
    return (Note("zero of force", "told", "force reads {} mN in the air before contact; this was taken off", (zero,)),)


def air_until(curve: Curve, control: Control | None, options: QualityOptions) -> tuple[int | None, SlowStart | None]:
    """How many readings were taken before contact; None if too few, and then the slow start, if there is one.

    The approach of `find_segments`; where it finds none, a straight and much slower rise in front of the loading is a
    drift of the load cell, and the approach is looked for again without it.
    """

    def found(curve: Curve) -> int | None:
        segments = find_segments(curve, control=control)
        first = segments[0]
        enough = first.kind == "approach" and len(segments) > 1 and len(first) > options.air_readings
        return first.stop if enough else None

    contact = found(curve)
    if contact is not None:
        return contact, None
    ahead = slow_start(curve, options)
    if ahead is None or ahead.share > options.drift_slower:
        return None, ahead
    time = np.minimum(curve.time_s, curve.time_s[ahead.stop - 1])
    return found(replace(curve, force_mN=curve.force_mN - ahead.line(time))), ahead


@dataclass(frozen=True)
class SlowStart:
    """A straight course of force over time in front of the loading.

    Attributes:
        line: the force over time [mN].
        stop: how many readings it has.
        change: of force along it [mN].
        share: its slope as a share of the loading's; negative where it falls.
    """

    line: np.polynomial.Polynomial
    stop: int
    change: float
    share: float


def slow_start(curve: Curve, options: QualityOptions) -> SlowStart | None:
    """A straight and slower course of force in front of the loading, of a load cell that drifts; None without one.

    A slower speed of the tester alone bends force and displacement alike: it is none.
    """
    force, time, path = curve.force_mN, curve.time_s, curve.displacement_um
    first = int(np.argmax(force > force[0] + options.start_share * (force.max() - force[0])))
    if first < 2 * options.air_readings + 4:
        return None
    kink = two_lines(time[: first + 1], force[: first + 1])
    if kink <= options.air_readings or kink > first - 3:
        return None
    ahead, behind = slice(kink), slice(kink, first + 1)
    if not (time[kink - 1] > time[0] and time[first] > time[kink]):
        return None
    clocks = [time[rows] - time[rows].mean() for rows in (ahead, behind)]
    spreads = [max(float(clock @ clock), 1e-300) for clock in clocks]
    slow, fast = (
        float(clock @ force[rows]) / s for clock, rows, s in zip(clocks, (ahead, behind), spreads, strict=True)
    )
    way, on = (float(clock @ path[rows]) / s for clock, rows, s in zip(clocks, (ahead, behind), spreads, strict=True))
    bends = fast - slow > options.drift_said * point_noise(force) * np.hypot(*(1 / np.sqrt(spreads)))
    share, pace = slow / max(fast, 1e-300), way / max(on, 1e-300)
    if not bends or share > options.drift_like:
        return None
    if pace > 0 and share > 0 and 1 / options.other_stiffness < share / pace < options.other_stiffness:
        return None
    line = np.polynomial.Polynomial.fit(time[ahead], force[ahead], 1)
    if np.std(force[ahead] - line(time[ahead])) > 2 * point_noise(force[ahead]) + 1e-12 * float(np.ptp(force)):
        return None
    return SlowStart(line, kink, float(line(time[kink - 1]) - line(time[0])), share)


# ---- words -----------------------------------------------------------------------------------------------------------


def _spike_note(name: str, count: int) -> Note:
    return Note(
        "spikes", "told", f"single readings of {name} ({{}}) lie far from their neighbours and are left out", (count,)
    )


def _stuck_note(name: str, count: int) -> Note:
    sentence = f"{{}} readings of {name} repeat the one before while the test goes on, and are left out"
    return Note("stuck readings", "told", sentence, (count,), "Look for a loose cable or a full buffer of the logger")


def _begins_note(force_mN: float) -> Note:
    return Note(
        "loading",
        "look",
        "the record begins at its largest force ({} mN), so its loading is missing",
        (force_mN,),
        "Join the loading part of the test to it: some testers store the two apart",
    )


def _breakage_note(force_mN: float, share: float) -> Note:
    return Note(
        "breakage",
        "look",
        "the particle broke at {} mN (the force falls by {} % at once); its record counts up to there",
        (force_mN, 100 * share),
        "Load particles of this batch less, or leave this one out",
    )


def campaign_findings(campaign: Campaign) -> tuple[Finding, ...]:
    """What the checks of a campaign found, one finding for all tests with the same fault.

    Args:
        campaign: what `check_tests` made.
    """
    check_campaign(campaign)
    groups: dict[tuple[str, str, str, str], list[tuple[str, tuple[float | int, ...]]]] = {}
    for name, curve in zip(campaign.particles, campaign.curves, strict=True):
        for note in curve.checked.notes if curve.checked is not None else ():
            key = note.check, note.level, note.sentence, note.remedy
            groups.setdefault(key, []).append((name, note.numbers))
    found = []
    for (check, level, sentence, remedy), members in groups.items():
        names = tuple(name for name, _ in members)
        texts = [_range(column) for column in zip(*(numbers for _, numbers in members), strict=True)]
        text = f"{named(names, len(campaign))}: {sentence.format(*texts)}"
        found.append(Finding(check, level, text, remedy, names))  # pyright: ignore[reportArgumentType]
    return tuple(found)


def named(names: tuple[str, ...], of: int, most: int = 5) -> str:
    """Particles by their names, as the beginning of a sentence; of many the first ones and how many there are."""
    if len(names) == 1:
        return f"Particle {names[0]}"
    shown = ", ".join(names[:most])
    return f"Particles {shown}" if len(names) <= most else f"Particles {shown}, ... ({len(names)} of {of})"


def _range(values: tuple[float | int, ...]) -> str:
    low, high = f"{min(values):.4g}", f"{max(values):.4g}"
    return low if low == high else f"{low} to {high}"
