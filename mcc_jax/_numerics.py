"""Elementary functions whose values and derivatives stay finite where the plain ones do not."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Shaped

from ._types import Path, Values
from .arguments import is_traced


def positive_pow(x: Values, p: float | Values) -> Values:
    """`max(x, 0)**p` for p > 1: zero, with zero derivatives, at and below zero, in both modes."""
    positive = x > 0
    inside = jnp.where(positive, x, 1.0)  # `where` alone would still differentiate 0**p in the branch not taken
    return jnp.where(positive, inside**p, 0.0)


@jax.custom_jvp
def running_max(path: Path) -> Path:
    """Largest value so far. A tie passes the derivative to the earliest of the equal values, whole, not in halves."""
    return _running_max(path)


@functools.partial(running_max.defjvp, symbolic_zeros=True)  # pyright: ignore[reportArgumentType]  # a zero is a tangent
def _running_max_jvp(primals, tangents):
    (path,), (tangent,) = primals, tangents
    highest = running_max(path)
    if isinstance(tangent, SymbolicZero):
        return highest, tangent
    first = jnp.ones_like(path[:1], bool)
    return highest, forward_fill(tangent, jnp.concatenate([first, path[1:] > highest[:-1]]))


def forward_fill(values: Path, record: Bool[Array, " steps"]) -> Path:
    """The value at the last record up to each step, the first step being one; linear in the values.

    By doubling. Transposed, that is a sum over the steps that hold a value, where indexing would become a scatter, on a
    CPU a loop over single numbers.
    """
    steps = values.shape[0]
    held, since = jnp.where(record, values, 0.0), ~record
    span = 1  # what has held for less than that is in place; `since` says whether no record came for so long
    while span < steps:
        held = held + jnp.where(since, jnp.pad(held[:-span], (span, 0)), 0.0)
        since = since & jnp.pad(since[:-span], (span, 0))
        held, since = jax.lax.optimization_barrier(held), jax.lax.optimization_barrier(since)
        span *= 2
    return held


def _running_max(path: Shaped[Array, " steps"], width: int = 8) -> Shaped[Array, " steps"]:
    """The larger of the last `width` values and of the blocks of as many before them: one loop over the data.

    `lax.cummax` makes a logarithmic number of strided copies instead and takes five times as long on a CPU.
    """
    steps = path.shape[0]
    if steps <= width:
        return jax.lax.cummax(path)
    blocks = path[: steps // width * width].reshape(-1, width)
    earlier = jnp.repeat(_running_max(_largest_of_each(blocks), width), width)[: steps - width]
    recent = (path[width - k : steps - k] for k in range(width))
    return jnp.concatenate([jax.lax.cummax(path[:width]), functools.reduce(jnp.maximum, recent, earlier)])


def _largest_of_each(blocks: Shaped[Array, "blocks width"]) -> Shaped[Array, " blocks"]:
    """Largest value of each row; NaN if there is one.

    XLA hands a plain maximum to a library whose calls take half of a law's time on a path.
    """

    def larger(a, b):
        return jax.lax.select((b > a) | (b != b), b, a)

    lowest = -jnp.inf if jnp.issubdtype(blocks.dtype, jnp.floating) else jnp.iinfo(blocks.dtype).min
    return jax.lax.reduce(blocks, jnp.asarray(lowest, blocks.dtype), larger, (1,))


def horner(coefficients: tuple[float, ...], x: Float[Array, ...]) -> Float[Array, ...]:
    """Polynomial in `x`, coefficients from the highest power down."""
    value = jnp.full_like(x, coefficients[0])
    for c in coefficients[1:]:
        value = value * x + c
    return value


def compiled_whole[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function as a whole where it is called from plain Python; within other compiled code it dissolves.

    Otherwise JAX compiles the fifty small operations of a law one at a time, which takes seconds.
    """
    return cast(Any, jax.jit)(function, inline=True)


def compiled[**P, R](function: Callable[P, R], level: int = 1) -> Callable[P, R]:
    """`equinox.filter_jit` with less optimisation: a fifth less time to compile, the same speed; dissolves likewise."""
    whole = cast(Any, eqx.filter_jit)(function, compiler_options={"xla_backend_optimization_level": level})

    @functools.wraps(function)
    def run(*given: P.args, **named: P.kwargs) -> R:
        traced = any(is_traced(x) for x in jax.tree.leaves((given, named)))
        return (function if traced else whole)(*given, **named)

    return run


def recompute(x: Values) -> Values:
    """`x` itself, marked as cheap to use in several places.

    XLA on a CPU keeps a quotient, root or logarithm out of the loop over the data of its users if it has more than one,
    and passes it on through memory. Behind this identity (rounding to the precision it has) it stays in their loop.
    """
    kind = jnp.finfo(x.dtype)
    return jax.lax.reduce_precision(x, kind.nexp, kind.nmant)


@jax.custom_jvp
def cotangent_barrier(x: Values) -> Values:
    """`x` itself, whose derivative is worked out once and kept for all its users.

    In reverse mode XLA otherwise computes what arrives here again in the loop of every input that it goes on to.
    """
    return x


@cotangent_barrier.defjvp
def _cotangent_barrier_jvp(primals, tangents):
    return primals[0], jax.lax.optimization_barrier(tangents[0])


def rough_power(x: Values, p: float) -> Values:
    """`x**p` within 5 % for normal float32 numbers x > 0 and |p| <= 1: a start for iterations, not to differentiate.

    The bits of a floating-point number, read as an integer, are its logarithm to that accuracy: one multiplication.
    """
    logarithm = jax.lax.bitcast_convert_type(x.astype(jnp.float32), jnp.int32).astype(jnp.float32)
    of_one = (127 - 0.043) * 2.0**23
    bits = jnp.float32(p) * logarithm + jnp.float32((1 - p) * of_one)
    return jax.lax.bitcast_convert_type(bits.astype(jnp.int32), jnp.float32).astype(x.dtype)


def two_thirds_power(x: Values) -> Values:
    """`x**(2/3)` for 0 <= x <= 1, to rounding; below 1e-36 too small, but never above it. Not to differentiate.

    Two steps of the binomial series of x^(-1/3): multiplications only, a fifth of the cost of a logarithm.
    """
    cube = jnp.maximum(x, 1e-36)
    y = rough_power(cube, -1 / 3)
    e = 1 - cube * (y * y * y)
    y = y * (1 + e * (1 / 3 + e * (2 / 9 + e * (14 / 81 + e * (35 / 243 + e * (91 / 729))))))
    e = 1 - cube * (y * y * y)
    power = x * y
    return power + power * (e * (1 / 3 + e * (2 / 9)))  # what is added last is small: its rounding does not count
