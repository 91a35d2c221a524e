"""From a compaction curve back to the parameters of the particles."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from .. import arguments
from .._errors import InputError
from .._format import described
from .load_steps import TOP, LoadStep, Solver, replay_stacked, stacked
from .quasistatic import Compaction, compact
from .sensitivity import PackingOf
from .state import State

ROUNDS = 5


class CompactionFit(NamedTuple):
    """Parameters fitted to a compaction curve.

    Attributes:
        values: the parameters.
        compaction: rows of the compaction with them.
        misfit: root mean square of force minus measured force, over the largest measured force [-].
        rounds: compactions made anew on the way.
        converged: whether the last round no longer changed the parameters and every row is in equilibrium.
    """

    values: np.ndarray
    compaction: Compaction
    misfit: float
    rounds: int
    converged: bool

    __repr__ = described()


def fit_compaction(
    packing_of: PackingOf,
    start: Any,
    state: State,
    heights: Any,
    force: Any,
    *,
    solver: Solver | None = None,
    tolerance: float = 1e-7,
) -> CompactionFit:
    r"""Parameters whose compaction curve comes closest to a measured one, by Levenberg-Marquardt.

    .. math:: \min_\theta \sum_r \left(\frac{F_r(\theta) - F_r}{\max F}\right)^2

    with the sensitivities of the load steps. Within a round the load steps are those of a compaction at the round's
    start (`replay_compaction`); then the compaction is made anew, because contacts may snap elsewhere, until the
    parameters stay. Take logarithms of positive parameters. What a curve does not show it cannot give: the modulus
    needs rows of unloading.

    Args:
        packing_of: the packing as a function of the parameters; traced by JAX.
        start: where to start.
        state: where the compaction starts.
        heights: of the top punch [m].
        force: on the top punch there [N].
        solver: as for `compact`.
        tolerance: of the parameters, relative and absolute.

    Raises:
        InputError: as `compact`; if heights and forces are not equally many, or fewer than the parameters.
    """
    solver = solver or Solver()
    tolerance = arguments.number(tolerance, "tolerance", above=0)
    values = arguments.path(start, "start")
    measured = arguments.floats(force, "force", shape="the force on the top punch [N] at every height")
    if (
        measured.ndim != 1
        or measured.shape != np.shape(heights)
        or len(measured) < len(values)
        or not np.isfinite(measured).all()
    ):
        raise InputError(
            f"{measured.size} forces for {len(np.atleast_1d(heights))} heights and {len(values)} parameters",
            remedy="One finite force for each height, and no fewer than parameters.",
        )
    if not measured.max() > 0:
        raise InputError("a compaction curve without a positive force", remedy="Forces are in newtons.")
    target, settled, rounds = jnp.asarray(measured), False, 0
    while not settled and rounds < ROUNDS:
        tape: list[LoadStep] = []
        compact(packing_of(values), state, heights, solver, tape)
        before, rounds = values, rounds + 1
        values = _least_squares(packing_of, values, state, stacked(tape), target, solver, tolerance)
        settled = bool(jnp.all(jnp.abs(values - before) <= 10 * tolerance * (1 + jnp.abs(values))))
    _, rows = compact(packing_of(values), state, heights, solver)
    misfit = float(np.sqrt(np.mean(((rows.top - measured) / measured.max()) ** 2)))
    return CompactionFit(np.asarray(values), rows, misfit, rounds, settled and bool(rows.converged.all()))


@eqx.filter_jit
def _least_squares(
    packing_of: PackingOf, start: Array, state: State, steps: LoadStep, target: Array, solver: Solver, tolerance: float
) -> Array:
    ends = jnp.nonzero(steps.last, size=len(target))[0]

    def residuals(values: Array, _: None) -> Array:
        replayed = replay_stacked(packing_of(values), state, steps, solver)
        return (replayed.on_wall[ends, TOP] - target) / jnp.max(target)

    method = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
    return optx.least_squares(residuals, method, start, max_steps=64, throw=False).value
