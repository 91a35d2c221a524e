"""The draws behind the posterior: the sampler's runs, every particle drawn back, weights applied, diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._blocks import count_of
from ._compile import compiled
from ._data import Tests
from ._drawer import RESTLESS, Drawer
from ._fit import population_at, populations
from ._large import PROBES, correction, evenly, sample_weighted
from ._mode import Target
from ._model import JointFit, JointModel
from ._nuts import Chains
from ._population import COEFFICIENTS, Population, Scatter, laplace
from ._sampling import Exact, ParticleDraws, sample_joint, sample_population
from ._weights import PARETO_K_MOST, diagnostics, ordered_resample, pareto_k, smoothed_weights, unrest

MOST_CHECKED = 400_000
"""Up to as many draws of single particles, every one is compared with the exact likelihood and the weights are applied;
of larger campaigns some draws are compared, to know how good each particle's summary is, and the population is
corrected by regression (`_large`)."""

CANDIDATES, CANDIDATES_OF_MANY = (16, 64), (2, 16)
"""How many a restless particle gets: first, and the few that scatter most even then."""

RESTLESS_OF_MANY = 0.1
"""`RESTLESS` where the weights of the others are not applied: a mean of one of these is wrong by at most this share of
its standard deviation."""

LEAST_RATIO = -50.0
"""Log ratio that counts for a probe at which the exact likelihood vanishes."""

UNSURE = 0.3
"""Standard error of the correction, in standard deviations of the posterior, from which on a reader is told."""

MOST_PARTICLE_DRAWS = 4_000_000
"""At most as many draws of single particles are kept; of very large campaigns every n-th draw."""

ACCEPT = (0.8, 0.95, 0.99)
"""Acceptance that the sampler aims at: after divergences once more, and once more, with smaller steps."""


class Length(NamedTuple):
    """How long the sampler runs: chains, and draws of each before and after it has settled."""

    chains: int
    warmup: int
    draws: int

    @property
    def total(self) -> int:
        """Draws kept of all chains."""
        return self.chains * self.draws


SHARP = 0.03
"""Posterior standard deviation of the logarithm of a polynomial's coefficient below which one Newton step is enough."""

_laplace = compiled(laplace)


def newton_steps(fit: JointFit, tests: Tests, model: JointModel) -> int:
    """How many Newton steps the integration over the particles needs: none if every coefficient is known sharply."""
    population = population_at(fit.mode, fit.numbers, model.scatter)
    at = _laplace(population, fit.summary, tests.flatness, model.scatter)
    variance = np.diagonal(np.linalg.inv(np.asarray(at.hessian)[: count_of(tests)]), axis1=1, axis2=2)
    widest = float(np.max(np.sqrt(variance) * np.asarray(at.stretch)))
    return 0 if widest < SHARP else 4


