"""Golden tables: paths with force and tangent, against which an implementation in any engine is checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import arguments
from .._errors import InputError
from .._types import Scalar
from ..dem import HalfContact, half_contact, pair_force, pair_recovery, wall_force, wall_recovery
from ..geometry import Particle
from ..law import TESTED_STRAIN, MccLaw
from .origin import checked
from .tables import Table

RANDOM_PATHS = 8
STEPS = 40
SMALL = np.array([1e-6, 1e-4, 3e-3, 1e-2, 2e-2, 5e-2])
"""Peaks of the last path over the largest displacement: there the recovered strain leaves its limit for its formula."""
# Shares of the recoverable displacement on the way down; 1 itself is left out, where a tangent is all rounding.
SHARES = np.array([1e-9, 1e-3, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 0.9999, 1.001, 1.5])
OTHER_SIZE = 0.6
UNITS: tuple[Literal["um_mN", "SI"], ...] = ("um_mN", "SI")
_SI = {"displacement": ("um", "m", 1e-6), "force": ("mN", "N", 1e-3), "tangent": ("mN_per_um", "N_per_m", 1e3)}


def golden_table(law: MccLaw, particle: Particle, *, seed: int = 0, units: Literal["um_mN", "SI"] = "um_mN") -> Table:
    """Paths of one particle between two platens with the law's force and tangent.

    The first path loads, releases, reloads and overtakes its peak, up to a scaled strain of 0.67, with points close to
    every place where branches meet; the last unloads from small peaks; the others are random, by the seed.

    Returns:
        A pandas table with a column `path`, 0 for the first, and displacement, largest displacement so far, force and
        tangent, the unit in the column's name. Every path starts from a virgin particle. Of a law with effects that are
        no closed formula: path, time (a second from point to point), displacement and force.
    """
    checked(law, particle)
    seed, units = arguments.seed(seed), arguments.choice(units, UNITS, "units")
    try:
        side = half_contact(law, particle)
    except InputError:  # no closed formula: point by point, as `mcc_jax.drive`
        return _in_units(_driven(law, particle, seed), units)
    rows = _contact_rows(side, None, seed)
    rows[["displacement", "displacement_max"]] *= 2  # half of it at each platen
    rows["tangent"] *= 0.5
    return _in_units(rows, units)


def golden_pair_table(
    law: MccLaw, particle: Particle, *, seed: int = 0, units: Literal["um_mN", "SI"] = "um_mN"
) -> Table:
    """Paths of the overlap of two half contacts: with itself, with one of 0.6 times the size, and with a rigid wall.

    Both sides carry one force; see `dem.pair_force`. Columns as of `golden_table`, and `partner`: `equal`, `smaller`,
    `wall`. Where the law is not monotone a pair has several answers, and the table holds one of them.
    """
    import pandas as pd

    checked(law, particle)
    seed, units = arguments.seed(seed), arguments.choice(units, UNITS, "units")
    smaller = jax.tree.map(lambda d: d * OTHER_SIZE, particle)
    side = half_contact(law, particle)
    partners = {"equal": side, "smaller": half_contact(law, smaller), "wall": None}
    tables = [_contact_rows(side, other, seed).assign(partner=name) for name, other in partners.items()]
    return _in_units(pd.concat(tables, ignore_index=True), units)


def _contact_rows(side: HalfContact, other: HalfContact | None, seed: int) -> Table:
    """Paths of the overlap of a pair, or with a rigid wall [um, mN]."""
    import pandas as pd

    scale = float(side.tested) if other is None else 2 * min(float(side.tested), float(other.tested))

    def recovered(peak: np.ndarray) -> np.ndarray:
        return np.asarray(_recovered_overlap(side, other, jnp.atleast_1d(peak))).reshape(np.shape(peak))

    paths = _paths(scale, recovered, seed)
    number = np.repeat(np.arange(len(paths)), [len(path) for path in paths])
    x, past = np.concatenate(paths), np.concatenate([np.maximum.accumulate(np.maximum(path, 0.0)) for path in paths])
    force, tangent = (np.asarray(v) for v in _contact(side, other, jnp.asarray(past), jnp.asarray(x)))
    columns = {"path": number, "displacement": 1e6 * x, "displacement_max": 1e6 * past}
    return pd.DataFrame(columns | {"force": 1e3 * force, "tangent": 1e-3 * tangent})


def _driven(law: MccLaw, particle: Particle, seed: int) -> Table:
    """Paths of a law whose effects have a memory, a second from point to point."""
    import pandas as pd

    scale = TESTED_STRAIN * float(particle.effective_diameter / law.shape_factor(particle))

    def recovered(peak: np.ndarray) -> np.ndarray:
        return np.asarray(particle.displacement(law.recoverable_strain(particle, particle.strain(jnp.asarray(peak)))))

    paths = _paths(scale, recovered, seed)
    length = np.array([len(path) for path in paths])
    number, second = np.nonzero(np.arange(length.max()) < length[:, None])
    x = np.array([np.pad(path, (0, length.max() - len(path)), "edge") for path in paths])  # so it compiles once
    along = eqx.filter_vmap(lambda x, time: law.path(particle, law.init(particle), x, time)[1], in_axes=(0, None))
    force = np.asarray(eqx.filter_jit(along)(jnp.asarray(x), jnp.arange(float(length.max()))))
    columns = {"path": number, "time_s": second, "displacement": x[number, second], "force": force[number, second]}
    return pd.DataFrame(columns)


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
    peak = loading[-1]
    down = peak - recovered(np.asarray(peak)) * SHARES
    further = np.linspace(peak, scale, 9)
    end = scale - recovered(np.asarray(scale)) * SHARES
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


def _in_units(table: Table, units: str) -> Table:
    columns = {name: name for name in ("partner", "path", "time_s") if name in table}
    for name in table.columns.difference(list(columns), sort=False):
        ours, si, factor = _SI[name.removesuffix("_max")]
        columns[name] = f"{name}_{si if units == 'SI' else ours}"
        table[name] *= factor if units == "SI" else 1.0
    return table.reindex(columns=list(columns)).rename(columns=columns)
