"""The draws behind the posterior: the sampler's runs, every particle drawn back, weights applied, diagnostics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .conditional import Drawer, chunk_of, corrected, every, stride_of, weighted
from .data import Tests
from .fit import populations
from .importance import sample_weighted
from .linearise import careful_enough
from .model import JointFit, Model
from .nuts import Chains, Length, by_chains
from .population import COEFFICIENTS, Population, Scatter
from .reweighting import PROBES
from .sampling import ExactLikelihood, sample_joint, sample_population
from .sharding import count_of
from .transforms import LogPosterior
from .weights import diagnostics

ACCEPT = (0.8, 0.95, 0.99)
"""Acceptance that the sampler aims at: after divergences once more, and once more, with smaller steps."""


def draw_fast(
    key: Array, tests: Tests, model: Model, fit: JointFit, length: Length, block: int, *, patient: bool = True
) -> dict[str, Any]:
    """The population sampled, the particles drawn back and corrected by exact weights: fields of the result."""
    scatter = careful_enough(fit.mode, LogPosterior(fit.numbers, fit.summary, model.scatter), count_of(tests))
    exact = ExactLikelihood(tests, fit.filters, fit.summary, scatter, model.zero_sd, model.unloading)
    target = LogPosterior(fit.numbers, fit.summary, scatter)
    return draw_around(key, fit.mode, fit.covariance, target, exact, model, length, block, patient=patient)


def draw_around(
    key: Array,
    mode: Array,
    covariance: Array,
    target: LogPosterior,
    exact: ExactLikelihood,
    model: Model,
    length: Length,
    block: int = 0,
    *,
    patient: bool = True,
) -> dict[str, Any]:
    """The same for any density of the population, around its mode, and any exact likelihood of the tests.

    More than one block (0 for a single one) takes tests whose every array has one row per particle. Without patience
    the sampler never runs, which takes minutes where numbers cannot be true: the draws are then those of the proposal.
    """
    tests, scatter = exact.tests, exact.scatter
    population_key, particle_key, check_key, pick_key = jax.random.split(key, 4)
    few = stride_of(count_of(tests), length.total) == 1
    run, population, good = _sampled(population_key, mode, covariance, target, length, not few, patient)
    names, stacked = _stack(population, scatter, length)
    flat = stacked.reshape(length.total, -1)
    if few:
        found = weighted(Drawer(exact, block, chunk_of(length.total)), population, length, check_key, pick_key)
    else:
        keys = check_key, pick_key, particle_key
        found = corrected(Drawer(exact, block, PROBES), population, flat, length, *keys)
    stacked, population = flat[found.chosen].reshape(stacked.shape), every(population, found.chosen)
    particles = found.particles[:3]
    return {
        **_fields(run, population, names, stacked, particles, tests, model, length, found.keep),
        "pareto_k": found.k,
        "pareto_k_joint": found.k_joint if good else np.inf,
        "weights_applied": few,
        "notes": found.notes,
    }


def _sampled(
    key: Array, mode: Array, covariance: Array, target: LogPosterior, length: Length, many: bool, patient: bool
) -> tuple[Chains, Population, bool]:
    """Draws of the population: independent ones, weighted, if the weights are good enough, else the sampler's.

    And whether they are good: without patience the sampler does not run.
    """
    shape: dict[str, Any] = {"chains": length.chains, "draws": length.draws, "many": many}
    found = sample_weighted(key, mode, covariance, target, **shape)
    if found is not None:
        return *found, True
    if not patient:
        bad = sample_weighted(key, mode, covariance, target, **shape, however_bad=True)
        assert bad is not None
        return *bad, False

    return *_patient(lambda aim: by_chains(sample_population, key, length, mode, covariance, target, aim)), True


def _patient[*Ts](run: Callable[[Array], tuple[Chains, *Ts]]) -> tuple[Chains, *Ts]:
    """What the sampler finds; where any trajectory diverged it runs again, with smaller steps."""
    # From arrays, not from Python numbers: another number would be compiled anew.
    first, *smaller = (jnp.asarray(np.asarray(accept)) for accept in ACCEPT)
    found = run(first)
    for accept in smaller:
        if not np.any(np.asarray(found[0].divergent)):
            break
        found = run(accept)
    return found


def draw_joint(key: Array, tests: Tests, model: Model, fit: JointFit, length: Length) -> dict[str, Any]:
    """Population and particles sampled together under the exact likelihood: fields of the result."""
    scatter = careful_enough(fit.mode, LogPosterior(fit.numbers, fit.summary, model.scatter), count_of(tests))
    exact = ExactLikelihood(tests, fit.filters, fit.summary, scatter, model.zero_sd, model.unloading)
    run, free, *particles = _patient(
        lambda aim: by_chains(sample_joint, key, length, fit.mode, fit.covariance, fit.numbers, exact, aim)
    )
    population = populations(free.reshape(-1, free.shape[-1]), fit.numbers, scatter)
    names, stacked = _stack(population, scatter, length)
    return {
        **_fields(run, population, names, stacked, particles, tests, model, length),
        "pareto_k": np.zeros(len(tests)),
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
    model: Model,
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
    latent: np.ndarray, zero: np.ndarray, population: Population, flatness: np.ndarray, model: Model, chains: int
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
