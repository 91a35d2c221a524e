"""One step of the law with its tangent: what every engine needs of a contact."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from .._types import Scalar
from ..geometry import Particle
from ..law import History, MccLaw


def respond(
    law: MccLaw, particle: Particle, state: History, displacement: Scalar, time: Scalar | None = None
) -> tuple[Scalar, Scalar, History]:
    """Force [mN], its derivative with respect to the displacement [mN/um], and the state after the step."""

    def step(x: Scalar) -> tuple[Scalar, History]:
        after, force = law.step(particle, state, x, time)
        return force, after

    return jax.jvp(step, (displacement,), (jnp.ones_like(displacement),), has_aux=True)
