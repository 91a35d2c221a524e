"""Designs of hypotheses around a state: which columns they have, and where the state moves to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mcc_jax.calibrate.compiling import compiled
from mcc_jax.calibrate.data import Tests
from mcc_jax.calibrate.distributions import SpreadCoordinate, nuisance_moments
from mcc_jax.calibrate.fit_result import Fit
from mcc_jax.calibrate.fitting import linear_data
from mcc_jax.calibrate.forward import Forms, Linear, Point
from mcc_jax.calibrate.model import Model
from mcc_jax.effects import Variant

from .evidence import Design, Kinds, Solution


class State(eqx.Module):
    """Where a hypothesis is linear.

    Attributes:
        point: every particle's numbers, its zero, and those of the effects.
        population: b = (a, log modulus, b1, b3, b5) of the population.
    """

    point: Point
    population: Float[Array, " 5"]


def population_prior(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Prior of (a, log modulus, b1, b3, b5): mean, and factor of the covariance (lower triangular but for b3)."""
    p = model.chosen_priors
    mean = np.zeros(5)
    factor = np.zeros((5, 5))
    mean[0], factor[0, 0] = p.a.mean, p.a.sd
    mean[1], factor[1, 1] = np.log(p.effective_modulus_MPa.median), p.effective_modulus_MPa.log_sd
    mean[2], factor[2, 2] = np.log(p.C1.median), p.C1.log_sd
    mean[4], factor[4, 4] = np.log(p.C5.median), p.C5.log_sd
    mean[3] = (np.log(20 / 9) + mean[2] + 5 * mean[4] + np.log(p.softening.median)) / 6
    factor[3, 2], factor[3, 4], factor[3, 3] = factor[2, 2] / 6, 5 * factor[4, 4] / 6, p.softening.log_sd / 6
    return mean, factor


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
def base_columns(state: State, tests: Tests, linear: Linear, prior: tuple[Array, Array], power: float) -> Any:
    """Columns of the population, and the data less what the priors' means say."""
    mean, factor = prior
    flatness = tests.flatness
    at = particle_means(state.population, flatness, power)
    slope = jax.jacfwd(lambda b: particle_means(b, flatness, power))(state.population)
    columns = jnp.einsum("npk,nkb,bc->npc", linear.columns[..., :4], slope, factor)
    away = at + jnp.einsum("nkb,b->nk", slope, mean - state.population) - state.point.latent
    data = linear.residual - jnp.einsum("npk,nk->np", linear.columns[..., :4], away)
    return columns, data


@dataclass(frozen=True)
class Base:
    """The tests, the base fit, and the priors as the linear model has them."""

    fit: Fit
    model: Model

    @property
    def tests(self) -> Tests:
        return self.fit.tests

    @property
    def prior(self) -> tuple[Array, Array]:
        mean, factor = population_prior(self.model)
        return jnp.asarray(mean), jnp.asarray(factor)

    @property
    def spreads(self) -> tuple[Any, ...]:
        p = self.model.chosen_priors
        return p.tau_C1, p.tau_C3, p.tau_C5, p.modulus_scatter

    def start_state(self) -> State:
        p = self.fit.population
        shift = float(jnp.mean(jnp.log1p(p.a * self.tests.flatness)))
        beta = jnp.concatenate([jnp.stack([p.a, p.log_modulus]), p.mu + shift])
        return State(replace(self.fit.point, theta=jnp.zeros((len(self.tests), 0))), beta)

    def start_free(self) -> np.ndarray:
        p = self.fit.population
        noise = np.asarray(self.fit.noise.noise.logs)
        tau = [*np.asarray(p.tau), max(float(p.modulus_scatter), 1e-3)]
        x = [float(SpreadCoordinate(s).coordinate(max(float(t), 1e-4))) for s, t in zip(self.spreads, tau, strict=True)]
        return np.concatenate([noise, np.maximum(x, 0.3)])


