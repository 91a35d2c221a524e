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
from .._types import Flag

PADDING = np.iinfo(np.int64).max
"""Key of a place in the list that no pair uses; sorts behind all others."""


class Edges(eqx.Module):
    r"""Pairs of particles that touch or may soon, sorted by key, in a list of fixed length.

    The key of a pair is :math:`\min(i, j)\,N + \max(i, j)`, its sides are ordered by index, and history follows the
    key. A pair that leaves the list loses its history: should it come back, it is a virgin contact.

    Attributes:
        key: keys, ascending, then padding. 8 B an edge; needs double precision switched on, the rest does not.
        i, j: particles of the pair, i < j; 0 in padding.
        overlap_max: largest overlap so far [m].
        slip: elastic tangential displacement of j's surface against i's [m].
        wanted: number of pairs asked for; larger than the capacity if the list overflowed.
        particles: N.
    """

    key: Int[Array, " edges"]
    i: Int[Array, " edges"]
    j: Int[Array, " edges"]
    overlap_max: Float[Array, " edges"]
    slip: Float[Array, "edges 3"]
    wanted: Int[Array, ""]
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

    @property
    def overflow(self) -> Flag:
        """Whether the list is too short and pairs were left out."""
        return self.wanted > self.capacity

    def require_room(self) -> None:
        """Refuse to go on with a list from which pairs are missing."""
        if bool(self.overflow):
            raise InputError(
                f"{int(self.wanted)} pairs do not fit into a list of {self.capacity} edges",
                remedy="Make the list with a larger `capacity`; nothing was computed with this one.",
            )


def close_pairs(position: Any, radius: Any, skin: float) -> Int[np.ndarray, "pairs 2"]:
    """All pairs whose surfaces are closer than the skin, :math:`|x_i - x_j| < R_i + R_j + s`.

    By `vesin` if it is installed (``pip install mcc-jax[neighbours]``), else by SciPy's k-d tree; the same pairs.

    Args:
        position: centres [m].
        radius: radii [m].
        skin: extra distance [m]. No pair can touch unseen until a particle has moved by half of it.

    Raises:
        InputError: if a position is not finite; it names the particle.
    """
    position = arguments.floats(position, "position", shape="centres [m], shape (N, 3)")
    radius = arguments.floats(radius, "radius", shape="radii [m], shape (N,)")
    if position.ndim != 2 or position.shape[1] != 3 or radius.ndim != 1:
        shapes = f"{position.shape} and {radius.shape}"
        raise InputError(f"position and radius have the shapes {shapes} where (N, 3) and (N,) are expected")
    arguments.same_length(position=position, radius=radius)
    arguments.positive(radius, "radius [m]")
    skin = arguments.number(skin, "skin [m]", least=0)
    lost = np.flatnonzero(~np.isfinite(position).all(axis=1))
    if lost.size:
        raise InputError(
            f"the position of particle {lost[0]} is not finite",
            remedy="A smaller time step, or look at how the packing was made.",
        )
    if len(position) < 2:
        return np.zeros((0, 2), np.int64)
    cutoff = 2 * float(radius.max()) + skin
    pairs = _pairs_within(position, cutoff)
    gap = np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1) - radius[pairs].sum(axis=1)
    return pairs[gap < skin]


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
    """Edges of virgin contacts from pairs in any order.

    Args:
        pairs: indices of particles; the order of pairs and within a pair does not matter, repetitions are dropped.
        particles: number of particles N.
        capacity: length of the list. If the pairs do not fit, `Edges.overflow` says so.
        dtype: precision of the history.

    Raises:
        InputError: if an index is not of a particle, a particle is paired with itself, or without double precision.
    """
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError(
            "keys of contacts need 64 bits",
            remedy='jax.config.update("jax_enable_x64", True) first; positions and forces may still be float32.',
        )
    particles = arguments.whole(particles, "particles")
    capacity = arguments.whole(capacity, "capacity")
    given = np.asarray(pairs)
    if given.size and (given.dtype.kind not in "iu" or given.ndim != 2 or given.shape[1] != 2):
        raise InputError(f"pairs must be pairs of whole numbers, shape (pairs, 2), got {arguments.shown(pairs)}")
    pairs = given.astype(np.int64).reshape(-1, 2)
    low, high = np.minimum(pairs[:, 0], pairs[:, 1]), np.maximum(pairs[:, 0], pairs[:, 1])
    wrong = np.flatnonzero((low < 0) | (high >= particles) | (low == high))
    if wrong.size:
        raise InputError(f"pair {wrong[0]} joins {pairs[wrong[0]].tolist()}", remedy=f"Name two of {particles}.")
    key = np.sort(low * particles + high)
    key = key[np.diff(key, prepend=-1) > 0]
    kept = np.full(capacity, PADDING)
    kept[: min(key.size, capacity)] = key[:capacity]
    first, second = np.divmod(np.where(kept == PADDING, 0, kept), particles)
    return Edges(
        jnp.asarray(kept),
        jnp.asarray(first, jnp.int32),
        jnp.asarray(second, jnp.int32),
        jnp.zeros(capacity, dtype),
        jnp.zeros((capacity, 3), dtype),
        jnp.asarray(key.size),
        particles,
    )


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
    return carry_history(old, Edges(key, i, j, overlap_max, slip, old.wanted, old.particles))


def stacked_lists[Recorded: Any](tape: Sequence[Recorded]) -> Recorded:
    """Named tuples with a list of edges each (`key`, `i`, `j`) as one with a leading axis, padded to one length."""
    longest = max(step.key.shape[0] for step in tape)

    def padded(step: Recorded) -> Recorded:
        i, j = pad_rows((step.i, step.j), longest)
        return step._replace(key=pad_rows(step.key, longest, PADDING), i=i, j=j)

    return type(tape[0])(*(jnp.asarray(np.stack(column)) for column in zip(*map(padded, tape), strict=True)))


def pad_rows(tree: Any, rows: int, value: int = 0) -> Any:
    """The arrays of a tree with so many rows, the new ones filled with a value."""

    def longer(x: Array) -> Array:
        return jnp.pad(x, [(0, rows - len(x)), *[(0, 0)] * (x.ndim - 1)], constant_values=value)

    return jax.tree.map(longer, tree)
