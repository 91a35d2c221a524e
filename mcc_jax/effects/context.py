"""What an effect is given at a point of a test: load history, state of the contact, response of the law."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._format import described
from .._types import Values
from ..formulas import PUNCH_AREA, Formulas, recovery
from ..geometry import Particle
from .record import RELOAD, UNLOAD, Record, reload_progress

SMALL = 1e-8


def root(x: Values) -> Values:
    """Square root of x >= 0 with a finite slope at zero: sqrt(x + 1e-8) - sqrt(1e-8)."""
    return jnp.sqrt(x + SMALL) - SMALL**0.5


def positive(x: Values) -> Values:
    """`x` where it is above zero, else 0; no half derivative at zero."""
    return jnp.where(x > 0, x, 0.0)


class Context(eqx.Module):
    """One point of a test or all of them: everything here is a scalar or an array over points.

    Attributes:
        particle: the particle.
        law: the law as modified by the effects that act on its parameters; they already contain the shape where the
            fit has taken it in (`a` = 0), so effects use strain and never the shape factor.
        record: what the instrument did.
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
    def recovered_share(self) -> Values:
        """s [-]: recovered over recoverable displacement of the law, 0 at the peak, 1 on full release."""
        return recovery(self.load_share)

    @property
    def contact_share(self) -> Values:
        """Radius of contact over that at the peak [-], sqrt(1 - s^2)."""
        return contact_of(self.recovered_share)

    @property
    def peak_contact_radius(self) -> Values:
        """Radius of contact at the peak [um], D_e sqrt(c^2 eps_P), c^2 = 1.43 (Storakers, perfect plasticity)."""
        return contact_radius(self.particle, self.peak_strain)

    @property
    def contact_radius(self) -> Values:
        """Radius of contact now [um]; it shrinks while the particle is unloaded."""
        return self.peak_contact_radius * self.contact_share

    @property
    def reload_from_share(self) -> Values:
        """Force at which the latest reload began, over the peak force [-]."""
        return jnp.clip(self._over_peak(self.record.reload_from)[1], 0.0, 1.0)

    def _over_peak(self, force: Values) -> tuple[Bool[Array, ...], Values]:
        """Whether there has been a load, and a force over its peak, 0 without one."""
        loaded = self.peak_force > jnp.finfo(self.peak_force.dtype).tiny ** 0.5
        return loaded, jnp.where(loaded, force, 0.0) / jnp.where(loaded, self.peak_force, 1.0)

    @property
    def unloading(self) -> Values:
        """1 where the latest ramp is an unloading, else 0."""
        return (self.record.branch == UNLOAD).astype(self.peak_force.dtype)

    @property
    def reloading(self) -> Values:
        """1 where the latest ramp is a reload, else 0."""
        return (self.record.branch == RELOAD).astype(self.peak_force.dtype)

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
    """Radius of plastic contact [um] at a strain [-], 2 R_e sqrt(c^2 eps)."""
    return particle.effective_diameter * root(PUNCH_AREA * strain)
