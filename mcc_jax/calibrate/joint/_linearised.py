"""Tests linear in their particle's own parameters: what noise is estimated from and summaries are made of."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._types import Scalar
from ...law import Unloading
from ._compile import compiled
from ._data import Tests
from ._forward import linearise_with_force, snap
from ._mode import Target
from ._noise import Linear, Noise, Whitening, whitening
from ._population import Summary, draw_latent, moments


@compiled
def linear_data(
    latent: Float[Array, "particles 4"],
    zero: Float[Array, " particles"],
    tests: Tests,
    zero_sd: Scalar,
    unloading: Unloading,
) -> Linear:
    """Residuals, their derivatives, and how noise of force moves them, around the given latent vectors and zeros."""
    value, J, moved, by_peak = linearise_with_force(latent, zero, tests, unloading)
    prior = jnp.concatenate([jnp.ones(4), 1 / zero_sd[None] ** 2])
    prior = jnp.broadcast_to(prior, (len(tests), 5))
    return Linear(value, J, prior, tests.step, tests.mask, moved, by_peak, tests.branch, tests.weight)


@compiled
def summarise(
    latent: Float[Array, "particles 4"],
    zero: Float[Array, " particles"],
    tests: Tests,
    data: Linear,
    noise: Noise,
    zero_sd: Scalar,
) -> tuple[Summary, Whitening]:
    """Quadratic summaries of all tests around the given latent vectors and zeros, by Gauss-Newton curvature.

    Returns:
        The summaries, and the noise filters, in which force noise has become noise of displacement.
    """
    noise_filters = jax.vmap(lambda s, *path: whitening(noise, s, *path))(
        noise.scale, data.step, data.mask, data.compliance, data.peak, data.branch
    )
    r = jax.vmap(lambda f, x: f(x))(noise_filters, data.residual)
    J = jax.vmap(lambda f, x: jax.vmap(f, in_axes=1, out_axes=1)(x))(noise_filters, data.jacobian)
    H = jnp.einsum("nkp,nkq->npq", J, J)
    g = -jnp.einsum("nkp,nk->np", J, r)
    slope, offset, weight = jax.vmap(_snap_evidence)(latent, tests.particle, tests.force, tests.mask & tests.loading)
    H = H.at[:, :4, :4].add(weight[:, None, None] * slope[:, :, None] * slope[:, None, :])
    g = g.at[:, :4].add(weight[:, None] * slope * offset[:, None])
    away = zero - tests.contact
    width = 1 / (H[:, 4, 4] + 1 / zero_sd**2)
    pull = g[:, 4] - away / zero_sd**2
    border = H[:, :4, 4]
    summary = Summary(
        point=latent,
        precision=H[:, :4, :4] - border[:, :, None] * border[:, None, :] * width[:, None, None],
        score=g[:, :4] - border * (width * pull)[:, None],
        squares=jnp.sum(r**2, 1)
        + jax.vmap(lambda f: f.least_squares)(noise_filters)
        + (away / zero_sd) ** 2
        - width * pull**2,
        count=jnp.sum(data.mask, 1).astype(float) - 1,
        zero=zero + width * pull,
        zero_slope=-border * width[:, None],
        zero_sd=jnp.sqrt(width),
    )
    return summary, noise_filters


def _snap_evidence(latent, particle, force, used):
    """What a jump says that no residual does: that the curve's peak lies between the two forces around it.

    The likelihood of a particle that snaps through falls off a cliff where the jump would move to another point of the
    record. A normal distribution of the logarithm of the force at the peak, as wide as the interval, stands in for it.

    Returns:
        Derivative of that logarithm by the latent vector, distance of the interval's middle from it, and its precision:
        zero unless the test shows a jump.
    """
    value, slope = jax.value_and_grad(snap)(latent, particle)
    at = jnp.where(jnp.isfinite(value), jnp.exp(jnp.where(jnp.isfinite(value), value, 0.0)), jnp.inf)
    below = jnp.max(jnp.where(used & (force <= at), force, 0.0))
    above = jnp.min(jnp.where(used & (force > at), force, jnp.inf))
    seen = jnp.isfinite(above) & (below > 0)
    low, high = jnp.log(jnp.where(seen, below, 1.0)), jnp.log(jnp.where(seen, above, 2.0))
    width = jnp.maximum(high - low, 1e-6)
    middle = jnp.where(seen, (low + high) / 2 - jnp.where(seen, value, 0.0), 0.0)
    return jnp.where(seen, slope, 0.0), middle, jnp.where(seen, 12 / width**2, 0.0)


@compiled
def expected_latent(
    free: Float[Array, " d"], target: Target
) -> tuple[
    Float[Array, "particles 4"], Float[Array, "particles 4"], Float[Array, "particles 4"], Float[Array, " particles"]
]:
    """Mean and standard deviation of the particles' latent vectors under the population, then the most probable latent
    vectors and zeros given the tests, too."""
    population = target.population(free)
    mean, factor = moments(population, target.flatness, target.scatter)
    still = jnp.zeros((mean.shape[0], target.scatter.size))
    found = draw_latent(population, target.summary, target.flatness, target.scatter, still, still[:, 0])
    return mean, jnp.sqrt(jnp.sum(factor**2, -1)), found.latent, found.zero
