"""Packings to start from."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .. import arguments
from .._errors import InputError
from ..geometry import Particle
from ..law import MccLaw
from .side import half_contact, passive
from .state import Packing

MCC_DENSITY = 1540.0
"""True density of micro-crystalline cellulose, about [kg/m^3]."""


def spheres(law: MccLaw, diameter: Any, density: float = MCC_DENSITY) -> Packing:
    """Spheres of given diameters, each with the law or with its own.

    Args:
        law: one law for all, or a batch of laws with one for each sphere.
        diameter: [um].
        density: of the particle, pores included [kg/m^3].
    """
    diameter = arguments.path(diameter, "diameter", many="Give one diameter [um] for each sphere.")
    arguments.positive(diameter, "diameter [um]")  # traced ones pass
    density = arguments.number(density, "density [kg/m^3]", above=0)
    batched = law.a.ndim == 1 or law.plastic.C1.ndim == 1
    axes = jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, law) if batched else None

    def one(law: MccLaw, diameter: Array):
        return half_contact(law, Particle(diameter, diameter, diameter))

    radius = 0.5e-6 * diameter
    sides = jax.vmap(one, (axes, 0))(law, diameter)
    return Packing(radius, density * 4 / 3 * jnp.pi * radius**3, passive(sides))


def scattered(
    key: PRNGKeyArray, radius: Any, die_radius: float, gap: float = 0.02
) -> tuple[Float[Array, "particles 3"], float]:
    """Centres [m] of spheres over z = 0 in a die, none touching, and the height of the die [m]; a jittered lattice.

    Args:
        key: random key.
        radius: of the spheres [m].
        die_radius: of the die [m].
        gap: least distance between surfaces, as a share of the largest radius.
    """
    radius = arguments.path(radius, "radius", many="Give one radius [m] for each sphere.")
    arguments.positive(radius, "radius [m]")
    die_radius = arguments.number(die_radius, "die_radius [m]", above=0)
    gap = arguments.number(gap, "gap, a share of the largest radius,", least=0)
    largest = float(jnp.max(radius))
    pitch = (2 + 2 * gap) * largest
    inner = die_radius - (1 + gap) * largest
    if inner < 0:
        raise InputError(f"a die of radius {die_radius} m is narrower than a particle", remedy="Make it wider.")
    reach = math.floor(inner / pitch)
    grid = np.array([(x, y) for x in range(-reach, reach + 1) for y in range(-reach, reach + 1)], float) * pitch
    layer = grid[np.hypot(*grid.T) <= inner]
    layers = math.ceil(len(radius) / len(layer))
    centres = np.concatenate([np.column_stack([layer, np.full(len(layer), (k + 0.5) * pitch)]) for k in range(layers)])
    order, shake = jax.random.split(key)
    place = jnp.asarray(centres)[jax.random.permutation(order, len(centres))[: len(radius)]]
    # A sphere may move by half of what is left between it and the largest there could be beside it.
    room = jnp.maximum(0.5 * pitch - radius - 0.5 * gap * largest, 0.0) / math.sqrt(3)
    shift = jax.random.uniform(shake, place.shape, minval=-1.0)
    return place + jax.vmap(jnp.multiply)(shift, room), layers * pitch


def relative_density(packing: Packing, radius: float, bottom: float, top: float) -> float:
    """Volume of the spheres over that of the die between the punches [-]."""
    radius = arguments.number(radius, "radius [m]", above=0)
    bottom = arguments.number(bottom, "bottom [m]")
    top = arguments.number(top, "top [m]", above=bottom)
    return float(packing.volume) / (math.pi * radius**2 * (top - bottom))
