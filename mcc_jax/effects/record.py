"""What an effect sees of a test: what the instrument did, point by point, and the state of the contact."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .. import arguments
from .._format import described
from .._types import Scalar, ScalarLike, Values, scalar
from ..formulas import PUNCH_AREA, Formulas, recovery
from ..geometry import Particle

KINDS = ("approach", "load", "hold", "unload", "reload")
APPROACH, LOAD, HOLD, UNLOAD, RELOAD = range(5)
HUMIDITY_COLUMN = "relative_humidity_percent"
REFERENCE_HUMIDITY_PERCENT = 45.0
"""Relative humidity of a test that names none; there no effect of humidity acts."""

Codes = Int[Array, "..."]
SMALL = 1e-8


def root(x: Values) -> Values:
    """Square root of x >= 0 with a finite slope at zero: sqrt(x + 1e-8) - sqrt(1e-8)."""
    return jnp.sqrt(x + SMALL) - SMALL**0.5


def positive(x: Values) -> Values:
    """`x` where it is above zero, else 0; no half derivative at zero."""
    return jnp.where(x > 0, x, 0.0)


def power(x: Values, exponent: Scalar) -> Values:
    """`x**exponent` where x is above zero, else 0, with finite derivatives by both."""
    some = x > jnp.finfo(x.dtype).tiny ** 0.5
    return jnp.where(some, jnp.exp(exponent * jnp.log(jnp.where(some, x, 1.0))), 0.0)


class Record(eqx.Module):
    """One test as an effect sees it, one point of it (scalars), or many tests (a leading axis).

    Real forces are noisy. So everything that follows from differences of force is data here, found by the segmentation
    of a campaign (`mcc_jax.campaign.record_of`) or, for a clean path, by its turning points (`clean_record`). A point
    that repeats the one before, time included, changes nothing: padding is harmless.

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
            record shows it better than its largest reading (`mcc_jax.campaign.turning_forces`); None: largest so far.
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


def reload_progress(force: Values, reload_from: Values, peak_force: Values) -> Values:
    """Share of the way from the force where reloading began to the peak force, 0 to 1."""
    way = peak_force - reload_from
    some = way > 1e-6 * peak_force
    share = (force - reload_from) / jnp.where(some, way, 1.0)
    return jnp.where(some & (share < 1), jnp.where(share > 0, share, 0.0), 1.0)


def first_point(dtype: jnp.dtype, humidity: Scalar | None = None, time: Scalar | None = None) -> Record:
    """A test that has not begun: no force; time zero and the reference humidity unless they are given."""
    zero, none = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    humidity = jnp.asarray(REFERENCE_HUMIDITY_PERCENT, dtype) if humidity is None else humidity
    time = zero if time is None else time
    return Record(zero, time, none + LOAD, none + LOAD, none, zero, zero, zero, zero, zero, humidity)


def follow(before: Record, peak_force: Scalar, force: Scalar, time: Scalar) -> Record:
    """The next point of a clean path, from the point before, the largest force up to it, and what comes now."""
    change, elapsed = force - before.force, time - before.time
    moves = jnp.abs(change) > 8 * jnp.finfo(force.dtype).eps * jnp.maximum(peak_force, jnp.abs(force))
    rises, falls = moves & (change > 0), moves & (change < 0)
    was_unloading = before.branch == UNLOAD
    ramp = jnp.where(force > peak_force, LOAD, jnp.where(before.branch == LOAD, LOAD, RELOAD))
    branch = jnp.where(falls, UNLOAD, jnp.where(rises, ramp, before.branch)).astype(jnp.int32)
    reloading = rises & was_unloading
    way = reload_progress(before.unload_from, before.reload_from, peak_force)
    finished = jnp.where(before.reloads > 0, way, jnp.zeros_like(force))
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
    """The record of a path without noise: forces [mN] over times [s] that never decrease; every turn is meant.

    A path may continue another: from the point `before` it, with the largest force up to then [mN].
    """
    force, time = arguments.path(force, "force"), arguments.path(time, "time")
    arguments.same_length(force=force, time=time)
    humidity = None if relative_humidity is None else scalar(relative_humidity)
    start = first_point(force.dtype, humidity, time[0]) if before is None else before
    highest = jnp.zeros_like(force[0]) if peak_force is None else peak_force

    def one(carry, now):
        point, peak = carry
        point = follow(point, peak, *now)
        return (point, jnp.maximum(peak, point.force)), point

    _, points = jax.lax.scan(one, (start, highest), (force, time))
    # The programme of the test is data: derivatives by force act through the law, not through where the branches begin.
    points = eqx.tree_at(lambda r: (r.force, r.time), jax.lax.stop_gradient(points), (force, time))
    return eqx.tree_at(lambda r: r.relative_humidity, points, start.relative_humidity)


