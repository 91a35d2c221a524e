"""The law as two tables: the master loading curve and the unloading curve, fine enough for linear interpolation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import arguments
from .._errors import InputError
from .._format import described
from .._numerics import compiled_whole
from ..dem import HalfContact, half_contact
from ..formulas import Contact, Formulas
from ..formulas.contact import SHARE
from ..geometry import Particle
from ..law import TESTED_STRAIN, MccLaw, stress_ratio
from ..law.response import folded
from .origin import checked

if TYPE_CHECKING:
    import pandas as pd

    Table = pd.DataFrame
else:
    Table = object

Curves = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
MIN_ROWS, MAX_ROWS = 64, 65536
BETWEEN = 8  # points at which an interval is checked
CORNERS = 4096  # intervals in which a corner is looked for


@dataclass(frozen=True)
class CurveTables:
    """The law as tables for linear interpolation.

    Attributes:
        loading: `scaled_strain` (eta_p eps), `stress_MPa`, `tangent_MPa` (d stress / d scaled strain),
            `recovered_strain_at_eta_1`, the strain that a particle of shape factor 1 recovers from there, and
            `recovered_strain_formula_at_eta_1`, the same without its limit. Of another shape factor a particle recovers
            the latter times eta_p^((1 - p)/2), and at most the smaller of `scaled_strain` and (3 pi/8) `stress_MPa` /
            `tangent_MPa` (where that is positive), over eta_p: so no unloading gains energy (`recoverable_strain`).
        unloading: `recovered_share` s and `stress_share` g(s) of the peak stress.
        error: largest error of linear interpolation, as a share of each column's largest value.
    """

    loading: Table
    unloading: Table
    error: float

    __repr__ = described()


def curve_tables(
    law: MccLaw, particle: Particle | None = None, *, strain_max: float = TESTED_STRAIN, tolerance: float = 1e-5
) -> CurveTables:
    """Tables of the master curves of a law; sizes and shapes come in through the scaled strain.

    Args:
        law: the law.
        particle: the one that the tables hold for if the law has effects; without effects they hold for all.
        strain_max: where the loading table ends [-].
        tolerance: largest error of linear interpolation, as a share of each column's largest value.

    Raises:
        InputError: if 65536 points do not suffice, or naming an effect that is no closed formula.
    """
    import pandas as pd

    checked(law, particle, needed=bool(getattr(law, "effects", ())))
    strain_max = arguments.number(strain_max, "strain_max", above=0)
    tolerance = arguments.number(tolerance, "tolerance", above=0)
    formulas, side = law.formulas, None
    if law.effects and particle is not None:
        side = half_contact(law, particle)
        formulas, _ = folded(formulas, law.effects, particle, "the tables")

    at = partial(_at, formulas, side)
    corners = _corners(lambda t: at(strain_max * t**3))
    loading, one = _refine(lambda t: _loading(x := strain_max * t**3, at(x)), tolerance, corners)
    unloading, other = _refine(lambda t: _unloading(1 - (1 - t) ** 2), tolerance)
    return CurveTables(pd.DataFrame(loading), pd.DataFrame(unloading), max(one, other))


def _loading(x: np.ndarray, curves: Curves) -> dict[str, np.ndarray]:
    secant, tangent, formula, limit = curves
    return {
        "scaled_strain": x,
        "stress_MPa": x * secant,
        "tangent_MPa": np.where(secant > 0, tangent, 0.0),
        "recovered_strain_at_eta_1": np.minimum(formula, limit),
        "recovered_strain_formula_at_eta_1": formula,
    }


def _at(law: Formulas, side: HalfContact | None, x: np.ndarray) -> Curves:
    """Secant and tangent [MPa] at scaled strains; strain recovered at eta_p = 1 by the formula, and its limit."""
    n, k = law.unloading.stress_power, law.unloading.constant
    contact = Contact(*law.plastic.polynomial, 1 / (k * law.effective_modulus**n), power=n)
    if side is not None:
        ratio = side.at_peak(jnp.asarray(side.tested / TESTED_STRAIN * x)).c / side.c
        contact = eqx.tree_at(lambda one: one.c, contact, contact.c * ratio)
    secant, tangent, formula, limit = map(np.asarray, _curves(contact, jnp.asarray(x)))
    return secant, tangent, formula, limit


@compiled_whole
def _curves(contact: Contact, x: Array) -> tuple[Array, Array, Array, Array]:
    top, bottom, _ = contact.limit(x)
    return contact.secant(x), contact.tangent(x), jnp.sqrt(contact.formula_squared(x)), top / bottom


def _corners(at: Callable[[np.ndarray], Curves]) -> np.ndarray:
    """Where the recovered strain bends sharply, as t: its limit begins to hold, or ends to."""

    from scipy.optimize import brentq

    def excess(t: np.ndarray) -> np.ndarray:
        _, _, formula, limit = at(t)
        return formula - limit

    def steepness(t: np.ndarray) -> np.ndarray:
        secant, tangent, _, _ = at(t)
        return tangent - SHARE * secant

    t, found = np.linspace(0.0, 1.0, CORNERS + 1), []
    for of in (excess, steepness):
        sign = np.sign(of(t))
        crossed = np.flatnonzero(sign[1:] * sign[:-1] < 0)
        found += [brentq(lambda t, of=of: of(np.array([t]))[0], t[i], t[i + 1], xtol=1e-15) for i in crossed]
    return np.asarray(found)


def _unloading(s: np.ndarray) -> dict[str, np.ndarray]:
    return {"recovered_share": s, "stress_share": np.asarray(stress_ratio(jnp.asarray(s)))}


def _refine(
    columns: Callable[[np.ndarray], dict[str, np.ndarray]], tolerance: float, corners: np.ndarray | tuple[()] = ()
) -> tuple[dict, float]:
    """Columns at as few points as the tolerance allows, the first being the abscissa, and their error.

    Points lie evenly from 0 to 1, and on the corners.
    """
    count = MIN_ROWS
    while count <= MAX_ROWS:
        table = columns(np.union1d(np.linspace(0.0, 1.0, count + 1), corners))
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
        f"{MAX_ROWS} points do not describe the curve to {tolerance:g}: it has a corner",
        remedy="Export this law in another format",
    )
