"""NumPyro's No-U-Turn sampler as one compiled function of the data."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ..._types import Scalar, ScalarLike


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


def sample(
    key: PRNGKeyArray,
    log_density: Callable[[Float[Array, " d"]], Scalar],
    mode: Float[Array, " d"],
    factor: Float[Array, "d d"],
    *,
    chains: int,
    warmup: int,
    draws: int,
    accept: ScalarLike = 0.8,
    together: bool = False,
) -> Chains:
    """Sample a density whose mode and covariance are roughly known.

    The sampler works in coordinates in which that covariance is the identity, so little is left to adapt. Call it
    inside `jit`: MCMC objects of NumPyro compile anew for every data set, this does so once per shape.

    Args:
        key: random key.
        log_density: log density in unbounded coordinates.
        mode: centre of the coordinates; chains begin scattered around it.
        factor: Cholesky factor of the covariance.
        chains: number of chains.
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

    keys = jax.random.split(key, chains)
    # NumPyro counts on JAX's usual promotion of types and ranks, whatever the caller's settings are.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        z, divergent, steps, step_size = jax.vmap(chain)(keys) if together else jax.lax.map(chain, keys)
    return Chains(mode[None, None] + jnp.einsum("ij,cnj->cni", factor, z), divergent, steps, step_size)
