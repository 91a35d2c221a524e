"""What is measured of a packing on its way."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._format import described
from .._types import Scalar
from .forces import overlap_and_normal
from .pair import pair_split
from .side import sides_of
from .state import Packing, State
from .walls import Walls


class Trajectory(NamedTuple):
    """What was measured at the end of every chunk of steps.

    Attributes:
        time: [s].
        walls: the walls then, with one more axis in front.
        on_wall: force on each wall [N], mean over the chunk's steps.
        contacts: pairs and walls that carry force.
        beyond_tested: contacts compressed further than the paper's tests (eta_p eps > 0.67), on either side.
        kinetic: kinetic energy [J].
        lists: neighbour lists made so far.
        capacity: length of the list of edges.
    """

    time: np.ndarray
    walls: Walls
    on_wall: np.ndarray
    contacts: np.ndarray
    beyond_tested: np.ndarray
    kinetic: np.ndarray
    lists: np.ndarray
    capacity: np.ndarray

    __repr__ = described()


class Sample(NamedTuple):
    """One row of a `Trajectory`."""

    time: Scalar
    walls: Walls
    on_wall: Float[Array, "walls 3"]
    contacts: Int[Array, ""]
    beyond_tested: Int[Array, ""]
    kinetic: Scalar


@jax.jit
def measured(packing: Packing, state: State, on_wall: Float[Array, "walls 3"]) -> Sample:
    """Measure a state; the force on the walls is given, as a mean over steps."""
    edges, history = state.edges, state.wall_history
    i, j = sides_of(packing.sides, edges.i), sides_of(packing.sides, edges.j)
    reach = packing.radius[edges.i] + packing.radius[edges.j]
    overlap, _ = jax.vmap(overlap_and_normal)(state.position[edges.i], state.position[edges.j], reach, edges.active)
    d_i, d_j = jax.vmap(pair_split)(i, j, edges.overlap_max)
    beyond = edges.active & ((d_i > i.tested) | (d_j > j.tested))
    beyond_at_walls = history.overlap_max > jnp.broadcast_to(packing.sides.tested[:, None], history.overlap_max.shape)
    extent = packing.radius.astype(state.position.dtype)
    wall_overlap = [extent - jax.vmap(wall.distance)(state.position) for wall in state.walls]
    touching = jnp.sum(overlap > 0) + sum(jnp.sum(x > 0) for x in wall_overlap)
    kinetic = 0.5 * jnp.sum(packing.mass * jnp.sum(state.velocity**2, axis=1)) + 0.2 * jnp.sum(
        packing.mass * packing.radius**2 * jnp.sum(state.spin**2, axis=1)
    )
    return Sample(state.time, state.walls, on_wall, touching, jnp.sum(beyond) + jnp.sum(beyond_at_walls), kinetic)
