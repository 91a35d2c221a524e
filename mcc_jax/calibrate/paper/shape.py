"""The shape parameter `a`: the value under which the particles' curves collapse on one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ... import arguments
from ..._errors import InputError
from ..._format import described
from ..._types import Scalar
from ..settings import PAPER
from ..sharding import filled_rows
from .loading import StrainTable, enough

Objective = Literal["full", "reference"]


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


def full_residuals(
    a: Scalar,
    strain: Float[Array, "particles grid"],
    weights: Float[Array, "particles grid"],
    reached: Bool[Array, "particles grid"],
    flatness: Float[Array, " particles"],
) -> Float[Array, "particles grid"]:
    r"""Residuals whose sum of squares is the paper's full objective.

    .. math:: \sum_i \frac{\int \left[\bar\epsilon(\sigma) - \eta_{p,i} \epsilon_i(\sigma)\right]^2 d\sigma}
        {\int \bar\epsilon(\sigma)^2 d\sigma}, \qquad \bar\epsilon = \frac{1}{\#S_\sigma}\sum_{j\in S_\sigma}
        \eta_{p,j}\epsilon_j

    References:
        Bommireddy et al. (2018), eq. 14.
    """
    scaled = (1 + a * flatness)[:, None] * strain
    count = jnp.sum(reached, axis=0)
    mean = jnp.sum(jnp.where(reached, scaled, 0.0), axis=0) / jnp.maximum(count, 1).astype(strain.dtype)
    norm = jnp.sum(weights * mean[None, :] ** 2, axis=1)
    return jnp.where(reached, mean[None, :] - scaled, 0.0) * (jnp.sqrt(weights) / jnp.sqrt(norm)[:, None])


def reference_residuals(
    a: Scalar,
    strain: Float[Array, "particles grid"],
    weights: Float[Array, "particles grid"],
    reference_strain: Float[Array, " grid"],
    flatness: Float[Array, " particles"],
    reference_flatness: Scalar,
) -> Float[Array, "particles grid"]:
    r"""Residuals whose sum of squares is the paper's objective with a reference particle N.

    .. math:: \sum_{i \ne N} \frac{\int \left[\epsilon_N(\sigma) - \frac{\eta_{p,i}}{\eta_{p,N}}
    \epsilon_i(\sigma)\right]^2 d\sigma}
        {\int \epsilon_N(\sigma)^2 d\sigma}

    References:
        Bommireddy et al. (2018), eq. 15.
    """
    ratio = (1 + a * flatness) / (1 + a * reference_flatness)
    norm = jnp.sum(weights * reference_strain[None, :] ** 2, axis=1)
    deviation = reference_strain[None, :] - ratio[:, None] * strain
    return deviation * (jnp.sqrt(weights) / jnp.sqrt(norm)[:, None])


def choose_reference(table: StrainTable) -> int:
    """The paper's rule: D3^2/(D1 D2) close to 1, among the half of the particles compressed to the highest stress.

    Returns:
        Row of the table (not position in the campaign).
    """
    arguments.instance(table, StrainTable, "table", "Take mcc_jax.calibrate.strain_table(adjustment, diameters_um).")
    top = table.reached.sum(axis=1)
    high = top >= np.median(top)
    return int(np.argmin(np.where(high, np.abs(table.flatness), np.inf)))


@partial(jax.jit, static_argnums=0)
def _solve(residuals, starts: Float[Array, " starts"], data: tuple[Array, ...]):
    """Levenberg-Marquardt from every start at once, on exact Jacobians."""
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)

    def from_start(start):
        solution = optx.least_squares(
            lambda a, args: residuals(a, *args), solver, start, args=data, max_steps=200, throw=False
        )
        return (
            solution.value,
            jnp.sum(residuals(solution.value, *data) ** 2),
            solution.result == optx.RESULTS.successful,
        )

    return jax.vmap(from_start)(starts), jnp.sum(residuals(jnp.zeros_like(starts[0]), *data) ** 2)


def fit_shape_parameter(table: StrainTable, objective: Objective = "full", reference: int | None = None) -> ShapeFit:
    """Fit `a` by the full objective or by the one with a reference particle.

    Args:
        table: strains on a common grid of stresses.
        objective: "full" (eq. 14) or "reference" (eq. 15, the paper's own simplification).
        reference: position in the campaign of the reference particle; by the paper's rule (`choose_reference`) if None.

    Returns:
        The best of several starts; a fit that fails is returned with its reason.

    Raises:
        ValueError: for fewer than two particles, or a reference that was not kept.

    References:
        Bommireddy et al. (2018), eqs. 13 to 15.
    """
    arguments.instance(table, StrainTable, "table", "Take mcc_jax.calibrate.strain_table(adjustment, diameters_um).")
    arguments.choice(objective, get_args(Objective), "objective")
    if len(table.index) < 2:
        raise InputError("the shape parameter needs at least two particles")
    stress, strain, flatness = table.stress_MPa, table.strain, table.flatness
    reached = table.reached & enough(table)
    # Particles are filled up to few numbers, and the grid keeps its length, so that campaigns share one compilation: it
    # takes seconds, the fit none.
    fill = filled_rows(len(strain))
    extra = np.arange(len(fill)) >= len(strain)
    starts = jnp.asarray(PAPER.shape_starts, dtype=float)
    if objective == "full":
        row = None
        # Copies reach no stress, so that none counts.
        data = (strain[fill], _weights(stress, reached)[fill], reached[fill] & ~extra[:, None], flatness[fill])
        solved, at_zero = _solve(full_residuals, starts, tuple(jnp.asarray(d) for d in data))
    else:
        if reference is None:
            row = choose_reference(table)
        elif reference in table.index:
            row = int(np.flatnonzero(table.index == reference)[0])
        else:
            raise InputError("the reference particle was not kept")
        # The reference particle itself, and copies of it, deviate from it by nothing, whatever `a`.
        fill = np.where(extra, row, fill)
        weights = _weights(stress, reached[fill] & reached[row])
        data = (strain[fill], weights, strain[row], flatness[fill], flatness[row])
        solved, at_zero = _solve(reference_residuals, starts, tuple(jnp.asarray(d, dtype=float) for d in data))
    values, costs, converged = (np.asarray(x) for x in solved)
    # A shape factor that is not positive turns the particle inside out; such a minimum is none.
    valid = np.isfinite(costs) & ((1 + values[:, None] * table.flatness) > 0).all(axis=1)
    identifiable = bool(np.ptp(table.flatness) > 1e-9)
    if not valid.any():
        reason = (
            "every minimum found makes some shape factor negative; the curves do not collapse under this shape factor"
        )
        return ShapeFit(0.0, float(at_zero), float(at_zero), objective, None, False, reason, identifiable)
    best = int(np.argmin(np.where(valid, costs, np.inf)))
    reason = "" if converged[best] else "the optimiser did not meet its tolerances within 200 steps"
    if not identifiable:
        reason = "all particles have the same D3^2/(D1 D2), so the curves do not tell the shape parameter"
    return ShapeFit(
        float(values[best]),
        float(costs[best]),
        float(at_zero),
        objective,
        None if row is None else int(table.index[row]),
        bool(converged[best]) and identifiable,
        reason,
        identifiable,
    )
