"""What the page needs of `posterior.nc`: draws of the population, and bands of what may be measured."""

from __future__ import annotations

import io
import math
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._errors import InputError
from ..files import LIMITS, open_regular

SECONDS, BYTES_PER_SECOND = 4.0, 10e6
"""So long a whole file takes at most, on a slow machine."""
LONGEST = 160
"""So much of the HDF5 library's message is shown."""


@dataclass(frozen=True)
class Band:
    """Central 95 % of what may be measured of one particle, noise included.

    Attributes:
        force_mN: at these forces [mN], shape (n,).
        middle_um: mean of the predictions [um]; NaN where no point is compared.
        low_um, high_um: ends [um], likewise.
    """

    force_mN: np.ndarray
    middle_um: np.ndarray
    low_um: np.ndarray
    high_um: np.ndarray


@dataclass(frozen=True)
class Posterior:
    """A posterior as the page shows it.

    Attributes:
        draws: of the population, by name, each of shape (chains * draws,).
        bands: by particle.
        inside: share of all compared points inside their band [-]; None without bands.
    """

    draws: Mapping[str, np.ndarray]
    bands: Mapping[str, Band]
    inside: float | None


def read_posterior(file: Path) -> Posterior:
    """Read a `posterior.nc`, in a process of its own with limits: a damaged one may never come to an end.

    Raises:
        InputError: if it is none, or takes longer than a whole one of its size would.
    """
    damaged = "Write it again with mcc-jax calibrate, or move it away"
    with open_regular(file, LIMITS.posterior_bytes, "Calibrate with fewer --draws, or move it away") as stream:
        size = stream.seek(0, os.SEEK_END)
    reader = Path(__file__).with_name("_hdf5_reader.py")
    # One thread: threads of a linear algebra that is not needed would count as memory.
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    seconds = SECONDS + size / BYTES_PER_SECOND
    try:
        done = subprocess.run(
            [sys.executable, str(reader), str(file.absolute())],
            capture_output=True,
            stdin=subprocess.DEVNULL,
            env=environment,
            timeout=seconds,
        )
    except subprocess.TimeoutExpired:
        raise InputError(f"is damaged: no end after {seconds:.0f} s of reading", file=file, remedy=damaged) from None
    if done.returncode:
        said = done.stderr.decode("utf-8", "replace").strip().splitlines()
        why = said[-1][:LONGEST] if said and done.returncode == 1 else "the HDF5 library gave up"
        raise InputError(f"is no posterior that mcc-jax wrote: {why}", file=file, remedy=damaged)
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
        draws = {name.removeprefix("draws/"): found[name] for name in found.files if name.startswith("draws/")}
        names = [str(name) for name in found["names"]] if "names" in found.files else []
        bands = {name: Band(*found[f"bands/{row}"]) for row, name in enumerate(names)}
        inside = float(found["inside"]) if "inside" in found.files else math.nan
    return Posterior(draws, bands, inside if math.isfinite(inside) else None)
