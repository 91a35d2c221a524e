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
from ._drawer import stride_of
from ._large import AT_A_TIME, PROBES, log_densities
from ._mode import FIRST_SPREAD, Target
from ._model import JointModel, prior_numbers
from ._noise import Whitening
from ._nuts import Length, chains_together
from ._population import Population, Summary
from ._sampling import Exact, draw_particles, sample_population


def compile_ahead(tests: Tests, block: int, model: JointModel, length: Length) -> None:
    """Compile the same functions as will be called, for arrays of the same shapes."""
    count, points = tests.force.shape
    d = FIRST_SPREAD + model.scatter.size
    blocks = Blocks(count, block)

    def dummy(*shape: int) -> Array:
        return jnp.asarray(np.ones(shape))

    def quadratic(count: int) -> Summary:
        one, four = dummy(count), dummy(count, 4)
        return Summary(four, dummy(count, 4, 4), four, one, one, one, four, one)

    # Almost all campaigns pin their coefficients down; the others compile again.
    scatter = replace(model.scatter, newton=0)
    target = Target(prior_numbers(model.beliefs, tests.flatness, tests.weight), quadratic(count), scatter)
    stride = stride_of(count_of(tests), length.total)
    if stride > 1:
        cast(Any, log_densities).lower(dummy(AT_A_TIME, d), target).compile()
    else:
        keys = jax.random.split(jax.random.key(0), chains_together(length.chains))
        cast(Any, sample_population).lower(
            keys, dummy(d), dummy(d, d), target, dummy(), warmup=length.warmup, draws=length.draws
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
