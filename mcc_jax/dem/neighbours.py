"""Contacts between particles: which are close, their list of fixed length, and what each remembers across lists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import arguments
from .._errors import InputError
from .._format import described
from .._numerics import recompute
from .._types import Flag, Scalar
from .walls import Vector, dot

PADDING = np.iinfo(np.int64).max  # key of a place in the list that no pair uses; sorts behind all others


class Edges(eqx.Module):
    r"""Pairs of particles that touch or may soon, sorted by key, in a list of fixed length.

    The key of a pair is :math:`\min(i, j)\,N + \max(i, j)`, its sides are ordered by index, and history follows the
    key. A pair that leaves the list loses its history: should it come back, it is a virgin contact.

    Attributes:
        key: keys, ascending, then padding; they need double precision switched on.
        i, j: particles of the pair, i < j; 0 in padding.
        overlap_max: largest overlap so far [m].
        slip: elastic tangential displacement of j's surface against i's [m].
        particles: N.
    """

    key: Int[Array, " edges"]
    i: Int[Array, " edges"]
    j: Int[Array, " edges"]
    overlap_max: Float[Array, " edges"]
    slip: Float[Array, "edges 3"]
    particles: int = eqx.field(static=True)

    __repr__ = described()

    @property
    def capacity(self) -> int:
        """Length of the list."""
        return self.key.shape[0]

    @property
    def active(self) -> Bool[Array, " edges"]:
        """Which places hold a pair."""
        return self.key != PADDING


def overlap_and_normal(i: Vector, j: Vector, reach: Scalar, listed: Flag) -> tuple[Scalar, Vector]:
    """Overlap [m] of two spheres and unit vector from i to j, from centres [m] and the sum of the radii [m].

    Coincident centres: zero normal, no force. Unused places of the list: overlap -1 m. A position that is NaN shows.
    The overlap, a small difference of large numbers, is taken in the precision of the positions and then rounded.
    """
    between = j - i
    square = dot(between, between)
    apart = listed & (square > 0)
    distance = recompute(jnp.sqrt(jnp.where(apart, square, 1.0)))
    separation = reach.astype(distance.dtype) - distance
    overlap = jnp.where(apart, separation, jnp.where(listed & jnp.isnan(square), square, -1.0))
    normal = jnp.where(apart, between * recompute(1 / distance), 0.0)
    return overlap.astype(reach.dtype), normal.astype(reach.dtype)


def pair_geometry(
    radius: Float[Array, " particles"], position: Float[Array, "particles 3"], edges: Edges
) -> tuple[Array, Array]:
    """Overlap [m] and unit normal from i to j of every edge."""
    i, j = edges.i, edges.j
    return jax.vmap(overlap_and_normal)(position[i], position[j], radius[i] + radius[j], edges.active)


def close_pairs(position: Any, radius: Any, skin: float) -> Int[np.ndarray, "pairs 2"]:
    """All pairs whose surfaces are closer than the skin, :math:`|x_i - x_j| < R_i + R_j + s` [m].

    By `vesin` if it is installed (``pip install mcc-jax[neighbours]``), else by SciPy's k-d tree; the same pairs. None
    can touch unseen until a particle has moved by half of the skin. `InputError` names a position that is not finite.
    """
    position = arguments.floats(position, "position", shape="centres [m], shape (N, 3)")
    radius = arguments.floats(radius, "radius", shape="radii [m], shape (N,)")
    skin = arguments.number(skin, "skin [m]", least=0)
    arguments.positive(radius, "radius [m]")
    if position.shape != (*radius.shape, 3):
        shapes = f"{position.shape} and {radius.shape}"
        raise InputError(f"position and radius have the shapes {shapes} where (N, 3) and (N,) are expected")
    check_finite(position)
    if len(position) < 2:
        return np.zeros((0, 2), np.int64)
    cutoff = 2 * float(radius.max()) + skin
    pairs = _pairs_within(position, cutoff)
    gap = np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1) - radius[pairs].sum(axis=1)
    return pairs[gap < skin]


def check_finite(position: np.ndarray, when: str = "") -> None:
    """Refuse positions that are not finite, naming the first particle."""
    lost = np.flatnonzero(~np.isfinite(position).all(axis=1))
    if lost.size:
        problem = f"the position of particle {lost[0]} is not finite{when}"
        raise InputError(problem, remedy="A smaller time step, or look at how the packing was made.")


def _pairs_within(position: np.ndarray, cutoff: float) -> np.ndarray:
    try:
        from vesin import NeighborList  # pyright: ignore[reportMissingImports]  # optional
    except ImportError:
        from scipy.spatial import KDTree

        return KDTree(position).query_pairs(cutoff, output_type="ndarray").astype(np.int64)
    # vesin's cell grid is made for lengths of the order of one: in units of the cut-off they are.
    found = NeighborList(cutoff=1.0, full_list=False).compute(
        points=position / cutoff, box=np.zeros((3, 3)), periodic=False, quantities="ij"
    )
    return np.stack(found, axis=1).astype(np.int64)


def list_edges(pairs: Any, particles: int, capacity: int, dtype: np.dtype | type = np.float64) -> Edges:
    """Edges of virgin contacts from pairs of indices, shape (pairs, 2), in any order; repetitions are dropped.

    `InputError` if the pairs do not fit into a list of the length `capacity`, an index is not of a particle, a particle
    is paired with itself, or without double precision.
    """
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        remedy = 'jax.config.update("jax_enable_x64", True) first; positions and forces may still be float32.'
        raise InputError("keys of contacts need 64 bits", remedy=remedy)
    pairs = np.asarray(pairs, np.int64).reshape(-1, 2)
    low, high = np.minimum(pairs[:, 0], pairs[:, 1]), np.maximum(pairs[:, 0], pairs[:, 1])
    wrong = np.flatnonzero((low < 0) | (high >= particles) | (low == high))
    if wrong.size:
        raise InputError(f"pair {wrong[0]} joins {pairs[wrong[0]].tolist()}", remedy=f"Name two of {particles}.")
    used = np.unique(low * particles + high)
    if used.size > capacity:
        problem = f"{used.size} pairs do not fit into a list of {capacity} edges"
        raise InputError(problem, remedy="Take a larger `capacity`.")
    key = np.concatenate([used, np.full(capacity - used.size, PADDING)])
    i, j = (jnp.asarray(x, jnp.int32) for x in np.divmod(np.where(key == PADDING, 0, key), particles))
    return Edges(jnp.asarray(key), i, j, jnp.zeros(capacity, dtype), jnp.zeros((capacity, 3), dtype), particles)


@jax.jit
def carry_history(old: Edges, new: Edges) -> Edges:
    """The new list with the history of the pairs that were in the old one, bit for bit; others start virgin."""
    place = jnp.searchsorted(old.key, new.key).clip(0, old.capacity - 1)
    known = (old.key[place] == new.key) & new.active
    history = jnp.where(known, old.overlap_max[place], 0.0), jnp.where(known[:, None], old.slip[place], 0.0)
    return eqx.tree_at(lambda e: (e.overlap_max, e.slip), new, history)


def with_list(old: Edges, key: Array, i: Array, j: Array) -> Edges:
    """The contacts on another list of the same particles, with the history of the pairs that were in the old one."""
    overlap_max, slip = jnp.zeros(key.shape[0], old.slip.dtype), jnp.zeros((key.shape[0], 3), old.slip.dtype)
    return carry_history(old, Edges(key, i, j, overlap_max, slip, old.particles))


def stacked_lists[Recorded: Any](tape: Sequence[Recorded]) -> Recorded:
    """Named tuples with a list of edges each (`key`, `i`, `j`) as one with a leading axis, padded to one length."""
    if not tape:
        raise InputError("an empty tape", remedy="Pass the list that `advance` or `compact` filled.")
    longest = max(step.key.shape[0] for step in tape)
    padded = []
    for step in tape:
        missing = 0, longest - step.key.shape[0]
        key = np.pad(step.key, missing, constant_values=PADDING)  # in NumPy: the tape is known while JAX traces
        padded.append(step._replace(key=key, i=np.pad(step.i, missing), j=np.pad(step.j, missing)))
    return type(tape[0])(*(jnp.asarray(np.stack(column)) for column in zip(*padded, strict=True)))
