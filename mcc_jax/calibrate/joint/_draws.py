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
from ._fit import population_at, populations
from ._mode import Target
from ._model import JointFit, JointModel, prior_numbers
from ._noise import Whitening
from ._nuts import Chains
from ._population import COEFFICIENTS, Population, Scatter, Summary, laplace
from ._sampling import Exact, draw_particles, sample_joint, sample_population
from ._weights import diagnostics, ordered_resample, pareto_k, smoothed_weights, unrest

MOST_CHECKED = 400_000
"""Up to as many draws of single particles, every one is compared with the exact likelihood and the weights are applied;
of larger campaigns some draws are compared, to know how good each particle's summary is."""

RESTLESS = 0.3
"""A particle whose weight scatters by more than this share of its mean gets several candidates per draw."""

CANDIDATES = (16, 64)
"""How many: first, and for the few that scatter most even then."""

FEW = 4

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
    cast(Any, sample_population).lower(
        jax.random.key(0), dummy(d), dummy(d, d), target, dummy(), **length._asdict()
    ).compile()
    import arviz_stats.base  # noqa: F401  # seconds on a cold machine, so here too

    if blocks.mesh is not None:
        return  # for several devices it is another function
    some_tests = jax.tree.map(lambda x: x[:block], tests)
    filters = eqx.filter_vmap(Whitening)(*(dummy(block, points) for _ in range(4)), some_tests.branch)
    exact = Exact(some_tests, filters, quadratic(block), scatter, model.zero_sd, model.unloading)
    several = dummy(len(range(0, length.total, _stride(count_of(tests), length.total))))
    triple = dummy(*several.shape, 3)
    some = eqx.filter_vmap(Population)(several, several, triple, triple, several, several, several)
    cast(Any, draw_particles).lower(jax.random.key(0)[None], some, exact, 1).compile()


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
    run, population = _settled(population_key, mode, covariance, target, length)
    count = count_of(tests)
    stride = _stride(count, length.total)
    blocks = Blocks(len(tests), block)
    own = blocks.cut(exact)

    def drawn(key: Array, population: Population, candidates: int = 1) -> list[np.ndarray]:
        found = blocks.each(draw_particles, blocks.keys(key), population, own, candidates, axis=1)
        return [np.array(np.asarray(v)[:, :count]) for v in blocks.whole(found)]

    checked = drawn(check_key, _every(population, stride))
    ratio = checked[3]
    k = pareto_k(ratio)
    restless = np.flatnonzero(unrest(ratio) > RESTLESS)
    applied = stride == 1
    notes: list[str] = []
    names, stacked = _stack(population, scatter, length)
    keep, joint = 1, None
    if applied:
        latent, zero, likelihood, ratio = checked
        for candidates in CANDIDATES:
            if not len(restless):
                break
            # Always of one of a few sizes, the first one repeated: every size would be compiled anew.
            size = min(count, 4 ** int(np.ceil(np.log(max(len(restless), 2)) / np.log(4))))
            padded = np.concatenate([restless, np.full(size - len(restless), restless[0])])
            # They are few: every process draws all of them.
            more = draw_particles(
                jax.random.fold_in(pick_key, candidates)[None], population, exact.some(jnp.asarray(padded)), candidates
            )
            better = [np.asarray(v)[:, : len(restless)] for v in more]
            latent[:, restless], zero[:, restless], ratio[:, restless] = better[0], better[1], better[3]
            k[restless] = pareto_k(ratio[:, restless])
            restless = restless[np.argsort(-unrest(ratio[:, restless]))][:FEW]
            restless = restless[unrest(ratio[:, restless]) > RESTLESS]
        weight, joint = smoothed_weights(ratio.sum(1))
        rows = (slice(c * length.draws, (c + 1) * length.draws) for c in range(length.chains))
        chosen = np.concatenate([row.start + ordered_resample(weight[row], length.draws) for row in rows])
        population = jax.tree.map(lambda x: np.asarray(x)[chosen], population)
        latent, zero, likelihood = latent[chosen], zero[chosen], likelihood[chosen]
        stacked = stacked.reshape(length.total, -1)[chosen].reshape(stacked.shape)
    else:
        if len(restless):
            affected = ", ".join(str(i) for i in restless[:5])
            notes.append(f"{len(restless)} particles are far from their quadratic summary (positions {affected}, ...)")
        keep = max(1, -(-length.total * count // MOST_PARTICLE_DRAWS))
        latent, zero, likelihood, _ = drawn(particle_key, _every(population, keep), 0)
    return {
        **_fields(run, population, names, stacked, (latent, zero, likelihood), tests, model, length, keep),
        "pareto_k": k,
        "pareto_k_joint": joint,
        "weights_applied": applied,
        "notes": tuple(notes),
    }


def _settled(key: Array, mode: Array, covariance: Array, target: Target, length: Length) -> tuple[Chains, Population]:
    """The sampler's run and its populations, with smaller steps if any trajectory diverged."""

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


def _every(population: Population, stride: int) -> Population:
    return jax.tree.map(lambda x: x[::stride], population)


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
