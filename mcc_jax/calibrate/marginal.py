r"""The likelihood of the tests with every particle's own numbers integrated out: the embedded Laplace approximation.

Around a point every test is summarised by one whitened Gram matrix, of the derivatives of its prediction and its
residual (`summarise`). Its zero is integrated out exactly (`eliminate`). What is left of a particle,

.. math:: w_i = m_i + S \xi_i, \quad \xi_i \sim N(0, 1), \qquad
    m_i = (\mu_1 + \log\eta_i,\ \mu_3 + \log\eta_i,\ \mu_5 + \log\eta_i,\ \log\bar E + p \log\eta_i), \quad
    \eta_i = \eta_p(a)

and, where an effect differs from particle to particle, :math:`A_i = A e^{\tau \xi}` (:math:`A + \tau \xi` where both
signs are physical), is integrated out by Laplace's method. The Gram matrix is a quadratic not in w, but in the
coefficients of the stress's polynomial, :math:`\kappa_j = (e^{j (b_j - \hat b_j)} - 1)/j`, and in the amplitudes,
because the prediction is nearly linear in these and the ridges of the likelihood are straight. Deviations, not
coefficients, are the variables, so everything stays regular when a spread is exactly 0: there is no funnel (Margossian
et al. 2020, Hamiltonian Monte Carlo using an adjoint-differentiated Laplace approximation).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .data import Tests
from .forward import Linear, Point, Straight, coordinates, snap
from .noise import Along, Correlation, Noise, Whitening, whitening
from .population import Population, Scatter, moments, particles_at
from .running import compiled
from .small_matrices import Cholesky, eliminate

FARTHEST = 4.0  # exponents are cut here: a coefficient e^4 times its fitted value is nowhere near any test
MIN_SHARE = 0.05  # a coefficient of the polynomial is not drawn below this share of its most probable value


class Marginal(eqx.Module):
    r"""The tests around a point, zeros integrated out.

    With u a particle's coordinates (kappa, the effects' parameters as in `Straight`, and products of these, to the
    second order in effects), the log likelihood of a test is

    .. math:: L - n\lambda - \tfrac12 e^{-2\lambda} (u, -1)^T G (u, -1)

    with :math:`\lambda` the population's `log_noise`. The zero given u is normal around `zero + zero_slope u` with
    standard deviation `zero_sd` (times the noise factor).
    """

    point: Point
    straight: Straight  # coordinates of the effects' numbers
    gram: Float[Array, "particles q q"]  # G, of which the residual is the last column
    log_scale: Float[Array, " particles"]  # L: noise's determinant and the zero's integral
    count: Float[Array, " particles"]  # n, number of points
    zero: Float[Array, " particles"]
    zero_slope: Float[Array, "particles u"]
    zero_sd: Float[Array, " particles"]
    flatness: Float[Array, " particles"]  # 1 - D3^2/(D1 D2)
    weight: Float[Array, " particles"] | None  # 1 for particles, 0 for padding; None where all are particles
    scatter: Scatter

    def log_likelihood(self, population: Population) -> Float[Array, " particles"]:
        """Log likelihood of each test, the particle's own numbers integrated out; 0 of padding."""
        each = self.laplace(population).log_likelihood
        return each if self.weight is None else self.weight * each

    def place(self, population: Population, xi: Float[Array, "particles k"]) -> Placed:
        """Coordinates u of all particles at deviations xi, and their derivatives."""
        at = particles_at(population, self.flatness, self.scatter, xi)
        u, slope = straighten(at.latent - self.point.latent)
        jacobian = slope[..., None] * at.factor
        numbers, own = at.theta.shape[1], at.factor.shape[-1]
        if numbers:
            there = jax.vmap(partial(coordinates, places=self.scatter.positive))
            away, factor = there(at.theta, self.point.theta, self.straight)
            jacobian = jnp.pad(jacobian, ((0, 0), (0, numbers), (0, len(self.scatter.varying))))
            for j, (k, _) in enumerate(self.scatter.varying):
                jacobian = jacobian.at[:, 4 + k, own + j].set(at.slope[:, j] * factor[:, k])
            u = jnp.concatenate([u, away], 1)
        if u.shape[1] < self.gram.shape[-1] - 1:
            u, jacobian = with_products(u, jacobian)
        return Placed(at.latent, at.theta, u, jacobian)

    def stretch(self, population: Population) -> Float[Array, " k"]:
        r""":math:`j \tau_j` of every deviation, by which what it moves bends; 0 where it moves in a straight line."""
        signed = np.array([signed for _, signed in self.scatter.varying], bool)
        amplitudes = jnp.where(signed, 0.0, population.theta_scatter)
        straight = jnp.zeros(self.scatter.of_latent - 3)
        return jnp.concatenate([jnp.array([1.0, 3.0, 5.0]) * population.tau, straight, amplitudes])

    def laplace(self, population: Population) -> Laplace:
        """Integrate every particle's deviations out by Laplace's method."""
        share = jnp.exp(-2 * population.log_noise)
        eye = jnp.eye(self.scatter.size)[None]

        def expand(at: Marginal, population: Population, xi: Array, share: Array) -> tuple[Placed, Array, Array]:
            placed = at.place(population, xi)
            precision, score = at.gram[:, :-1, :-1], at.gram[:, :-1, -1]
            pull = jnp.einsum("npq,nq->np", precision, placed.u) - score
            curvature = share * jnp.einsum("npk,npq,nql->nkl", placed.jacobian, precision, placed.jacobian)
            return placed, share * jnp.einsum("npk,np->nk", placed.jacobian, pull), curvature

        def newton(at: Marginal, population: Population, xi: Array, share: Array) -> Array:
            _, gradient, curvature = expand(at, population, xi, share)
            return xi - Cholesky(curvature + eye).solve(xi + gradient)

        # The linear solution: slopes at the point, not at the population's mean, which may lie far away.
        mean = self.place(population, jnp.zeros((len(self.flatness), self.scatter.size)))
        away = jnp.concatenate([mean.latent - self.point.latent, mean.u[:, 4:]], 1)
        _, factor = moments(population, self.flatness, self.scatter)
        jacobian = mean.jacobian.at[:, :4, : factor.shape[-1]].set(factor)
        precision, score = self.gram[:, :-1, :-1], self.gram[:, :-1, -1]
        pull = score - jnp.einsum("npq,nq->np", precision, away)
        curvature = share * jnp.einsum("npk,npq,nql->nkl", jacobian, precision, jacobian)
        xi = Cholesky(curvature + eye).solve(share * jnp.einsum("npk,np->nk", jacobian, pull))
        if self.scatter.newton:
            # Found without derivatives; one last step with them carries the derivative of the whole iteration.
            fixed, held, frozen, xi = jax.lax.stop_gradient((self, population, share, xi))
            xi = jax.lax.fori_loop(0, self.scatter.newton, lambda _, x: newton(fixed, held, x, frozen), xi)
            xi = newton(self, population, xi, share)
        placed, _, curvature = expand(self, population, xi, share)
        border = jnp.pad(placed.u, ((0, 0), (0, 1)), constant_values=-1.0)
        squares = jnp.einsum("np,npq,nq->n", border, self.gram, border)
        stretch = self.stretch(population)
        # In straightened coordinates the likelihood is quadratic; what bends is the prior: xi^2/2 has the curvature
        # 1 - j tau xi.
        bend = jnp.maximum(1 - stretch[None] * xi, 0.25)
        hessian = curvature + eye * bend[..., None, :]
        inner = Cholesky(hessian)
        # Small next to the curvature; where tests are silent and spreads wide, stretch^2 keeps it below 1/2 each.
        slope = jnp.broadcast_to(stretch, xi.shape)
        tilt = 0.5 * jnp.sum(Cholesky(hessian + eye * (stretch**2)[None, None]).forward(slope) ** 2, -1)
        value = -0.5 * share * squares - 0.5 * jnp.sum(xi**2, -1) - 0.5 * inner.log_det() + tilt
        value += self.log_scale - self.count * population.log_noise
        return Laplace(xi, hessian, stretch, value, placed)

    def draw(self, population: Population, normal: Array, normal_zero: Array) -> ParticleDraw:
        """Every particle's own numbers given the population, from standard normal numbers."""
        at = self.laplace(population)
        inner = Cholesky(at.hessian)
        nu = inner.backward(normal)
        y = at.stretch[None] * nu
        inside = y > MIN_SHARE - 1
        y = jnp.where(inside, y, 0.0)
        small = jnp.abs(y) < 1e-5
        safe = jnp.where(small, 1.0, y)
        quotient = jnp.where(small, 1 - y / 2 + y * y / 3, jnp.log1p(safe) / safe)
        deviations = at.deviations + nu * quotient
        placed = self.place(population, deviations)
        sd = self.zero_sd * jnp.exp(population.log_noise)
        zero = self.zero + jnp.einsum("np,np->n", self.zero_slope, placed.u) + sd * normal_zero
        volume = -0.5 * inner.log_det() - jnp.sum(jnp.log1p(y), -1) + jnp.log(sd)
        volume = jnp.where(jnp.all(inside, -1), volume, -jnp.inf)
        return ParticleDraw(placed.latent, placed.theta, zero, deviations, volume, at.log_likelihood)


