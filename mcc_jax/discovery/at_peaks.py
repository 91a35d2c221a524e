"""The modulus that acts at the peaks of the tests: what all formulas of a modulus mean by it.

Each formula has a strain, a size or a humidity of its own at which its modulus is that of the law: extrapolated there,
it may be twice what acts in the tests. At their peaks all formulas that describe the tests agree.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..calibrate.forward import Forms
from ..calibrate.priors import nuisance_moments
from ..effects.record import Record
from ..geometry import Particle
from .base import Base
from .design import moved
from .evidence import Solution
from .fit import Fitted


def of_modulus_at_peaks(base: Base, formulas: Fitted, solution: Solution) -> tuple[float, np.ndarray]:
    """Mean logarithm of what effects make of the modulus at every test's largest force, and its derivatives.

    These are by the amplitudes and then by the further numbers, each in units of its column.
    """
    variants, names = formulas.variants, len(formulas.variants)
    forms, state = Forms(base.model.unloading, variants), formulas.state
    at = jnp.asarray(moved(base, state, variants, solution).point.theta[0])
    if not any(effect.overrides("modify", "stiffness") for effect in forms.build(at)):
        return 0.0, np.zeros(len(at))

    def mean(numbers: Array) -> tuple[Array, Array]:
        def one(latent: Array, particle: Particle, record: Record) -> Array:
            law = forms.law(latent, numbers)
            context = law.context(particle, record)
            factors = (effect.stiffness(context)[record.force.argmax()] for effect in law.effects)
            factor = math.prod(factors, start=jnp.ones(()))
            return jnp.log(factor * context.law.effective_modulus / law.effective_modulus)

        found = jax.vmap(one)(state.point.latent, base.tests.particle, base.tests.record).mean()
        return found, found  # the value, too

    further = np.array([nuisance_moments(n)[1] for v in variants for n in v.nuisances])
    units = [*(v.plausible[0] for v in variants), *further * np.where(forms.positive, at[names:], 1.0)]
    slope, value = jax.jacfwd(mean, has_aux=True)(at)
    return float(value), np.asarray(slope) * np.array(units)
