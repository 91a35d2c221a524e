r"""The population behind the particles, and how likely the tests are under it with every particle integrated out.

Particle i's latent vector :math:`w = (b_1, b_3, b_5, e)` (see `_forward`) has, given the population,

.. math:: w_i = m_i + S_i \xi_i, \quad \xi_i \sim N(0, 1), \qquad
    m_i = (\mu_1 + \log\eta_i,\ \mu_3 + \log\eta_i,\ \mu_5 + \log\eta_i,\ \log\bar E + p \log\eta_i)

with :math:`\eta_i = \eta_p(a)`. The likelihood of its test is summarised by a quadratic around its best fit
(`Summary`). Their product is normal in :math:`\xi`, which integrates out in closed form, in a way that stays regular
when a spread is exactly 0: there is no funnel left.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._types import Scalar
from ._small import Cholesky


class Population(eqx.Module):
    """What all particles share.

    Attributes:
        a: shape parameter [-].
        log_modulus: logarithm of the effective modulus in MPa.
        mu: means of log C1, log C3, log C5.
        tau: their standard deviations, >= 0.
        modulus_scatter: standard deviation of the log modulus over the particles.
        shape_scatter: standard deviation of `a` over the particles; to first order in it.
        log_noise: logarithm of a factor on all noise.
    """

    a: Scalar
    log_modulus: Scalar
    mu: Float[Array, " 3"]
    tau: Float[Array, " 3"]
    modulus_scatter: Scalar
    shape_scatter: Scalar
    log_noise: Scalar


class Scatter(eqx.Module):
    """Which further quantities differ from particle to particle, and the power with which shape enters unloading."""

    modulus: bool = eqx.field(static=True, default=False)
    shape: bool = eqx.field(static=True, default=False)
    power: int = eqx.field(static=True, default=0)

    @property
    def size(self) -> int:
        """Number of independent deviations of a particle."""
        return 3 + self.modulus + self.shape


class Summary(eqx.Module):
    r"""A quadratic for the log likelihood of each test, its zero integrated out.

    .. math:: -n\lambda - \tfrac12 e^{-2\lambda}\left[R + (w - \hat w)^T \Lambda (w - \hat w)\right]
        + e^{-2\lambda} g^T (w - \hat w)

    with :math:`\lambda` the `log_noise`. The zero given w is normal around
    `zero + zero_slope (w - point)` with standard deviation `zero_sd` (times the noise factor).

    Attributes:
        point: :math:`\hat w`, shape (N, 4).
        precision: Lambda, shape (N, 4, 4), positive semi-definite.
        score: g, shape (N, 4).
        squares: R.
        count: n, number of points.
        zero, zero_slope, zero_sd: distribution of the zero [um].
    """

    point: Float[Array, "particles 4"]
    precision: Float[Array, "particles 4 4"]
    score: Float[Array, "particles 4"]
    squares: Float[Array, " particles"]
    count: Float[Array, " particles"]
    zero: Float[Array, " particles"]
    zero_slope: Float[Array, "particles 4"]
    zero_sd: Float[Array, " particles"]


def moments(
    population: Population, flatness: Float[Array, " particles"], scatter: Scatter
) -> tuple[Float[Array, "particles 4"], Float[Array, "particles 4 k"]]:
    """Mean of the particles' latent vectors, and the factor of their covariance."""
    eta = 1 + population.a * flatness
    log_eta = jnp.log(jnp.where(eta > 0, eta, 1e-300))
    powers = jnp.array([1.0, 1.0, 1.0, scatter.power])
    mean = jnp.concatenate([population.mu, population.log_modulus[None]]) + log_eta[:, None] * powers
    columns = [jnp.zeros(4).at[j].set(population.tau[j]) for j in range(3)]
    if scatter.modulus:
        columns.append(jnp.zeros(4).at[3].set(population.modulus_scatter))
    factor = jnp.broadcast_to(jnp.stack(columns, 1), (flatness.shape[0], 4, len(columns)))
    if scatter.shape:
        slope = population.shape_scatter * (flatness / eta)[:, None] * powers
        factor = jnp.concatenate([factor, slope[..., None]], 2)
    return mean, factor


def _posterior(population: Population, summary: Summary, flatness: Float[Array, " particles"], scatter: Scatter):
    share = jnp.exp(-2 * population.log_noise)
    mean, factor = moments(population, flatness, scatter)
    away = mean - summary.point
    pull = summary.score - jnp.einsum("npq,nq->np", summary.precision, away)
    right = share * jnp.einsum("npk,np->nk", factor, pull)
    inner = share * jnp.einsum("npk,npq,nql->nkl", factor, summary.precision, factor) + jnp.eye(scatter.size)
    return share, mean, factor, away, right, Cholesky(inner)


def marginal_likelihood(
    population: Population, summary: Summary, flatness: Float[Array, " particles"], scatter: Scatter
) -> Float[Array, " particles"]:
    """Log likelihood of each test, the particle's own parameters integrated out, up to a constant."""
    share, _, _, away, right, inner = _posterior(population, summary, flatness, scatter)
    at_mean = jnp.einsum("np,np->n", summary.score, away) - 0.5 * jnp.einsum(
        "np,npq,nq->n", away, summary.precision, away
    )
    gained = 0.5 * jnp.sum(inner.forward(right) ** 2, -1) - 0.5 * inner.log_det()
    return share * (at_mean - 0.5 * summary.squares) + gained - summary.count * population.log_noise


def draw_latent(
    population: Population,
    summary: Summary,
    flatness: Float[Array, " particles"],
    scatter: Scatter,
    normal: Float[Array, "particles k"],
    normal_zero: Float[Array, " particles"],
) -> tuple[Float[Array, "particles 4"], Float[Array, " particles"], Float[Array, "particles k"]]:
    """Latent vectors, zeros and deviations of the particles given the population, from standard normal numbers."""
    _, mean, factor, _, right, inner = _posterior(population, summary, flatness, scatter)
    deviations = inner.solve(right) + inner.backward(normal)
    latent = mean + jnp.einsum("npk,nk->np", factor, deviations)
    slope = jnp.einsum("np,np->n", summary.zero_slope, latent - summary.point)
    zero = summary.zero + slope + summary.zero_sd * jnp.exp(population.log_noise) * normal_zero
    return latent, zero, deviations


def log_jacobian(
    population: Population, summary: Summary, flatness: Float[Array, " particles"], scatter: Scatter
) -> Scalar:
    """Log of the volume by which `draw_latent` stretches its standard normal numbers into deviations and zeros."""
    *_, inner = _posterior(population, summary, flatness, scatter)
    return jnp.sum(-0.5 * inner.log_det() + jnp.log(summary.zero_sd) + population.log_noise)