class Context(eqx.Module):
    """One point of a test or all of them: everything here is a scalar or an array over points.

    Attributes:
        law: the law as modified by the effects that act on its parameters; they already contain the shape where the
            fit has taken it in (`a` = 0), so effects use strain and never the shape factor.
        peak_force: largest force so far [mN].
        peak_displacement: largest displacement of the law so far [um].
        recoverable: displacement that the law recovers on full release from there [um].
        displacement: displacement of the law [um], without additions.
        memory: what an effect with a memory has accumulated; None for the others.
    """

    particle: Particle
    law: Formulas
    record: Record
    peak_force: Values
    peak_displacement: Values
    recoverable: Values
    displacement: Values
    memory: Any = None

    __repr__ = described(peak_force="mN", peak_displacement="um", recoverable="um", displacement="um")

    @property
    def force(self) -> Values:
        """Force [mN], 0 out of contact."""
        return positive(self.record.force)

    @property
    def stress(self) -> Values:
        """Stress F / (pi R_e^2) [MPa]."""
        return self.particle.stress(self.force)

    @property
    def peak_stress(self) -> Values:
        """Largest stress so far [MPa]."""
        return self.particle.stress(self.peak_force)

    @property
    def peak_strain(self) -> Values:
        """Largest strain of the law so far [-]."""
        return self.particle.strain(self.peak_displacement)

    @property
    def load_share(self) -> Values:
        """u = F / F_P [-]: 1 on virgin loading, 0 on full release."""
        loaded, share = self._over_peak(self.force)
        return jnp.where(loaded & (share < 1), share, 1.0)

    @property
    def pulled_share(self) -> Values:
        """The same, and below 0 in tension."""
        return jnp.where(self.record.force < 0, self._over_peak(self.record.force)[1], self.load_share)

    @property
    def recovered_share(self) -> Values:
        """s [-]: recovered over recoverable displacement of the law, 0 at the peak, 1 on full release."""
        return recovery(self.load_share)

    @property
    def peak_contact_radius(self) -> Values:
        """Radius of contact at the peak [um], see `contact_radius`."""
        return contact_radius(self.particle, self.peak_strain)

    @property
    def contact_radius(self) -> Values:
        """Radius of contact now [um]; it shrinks while the particle is unloaded."""
        return self.peak_contact_radius * contact_of(self.recovered_share)

    @property
    def reload_from_share(self) -> Values:
        """Force at which the latest reload began, over the peak force [-]."""
        return jnp.clip(self._over_peak(self.record.reload_from)[1], 0.0, 1.0)

    def _over_peak(self, force: Values) -> tuple[Bool[Array, ...], Values]:
        """Whether there has been a load, and a force over its peak, 0 without one."""
        loaded = self.peak_force > jnp.finfo(self.peak_force.dtype).tiny ** 0.5
        return loaded, jnp.where(loaded, force, 0.0) / jnp.where(loaded, self.peak_force, 1.0)

    @property
    def progress(self) -> Values:
        """How far the present or latest reload went [-]: 0 where it began, 1 at the peak force; 0 before any reload."""
        reached = jnp.where(self.record.branch == UNLOAD, self.record.unload_from, self.force)
        share = reload_progress(reached, self.record.reload_from, self.peak_force)
        return jnp.where(self.record.reloads > 0, share, 0.0)

    @property
    def cycles(self) -> Values:
        """Reloads so far, a partial one counted in part [-]; never decreases."""
        return self.record.progress + self.progress


def contact_of(recovered_share: Values) -> Values:
    """sqrt(1 - s^2), with slope zero instead of infinity at s = 1."""
    chord = (1 - recovered_share) * (1 + recovered_share)
    inside = chord > 0
    return jnp.where(inside, jnp.sqrt(jnp.where(inside, chord, 1.0)), 0.0)


def contact_radius(particle: Particle, strain: Values) -> Values:
    """Radius of plastic contact with each of two platens [um] at a strain [-], D_e sqrt(c^2 eps / 2), c^2 = 1.43.

    Each platen takes half of the displacement: a^2 = 2 c^2 R_e gamma / 2 (Storakers, Biwa and Larsson 1997).
    """
    return particle.effective_diameter * root(PUNCH_AREA * strain / 2)
