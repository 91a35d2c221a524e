"""What may be missing: hypotheses, whose formulas may be wrong; effects that differ from test to test; and a smooth
discrepancy that no mechanism explains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import betaln, expit, logsumexp

from ..calibrate.noise import correlations
from ..calibrate.numpyro_model import Model
from ..calibrate.priors import NakagamiPrior, SpreadCoordinate
from ..effects import Variant
from .base import Base, State
from .design import NO_EXTRA, Design, ExtraColumns, Variants, design_of, linear_at
from .evidence import LinearModel, likely_start, log_joint, optimise, visible, with_little_noise
from .fit import Fitted, fit_hypothesis, moved
from .periods import Periodogram
from .screen import Candidates, single_integrals
from .settings import DECISIONS, EARLY, HYPERPARAMETERS, UNLISTED, VERY_STRONG

Names = tuple[str, ...]

# Priors of the spread of an amplitude over the particles, as a share of it; and of a random effect over the tests, in
# units of the largest plausible one, open in its order of magnitude.
SCATTER, SPREAD = NakagamiPrior(DECISIONS.scatter), NakagamiPrior(1.0, shape=0.25)

FOLLOWED = 4  # times at most that the prior of a misfit follows the amplitude of its formula
AGREE = 0.1  # difference of the logarithms of the two at which it need not
DRIFTS = 6  # drifts of every test's own that are fitted at their own optimum
MOST_STEPS = 12  # sudden ones of one test
LASTING = 0.05  # share of an outlier left at the end of its test from which on it is no different from a step


@dataclass
class Hypothesis:
    """What may be missing: a law with it at its optimum, and the log evidence of its several forms."""

    names: Names  # of the mechanisms; none for nothing, `UNLISTED` for a discrepancy that none explains
    alone: float = -np.inf  # log evidence by formulas of the library alone
    with_misfit: float = -np.inf  # where the formulas may be wrong
    with_discrepancy: float = -np.inf  # with a smooth discrepancy in addition
    at: Fitted | None = None  # the best formulas at their optimum; None where they are known to first order alone
    own: RandomEffects | None = None  # numbers of every test's own, which are part of `at`
    misfit: tuple[np.ndarray, Design] | None = None  # hyperparameters at their mode, and design, with the misfit
    other_noise: float = 0.0  # what averaging over other kinds of noise adds to the log evidence
    under_other_noise: tuple[Model, np.ndarray] | None = None  # a kind that the tests prefer, hyperparameters there

    @property
    def fitted(self) -> Fitted:
        """The best formulas at their optimum, where they have been fitted."""
        assert self.at is not None
        return self.at

    @property
    def log_evidence(self) -> float:
        """Log marginal likelihood, averaged over its formulas alone and with their misfit."""
        if not self.names or self.names == UNLISTED or (self.own is not None and not np.isfinite(self.with_misfit)):
            return self.alone + self.other_noise
        return float(np.logaddexp(self.alone, self.with_misfit) - np.log(2)) + self.other_noise

    @property
    def is_off(self) -> bool:
        """Whether the tests prefer its formulas with a misfit."""
        return self.with_misfit > self.alone

    @property
    def sizes(self) -> tuple[float, ...]:
        """How far the formulas are off, as shares of the effects: scales that follow the other hyperparameters."""
        if self.misfit is None or self.at is None:
            return ()
        hyper, design = self.misfit
        logs = hyper[len(self.at.optimum.hyper) + len(self.at.variants) :] - design.misfits[:, 0]
        return tuple(float(x) for x in DECISIONS.misfit * np.exp(logs))

    def likely_form(self, *, misfit: bool = True) -> tuple[np.ndarray, Design]:
        """Hyperparameters at their mode, and design, in the form and under the noise that the tests prefer."""
        hyper, design = self.fitted.optimum.hyper, self.fitted.design
        if misfit and self.is_off and self.misfit is not None:
            hyper, design = self.misfit
        if self.under_other_noise is not None:
            model, other = self.under_other_noise
            hyper, design = other[: len(hyper)], design.with_noise(model)
        return hyper, design


def fit_with_misfit(base: Base, one: Hypothesis, columns_of: Callable[[Variant, np.ndarray], np.ndarray]) -> None:
    """The form of a hypothesis where every name's formula may be wrong by a share of the effect.

    Columns of a misfit, from `columns_of` by formula and the curve it adds, are made at the amplitude of the formula
    alone. Where the amplitude is another with them, their prior follows it until both agree: otherwise a formula that
    explains nothing by itself would lend its name to what its misfit explains.
    """
    r = one.fitted
    names, units, more = len(r.variants), np.array([v.plausible[0] for v in r.variants]), NO_EXTRA
    curves = r.design.amplitude[..., :names] * (r.theta[:names] / units)  # what every formula adds to the tests [um]
    misfits = [columns_of(v, curves[..., i]) for i, v in enumerate(r.variants)]
    # A formula is wrong by a share of what can be seen of it: most of some is like a particle's own numbers.
    seen = list(visible(r.optimum.hyper, r.design, curves))
    if one.own is not None:
        more, curve = one.own.more, one.own.curve_um
        alone = replace(r.design, own=r.design.own[..., :5], spreads=r.design.spreads[:4])
        seen.extend(visible(r.optimum.hyper[:HYPERPARAMETERS], alone, curve[..., None]))
        if one.own.jumps:  # steps too small to be found add up to a curve that all tests share
            curve = np.full_like(curve, np.mean(np.max(curve, 1)))
        misfits.append(columns_of(one.own.variant, curve))
    more = replace(
        more,
        own=(*more.own, curves),  # amplitudes differ from particle to particle
        own_spreads=(*more.own_spreads, *[SCATTER] * names),
        misfits=tuple(share * columns for share, columns in zip(seen, misfits, strict=True)),
        sizes=[(np.log(DECISIONS.misfit), DECISIONS.misfit_log_sd, np.log(DECISIONS.misfit_most))] * len(misfits),
    )
    design = design_of(base, r.state, r.variants, more)
    scatter = float(SpreadCoordinate(SCATTER).coordinate(SCATTER.sd))
    start = np.concatenate([r.optimum.hyper, [scatter] * names, design.misfits[:, 0]])
    optimum = optimise(design, start, without=r.optimum)
    sizes, shift = design.misfits, np.zeros(len(misfits))
    alone = np.maximum(np.abs(r.theta[:names]), 1e-300)
    for _ in range(FOLLOWED):
        amplitudes = np.abs(LinearModel(optimum.hyper, design).solve().amplitude[:names] * units)
        away = -shift  # of a test's own numbers the prior stays
        away[:names] += np.log(np.maximum(amplitudes, 1e-300) / alone)
        if optimum.log_evidence < r.log_evidence or np.all(np.abs(away) < AGREE):
            break
        shift = shift + away / 2  # all of the way would overshoot
        design = replace(design, misfits=sizes + shift[:, None] * [1.0, 0.0, 1.0])
        start = np.concatenate([optimum.hyper[: -len(sizes)], design.misfits[:, 0]])
        optimum = optimise(design, start, without=r.optimum)
    one.misfit = optimum.hyper, replace(design)  # a copy, without its whitened columns
    one.with_misfit = optimum.log_evidence + (0.0 if one.own is None else one.own.of_choices)


@dataclass(frozen=True)
class Discrepancy:
    """A discrepancy common to all particles, smooth or periodic, which no mechanism explains."""

    smooth: tuple[np.ndarray, ...]  # functions of each of its parts [um]
    log_white: float  # logarithm of the standard deviation of white noise, by which they are measured
    periods: tuple[Periodogram, ...] = ()
    sinusoids: tuple[np.ndarray, ...] = ()  # of every period, a part each [um]

    @property
    def parts(self) -> tuple[np.ndarray, ...]:
        """Functions of all its parts [um]."""
        return (*self.smooth, *self.sinusoids)

    @property
    def sizes(self) -> np.ndarray:
        """Standard deviations that a part may have where none is fitted [um]."""
        return DECISIONS.general * np.exp(self.log_white) * np.array([0.1, 0.3, 1.0, 3.0])

    def added_to(self, base: Base, r: Fitted, at_least: float = -np.inf) -> Fitted | None:
        """The law, or what is named, with the discrepancy at its optimum; None where it begins far below `at_least`."""
        unit, count = float(np.log(DECISIONS.general)) + self.log_white, len(self.parts)
        more = ExtraColumns(misfits=self.parts, sizes=[(unit, DECISIONS.general_log_sd, np.inf)] * count)
        design = design_of(base, r.state, r.variants, more)
        start, value = likely_start(design, np.append(r.optimum.hyper, [unit - 1.0] * count))
        if value < at_least - VERY_STRONG:
            return None
        optimum = optimise(design, start, without=r.optimum)
        at = Fitted(r.variants, r.state, design, optimum)
        if not r.variants and optimum.log_joint > r.optimum.log_joint + VERY_STRONG:
            # What it takes away from the law's numbers moves these as far as a name does; with a name that is done.
            there = at
            for _ in range(EARLY):
                state = moved(base, there.state, r.variants, there.solution)
                there = replace(there, state=state, design=design_of(base, state, r.variants, more))
            optimum = optimise(there.design, optimum.hyper, without=r.optimum)
            if optimum.log_joint > at.optimum.log_joint:
                at = replace(there, optimum=optimum)
        of_choices = sum(one.of_choice(self.sizes) for one in self.periods)
        return replace(at, optimum=replace(at.optimum, log_evidence=at.optimum.log_evidence + of_choices))

    def curve_um(self, at: Fitted) -> np.ndarray:
        """What it adds to the law's displacement at every point, where it is part of a hypothesis [um]."""
        return np.concatenate(self.parts, -1) @ at.solution.common[at.design.group > 0]


