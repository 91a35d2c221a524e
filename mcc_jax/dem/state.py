"""What a packing is at one moment: places, velocities, contacts with their history, walls; its start, and on disk."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from .. import arguments
from .._archive import encode, read_archive
from .._errors import InputError
from .._format import described
from .._store import write_file
from .._types import Scalar
from .edges import Edges, carry_history, close_pairs, list_edges
from .side import HalfContact
from .walls import Walls

SPARE = 1.1
"""Length of a new list of edges over the pairs found."""

Vectors = Float[Array, "particles 3"]


class Packing(eqx.Module):
    """Spheres, and how each of them pushes back.

    Attributes:
        radius: [m].
        mass: [kg].
        sides: half contacts, one a particle (``jax.vmap(half_contact)``).
    """

    radius: Float[Array, " particles"]
    mass: Float[Array, " particles"]
    sides: HalfContact

    __repr__ = described(radius="m", mass="kg")

    @property
    def volume(self) -> Scalar:
        """Volume of all spheres [m^3], overlaps not taken off."""
        return 4 / 3 * jnp.pi * jnp.sum(self.radius**3)


class WallHistory(eqx.Module):
    """What the contacts with walls remember: dense, one place for each particle and wall.

    Attributes:
        overlap_max: largest overlap so far [m].
        slip: elastic tangential displacement of the wall against the particle's surface [m].
    """

    overlap_max: Float[Array, "particles walls"]
    slip: Float[Array, "particles walls 3"]

    __repr__ = described()

    @classmethod
    def virgin(cls, particles: int, walls: int, dtype: DTypeLike = jnp.float64) -> WallHistory:
        """Nothing has touched yet."""
        return cls(jnp.zeros((particles, walls), dtype), jnp.zeros((particles, walls, 3), dtype))


class State(eqx.Module):
    """Everything that moves or remembers. Saved and loaded whole (`save_state`), it goes on bit for bit.

    Attributes:
        position, velocity: of the centres [m, m/s].
        spin: angular velocities [rad/s].
        edges, wall_history: pairs and contacts with walls, with their history.
        walls: the walls, where they are now.
        listed_at, skin: positions when the list of edges was made, and extra distance up to which pairs were listed
        [m]. time: [s].
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
    """A state at rest: virgin contacts, a fresh list of edges.

    Args:
        packing: the spheres.
        walls: the walls.
        position: centres [m].
        skin: extra distance up to which pairs are listed [m], for example a fifth of a radius.
        capacity: length of the list of edges; a tenth more than there are pairs if None.

    Raises:
        InputError: if a position is not finite, a particle is outside the walls, a half contact resists nothing, or the
            pairs do not fit the capacity.
    """
    check_packing(packing)
    position = arguments.values(position, "position", shape="centres [m], shape (N, 3)")
    if position.shape != (len(packing.radius), 3):
        raise InputError(f"position has the shape {position.shape} where ({len(packing.radius)}, 3) is expected")
    skin = arguments.number(skin, "skin [m]", least=0)
    dtype = position.dtype
    state = State(
        position,
        jnp.zeros_like(position),
        jnp.zeros_like(position),
        list_edges(np.zeros((0, 2), np.int64), len(position), 0, dtype),
        WallHistory.virgin(len(position), len(walls), dtype),
        walls,
        position,
        jnp.asarray(skin, dtype),
        jnp.zeros((), dtype),
    )
    check_state(state)
    return rebuild_list(packing, state, skin, capacity)


def rebuild_list(packing: Packing, state: State, skin: float, capacity: int | None = None) -> State:
    """The state with a fresh list of edges, also where that of the given one is stale; contacts keep their history.

    Args:
        skin: as in `start`.
        capacity: length of the list; if None that of the present list, or a tenth more than the pairs if they do not
            fit.
    """
    skin = arguments.number(skin, "skin [m]", least=0)
    if capacity is not None:
        capacity = arguments.whole(capacity, "capacity")
    pairs = close_pairs(np.asarray(state.position, float), np.asarray(packing.radius, float), skin)
    room = state.edges.capacity if capacity is None else capacity
    if capacity is None and len(pairs) > room:
        room = 64 * math.ceil(SPARE * len(pairs) / 64 + 1)
    fresh = list_edges(pairs, len(state.position), room, state.edges.overlap_max.dtype)
    fresh.require_room()
    if state.edges.capacity:
        fresh = carry_history(state.edges, fresh)
    reach = jnp.asarray(skin, state.skin.dtype)
    return eqx.tree_at(lambda s: (s.edges, s.listed_at, s.skin), state, (fresh, state.position, reach))


def check_packing(packing: Packing) -> None:
    """Refuse half contacts that resist nothing, naming the first such particle."""
    valid = np.asarray(jax.vmap(lambda side: side.is_valid)(packing.sides))
    valid = valid & np.asarray((packing.radius > 0) & (packing.mass > 0))
    if not valid.all():
        raise InputError(
            f"particle {np.flatnonzero(~valid)[0]} has no positive radius, mass or stiffness, or a shape factor <= 0",
            remedy="Check its coefficients and diameters.",
        )


def not_monotone(packing: Packing) -> Bool[np.ndarray, " particles"]:
    """Which particles soften until their force falls; the split of their contacts is not unique. Draw them anew."""
    return ~np.asarray(jax.vmap(lambda side: side.is_monotone)(packing.sides))


def check_state(state: State) -> None:
    """Refuse a state in which a position is not finite or a centre is behind a wall, naming particle and wall."""
    lost, behind = (np.asarray(x) for x in _escaped(state))
    if lost.any():
        raise InputError(
            f"the position of particle {np.flatnonzero(lost)[0]} is not finite at {float(state.time):.6g} s",
            remedy="A smaller time step, or look at how the packing was made.",
        )
    for w, wall in enumerate(state.walls):
        if behind[w].any():
            raise InputError(
                f"particle {np.flatnonzero(behind[w])[0]} is outside wall {w} ({type(wall).__name__}) "
                f"at {float(state.time):.6g} s",
                remedy="Place particles inside; if it was pushed through, a smaller time step or a slower punch.",
            )


@jax.jit
def _escaped(state: State) -> tuple[Bool[Array, " particles"], Bool[Array, "walls particles"]]:
    """Which particles are nowhere, and which are behind which wall."""
    behind = [jax.vmap(wall.distance)(state.position) < 0 for wall in state.walls]
    lost = ~jnp.all(jnp.isfinite(state.position), axis=1)
    return lost, jnp.stack(behind) if behind else jnp.zeros((0, len(lost)), bool)


# ---- a state on disk -------------------------------------------------------------------------------------------------


def save_state(path: str | Path, packing: Packing, state: State) -> None:
    """Write packing and state into one file, replacing an older one only when it is complete."""
    path = arguments.file_path(path, "path")
    if not path.parent.is_dir():
        raise InputError("no such folder", file=path.parent, remedy="Make it first.")
    content = encode((packing, state))
    write_file(path, lambda stream: stream.write(content))


def load_state(path: str | Path) -> tuple[Packing, State]:
    """What `save_state` wrote; `InputError` if the file is missing, damaged, or of something else."""
    path = arguments.file_path(path, "path")
    match read_archive(path):
        case (Packing() as packing, State() as state):
            return packing, state
    raise InputError("is not a saved state", file=path, remedy="Name one that `save_state` wrote.")
