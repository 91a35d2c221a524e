"""What the instrument did, point by point: force, time, branch, cycle, rates, from segments of a test."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .. import arguments
from .._format import described
from .._types import Scalar, ScalarLike, Values, scalar

KINDS = ("approach", "load", "hold", "unload", "reload")
APPROACH, LOAD, HOLD, UNLOAD, RELOAD = range(5)
HUMIDITY_COLUMN = "relative_humidity_percent"
REFERENCE_HUMIDITY_PERCENT = 45.0
"""Relative humidity of a test that names none; there no effect of humidity acts."""

Codes = Int[Array, "..."]


class Record(eqx.Module):
    """One test as an effect sees it; the same class holds one point of it (scalars) and many tests (a leading axis).

    Real forces are noisy. So everything that follows from differences of force is data here, found by the
    segmentation of a campaign (`mcc_jax.campaign.record_of`) or, for a clean path, by its turning points
    (`clean_record`). A point that repeats the one before, time included, changes nothing: padding is harmless.

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
        peak: force from which the branch of each point starts [mN], on virgin loading its own force, where a measured
            record shows it better than its largest reading does (`mcc_jax.campaign.turning_forces`); None for the
            largest force so far.
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
    peak: Values | None = None

    __repr__ = described(
        force="mN", time="s", unload_from="mN", reload_from="mN", rate="mN/s", loading_rate="mN/s",
        relative_humidity="%",
    )  # fmt: skip

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
    # The programme of the test is data: derivatives by force act through the law, not through where the branches begin.
    points = eqx.tree_at(lambda r: (r.force, r.time), jax.lax.stop_gradient(points), (force, time))
    return eqx.tree_at(lambda r: r.relative_humidity, points, start.relative_humidity)
