"""What is needed last is compiled while the first steps run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._blocks import Blocks, count_of
from ._data import Tests
from ._drawer import chunk_of, stride_of
from ._importance import AT_A_TIME, log_densities
from ._large import PROBES
from ._linearised import expected_latent
from ._mode import FIRST_SPREAD, Target, gradients
from ._model import JointModel, prior_numbers
from ._noise import Whitening
from ._nuts import Length, side_by_side
from ._population import Population, Scatter, Summary
from ._sampling import Exact, draw_particles


def compile_ahead(tests: Tests, block: int, model: JointModel, length: Length) -> None:
    """Compile the same functions as will be called, for arrays of the same shapes.

    Those of the population and those of the particles side by side: the fit, which compiles what it needs itself, would
    otherwise wait for this to end.
    """
    # Almost all campaigns pin their coefficients down; the others compile again.
    sharp = replace(model.scatter, newton=0)
    side_by_side(
        lambda compile_part: compile_part(),
        (lambda: _population(tests, model, sharp), lambda: _particles(tests, block, model, sharp, length)),
    )


def _population(tests: Tests, model: JointModel, sharp: Scatter) -> None:
    """What finds the population's mode, and draws around it; the sampler proper is hardly ever called for."""
    d = FIRST_SPREAD + model.scatter.size
    numbers = prior_numbers(model.beliefs, tests.flatness, tests.weight)
    target = Target(numbers, _quadratic(len(tests)), model.scatter)
    cast(Any, expected_latent).lower(_dummy(d), target).compile()
    target = replace(target, scatter=sharp)
    cast(Any, gradients).lower(_dummy(2 * d + 1, d), target).compile()
    cast(Any, log_densities).lower(_dummy(AT_A_TIME, d), target).compile()


def _particles(tests: Tests, block: int, model: JointModel, sharp: Scatter, length: Length) -> None:
    """What draws the particles back and looks at the draws."""
    import arviz_stats.base  # noqa: F401  # seconds on a cold machine, so here too

    if Blocks(len(tests), block).mesh is not None:
        return  # for several devices it is another function
    some_tests = jax.tree.map(lambda x: x[:block], tests)
    points = tests.force.shape[1]
    filters = eqx.filter_vmap(Whitening)(*(_dummy(block, points) for _ in range(4)), some_tests.branch)
    exact = Exact(some_tests, filters, _quadratic(block), sharp, model.zero_sd, model.unloading)
    all_compared = stride_of(count_of(tests), length.total) == 1
    several = _dummy((chunk_of(length.total) or length.total) if all_compared else PROBES)
    triple = _dummy(*several.shape, 3)
    some = eqx.filter_vmap(Population)(several, several, triple, triple, several, several, several)
    cast(Any, draw_particles).lower(jax.random.key(0)[None], some, exact, 1, _dummy() > 2).compile()


def _dummy(*shape: int) -> Array:
    return jnp.asarray(np.ones(shape))


def _quadratic(count: int) -> Summary:
    one, four = _dummy(count), _dummy(count, 4)
    return Summary(four, _dummy(count, 4, 4), four, one, one, one, four, one)
