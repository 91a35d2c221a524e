"""What is needed last is compiled while the first steps run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .conditional import chunk_of, stride_of
from .data import Tests
from .importance import log_densities
from .linearise import expected_latent, summarise
from .model import JointModel, prior_numbers
from .noise import DIFFERENCES, Linear, Noise, Whitening, likelihoods
from .nuts import Length, side_by_side
from .population import Population, Scatter, Summary
from .reweighting import PROBES
from .sampling import ExactLikelihood, draw_particles
from .sharding import Blocks, count_of
from .transforms import FIRST_SPREAD, ROWS, LogPosterior, gradients


def compile_ahead(tests: Tests, block: int, model: JointModel, length: Length) -> None:
    """Compile the same functions as will be called, for arrays of the same shapes.

    In the order in which they are needed, and side by side, since the fit would otherwise wait for this to end: it
    compiles itself only what it begins with.
    """
    # Almost all campaigns pin their coefficients down; the others compile again.
    sharp = replace(model.scatter, newton=0)
    many = stride_of(count_of(tests), length.total) > 1
    one_block = jax.tree.map(lambda x: x[:block], tests)
    chunk = PROBES if many else chunk_of(length.total) or length.total
    parts = [lambda: _population(tests, model, sharp, many)]
    if Blocks(len(tests), block).mesh is None:  # for several devices the particles' are other functions
        parts += [lambda: _particles(one_block, model, sharp, chunk), lambda: _noise(one_block, model)]
    side_by_side(lambda compile_part: compile_part(), parts)


def _population(tests: Tests, model: JointModel, sharp: Scatter, many: bool) -> None:
    """What finds the population's mode, and draws around it; the sampler proper is hardly ever called for."""
    d = FIRST_SPREAD + sharp.size
    numbers = prior_numbers(model.chosen_priors, tests.flatness, tests.weight)
    target = LogPosterior(numbers, _quadratic(len(tests)), sharp)
    cast(Any, expected_latent).lower(_dummy(d), target).compile()
    gradients(np.zeros((0, d)), target)
    if many:
        cast(Any, log_densities).lower(_dummy(ROWS, d), target).compile()


def _noise(tests: Tests, model: JointModel) -> None:
    """What estimates the noise and summarises the tests under it."""
    shape = count, points = tests.force.shape
    moved, one = _dummy(*shape), _dummy(count)
    jacobian, prior = _dummy(count, points, 5), _dummy(count, 5)
    common = None if tests.force_zero_sd is None else moved
    path = tests.step, tests.mask, moved, moved, tests.branch
    data = Linear(moved, jacobian, prior, *path, tests.weight, tests.peak_sd, common)
    cast(Any, likelihoods).lower(_dummy(*DIFFERENCES.shape), one, data).compile()
    noise = Noise.of(np.ones(4), one)
    cast(Any, summarise).lower(_dummy(count, 4), one, tests, data, noise, model.zero_sd).compile()


def _particles(tests: Tests, model: JointModel, sharp: Scatter, draws: int) -> None:
    """What draws the particles back and looks at the draws."""
    import arviz_stats.base  # noqa: F401  # seconds on a cold machine, so here too

    count, points = tests.force.shape
    common = None if tests.force_zero_sd is None else _dummy(count, points)
    filters = eqx.filter_vmap(Whitening)(*(_dummy(count, points) for _ in range(4)), tests.branch, common)
    exact = ExactLikelihood(tests, filters, _quadratic(count), sharp, model.zero_sd, model.unloading)
    several, triple = _dummy(draws), _dummy(draws, 3)
    some = eqx.filter_vmap(Population)(several, several, triple, triple, several, several, several)
    cast(Any, draw_particles).lower(jax.random.key(0)[None], some, exact, 1, _dummy() > 2).compile()


def _dummy(*shape: int) -> Array:
    return jnp.asarray(np.ones(shape))


def _quadratic(count: int) -> Summary:
    one, four = _dummy(count), _dummy(count, 4)
    return Summary(four, _dummy(count, 4, 4), four, one, one, one, four, one)
