"""The particles that a population expects, given their tests, and how carefully they must be integrated out."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .compiling import compiled
from .marginal import straighten
from .mode import LogPosterior
from .settings import FIT


class Expected(eqx.Module):
    """What a population says of its particles, and what the tests add.

    Attributes:
        mean, sd: of b1, b3, b5, e under the population, shape (N, 4).
        latent: most probable ones given the tests, too, shape (N, 4).
        theta: most probable numbers of the effects.
        theta_mean, theta_sd: of the amplitudes that vary, under the population.
        zero: most probable zeros [um], shape (N,).
        hessian, stretch: of `Laplace`.
    """

    mean: Float[Array, "particles 4"]
    sd: Float[Array, "particles 4"]
    latent: Float[Array, "particles 4"]
    theta: Float[Array, "particles numbers"]
    theta_mean: Float[Array, "particles varying"]
    theta_sd: Float[Array, "particles varying"]
    zero: Float[Array, " particles"]
    hessian: Float[Array, "particles k k"]
    stretch: Float[Array, " k"]


@compiled
def expect(free: Float[Array, " d"], target: LogPosterior) -> Expected:
    """The particles under the population at unbounded coordinates."""
    marginal, population = target.marginal, target.population(free)
    at = marginal.laplace(population)
    none = marginal.place(population, jnp.zeros_like(at.deviations))
    varying = jnp.asarray([k for k, _ in marginal.scatter.varying], int)
    width = jnp.sqrt(jnp.sum(at.placed.jacobian**2, -1))
    mean, factor = none.latent, none.jacobian[:, :4]
    # Without the bend of the straightened coordinates, which is that of the point.
    _, slope = straighten(mean - marginal.point.latent)
    sd = jnp.sqrt(jnp.sum((factor / slope[..., None]) ** 2, -1))
    zero = marginal.zero + jnp.einsum("np,np->n", marginal.zero_slope, at.placed.u)
    theta = at.placed.theta
    return Expected(
        mean,
        sd,
        at.placed.latent,
        theta,
        none.theta[:, varying],
        width[:, 4:][:, varying],
        zero,
        at.hessian,
        at.stretch,
    )


def careful_enough(free: Float[Array, " d"], target: LogPosterior, count: int) -> LogPosterior:
    """The target with as many Newton steps as the integration over the particles needs: none if every coefficient is
    known sharply.

    Args:
        free: population in unbounded coordinates.
        target: of the tests.
        count: number of particles, without copies that only fill up.
    """
    scatter = replace(target.marginal.scatter, newton=0)
    sharp = replace(target, marginal=replace(target.marginal, scatter=scatter))
    at = expect(free, sharp)
    variance = np.diagonal(np.linalg.inv(np.asarray(at.hessian)[:count]), axis1=1, axis2=2)
    widest = float(np.max(np.sqrt(variance) * np.asarray(at.stretch)))
    return sharp if widest < FIT.sharp else target
