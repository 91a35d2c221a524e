"""Hypotheses at their own optimum: Gauss-Newton in all numbers, hyperparameters at their mode at every step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
import numpy as np

from ..calibrate.fitting import Start
from ..calibrate.noise import Noise
from ..calibrate.population import Population
from ..effects import Variant
from .base import Base, State
from .columns import Design
from .design import NO_EXTRA, ExtraColumns, between, design_of, moved
from .evidence import LinearModel, Optimum, Solution, optimise, spreads_of
from .settings import EARLY

STEPS = 25  # of Gauss-Newton at most
STILL = 0.05  # change of the log posterior at which they end, and by which later ones may make it worse [nats]
WORSE = 5.0  # nats by which each of the `EARLY` first steps may make it worse before half of it is taken back


@dataclass(frozen=True)
class Fitted:
    """A hypothesis at its optimum: evidence and numbers come from the same accepted step."""

    variants: tuple[Variant, ...]
    state: State  # where it is linear, which is where its numbers are
    design: Design
    optimum: Optimum

    @cached_property
    def solution(self) -> Solution:
        """Means of all numbers there."""
        return LinearModel(self.optimum.hyper, self.design).solve()

    @property
    def log_evidence(self) -> float:
        """Log marginal likelihood."""
        return self.optimum.log_evidence

    @property
    def theta(self) -> np.ndarray:
        """Numbers of the effects."""
        return np.asarray(self.state.point.theta[0])

    def start(self, base: Base) -> Start:
        """Where a posterior of the law with these formulas begins: the numbers of this optimum."""
        hyper, population = self.optimum.hyper, np.asarray(self.state.population)
        shift = np.mean(np.log1p(population[0] * base.flatness))
        spreads = spreads_of(hyper[4:8], base.spreads).value
        return Start(
            self.state.point,
            Population(
                *map(jnp.asarray, (population[0], population[1], population[2:] - shift, spreads[:3], spreads[3])),
                *map(jnp.asarray, (0.0, 0.0, self.theta, np.zeros(0))),
            ),
            Noise.from_logs(jnp.asarray(hyper[:4]), jnp.asarray(base.scale)),
        )

    @property
    def curves_um(self) -> np.ndarray:
        """What every formula adds to the displacement of every test, to first order [um]."""
        units = np.array([v.plausible[0] for v in self.variants])
        return self.design.amplitude[..., : len(units)] * (self.theta[: len(units)] / units)


def fit_hypothesis(
    base: Base,
    state: State,
    variants: tuple[Variant, ...],
    numbers: np.ndarray,
    hyper: np.ndarray,
    more: ExtraColumns = NO_EXTRA,
) -> Fitted:
    """The optimum of a hypothesis, from a state of the base law on.

    Args:
        base, state: tests and priors; where particles are.
        variants: the formulas.
        numbers: where the effects' numbers are linearised first: amplitudes of zero and further numbers.
        hyper: hyperparameters to start from.
        more: columns in addition to those of the formulas.
    """
    state, value = state.with_numbers(numbers), -np.inf
    before = state
    design = design_of(base, state, variants, more)
    for k in range(STEPS):
        try:
            optimum = optimise(design, hyper, curvature=False)
        except FloatingPointError:
            if k == 0:
                raise
            optimum = None  # a step beyond arithmetic is as bad as can be
        last = k == STEPS - 1
        # First order from an amplitude of zero promises too much: the first steps may take some of it back. Later a
        # step that makes things worse goes to and fro around the optimum.
        worse = value - (WORSE if k < EARLY else STILL)
        if not last and (optimum is None or optimum.log_joint < worse):
            state, value = between(before, state), -np.inf  # what was linear there is not here
        else:
            if optimum is None or (last and optimum.log_joint < worse):
                state = before
                design = design_of(base, state, variants, more)
                break
            hyper = optimum.hyper
            if last or (k > 1 and abs(optimum.log_joint - value) < STILL):
                break
            before, value = state, optimum.log_joint
            state = moved(base, state, variants, LinearModel(hyper, design).solve())
        design = design_of(base, state, variants, more)
    return Fitted(variants, state, design, optimise(design, hyper))
