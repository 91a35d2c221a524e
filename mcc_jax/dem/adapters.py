"""The contact inside other particle codes in JAX: JaxDEM and JAX-MD. Importing this needs neither."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._errors import InputError
from .neighbours import Edges, list_edges, overlap_and_normal
from .pair import HalfContact, largest_overlap, pair_energy, pair_force, sides_of


def edges_from_jaxmd(neighbours: Any, capacity: int | None = None) -> Edges:
    """Edges of virgin contacts from a `jax_md.partition.NeighborList`; give them history with `carry_history`.

    The list has the format OrderedSparse or Sparse (``pip install mcc-jax[jaxmd]``), the edges its length if no
    `capacity` is given. jax-md makes its lists for one cut-off: with spheres of several sizes take the largest sum of
    two radii. `InputError` if the list is dense, or overflowed and so lacks pairs.
    """
    index, count = np.asarray(neighbours.idx), len(neighbours.reference_position)
    if "Sparse" not in str(neighbours.format):
        problem = f"a neighbour list of format {neighbours.format}"
        raise InputError(problem, remedy="Make it with `format=jax_md.partition.NeighborListFormat.OrderedSparse`.")
    if bool(neighbours.did_buffer_overflow):
        problem = "jax-md's neighbour list overflowed: pairs are missing"
        raise InputError(problem, remedy="Allocate it again: `neighbours = neighbour_fn.allocate(position)`.")
    pairs = index.T[(index < count).all(axis=0)]  # places not used name particle N
    return list_edges(pairs, count, index.shape[1] if capacity is None else capacity)


def jaxdem_force_model(sides: HalfContact) -> Any:
    """A JaxDEM force model (`jaxdem.ForceModel`) that remembers the largest overlap of every contact.

    Use it with JaxDEM's `NeighborList` collider, which carries history and keeps the order of particles:
    ``jaxdem.System.create(..., force_model=jaxdem_force_model(packing.sides), collider_type="NeighborList", ...)``.
    Every contact is computed from both sides with the same result, without torque, in metres and newtons.

    Written for the interface of JaxDEM in mid 2026 (`requires_history`, `init_history`, `force_and_history`). JaxDEM is
    not on the package index: install it from its source.
    """
    try:
        from jaxdem import ForceModel  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("JaxDEM is not installed", remedy="Install it from its source (cdelv/JaxDEM).") from None

    @jax.tree_util.register_dataclass
    @dataclasses.dataclass
    class MccForce(ForceModel):
        """Loading and unloading of microcrystalline cellulose, one half contact a particle."""

        sides: Any = None  # JaxDEM rebuilds force models by their fields, which must have defaults

        @property
        def requires_history(self) -> bool:
            """Unloading depends on the largest overlap."""
            return True

        def init_history(self, shape: tuple[int, ...]) -> Array:
            """Virgin contacts."""
            return jnp.zeros(shape, self.sides.k1.dtype)

        @staticmethod
        def force_and_history(i: Any, j: Any, pos: Array, state: Any, system: Any, history: Array) -> tuple:
            """Force on i from each j, no torque, and the largest overlaps after this one."""
            overlap, away, pair = _geometry(i, j, pos, state, system)
            push = _each(pair_force, *pair, history, overlap, axes=overlap.ndim)
            torque = jnp.zeros((*jnp.shape(overlap), *state.torque.shape[1:]), push.dtype)
            return push[..., None] * away, torque, largest_overlap(history, overlap)

        @staticmethod
        def force(i: Any, j: Any, pos: Array, state: Any, system: Any) -> tuple:
            """Refused: without history there is no unloading."""
            problem = "this collider of JaxDEM carries no history, and the law needs it"
            raise InputError(problem, remedy='Take `collider_type="NeighborList"`.')

        @staticmethod
        def energy(i: Any, j: Any, pos: Array, state: Any, system: Any) -> Array:
            """Energy that a contact loaded for the first time gives back; JaxDEM hands over no history here."""
            overlap, _, pair = _geometry(i, j, pos, state, system)
            return _each(pair_energy, *pair, jnp.zeros_like(overlap), overlap, axes=overlap.ndim).recoverable

    return MccForce(sides=sides)


def _geometry(
    i: Any, j: Any, pos: Array, state: Any, system: Any
) -> tuple[Array, Array, tuple[HalfContact, HalfContact]]:
    """Overlaps, unit vectors from j to i, and the half contacts, those of the lower index first."""
    i, j = jnp.broadcast_arrays(i, j)
    between = system.domain.displacement(pos[i], pos[j], system)
    reach = state.rad[i] + state.rad[j]
    overlap, away = _each(overlap_and_normal, jnp.zeros_like(between), between, reach, i != j, axes=i.ndim)
    sides = system.force_model.sides
    return overlap, away, (sides_of(sides, jnp.minimum(i, j)), sides_of(sides, jnp.maximum(i, j)))


def _each(law: Any, *given: Any, axes: int) -> Any:
    """The law for every contact of arrays with so many axes."""
    for _ in range(axes):
        law = jax.vmap(law)
    return law(*given)
