"""Which particles are close: neighbour lists from a library, on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Int

from .. import arguments
from .._errors import InputError


def close_pairs(position: Any, radius: Any, skin: float) -> Int[np.ndarray, "pairs 2"]:
    r"""All pairs whose surfaces are closer than the skin, :math:`|x_i - x_j| < R_i + R_j + s`.

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
