"""Measured tests as effects see them, and what a campaign holds of what effects need."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .. import arguments
from .._errors import InputError
from ..effects import HUMIDITY_COLUMN, REFERENCE_HUMIDITY_PERCENT, Need, Record
from ..effects.record import APPROACH, HOLD, KINDS, LOAD, UNLOAD
from .adjustment import campaign_segments
from .schema import Campaign, Curve
from .segments import BAND, Segment
from .signal import Line

JUMP = 1.3  # factor by which rates of force differ at least; less is what the control of test machines leaves
READINGS = 6  # of a ramp from which on changes of its speed are looked for: two lines that meet have four numbers
KINKS = 6  # of a ramp at most: a change between two readings makes two


def record_of(curve: Curve, segments: tuple[Segment, ...], *, relative_humidity_percent: float | None = None) -> Record:
    """The record of a measured test, cut by `find_segments`.

    Rates are the slopes of straight lines through segments (`ramp_rates`). The forces where branches begin come from
    straight lines through their first points. Without a humidity of the test it is the reference, which has no effect.
    """
    columns = record_columns(curve, segments, relative_humidity_percent=relative_humidity_percent)
    return Record(**{name: jnp.asarray(values) for name, values in columns.items()})


def record_columns(
    curve: Curve, segments: tuple[Segment, ...], *, relative_humidity_percent: float | None = None
) -> dict[str, np.ndarray]:
    """The record of a measured test as NumPy arrays by name, to be put together with others; see `record_of`."""
    humidity = REFERENCE_HUMIDITY_PERCENT
    if relative_humidity_percent is not None:
        humidity = arguments.number(relative_humidity_percent, "relative_humidity_percent", least=0, most=100)
    count = len(curve)
    if not segments or segments[0].start != 0 or segments[-1].stop != count:
        raise InputError(f"the segments must cover all {count} points of the curve")
    force = np.asarray(curve.force_mN, float)
    time = np.asarray(curve.time_s, float) - float(curve.time_s[0])
    names = ("kind", "branch", "reloads", "progress", "unload_from", "reload_from")
    states: list[tuple[float, ...]] = []
    rates, loading_rates = np.zeros(count), np.zeros(count)
    branch, reloads, progress, unload_from, reload_from, rate, loading_rate = LOAD, 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for segment in segments:
        kind = KINDS.index(segment.kind)
        part = slice(segment.start, segment.stop)
        if kind not in (HOLD, APPROACH):
            begins = float(force[part.start])
            first = slice(part.start, min(part.start + 9, part.stop))
            if part.stop - part.start >= 3 and np.ptp(time[first]) > 0:
                begins = float(Line.through(time[first], force[first]).at(time[part.start]))
            if kind == UNLOAD and branch != UNLOAD:
                unload_from = begins
            if kind != UNLOAD and branch == UNLOAD:
                if reloads:
                    peak = float(force[: segment.start].max())
                    way = peak - reload_from
                    done = (unload_from - reload_from) / way if way > 1e-6 * peak else 1.0
                    progress += min(max(done, 0.0), 1.0)
                reloads, reload_from = reloads + 1, max(begins, 0.0)
            branch = LOAD if branch == LOAD and kind != UNLOAD else kind
            rates[part], loading_rates[part] = ramp_rates(time[part], force[part], rate), loading_rate
            rate = float(rates[part.stop - 1]) if len(segment) else rate
            if branch != UNLOAD:
                loading_rates[part], loading_rate = rates[part], rate
        else:
            rates[part], loading_rates[part] = rate, loading_rate
        states.append((kind, branch, reloads, progress, unload_from, reload_from))
    # What comes before the first ramp goes at its rate.
    known = np.flatnonzero(loading_rates > 0)
    if len(known):
        rates[: known[0]] = loading_rates[: known[0]] = loading_rates[known[0]]
    lengths = [len(segment) for segment in segments]
    columns = {
        name: np.repeat(np.asarray(values, np.int32 if name in names[:3] else float), lengths)
        for name, values in zip(names, zip(*states, strict=True), strict=True)
    }
    columns |= {"rate": rates, "loading_rate": loading_rates}
    return {"force": force, "time": time, **columns, "relative_humidity": np.asarray(humidity, dtype=float)}


def humidities(campaign: Campaign) -> Float[np.ndarray, " particles"] | None:
    """Relative humidity [%] of every test; None without its column, `InputError` for an entry that is none."""
    return humidity_column(campaign.particles, campaign.columns, campaign.source)


def humidity_column(
    particles: Sequence[str], columns: Mapping[str, Sequence[str]], source: str = ""
) -> Float[np.ndarray, " particles"] | None:
    """The same from a table of particles alone; see `humidities`."""
    if HUMIDITY_COLUMN not in columns:
        return None
    values = []
    for name, text in zip(particles, columns[HUMIDITY_COLUMN], strict=True):
        try:
            values.append(float(text))
        except ValueError:
            values.append(math.nan)
        if not 0 <= values[-1] <= 100:
            problem = f"the relative humidity of particle {name!r} is {text!r}"
            remedy = "Write a number from 0 to 100, in percent"
            raise InputError(problem, file=source or None, column=HUMIDITY_COLUMN, remedy=remedy)
    return np.array(values)


def ramp_rates(time: Float[np.ndarray, " n"], force: Float[np.ndarray, " n"], before: float) -> Float[np.ndarray, " n"]:
    """Force rate at every reading of a ramp: of one straight line, or of several where the programme changes its speed.

    Changes of speed are kinks, believed where straight lines that meet describe the force better than one line and than
    any polynomial of as many numbers, by the Bayesian information criterion (Schwarz 1978; a kink counts as three
    numbers, Zhang and Siegmund 2007). A ramp without duration, and a piece that does not move, keep the rate `before`.
    """
    if len(time) < 2 or np.ptp(time) <= 0:
        return np.full(len(time), before)
    ends = [0, *_kinks(time, force), len(time) - 1]
    rates = np.empty(len(time))
    for first, last in itertools.pairwise(ends):
        piece = slice(first, last + 1)
        slope = abs(Line.through(time[piece], force[piece]).slope)
        # A hold too short to be a segment is a piece that does not move; it belongs to the ramp before it.
        if slope * (time[last] - time[first]) >= BAND * np.ptp(force):
            before = slope
        rates[first + (first > 0) : last + 1] = before
    return rates


def _kinks(time: np.ndarray, force: np.ndarray) -> list[int]:
    """The readings at which a ramp changes its speed, in order; see `ramp_rates`."""
    n = len(time)
    if n < READINGS:
        return []
    x, y = (2 * (v - v.mean()) / max(float(np.ptp(v)), 1e-300) for v in (time, force))

    def criterion(design: np.ndarray, numbers: int) -> float:
        rest = y - design @ np.linalg.lstsq(design, y)[0]
        # Not below rounding: a course without noise is described to the last digit.
        return n * np.log(max(float(rest @ rest), n * np.finfo(float).eps)) + numbers * np.log(n)

    def lines(kinks: list[int]) -> np.ndarray:
        return np.stack([np.ones(n), x, *(np.maximum(x - x[k], 0.0) for k in kinks)], 1)

    def of_lines(kinks: list[int]) -> float:
        return criterion(lines(kinks), 2 + 3 * len(kinks))

    kinks: list[int] = []
    best, found = of_lines([]), []
    for _ in range(min(KINKS, (n - 4) // 2)):
        ends = [0, *kinks, n - 1]
        gains = [_best_kink(x[i : j + 1], y[i : j + 1]) for i, j in itertools.pairwise(ends)]
        piece = int(np.argmax([gain for gain, _ in gains]))
        kinks = sorted([*kinks, ends[piece] + gains[piece][1]])
        value = of_lines(kinks)
        if value < best:
            best, found = value, kinks
        elif len(kinks) == 1:
            return []  # by far the most ramps
    # The first kinks were placed before the others were known: some are needed no more.
    while found:
        value, fewer = min((of_lines(fewer), fewer) for fewer in ([k for k in found if k != one] for one in found))
        if value > best:
            break
        best, found = value, fewer
    curves = np.polynomial.chebyshev.chebvander(x, min(1 + 2 * KINKS, n - 3))
    if not found or best >= min(criterion(curves[:, :k], k) for k in range(3, curves.shape[1] + 1)):
        return []
    slopes = np.cumsum(np.linalg.lstsq(lines(found), y)[0][1:])
    return found if _differ(np.abs(slopes).tolist(), JUMP) else []


def _best_kink(x: np.ndarray, y: np.ndarray) -> tuple[float, int]:
    """What a kink of the straight line through a piece gains of its residual square at most, and at which reading."""
    n = len(x)
    if n < 3 or not np.ptp(x) > 0:
        return 0.0, 0
    x, y = x - x.mean(), y - y.mean()
    rest = y - (x @ y) / (x @ x) * x

    def behind(values: np.ndarray) -> np.ndarray:
        return np.cumsum(values[::-1])[::-1][1:-1]

    # The hinge max(x - at, 0), for each reading `at`, less its part along the line: its square, its product with rest.
    at, count = x[1:-1], np.arange(n - 1, 1, -1)
    x1, x2 = behind(x), behind(x * x)
    square = (x2 - 2 * at * x1 + count * at**2) - (x1 - count * at) ** 2 / n - (x2 - at * x1) ** 2 / (x @ x)
    gain = (behind(rest * x) - at * behind(rest)) ** 2 / np.maximum(square, 1e-9 * (x @ x))
    kink = int(np.argmax(gain))
    return float(gain[kink]), kink + 1


def available_data(campaign: Campaign) -> frozenset[Need]:
    """What a campaign holds of what effects need.

    A kind of segment counts as present when at least one test in five has it; sizes and shapes when they differ by a
    tenth; peaks and rates when the largest is 1.3 times the smallest.
    """
    found = campaign_segments(campaign)
    D1, D2, D3 = campaign.diameters_um.T
    kinds = [[segment.kind for segment in parts] for parts in found]
    least = max(1.0, 0.2 * len(campaign))

    def often(kind: str, times: int = 1) -> bool:
        return sum(parts.count(kind) >= times for parts in kinds) >= least

    rates, peaks, durations, low = [], [], [], 0
    for curve, parts, diameter in zip(campaign.curves, found, D1 * D2 / D3, strict=True):
        record = record_columns(curve, parts)
        loading = np.isin(record["kind"], (1, 4))
        rates.extend(np.unique(record["loading_rate"][loading]).tolist())
        area = np.pi * diameter**2 / 4 * 1e-3
        ends = [part.start for part in parts if part.kind == "unload" and part.start]
        peaks += [float(curve.force_mN[:end].max() / area) for end in (None, *ends)]
        durations.append(float(curve.time_s[-1] - curve.time_s[0]))
        low += int(np.sum(curve.force_mN < 0.1 * curve.force_mN.max()) >= 5)
    humidity = humidities(campaign)
    conditions = {
        Need.LOW_LOAD: low >= least,
        Need.UNLOADING: often("unload"),
        Need.HOLD: often("hold"),
        Need.RELOAD: often("reload"),
        Need.SECOND_RELOAD: often("reload", 2),
        Need.LONG_TIME: float(np.median(durations)) > 200,
        Need.TWO_RATES: _differ(rates, JUMP),
        Need.SEVERAL_SIZES: _differ((D1 * D2 / D3).tolist(), 1.1),
        Need.SEVERAL_SHAPES: bool(np.ptp(1 - D3**2 / (D1 * D2)) > 0.1),
        Need.SEVERAL_PEAKS: _differ(peaks, 1.3),
        Need.HUMIDITY_COLUMN: humidity is not None and bool(np.ptp(humidity) > 1),
    }
    return frozenset(need for need, there in conditions.items() if there)


def _differ(values: list[float], ratio: float) -> bool:
    some = [value for value in values if value > 0]
    return bool(some and max(some) > ratio * min(some))
