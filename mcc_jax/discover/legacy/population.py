r"""The population behind the particles, and how likely the tests are under it with every particle integrated out.

Particle i's latent vector :math:`w = (b_1, b_3, b_5, e)` (see `forward`) has, given the population,

.. math:: w_i = m_i + S_i \xi_i, \quad \xi_i \sim N(0, 1), \qquad
    m_i = (\mu_1 + \log\eta_i,\ \mu_3 + \log\eta_i,\ \mu_5 + \log\eta_i,\ \log\bar E + p \log\eta_i)

with :math:`\eta_i = \eta_p(a)`. The likelihood of its test is summarised by a quadratic (`Summary`): not in w, but in
the coefficients of the stress's polynomial, :math:`\kappa_j = (e^{j (b_j - \hat b_j)} - 1)/j`, because stress is linear
in these and the ridges of the likelihood are straight. What is left to integrate is three-dimensional and smooth, and
is done by Laplace's method around the most probable deviations, in coordinates in which the summary is exactly
quadratic. Deviations, not coefficients, are the variables, so everything stays regular when a spread is exactly 0:
there is no funnel.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._types import Scalar
from .small_matrices import Cholesky

COEFFICIENTS = ("C1", "C3", "C5")


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

    def further(self) -> dict[str, Array]:
        """Further numbers that all particles share, by name: of effects that were added to the law."""
        return {}


class Scatter(eqx.Module):
    """How particles differ, and how carefully they are integrated out.

    Attributes:
        modulus: whether the modulus scatters, too.
        shape: whether `a` does.
        power: power with which the shape factor enters unloading.
        newton: Newton steps from the linear solution to the most probable deviations; none are needed where the tests
            pin all coefficients down.
    """

    modulus: bool = eqx.field(static=True, default=False)
    shape: bool = eqx.field(static=True, default=False)
    power: float = eqx.field(static=True, default=0.0)
    newton: int = eqx.field(static=True, default=4)

    @property
    def size(self) -> int:
        """Number of independent deviations of a particle."""
        return 3 + self.modulus + self.shape


class Summary(eqx.Module):
    r"""A quadratic for the log likelihood of each test, its zero integrated out.

    .. math:: -n\lambda - \tfrac12 e^{-2\lambda}\left[R + \kappa^T \Lambda \kappa - 2 g^T \kappa\right], \qquad
        \kappa_j = \frac{e^{j (b_j - \hat b_j)} - 1}{j},\ j = 1, 3, 5, \quad \kappa_e = e - \hat e

    with :math:`\lambda` the `log_noise`. The zero given kappa is normal around `zero + zero_slope kappa` with standard
    deviation `zero_sd` (times the noise factor).

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
    mean = jnp.concatenate([population.mu, population.log_modulus[None]])[None] + log_eta[:, None] * powers[None]
    columns = [jnp.zeros(4).at[j].set(population.tau[j]) for j in range(3)]
    if scatter.modulus:
        columns.append(jnp.zeros(4).at[3].set(population.modulus_scatter))
    factor = jnp.broadcast_to(jnp.stack(columns, 1), (flatness.shape[0], 4, len(columns)))
    if scatter.shape:
        slope = population.shape_scatter * (flatness / eta)[:, None] * powers[None]
        factor = jnp.concatenate([factor, slope[..., None]], 2)
    return mean, factor


class Laplace(eqx.Module):
    """Deviations of all particles given the population, around the most probable ones.

    Attributes:
        deviations: most probable xi, shape (N, k).
        hessian: curvature there in the straightened coordinates nu.
        stretch: :math:`j \\tau_j` by which :math:`\\xi_j = \\hat\\xi_j + \\log(1 + j\\tau_j\\nu_j)/(j\\tau_j)`.
        log_likelihood: of each test, integrated.
        mean, factor: m and S.
    """

    deviations: Float[Array, "particles k"]
    hessian: Float[Array, "particles k k"]
    stretch: Float[Array, " k"]
    log_likelihood: Float[Array, " particles"]
    mean: Float[Array, "particles 4"]
    factor: Float[Array, "particles 4 k"]


FARTHEST = 4.0
"""Exponents are cut here: a coefficient e^4 times its fitted value is nowhere near any test."""


def straighten(away: Float[Array, "*batch 4"]) -> tuple[Float[Array, "*batch 4"], Float[Array, "*batch 4"]]:
    """kappa, in which stress is linear, and its derivative, from w less the summary's point."""
    powers = jnp.array([1.0, 3.0, 5.0])
    powers = jnp.broadcast_to(powers, away[..., :3].shape)
    exponent = jnp.clip(powers * away[..., :3], -FARTHEST, FARTHEST)
    kappa = jnp.concatenate([jnp.expm1(exponent) / powers, away[..., 3:]], -1)
    return kappa, jnp.concatenate([jnp.exp(exponent), jnp.ones_like(away[..., 3:])], -1)


