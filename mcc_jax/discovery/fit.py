"""Hypotheses at their own optimum, by Gauss-Newton in all numbers; and the kind of noise that the tests prefer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..calibrate.data import ranges_um
from ..calibrate.fitting import Start
from ..calibrate.forward import Point
from ..calibrate.judgement import LARGE_MISFIT
from ..calibrate.noise import Along, Correlation, Noise, particle_scales, places
from ..calibrate.numpyro_model import Model
from ..calibrate.population import Population
from .base import Base, State
from .design import NO_EXTRA, Design, ExtraColumns, Variants, design_of, further_priors, particle_means
from .evidence import LinearModel, Optimum, Solution, optimise, residual_of, spreads_of, whitened
from .settings import EARLY, POPULATION, STRONG

STEPS = 25  # of Gauss-Newton at most
STILL = 0.05  # change of the log posterior at which they end, and by which later ones may make it worse [nats]
WORSE = 5.0  # nats by which each of the `EARLY` first steps may make it worse before half of it is taken back


@dataclass(frozen=True)
class Fitted:
    """A hypothesis at its optimum: evidence and numbers come from the same accepted step."""

    variants: Variants
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


def fit_hypothesis(
    base: Base, state: State, variants: Variants, numbers: Any, hyper: np.ndarray, more: ExtraColumns = NO_EXTRA
) -> Fitted:
    """The optimum of a hypothesis by Gauss-Newton, from a state of the base law and `numbers` of the effects."""
    state, value = state.with_numbers(np.asarray(numbers)), -np.inf
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
        if optimum is None or optimum.log_joint < value - (WORSE if k < EARLY else STILL):
            # What was linear there is not here: half of the step, or none of it.
            state, value = (before if last else between(before, state)), -np.inf
        else:
            hyper = optimum.hyper
            if last or (k > 1 and abs(optimum.log_joint - value) < STILL):
                break
            before, value = state, optimum.log_joint
            state = moved(base, state, variants, LinearModel(hyper, design).solve())
        design = design_of(base, state, variants, more)
    return Fitted(variants, state, design, optimise(design, hyper))


def moved(base: Base, state: State, variants: Variants, solution: Solution) -> State:
    """The state at a solution, or on the way there: no positive number moves by more than a factor of e.

    All numbers go the same share of the way: an amplitude that is right at the solution is wrong with further numbers
    that stayed behind. Those of an effect whose amplitude is zero stay: the data say nothing of them.
    """
    middle, factor = base.population_prior
    beta = middle + factor @ solution.common[:POPULATION]
    means, slope = particle_means(state.population, base.flatness, base.model.shape_power)
    latent = means + slope @ (beta - np.asarray(state.population)) + solution.own[:, :4]
    zero_prior = base.model.chosen_priors.zero_um
    zero = np.asarray(base.tests.contact) + zero_prior.mean + zero_prior.sd * solution.own[:, 4]
    old, now = np.split(np.asarray(state.point.theta[0]), [len(variants)])
    to_amplitudes = solution.amplitude[: len(old)] * np.array([v.plausible[0] for v in variants]) - old
    mean, sd, positive = further_priors(variants)
    low, high = np.array([n.plausible for v in variants for n in v.nuisances], float).reshape(-1, 2).T
    there = mean + sd * solution.common[POPULATION : POPULATION + len(now)]
    way = np.where(positive, there - np.log(np.where(positive, now, 1.0)), np.clip(there, low, high) - now)
    way = np.where(np.repeat(old, [len(v.nuisances) for v in variants]) != 0, way, 0.0)
    share = 1 / max(1.0, np.max(np.abs(way[positive]), initial=0.0))
    further = np.where(positive, now * np.exp(share * np.where(positive, way, 0.0)), now + share * way)
    solved = State(Point(jnp.asarray(latent), jnp.asarray(zero), state.point.theta), jnp.asarray(beta))
    return between(state, solved, share).with_numbers(np.append(old + share * to_amplitudes, further))


def between(one: State, other: State, share: float = 0.5) -> State:
    """A share of the way from one state to another, half of it by default."""
    return jax.tree.map(lambda x, y: jax.device_put((1 - share) * np.asarray(x) + share * np.asarray(y)), one, other)


def at_priors(base: Base, rows: np.ndarray) -> State:
    """The base law's fit, but for some tests at the priors' middle; where these are most, the population, too."""
    mean, point = base.population_prior[0], base.state.point
    population = np.asarray(base.state.population)
    if 2 * rows.sum() > len(rows):
        population = np.concatenate([population[:2], mean[2:]])
    middle, _ = particle_means(mean, base.flatness, base.model.shape_power)
    latent = jnp.where(rows[:, None], middle, point.latent)
    zero = jnp.where(rows, base.tests.contact, point.zero)
    return State(replace(point, latent=latent, zero=zero), jnp.asarray(population))


def with_likely_noise(base: Base, r: Fitted | None = None) -> tuple[Base, Optimum]:
    """The base law and a mode under the kind of noise that the tests prefer: the model's own unless clearly not. Under
    other noise formulas would be fitted to what the noise leaves.

    What noise leaves is judged by the law alone or, where much is missing, by a hypothesis `r`: otherwise particles in
    which more is missing would count as noisier ones.
    """
    if r is None:
        design = design_of(base, base.state)
        own, models = optimise(design, base.hyperparameters, curvature=False), noise_models(base)
    else:
        design, own, models = r.design, r.optimum, (base.model, *noise_models(base))
    others = [(*_with_own_scales(design, own.hyper, model), model) for model in models]
    best, scale, model = max(others, key=lambda one: one[0].log_joint)
    if best.log_joint > own.log_joint + STRONG:
        return replace(base, model=model, scale=scale), best
    return base, own


def _with_own_scales(design: Design, hyper: np.ndarray, model: Model) -> tuple[Optimum, np.ndarray]:
    """As `with_other_noise`, with the particles' own factors that belong to this kind of noise, and these."""
    alike = replace(design, scale=np.ones(len(design.scale))).with_noise(model)
    found = with_other_noise(alike, hyper, model)
    white, _ = whitened(found.hyper, alike, residual_of(LinearModel(found.hyper, alike).solve(), alike))
    mask = np.asarray(design.tests.mask)
    scale = particle_scales(alike.scale, np.sum(np.where(mask, white, 0.0) ** 2, 1), mask.sum(1) - 4)
    if np.any(scale != 1.0):
        found = with_other_noise(replace(design, scale=scale), found.hyper, model)
    return found, scale


