"""NumPyro's No-U-Turn sampler as one compiled function of the data."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray

from .._types import Scalar
from .compiling import compiled
from .mode import LogPosterior
from .noise import standard_promotion

PAIR = 2
"""Chains that one call of the sampler takes, on a CPU."""

MAX_TREE_DEPTH = 6
"""Around its mode, in coordinates scaled by the curvature there, a density that is near normal takes 7 leapfrog steps a
draw; one that needs more than 63 is not one this sampler should be trusted with, and shows in R-hat."""


class Chains(NamedTuple):
    """Draws of several chains.

    Attributes:
        position: coordinates, shape (chains, draws, d).
        divergent: whether the trajectory diverged.
        steps: leapfrog steps of each draw.
        step_size: after adaptation, one per chain.
    """

    position: Float[Array, "chains draws d"]
    divergent: Bool[Array, "chains draws"]
    steps: Int[Array, "chains draws"]
    step_size: Float[Array, " chains"]


class Length(NamedTuple):
    """How long the sampler runs: chains, and draws of each before and after it has settled."""

    chains: int
    warmup: int
    draws: int

    @property
    def total(self) -> int:
        """Draws kept of all chains."""
        return self.chains * self.draws


def by_chains[T](function: Callable[..., T], key: PRNGKeyArray, length: Length, *arguments: object) -> T:
    """What `function(keys, *arguments, warmup=..., draws=...)` returns for a key per chain, as NumPy arrays.

    On a CPU, where a chain keeps one core busy with small operations, chains run two by two, side by side. The pairs do
    not depend on the number of cores: the same seed gives the same bits on any.

    Args:
        function: compiled; every array of its result has the chains, or their draws in a row, along its first axis.
        key: random key.
        length: how many chains, and how long.
        arguments: passed on.
    """
    keys = jax.random.split(key, length.chains)
    size = chains_together(length.chains)

    def run(some: Array) -> T:
        return jax.tree.map(np.asarray, function(some, *arguments, warmup=length.warmup, draws=length.draws))

    results = side_by_side(run, [keys[i : i + size] for i in range(0, length.chains, size)])
    return jax.tree.map(lambda *parts: np.concatenate(parts), *results)


def side_by_side[A, B](function: Callable[[A], B], arguments: Iterable[A]) -> list[B]:
    """What a function returns for each of its arguments, on as many threads as there are cores."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, arguments))


def chains_together(chains: int) -> int:
    """How many chains one call of `by_chains` takes: all of them on an accelerator, which advances them in step."""
    return PAIR if jax.default_backend() == "cpu" and chains % PAIR == 0 else chains


@compiled
def sample_density(
    keys: Key[Array, " chains"],
    mode: Float[Array, " d"],
    covariance: Float[Array, "d d"],
    target: LogPosterior,
    accept: Scalar,
    *,
    warmup: int,
    draws: int,
) -> Chains:
    """Sample the population, all particles integrated out, around a mode and covariance that are roughly known.

    The sampler works in coordinates in which that covariance is the identity, so little is left to adapt. MCMC objects
    of NumPyro compile anew for every data set, this does so once per shape.

    Args:
        keys: a random key for every chain.
        mode: centre of the coordinates; chains begin scattered around it.
        covariance: there.
        target: the density.
        accept: mean acceptance that the step size aims at; higher is slower and follows narrower densities.
        warmup: draws thrown away while the step size adapts.
        draws: draws kept per chain.
    """
    from numpyro.infer import NUTS

    dimension, factor = mode.shape[0], jnp.linalg.cholesky(covariance)

    def potential(z: Float[Array, " d"]) -> Scalar:
        value = -target.log_density(mode + factor @ z)
        return jnp.where(jnp.isnan(value), jnp.inf, value)

    def chain(key):
        # A traced number does as well as a Python one: another value then needs no new compilation.
        kernel = NUTS(
            potential_fn=potential,
            dense_mass=True,
            target_accept_prob=cast(float, accept),
            max_tree_depth=MAX_TREE_DEPTH,
        )
        start_key, key = jax.random.split(key)
        start = jax.random.normal(start_key, (dimension,), mode.dtype)
        state = kernel.init(key, warmup, start, (), {})

        def advance(state, _):
            state = kernel.sample(state, (), {})
            return state, (state.z, state.diverging, state.num_steps)

        # One loop for both, so that the sampler is compiled once.
        state, (z, divergent, steps) = jax.lax.scan(advance, state, None, length=warmup + draws)
        return z[warmup:], divergent[warmup:], steps[warmup:], state.adapt_state.step_size

    together = jax.default_backend() != "cpu"
    with standard_promotion():
        z, divergent, steps, step_size = jax.vmap(chain)(keys) if together else jax.lax.map(chain, keys)
    return Chains(mode[None, None] + jnp.einsum("ij,cnj->cni", factor, z), divergent, steps, step_size)