def laplace(
    population: Population, summary: Summary, flatness: Float[Array, " particles"], scatter: Scatter
) -> Laplace:
    """Integrate every particle out by Laplace's method."""
    share = jnp.exp(-2 * population.log_noise)
    mean, factor = moments(population, flatness, scatter)
    eye = jnp.eye(scatter.size)[None]

    def curvature(slope, factor, precision):
        bent = slope[..., None] * factor
        return share * jnp.einsum("npk,npq,nql->nkl", bent, precision, bent)

    def newton(xi, mean, factor, quadratic):
        away = mean + jnp.einsum("npk,nk->np", factor, xi) - quadratic.point
        kappa, slope = straighten(away)
        pull = jnp.einsum("npq,nq->np", quadratic.precision, kappa) - quadratic.score
        gradient = xi + share * jnp.einsum("npk,np->nk", factor, slope * pull)
        return xi - Cholesky(curvature(slope, factor, quadratic.precision) + eye).solve(gradient)

    def linear(mean, factor, quadratic):
        away = mean - quadratic.point
        pull = quadratic.score - jnp.einsum("npq,nq->np", quadratic.precision, away)
        ones = jnp.ones_like(mean)
        right = share * jnp.einsum("npk,np->nk", factor, pull)
        return Cholesky(curvature(ones, factor, quadratic.precision) + eye).solve(right)

    xi = linear(mean, factor, summary)
    if scatter.newton:
        # Found without derivatives; one last step with them carries the derivative of the whole iteration.
        fixed = jax.lax.stop_gradient((mean, factor, summary))
        with_derivative, share = share, jax.lax.stop_gradient(share)
        xi = jax.lax.fori_loop(0, scatter.newton, lambda _, at: newton(at, *fixed), jax.lax.stop_gradient(xi))
        share = with_derivative
        xi = newton(xi, mean, factor, summary)

    away = mean + jnp.einsum("npk,nk->np", factor, xi) - summary.point
    kappa, slope = straighten(away)
    quadratic = jnp.einsum("np,npq,nq->n", kappa, summary.precision, kappa) - 2 * jnp.einsum(
        "np,np->n", summary.score, kappa
    )
    at_mode = -0.5 * share * (quadratic + summary.squares) - 0.5 * jnp.sum(xi**2, -1)
    stretch = jnp.concatenate([jnp.array([1.0, 3.0, 5.0]) * population.tau, jnp.zeros(scatter.size - 3)])
    # In nu the summary is quadratic; what bends is the prior: xi^2/2 has the curvature 1 - j tau xi.
    bend = jnp.maximum(1 - stretch[None] * xi, 0.25)
    hessian = curvature(slope, factor, summary.precision) + eye * bend[..., None, :]
    inner = Cholesky(hessian)
    tilt = 0.5 * jnp.sum(inner.forward(jnp.broadcast_to(stretch, xi.shape)) ** 2, -1)
    value = at_mode - 0.5 * inner.log_det() + tilt - summary.count * population.log_noise
    return Laplace(xi, hessian, stretch, value, mean, factor)


def marginal_likelihood(
    population: Population, summary: Summary, flatness: Float[Array, " particles"], scatter: Scatter
) -> Float[Array, " particles"]:
    """Log likelihood of each test, the particle's own parameters integrated out, up to a constant."""
    return laplace(population, summary, flatness, scatter).log_likelihood


class Draw(eqx.Module):
    """One draw of all particles given the population.

    Attributes:
        latent: w, shape (N, 4).
        zero: zero of displacement [um].
        deviations: xi, shape (N, k).
        log_volume: log of the volume by which the map from standard normal numbers to xi and zero stretches; minus
            infinity outside its range.
        log_likelihood: of each test, integrated.
    """

    latent: Float[Array, "particles 4"]
    zero: Float[Array, " particles"]
    deviations: Float[Array, "particles k"]
    log_volume: Float[Array, " particles"]
    log_likelihood: Float[Array, " particles"]


MIN_SHARE = 0.05
"""A coefficient of the polynomial is not drawn below this share of its most probable value."""


def draw_latent(
    population: Population,
    summary: Summary,
    flatness: Float[Array, " particles"],
    scatter: Scatter,
    normal: Float[Array, "particles k"],
    normal_zero: Float[Array, " particles"],
) -> Draw:
    """Latent vectors, zeros and deviations of the particles given the population, from standard normal numbers."""
    at = laplace(population, summary, flatness, scatter)
    inner = Cholesky(at.hessian)
    nu = inner.backward(normal)
    y = at.stretch[None] * nu
    inside = y > MIN_SHARE - 1
    y = jnp.where(inside, y, 0.0)
    small = jnp.abs(y) < 1e-5
    safe = jnp.where(small, 1.0, y)
    quotient = jnp.where(small, 1 - y / 2 + y * y / 3, jnp.log1p(safe) / safe)
    deviations = at.deviations + nu * quotient
    latent = at.mean + jnp.einsum("npk,nk->np", at.factor, deviations)
    kappa, _ = straighten(latent - summary.point)
    sd = summary.zero_sd * jnp.exp(population.log_noise)
    zero = summary.zero + jnp.einsum("np,np->n", summary.zero_slope, kappa) + sd * normal_zero
    volume = -0.5 * inner.log_det() - jnp.sum(jnp.log1p(y), -1) + jnp.log(sd)
    volume = jnp.where(jnp.all(inside, -1), volume, -jnp.inf)
    return Draw(latent, zero, deviations, volume, at.log_likelihood)
