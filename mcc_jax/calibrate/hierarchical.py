"""Least squares over all particles at once, by Optimistix with the block structure of the problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Values
from .block_arrow import Parameters, Solution, minimise
from .compiling import compiled
from .data import Tests
from .forward import Forms, Point, residuals
from .noise import Whitening
from .population import Population, Scatter, moments
from .settings import FIT
from .small_matrices import Cholesky


def robust(loss: str, r: Values) -> Values:
    """A residual whose square is the robust loss: 2 (sqrt(1 + r^2) - 1), or log(1 + r^2)."""
    if loss == "linear":
        return r
    square = r * r
    # Both equal r^2 - ... at 0; the quotient keeps value and derivative finite there.
    if loss == "soft_l1":
        quotient = 2 / (jnp.sqrt(1 + square) + 1)
    else:
        small = square < 1e-6
        safe = jnp.where(small, 1.0, square)
        quotient = jnp.where(small, 1 - square / 2, jnp.log1p(safe) / safe)
    return r * jnp.sqrt(quotient)


class Pooled(eqx.Module):
    """Settings of the pooled least squares.

    Attributes:
        whitening: the noise filters.
        population: whose spreads weigh the deviations of the particles.
        zero_prior: mean and standard deviation of the zeros, from the recorded contact [um].
        further: mean and standard deviation of every further number of an effect, of its logarithm if it is positive.
        forms: the law.
        scatter: what differs from particle to particle.
        loss: "linear", "soft_l1" or "cauchy", applied to the whitened residuals.
    """

    whitening: Whitening
    population: Population
    zero_prior: Float[Array, " 2"]
    further: Float[Array, "further 2"]
    forms: Forms
    scatter: Scatter = eqx.field(static=True)
    loss: str = eqx.field(static=True, default="linear")


SHARED = ("a", "log effective modulus", "mu_C1", "mu_C3", "mu_C5")
"""The shared parameters, behind which the effects' amplitudes stand and the logarithms of their further numbers."""


def unpack(y: Parameters, settings: Pooled, tests: Tests) -> Point:
    """Every particle's numbers: local are b1, b3, b5, zero and, where they differ, e and amplitudes."""
    scatter, size = settings.scatter, len(settings.forms.effects)
    if scatter.modulus:
        latent, own = jnp.concatenate([y.local[:, :3], y.local[:, 4:5]], 1), y.local[:, 5:]
    else:
        log_eta = jnp.log(jnp.maximum(1 + y.shared[0] * tests.flatness, 1e-3))
        e = y.shared[1] + scatter.power * log_eta
        latent, own = jnp.concatenate([y.local[:, :3], e[:, None]], 1), y.local[:, 4:]
    amplitudes, further = y.shared[len(SHARED) :][:size], y.shared[len(SHARED) + size :]
    positive = settings.forms.positive
    theta = jnp.concatenate([amplitudes, jnp.where(positive, jnp.exp(jnp.where(positive, further, 0.0)), further)])
    theta = jnp.broadcast_to(theta, (len(latent), len(theta)))
    for j, (k, _) in enumerate(scatter.varying):
        theta = theta.at[:, k].set(own[:, j])
    return Point(latent, y.local[:, 3], theta)


def pooled_residual(settings: Pooled, tests: Tests) -> Callable[[Parameters], tuple[Array, ...]]:
    r"""Residuals of the pooled least squares, as a function of the parameters.

    Whitened residuals of displacement, deviations of the particles from the population in its standard deviations, of
    the zeros from the recorded contacts, and of the effects' further numbers from what is plausible.
    """
    scatter, at = settings.scatter, settings.population
    size = 4 if scatter.modulus else 3
    tau = jnp.maximum(at.tau, FIT.least_spread)
    modulus = jnp.maximum(at.modulus_scatter, FIT.least_spread)
    mean_zero, sd_zero = settings.zero_prior
    count = jnp.asarray(float(len(tests))) if tests.weight is None else jnp.sum(tests.weight)

    def residual(y: Parameters):
        point = unpack(y, settings, tests)
        away = residuals(point, tests, settings.forms)
        data = jax.vmap(lambda f, r: f(r[:, None])[:, 0])(settings.whitening, away)
        moved = replace(at, a=y.shared[0], log_modulus=y.shared[1], mu=y.shared[2:5], tau=tau, modulus_scatter=modulus)
        mean, factor = moments(moved, tests.flatness, scatter)
        covariance = jnp.einsum("npk,nqk->npq", factor, factor)[:, :size, :size]
        pooled = Cholesky(covariance).forward((point.latent - mean)[:, :size])
        zero = ((point.zero - tests.contact - mean_zero) / sd_zero)[:, None]
        found = [robust(settings.loss, data), pooled, zero]
        for j, (k, signed) in enumerate(scatter.varying):
            shared = y.shared[len(SHARED) + k]
            unit = jnp.maximum(at.theta_scatter[j], FIT.least_spread) * (1.0 if signed else jnp.abs(at.theta[k]))
            found.append(((point.theta[:, k] - shared) / unit)[:, None])
        if len(settings.further):
            # A prior that all share, in equal parts of all particles.
            logs = y.shared[len(SHARED) + len(settings.forms.effects) :]
            part = (logs - settings.further[:, 0]) / (settings.further[:, 1] * jnp.sqrt(count))
            found.append(jnp.broadcast_to(part, (len(tests), len(part))))
        weight = 1.0 if tests.weight is None else tests.weight[:, None]
        return tuple(one * weight for one in found)

    return residual


@compiled
def fit_pooled(
    tests: Tests, settings: Pooled, start: Parameters, *, max_steps: int = 300, tolerance: float = 1e-7
) -> Solution:
    """Minimise the pooled residuals."""
    return minimise(pooled_residual(settings, tests), start, max_steps=max_steps, tolerance=tolerance)
