"""The design matrix of a hypothesis around a state, and where the state moves to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..calibrate.compiling import compiled
from ..calibrate.forward import Forms, Linear, Point, linearise
from ..calibrate.priors import nuisance_moments
from ..effects import Variant
from .base import Base, State
from .columns import Design, Kinds, prior_of_noise
from .evidence import Solution
from .settings import POPULATION


def particle_means(beta: Float[Array, " 5"], flatness: Array, power: float) -> Float[Array, "particles 4"]:
    """Means of the particles' b1, b3, b5, e under the population.

    b1, b3, b5 of the population are those at the campaign's average shape; its mean, as a, is taken in by the prior.
    """
    log_eta = jnp.log1p(jnp.maximum(beta[0] * flatness, -0.99))
    shift = jnp.mean(log_eta)
    b = beta[2:5][None] + (log_eta - shift)[:, None]
    e = beta[1] + power * log_eta
    return jnp.concatenate([b, e[:, None]], 1)


@compiled
def means_and_slope(beta: Float[Array, " 5"], flatness: Array, power: float) -> tuple[Array, Array]:
    """Means of the particles' b1, b3, b5, e, and their derivatives by the population."""
    return particle_means(beta, flatness, power), jax.jacfwd(lambda b: particle_means(b, flatness, power))(beta)


def linear_means(base: Base, state: State) -> tuple[np.ndarray, np.ndarray]:
    """`means_and_slope` at a state, as arrays of NumPy."""
    at, slope = means_and_slope(state.population, jnp.asarray(base.flatness), base.model.shape_power)
    return np.asarray(at), np.asarray(slope)


@dataclass(frozen=True)
class ExtraColumns:
    """Columns of a hypothesis in addition to those of its formulas."""

    own: np.ndarray | None = None  # of numbers that every test has of its own
    own_spreads: tuple[Any, ...] = ()  # the priors of their spreads
    amplitude: np.ndarray | None = None  # of further amplitudes in units of the smallest plausible one
    largest: tuple[float, ...] = ()  # plausible amplitude of each in that unit
    sign: tuple[int, ...] = ()
    basis: np.ndarray | None = None  # of misfits
    group: Sequence[int] = ()  # which misfit each of these columns belongs to, from 1 on
    sizes: Sequence[tuple[float, float, float]] = ()  # of the logarithm of each one's size: median, sd, the most

    def with_own(self, columns: np.ndarray, spreads: Sequence[Any]) -> ExtraColumns:
        """Further numbers that every test has of its own, in addition."""
        own = columns if self.own is None else np.concatenate([self.own, columns], -1)
        return replace(self, own=own, own_spreads=(*self.own_spreads, *spreads))


NO_EXTRA = ExtraColumns()


def linear_at(base: Base, state: State, variants: tuple[Variant, ...]) -> Linear:
    """The tests linearised at a state."""
    return base.each(linearise, state.point, Forms(base.model.unloading, variants))