def with_products(
    u: Float[Array, "particles u"], jacobian: Float[Array, "particles u k"]
) -> tuple[Float[Array, "particles q"], Float[Array, "particles q k"]]:
    """Coordinates with the products of each effect's with all, in the order of `Linear.bends`, and derivatives."""
    half = jnp.concatenate([jnp.ones(4), jnp.full(u.shape[1] - 4, 0.5)])[None]
    own, own_slope = u[:, 4:], jacobian[:, 4:]
    products = own[:, :, None] * (half * u)[:, None, :]
    slopes = own_slope[:, :, None, :] * (half * u)[:, None, :, None]
    slopes += own[:, :, None, None] * (half[..., None] * jacobian)[:, None]
    count = len(u), own.shape[1] * u.shape[1]
    u = jnp.concatenate([u, products.reshape(count)], 1)
    return u, jnp.concatenate([jacobian, slopes.reshape(*count, jacobian.shape[2])], 1)


class Placed(NamedTuple):
    """Particles' latent vector w, parameters of effects, coordinates u, and derivatives of u by the deviations."""

    latent: Float[Array, "particles 4"]
    theta: Float[Array, "particles numbers"]
    u: Float[Array, "particles u"]
    jacobian: Float[Array, "particles u k"]


class Laplace(eqx.Module):
    r"""Most probable deviations of all particles given the population, and each test's integrated log likelihood.

    The curvature is in coordinates nu, :math:`\xi_j = \hat\xi_j + \log(1 + j\tau_j\nu_j)/(j\tau_j)`, with
    :math:`j \tau_j` in `stretch`.
    """

    deviations: Float[Array, "particles k"]
    hessian: Float[Array, "particles k k"]
    stretch: Float[Array, " k"]
    log_likelihood: Float[Array, " particles"]
    placed: Placed


