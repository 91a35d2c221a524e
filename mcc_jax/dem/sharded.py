"""Contacts divided over devices and processes: each computes its share, one sum a step brings them together."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from .forces import Forces, Motion, bodies_of, contact_forces, pair_loads, wall_loads
from .neighbours import PADDING, Edges, pad_rows
from .state import Packing, State, WallHistory

AXIS = "shares"

Devices: TypeAlias = Sequence[jax.Device]  # pyright: ignore[reportInvalidTypeForm]  # JAX names it by assignment
Contacts: TypeAlias = Callable[..., tuple[Forces, Edges, WallHistory]]
"""What computes all contact forces, with the arguments of `contact_forces`."""


def sharded[Moving: eqx.Module](
    loop: Callable[..., tuple[Moving, Any]],
    devices: Devices | None,
    packing: Packing,
    motion: eqx.Module,
    state: Moving,
    *further: jax.Array,
) -> tuple[Moving, Any]:
    """A loop over time steps with its contacts divided over devices; differentiable like the loop itself.

    Edges, sorted by key, are divided in contiguous shares of equal length, contacts with walls by particle. Every
    device has and moves all particles; a step needs one reduction, of forces, torques and forces on walls. The loop is
    called with what computes the contact forces, packing, motion, state and what is further; it returns the state, and
    anything that is the same on all devices. Without devices nothing is divided.
    """
    if devices is None:
        return loop(contact_forces, packing, motion, state, *further)
    mesh = Mesh(np.asarray(devices), (AXIS,))
    lengths = [x.shape[0] for x in _remembered(state)]
    whole, share = PartitionSpec(), PartitionSpec(AXIS)
    padded = _padded(state, len(devices))
    specs = eqx.tree_at(_sharded_leaves, jax.tree.map(lambda _: whole, padded), (share,) * len(_sharded_leaves(padded)))

    def one_share(packing: Packing, motion: eqx.Module, state: Moving, *further: jax.Array) -> tuple[Moving, Any]:
        # Marked once, outside the loop: its derivative is then summed over devices once, not in every step.
        own = jax.lax.pcast(packing, AXIS, to="varying")
        return loop(functools.partial(_share_of_contacts, own), packing, motion, state, *further)

    moved, rest = jax.shard_map(
        one_share, mesh=mesh, in_specs=(whole, whole, specs, *(whole for _ in further)), out_specs=(specs, whole)
    )(packing, motion, padded, *further)
    everywhere = NamedSharding(mesh, whole)
    remembered = zip(_remembered(moved), lengths, strict=True)
    kept = [jax.lax.with_sharding_constraint(x[:n], everywhere) for x, n in remembered]
    return eqx.tree_at(_sharded_leaves, moved, (*_sharded_leaves(state)[:3], *kept)), rest


def gathered[Moving: eqx.Module](
    run: Callable[..., tuple[Moving, Any]], devices: Devices | None, *arguments: Any
) -> tuple[Moving, Any]:
    """Call a compiled `sharded` loop with values of this process and bring what it returns back to it, where neighbour
    lists are made: by every process for itself and all alike."""
    if devices is None:
        return run(None, *arguments)
    given = jax.tree.map(np.asarray, arguments)
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), run(tuple(devices), *given))


def _sharded_leaves(state: Any) -> tuple[jax.Array, ...]:
    """What is dealt out, one row an edge or a particle."""
    return (state.edges.key, state.edges.i, state.edges.j, *_remembered(state))


def _remembered(state: Any) -> tuple[jax.Array, ...]:
    edges, history = state.edges, state.wall_history
    return edges.overlap_max, edges.slip, history.overlap_max, history.slip


def _padded(state: Any, parts: int) -> Any:
    """The state with as many edges, and rows of contacts with walls, as divide among the parts."""
    key, *others = _sharded_leaves(state)
    longer = (pad_rows(x, parts * math.ceil(len(x) / parts)) for x in others)
    return eqx.tree_at(_sharded_leaves, state, (pad_rows(key, parts * math.ceil(len(key) / parts), PADDING), *longer))


def _share_of_contacts(packing: Packing, _: Packing, motion: Motion, state: State) -> tuple[Forces, Edges, WallHistory]:
    """`contact_forces` on one device of several, which holds a share of the edges and of the contacts with walls."""
    moving = jax.lax.pcast((state.position, state.velocity, state.spin), AXIS, to="varying")
    bodies = bodies_of(packing, *moving)
    loads, edges = pair_loads(motion, bodies, state.edges)
    particles, rows = loads.shape[0], state.wall_history.slip.shape[0]
    own = jax.lax.axis_index(AXIS) * rows + jnp.arange(rows)
    index = jnp.minimum(own, particles - 1)
    # The last share may be short: a radius below zero touches nothing.
    some = jax.tree.map(lambda x: x[index], bodies)
    some = eqx.tree_at(lambda b: b.radius, some, jnp.where(own < particles, some.radius, -1.0))
    at_walls, on_wall, history = wall_loads(motion, state.walls, some, state.wall_history)
    loads = loads.at[index].add(at_walls)
    loads = jax.lax.psum(jnp.concatenate([loads, jnp.pad(on_wall, ((0, 0), (0, 3)))]), AXIS)
    forces = Forces(loads[:particles, :3], loads[:particles, 3:], loads[particles:, :3])
    return forces, edges, history
