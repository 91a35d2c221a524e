"""The master curve: mean and spread of the scaled strain at a given stress."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ... import arguments
from ..._errors import InputError
from ..._format import described
from ...campaign import Adjustment, of_each_particle


@dataclass(frozen=True)
class StrainTable:
    r"""Every kept particle's :math:`\epsilon_i(\sigma)` on one grid of stresses.

    Attributes:
        stress_MPa: the grid [MPa], evenly spaced from 0, shape (G,).
        strain: strains [-], shape (n, G); 0 where a particle did not reach the stress.
        reached: whether it did, shape (n, G).
        flatness: 1 - D3^2 / (D1 D2) of the n particles, shape (n,).
        index: position of the n particles in the campaign, shape (n,).
    """

    stress_MPa: np.ndarray
    strain: np.ndarray
    reached: np.ndarray
    flatness: np.ndarray
    index: np.ndarray

    __repr__ = described()

    def shape_factor(self, a: float) -> np.ndarray:
        """eta_p of the n particles."""
        return 1 + a * self.flatness


def strain_table(adjustment: Adjustment, diameters_um: np.ndarray, points: int = 801) -> StrainTable:
    """Tabulate the kept loading curves by linear interpolation.

    Args:
        adjustment: the curves.
        diameters_um: D1, D2, D3 [um] of all particles, shape (N, 3).
        points: size of the grid.

    Raises:
        ValueError: if no particle is kept.
    """
    arguments.instance(adjustment, Adjustment, "adjustment", "Take mcc_jax.adjust(campaign).")
    diameters_um = arguments.diameters(diameters_um)
    points = arguments.whole(points, "points", least=2)
    index = np.flatnonzero(adjustment.kept)
    if not len(index):
        raise InputError("no particle can be used: " + "; ".join(sorted({r for r in adjustment.why_not if r})))
    curves = [c for c in adjustment.curves if c is not None and c.stress_max_MPa > adjustment.threshold_MPa]
    grid = np.linspace(0.0, max(c.stress_max_MPa for c in curves), points)
    strain = np.stack([c.at(grid) for c in curves])
    reached = ~np.isnan(strain)
    flatness = of_each_particle(diameters_um[index], lambda p: p.flatness)
    return StrainTable(grid, np.where(reached, strain, 0.0), reached, flatness, index)


@dataclass(frozen=True)
class MasterCurve:
    r"""Normal distribution of the master strain at a given stress.

    .. math::
        \bar\epsilon(\sigma) = \frac{1}{\#S_\sigma} \sum_{i \in S_\sigma} \eta_{p,i}\, \epsilon_i(\sigma), \qquad
        s^2_\epsilon(\sigma) = \frac{1}{\#S_\sigma - 1} \sum_{i \in S_\sigma}
            \left[\eta_{p,i}\, \epsilon_i(\sigma) - \bar\epsilon(\sigma)\right]^2

    Attributes:
        stress_MPa: stresses [MPa], up to the largest that more than N/5 particles reach, shape (G,).
        mean: mean master strain [-].
        sd: its sample standard deviation; NaN where a single particle is left.
        count: number of particles that reach the stress.

    References:
        Bommireddy et al. (2018), eqs. 11 and 12.
    """

    stress_MPa: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    count: np.ndarray

    __repr__ = described()


def enough(table: StrainTable) -> np.ndarray:
    """Where on the grid more than N/5 of the particles reach the stress, booleans of shape (G,)."""
    return table.reached.sum(axis=0) > len(table.index) / 5


def master_curve(table: StrainTable, a: float) -> MasterCurve:
    """Mean and standard deviation of the master strain for a shape parameter `a`."""
    arguments.instance(table, StrainTable, "table", "Take mcc_jax.calibrate.strain_table(adjustment, diameters_um).")
    a = arguments.number(a, "the shape parameter a")
    use = enough(table)
    reached = table.reached[:, use]
    scaled = table.shape_factor(a)[:, None] * table.strain[:, use]
    count = reached.sum(axis=0)
    mean = scaled.sum(axis=0, where=reached) / count
    square = ((scaled - mean) ** 2).sum(axis=0, where=reached)
    sd = np.sqrt(np.where(count > 1, square, np.nan) / np.maximum(count - 1, 1))
    return MasterCurve(table.stress_MPa[use], mean, sd, count)
