"""Contacts in single precision, places in double."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .dynamics import Motion, check_arguments
from .forces import Packing
from .state import State


def in_single(packing: Packing, motion: Motion, state: State) -> tuple[Packing, Motion, State]:
    """The same with forces, velocities and history in float32; positions, walls and time stay in double precision.

    An overlap is a small difference of coordinates, and the way of a particle or a punch in one step is smaller still:
    in float32 a die of 1 mm knows places to 1e-10 m, more than a slow punch moves in a step, and so the punch would
    stop or run at a wrong speed. Both are therefore kept in double precision; the law, which takes the time, is not.
    Forces then err by about 1e-6 of the largest (tested to 1e-5). History takes 16 B an edge instead of 32.

    Args:
        packing: the spheres.
        motion: time step, damping, friction.
        state: where to start; what it remembers is rounded.
    """
    check_arguments(packing, motion, state)

    def fields(state: State) -> tuple[Any, ...]:
        return state.velocity, state.spin, state.edges, state.wall_history

    return _single(packing), _single(motion), eqx.tree_at(fields, state, _single(fields(state)))


def _single(tree: Any) -> Any:
    return jax.tree.map(lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)
