"""What the page needs of `posterior.nc`: draws of the population, and bands of what may be measured."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import InputError

COEFFICIENTS = ("C1", "C3", "C5")
MOST_VALUES = 2**24
"""In one array; a damaged shape may ask for any memory, and a kilobyte of chunks may fill it."""


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
    """Read a `posterior.nc`.

    Raises:
        InputError: if it is none.
    """
    import h5py

    try:
        with h5py.File(file) as tree:
            draws = _draws(tree["posterior"])
            bands, inside = _bands(tree) if "posterior_predictive" in tree else ({}, None)
    except PermissionError as error:
        raise InputError(f"cannot be read: {error}", file=file, remedy="Check the permissions") from None
    except (OSError, KeyError, ValueError, TypeError, IndexError, AttributeError, RuntimeError) as error:
        raise InputError(
            f"is no posterior that mcc-jax wrote: {error}",
            file=file,
            remedy="Write it again with mcc-jax calibrate, or move it away",
        ) from None
    return Posterior(draws, bands, inside)


def _draws(group: Any) -> dict[str, np.ndarray]:
    mu, tau = (_values(group[name]).reshape(-1, 3) for name in ("mu", "tau"))
    found = {name: _values(group[name]).ravel() for name in ("a", "effective_modulus_MPa")}
    for j, name in enumerate(COEFFICIENTS):
        found[f"{name}_median"], found[f"{name}_spread"] = np.exp(mu[:, j]), tau[:, j]
    for name, draws in found.items():
        if draws.size == 0 or not np.isfinite(draws).all():
            raise ValueError(f"{name} has no draws, or some that are not finite")
    return found


def _bands(tree: Any) -> tuple[dict[str, Band], float | None]:
    group, constant = tree["posterior_predictive"], tree["constant_data"]
    names = [_text(name) for name in _values(group["particle"], kind=None)]
    draws = group["displacement_um"]
    inside = count = 0
    bands = {}
    for row, name in enumerate(names):
        force, mask = _values(constant["force_mN"], row), _values(constant["mask"], row, kind=bool)
        # Where no point is compared nothing was drawn.
        some = np.flatnonzero(mask)
        middle, low, high = np.full((3, len(force)), np.nan)
        if len(some):
            # One particle at a time: the whole array may be larger than one wants in memory.
            own = _values(draws, slice(None), slice(None), row).reshape(-1, len(force))[:, some]
            # Of two hundred draws mean and standard deviation say the ends of a near-normal band better than quantiles.
            centre, half = own.mean(0), 1.96 * own.std(0)
            middle[some], low[some], high[some] = centre, centre - half, centre + half
            measured = _values(tree["observed_data"]["displacement_um"], row)[some]
            inside += int(((measured >= low[some]) & (measured <= high[some])).sum())
            count += len(some)
        bands[name] = Band(force, middle, low, high)
    return bands, inside / count if count else None


def _values(dataset: Any, *where: Any, kind: type | None = float) -> np.ndarray:
    """A part of a stored array, unless it is too large to be what we wrote."""
    lengths = [n for i, n in enumerate(dataset.shape) if i >= len(where) or isinstance(where[i], slice)]
    if math.prod(lengths) > MOST_VALUES:
        raise ValueError(f"{dataset.name} has the shape {dataset.shape}")
    return np.asarray(dataset[where], kind)


def _text(value: Any) -> str:
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)
