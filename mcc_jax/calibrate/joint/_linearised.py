"""Tests linear in their particle's own parameters: what the noise is estimated from and what the summaries are made of."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._types import Scalar
from ...law import Unloading
from ._data import Tests
from ._forward import linearise_with_force
from ._mode import PriorNumbers, from_free
from ._noise import Linear, Noise, Whitening, whitening
from ._population import Scatter, Summary, draw_latent


@eqx.filter_jit
def linear_data(
    latent: Float[Array, "particles 4"],
    zero: Float[Array, " particles"],
    tests: Tests,
    zero_sd: Scalar,
    unloading: Unloading,
) -> Linear:
    """Residuals, their derivatives, and how noise of force moves them, around the given latent vectors and zeros."""
    value, J, moved = linearise_with_force(latent, zero, tests, unloading)
    prior = jnp.concatenate([jnp.ones(4), 1 / zero_sd[None] ** 2])
    return Linear(value, J, prior, tests.step, tests.mask, moved)


@eqx.filter_jit
def summarise(
    latent: Float[Array, "particles 4"],
    zero: Float[Array, " particles"],
    contact: Float[Array, " particles"],
    data: Linear,
    noise: Noise,
    zero_sd: Scalar,
) -> tuple[Summary, Whitening]:
    """Quadratic summaries of all tests around the given latent vectors and zeros, by Gauss-Newton curvature.

    Returns:
        The summaries, and the noise filters, in which force noise has become noise of displacement.
    """
    noise_filters = jax.vmap(lambda s, step, mask, moved: whitening(noise, s, step, mask, moved))(
        noise.scale, data.step, data.mask, data.compliance
    )
    r = jax.vmap(lambda f, x: f(x))(noise_filters, data.residual)
    J = jax.vmap(lambda f, x: jax.vmap(f, in_axes=1, out_axes=1)(x))(noise_filters, data.jacobian)
    H = jnp.einsum("nkp,nkq->npq", J, J)
    g = -jnp.einsum("nkp,nk->np", J, r)
    away = zero - contact
    width = 1 / (H[:, 4, 4] + 1 / zero_sd**2)
    pull = g[:, 4] - away / zero_sd**2
    border = H[:, :4, 4]
    summary = Summary(
        point=latent,
        precision=H[:, :4, :4] - border[:, :, None] * border[:, None, :] * width[:, None, None],
        score=g[:, :4] - border * (width * pull)[:, None],
        squares=jnp.sum(r**2, 1) + (away / zero_sd) ** 2 - width * pull**2,
        count=jnp.sum(data.mask, 1).astype(float) - 1,
        zero=zero + width * pull,
        zero_slope=-border * width[:, None],
        zero_sd=jnp.sqrt(width),
    )
    return summary, noise_filters


@eqx.filter_jit
def expected_latent(
    free: Float[Array, " d"],
    numbers: PriorNumbers,
    summary: Summary,
    flatness: Float[Array, " particles"],
    scatter: Scatter,
) -> tuple[Float[Array, "particles 4"], Float[Array, " particles"]]:
    """Most probable latent vectors and zeros of the particles given the population."""
    still = jnp.zeros((flatness.shape[0], scatter.size))
    return draw_latent(from_free(free, numbers, scatter)[0], summary, flatness, scatter, still, still[:, 0])[:2]
