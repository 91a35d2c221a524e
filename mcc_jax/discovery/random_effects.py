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
from .design import ExtraColumns, design_of, linear_at
from .evidence import log_joint, optimise, scales_of, with_little_noise
from .fit import Fitted, fit_hypothesis
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
class RandomEffects:
    """A hypothesis of random effects of every test, alone or with a formula that all tests share."""

    variant: Variant
    nuisance: dict[str, float]  # further numbers of the formula
    log_evidence: float
    at: Fitted  # the hypothesis at its optimum
    more: ExtraColumns  # columns of its own numbers
    jumps: tuple[Jump, ...] = ()  # sudden steps, if it is about these

    @property
    def curve_um(self) -> np.ndarray:
        """What its own numbers add to every test [um]."""
        solution, K = self.at.solution, len(self.at.variants)
        own = np.einsum("npo,no->np", self.at.design.own[..., 5:], solution.own[:, 5:])
        return own + self.at.design.amplitude[..., K:] @ solution.amplitude[K:]

    def next_to(
        self, base: Base, state: State, variants: tuple[Variant, ...], numbers: np.ndarray, hyper: np.ndarray
    ) -> RandomEffects:
        """The same numbers with a formula in addition, at its optimum."""
        spreads = self.at.optimum.hyper[HYPERPARAMETERS : HYPERPARAMETERS + len(self.more.own_spreads)]
        at = fit_hypothesis(base, state, variants, numbers, np.concatenate([hyper, spreads]), self.more)
        return replace(self, at=at, log_evidence=at.log_evidence + self.of_choices)

    @property
    def of_choices(self) -> float:
        """What having chosen a formula, its further numbers or places of steps costs in log evidence."""
        return self.log_evidence - self.at.log_evidence


def random_amplitude(
    base: Base, start: Fitted, columns: np.ndarray, candidates: Sequence[Candidate]
) -> RandomEffects | None:
    """An amplitude that scatters around a common one, over all formulas of a mechanism; None if none does.

    It is added to a hypothesis at its optimum: the base law, or one with a formula. `columns` are the candidates'
    signatures in units of their smallest plausible amplitudes.
    """
    hyper = np.append(start.optimum.hyper, 1.0)
    linear = linear_at(base, start.state, start.variants)
    tried: list[tuple[float, np.ndarray, Candidate, Design, ExtraColumns]] = []
    for k, c in enumerate(candidates):
        if not c.variant.random_per_test:
            continue
        ratio = c.variant.plausible[1] / c.variant.plausible[0]
        column = columns[..., k : k + 1]
        more = ExtraColumns(ratio * column, (SPREAD,), column, (ratio,), (0,))
        design = design_of(base, start.state, start.variants, more, linear)
        value, at = max(((log_joint(x, design), x) for x in (hyper, with_little_noise(hyper))), key=lambda one: one[0])
        tried.append((value, at, c, design, more))
    if not tried:
        return None
    tried.sort(key=lambda one: -one[0])
    fits = [optimise(design, at, curvature=False) for _, at, _, design, _ in tried[:DRIFTS]]
    values: dict[str, list[float]] = {}
    logs = [*(fit.log_joint for fit in fits), *(first for first, *_ in tried[DRIFTS:])]
    for value, (_, _, c, _, _) in zip(logs, tried, strict=True):
        values.setdefault(c.variant.name, []).append(value)
    row = int(np.argmax([fit.log_joint for fit in fits]))
    optimum, (_, _, c, design, more) = fits[row], tried[row]
    if optimum.log_joint > start.optimum.log_joint:
        # Numbers of its own may be as large as anything else: what was linear without them is not with them.
        at = fit_hypothesis(base, start.state, start.variants, start.theta, optimum.hyper, more)
    else:
        at = replace(start, design=design, optimum=optimise(design, optimum.hyper))
    each = [logsumexp(v) - np.log(len(v)) for v in values.values()]
    total = float(logsumexp(each) - np.log(len(each))) + at.log_evidence - optimum.log_joint
    return RandomEffects(c.variant, dict(c.nuisance), total, at, more)


def step_scores(now: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """Score and information of a step of 1 um at every point, each particle's own numbers integrated out."""
    design, hyper = now.design, now.optimum.hyper
    _, P, o = design.own.shape
    own, _ = scales_of(hyper, design)
    residual = design.data - design.common @ now.solution.common - design.amplitude @ now.solution.amplitude
    steps = np.where(np.asarray(design.tests.mask)[..., None], np.tril(np.ones((P, P))), 0.0)
    white = Columns(np.concatenate([design.own * own, steps, residual[..., None]], -1), design).white(hyper).columns
    turned = np.swapaxes(white[..., :o], 1, 2)
    root = np.linalg.cholesky(turned @ white[..., :o] + np.eye(o))
    half = np.linalg.solve(root, turned @ white[..., o:])
    score = np.einsum("npk,np->nk", white[..., o:-1], white[..., -1]) - np.einsum(
        "nok,no->nk", half[..., :-1], half[..., -1]
    )
    return score, np.sum(white[..., o:-1] ** 2, 1) - np.sum(half[..., :-1] ** 2, 1)


def sudden_steps(base: Base, start: Fitted, variant: Variant) -> RandomEffects | None:
    """Sudden steps in some tests, found one after the other: at most `MOST_STEPS` in each.

    A test has one with a probability that is itself unknown, uniformly; it may be at any point of its loading. They
    are added to a hypothesis at its optimum: the base law, or one with a formula.
    """
    N, P = np.asarray(base.tests.mask).shape
    loading, mask = np.asarray(base.tests.loading & base.tests.mask), np.asarray(base.tests.mask)
    low, high = variant.plausible
    unit = high / 3
    columns = np.zeros((N, P, 0))
    found: list[Step] = []
    now, best, value, steps = start, None, -np.inf, list[Step]()
    for turn in range(MOST_STEPS):
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
        more = ExtraColumns(columns, (SPREAD,) * (turn + 1))
        design = design_of(base, start.state, start.variants, more)
        optimum = optimise(design, np.concatenate([start.optimum.hyper, np.ones(turn + 1)]), curvature=False)
        with_prior = optimum.log_joint + _log_prior_of_steps(found, loading)
        if with_prior <= value:
            break
        value, now = with_prior, replace(start, design=design, optimum=optimum)
        best, steps = RandomEffects(variant, {}, value, now, more), list(found)
    if best is None:
        return None
    at = fit_hypothesis(base, start.state, start.variants, start.theta, best.at.optimum.hyper, best.more)
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
    jumps = []
    for step in found:
        i = step.test
        stress = 1e3 * force[i, step.point] / (np.pi * diameter[i] ** 2 / 4)
        size = float(sizes[i, step.turn])
        if size > 0:
            probability = float(expit((size / step.sd) ** 2 / 2 - np.log(len(force[i]))))
            jumps.append(Jump(i, float(stress), size, step.sd, probability))
    return tuple(jumps)
