"""Particles of a campaign as one with a batch axis."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import arguments
from .._types import Scalar
from ..geometry import Particle


def particle_batch(diameters_um: Any) -> Particle:
    """One `Particle` whose fields have a leading axis N, from diameters [um] of shape (N, 3).

    Raises:
        InputError: for another shape, or a diameter that is not positive and finite; traced ones pass.
    """
    sizes = diameters_um if arguments.is_traced(diameters_um) else arguments.diameters(diameters_um)
    D1, D2, D3 = jnp.asarray(sizes, dtype=float).T
    return eqx.filter_vmap(Particle)(D1, D2, D3)


def of_each_particle(diameters_um: Any, quantity: Callable[[Particle], Scalar]) -> np.ndarray:
    """A quantity of every particle, shape (N,).

    Args:
        diameters_um: D1, D2, D3 [um], shape (N, 3).
        quantity: function of one `Particle`, for instance its flatness or its plastic shape factor.
    """
    # What files and figures show is in double precision, whatever precision the caller computes in.
    with jax.enable_x64(True):
        return np.array(eqx.filter_vmap(quantity)(particle_batch(diameters_um)))