@dataclass(frozen=True)
class Jump:
    """A sudden step in a test."""

    particle: str
    stress_MPa: float
    size: float  # in the formula's unit
    sd: float
    probability: float  # that there is one in this test


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

    def next_to(self, base: Base, state: State, variants: Variants, numbers: Any, hyper: np.ndarray) -> RandomEffects:
        """The same numbers with a formula in addition, at its optimum."""
        spreads = self.at.optimum.hyper[HYPERPARAMETERS : HYPERPARAMETERS + len(self.more.own_spreads)]
        at = fit_hypothesis(base, state, variants, numbers, np.concatenate([hyper, spreads]), self.more)
        return replace(self, at=at, log_evidence=at.log_evidence + self.of_choices)

    @property
    def of_choices(self) -> float:
        """What having chosen a formula, its further numbers or places of steps costs in log evidence."""
        return self.log_evidence - self.at.log_evidence


def random_amplitude(base: Base, start: Fitted, candidates: Candidates) -> RandomEffects | None:
    """An amplitude that scatters around a common one, over all formulas of a mechanism, added to a fit; or None."""
    hyper = np.append(start.optimum.hyper, 1.0)
    linear = linear_at(base, start.state, start.variants)
    tried = []
    for k, c in enumerate(candidates.each):
        if c.variant.random_per_test:
            ratio, column = float(candidates.largest[k]), candidates.columns[..., k : k + 1]
            more = ExtraColumns((ratio * column,), (SPREAD,), (column,), (ratio,))
            design = design_of(base, start.state, start.variants, more, linear)
            each = [(log_joint(x, design), x) for x in (hyper, with_little_noise(hyper))]
            tried.append((*max(each, key=lambda one: one[0]), c, design, more))
    if not tried:
        return None
    tried.sort(key=lambda one: -one[0])
    fits = [optimise(design, at, curvature=False) for _, at, _, design, _ in tried[:DRIFTS]]
    logs = [*(fit.log_joint for fit in fits), *(one[0] for one in tried[DRIFTS:])]
    values: dict[str, list[float]] = {}
    for value, (_, _, candidate, *_) in zip(logs, tried, strict=True):
        values.setdefault(candidate.variant.name, []).append(value)
    row = int(np.argmax([fit.log_joint for fit in fits]))
    optimum, (_, _, best, design, more) = fits[row], tried[row]
    if optimum.log_joint > start.optimum.log_joint:
        # Numbers of its own may be as large as anything else: what was linear without them is not with them.
        at = fit_hypothesis(base, start.state, start.variants, start.theta, optimum.hyper, more)
    else:
        at = replace(start, design=design, optimum=optimise(design, optimum.hyper))
    each = [logsumexp(v) - np.log(len(v)) for v in values.values()]
    total = float(logsumexp(each) - np.log(len(each))) + at.log_evidence - optimum.log_joint
    return RandomEffects(best.variant, dict(best.nuisance), total, at, more)


