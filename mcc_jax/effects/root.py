"""Root of an increasing function of force, bracketed from zero upwards."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from .._types import Flag, Scalar

MAX_DOUBLINGS = 60
MAX_STEPS = 100


def increasing_root(function: Callable[[Scalar], Scalar], start: Scalar) -> Scalar:
    """Where an increasing function crosses zero, at or above 0.

    Doubling finds a bracket, Chandrupatla's method (inverse quadratic interpolation where it is safe, bisection
    elsewhere) closes it to rounding. Not meant to be differentiated.

    Args:
        function: increasing, may have kinks and jumps.
        start: a first guess of an upper bound, > 0.

    Returns:
        The root; 0 if the function is not negative at 0.

    References:
        Chandrupatla (1997), Advances in Engineering Software 28, 145.
    """
    zero = jnp.zeros_like(start)
    below = function(zero)

    def wider(carry: tuple) -> tuple:
        _, _, high, f_high, steps = carry
        up = jnp.where(steps == 0, start, 2 * high)
        return high, f_high, up, function(up), steps + 1

    low, f_low, high, f_high, _ = jax.lax.while_loop(
        lambda c: (c[3] < 0) & (c[4] < MAX_DOUBLINGS), wider, (zero, below, zero, below, 0)
    )
    eps = jnp.finfo(start.dtype).eps

    def width(carry: tuple) -> Scalar:
        return jnp.abs(carry[2] - carry[0])

    def unfinished(carry: tuple) -> Flag:
        a, fa, b, fb, *_, steps = carry
        best = jnp.where(jnp.abs(fa) < jnp.abs(fb), a, b)
        exact = (fa == 0) | (fb == 0)
        return ~exact & (width(carry) > 2 * eps * jnp.abs(best) + jnp.finfo(start.dtype).tiny) & (steps < MAX_STEPS)

    def closer(carry: tuple) -> tuple:
        a, fa, b, fb, share, steps = carry
        new = a + share * (b - a)
        f = function(new)
        same = jnp.sign(f) == jnp.sign(fa)
        c, fc = jnp.where(same, a, b), jnp.where(same, fa, fb)
        b, fb = jnp.where(same, b, a), jnp.where(same, fb, fa)
        a, fa = new, f

        # Inverse quadratic interpolation through a, b, c is safe inside this region.
        def over(x: Scalar, y: Scalar) -> Scalar:
            return x / jnp.where(y == 0, 1.0, y)

        xi, phi = over(a - b, c - b), over(fa - fb, fc - fb)
        safe = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi) & (fa != fb) & (fc != fb) & (fa != fc)
        quadratic = over(fa, fb - fa) * over(fc, fb - fc) + over(c - a, b - a) * over(fa, fc - fa) * over(fb, fc - fb)
        best = jnp.where(jnp.abs(fa) < jnp.abs(fb), a, b)
        least = jnp.minimum(0.5, over(eps * jnp.abs(best), jnp.abs(b - a)))
        share = jnp.clip(jnp.where(safe, quadratic, 0.5), least, 1 - least)
        return a, fa, b, fb, share, steps + 1

    half = jnp.full_like(start, 0.5)
    a, fa, b, fb, *_ = jax.lax.while_loop(unfinished, closer, (low, f_low, high, f_high, half, 0))
    root = jnp.where(jnp.abs(fa) < jnp.abs(fb), a, b)
    return jnp.where(below >= 0, zero, root)
