"""Effects that differ from test to test: a drift of each test's own, and sudden steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.special import betaln, expit, logsumexp

from ..calibrate.compiling import compiled
from ..calibrate.data import Tests
from ..calibrate.forward import Linear
from ..calibrate.noise import whitening
from ..calibrate.priors import NakagamiPrior
from ..effects import Variant
from .base import Base, State
from .candidates import Candidate
from .design import More, design_of
from .evidence import Design, Optimum, Solution, optimise, scales_of, solve
from .screen import single_integrals
from .settings import DECISIONS, NUMERICS

SPREAD = NakagamiPrior(1.0, shape=0.25)
"""Prior of a spread over the tests in units of the largest plausible one, open in its order of magnitude."""


@dataclass(frozen=True)
class Jump:
    """A sudden step in a test.

    Attributes:
        particle: in which one, in the order of the tests that took part.
        stress_MPa: at what stress.
        size, sd: how large, in the formula's unit.
        probability: that there is one in this test.
    """

    particle: int
    stress_MPa: float
    size: float
    sd: float
    probability: float


@dataclass(frozen=True)
class OwnNumbers:
    """A hypothesis of numbers that each test has of its own.

    Attributes:
        variant, nuisance: the formula and its further numbers.
        log_evidence: log marginal likelihood.
        design, optimum, solution: at its optimum.
        jumps: sudden steps, if it is about these.
    """

    variant: Variant
    nuisance: dict[str, float]
    log_evidence: float
    design: Design
    optimum: Optimum
    solution: Solution
    jumps: tuple[Jump, ...] = ()


def differing(
    base: Base, state: State, free: np.ndarray, columns: Array, candidates: Sequence[Candidate]
) -> OwnNumbers | None:
    """An amplitude that scatters around a common one, over all formulas of a mechanism; None if none does.

    Args:
        base: the tests.
        state: where the base law fits.
        free: its hyperparameters.
        columns: signatures of the formulas in units of their smallest plausible amplitudes.
        candidates: the formulas.
    """
    values: dict[str, list[float]] = {}
    best = None
    for k, c in enumerate(candidates):
        if not c.variant.random_per_test:
            continue
        ratio = c.variant.plausible[1] / c.variant.plausible[0]
        column = columns[..., k : k + 1]
        more = More(ratio * column, (SPREAD,), column, (ratio,), (0,))
        design = design_of(base, state, (), more)
        optimum = optimise(design, np.append(free, 1.0), curvature=False)
        values.setdefault(c.variant.name, []).append(optimum.log_joint)
        if best is None or optimum.log_joint > best[0].log_joint:
            best = optimum, c, design
    if best is None:
        return None
    optimum, c, design = best
    curved = optimise(design, optimum.free)
    each = [logsumexp(v) - np.log(len(v)) for v in values.values()]
    total = float(logsumexp(each) - np.log(len(each))) + curved.log_evidence - optimum.log_joint
    solution = solve(jnp.asarray(curved.free), design)
    return OwnNumbers(c.variant, dict(c.nuisance), total, design, curved, solution)


@compiled
def step_scores(free: Array, design: Design, common: Array) -> tuple[Array, Array]:
    """Score and information of a step of 1 um at every point, each particle's own numbers integrated out."""
    noise, own, _ = scales_of(free, design)
    kinds = design.kinds
    points = design.data.shape[-1]
    residual = design.data - jnp.einsum("npc,c->np", design.common, common)

    def one(scale: Array, tests: Tests, linear: Linear, columns: Array, residual: Array) -> tuple[Array, Array]:
        filtered = whitening(noise, scale, tests, linear, kinds.correlation, kinds.along)
        steps = jnp.where(tests.mask[:, None], jnp.tril(jnp.ones((points, points))), 0.0)
        white = filtered(jnp.concatenate([columns * own[None], steps, residual[:, None]], -1))
        o = columns.shape[-1]
        root = jnp.linalg.cholesky(white[:, :o].T @ white[:, :o] + jnp.eye(o))
        half = jax.scipy.linalg.solve_triangular(root, white[:, :o].T @ white[:, o:], lower=True)
        score = white[:, o:-1].T @ white[:, -1] - half[:, :-1].T @ half[:, -1]
        return score, jnp.sum(white[:, o:-1] ** 2, 0) - jnp.sum(half[:, :-1] ** 2, 0)

    return jax.vmap(one)(design.scale, design.tests, design.linear, design.own, residual)