def stride_of(count: int, total: int) -> int:
    """Every how many-th draw is compared with the exact likelihood: all of them for few particles."""
    return max(1, -(-total * count // MOST_CHECKED))


def draw_fast(key: Array, tests: Tests, model: JointModel, fit: JointFit, length: Length, block: int) -> dict[str, Any]:
    """The population sampled, the particles drawn back and corrected by exact weights: fields of the result."""
    scatter = replace(model.scatter, newton=newton_steps(fit, tests, model))
    exact = Exact(tests, fit.filters, fit.summary, scatter, model.zero_sd, model.unloading)
    target = Target(fit.numbers, fit.summary, scatter)
    return draw_around(key, fit.mode, fit.covariance, target, exact, model, length, block)


def draw_around(
    key: Array,
    mode: Array,
    covariance: Array,
    target: Target,
    exact: Exact,
    model: JointModel,
    length: Length,
    block: int = 0,
) -> dict[str, Any]:
    """The same for any density of the population, around its mode, and any exact likelihood of the tests.

    More than one block (0 for a single one) takes tests whose every array has one row per particle.
    """
    tests, scatter = exact.tests, exact.scatter
    population_key, particle_key, check_key, pick_key = jax.random.split(key, 4)
    few = stride_of(count_of(tests), length.total) == 1
    run, population = _sampled(population_key, mode, covariance, target, length, not few)
    names, stacked = _stack(population, scatter, length)
    flat = stacked.reshape(length.total, -1)
    if few:
        found = _weighted(Drawer(exact, block), population, length, check_key, pick_key)
    else:
        keys = check_key, pick_key, particle_key
        found = _corrected(Drawer(exact, block, PROBES), population, flat, length, *keys)
    stacked, population = flat[found.chosen].reshape(stacked.shape), _every(population, found.chosen)
    particles = found.particles[:3]
    return {
        **_fields(run, population, names, stacked, particles, tests, model, length, found.keep),
        "pareto_k": found.k,
        "pareto_k_joint": found.k_joint,
        "weights_applied": few,
        "notes": found.notes,
    }


class _Drawn(NamedTuple):
    """Particles drawn back.

    Attributes:
        chosen: which draws of the population stand for the weighted ones.
        particles: under every `keep`-th of these.
        k: Pareto k of every particle's weights.
        k_joint: of the population's.
        keep: see `particles`.
        notes: what a reader must know.
    """

    chosen: np.ndarray
    particles: ParticleDraws
    k: np.ndarray
    k_joint: float
    keep: int = 1
    notes: tuple[str, ...] = ()


def _weighted(drawer: Drawer, population: Population, length: Length, check_key: Array, pick_key: Array) -> _Drawn:
    """Few particles: the weight of a draw is the product of all particles' ratios of exact to quadratic likelihood."""
    particles = drawer.all(check_key, population)
    ratio = np.asarray(particles.log_ratio)
    k = pareto_k(ratio)
    restless = np.flatnonzero((unrest(ratio) > RESTLESS) | (k > PARETO_K_MOST))
    drawer.settle(pick_key, particles, population, k, restless, CANDIDATES)
    chosen, k_joint = _resampled(ratio.sum(1), length)
    return _Drawn(chosen, jax.tree.map(lambda x: x[chosen], particles), k, k_joint)


def _corrected(
    drawer: Drawer,
    population: Population,
    parameters: np.ndarray,
    length: Length,
    check_key: Array,
    pick_key: Array,
    particle_key: Array,
) -> _Drawn:
    """Many particles: the draws of the population are weighted by regression (`_large.correction`).

    Of each particle some draws are compared with the exact likelihood. Those whose weights scatter are drawn from
    several candidates; of the others the draws are left as they are.
    """
    checks = PROBES * max(2, MOST_CHECKED // (PROBES * drawer.count))
    ratio = np.asarray(drawer.all(check_key, _every(population, evenly(length.total, checks))).log_ratio)
    scatter, k = unrest(ratio), pareto_k(ratio)
    # Of a likelihood that ends at a cliff, single candidates fall off it as the population moves.
    wild = np.flatnonzero(scatter > RESTLESS)

    def total(which: int, rows: np.ndarray) -> np.ndarray:
        probes, own = _every(population, rows), jax.random.fold_in(check_key, which)
        ratio = np.asarray(drawer.all(own, probes, common=True).log_ratio)
        if len(wild):
            ratio[:, wild] = drawer.some(own, wild, probes, CANDIDATES[-1], common=True).log_ratio
        return np.maximum(ratio, LEAST_RATIO).sum(1)

    log_weight, error = correction(total, parameters)
    notes = (f"the means of the population are known to {error:.2f} of their standard deviations only",)
    chosen, k_joint = _resampled(log_weight, length)
    keep = max(1, -(-length.total * drawer.count // MOST_PARTICLE_DRAWS))
    some = _every(_every(population, chosen), keep)
    particles = drawer.all(particle_key, some, 0)
    restless = np.flatnonzero((scatter > RESTLESS_OF_MANY) | (k > PARETO_K_MOST))
    drawer.settle(pick_key, particles, some, k, restless, CANDIDATES_OF_MANY)
    return _Drawn(chosen, particles, k, k_joint, keep, notes if error > UNSURE else ())


def _resampled(log_weight: np.ndarray, length: Length) -> tuple[np.ndarray, float]:
    """Which draws stand for the weighted ones, in order within each chain, and the Pareto k of the weights."""
    weight, k = smoothed_weights(log_weight)
    rows = (slice(c * length.draws, (c + 1) * length.draws) for c in range(length.chains))
    return np.concatenate([row.start + ordered_resample(weight[row], length.draws) for row in rows]), k


def _sampled(
    key: Array, mode: Array, covariance: Array, target: Target, length: Length, many: bool
) -> tuple[Chains, Population]:
    """Draws of the population: of many particles weighted ones, if they are good enough, else the sampler's.

    If any trajectory diverged, the sampler runs again with smaller steps.
    """
    if many:
        found = sample_weighted(key, mode, covariance, target, chains=length.chains, draws=length.draws)
        if found is not None:
            return found

    def run(accept: float) -> tuple[Chains, Population]:
        # From an array, not from a Python number: a weak type would be compiled anew after `compile_ahead`.
        aim = jnp.asarray(np.asarray(accept))
        found = sample_population(key, mode, covariance, target, aim, **length._asdict())
        return cast(Any, jax.tree.map(np.asarray, found))

    chains, population = run(ACCEPT[0])
    for accept in ACCEPT[1:]:
        if not np.any(np.asarray(chains.divergent)):
            break
        chains, population = run(accept)
    return chains, population


def draw_joint(key: Array, tests: Tests, model: JointModel, fit: JointFit, length: Length) -> dict[str, Any]:
    """Population and particles sampled together under the exact likelihood: fields of the result."""
    scatter = replace(model.scatter, newton=newton_steps(fit, tests, model))
    exact = Exact(tests, fit.filters, fit.summary, scatter, model.zero_sd, model.unloading)
    found = sample_joint(key, fit.mode, fit.covariance, fit.numbers, exact, **length._asdict())
    run, free, *particles = jax.tree.map(np.asarray, found)
    count = len(tests)
    population = populations(free.reshape(-1, free.shape[-1]), fit.numbers, scatter)
    names, stacked = _stack(population, scatter, length)
    return {
        **_fields(run, population, names, stacked, particles, tests, model, length),
        "pareto_k": np.zeros(count),
        "pareto_k_joint": None,
        "weights_applied": False,
    }


def _fields(
    run: Chains,
    population: Population,
    names: list[str],
    stacked: np.ndarray,
    particles: Sequence[Any],
    tests: Tests,
    model: JointModel,
    length: Length,
    keep: int = 1,
) -> dict[str, Any]:
    """What the results of both modes have in common; of the population every `keep`-th draw of each chain."""

    def shaped(x: Any) -> np.ndarray:
        return np.asarray(x).reshape(length.chains, length.draws, *x.shape[1:])[:, ::keep]

    population = jax.tree.map(shaped, population)
    rhat, bulk, tail = diagnostics(names, stacked)
    count = count_of(tests)
    latent, zero, likelihood = (np.asarray(v) for v in particles)
    return {
        "population": population,
        **_particles(latent, zero, population, np.asarray(tests.flatness)[:count], model, length.chains),
        "log_likelihood": likelihood.reshape(length.chains, -1, count),
        "divergences": int(np.sum(np.asarray(run.divergent))),
        "rhat": rhat,
        "ess_bulk": bulk,
        "ess_tail": tail,
        "leapfrogs": float(np.mean(np.asarray(run.steps))),
    }


def _particles(
    latent: np.ndarray, zero: np.ndarray, population: Population, flatness: np.ndarray, model: JointModel, chains: int
) -> dict[str, np.ndarray]:
    """C, modulus, zero and shape factor of the particles from their latent vectors."""
    count = len(flatness)
    eta = 1 + np.asarray(population.a)[..., None] * flatness
    latent = latent.reshape(chains, -1, count, 4)
    log_eta = np.log(eta)
    # What scatter of `a` there is has gone into b alone; a particle's coefficients are those under the common a.
    C = np.exp(latent[..., :3] - log_eta[..., None])
    modulus = np.exp(latent[..., 3] - model.shape_power * log_eta)
    return {"C": C, "modulus_MPa": modulus, "zero_um": zero.reshape(chains, -1, count), "shape_factor": eta}


def _every(population: Population, which: int | np.ndarray) -> Population:
    """Every so-many-th draw, or those at given positions."""
    rows = slice(None, None, which) if isinstance(which, int) else which
    return jax.tree.map(lambda x: np.asarray(x)[rows], population)


def _stack(population: Population, scatter: Scatter, length: Length) -> tuple[list[str], np.ndarray]:
    columns = {"a": population.a, "log_modulus": population.log_modulus}
    columns |= {f"mu_{n}": population.mu[:, j] for j, n in enumerate(COEFFICIENTS)}
    columns |= {f"tau_{n}": population.tau[:, j] for j, n in enumerate(COEFFICIENTS)}
    if scatter.modulus:
        columns["modulus_scatter"] = population.modulus_scatter
    if scatter.shape:
        columns["shape_scatter"] = population.shape_scatter
    columns["noise_factor"] = population.log_noise
    columns |= population.further()
    return list(columns), np.stack([np.asarray(v).reshape(length.chains, length.draws) for v in columns.values()], -1)
