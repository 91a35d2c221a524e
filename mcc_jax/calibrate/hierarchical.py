"""Least squares over all particles at once, by Optimistix with the block structure of the problem."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar, Values
from ..law import Unloading
from .block_arrow import Parameters, Solution, minimise
from .compiling import compiled
from .data import Tests
from .forward import raw_residual
from .noise import Whitening
from .population import Population, Scatter, moments
from .small_matrices import Cholesky

MIN_SPREAD = 1e-4
"""Least standard deviation of log C in the pooled residuals; any smaller and the problem is badly scaled."""


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
        tau: standard deviations of log C1, log C3, log C5 over the particles.
        modulus_scatter, shape_scatter: the same for the log modulus and for a.
        zero_sd: how far a zero may lie from the recorded contact [um].
        unloading: form of unloading.
        scatter: which further quantities scatter.
        loss: "linear", "soft_l1" or "cauchy", applied to the whitened residuals.
    """

    whitening: Whitening
    tau: Float[Array, " 3"]
    modulus_scatter: Scalar
    shape_scatter: Scalar
    zero_sd: Scalar
    unloading: Unloading = eqx.field(static=True)
    scatter: Scatter = eqx.field(static=True)
    loss: str = eqx.field(static=True, default="linear")


def unpack(y: Parameters, settings: Pooled, tests: Tests) -> tuple[Float[Array, "particles 4"], Float[Array, " n"]]:
    """Latent vectors and zeros: local are b1, b3, b5, zero and, if it scatters, e."""
    if settings.scatter.modulus:
        return jnp.concatenate([y.local[:, :3], y.local[:, 4:]], 1), y.local[:, 3]
    log_eta = jnp.log(jnp.maximum(1 + y.shared[0] * tests.flatness, 1e-3))
    e = y.shared[1] + settings.scatter.power * log_eta
    return jnp.concatenate([y.local[:, :3], e[:, None]], 1), y.local[:, 3]


def pooled_residual(settings: Pooled, tests: Tests) -> Callable[[Parameters], tuple[Array, Array, Array]]:
    r"""Residuals of the pooled least squares, as a function of the parameters.

    Whitened residuals of displacement, deviations of the particles from the population in its standard deviations, and
    of the zeros from the recorded contacts. Local parameters are b1, b3, b5, zero (and e, if the modulus scatters),
    shared are a, log Ebar, mu1, mu3, mu5.
    """
    size = 4 if settings.scatter.modulus else 3
    tau = jnp.maximum(settings.tau, MIN_SPREAD)

    def residual(y: Parameters):
        latent, zero = unpack(y, settings, tests)
        data = jax.vmap(lambda f, r: f(r))(settings.whitening, raw_residual(latent, zero, tests, settings.unloading))
        population = Population(
            y.shared[0],
            y.shared[1],
            y.shared[2:],
            tau,
            jnp.maximum(settings.modulus_scatter, MIN_SPREAD),
            settings.shape_scatter,
            jnp.zeros(()),
        )
        mean, factor = moments(population, tests.flatness, settings.scatter)
        covariance = jnp.einsum("npk,nqk->npq", factor, factor)[:, :size, :size]
        pooled = Cholesky(covariance).forward((latent - mean)[:, :size])
        found = robust(settings.loss, data), pooled, ((zero - tests.contact) / settings.zero_sd)[:, None]
        if tests.weight is None:
            return found
        weight = tests.weight[:, None]
        return found[0] * weight, found[1] * weight, found[2] * weight

    return residual


@compiled
def fit_pooled(
    tests: Tests, settings: Pooled, start: Parameters, *, max_steps: int = 300, tolerance: float = 1e-7
) -> Solution:
    """Minimise the pooled residuals."""
    return minimise(pooled_residual(settings, tests), start, max_steps=max_steps, tolerance=tolerance)
