"""The master curve, mean and spread of the scaled strain at a given stress, and log-normal C1, C3, C5 from it."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from ... import arguments
from ..._errors import InputError
from ..._format import described
from ...campaign import Adjustment, of_each_particle
from ...law import LogNormal, PlasticPopulation

SMALLEST_SHARE = 1e-6  # of the largest stress: a factor of the quintic is kept at least so large; its logarithm exists
SPREAD_FROM = 5.0  # thresholds from which on the spread of stress is fitted; the paper's threshold is 1 MPa


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
    use = enough(table)
    reached = table.reached[:, use]
    scaled = table.shape_factor(a)[:, None] * table.strain[:, use]
    count = reached.sum(axis=0)
    mean = scaled.sum(axis=0, where=reached) / count
    square = ((scaled - mean) ** 2).sum(axis=0, where=reached)
    sd = np.sqrt(np.where(count > 1, square, np.nan) / np.maximum(count - 1, 1))
    return MasterCurve(table.stress_MPa[use], mean, sd, count)


@dataclass(frozen=True)
class PlasticFit:
    r"""Population of the plastic coefficients.

    Attributes:
        population: log-normal C1, C3, C5.
        polynomial: fitted :math:`E[C_1], E[C_3^3], E[C_5^5]` [MPa].
        variances: fitted :math:`\mathrm{Var}[C_1], \mathrm{Var}[C_3^3], \mathrm{Var}[C_5^5]` [MPa^2].
        rms_MPa: root mean square deviation of the fitted mean from the master curve [MPa].
        at_bound: what ended at its lower bound, such as "C3" or "spread of C3": collapsed estimates, not measurements.
    """

    population: PlasticPopulation
    polynomial: tuple[float, float, float]
    variances: tuple[float, float, float]
    rms_MPa: float
    at_bound: tuple[str, ...]

    __repr__ = described()


def fit_polynomial(strain: np.ndarray, stress_MPa: np.ndarray) -> np.ndarray:
    r"""Least squares for :math:`\sigma = K_1 x - K_3 x^3 + K_5 x^5` with all factors > 0 [MPa], in relative stress.

    Relative, since the scatter between particles grows in proportion to stress: weighing MPa alike lets the few
    particles that reach the highest stress decide all three factors. A factor that would be negative is put at a small
    share of the largest stress.
    """
    from scipy.optimize import nnls  # half a second to import, so only where it is used

    design = np.stack([strain, -(strain**3), strain**5], axis=1) / stress_MPa[:, None]
    # Columns of one size: the three powers differ by orders of magnitude at small strains.
    scale = np.linalg.norm(design, axis=0)
    factors, _ = nnls(design / scale, np.ones_like(stress_MPa))
    smallest = SMALLEST_SHARE * stress_MPa.max() / np.abs(strain).max() ** np.array([1, 3, 5])
    return np.maximum(factors / scale, smallest)


def fit_population(master: MasterCurve, threshold_MPa: float = 0.0) -> PlasticFit:
    r"""Fit the moments of the quintic's factors, then turn them into log-normal parameters.

    The mean curve gives :math:`E[\sigma(x)] = E[C_1] x - E[C_3^3] x^3 + E[C_5^5] x^5` by least squares at the points
    :math:`(\bar\epsilon(\sigma), \sigma)`. The spread of strain is carried over to stress along the curve's slope,
    :math:`s_\sigma = \sigma'(x)\, s_\epsilon`, and gives

    .. math:: s_\sigma^2(x) = \mathrm{Var}[C_1]\, x^2 + \mathrm{Var}[C_3^3]\, x^6 + \mathrm{Var}[C_5^5]\, x^{10}

    by least squares with variances >= 0. Mean and variance of :math:`C_k^k` give
    :math:`\tau^2 = \log(1 + \mathrm{Var}/E^2)/k^2` and :math:`\mu = (\log E - k^2\tau^2/2)/k`.

    A variance that would be negative ends at zero. That is how a spread of log C3 of 4.9e-9, as in the paper, comes
    about: the curve's spread leaves nothing for the middle term. As in the paper, the mean of the strain curves is
    inverted, which is not the mean of the stress curves: with the paper's own scatter C1 comes out about 10 % low.

    Args:
        master: the master curve.
        threshold_MPa: leave out points below this stress [MPa]; there the curve is the straight line of the offset
            step.

    Raises:
        InputError: if fewer than four points are left.

    References:
        Bommireddy et al. (2018), eqs. 16 to 18 and Table 2.
    """
    from scipy.optimize import nnls

    use = (master.stress_MPa >= threshold_MPa) & (master.stress_MPa > 0) & (master.mean > 0)
    x, stress, sd, count = (v[use] for v in (master.mean, master.stress_MPa, master.sd, master.count))
    if len(x) < 4:
        raise InputError(
            "the master curve has fewer than four points of positive strain above the threshold",
            remedy="Check the sign of displacement (positive as the platens approach), or lower the threshold.",
        )
    means = fit_polynomial(x, stress)
    K1, K3, K5 = means
    fitted = K1 * x - K3 * x**3 + K5 * x**5
    variance = ((K1 - 3 * K3 * x**2 + 5 * K5 * x**4) * sd) ** 2
    # The offset step makes all curves meet at the threshold: the spread near it is its doing, not the particles'.
    known = np.isfinite(variance) & (variance > 0) & (count > 1) & (stress >= SPREAD_FROM * threshold_MPa)
    variances = np.zeros(3)
    if known.sum() >= 3:
        # A variance has a standard error in proportion to itself: relative residuals here too.
        design = np.stack([x**2, x**6, x**10], axis=1)[known] / variance[known, None]
        scale = np.linalg.norm(design, axis=0)
        variances = nnls(design / scale, np.ones(int(known.sum())))[0] / scale
    names, orders = ("C1", "C3", "C5"), (1, 3, 5)
    smallest = SMALLEST_SHARE * stress.max() / x.max() ** np.array(orders)
    distributions = (
        LogNormal.from_power_moments(order, jnp.asarray(mean), jnp.asarray(variance))
        for order, mean, variance in zip(orders, means, variances, strict=True)
    )
    return PlasticFit(
        PlasticPopulation(*distributions),
        (float(K1), float(K3), float(K5)),
        (float(variances[0]), float(variances[1]), float(variances[2])),
        float(np.sqrt(np.mean((fitted - stress) ** 2))),
        tuple(n for n, m, low in zip(names, means, smallest, strict=True) if m <= low)
        + tuple(f"spread of {n}" for n, v in zip(names, variances, strict=True) if v == 0),
    )