def sudden_steps(base: Base, state: State, free: np.ndarray, variant: Variant) -> OwnNumbers | None:
    """Sudden steps in some tests, found one after the other: at most `Numerics.jumps` in each.

    A test has one with a probability that is itself unknown, uniformly; it may be at any point of its loading.

    Args:
        base: the tests.
        state: where the base law fits.
        free: its hyperparameters.
        variant: the formula.
    """
    N, P = np.asarray(base.tests.mask).shape
    loading, mask = np.asarray(base.tests.loading & base.tests.mask), np.asarray(base.tests.mask)
    low, high = variant.plausible
    unit = high / 3
    columns = np.zeros((N, P, 0))
    found: list[Step] = []
    at, best = free, None
    for turn in range(NUMERICS.jumps + 1):
        more = More(jnp.asarray(columns) if turn else None, (SPREAD,) * turn)
        design = design_of(base, state, (), more)
        if turn:
            optimum = optimise(design, np.concatenate([free, np.ones(turn)]), curvature=False)
            value = optimum.log_joint + _log_prior_of_steps(found, loading)
            if best is not None and value <= best.log_evidence:
                break
            at = optimum.free
            solution = solve(jnp.asarray(at), design)
            jumps = _jumps(base, found, unit * np.asarray(solution.own)[:, 5:])
            best = OwnNumbers(variant, {}, float(value), design, optimum, solution, jumps)
        if turn == NUMERICS.jumps:
            break
        s = solve(jnp.asarray(at), design)
        score, information = map(np.asarray, step_scores(jnp.asarray(at), design, s.common))
        new, added = np.zeros((N, P, 1)), False
        for i in range(N):
            rows = np.flatnonzero(loading[i])[1:]
            if not len(rows):
                continue
            ones = np.ones(len(rows))
            each, _ = single_integrals(low * score[i, rows], low**2 * information[i, rows], ones, ones * high / low)
            if logsumexp(each) - np.log(len(rows)) > np.log((1 - DECISIONS.jump) / DECISIONS.jump):
                j = int(rows[int(np.argmax(each))])
                new[i, j:, 0] = np.where(mask[i, j:], unit, 0.0)
                found.append(Step(i, j, turn, float(max(information[i, j], 1e-300) ** -0.5)))
                added = True
        if not added:
            break
        columns = np.concatenate([columns, new], -1)
    return best


class Step(NamedTuple):
    """A step that was found: in which test, from which point on, in which turn, and its standard error [um]."""

    test: int
    point: int
    turn: int
    sd: float


def _log_prior_of_steps(found: Sequence[Step], loading: np.ndarray) -> float:
    """Log prior of which tests have steps, how many, and where."""
    N, k = len(loading), len({step.test for step in found})
    places = sum(np.log(max(loading[step.test].sum(), 1)) for step in found)
    several = (len(found) - k) * np.log(0.5)
    return float(betaln(k + 1, N - k + 1) + several - places)


def _jumps(base: Base, found: Sequence[Step], sizes: np.ndarray) -> tuple[Jump, ...]:
    """The steps with their sizes, those of a turn in the turn's column."""
    force, diameter = np.asarray(base.tests.force), np.asarray(base.tests.effective_diameter)
    told = []
    for step in found:
        i = step.test
        stress = 1e3 * force[i, step.point] / (np.pi * diameter[i] ** 2 / 4)
        size = float(sizes[i, step.turn])
        if size > 0:
            probability = float(expit((size / step.sd) ** 2 / 2 - np.log(len(force[i]))))
            told.append(Jump(i, float(stress), size, step.sd, probability))
    return tuple(told)
