"""A packing: spheres, where they are, what their contacts remember, walls; its start, and on disk."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .. import arguments
from .._archive import encode, read_archive
from .._errors import InputError
from .._format import described
from .._store import write_file
from .._types import Scalar
from ..geometry import Particle
from ..law import MccLaw
from .neighbours import Edges, carry_history, check_finite, close_pairs, list_edges, pair_geometry
from .pair import HalfContact, half_contact, pair_split, passive, sides_of
from .walls import Walls

MCC_DENSITY = 1540.0
"""True density of microcrystalline cellulose, about [kg/m^3]."""
SPARE = 1.1  # length of a new list of edges over the pairs found

Vectors = Float[Array, "particles 3"]


class Packing(eqx.Module):
    """Spheres, with a half contact each (``jax.vmap(half_contact)``)."""

    radius: Float[Array, " particles"]
    mass: Float[Array, " particles"]
    sides: HalfContact

    __repr__ = described(radius="m", mass="kg")

    @property
    def volume(self) -> Scalar:
        """Volume of all spheres [m^3], overlaps not taken off."""
        return 4 / 3 * jnp.pi * jnp.sum(self.radius**3)


def spheres(law: MccLaw, diameter: Any, density: float = MCC_DENSITY) -> Packing:
    """Spheres of given diameters [um] and density, pores included [kg/m^3]: one law for all, or a batch of laws."""
    diameter = arguments.path(diameter, "diameter", many="Give one diameter [um] for each sphere.")
    arguments.positive(diameter, "diameter [um]")  # traced ones pass
    density = arguments.number(density, "density [kg/m^3]", above=0)
    radius = 0.5e-6 * diameter
    axes = jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, law)
    sides = jax.vmap(lambda law, size: half_contact(law, Particle(size, size, size)), (axes, 0))(law, diameter)
    return Packing(radius, density * 4 / 3 * jnp.pi * radius**3, passive(sides))


def scattered(
    key: PRNGKeyArray, radius: Any, die_radius: float, gap: float = 0.02
) -> tuple[Float[Array, "particles 3"], float]:
    """Centres [m] of spheres over z = 0 in a die, none touching, and the height of the die [m]; a jittered lattice.

    `gap` is the least distance between surfaces, as a share of the largest radius.
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
    # A sphere may move by half of what is left between it and the largest there could be next to it.
    length = jnp.maximum(0.5 * pitch - radius - 0.5 * gap * largest, 0.0) / math.sqrt(3)
    shift = jax.random.uniform(shake, place.shape, minval=-1.0)
    return place + jax.vmap(jnp.multiply)(shift, length), layers * pitch


def relative_density(packing: Packing, radius: float, bottom: float, top: float) -> float:
    """Volume of the spheres over that of the die between the punches [-]."""
    radius = arguments.number(radius, "radius [m]", above=0)
    bottom = arguments.number(bottom, "bottom [m]")
    top = arguments.number(top, "top [m]", above=bottom)
    return float(packing.volume) / (math.pi * radius**2 * (top - bottom))


class WallHistory(eqx.Module):
    """Largest overlap [m] of every particle with every wall, and slip of the wall against its surface [m]."""

    overlap_max: Float[Array, "particles walls"]
    slip: Float[Array, "particles walls 3"]

    __repr__ = described()


class State(eqx.Module):
    """Everything that moves or remembers. Saved and loaded whole (`save_state`), it goes on bit for bit.

    Attributes:
        position, velocity, spin: of the particles [m, m/s, rad/s].
        edges, wall_history: pairs and contacts with walls, with their history.
        walls: the walls, where they are now.
        listed_at, skin: positions when the edges were listed, and extra distance up to which pairs were listed [m].
        time: [s].
    """

    position: Vectors
    velocity: Vectors
    spin: Vectors
    edges: Edges
    wall_history: WallHistory
    walls: Walls
    listed_at: Vectors
    skin: Scalar
    time: Scalar

    __repr__ = described(position="m", velocity="m/s", skin="m", time="s")


def start(packing: Packing, walls: Walls, position: Any, skin: float, capacity: int | None = None) -> State:
    """A state at rest, of centres [m]: virgin contacts, a fresh list of edges.

    Pairs are listed up to an extra distance `skin` [m], for example a fifth of a radius; the list has the length
    `capacity`, or a tenth more than there are pairs. `InputError` if they do not fit, a position is not finite, a
    particle is outside the walls, or a half contact resists nothing.
    """
    check_packing(packing)
    position = arguments.values(position, "position", shape="centres [m], shape (N, 3)")
    if position.shape != (len(packing.radius), 3):
        raise InputError(f"position has the shape {position.shape} where ({len(packing.radius)}, 3) is expected")
    count, dtype, still = len(position), position.dtype, jnp.zeros_like(position)
    edges = list_edges([], count, 0, dtype)
    history = WallHistory(jnp.zeros((count, len(walls)), dtype), jnp.zeros((count, len(walls), 3), dtype))
    zero = jnp.zeros((), dtype)
    state = State(position, still, still, edges, history, walls, position, zero, zero)
    check_state(state)
    return rebuild_list(packing, state, skin, capacity)


