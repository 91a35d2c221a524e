"""A state on disk: whole or not at all, and bit for bit the same when it comes back."""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._errors import InputError
from ._edges import Edges
from ._forces import Packing, WallHistory
from ._side import HalfContact
from ._state import State
from ._walls import Cylinder, Plane

SCHEMA = 1


def save_state(path: str | Path, packing: Packing, state: State) -> None:
    """Write packing and state into one file (NumPy's .npz), replacing an older one only when it is complete.

    Args:
        path: the file.
        packing: the spheres.
        state: all that moves or remembers.
    """
    path = Path(path)
    header = {
        "schema": SCHEMA,
        "walls": [type(wall).__name__ for wall in state.walls],
        "particles": state.edges.particles,
        "power": packing.sides.power,
    }
    arrays: dict[str, Any] = {f"leaf_{k}": np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves((packing, state)))}
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as stream:
            np.savez(stream, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def load_state(path: str | Path) -> tuple[Packing, State]:
    """What `save_state` wrote.

    Raises:
        InputError: if the file is missing, damaged, of another version, or of something else.
    """
    try:
        # Opened here: NumPy leaves the file open when the archive turns out to be damaged.
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            header = json.loads(bytes(stored["header"]))
            leaves = [stored[f"leaf_{k}"] for k in range(len(stored.files) - 1)]
    except FileNotFoundError:
        raise InputError("there is no such file", file=path, remedy="Name one that `save_state` wrote.") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"is not a saved state ({error})", file=path, remedy="Save it again.") from None
    if not isinstance(header, dict) or header.get("schema") != SCHEMA:
        raise InputError(
            "was saved by another version",
            file=path,
            remedy=f"This one reads schema {SCHEMA}; run it again from the start.",
        )
    skeleton = _skeleton(header)
    wanted = jax.tree.leaves(skeleton)
    if len(wanted) != len(leaves):
        raise InputError(f"holds {len(leaves)} arrays instead of {len(wanted)}", file=path, remedy="Save it again.")
    return jax.tree.unflatten(jax.tree.structure(skeleton), [jnp.asarray(leaf) for leaf in leaves])


def _skeleton(header: dict) -> tuple[Packing, State]:
    """A packing and a state of the right structure, with nothing in them."""

    def empty(*shape: int, kind: type = float) -> jax.Array:
        return jnp.zeros(shape, kind)

    one, vector, number = empty(1), empty(1, 3), empty()
    point = empty(3)
    side = HalfContact(number, number, number, number, number, header["power"])
    made = {"Plane": Plane(point, point, point), "Cylinder": Cylinder(number, number, number, point)}
    walls = tuple(made[name] for name in header["walls"])
    index = empty(1, kind=int)
    edges = Edges(index, index, index, one, vector, empty(kind=int), header["particles"])
    history = WallHistory.virgin(1, len(walls))
    packing = Packing(one, one, side)
    return packing, State(vector, vector, vector, edges, history, walls, vector, number, number)
