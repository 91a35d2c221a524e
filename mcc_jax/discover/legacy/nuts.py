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

from ..._types import Scalar, ScalarLike

PAIR = 2


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


def sample(
    keys: Key[Array, " chains"],
    log_density: Callable[[Float[Array, " d"]], Scalar],
    mode: Float[Array, " d"],
    factor: Float[Array, "d d"],
    *,
    warmup: int,
    draws: int,
    accept: ScalarLike = 0.8,
    together: bool = False,
) -> Chains:
    """Sample a density whose mode and covariance are roughly known.

    The sampler works in coordinates in which that covariance is the identity, so little is left to adapt. Call it
    inside `jit`: MCMC objects of NumPyro compile anew for every data set, this does so once per shape.

    Args:
        keys: a random key for every chain.
        log_density: log density in unbounded coordinates.
        mode: centre of the coordinates; chains begin scattered around it.
        factor: Cholesky factor of the covariance.
        warmup: draws thrown away while the step size adapts.
        draws: draws kept per chain.
        accept: mean acceptance that the step size aims at; higher is slower and follows narrower densities.
        together: advance all chains in step (for accelerators), instead of one after the other.
    """
    from numpyro.infer import NUTS

    dimension = mode.shape[0]

    def potential(z: Float[Array, " d"]) -> Scalar:
        value = -log_density(mode + factor @ z)
        return jnp.where(jnp.isnan(value), jnp.inf, value)

    def chain(key):
        # A traced number does as well as a Python one: another value then needs no new compilation.
        target = cast(float, accept)
        kernel = NUTS(potential_fn=potential, dense_mass=dimension < 40, target_accept_prob=target)
        start_key, key = jax.random.split(key)
        start = jax.random.normal(start_key, (dimension,), mode.dtype)
        state = kernel.init(key, warmup, start, (), {})

        def advance(state, _):
            state = kernel.sample(state, (), {})
            return state, (state.z, state.diverging, state.num_steps)

        # One loop for both, so that the sampler is compiled once.
        state, (z, divergent, steps) = jax.lax.scan(advance, state, None, length=warmup + draws)
        return z[warmup:], divergent[warmup:], steps[warmup:], state.adapt_state.step_size

    # NumPyro counts on JAX's usual promotion of types and ranks, whatever the caller's settings are.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        z, divergent, steps, step_size = jax.vmap(chain)(keys) if together else jax.lax.map(chain, keys)
    return Chains(mode[None, None] + jnp.einsum("ij,cnj->cni", factor, z), divergent, steps, step_size)
