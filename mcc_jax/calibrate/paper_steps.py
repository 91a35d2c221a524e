r"""The steps of Bommireddy et al. (2018), sections 3 to 6, one by one; equations are numbered as there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from .. import arguments
from .._errors import InputError
from .._format import described
from ..campaign import Adjustment, Campaign, Segment, of_each_particle, stress_and_strain
from ..formulas import recovery
from ..law import LogNormal, PlasticPopulation, StrainScaling, Unloading
from .data import UNLOADED_FROM

# ---- master curve ----------------------------------------------------------------------------------------------------

GRID_POINTS = 801  # stresses at which curves are compared; no source


@dataclass(frozen=True)
class StrainTable:
    r"""Every kept particle's :math:`\epsilon_i(\sigma)` on one grid of stresses."""

    stress_MPa: np.ndarray  # the grid [MPa], evenly spaced from 0, shape (G,)
    strain: np.ndarray  # strains [-], shape (n, G); 0 where a particle did not reach the stress
    reached: np.ndarray  # whether it did, shape (n, G)
    flatness: np.ndarray  # 1 - D3^2 / (D1 D2) of the n particles, shape (n,)
    index: np.ndarray  # position of the n particles in the campaign, shape (n,)

    __repr__ = described()

    def shape_factor(self, a: float) -> np.ndarray:
        """eta_p of the n particles."""
        return 1 + a * self.flatness

    @property
    def enough(self) -> np.ndarray:
        """Where on the grid more than N/5 of the particles reach the stress, booleans of shape (G,)."""
        return self.reached.sum(axis=0) > len(self.index) / 5


def strain_table(adjustment: Adjustment, diameters_um: np.ndarray) -> StrainTable:
    """Tabulate the kept loading curves by linear interpolation on `GRID_POINTS` stresses; `diameters_um` are D1, D2, D3
    [um] of all particles, shape (N, 3)."""
    diameters_um = arguments.diameters(diameters_um)
    index = np.flatnonzero(adjustment.kept)
    curves = [c for c in adjustment.curves if c is not None and c.stress_max_MPa > adjustment.threshold_MPa]
    grid = np.linspace(0.0, max(c.stress_max_MPa for c in curves), GRID_POINTS)
    strain = np.stack([c.at(grid) for c in curves])
    reached = ~np.isnan(strain)
    flatness = of_each_particle(diameters_um[index], lambda p: p.flatness)
    return StrainTable(grid, np.where(reached, strain, 0.0), reached, flatness, index)


@dataclass(frozen=True)
class MasterCurve:
    r"""Normal distribution of the master strain at a given stress (eqs. 11 and 12).

    .. math::
        \bar\epsilon(\sigma) = \frac{1}{\#S_\sigma} \sum_{i \in S_\sigma} \eta_{p,i}\, \epsilon_i(\sigma), \qquad
        s^2_\epsilon(\sigma) = \frac{1}{\#S_\sigma - 1} \sum_{i \in S_\sigma}
            \left[\eta_{p,i}\, \epsilon_i(\sigma) - \bar\epsilon(\sigma)\right]^2
    """

    stress_MPa: np.ndarray  # stresses [MPa], up to the largest that more than N/5 particles reach, shape (G,)
    mean: np.ndarray  # mean master strain [-]
    sd: np.ndarray  # its sample standard deviation; NaN where a single particle is left
    count: np.ndarray  # number of particles that reach the stress

    __repr__ = described()


def master_curve(table: StrainTable, a: float) -> MasterCurve:
    """Mean and standard deviation of the master strain for a shape parameter `a`."""
    use = table.enough
    reached = table.reached[:, use]
    scaled = table.shape_factor(a)[:, None] * table.strain[:, use]
    count = reached.sum(axis=0)
    mean = scaled.sum(axis=0, where=reached) / count
    square = ((scaled - mean) ** 2).sum(axis=0, where=reached)
    sd = np.sqrt(np.where(count > 1, square, np.nan) / np.maximum(count - 1, 1))
    return MasterCurve(table.stress_MPa[use], mean, sd, count)


# ---- shape parameter -------------------------------------------------------------------------------------------------

Objective = Literal["full", "reference"]
# Minima are bracketed by so many values of `a`, up to shape factors far beyond any particle's. No source: a ratio of
# quadratics changes over steps of 1 over the flatness, 20 times as long.
GRID, FAR = 2000, 100.0


