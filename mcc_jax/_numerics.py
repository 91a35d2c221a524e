"""Elementary functions whose values and derivatives stay finite where the plain ones do not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._types import Path, Scalar


def positive_pow(x: Scalar, p: float | Scalar) -> Scalar:
    """`max(x, 0)**p` for p > 1: zero, with zero derivatives, at and below zero, in both modes."""
    positive = x > 0
    inside = jnp.where(positive, x, 1.0)  # `where` alone would still differentiate 0**p in the branch not taken
    return jnp.where(positive, inside**p, 0.0)


def safe_sqrt(x: Scalar) -> Scalar:
    """`sqrt(max(x, 0))` with the derivative 0, instead of infinity, at and below zero."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def _argcummax(path: Path) -> Int[Array, " steps"]:
    """Where along the path so far the largest value lies; the first of equal ones."""

    def larger(left, right):
        left_value, left_index = left
        right_value, right_index = right
        keep = left_value >= right_value
        return jnp.where(keep, left_value, right_value), jnp.where(keep, left_index, right_index)

    return jax.lax.associative_scan(larger, (path, jnp.arange(path.shape[0])))[1]


@jax.custom_jvp
def running_max(path: Path) -> Path:
    """Largest value so far. A tie passes the derivative to the earliest of the equal values, whole and not in halves."""
    return jax.lax.cummax(path)


@running_max.defjvp
def _running_max_jvp(primals, tangents):
    (path,), (tangent,) = primals, tangents
    where = _argcummax(path)
    return path[where], tangent[where]


def horner(coefficients: tuple[float, ...], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Polynomial in `x`, coefficients from the highest power down."""
    value = jnp.full_like(x, coefficients[0])
    for c in coefficients[1:]:
        value = value * x + c
    return value
