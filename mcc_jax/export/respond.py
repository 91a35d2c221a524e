"""One step of the law with its tangent: what every engine needs of a contact."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from .._types import Scalar
from ..geometry import Particle
from ..law import History, MccLaw


def respond(
    law: MccLaw, particle: Particle, displacement: Scalar, displacement_max: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """Force [mN], its derivative with respect to the displacement [mN/um], and the history [um] after the step."""

    def step(x: Scalar) -> tuple[Scalar, Scalar]:
        history, force = law.step(particle, History(displacement_max), x)
        return force, history.displacement_max

    force, tangent, peak = jax.jvp(step, (displacement,), (jnp.ones_like(displacement),), has_aux=True)
    return force, tangent, peak
