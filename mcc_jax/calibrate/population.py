"""The population behind the particles: what all of them share, and how one of them differs."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from .forward import Places

COEFFICIENTS = ("C1", "C3", "C5")


class Population(eqx.Module):
    """What all particles share."""

    a: Scalar  # shape parameter [-]
    log_modulus: Scalar  # logarithm of the effective modulus in MPa
    mu: Float[Array, " 3"]  # means of log C1, log C3, log C5 over the particles
    tau: Float[Array, " 3"]  # and standard deviations
    modulus_scatter: Scalar  # standard deviation of the log modulus
    shape_scatter: Scalar  # and of `a`, to first order
    log_noise: Scalar  # logarithm of a factor on all noise
    theta: Float[Array, " numbers"]  # parameters of the effects: amplitudes, then further ones
    theta_scatter: Float[Array, " varying"]  # sd of each amplitude that varies, of its log if it has one sign


class Scatter(eqx.Module):
    """How particles differ, and with how many Newton steps they are integrated out."""

    modulus: bool = eqx.field(static=True, default=False)
    shape: bool = eqx.field(static=True, default=False)
    power: float = eqx.field(static=True, default=0.0)  # with which the shape factor enters unloading
    # Places of amplitudes that differ, and whether both signs are physical; places of positive numbers of effects, and
    # of their amplitudes.
    varying: tuple[tuple[int, bool], ...] = eqx.field(static=True, default=())
    positive: Places = eqx.field(static=True, default=())
    newton: int = eqx.field(static=True, default=4)

    @property
    def of_latent(self) -> int:
        """Number of independent deviations of a particle's b1, b3, b5, e."""
        return 3 + self.modulus + self.shape

    @property
    def size(self) -> int:
        """Number of independent deviations of a particle."""
        return self.of_latent + len(self.varying)


def moments(
    population: Population, flatness: Float[Array, " particles"], scatter: Scatter
) -> tuple[Float[Array, "particles 4"], Float[Array, "particles 4 k"]]:
    """Mean of the particles' b1, b3, b5, e, and the factor of their covariance."""
    eta = 1 + population.a * flatness
    log_eta = jnp.log(jnp.where(eta > 0, eta, 1e-300))
    powers = jnp.array([1.0, 1.0, 1.0, scatter.power])
    mean = jnp.concatenate([population.mu, population.log_modulus[None]])[None] + log_eta[:, None] * powers[None]
    columns = [jnp.zeros(4).at[j].set(population.tau[j]) for j in range(3)]
    if scatter.modulus:
        columns.append(jnp.zeros(4).at[3].set(population.modulus_scatter))
    factor = jnp.broadcast_to(jnp.stack(columns, 1), (flatness.shape[0], 4, len(columns)))
    if scatter.shape:
        slope = population.shape_scatter * (flatness / eta)[:, None] * powers[None]
        factor = jnp.concatenate([factor, slope[..., None]], 2)
    return mean, factor


class Particles(eqx.Module):
    """Particles at their deviations from the population."""

    latent: Float[Array, "particles 4"]  # b1, b3, b5, e
    theta: Float[Array, "particles numbers"]  # parameters of their effects
    factor: Float[Array, "particles 4 k"]  # derivatives of `latent` by the deviations
    slope: Float[Array, "particles varying"]  # and of the amplitudes that vary


def particles_at(
    population: Population, flatness: Float[Array, " particles"], scatter: Scatter, xi: Float[Array, "particles size"]
) -> Particles:
    """Every particle's parameters, from its standard normal deviations."""
    mean, factor = moments(population, flatness, scatter)
    own = scatter.of_latent
    latent = mean + jnp.einsum("npk,nk->np", factor, xi[:, :own])
    theta = jnp.broadcast_to(population.theta, (len(flatness), len(population.theta)))
    slopes = [jnp.zeros((len(flatness), 0))]
    for j, (k, signed) in enumerate(scatter.varying):
        tau, mine = population.theta_scatter[j], xi[:, own + j]
        value = theta[:, k] + tau * mine if signed else theta[:, k] * jnp.exp(tau * mine)
        theta = theta.at[:, k].set(value)
        slopes.append((jnp.broadcast_to(tau, mine.shape) if signed else tau * value)[:, None])
    return Particles(latent, theta, factor, jnp.concatenate(slopes, 1))


def flattened(draws: Any) -> Any:
    """Arrays of draws with the axes (chain, draw, ...), all chains in one row."""
    return jax.tree.map(lambda x: np.asarray(x).reshape(x.shape[0] * x.shape[1], *x.shape[2:]), draws)
