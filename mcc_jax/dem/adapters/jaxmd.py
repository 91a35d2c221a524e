"""Edges from the neighbour lists of jax-md."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..._errors import InputError
from ..edges import Edges, list_edges


def edges_from_jaxmd(neighbours: Any, capacity: int | None = None, dtype: np.dtype | type = np.float64) -> Edges:
    """Edges of virgin contacts from a `jax_md.partition.NeighborList`; give them history with `carry_history`.

    jax-md looks for pairs on the accelerator and makes its lists for one cut-off: with spheres of several sizes take
    the largest sum of two radii. The list comes to the host here, as does that of `close_pairs`.

    Args:
        neighbours: a list of format OrderedSparse or Sparse (``pip install mcc-jax[jaxmd]``).
        capacity: length of the list of edges; that of jax-md's if None.
        dtype: precision of the history.

    Raises:
        InputError: if the list is dense, or if it overflowed and so pairs are missing.
    """
    index = np.asarray(neighbours.idx)
    count = len(neighbours.reference_position)
    if index.ndim != 2 or len(index) != 2 or "Sparse" not in str(neighbours.format):
        raise InputError(
            f"a neighbour list of format {neighbours.format}",
            remedy="Make it with `format=jax_md.partition.NeighborListFormat.OrderedSparse`.",
        )
    if bool(neighbours.did_buffer_overflow):
        raise InputError(
            "jax-md's neighbour list overflowed: pairs are missing",
            remedy="Allocate it again: `neighbours = neighbour_fn.allocate(position)`.",
        )
    pairs = index.T[(index < count).all(axis=0)]  # places not used name particle N
    return list_edges(pairs, count, index.shape[1] if capacity is None else capacity, dtype)
