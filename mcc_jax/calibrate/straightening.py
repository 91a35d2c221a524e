r"""Coordinates of the effects' numbers in which the prediction is nearly linear.

Tests may leave a number of an effect open over a decade: of logarithmic creep whose time is far beyond the record they
show the amplitude over the time, and of the time by itself almost nothing. A quadratic in amplitude and time, or in
their logarithms, does not hold that far. Of an amplitude A and a further, positive number :math:`\theta`, where tests
are linearised at :math:`\hat A, \hat\theta`, the coordinates are

.. math:: v = \hat\theta\, \frac{e^{q x} - 1}{q}, \qquad u = A\, e^{p x} - \hat A, \qquad x = \log(\theta/\hat\theta)

The shear p takes from what :math:`\theta` does that part which the amplitude does as well. The power q makes the rest
as large on one side of the point as on the other. With p = q = 0 they are the amplitude and the logarithm.

References:
    Bates and Watts (1980), Relative curvature measures of nonlinearity: parameter-effects curvature.
    Box and Cox (1964), An analysis of transformations. Cox and Reid (1987), Parameter orthogonality.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar, Values
from .compiling import compiled

Places = tuple[tuple[int, int], ...]
"""Of each further number that must be positive its place among the effects' numbers, and its amplitude's."""

FARTHEST = 20.0
"""Exponents are cut here: a number e^20 times that of the point is nowhere near any test."""


class Straight(eqx.Module):
    """Shear p and power q of every number of the effects; 0 of amplitudes, and of numbers that may be 0."""

    shear: Float[Array, "particles numbers"]
    power: Float[Array, "particles numbers"]

    @classmethod
    def of(cls, count: int, shear: np.ndarray, power: np.ndarray) -> Straight:
        """The same for so many particles."""
        return cls(*(jnp.asarray(np.broadcast_to(x, (count, len(x)))) for x in (shear, power)))


def coordinates(
    theta: Float[Array, " numbers"], at: Float[Array, " numbers"], straight: Straight, places: Places
) -> tuple[Float[Array, " numbers"], Float[Array, " numbers"]]:
    """Coordinates of one particle's numbers, and the factor that each amplitude has in its own.

    All without an axis of particles; `at` are the numbers where the test is linearised.
    """
    away, factor = theta - at, jnp.ones_like(theta)
    for k, amplitude in places:
        x, q = jnp.log(theta[k] / at[k]), straight.power[k]
        away = away.at[k].set(at[k] * box_cox(x, q))
        factor = factor.at[amplitude].multiply(jnp.exp(jnp.clip(straight.shear[k] * x, -FARTHEST, FARTHEST)))
    amplitudes = sorted({amplitude for _, amplitude in places})
    for k in amplitudes:
        away = away.at[k].set(theta[k] * factor[k] - at[k])
    return away, factor


def numbers(
    away: Float[Array, " numbers"], at: Float[Array, " numbers"], straight: Straight, places: Places
) -> Float[Array, " numbers"]:
    """The numbers at these coordinates: the inverse of `coordinates`."""
    theta = at + away
    for k, amplitude in places:
        q = straight.power[k]
        linear = jnp.abs(q) < 1e-6
        safe = jnp.where(linear, 1.0, q)
        x = jnp.where(linear, away[k] / at[k], jnp.log1p(safe * away[k] / at[k]) / safe)
        theta = theta.at[k].set(at[k] * jnp.exp(x))
        theta = theta.at[amplitude].multiply(jnp.exp(-straight.shear[k] * x))
    return theta


def box_cox(x: Values, power: Scalar) -> Values:
    """How far v goes, per unit of the number, where it changes by the factor e^x: (e^(q x) - 1) / q."""
    linear = jnp.abs(power) < 1e-6
    safe = jnp.where(linear, 1.0, power)
    return jnp.where(linear, x, jnp.expm1(jnp.clip(safe * x, -FARTHEST, FARTHEST)) / safe)


@compiled
def moved(
    away: Float[Array, " numbers"], theta: Float[Array, "particles numbers"], straight: Straight, places: Places
) -> tuple[Float[Array, "particles numbers"], Float[Array, "particles numbers numbers"]]:
    """Numbers of all particles at coordinates that all share, and their derivatives by the coordinates."""

    def of_one(at: Array, straight: Straight) -> tuple[Array, Array]:
        def there(v: Array) -> Array:
            return numbers(v, at, straight, places)

        return there(away), jax.jacfwd(there)(away)

    return jax.vmap(of_one)(theta, straight)


@compiled
def products(columns: Float[Array, "particles points columns"]) -> Float[Array, "particles numbers numbers"]:
    """Sums over the points of the products of an effect's columns."""
    return jnp.einsum("npk,npl->nkl", columns[..., 4:], columns[..., 4:])