@dataclass(frozen=True)
class ShapeFit:
    """A fitted shape parameter."""

    a: float  # the parameter [-]
    objective: float  # sum of squared relative deviations at `a`
    objective_at_zero: float  # the same with no shape factor (a = 0), for comparison
    reference: int | None  # position in the campaign of the reference particle; None for the full objective
    reason: str  # why there is no minimum, in words; empty if there is one

    __repr__ = described()


def integration_weights(stress: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Trapezoidal weights of the integral over the reached part of the grid, per particle."""
    weights = np.where(reached, stress[1] - stress[0], 0.0)
    weights[:, 0] /= 2
    last = reached & ~np.pad(reached[:, 1:], ((0, 0), (0, 1)))
    return np.where(last, weights / 2, weights)


# Of every particle the coefficients of 1, a and a^2 above and below the line, each of shape (3, particles).
Quadratics = tuple[np.ndarray, np.ndarray]


def _square(weights: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Integral of (x + a y)^2 over the grid, as coefficients of 1, a and a^2."""
    return np.stack([np.sum(weights * product, -1) for product in (x * x, 2 * x * y, y * y)])


def full_objective(table: StrainTable) -> Quadratics:
    r"""The paper's full objective (eq. 14): of every particle a ratio of two quadratics in `a`.

    .. math:: \sum_i \frac{\int \left[\bar\epsilon(\sigma) - \eta_{p,i} \epsilon_i(\sigma)\right]^2 d\sigma}
        {\int \bar\epsilon(\sigma)^2 d\sigma}, \qquad \bar\epsilon = \frac{1}{\#S_\sigma}\sum_{j\in S_\sigma}
        \eta_{p,j}\epsilon_j
    """
    reached = table.reached & table.enough
    weights = integration_weights(table.stress_MPa, reached)
    parts = table.strain, table.flatness[:, None] * table.strain
    means = [np.sum(part, 0, where=reached) / np.maximum(reached.sum(0), 1) for part in parts]
    away = [np.where(reached, mean - part, 0.0) for mean, part in zip(means, parts, strict=True)]
    return _square(weights, *away), _square(weights, *means)


def reference_objective(table: StrainTable, row: int) -> Quadratics:
    r"""The paper's objective with a reference particle N (eq. 15), in the row-th place.

    .. math:: \sum_{i \ne N} \frac{\int \left[\epsilon_N(\sigma) - \frac{\eta_{p,i}}{\eta_{p,N}}
    \epsilon_i(\sigma)\right]^2 d\sigma}
        {\int \epsilon_N(\sigma)^2 d\sigma}
    """
    reached = table.reached & table.enough
    weights = integration_weights(table.stress_MPa, reached & reached[row])
    parts = table.strain, table.flatness[:, None] * table.strain
    return _square(weights, *(x[row] - x for x in parts)), _square(weights, *(x[row] for x in parts))


def objective_at(a: Any, quadratics: Quadratics) -> Any:
    """An objective at one value of `a`, or at many."""
    above, below = (polyval(a, coefficients) for coefficients in quadratics)
    return np.sum(above / below, 0)


def _slope_at(a: Any, quadratics: Quadratics) -> Any:
    (above, below), (up, down) = ([polyval(a, f(c)) for c in quadratics] for f in (np.asarray, polyder))
    return np.sum((up * below - above * down) / below**2, 0)


def choose_reference(table: StrainTable) -> int:
    """Row of the table of the paper's reference particle: D3^2/(D1 D2) close to 1, among the half of the particles
    compressed to the highest stress."""
    top = table.reached.sum(axis=1)
    high = top >= np.median(top)
    return int(np.argmin(np.where(high, np.abs(table.flatness), np.inf)))


def fit_shape_parameter(table: StrainTable, objective: Objective = "full", reference: int | None = None) -> ShapeFit:
    """Fit `a`, the value under which the particles' curves collapse on one (eqs. 13 to 15).

    Args:
        table: strains on a common grid of stresses, of two particles at least.
        objective: "full" (eq. 14) or "reference" (eq. 15, the paper's own simplification).
        reference: position in the campaign of the reference particle; by the paper's rule (`choose_reference`) if None.
    """
    from scipy.optimize import brentq  # half a second to import, so only where it is used

    arguments.choice(objective, get_args(Objective), "objective")
    if len(table.index) < 2:
        raise InputError("the shape parameter needs at least two particles")
    flatness = table.flatness
    if objective == "full":
        reference, quadratics = None, full_objective(table)
    else:
        row = choose_reference(table) if reference is None else int(np.flatnonzero(table.index == reference)[0])
        reference, quadratics = int(table.index[row]), reference_objective(table, row)
    # A shape factor that is not positive turns the particle inside out; such a minimum is none.
    most, least, far = flatness.max(), flatness.min(), FAR / max(np.abs(flatness).max(), 1e-9)
    grid = np.linspace(-1 / most if most > 0 else -far, -1 / least if least < 0 else far, GRID + 2)[1:-1]
    slope = _slope_at(grid, quadratics)
    minima = [
        float(cast(Any, brentq)(_slope_at, *grid[k : k + 2], args=(quadratics,), xtol=1e-12))
        for k in np.flatnonzero((slope[:-1] < 0) & (slope[1:] >= 0))
    ]
    reason = ""
    if np.ptp(flatness) <= 1e-9:
        minima = []
        reason = "all particles have the same D3^2/(D1 D2), so the curves do not determine the shape parameter"
    elif not minima:
        reason = "no minimum has positive shape factors of all particles; the curves do not collapse under this factor"
    a = min(minima, key=lambda a: objective_at(a, quadratics), default=0.0)
    at, at_zero = (float(objective_at(value, quadratics)) for value in (a, 0.0))
    return ShapeFit(a, at, at_zero, reference, reason)


# ---- plastic coefficients --------------------------------------------------------------------------------------------

SMALLEST_SHARE = 1e-6  # of the largest stress: a factor of the quintic is kept at least so large; its logarithm exists
SPREAD_FROM = 5.0  # thresholds from which on the spread of stress is fitted; the paper's threshold is 1 MPa


@dataclass(frozen=True)
class PlasticFit:
    r"""Population of the plastic coefficients."""

    population: PlasticPopulation  # log-normal C1, C3, C5
    polynomial: tuple[float, float, float]  # fitted E[C_1], E[C_3^3], E[C_5^5] [MPa]
    rms_MPa: float  # root mean square deviation of the fitted mean from the master curve [MPa]
    # what ended at its lower bound, such as "C3" or "spread of C3": collapsed estimates, not measurements
    at_bound: tuple[str, ...]

    __repr__ = described()


def fit_polynomial(strain: np.ndarray, stress_MPa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Least squares for :math:`\sigma = K_1 x - K_3 x^3 + K_5 x^5` with all factors > 0 [MPa], in relative stress; the
    factors, and which of them ended at their lower bound, a small share of the largest stress.

    Relative, since the scatter between particles grows in proportion to stress: weighing MPa alike lets the few
    particles that reach the highest stress decide all three factors.
    """
    design = np.stack([strain, -(strain**3), strain**5], axis=1) / stress_MPa[:, None]
    smallest = SMALLEST_SHARE * stress_MPa.max() / np.abs(strain).max() ** np.array([1, 3, 5])
    factors = np.maximum(_positive_least_squares(design), smallest)
    return factors, factors <= smallest


def _positive_least_squares(design: np.ndarray) -> np.ndarray:
    """Factors >= 0 with which the columns add up to 1."""
    from scipy.optimize import nnls  # half a second to import, so only where it is used

    # Columns of one size: powers of strain differ by orders of magnitude at small strains.
    scale = np.linalg.norm(design, axis=0)
    return nnls(design / scale, np.ones(len(design)))[0] / scale


def fit_population(master: MasterCurve, threshold_MPa: float = 0.0) -> PlasticFit:
    r"""Fit the moments of the quintic's factors, then turn them into log-normal parameters (eqs. 16 to 18, Table 2).

    The mean curve gives :math:`E[\sigma(x)] = E[C_1] x - E[C_3^3] x^3 + E[C_5^5] x^5` by least squares at the points
    :math:`(\bar\epsilon(\sigma), \sigma)`. The spread of strain is carried over to stress along the curve's slope,
    :math:`s_\sigma = \sigma'(x)\, s_\epsilon`, and gives

    .. math:: s_\sigma^2(x) = \mathrm{Var}[C_1]\, x^2 + \mathrm{Var}[C_3^3]\, x^6 + \mathrm{Var}[C_5^5]\, x^{10}

    by least squares with variances >= 0. Mean and variance of :math:`C_k^k` give
    :math:`\tau^2 = \log(1 + \mathrm{Var}/E^2)/k^2` and :math:`\mu = (\log E - k^2\tau^2/2)/k`.

    A variance that would be negative ends at zero. That is how a spread of log C3 of 4.9e-9, as in the paper, comes
    about: the curve's spread leaves nothing for the middle term. As in the paper, the mean of the strain curves is
    inverted, which is not the mean of the stress curves: with the paper's own scatter C1 comes out about 10 % low.

    Points below the threshold are left out; there the curve is the straight line of the offset step. Raises
    `InputError` if fewer than four points are left.
    """
    use = (master.stress_MPa >= threshold_MPa) & (master.stress_MPa > 0) & (master.mean > 0)
    x, stress, sd, count = (v[use] for v in (master.mean, master.stress_MPa, master.sd, master.count))
    if len(x) < 4:
        problem = "the master curve has fewer than four points of positive strain above the threshold"
        remedy = "Check the sign of displacement (positive as the platens approach), or lower the threshold."
        raise InputError(problem, remedy=remedy)
    means, low = fit_polynomial(x, stress)
    K1, K3, K5 = means
    variance = ((K1 - 3 * K3 * x**2 + 5 * K5 * x**4) * sd) ** 2
    # The offset step makes all curves meet at the threshold: the spread near it is its doing, not the particles'.
    known = np.isfinite(variance) & (variance > 0) & (count > 1) & (stress >= SPREAD_FROM * threshold_MPa)
    variances = np.zeros(3)
    if known.sum() >= 3:
        # A variance has a standard error in proportion to itself: relative residuals here too.
        variances = _positive_least_squares(np.stack([x**2, x**6, x**10], axis=1)[known] / variance[known, None])
    distributions = (
        LogNormal.from_power_moments(order, jnp.asarray(mean), jnp.asarray(variance))
        for order, mean, variance in zip((1, 3, 5), means, variances, strict=True)
    )
    names = ("C1", "C3", "C5", "spread of C1", "spread of C3", "spread of C5")
    return PlasticFit(
        PlasticPopulation(*distributions),
        (float(K1), float(K3), float(K5)),
        float(np.sqrt(np.mean((K1 * x - K3 * x**3 + K5 * x**5 - stress) ** 2))),
        tuple(n for n, bound in zip(names, (*low, *(variances == 0)), strict=True) if bound),
    )


# ---- effective modulus -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ElasticBranch:
    """One elastic branch: unloading from a peak and, if any, the reloading that follows, up to virgin loading."""

    particle: int  # position of the particle in the campaign
    strain_max: float  # epsilon_P [-], with the offset step applied
    stress_max_MPa: float  # sigma_P [MPa]
    strain: np.ndarray  # strains along the branch [-], shape (n,)
    stress_MPa: np.ndarray  # stresses along it [MPa], shape (n,)

    __repr__ = described()


@dataclass(frozen=True)
class ElasticFit:
    """A fitted effective modulus."""

    effective_modulus_MPa: float | None  # the modulus shared by all particles [MPa]; None if no branch could be used
    rms_strain: float  # root mean square residual [-]
    per_branch_MPa: np.ndarray  # the modulus that each branch alone would give [MPa]
    branches: tuple[ElasticBranch, ...]  # the branches used
    # recovered over recoverable strain along every branch [-], its free zero taken off
    recovered: tuple[np.ndarray, ...]
    reason: str  # why there is no modulus, in words; empty if there is one

    __repr__ = described()


def campaign_branches(campaign: Campaign, adjustment: Adjustment) -> list[ElasticBranch]:
    """The elastic branches of every particle that the offset step kept, in its adjusted strain: five points at least
    between `UNLOADED_FROM` and the peak."""
    found = []
    for i in np.flatnonzero(adjustment.kept).tolist():
        curve, segments = campaign.curves[i], adjustment.segments[i]
        stress, strain = stress_and_strain(curve, campaign.diameters_um[i], segments)
        strain = strain + adjustment.shift[i]
        for peak, rows in _elastic_segments(segments):
            # The samples on both sides of the turning point: noise would make their maximum alone too large. One
            # whose force was worked out has no such neighbour.
            around = np.arange(max(peak - 1, 0), peak + 1)
            if curve.worked_out[around].any():
                around = around[curve.worked_out[around]]
            top, deepest = float(stress[around].mean()), float(strain[around].max())
            rows = rows[curve.compared[rows] & (stress[rows] > UNLOADED_FROM * top) & (stress[rows] <= top)]
            if len(rows) >= 5 and deepest > 0 and top > 0:
                found.append(ElasticBranch(i, deepest, top, strain[rows], stress[rows]))
    return found


def _elastic_segments(segments: tuple[Segment, ...]) -> list[tuple[int, np.ndarray]]:
    """Peak and rows of every unloading, together with the reloading that follows, from virgin loading."""
    found: list[tuple[int, list[np.ndarray]]] = []
    virgin = False
    for segment in segments:
        if segment.kind == "load":
            virgin = True
        elif segment.kind in ("unload", "reload") and (virgin or found):
            if virgin:
                found.append((segment.start, []))
            virgin = False
            found[-1][1].append(np.arange(segment.start, segment.stop))
    return [(peak, np.concatenate(rows)) for peak, rows in found]


def fit_effective_modulus(
    branches: Sequence[ElasticBranch],
    shape_factor: np.ndarray,
    unloading: Unloading = Unloading.PRINTED,
    strain_scaling: StrainScaling = StrainScaling.RAW,
) -> ElasticFit:
    r"""Fit one effective modulus to all elastic branches (eqs. 23 and 24).

    .. math:: \min_{\bar E,\, o_b} \sum_{b,k} \left[\epsilon_{bk} - o_b
        + \delta_b(\bar E)\, s(\sigma_{bk}/\sigma_{P,b})\right]^2

    with the recoverable strain :math:`\delta_b` of the chosen form at the measured peak, and a free zero :math:`o_b`
    per branch, so that neither the loading law nor the contact point enters.

    The modulus belongs to the form of unloading. `shape_factor` is eta_p of every particle of the campaign, shape (N,);
    it enters unless the scaling is raw.
    """
    branches = tuple(branches)
    if not branches:
        return ElasticFit(None, np.nan, np.empty(0), (), (), "no unloading branch was measured")
    # Recoverable strain from the measured peak, whatever the loading law, at a modulus of 1 MPa. Strain is linear in
    # c = E^(-1/2) of the printed form, E^-1 of a punch.
    top, deepest = np.array([(b.stress_max_MPa, b.strain_max) for b in branches]).T
    shape = shape_factor[[b.particle for b in branches]] ** strain_scaling.power
    if unloading is Unloading.PRINTED:
        recoverable, power = np.sqrt(top / (unloading.constant * shape * deepest)), -2
    else:
        recoverable, power = top / np.sqrt(unloading.constant * shape * deepest), -1
    released = _released(branches)
    # The free zero of a branch is its mean.
    strain = [b.strain - b.strain.mean() for b in branches]
    slope = [r * (s.mean() - s) for r, s in zip(recoverable, released, strict=True)]
    products = np.array([(x @ y, x @ x) for x, y in zip(slope, strain, strict=True)])
    own, c = products[:, 0] / products[:, 1], products[:, 0].sum() / products[:, 1].sum()
    alone = np.where(own > 0, own, np.nan) ** power
    if not c > 0:
        return ElasticFit(None, np.nan, alone, branches, (), "strain does not fall on unloading")
    residual = np.concatenate(strain) - c * np.concatenate(slope)
    recovered = tuple(s.mean() - x / (c * r) for s, x, r in zip(released, strain, recoverable, strict=True))
    return ElasticFit(float(c**power), float(np.sqrt(np.mean(residual**2))), alone, branches, recovered, "")


def _released(branches: Sequence[ElasticBranch]) -> list[np.ndarray]:
    """Recovered share of strain at the measured stresses of each branch."""
    ratio = np.concatenate([b.stress_MPa / b.stress_max_MPa for b in branches])
    # Padded to a power of two: every new length would be compiled again.
    padded = np.pad(ratio, (0, (1 << (len(ratio) - 1).bit_length()) - len(ratio)))
    released = np.asarray(_recovery(jnp.asarray(padded)))[: len(ratio)]
    return np.split(released, np.cumsum([len(b.strain) for b in branches])[:-1])


_recovery = jax.jit(recovery)