def with_other_noise(design: Design, hyper: np.ndarray, model: Model) -> Optimum:
    """The mode of the hyperparameters under the noise of a model, from the mode under another; -inf where correlated
    noise is more than a misfit may be: it would describe any test."""
    other, start = design.with_noise(model), hyper.copy()
    start[3] = other.noise[0, 3]  # the length's unit may be another
    found = optimise(other, start, curvature=False)
    share = np.median(np.exp(found.hyper[2]) * design.scale / ranges_um(design.tests))
    return found if share < LARGE_MISFIT else replace(found, log_evidence=-np.inf, log_joint=-np.inf)


def noise_models(base: Base) -> tuple[Model, ...]:
    """The model with other kinds of noise; the prior of the length of correlation keeps its share of a test."""
    tests, model, prior = base.tests, base.model, base.model.chosen_priors
    mask = np.asarray(tests.mask)

    def length(along: Along) -> float:
        x = places(tests, along)
        return max(float(np.median(np.where(mask, x, -np.inf).max(1) - np.where(mask, x, np.inf).min(1))), 1e-9)

    models = []
    for kind in product((Correlation.EXPONENTIAL, Correlation.MATERN_32), (Along.LOAD, Along.TIME)):
        if kind != (model.correlation, model.along):
            median = prior.noise_length.median * length(kind[1]) / length(model.along)
            priors = replace(prior, noise_length=replace(prior.noise_length, median=median))
            models.append(replace(model, correlation=kind[0], along=kind[1], priors=priors))
    return tuple(models)
