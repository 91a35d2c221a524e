"""The modulus that acts at the peaks of the tests: what all formulas of a modulus mean by it.

Each formula has a strain, a size or a humidity of its own at which its modulus is that of the law: extrapolated there,
it may be twice what acts in the tests. At their peaks all formulas that describe the tests agree.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..calibrate.distributions import nuisance_moments
from ..calibrate.forward import Forms
from ..effects import Variant
from ..effects.record import Record
from ..geometry import Particle
from ..law.response import modulus_factor
from .base import Base, State
from .design import moved
from .evidence import Solution
from .refine import Refined
from .settings import NUMERICS


def of_modulus_at_peaks(base: Base, formulas: Refined, solution: Solution) -> tuple[float, np.ndarray]:
    """Mean logarithm of what effects make of the modulus at every test's largest force, and its slopes.

    Args:
        base: the tests.
        formulas: of the effects.
        solution: their numbers.

    Returns:
        The mean, and its derivatives by the amplitudes and then by the further numbers, each in units of its column.
    """
    variants = formulas.variants
    at = np.asarray(moved(base, formulas.state, variants, solution).point.theta[0])
    steps = [v.plausible[0] for v in variants]
    for v in variants:
        for n in v.nuisances:
            _, sd = nuisance_moments(n)
            steps.append(sd * float(at[len(steps)]) if n.plausible[0] > 0 else sd)
    effects = Forms(base.model.unloading, variants).build(jnp.asarray(at))
    if not any(effect.overrides("modify", "stiffness") for effect in effects):
        return 0.0, np.zeros(len(steps))

    def mean(numbers: np.ndarray) -> float:
        return _mean(base, formulas.state, variants, numbers)

    small = NUMERICS.aside
    return mean(at), np.array([(mean(at + way) - mean(at - way)) / (2 * small) for way in np.diag(steps) * small])


def _mean(base: Base, state: State, variants: tuple[Variant, ...], numbers: np.ndarray) -> float:
    """Mean logarithm of the factor on the modulus at numbers of the effects."""
    forms = Forms(base.model.unloading, variants)

    def one(latent: Array, particle: Particle, record: Record) -> Array:
        law = forms.law(latent, jnp.asarray(numbers))
        context = law.context(particle, record)
        top = record.force.argmax()
        return jnp.log(
            context.law.effective_modulus * modulus_factor(law.effects, context)[top] / law.formulas.effective_modulus
        )

    tests = base.tests
    return float(jax.vmap(one)(state.point.latent, tests.particle, tests.record).mean())
