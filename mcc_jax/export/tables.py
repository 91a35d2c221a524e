"""The law as tables: master curves for linear interpolation, and golden paths that any implementation is checked by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array

from .. import arguments
from .._errors import InputError
from .._format import described
from .._numerics import compiled_whole
from .._types import Scalar
from ..dem import HalfContact, half_contact, pair_force, pair_recovery, wall_force, wall_recovery
from ..formulas import Contact
from ..formulas.contact import SHARE
from ..geometry import Particle
from ..law import TESTED_STRAIN, MccLaw, stress_ratio
from ..law.response import folded
from .origin import check

Columns = dict[str, np.ndarray]
TOLERANCE = 1e-5  # largest error of linear interpolation, as a share of each column's largest value
MIN_ROWS, MAX_ROWS = 64, 65536
BETWEEN = 8  # points at which an interval is checked
CORNERS = 4096  # intervals in which a corner is looked for

Units = Literal["um_mN", "SI"]
UNITS = {
    "um_mN": {"displacement": ("um", 1e6), "force": ("mN", 1e3), "tangent": ("mN_per_um", 1e-3)},
    "SI": {"displacement": ("m", 1.0), "force": ("N", 1.0), "tangent": ("N_per_m", 1.0)},
}
RANDOM_PATHS, STEPS = 8, 40
SMALL = np.array([1e-6, 1e-4, 3e-3, 1e-2, 2e-2, 5e-2])
"""Peaks of the last path over the largest displacement: there the recovered strain leaves its limit for its formula."""
# Shares of the recoverable displacement on the way down; 1 itself is left out, where a tangent is all rounding.
SHARES = np.array([1e-9, 1e-3, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 0.9999, 1.001, 1.5])
OTHER_SIZE = 0.6


@dataclass(frozen=True)
class CurveTables:
    """The law as tables for linear interpolation.

    Attributes:
        loading: `scaled_strain` (eta_p eps), `stress_MPa`, `tangent_MPa` (d stress / d scaled strain),
            `recovered_strain_at_eta_1`, the strain that a particle of shape factor 1 recovers from there, and
            `recovered_strain_formula_at_eta_1`, the same without its limit. `master_curve.json` of `write_export` has
            the rule for other shape factors.
        unloading: `recovered_share` s and `stress_share` g(s) of the peak stress.
        error: largest error of linear interpolation, as a share of each column's largest value.
    """

    loading: pd.DataFrame
    unloading: pd.DataFrame
    error: float

    __repr__ = described()


def curve_tables(law: MccLaw, particle: Particle) -> CurveTables:
    """Tables of the master curves of a law, right to 1e-5, up to the largest scaled strain of the paper's tests.

    With effects they hold for `particle` alone; without effects for all, whose size and shape come in through the
    scaled strain. `InputError` if 65536 points do not suffice, or naming an effect that is no closed formula.
    """
    check(law, particle)
    formulas, _ = folded(law, law.effects, particle, "the tables")
    side = half_contact(law, particle) if law.effects else None
    n, k = law.unloading.stress_power, law.unloading.constant
    plain = Contact(*formulas.plastic.polynomial, 1 / (k * formulas.effective_modulus**n), power=n)

    def curves(t: np.ndarray) -> tuple[np.ndarray, ...]:
        """Scaled strain, secant and tangent [MPa], recovered strain by the formula, and its limit."""
        x, contact = TESTED_STRAIN * t**3, plain
        if side is not None:
            ratio = side.at_peak(jnp.asarray(side.tested / TESTED_STRAIN * x)).c / side.c
            contact = eqx.tree_at(lambda one: one.c, contact, contact.c * ratio)
        return x, *map(np.asarray, _curves(contact, jnp.asarray(x)))

    def loading(t: np.ndarray) -> Columns:
        x, secant, tangent, formula, limit = curves(t)
        return {
            "scaled_strain": x,
            "stress_MPa": x * secant,
            "tangent_MPa": np.where(secant > 0, tangent, 0.0),
            "recovered_strain_at_eta_1": np.minimum(formula, limit),
            "recovered_strain_formula_at_eta_1": formula,
        }

    def unloading(t: np.ndarray) -> Columns:
        s = 1 - (1 - t) ** 2
        return {"recovered_share": s, "stress_share": np.asarray(stress_ratio(jnp.asarray(s)))}

    up, one = _refined(loading, _corners(curves))
    down, other = _refined(unloading, [])
    return CurveTables(pd.DataFrame(up), pd.DataFrame(down), max(one, other))


@compiled_whole
def _curves(contact: Contact, x: Array) -> tuple[Array, Array, Array, Array]:
    top, bottom, _ = contact.limit(x)
    return contact.secant(x), contact.tangent(x), jnp.sqrt(contact.formula_squared(x)), top / bottom


def _corners(curves: Callable[[np.ndarray], tuple[np.ndarray, ...]]) -> list[float]:
    """Where the recovered strain bends sharply, as t: its limit begins to hold, or ends to."""
    from scipy.optimize import brentq

    def gaps(t: np.ndarray) -> np.ndarray:
        _, secant, tangent, formula, limit = curves(t)
        return np.stack([formula - limit, tangent - SHARE * secant])

    t, found = np.linspace(0.0, 1.0, CORNERS + 1), []
    for k, sign in enumerate(np.sign(gaps(t))):
        for i in np.flatnonzero(sign[1:] * sign[:-1] < 0):
            found += [brentq(lambda t, k=k: gaps(np.array([t]))[k, 0], t[i], t[i + 1], xtol=1e-15)]
    return found


def _refined(columns: Callable[[np.ndarray], Columns], corners: list[float]) -> tuple[Columns, float]:
    """Columns, the abscissa first, at as few even points and the corners as the tolerance allows; and their error."""
    count = MIN_ROWS
    while count <= MAX_ROWS:
        table = columns(np.union1d(np.linspace(0.0, 1.0, count + 1), corners))
        finer = columns(np.linspace(0.0, 1.0, BETWEEN * count + 1))
        x, *_ = table
        error = max(
            np.abs(np.interp(finer[x], table[x], table[name]) - finer[name]).max() / np.abs(finer[name]).max()
            for name in table
        )
        if error <= TOLERANCE:
            return table, float(error)
        count *= 2
    problem = f"{MAX_ROWS} points do not describe the curve to {TOLERANCE:g}: it has a corner"
    raise InputError(problem, remedy="Export this law in another format")


def golden_table(law: MccLaw, particle: Particle, *, seed: int = 0, units: Units = "um_mN") -> pd.DataFrame:
    """Paths of one particle between two platens with the law's force and tangent.

    The first path loads, releases, reloads and overtakes its peak, up to a scaled strain of 0.67, with points close to
    every place where branches meet; the last unloads from small peaks; the others are random, by the seed. Every path
    starts from a virgin particle. The columns are path, displacement, largest displacement so far, force and tangent;
    of a law with effects that are no closed formula path, time, displacement and force.
    """
    check(law, particle)
    seed = arguments.seed(seed)
    try:
        side = half_contact(law, particle)
    except InputError:  # no closed formula: point by point, as `mcc_jax.drive`
        return _in_units(_driven(law, particle, seed), units)
    columns = _of_contact(side, None, seed)
    half = {"displacement": 2.0, "displacement_max": 2.0, "force": 1.0, "tangent": 0.5}  # of it at each platen
    return _in_units({name: half.get(name, 1) * values for name, values in columns.items()}, units)


def golden_pair_table(law: MccLaw, particle: Particle, *, seed: int = 0, units: Units = "um_mN") -> pd.DataFrame:
    """Paths of the overlap of two half contacts: with itself, with one of 0.6 times the size, and with a rigid wall.

    Both sides carry one force; see `dem.pair_force`. Columns as of `golden_table`, and `partner`: `equal`, `smaller`,
    `wall`. Where the law is not monotone a pair has several answers, and the table holds one of them.
    """
    check(law, particle)
    seed = arguments.seed(seed)
    side = half_contact(law, particle)
    smaller = half_contact(law, jax.tree.map(lambda d: d * OTHER_SIZE, particle))
    partners = {"equal": side, "smaller": smaller, "wall": None}
    tables = {name: _in_units(_of_contact(side, other, seed), units) for name, other in partners.items()}
    return pd.concat(tables, names=["partner"]).reset_index(level="partner").reset_index(drop=True)


def _of_contact(side: HalfContact, other: HalfContact | None, seed: int) -> Columns:
    """Paths of the overlap of a pair, or with a rigid wall, in SI units."""
    scale = float(side.tested) if other is None else 2 * min(float(side.tested), float(other.tested))
    paths = _paths(scale, lambda peak: np.asarray(_recovered_overlap(side, other, jnp.asarray(peak))), seed)
    number = np.repeat(np.arange(len(paths)), [len(path) for path in paths])
    x, past = np.concatenate(paths), np.concatenate([np.maximum.accumulate(np.maximum(path, 0.0)) for path in paths])
    force, tangent = (np.asarray(v) for v in _contact(side, other, jnp.asarray(past), jnp.asarray(x)))
    return {"path": number, "displacement": x, "displacement_max": past, "force": force, "tangent": tangent}


def _driven(law: MccLaw, particle: Particle, seed: int) -> Columns:
    """Paths of a law whose effects have a memory, a second from point to point, in SI units."""
    scale = TESTED_STRAIN * float(particle.effective_diameter / law.shape_factor(particle))

    def recovered(peak: np.ndarray) -> np.ndarray:
        return np.asarray(particle.displacement(law.recoverable_strain(particle, particle.strain(jnp.asarray(peak)))))

    paths = _paths(scale, recovered, seed)
    length = np.array([len(path) for path in paths])
    number, second = np.nonzero(np.arange(length.max()) < length[:, None])
    x = np.array([np.pad(path, (0, length.max() - len(path)), "edge") for path in paths])  # so it compiles once
    along = eqx.filter_vmap(lambda x, time: law.path(particle, law.init(particle), x, time)[1], in_axes=(0, None))
    force = np.asarray(eqx.filter_jit(along)(jnp.asarray(x), jnp.arange(float(length.max()))))[number, second]
    return {"path": number, "time_s": second, "displacement": 1e-6 * x[number, second], "force": 1e-3 * force}


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, None, 0))
def _recovered_overlap(side: HalfContact, other: HalfContact | None, peak: Scalar) -> Scalar:
    """Overlap recovered on full release [m]."""
    return wall_recovery(side, peak) if other is None else pair_recovery(side, other, peak)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, None, 0, 0))
def _contact(side: HalfContact, other: HalfContact | None, peak: Scalar, overlap: Scalar) -> tuple[Scalar, Scalar]:
    """Force [N] and tangent [N/m] of a pair, or with a rigid wall."""

    def force(overlap: Scalar) -> Scalar:
        return wall_force(side, peak, overlap) if other is None else pair_force(side, other, peak, overlap)

    return jax.value_and_grad(force)(overlap)


def _paths(scale: float, recovered: Callable[[np.ndarray], np.ndarray], seed: int) -> list[np.ndarray]:
    """A path that meets every branch, some at random, one of small peaks; the largest displacement is `scale`."""
    loading = np.linspace(0.0, 0.6 * scale, 13)
    peaks = np.array([loading[-1], scale])
    down, end = peaks[:, None] - recovered(peaks)[:, None] * SHARES
    further = np.linspace(peaks[0], scale, 9)
    first = np.concatenate([[-0.01 * scale], loading, down, [-0.01 * scale], down[::-1], further, end, end[::-1]])
    rng = np.random.default_rng(seed)
    walks = []
    for _ in range(RANDOM_PATHS):
        peaks = np.maximum.accumulate(scale * rng.uniform(0.0, 1.0, STEPS) ** 2)
        depth = np.where(rng.uniform(size=STEPS) < 0.5, 0.0, rng.uniform(0.0, 1.2, STEPS))
        walks.append(peaks - depth * recovered(peaks))
    small = scale * SMALL
    turns = small[:, None] - recovered(small)[:, None] * np.concatenate([[0.0], SHARES])
    return [first, *walks, turns.ravel()]


def _in_units(columns: Columns, units: Units) -> pd.DataFrame:
    """A table of columns in SI units, in the units wanted, which are then part of the names."""
    wanted = UNITS[arguments.choice(units, UNITS, "units")]
    named = {}
    for name, values in columns.items():
        if quantity := wanted.get(name.removesuffix("_max")):
            unit, factor = quantity
            named[f"{name}_{unit}"] = factor * values
        else:  # path, time_s
            named[name] = values
    return pd.DataFrame(named)
