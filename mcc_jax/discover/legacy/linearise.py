"""Tests linear in their particle's own parameters: what noise is estimated from and summaries are made of."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._types import Scalar
from ...law import Unloading
from .compiling import compiled
from .data import Tests
from .forward import linearise_with_force, snap
from .noise import Linear, Noise, Whitening, whitening
from .population import Scatter, Summary, laplace, straighten
from .transforms import LogPosterior


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
    # All forces of a test, its peak among them, share the error of its zero of force.
    zero_sd_mN = tests.force_zero_sd
    common = None if zero_sd_mN is None else zero_sd_mN[:, None] * (moved + by_peak)
    path = tests.step, tests.mask, moved, by_peak, tests.branch
    return Linear(value, J, prior, *path, tests.weight, tests.peak_sd, common)


@compiled
def summarise(
    latent: Float[Array, "particles 4"],
    zero: Float[Array, " particles"],
    tests: Tests,
    data: Linear,
    noise: Noise,
    zero_sd: Scalar,
) -> tuple[Summary, Whitening, Float[Array, " particles"]]:
    """Quadratic summaries of all tests around the given latent vectors and zeros, by Gauss-Newton curvature.

    Returns:
        The summaries; the noise filters, in which force noise has become noise of displacement; and the standard
        deviation [um] of white noise that would weigh a test as much as its filter does.
    """
    noise_filters = jax.vmap(lambda s, *path: whitening(noise, s, *path))(
        noise.scale, data.step, data.mask, data.compliance, data.peak, data.branch, data.peak_sd, data.common
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
    points = jnp.sum(data.mask, 1).astype(zero.dtype)
    white = jnp.sqrt(points / jnp.maximum(jnp.sum(noise_filters.weight**2, 1), 1e-30))
    return summary, noise_filters, white


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


class Expected(NamedTuple):
    """What a population says of its particles, and what the tests add.

    Attributes:
        mean, sd: of the latent vectors under the population, shape (N, 4).
        latent: most probable latent vectors given the tests, too, shape (N, 4).
        zero: most probable zeros [um], shape (N,).
        hessian, stretch: of `Laplace`.
    """

    mean: Float[Array, "particles 4"]
    sd: Float[Array, "particles 4"]
    latent: Float[Array, "particles 4"]
    zero: Float[Array, " particles"]
    hessian: Float[Array, "particles k k"]
    stretch: Float[Array, " k"]


@compiled
def expected_latent(free: Float[Array, " d"], target: LogPosterior) -> Expected:
    """The particles under the population at unbounded coordinates."""
    summary = target.summary
    at = laplace(target.population(free), summary, target.flatness, target.scatter)
    latent = at.mean + jnp.einsum("npk,nk->np", at.factor, at.deviations)
    kappa, _ = straighten(latent - summary.point)
    zero = summary.zero + jnp.einsum("np,np->n", summary.zero_slope, kappa)
    return Expected(at.mean, jnp.sqrt(jnp.sum(at.factor**2, -1)), latent, zero, at.hessian, at.stretch)


SHARP = 0.03
"""Posterior standard deviation of the logarithm of a polynomial's coefficient below which one Newton step is enough."""


def careful_enough(free: Float[Array, " d"], target: LogPosterior, count: int) -> Scatter:
    """`target.scatter` with as many Newton steps as the integration over the particles needs: none if every coefficient
    is known sharply.

    Args:
        free: population in unbounded coordinates.
        target: of the tests.
        count: number of particles, without copies that only fill up.
    """
    sharp = replace(target.scatter, newton=0)
    at = expected_latent(free, replace(target, scatter=sharp))
    variance = np.diagonal(np.linalg.inv(np.asarray(at.hessian)[:count]), axis1=1, axis2=2)
    widest = float(np.max(np.sqrt(variance) * np.asarray(at.stretch)))
    return sharp if widest < SHARP else target.scatter
