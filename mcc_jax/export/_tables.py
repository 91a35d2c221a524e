"""The law as two tables: the master loading curve and the unloading curve, fine enough for linear interpolation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from .._errors import InputError
from ..law import TESTED_STRAIN, MccLaw, stress_ratio
from ..law.recovery_limit import HARDENING

if TYPE_CHECKING:
    import pandas as pd

    Table = pd.DataFrame
else:
    Table = object

FEWEST, MOST = 64, 65536
BETWEEN = 8  # points at which an interval is checked


@dataclass(frozen=True)
class CurveTables:
    """The law as tables for linear interpolation.

    Attributes:
        loading: `scaled_strain` (eta_p eps), `stress_MPa`, `tangent_MPa` (d stress / d scaled strain) and
            `recovered_strain_at_eta_1`: the strain recovered from there, to be multiplied by eta_p^((1 - p)/2), but no
            more than `recovery_limit` (scaled strain) over eta_p, so that no unloading gains energy.
        unloading: `recovered_share` s and `stress_share` g(s) of the peak stress.
        error: largest error of linear interpolation, as a share of each column's largest value.
    """

    loading: Table
    unloading: Table
    error: float


def curve_tables(law: MccLaw, *, strain_max: float = TESTED_STRAIN, tolerance: float = 1e-5) -> CurveTables:
    """Tables of the master curves of a law; sizes and shapes come in through the scaled strain.

    Args:
        law: the law.
        strain_max: where the loading table ends [-].
        tolerance: largest error of linear interpolation, as a share of each column's largest value.

    Raises:
        InputError: if 65536 points do not suffice.
    """
    import pandas as pd

    loading, one = _refine(lambda t: _loading(law, strain_max * t**3), tolerance)
    unloading, other = _refine(lambda t: _unloading(1 - (1 - t) ** 2), tolerance)
    return CurveTables(pd.DataFrame(loading), pd.DataFrame(unloading), max(one, other))


def _loading(law: MccLaw, x: np.ndarray) -> dict[str, np.ndarray]:
    K1, K3, K5 = (float(K) for K in law.plastic.polynomial)
    secant = np.maximum(K1 - x**2 * (K3 - x**2 * K5), 0.0)
    n, k, modulus = law.unloading.stress_power, law.unloading.constant, float(law.effective_modulus)
    return {
        "scaled_strain": x,
        "stress_MPa": x * secant,
        "tangent_MPa": np.where(secant > 0, K1 - x**2 * (3 * K3 - 5 * x**2 * K5), 0.0),
        "recovery_limit": x * secant / (K1 + HARDENING * x**4 * K5),
        "recovered_strain_at_eta_1": np.sqrt((secant / modulus) ** n * x ** (n - 1) / k),
    }


def _unloading(s: np.ndarray) -> dict[str, np.ndarray]:
    return {"recovered_share": s, "stress_share": np.asarray(stress_ratio(jnp.asarray(s)))}


def _refine(columns: Callable[[np.ndarray], dict[str, np.ndarray]], tolerance: float) -> tuple[dict, float]:
    """Columns at as few points as the tolerance allows, the first being the abscissa, and their error."""
    count = FEWEST
    while count <= MOST:
        table = columns(np.linspace(0.0, 1.0, count + 1))
        finer = columns(np.linspace(0.0, 1.0, BETWEEN * count + 1))
        x, *_ = table
        error = max(
            np.abs(np.interp(finer[x], table[x], table[name]) - finer[name]).max() / np.abs(finer[name]).max()
            for name in table
        )
        if error <= tolerance:
            return table, float(error)
        count *= 2
    raise InputError(
        f"{MOST} points do not describe the curve to {tolerance:g}: it has a corner",
        remedy="Export this law in another format",
    )