def rebuild_list(packing: Packing, state: State, skin: float, capacity: int | None = None) -> State:
    """The state with a fresh list of edges, also where that of the given one is stale; contacts keep their history.

    Without a `capacity`, the list is as long as the present one, or a tenth more than the pairs if they do not fit.
    """
    skin = arguments.number(skin, "skin [m]", least=0)
    if capacity is not None:
        capacity = arguments.whole(capacity, "capacity")
    pairs = close_pairs(np.asarray(state.position, float), np.asarray(packing.radius, float), skin)
    length = state.edges.capacity if capacity is None else capacity
    if capacity is None and len(pairs) > length:
        length = 64 * math.ceil(SPARE * len(pairs) / 64 + 1)
    fresh = list_edges(pairs, len(state.position), length, state.edges.overlap_max.dtype)
    if state.edges.capacity:
        fresh = carry_history(state.edges, fresh)
    return replace(state, edges=fresh, listed_at=state.position, skin=jnp.asarray(skin, state.skin.dtype))


@jax.jit
def measured(packing: Packing, state: State) -> tuple[Int[Array, ""], Int[Array, ""], Scalar]:
    """Pairs and walls that touch, those compressed further than the paper's tests on a side, and kinetic energy [J]."""
    edges, history = state.edges, state.wall_history
    i, j = sides_of(packing.sides, edges.i), sides_of(packing.sides, edges.j)
    overlap, _ = pair_geometry(packing.radius, state.position, edges)
    d_i, d_j = jax.vmap(pair_split)(i, j, edges.overlap_max)
    beyond = edges.active & ((d_i > i.tested) | (d_j > j.tested))
    beyond_at_walls = history.overlap_max > packing.sides.tested[:, None]
    extent = packing.radius.astype(state.position.dtype)
    at_walls = [extent - jax.vmap(wall.distance)(state.position) for wall in state.walls]
    touching = jnp.sum(overlap > 0) + sum(jnp.sum(x > 0) for x in at_walls)
    velocity, spin = (jnp.sum(x**2, axis=1) for x in (state.velocity, state.spin))
    kinetic = 0.5 * jnp.sum(packing.mass * velocity) + 0.2 * jnp.sum(packing.mass * packing.radius**2 * spin)
    return touching, jnp.sum(beyond) + jnp.sum(beyond_at_walls), kinetic


def check_packing(packing: Packing) -> None:
    """Refuse half contacts that resist nothing, naming the first such particle."""
    valid = np.asarray(jax.vmap(lambda side: side.is_valid)(packing.sides))
    valid = valid & np.asarray((packing.radius > 0) & (packing.mass > 0))
    if not valid.all():
        problem = (
            f"particle {np.flatnonzero(~valid)[0]} has no positive radius, mass or stiffness, or a shape factor <= 0"
        )
        raise InputError(problem, remedy="Check its coefficients and diameters.")


def not_monotone(packing: Packing) -> Bool[np.ndarray, " particles"]:
    """Which particles soften until their force falls; the split of their contacts is not unique. Draw them again."""
    return ~np.asarray(jax.vmap(lambda side: side.is_monotone)(packing.sides))


def check_state(state: State) -> None:
    """Refuse a state in which a position is not finite or a centre is behind a wall, naming particle and wall."""
    at = f" at {float(state.time):.6g} s"
    check_finite(np.asarray(state.position), at)
    for w, behind in enumerate(map(np.asarray, _behind(state))):
        if behind.any():
            problem = f"particle {np.flatnonzero(behind)[0]} is outside wall {w} ({type(state.walls[w]).__name__}){at}"
            remedy = "Place particles inside; if it was pushed through, a smaller time step or a slower punch."
            raise InputError(problem, remedy=remedy)


@jax.jit
def _behind(state: State) -> list[Bool[Array, " particles"]]:
    """Which particles are behind each wall."""
    return [jax.vmap(wall.distance)(state.position) < 0 for wall in state.walls]


def save_state(path: str | Path, packing: Packing, state: State) -> None:
    """Write packing and state into one file, replacing an older one only when it is complete."""
    write_file(Path(path), encode((packing, state)))


def load_state(path: str | Path) -> tuple[Packing, State]:
    """What `save_state` wrote; `InputError` if the file is missing, damaged, or of something else."""
    match read_archive(Path(path)):
        case (Packing() as packing, State() as state):
            return packing, state
    raise InputError("is not a saved state", file=path, remedy="Name one that `save_state` wrote.")
