"""A state on disk: whole or not at all, and bit for bit the same when it comes back."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import jax
import jax.numpy as jnp
import numpy as np

from .. import arguments
from .._errors import InputError
from .._store import write_file
from ..files import LIMITS, open_regular
from .edges import Edges
from .forces import A_PACKING, Packing, WallHistory
from .side import HalfContact
from .state import A_STATE, State
from .walls import Cylinder, Plane

SCHEMA = 1
# Lengths that stand for those of a file, which no number of walls or dimensions equals.
_PARTICLES, _EDGES = 3571, 3581


def save_state(path: str | Path, packing: Packing, state: State) -> None:
    """Write packing and state into one file (NumPy's .npz), replacing an older one only when it is complete.

    Args:
        path: the file.
        packing: the spheres.
        state: all that moves or remembers.
    """
    path = arguments.file_path(path, "path")
    arguments.instance(packing, Packing, "packing", A_PACKING)
    arguments.instance(state, State, "state", A_STATE)
    if packing.sides.effects:
        names = ", ".join(effect.name for effect in packing.sides.effects)
        raise InputError(f"a packing with {names} cannot be saved", remedy="Save one whose law has no effect at peaks.")
    if not path.parent.is_dir():
        raise InputError("no such folder", file=path.parent, remedy="Make it first.")
    header = {
        "schema": SCHEMA,
        "walls": [type(wall).__name__ for wall in state.walls],
        "particles": state.edges.particles,
        "power": packing.sides.power,
    }
    arrays: dict[str, Any] = {f"leaf_{k}": np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves((packing, state)))}
    header_bytes = np.frombuffer(json.dumps(header).encode(), np.uint8)
    write_file(path, lambda stream: np.savez(stream, header=header_bytes, **arrays))


def load_state(path: str | Path) -> tuple[Packing, State]:
    """What `save_state` wrote.

    Raises:
        InputError: if the file is missing, damaged, of another version, or of something else.
    """
    path = arguments.file_path(path, "path")
    try:
        # Opened here: NumPy leaves the file open when the archive turns out to be damaged.
        with open_regular(path, LIMITS.posterior_bytes, "Name one that `save_state` wrote.") as stream:
            header, leaves = _arrays(stream)
    except InputError:
        raise
    # NumPy, zipfile and the tokenizer behind them report damage through a dozen exception types.
    except Exception as error:
        raise InputError(f"is not a saved state ({error})", file=path, remedy="Save it again.") from None
    if not isinstance(header, dict) or header.get("schema") != SCHEMA:
        raise InputError(
            "was saved by another version",
            file=path,
            remedy=f"This one reads schema {SCHEMA}; run it again from the start.",
        )
    skeleton = _skeleton(header, path)
    _check_leaves(leaves, jax.tree.leaves(skeleton), header["particles"], path)
    return jax.tree.unflatten(jax.tree.structure(skeleton), [jnp.asarray(leaf) for leaf in leaves])


def _arrays(stream: BinaryIO) -> tuple[Any, list[np.ndarray]]:
    """The arrays of an archive and its header.

    Raises:
        ValueError: if it unpacks to more than it holds: what `save_state` writes is not compressed.
    """
    with zipfile.ZipFile(stream) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > stream.seek(0, os.SEEK_END):
            raise ValueError("it is compressed")
    stream.seek(0)
    with np.load(stream, allow_pickle=False) as stored:
        header = json.loads(bytes(stored["header"]))
        return header, [np.asarray(stored[f"leaf_{k}"]) for k in range(len(stored.files) - 1)]


def _skeleton(header: dict, file: Path) -> tuple[Packing, State]:
    """A packing and a state of the right structure; their leading axes tell what they count."""
    walls, power, particles = (header.get(key) for key in ("walls", "power", "particles"))
    if (
        not isinstance(walls, list)
        or not all(name in ("Plane", "Cylinder") for name in walls)
        or not isinstance(power, int)
        or not isinstance(particles, int)
    ):
        raise InputError("has a damaged header", file=file, remedy="Save it again.")

    def empty(*shape: int, kind: type = float) -> jax.Array:
        return jnp.zeros(shape, kind)

    one, vector, number, point = empty(_PARTICLES), empty(_PARTICLES, 3), empty(), empty(3)
    side = HalfContact(number, number, number, number, number, power)
    sides = jax.tree.map(lambda _: one, side)  # one for each particle, as `jax.vmap(half_contact)` gives them
    made = {"Plane": Plane(point, point, point), "Cylinder": Cylinder(number + 1, number, number, point)}
    index, edge = empty(_EDGES, kind=int), empty(_EDGES)
    edges = Edges(index, index, index, edge, empty(_EDGES, 3), empty(kind=int), particles)
    history = WallHistory.virgin(_PARTICLES, len(walls))
    packing = Packing(one, one, sides)
    state = State(vector, vector, vector, edges, history, tuple(made[name] for name in walls), vector, number, number)
    return packing, state


def _check_leaves(leaves: list[np.ndarray], wanted: list[jax.Array], particles: int, file: Path) -> None:
    if len(wanted) != len(leaves):
        raise InputError(f"holds {len(leaves)} arrays instead of {len(wanted)}", file=file, remedy="Save it again.")
    lengths = {_PARTICLES: particles}
    for k, (leaf, like) in enumerate(zip(leaves, wanted, strict=True)):
        if like.shape[:1] == (_EDGES,) and leaf.ndim:
            lengths.setdefault(_EDGES, len(leaf))
        shape = tuple(lengths.get(length, length) for length in like.shape)
        if leaf.shape != shape or leaf.dtype.kind != like.dtype.kind:
            raise InputError(
                f"array {k} is {leaf.dtype} of shape {leaf.shape}, where {like.dtype} of shape {shape} is expected",
                file=file,
                remedy="Save it again.",
            )
