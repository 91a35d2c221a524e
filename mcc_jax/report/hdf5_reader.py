"""Reads `posterior.nc`, in a process of its own: `python _hdf5_reader.py FILE`, arrays as NPZ on standard output.

A damaged HDF5 file can keep its library busy for ever or make it ask for any amount of memory, and nothing in Python
can stop it. So this file is run, not imported, with a limit on both (`_posterior.read_posterior`), and imports nothing
of the package.
"""

from __future__ import annotations

import io
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

COEFFICIENTS = ("C1", "C3", "C5")
MAX_VALUES = 2**24
"""In one array; a damaged shape may ask for any memory, and a kilobyte of chunks may fill it."""
MEMORY = 2**31
"""Of the process [bytes], beside what a whole file would take."""


def read(file: str) -> dict[str, np.ndarray]:
    """The arrays of a posterior: `draws/NAME`, and of bands `names`, `bands/NUMBER` (4 rows), `inside`."""
    import h5py

    with h5py.File(file) as tree:
        found = {f"draws/{name}": values for name, values in _draws(tree["posterior"]).items()}
        return found | (_bands(tree) if "posterior_predictive" in tree else {})


def _draws(group: Any) -> dict[str, np.ndarray]:
    mu, tau = (_values(group[name]).reshape(-1, 3) for name in ("mu", "tau"))
    found = {name: _values(group[name]).ravel() for name in ("a", "effective_modulus_MPa")}
    for j, name in enumerate(COEFFICIENTS):
        found[f"{name}_median"], found[f"{name}_spread"] = np.exp(mu[:, j]), tau[:, j]
    for name, draws in found.items():
        if draws.size == 0 or not np.isfinite(draws).all():
            raise ValueError(f"{name} has no draws, or some that are not finite")
    return found


def _bands(tree: Any) -> dict[str, np.ndarray]:
    group, constant = tree["posterior_predictive"], tree["constant_data"]
    names = [_text(name) for name in _values(group["particle"], kind=None)]
    draws = group["displacement_um"]
    inside = count = 0
    found: dict[str, np.ndarray] = {}
    for row in range(len(names)):
        force, mask = _values(constant["force_mN"], row), _values(constant["mask"], row, kind=bool)
        # Where no point is compared nothing was drawn.
        some = np.flatnonzero(mask)
        middle, low, high = np.full((3, len(force)), np.nan)
        if len(some):
            # One particle at a time: the whole array may be larger than one wants in memory.
            own = _values(draws, slice(None), slice(None), row).reshape(-1, len(force))[:, some]
            # Of two hundred draws mean and standard deviation say the ends of a near-normal band better than quantiles.
            centre, half = own.mean(0), 1.96 * own.std(0)
            if not (np.isfinite(centre) & np.isfinite(half)).all():
                raise ValueError(f"predictions of {names[row]} are not finite")
            middle[some], low[some], high[some] = centre, centre - half, centre + half
            measured = _values(tree["observed_data"]["displacement_um"], row)[some]
            inside += int(((measured >= low[some]) & (measured <= high[some])).sum())
            count += len(some)
        found[f"bands/{row}"] = np.stack([force, middle, low, high])
    share = np.asarray(inside / count if count else np.nan)
    return found | {"names": np.asarray(names, dtype=np.str_), "inside": share}


def _values(dataset: Any, *where: Any, kind: type | None = float) -> np.ndarray:
    """A part of a stored array, unless it is too large to be what we wrote."""
    lengths = [n for i, n in enumerate(dataset.shape) if i >= len(where) or isinstance(where[i], slice)]
    if math.prod(lengths) > MAX_VALUES:
        raise ValueError(f"{dataset.name} has the shape {dataset.shape}")
    return np.asarray(dataset[where], kind)


def _text(value: Any) -> str:
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


def _limit_memory(most: int) -> None:
    try:
        import resource
    except ImportError:  # not on Windows
        return
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def main(file: str) -> int:
    """Write the arrays, or what is wrong in one line on standard error."""
    _limit_memory(MEMORY + 4 * Path(file).stat().st_size)
    stream = io.BytesIO()
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused
            np.savez(stream, **read(file))  # pyright: ignore[reportArgumentType]
    except Exception as error:
        sys.stderr.write(f"{error or type(error).__name__}\n")
        return 1
    sys.stdout.buffer.write(stream.getvalue())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
