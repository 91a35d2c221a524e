"""The draws behind the posterior: the sampler's runs, every particle drawn back, weights applied, diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._blocks import Blocks, count_of
from ._compile import compiled
from ._data import Tests
from ._drawer import RESTLESS, Drawer
from ._fit import population_at, populations
from ._large import PROBES, correction, log_densities, sample_weighted
from ._mode import Target
from ._model import JointFit, JointModel, prior_numbers
from ._noise import Whitening
from ._nuts import Chains
from ._population import COEFFICIENTS, Population, Scatter, Summary, laplace
from ._sampling import Exact, draw_particles, sample_joint, sample_population
from ._weights import PARETO_K_MOST, diagnostics, ordered_resample, pareto_k, smoothed_weights, unrest

MOST_CHECKED = 400_000
"""Up to as many draws of single particles, every one is compared with the exact likelihood and the weights are applied;
of larger campaigns some draws are compared, to know how good each particle's summary is, and the population is
corrected by regression (`_large`)."""

CANDIDATES, CANDIDATES_OF_MANY = (16, 64), (4, 16)
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


def compile_ahead(tests: Tests, block: int, model: JointModel, length: Length) -> None:
    """Compile what is needed last while the first steps run: the same functions, for arrays of the same shapes."""
    count, points = tests.force.shape
    d = 6 + model.scatter.size
    blocks = Blocks(count, block)

    def dummy(*shape: int) -> Array:
        return jnp.asarray(np.ones(shape))

    def quadratic(count: int) -> Summary:
        one, four = dummy(count), dummy(count, 4)
        return Summary(four, dummy(count, 4, 4), four, one, one, one, four, one)

    # Almost all campaigns pin their coefficients down; the others compile again.
    scatter = replace(model.scatter, newton=0)
    target = Target(prior_numbers(model.beliefs, tests.flatness, tests.weight), quadratic(count), scatter)
    stride = _stride(count_of(tests), length.total)
    if stride > 1:
        cast(Any, log_densities).lower(dummy(length.total, d), target).compile()
    else:
        cast(Any, sample_population).lower(
            jax.random.key(0), dummy(d), dummy(d, d), target, dummy(), **length._asdict()
        ).compile()
    import arviz_stats.base  # noqa: F401  # seconds on a cold machine, so here too

    if blocks.mesh is not None:
        return  # for several devices it is another function
    some_tests = jax.tree.map(lambda x: x[:block], tests)
    filters = eqx.filter_vmap(Whitening)(*(dummy(block, points) for _ in range(4)), some_tests.branch)
    exact = Exact(some_tests, filters, quadratic(block), scatter, model.zero_sd, model.unloading)
    several = dummy(length.total if stride == 1 else PROBES)
    triple = dummy(*several.shape, 3)
    some = eqx.filter_vmap(Population)(several, several, triple, triple, several, several, several)
    cast(Any, draw_particles).lower(jax.random.key(0)[None], some, exact, 1, dummy() > 2).compile()


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


def _stride(count: int, total: int) -> int:
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
    stride = _stride(count_of(tests), length.total)
    drawer = Drawer(exact, block, None if stride == 1 else PROBES)
    run, population = _sampled(population_key, mode, covariance, target, length, stride > 1)
    names, stacked = _stack(population, scatter, length)
    checked = drawer.all(check_key, _every(population, stride))
    k = pareto_k(np.asarray(checked.log_ratio))
    applied, keep, notes = stride == 1, 1, ()
    scatters = unrest(np.asarray(checked.log_ratio)) > (RESTLESS if applied else RESTLESS_OF_MANY)
    restless = np.flatnonzero(scatters | (k > PARETO_K_MOST))
    if applied:
        particles = checked
        drawer.settle(pick_key, particles, population, k, restless, CANDIDATES)
        chosen, joint = _resampled(np.asarray(particles.log_ratio).sum(1), length)
        particles = jax.tree.map(lambda x: x[chosen], particles)
    else:

        def total(which: int, rows: np.ndarray) -> np.ndarray:
            probes, own = _every(population, rows), jax.random.fold_in(check_key, which)
            ratio = np.asarray(drawer.all(own, probes, common=True).log_ratio)
            if len(restless):
                ratio[:, restless] = drawer.some(own, restless, probes, CANDIDATES_OF_MANY[0], common=True).log_ratio
            return np.maximum(ratio, LEAST_RATIO).sum(1)

        log_weight, error = correction(total, stacked.reshape(length.total, -1))
        if error > UNSURE:
            notes = (f"the population's means are uncertain by {error:.2f} standard deviations of their posterior",)
        chosen, joint = _resampled(log_weight, length)
        keep = max(1, -(-length.total * drawer.count // MOST_PARTICLE_DRAWS))
        some = _every(_every(population, chosen), keep)
        particles = drawer.all(particle_key, some, 0)
        drawer.settle(pick_key, particles, some, k, restless, CANDIDATES_OF_MANY)
    stacked = stacked.reshape(length.total, -1)[chosen].reshape(stacked.shape)
    return {
        **_fields(run, _every(population, chosen), names, stacked, particles[:3], tests, model, length, keep),
        "pareto_k": k,
        "pareto_k_joint": joint,
        "weights_applied": applied,
        "notes": notes,
    }


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
