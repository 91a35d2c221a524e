"""What the tester did, point by point: force, time, branch, cycle, rates. Pieces of a test, not noisy differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .. import arguments
from .._errors import InputError
from .._types import Scalar, ScalarLike, Values, scalar
from ..campaign import Campaign, Curve, Segment, campaign_segments, check_campaign

KINDS = ("approach", "load", "hold", "unload", "reload")
APPROACH, LOAD, HOLD, UNLOAD, RELOAD = range(5)
HUMIDITY_COLUMN = "relative_humidity_percent"
REFERENCE_HUMIDITY_PERCENT = 45.0
"""Relative humidity of a test that names none; there no effect of humidity acts."""

Codes = Int[Array, "..."]


class Record(eqx.Module):
    """One test as an effect sees it; the same class holds one point of it (scalars) and many tests (a leading axis).

    Real forces are noisy. So everything that follows from differences of force stands here as data, found by the
    segmentation of a campaign (`record_of`) or, for a clean path, by its turning points (`clean_record`). A point that
    repeats the one before, time included, changes nothing: padding is harmless.

    Attributes:
        force: force [mN].
        time: time since the first point [s], never decreasing.
        kind: 0 approach, 1 load beyond any force before, 2 hold, 3 unload, 4 reload.
        branch: 1, 3 or 4, the direction of the latest ramp; a hold belongs to the ramp before it.
        reloads: reloads begun so far.
        progress: how much of the earlier reloads was completed, in reloads; the present one counts from here on.
        unload_from: force at which the latest unloading began [mN].
        reload_from: force at which the latest reloading began [mN].
        rate: magnitude of the latest ramp's force rate [mN/s]; 0 while unknown.
        loading_rate: the same of the latest loading or reloading ramp [mN/s].
        relative_humidity: relative humidity of the room [%], one number per test.
    """

    force: Values
    time: Values
    kind: Codes
    branch: Codes
    reloads: Codes
    progress: Values
    unload_from: Values
    reload_from: Values
    rate: Values
    loading_rate: Values
    relative_humidity: Values

    @property
    def at_points(self) -> Record:
        """The record with its one humidity repeated at every point, for `scan`."""
        return eqx.tree_at(
            lambda r: r.relative_humidity, self, jnp.broadcast_to(self.relative_humidity, self.time.shape)
        )


def reload_progress(force: Values, reload_from: Values, peak_force: Values) -> Values:
    """Share of the way from the force where reloading began to the peak force, 0 to 1."""
    way = peak_force - reload_from
    some = way > 1e-6 * peak_force
    share = (force - reload_from) / jnp.where(some, way, 1.0)
    return jnp.where(some & (share < 1), jnp.where(share > 0, share, 0.0), 1.0)


def first_point(dtype: jnp.dtype, relative_humidity: Scalar | None = None) -> Record:
    """A test that has not begun: no force, no time."""
    zero, none = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    humidity = jnp.asarray(REFERENCE_HUMIDITY_PERCENT, dtype) if relative_humidity is None else relative_humidity
    return Record(zero, zero, none + LOAD, none + LOAD, none, zero, zero, zero, zero, zero, humidity)


def follow(before: Record, peak_force: Scalar, force: Scalar, time: Scalar) -> Record:
    """The next point of a clean path, from the point before, the largest force up to it, and what comes now."""
    change, elapsed = force - before.force, time - before.time
    moves = jnp.abs(change) > 8 * jnp.finfo(force.dtype).eps * jnp.maximum(peak_force, jnp.abs(force))
    rises, falls = moves & (change > 0), moves & (change < 0)
    was_unloading = before.branch == UNLOAD
    ramp = jnp.where(force > peak_force, LOAD, jnp.where(before.branch == LOAD, LOAD, RELOAD))
    branch = jnp.where(falls, UNLOAD, jnp.where(rises, ramp, before.branch)).astype(jnp.int32)
    reloading = rises & was_unloading
    finished = jnp.where(
        before.reloads > 0, reload_progress(before.unload_from, before.reload_from, peak_force), jnp.zeros_like(force)
    )
    timed = moves & (elapsed > 0)
    rate = jnp.where(timed, jnp.abs(change) / jnp.where(timed, elapsed, 1.0), before.rate)
    return Record(
        force=force,
        time=time,
        kind=jnp.where(moves, branch, HOLD).astype(jnp.int32),
        branch=branch,
        reloads=before.reloads + reloading.astype(jnp.int32),
        progress=before.progress + jnp.where(reloading, finished, 0.0),
        unload_from=jnp.where(falls & ~was_unloading, before.force, before.unload_from),
        reload_from=jnp.where(reloading, before.force, before.reload_from),
        rate=rate,
        loading_rate=jnp.where(timed & rises, rate, before.loading_rate),
        relative_humidity=before.relative_humidity,
    )


def clean_record(
    force: Any,
    time: Any,
    *,
    relative_humidity: ScalarLike | None = None,
    before: Record | None = None,
    peak_force: Scalar | None = None,
) -> Record:
    """The record of a path without noise; every change of direction is a turning point.

    Args:
        force: forces [mN].
        time: times [s], never decreasing.
        relative_humidity: [%]; the reference if None.
        before: the point before the first, if the path continues another.
        peak_force: the largest force up to then [mN].
    """
    force, time = arguments.path(force, "force"), arguments.path(time, "time")
    arguments.same_length(force=force, time=time)
    if relative_humidity is not None:
        relative_humidity = scalar(relative_humidity)
    start = first_point(force.dtype, relative_humidity) if before is None else before
    if before is None:
        start = eqx.tree_at(lambda r: r.time, start, time[0])
    highest = jnp.zeros_like(force[0]) if peak_force is None else peak_force

    def one(carry, now):
        point, peak = carry
        point = follow(point, peak, *now)
        return (point, jnp.maximum(peak, point.force)), point

    _, points = jax.lax.scan(one, (start, highest), (force, time))
    # The tester's programme is data: derivatives by force act through the law, not through where the branches begin.
    points = eqx.tree_at(lambda r: (r.force, r.time), jax.lax.stop_gradient(points), (force, time))
    return eqx.tree_at(lambda r: r.relative_humidity, points, start.relative_humidity)


def record_of(curve: Curve, segments: tuple[Segment, ...], *, relative_humidity_percent: float | None = None) -> Record:
    """The record of a measured test.

    Rates are the slopes of straight lines through whole segments. The forces where branches begin come from straight
    lines through their first points.

    Args:
        curve: the test, raw.
        segments: its segments, from `mcc_jax.campaign.find_segments` or `campaign_segments`.
        relative_humidity_percent: of the room during the test; the reference, where no effect of humidity acts, if
            None.

    Raises:
        ValueError: if the segments do not cover the curve.
    """
    arguments.instance(curve, Curve, "curve", "Make one with mcc_jax.Curve(time_s, force_mN, displacement_um).")
    if relative_humidity_percent is not None:
        arguments.number(relative_humidity_percent, "relative_humidity_percent", least=0, most=100)
    count = len(curve)
    if not segments or segments[0].start != 0 or segments[-1].stop != count:
        raise InputError(f"the segments must cover all {count} points of the curve")
    force = np.asarray(curve.force_mN, float)
    time = np.asarray(curve.time_s, float) - float(curve.time_s[0])
    columns: dict[str, np.ndarray] = {
        name: np.zeros(count, np.int32 if name in ("kind", "branch", "reloads") else float)
        for name in ("kind", "branch", "reloads", "progress", "unload_from", "reload_from", "rate", "loading_rate")
    }
    branch, reloads, progress, unload_from, reload_from, rate, loading_rate = LOAD, 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for segment in segments:
        kind = KINDS.index(segment.kind)
        part = slice(segment.start, segment.stop)
        if kind not in (HOLD, APPROACH):
            begins = _first_value(time[part], force[part])
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
            rate = _slope(time[part], force[part], rate)
            loading_rate = loading_rate if branch == UNLOAD else rate
        values = (kind, branch, reloads, progress, unload_from, reload_from, rate, loading_rate)
        for column, value in zip(columns.values(), values, strict=True):
            column[part] = value
    # What comes before the first ramp goes at its rate.
    known = np.flatnonzero(columns["loading_rate"] > 0)
    if len(known):
        columns["loading_rate"][: known[0]] = columns["loading_rate"][known[0]]
        columns["rate"][: known[0]] = columns["loading_rate"][known[0]]
    humidity = REFERENCE_HUMIDITY_PERCENT if relative_humidity_percent is None else float(relative_humidity_percent)
    return Record(
        jnp.asarray(force),
        jnp.asarray(time),
        **{name: jnp.asarray(values) for name, values in columns.items()},
        relative_humidity=jnp.asarray(humidity, dtype=float),
    )


def record_batch(
    campaign: Campaign, segments: tuple[tuple[Segment, ...], ...] | None = None, *, multiple: int = 1
) -> Record:
    """The records of all tests of a campaign with a leading axis N, shorter ones padded with their last point.

    Args:
        campaign: the tests.
        segments: the segments of each; found anew if None.
        multiple: round the length up to a multiple of this, as in `mcc_jax.campaign.batch`.

    Raises:
        InputError: if the campaign cannot be used, or the column of humidities holds what is no number.
    """
    check_campaign(campaign)
    multiple = arguments.whole(multiple, "multiple", least=1)
    found = campaign_segments(campaign) if segments is None else segments
    humidity = humidities(campaign)
    records = [
        record_of(curve, parts, relative_humidity_percent=None if humidity is None else float(humidity[i]))
        for i, (curve, parts) in enumerate(zip(campaign.curves, found, strict=True))
    ]
    longest = max(len(curve) for curve in campaign.curves)
    longest += -longest % multiple

    def together(*leaves: Array) -> Array:
        rows = [np.asarray(leaf) for leaf in leaves]
        return jnp.asarray(np.stack([np.pad(r, (0, longest - len(r)), mode="edge") if r.ndim else r for r in rows]))

    return jax.tree.map(together, *records)


def humidities(campaign: Campaign) -> Float[np.ndarray, " particles"] | None:
    """Relative humidity [%] of every test from the column `relative_humidity_percent`; None without that column.

    Raises:
        InputError: naming the particle whose entry is no number from 0 to 100.
    """
    check_campaign(campaign)
    return humidity_column(campaign.particles, campaign.columns, campaign.source)


def humidity_column(
    particles: Sequence[str], columns: Mapping[str, Sequence[str]], source: str = ""
) -> Float[np.ndarray, " particles"] | None:
    """The same from a table of particles alone; see `humidities`."""
    texts = columns.get(HUMIDITY_COLUMN)
    if texts is None:
        return None
    values = np.empty(len(texts))
    for i, text in enumerate(texts):
        try:
            values[i] = float(text)
        except ValueError:
            values[i] = np.nan
        if not 0 <= values[i] <= 100:
            raise InputError(
                f"the relative humidity of particle {particles[i]!r} is {text!r}",
                file=source or None,
                column=HUMIDITY_COLUMN,
                remedy="Write a number from 0 to 100, in percent",
            )
    return values


def _first_value(time: np.ndarray, force: np.ndarray) -> float:
    n = min(len(force), 9)
    if n < 3 or np.ptp(time[:n]) <= 0:
        return float(force[0])
    slope, level = np.polyfit(time[:n] - time[0], force[:n], 1)
    del slope
    return float(level)


def _slope(time: np.ndarray, force: np.ndarray, before: float) -> float:
    """Magnitude of the slope of a straight line; what it was before, if the segment has no duration."""
    if len(time) < 2 or np.ptp(time) <= 0:
        return before
    centred = time - time.mean()
    return float(abs(centred @ force) / (centred @ centred))
