"""Hypotheses at their own optimum: Gauss-Newton in all numbers, hyperparameters at their mode at every step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from mcc_jax.effects import Variant

from .design import Base, State, design_of, moved
from .evidence import Design, Optimum, Solution, optimise, solve

STEPS, STILL = 6, 0.05


@dataclass(frozen=True)
class Refined:
    """A hypothesis at its optimum."""

    variants: tuple[Variant, ...]
    state: State
    design: Design
    optimum: Optimum
    solution: Solution

    @property
    def log_evidence(self) -> float:
        return self.optimum.log_evidence

    @property
    def theta(self) -> np.ndarray:
        return np.asarray(self.state.point.theta[0])


def with_numbers(state: State, numbers: np.ndarray) -> State:
    N = len(state.point.zero)
    return State(replace(state.point, theta=jnp.asarray(np.broadcast_to(numbers, (N, len(numbers))))), state.population)


def refined(
    base: Base,
    state: State,
    variants: tuple[Variant, ...],
    numbers: np.ndarray,
    free: np.ndarray,
    *,
    steps: int = STEPS,
) -> Refined:
    """The optimum of a hypothesis, from a state of the base law on.

    Args:
        base: tests and priors.
        state: where particles are.
        variants: the formulas.
        numbers: where the effects' numbers are linearised first: amplitudes of zero and further numbers.
        free: hyperparameters to start from.
    """
    state = with_numbers(state, numbers)
    before, value = None, -np.inf
    for k in range(steps):
        design = design_of(base, state, variants)
        optimum = optimise(design, free, curvature=False)
        solution = solve(jnp.asarray(optimum.free), design)
        if before is not None and optimum.log_joint < value - 5.0 and k < steps - 1:
            # What was linear there is not here: half the way back.
            state = _between(before, state)
            value = -np.inf
            continue
        free = optimum.free
        still = abs(optimum.log_joint - value) < STILL and k > 1
        if still or k == steps - 1:
            break
        before, value = state, optimum.log_joint
        state = moved(base, state, variants, solution, 1.0)
    optimum = optimise(design, free)
    return Refined(variants, state, design, optimum, solve(jnp.asarray(optimum.free), design))


def _between(a: State, b: State) -> State:
    return jax.tree.map(lambda x, y: 0.5 * (x + y), a, b)