class Step(NamedTuple):
    """A step that was found: in which test, from which point on, in which turn, and its standard error [um]."""

    test: int
    point: int
    turn: int
    sd: float


def sudden_steps(base: Base, start: Fitted, variant: Variant, *, of_noise: bool = False) -> RandomEffects | None:
    """Sudden steps in some tests, found one after the other, added to a fit; None without any. A test has one with a
    probability that is itself unknown, uniformly, at any point of its loading. With `of_noise` they are outliers of the
    noise: of either sign, and fading by its correlation before the test ends (innovational outliers in place of level
    shifts: Chen and Liu 1993, J. Am. Stat. Assoc. 88, 284); only their log evidence counts."""
    mask = np.asarray(base.tests.mask)
    response = np.where(mask[..., None], np.tril(np.ones((mask.shape[1], mask.shape[1]))), 0.0)
    allowed, sign = mask if of_noise else np.asarray(base.tests.loading) & mask, 0 if of_noise else 1
    if of_noise:
        length = float(np.exp(start.optimum.hyper[3]))
        response *= correlations(start.design.tests, length, start.design.correlation, start.design.along)
        ends = mask.shape[1] - 1 - np.argmax(mask[:, ::-1], 1)
        allowed = mask & (response[np.arange(len(mask)), ends] < LASTING)  # where noise lasts, it is the particle's
    low, high = variant.plausible
    unit, now, best, value = high / 3, start, None, -np.inf
    columns, found, steps = (), list[Step](), list[Step]()
    for turn in range(MOST_STEPS):
        score, information = step_scores(now, response)
        new, count = np.zeros((*mask.shape, 1)), len(found)
        for i, points in enumerate(allowed):
            rows = np.flatnonzero(points)[1:]
            if not len(rows):
                continue
            each = single_integrals(low * score[i, rows], low**2 * information[i, rows], sign, high / low)
            if logsumexp(each) - np.log(len(rows)) > np.log((1 - DECISIONS.jump) / DECISIONS.jump):
                j = int(rows[int(np.argmax(each))])
                new[i, :, 0] = unit * response[i, :, j]
                found.append(Step(i, j, turn, float(max(information[i, j], 1e-300) ** -0.5)))
        if len(found) == count:
            break
        columns = (*columns, new)
        spreads = (SPREAD,) * (turn + 1)
        own = np.concatenate([start.design.own, *columns], -1)
        design = replace(start.design, own=own, spreads=(*start.design.spreads, *spreads))
        hyper = np.insert(start.optimum.hyper, 4 + len(start.design.spreads), np.ones(turn + 1))
        optimum = optimise(design, hyper, curvature=False)
        # Which tests have steps, how many, and where.
        with_steps = len({step.test for step in found})
        several = (len(found) - with_steps) * np.log(0.5)
        places = sum(np.log(max(allowed[step.test].sum(), 1)) for step in found)
        log_prior = float(betaln(with_steps + 1, len(allowed) - with_steps + 1) + several - places)
        with_prior = optimum.log_joint + log_prior
        if with_prior <= value:
            break
        value, now = with_prior, replace(start, design=design, optimum=optimum)
        best, steps = RandomEffects(variant, {}, value, now, ExtraColumns(columns, spreads)), list(found)
    if best is None or of_noise:
        # The spreads of the outliers are integrated out, as everything else is.
        return best and replace(
            best, log_evidence=optimise(best.at.design, best.at.optimum.hyper).log_evidence + best.of_choices
        )
    at = fit_hypothesis(base, start.state, start.variants, start.theta, best.at.optimum.hyper, best.more)
    force, diameter, jumps = np.asarray(base.tests.force), np.asarray(base.tests.effective_diameter), []
    for step in steps:
        i, size = step.test, float(unit * at.solution.own[step.test, 5 + step.turn])
        if size > 0:
            stress = float(1e3 * force[i, step.point] / (np.pi * diameter[i] ** 2 / 4))
            probability = float(expit((size / step.sd) ** 2 / 2 - np.log(len(force[i]))))
            jumps.append(Jump(base.names[i], stress, size, step.sd, probability))
    return replace(best, at=at, log_evidence=at.log_evidence + best.of_choices, jumps=tuple(jumps)) if jumps else None


def step_scores(now: Fitted, response: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Score and information of a step of 1 um at every point, each particle's own numbers integrated out;
    `response[i, k, j]` is the displacement of test i at point k by a step at point j."""
    design = now.design
    residual = design.data - design.common @ now.solution.common - design.amplitude @ now.solution.amplitude
    alone = replace(design, data=residual, common=design.common[..., :0], group=design.group[:0])
    particles = LinearModel(now.optimum.hyper, alone.with_amplitudes(response)).particles
    return particles.score, np.diagonal(particles.information, axis1=1, axis2=2)