def design_of(
    base: Base,
    state: State,
    variants: tuple[Variant, ...] = (),
    more: ExtraColumns = NO_EXTRA,
    linear: Linear | None = None,
) -> Design:
    """The design of a hypothesis around a state, from the tests linearised there if they are already."""
    tests, model, (middle, factor) = base.tests, base.model, base.population_prior
    linear = linear_at(base, state, variants) if linear is None else linear
    point, columns = state.point, np.asarray(linear.columns)
    of_particle, effect = columns[..., :4], columns[..., 4:]
    at, slope = linear_means(base, state)
    population = of_particle @ (slope @ factor)
    # The data less what the priors' means say.
    away = at + slope @ (middle - np.asarray(state.population)) - np.asarray(point.latent)
    data = np.asarray(linear.residual) - np.einsum("npk,nk->np", of_particle, away)
    zero_mean, zero_sd = base.zero_prior
    ones = np.where(tests.mask, 1.0, 0.0)
    data = data - (np.asarray(tests.contact) + zero_mean - np.asarray(point.zero))[:, None] * ones
    own = [of_particle, (zero_sd * ones)[..., None], *([] if more.own is None else [more.own])]
    K, theta = len(variants), np.asarray(point.theta)
    units = np.array([v.plausible[0] for v in variants])
    amplitude = [effect[..., :K] * units, *([] if more.amplitude is None else [more.amplitude])]
    data = data + np.einsum("npk,nk->np", effect[..., :K], theta[:, :K])
    common, place = [population], K
    for v in variants:
        for n in v.nuisances:
            mean, sd = nuisance_moments(n)
            now, column = theta[0, place], effect[..., place]
            if n.plausible[0] > 0:
                column, now = column * now, np.log(now)
            data = data - column * (mean - now)
            common.append((sd * column)[..., None])
            place += 1
    shared = np.concatenate([*common, *([] if more.basis is None else [more.basis])], -1)
    largest = [*(v.plausible[1] / v.plausible[0] for v in variants), *more.largest]
    return Design(
        tests,
        replace(linear, columns=linear.columns[..., :0]),  # they are part of the design: one shape for all formulas
        np.concatenate(own, -1),
        shared,
        np.concatenate(amplitude, -1),
        data,
        base.scale,
        np.array([0] * (shared.shape[-1] - len(more.group)) + list(more.group), int),
        prior_of_noise(model),
        np.array(largest, float),
        np.array([*(v.sign for v in variants), *more.sign], float),
        np.array(more.sizes, float).reshape(-1, 3),
        Kinds((*base.spreads, *more.own_spreads), model.correlation, model.along),
    )


def moved(base: Base, state: State, variants: tuple[Variant, ...], solution: Solution) -> State:
    """The state at a solution, or on the way there: no positive number moves by more than a factor of e.

    All numbers go the same share of the way, since an amplitude that is right at the solution is wrong with further
    numbers that stayed behind. Further numbers of an effect whose amplitude is zero stay: the data say nothing of them.
    """
    tests, (mean, factor) = base.tests, base.population_prior
    beta = mean + factor @ solution.common[:POPULATION]
    at, slope = linear_means(base, state)
    latent = at + slope @ (beta - np.asarray(state.population)) + solution.own[:, :4]
    zero_mean, zero_sd = base.zero_prior
    zero = np.asarray(tests.contact) + zero_mean + zero_sd * solution.own[:, 4]
    old, place, share = np.asarray(state.point.theta[0]), POPULATION, 1.0
    steps = [v.plausible[0] * float(solution.amplitude[k]) - float(old[k]) for k, v in enumerate(variants)]
    logs = [False] * len(steps)
    for k, v in enumerate(variants):
        for n in v.nuisances:
            middle, sd = nuisance_moments(n)
            x, now = middle + sd * float(solution.common[place]), float(old[len(steps)])
            log = n.plausible[0] > 0
            step = x - np.log(now) if log else float(np.clip(x, *n.plausible)) - now
            step = step if old[k] else 0.0
            if log:
                share = min(share, 1 / max(abs(step), 1.0))
            steps.append(step)
            logs.append(log)
            place += 1
    ways = share * np.array(steps)
    numbers = np.where(logs, old[: len(steps)] * np.exp(np.where(logs, ways, 0.0)), old[: len(steps)] + ways)

    there = State(Point(jnp.asarray(latent), jnp.asarray(zero), state.point.theta), jnp.asarray(beta))
    return between(state, there, share).with_numbers(numbers)


def at_priors(base: Base, rows: np.ndarray) -> State:
    """Where the base law fits, but for some tests at the priors' middle; the population, too, if they are most.

    The law is monotone there, as tests are, and what it lacks can be found from there.
    """
    mean, point = base.population_prior[0], base.state.point
    population = np.asarray(base.state.population)
    if 2 * rows.sum() > len(rows):
        population = np.concatenate([population[:2], mean[2:]])
    middle = particle_means(jnp.asarray(mean), jnp.asarray(base.flatness), base.model.shape_power)
    latent = jnp.where(rows[:, None], middle, point.latent)
    zero = jnp.where(rows, base.tests.contact, point.zero)
    return State(replace(point, latent=latent, zero=zero), jnp.asarray(population))


def between(one: State, other: State, share: float = 0.5) -> State:
    """A share of the way from one state to another, half of it by default."""
    return jax.tree.map(lambda x, y: (1 - share) * x + share * y, one, other)