def design_of(
    base: Base,
    state: State,
    variants: tuple[Variant, ...],
    basis: Array | None = None,
    misfits: Any = None,
    group: Any = None,
    *,
    own_columns: Array | None = None,
    own_spreads: tuple[Any, ...] = (),
    amplitude_columns: Array | None = None,
    largest: tuple[float, ...] = (),
    sign: tuple[int, ...] = (),
) -> Design:
    """The design of a hypothesis around a state."""
    tests, model = base.tests, base.model
    forms = Forms(model.unloading, variants)
    linear = linear_data(state.point, tests, forms)
    population, data = base_columns(state, tests, linear, base.prior, model.shape_power)
    zero_mean, zero_sd = np.asarray(model.zero_prior)
    ones = jnp.where(tests.mask, 1.0, 0.0)
    away = tests.contact + zero_mean - state.point.zero
    data = data - away[:, None] * ones
    own = jnp.concatenate([linear.columns[..., :4], (zero_sd * ones)[..., None]], -1)
    if own_columns is not None:
        own = jnp.concatenate([own, own_columns], -1)
    K = len(variants)
    effect = linear.columns[..., 4:]
    units = np.array([v.plausible[0] for v in variants])
    amplitude = effect[..., :K] * jnp.asarray(units)
    if amplitude_columns is not None:
        amplitude = jnp.concatenate([amplitude, amplitude_columns], -1)
    theta = state.point.theta
    data = data + jnp.einsum("npk,nk->np", effect[..., :K], theta[:, :K])
    common = [population]
    place = K
    for v in variants:
        for n in v.nuisances:
            mean, sd = nuisance_moments(n)
            at = theta[0, place]
            column = effect[..., place]
            if n.plausible[0] > 0:
                column, at = column * at, jnp.log(at)
            data = data - column * (mean - at)
            common.append((sd * column)[..., None])
            place += 1
    missing = 2 * amplitude.shape[-1] - sum(len(v.nuisances) for v in variants)
    if missing > 0:  # columns of nothing: one shape for all formulas
        common.append(jnp.zeros((*tests.mask.shape, missing)))
    group_ = [0] * sum(c.shape[-1] for c in common)
    if basis is not None:
        common.append(basis)
        group_ += list(group)
    priors = model.chosen_priors.noise
    noise = jnp.asarray(np.stack([np.log(np.asarray(priors.median)), np.asarray(priors.log_sd)]))
    kinds = Kinds((*base.spreads, *own_spreads), model.correlation, model.along)
    return Design(
        tests,
        linear,
        own,
        jnp.concatenate(common, -1),
        amplitude,
        data,
        base.fit.noise.noise.scale,
        jnp.asarray(np.array(group_, int)),
        noise,
        jnp.asarray(np.array([*(v.plausible[1] / v.plausible[0] for v in variants), *largest])),
        jnp.asarray(np.array([*(v.sign for v in variants), *sign], float)),
        jnp.asarray(np.zeros((0, 2)) if misfits is None else np.asarray(misfits)),
        kinds,
    )


def moved(base: Base, state: State, variants: tuple[Variant, ...], solution: Solution, share: float) -> State:
    """The state a share of the way to a solution."""
    tests, model = base.tests, base.model
    mean, factor = base.prior
    beta = mean + factor @ solution.common[:5]
    beta = state.population + share * (beta - state.population)
    flatness = tests.flatness
    slope = jax.jacfwd(lambda b: particle_means(b, flatness, model.shape_power))(state.population)
    at = particle_means(state.population, flatness, model.shape_power)
    target = (
        at
        + jnp.einsum("nkb,b->nk", slope, mean + factor @ solution.common[:5] - state.population)
        + solution.own[:, :4]
    )
    latent = state.point.latent + share * (target - state.point.latent)
    zero_mean, zero_sd = np.asarray(model.zero_prior)
    zero = tests.contact + zero_mean + zero_sd * solution.own[:, 4]
    zero = state.point.zero + share * (zero - state.point.zero)
    units = np.array([v.plausible[0] for v in variants])
    numbers = [units[k] * solution.amplitude[k] for k in range(len(variants))]
    place = 5
    old = state.point.theta[0]
    for v in variants:
        for n in v.nuisances:
            m, sd = nuisance_moments(n)
            x = m + sd * solution.common[place]
            now = old[len(numbers)]
            if n.plausible[0] > 0:
                x = jnp.exp(jnp.log(now) + share * jnp.clip(x - jnp.log(now), -1.0, 1.0))
                numbers.append(x)
            else:
                numbers.append(now + share * (jnp.clip(x, *n.plausible) - now))
            place += 1
    K = len(variants)
    theta = (
        jnp.stack(
            [
                old[k] + share * (jnp.asarray(numbers[k]) - old[k]) if k < K else jnp.asarray(numbers[k])
                for k in range(len(numbers))
            ]
        )
        if numbers
        else jnp.zeros(0)
    )
    return State(Point(latent, zero, jnp.broadcast_to(theta, (len(tests), len(numbers)))), beta)
