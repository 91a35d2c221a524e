"""The shape parameter `a`: the value under which the particles' curves collapse on one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from ... import arguments
from ..._errors import InputError
from ..._format import described
from .loading import StrainTable, enough

Objective = Literal["full", "reference"]
GRID, FAR = 2000, 100.0
"""Minima are bracketed by so many values of `a`, up to shape factors far beyond any particle's. No source: a ratio of
quadratics changes over steps of 1 over the flatness, 20 times as long."""


@dataclass(frozen=True)
class ShapeFit:
    """A fitted shape parameter.

    Attributes:
        a: the parameter [-].
        objective: sum of squared relative deviations at `a`.
        objective_at_zero: the same with no shape factor (a = 0), for comparison.
        kind: which objective was minimised.
        reference: position in the campaign of the reference particle; None for the full objective.
        converged: whether the optimiser met its tolerances from the best start.
        reason: why not, in words; empty if converged.
        identifiable: False if all particles have the same D3^2/(D1 D2): then `a` only rescales the material.
    """

    a: float
    objective: float
    objective_at_zero: float
    kind: Objective
    reference: int | None
    converged: bool
    reason: str
    identifiable: bool

    __repr__ = described()


def _weights(stress: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Trapezoidal weights of the integral over the reached part of the grid, per particle."""
    step = stress[1] - stress[0]
    last = reached & ~np.pad(reached[:, 1:], ((0, 0), (0, 1)))
    weights = np.where(reached, step, 0.0)
    weights[:, 0] /= 2
    return np.where(last, weights / 2, weights)


Quadratics = tuple[np.ndarray, np.ndarray]
"""Of every particle the coefficients of 1, a and a^2 above and below the line, each of shape (3, particles)."""


def _square(weights: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Integral of (x + a y)^2 over the grid, as coefficients of 1, a and a^2."""
    return np.stack([np.sum(weights * product, -1) for product in (x * x, 2 * x * y, y * y)])


def full_objective(strain: np.ndarray, weights: np.ndarray, reached: np.ndarray, flatness: np.ndarray) -> Quadratics:
    r"""The paper's full objective: of every particle a ratio of two quadratics in `a`.

    .. math:: \sum_i \frac{\int \left[\bar\epsilon(\sigma) - \eta_{p,i} \epsilon_i(\sigma)\right]^2 d\sigma}
        {\int \bar\epsilon(\sigma)^2 d\sigma}, \qquad \bar\epsilon = \frac{1}{\#S_\sigma}\sum_{j\in S_\sigma}
        \eta_{p,j}\epsilon_j

    References:
        Bommireddy et al. (2018), eq. 14.
    """
    parts = strain, flatness[:, None] * strain
    means = [np.sum(part, 0, where=reached) / np.maximum(reached.sum(0), 1) for part in parts]
    away = [np.where(reached, mean - part, 0.0) for mean, part in zip(means, parts, strict=True)]
    return _square(weights, *away), _square(weights, *means)


def reference_objective(strain: np.ndarray, weights: np.ndarray, flatness: np.ndarray, row: int) -> Quadratics:
    r"""The paper's objective with a reference particle N, in the row-th place.

    .. math:: \sum_{i \ne N} \frac{\int \left[\epsilon_N(\sigma) - \frac{\eta_{p,i}}{\eta_{p,N}}
    \epsilon_i(\sigma)\right]^2 d\sigma}
        {\int \epsilon_N(\sigma)^2 d\sigma}

    References:
        Bommireddy et al. (2018), eq. 15.
    """
    parts = strain, flatness[:, None] * strain
    scaled = strain[row], flatness[row] * strain[row]
    return _square(weights, *(x[row] - x for x in parts)), _square(weights, *scaled)


def objective_at(a: Any, quadratics: Quadratics) -> Any:
    """An objective at one value of `a`, or at many."""
    above, below = (polyval(a, coefficients) for coefficients in quadratics)
    return np.sum(above / below, 0)


def _slope_at(a: Any, quadratics: Quadratics) -> Any:
    (above, below), (up, down) = ([polyval(a, f(c)) for c in quadratics] for f in (np.asarray, polyder))
    return np.sum((up * below - above * down) / below**2, 0)


def choose_reference(table: StrainTable) -> int:
    """The paper's rule: D3^2/(D1 D2) close to 1, among the half of the particles compressed to the highest stress.

    Returns:
        Row of the table (not position in the campaign).
    """
    top = table.reached.sum(axis=1)
    high = top >= np.median(top)
    return int(np.argmin(np.where(high, np.abs(table.flatness), np.inf)))


def fit_shape_parameter(table: StrainTable, objective: Objective = "full", reference: int | None = None) -> ShapeFit:
    """Fit `a` by the full objective or by the one with a reference particle.

    Args:
        table: strains on a common grid of stresses.
        objective: "full" (eq. 14) or "reference" (eq. 15, the paper's own simplification).
        reference: position in the campaign of the reference particle; by the paper's rule (`choose_reference`) if None.

    Returns:
        The lowest minimum; a fit that fails is returned with its reason.

    Raises:
        ValueError: for fewer than two particles, or a reference that was not kept.

    References:
        Bommireddy et al. (2018), eqs. 13 to 15.
    """
    arguments.choice(objective, get_args(Objective), "objective")
    from scipy.optimize import brentq  # half a second to import, so only where it is used

    if len(table.index) < 2:
        raise InputError("the shape parameter needs at least two particles")
    stress, strain, flatness = table.stress_MPa, table.strain, table.flatness
    reached = table.reached & enough(table)
    row = None
    if objective == "full":
        quadratics = full_objective(strain, _weights(stress, reached), reached, flatness)
    else:
        if reference is None:
            row = choose_reference(table)
        elif reference in table.index:
            row = int(np.flatnonzero(table.index == reference)[0])
        else:
            raise InputError("the reference particle was not kept")
        quadratics = reference_objective(strain, _weights(stress, reached & reached[row]), flatness, row)
    identifiable = bool(np.ptp(flatness) > 1e-9)
    # A shape factor that is not positive turns the particle inside out; such a minimum is none.
    most, least, far = flatness.max(), flatness.min(), FAR / max(np.abs(flatness).max(), 1e-9)
    grid = np.linspace(-1 / most if most > 0 else -far, -1 / least if least < 0 else far, GRID + 2)[1:-1]
    slope = _slope_at(grid, quadratics)
    minima = [
        float(cast(Any, brentq)(_slope_at, *grid[k : k + 2], args=(quadratics,), xtol=1e-12))
        for k in np.flatnonzero((slope[:-1] < 0) & (slope[1:] >= 0) & identifiable)
    ]
    a, reason = min(minima, key=lambda a: objective_at(a, quadratics), default=0.0), ""
    if not minima:
        reason = (
            "no minimum has positive shape factors of all particles; the curves do not collapse under this shape factor"
        )
    if not identifiable:
        reason = "all particles have the same D3^2/(D1 D2), so the curves do not determine the shape parameter"
    at, at_zero = (float(objective_at(value, quadratics)) for value in (a, 0.0))
    kept = None if row is None else int(table.index[row])
    return ShapeFit(a, at, at_zero, objective, kept, not reason, reason, identifiable)