class ParticleDraw(NamedTuple):
    """One draw of all particles given the population. `log_volume` is the log determinant of the map from standard
    normal numbers to deviations and zero; `log_likelihood` that of each test, integrated."""

    latent: Float[Array, "particles 4"]
    theta: Float[Array, "particles numbers"]
    zero: Float[Array, " particles"]
    deviations: Float[Array, "particles k"]
    log_volume: Float[Array, " particles"]
    log_likelihood: Float[Array, " particles"]


def straighten(away: Float[Array, "*batch 4"]) -> tuple[Float[Array, "*batch 4"], Float[Array, "*batch 4"]]:
    """kappa, in which stress is linear, and its derivative, from w less the point's."""
    powers = jnp.broadcast_to(jnp.array([1.0, 3.0, 5.0]), away[..., :3].shape)
    exponent = jnp.clip(powers * away[..., :3], -FARTHEST, FARTHEST)
    kappa = jnp.concatenate([jnp.expm1(exponent) / powers, away[..., 3:]], -1)
    return kappa, jnp.concatenate([jnp.exp(exponent), jnp.ones_like(away[..., 3:])], -1)


@compiled
def summarise(
    point: Point,
    straight: Straight,
    tests: Tests,
    linear: Linear,
    noise: Noise,
    zero_prior: Float[Array, " 2"],
    scatter: Scatter,
    correlation: Correlation,
    along: Along,
) -> tuple[Marginal, Whitening, Float[Array, " particles"]]:
    """Summarise all tests around a point by Gauss-Newton curvature, from the derivatives in the coordinates `straight`;
    with the noise's filters, and the sd of white noise [um] that would weigh a test as much.

    `zero_prior` is mean and sd of the zeros' distance from the recorded contact [um].
    """
    whiten = jax.vmap(lambda scale, one, linear: whitening(noise, scale, one, linear, correlation, along))
    filters = whiten(noise.scale, tests, linear)
    ones = jnp.where(tests.mask, 1.0, 0.0)
    bends = [] if linear.bends is None else [linear.bends]
    columns = jnp.concatenate([linear.columns, *bends, ones[..., None], linear.residual[..., None]], -1)
    white = jax.vmap(lambda f, x: f(x))(filters, columns)
    gram = jnp.einsum("nkp,nkq->npq", white, white)
    used = tests.mask & tests.loading
    slope, offset, weight = jax.vmap(_snap_evidence)(point.latent, tests.particle, tests.force, used)
    seen = jnp.concatenate([slope, jnp.zeros((len(tests), gram.shape[-1] - 5)), offset[:, None]], 1)
    gram += weight[:, None, None] * seen[:, :, None] * seen[:, None, :]
    # It bounds where a particle may go, and is no datum: at the point itself it costs nothing.
    gram = gram.at[:, -1, -1].add(jax.vmap(lambda f: f.reading)(filters) - weight * offset**2)
    place = gram.shape[-1] - 2
    away = tests.contact + zero_prior[0] - point.zero
    precision = jnp.broadcast_to(1 / zero_prior[1] ** 2, (len(tests), 1))
    left, log_integral = eliminate(gram, (place,), precision, away[:, None])
    total = gram[:, place, place] + precision[:, 0]
    slopes = -gram[:, place, :place] / total[:, None]
    at = (gram[:, place, -1] + precision[:, 0] * away) / total
    points, log_det = jax.vmap(lambda f: (f.points, f.log_det))(filters)
    log_scale = log_integral - 0.5 * (log_det + float(np.log(2 * np.pi)) * jnp.sum(ones, 1))
    zero = point.zero + at, slopes, 1 / jnp.sqrt(total)
    marginal = Marginal(point, straight, left, log_scale, points - 1, *zero, tests.flatness, None, scatter)
    information = jax.vmap(lambda f: f.information)(filters)
    return marginal, filters, jnp.sqrt(points / jnp.maximum(information, 1e-30))


def _snap_evidence(latent, particle, force, used):
    """Evidence of a jump that no residual has: the curve's peak lies between the two forces around it.

    In place of a likelihood with a cliff, where the jump would move to another point, a normal distribution of the log
    of the force at the peak, as wide as the interval: its derivative by the latent vector, the distance of the
    interval's middle from it, and its precision, zero without a jump.
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
