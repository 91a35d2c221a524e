"""Effects that differ from test to test: a drift of each test's own, and sudden steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import betaln, expit, logsumexp

from ..calibrate.priors import NakagamiPrior
from ..effects import Variant
from .base import Base, State
from .candidates import Candidate
from .columns import Columns, Design
from .design import More, design_of, linear_at
from .evidence import Optimum, log_joint, optimise, scales_of, solve, with_little_noise
from .refine import Refined, refined
from .screen import single_integrals
from .settings import DECISIONS, HYPERPARAMETERS

SPREAD = NakagamiPrior(1.0, shape=0.25)
"""Prior of a spread over the tests in units of the largest plausible one, open in its order of magnitude."""

DRIFTS = 6  # drifts of every test's own that are fitted at their own optimum
MOST_STEPS = 3  # sudden ones of one test


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
    """A hypothesis of numbers that each test has of its own, with a formula that all tests share beside them or none.

    Attributes:
        variant, nuisance: the formula and its further numbers.
        log_evidence: log marginal likelihood.
        at: the hypothesis at its optimum.
        more: columns of its own numbers.
        jumps: sudden steps, if it is about these.
    """

    variant: Variant
    nuisance: dict[str, float]
    log_evidence: float
    at: Refined
    more: More
    jumps: tuple[Jump, ...] = ()

    @property
    def curve_um(self) -> np.ndarray:
        """What its own numbers add to every test [um]."""
        solution, K = self.at.solution, len(self.at.variants)
        own = np.einsum("npo,no->np", self.at.design.own[..., 5:], solution.own[:, 5:])
        return own + self.at.design.amplitude[..., K:] @ solution.amplitude[K:]

    def beside(
        self, base: Base, state: State, variants: tuple[Variant, ...], numbers: np.ndarray, free: np.ndarray
    ) -> OwnNumbers:
        """The same numbers with a formula beside them, at its optimum."""
        spreads = self.at.optimum.free[HYPERPARAMETERS : HYPERPARAMETERS + len(self.more.own_spreads)]
        at = refined(base, state, variants, numbers, np.concatenate([free, spreads]), self.more)
        return replace(self, at=at, log_evidence=at.log_evidence + self.of_choices)

    @property
    def of_choices(self) -> float:
        """What having chosen a formula, its further numbers or places of steps costs in log evidence."""
        return self.log_evidence - self.at.log_evidence


def solved(design: Design, optimum: Optimum, start: Refined) -> Refined:
    """A design at its optimum, linear where another hypothesis is."""
    return Refined(start.variants, start.state, design, optimum, solve(optimum.free, design))


def differing(base: Base, start: Refined, columns: np.ndarray, candidates: Sequence[Candidate]) -> OwnNumbers | None:
    """An amplitude that scatters around a common one, over all formulas of a mechanism; None if none does.

    Args:
        base: the tests.
        start: the hypothesis beside which they are: the base law, or one with a formula.
        columns: signatures of the formulas in units of their smallest plausible amplitudes.
        candidates: the formulas.
    """
    free = np.append(start.optimum.free, 1.0)
    linear = linear_at(base, start.state, start.variants)
    tried: list[tuple[float, np.ndarray, Candidate, Design, More]] = []
    for k, c in enumerate(candidates):
        if not c.variant.random_per_test:
            continue
        ratio = c.variant.plausible[1] / c.variant.plausible[0]
        column = columns[..., k : k + 1]
        more = More(ratio * column, (SPREAD,), column, (ratio,), (0,))
        design = design_of(base, start.state, start.variants, more, linear)
        value, at = max(
            ((log_joint(x, design), x) for x in (free, with_little_noise(free))),
            key=lambda one: one[0],
        )
        tried.append((value, at, c, design, more))
    if not tried:
        return None
    tried.sort(key=lambda one: -one[0])
    values: dict[str, list[float]] = {}
    best: tuple[Optimum, Candidate, Design, More] | None = None
    for turn, (value, at, c, design, more) in enumerate(tried):
        if turn < DRIFTS:
            optimum = optimise(design, at, curvature=False)
            value = optimum.log_joint
            if best is None or value > best[0].log_joint:
                best = optimum, c, design, more
        values.setdefault(c.variant.name, []).append(value)
    assert best is not None
    optimum, c, design, more = best
    if optimum.log_joint > start.optimum.log_joint:
        # Numbers of its own may be as large as anything else: what was linear without them is not with them.
        at = refined(base, start.state, start.variants, start.theta, optimum.free, more)
    else:
        at = solved(design, optimise(design, optimum.free), start)
    each = [logsumexp(v) - np.log(len(v)) for v in values.values()]
    total = float(logsumexp(each) - np.log(len(each))) + at.log_evidence - optimum.log_joint
    return OwnNumbers(c.variant, dict(c.nuisance), total, at, more)


def step_scores(now: Refined) -> tuple[np.ndarray, np.ndarray]:
    """Score and information of a step of 1 um at every point, each particle's own numbers integrated out."""
    design, free = now.design, now.optimum.free
    _, P, o = design.own.shape
    own, _ = scales_of(free, design)
    residual = design.data - design.common @ now.solution.common - design.amplitude @ now.solution.amplitude
    steps = np.where(np.asarray(design.tests.mask)[..., None], np.tril(np.ones((P, P))), 0.0)
    white = Columns(np.concatenate([design.own * own, steps, residual[..., None]], -1), design).white(free).columns
    turned = np.swapaxes(white[..., :o], 1, 2)
    root = np.linalg.cholesky(turned @ white[..., :o] + np.eye(o))
    half = np.linalg.solve(root, turned @ white[..., o:])
    score = np.einsum("npk,np->nk", white[..., o:-1], white[..., -1]) - np.einsum(
        "nok,no->nk", half[..., :-1], half[..., -1]
    )
    return score, np.sum(white[..., o:-1] ** 2, 1) - np.sum(half[..., :-1] ** 2, 1)


def sudden_steps(base: Base, start: Refined, variant: Variant) -> OwnNumbers | None:
    """Sudden steps in some tests, found one after the other: at most `MOST_STEPS` in each.

    A test has one with a probability that is itself unknown, uniformly; it may be at any point of its loading.

    Args:
        base: the tests.
        start: the hypothesis beside which they are: the base law, or one with a formula.
        variant: the formula.
    """
    N, P = np.asarray(base.tests.mask).shape
    loading, mask = np.asarray(base.tests.loading & base.tests.mask), np.asarray(base.tests.mask)
    low, high = variant.plausible
    unit = high / 3
    columns = np.zeros((N, P, 0))
    found: list[Step] = []
    now, best, value, steps = start, None, -np.inf, list[Step]()
    for turn in range(MOST_STEPS + 1):
        if turn:
            more = More(columns, (SPREAD,) * turn)
            design = design_of(base, start.state, start.variants, more)
            optimum = optimise(design, np.concatenate([start.optimum.free, np.ones(turn)]), curvature=False)
            log_prior = _log_prior_of_steps(found, loading)
            if optimum.log_joint + log_prior <= value:
                break
            value = optimum.log_joint + log_prior
            now = solved(design, optimum, start)
            best, steps = OwnNumbers(variant, {}, value, now, more), list(found)
        if turn == MOST_STEPS:
            break
        score, information = step_scores(now)
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
    if best is None:
        return None
    at = refined(base, start.state, start.variants, start.theta, best.at.optimum.free, best.more)
    jumps = _jumps(base, steps, unit * at.solution.own[:, 5:])
    return replace(best, at=at, log_evidence=at.log_evidence + best.of_choices, jumps=jumps) if jumps else None


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
