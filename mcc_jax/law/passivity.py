"""Whether a modulus that depends on the peak lets a particle give back more energy than it took."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._types import Scalar, Values
from ..effects import AbstractModulusAtPeak
from ..formulas import Formulas
from ..geometry import Particle
from .response import factor_at_peak

POINTS = 256
"""Peaks, evenly spread, each of which is asked whether it loses at least as much as the one before."""


def peaks_up_to(highest: Scalar) -> Values:
    """Peaks from zero to the highest one, at which `never_falls` is asked."""
    return highest * jnp.linspace(0.0, 1.0, POINTS + 1, dtype=highest.dtype)


def never_falls(work: Values, stored: Values) -> Bool[Array, ...]:
    """Whether the energy lost does not fall from each peak to the next, beyond rounding; not where it is NaN.

    What is lost, the work of loading less what full release gives back, depends on the peak alone. Where it falls, a
    particle that is released, loaded further and released again has gained.

    Args:
        work: of loading up to each of the peaks.
        stored: what full release from each of them gives back.
    """
    return jnp.diff(work - stored) >= -8 * jnp.finfo(work.dtype).eps * work[-1]


def first_gain(
    law: Formulas, effects: tuple[AbstractModulusAtPeak, ...], particle: Particle, highest: Scalar
) -> Scalar:
    """Smallest peak strain [-] beyond which further loading gains energy; infinite where it never does.

    Args:
        law: the law with the parameters that effects make of it.
        effects: those on the modulus at the peak.
        particle: the particle.
        highest: largest displacement to look at [um].
    """
    law, effects, particle, highest = jax.lax.stop_gradient((law, effects, particle, highest))

    def balance(peak: Scalar) -> tuple[Scalar, Scalar]:
        strain = particle.strain(peak)
        factor = factor_at_peak(effects, strain, law.loading_stress(particle, strain))
        return law.loading_work(particle, peak), law.recoverable_work(particle, peak, peak, factor)[0]

    peaks = peaks_up_to(highest)
    holds = never_falls(*jax.vmap(balance)(peaks))
    return jnp.where(jnp.all(holds), jnp.inf, particle.strain(peaks[jnp.argmin(holds)]))
