r"""Strain of plastic loading under a given stress: the inverse of the quintic, without a data-dependent loop.

An iteration needs a good start where the curve is nearly flat: at its bend when monotonicity is about to be lost, and
at its peak when it is lost. Around the bend b the quintic is *exactly*

.. math:: \sigma(b + d) = \sigma_b + m d + 2 K_3 d^3 + 5 K_5 b\, d^4 + K_5 d^5,

so the root of its cubic part is such a start, and an upper bound to the right of the bend. Around a peak p the curve
falls by :math:`H_0 e^2 + H_1 e^3 + \dots`, :math:`e = p - x`, again a cubic. From these starts four Halley steps reach
the last digit in every case tried: K3 = 0, loss of monotonicity, peaks approached to 1e-14, stresses over 13 decades.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from .._numerics import recompute, rough_power
from .._types import Scalar, Values

HALLEY_STEPS = 4


def secant_modulus(K1: Scalar, K3: Scalar, K5: Scalar, x: Values) -> Values:
    """Stress over scaled strain [MPa], as a polynomial: finite at x = 0, where their quotient is not.

    Zero where the quintic would be tensile, which takes K3^2 > 4 K1 K5: pushing a particle together cannot pull.
    """
    square = x * x
    value = K1 - square * (K3 - square * K5)
    return jnp.where(value < 0, 0.0, value)  # this way round a parameter that is NaN shows


def tangent_modulus(K1: Scalar, K3: Scalar, K5: Scalar, x: Values) -> Values:
    """Slope of the quintic [MPa]."""
    square = x * x
    return K1 - square * (3 * K3 - 5 * square * K5)


def loading_work(K1: Scalar, K3: Scalar, K5: Scalar, x: Values) -> Values:
    """Integral of x times `secant_modulus`: the work of loading, none where the quintic would be tensile.

    The ends of that stretch are roots of the quintic, so that derivatives do not depend on them.
    """

    def integral(square: Values) -> Values:
        return square * (K1 / 2 - square * (K3 / 4 - square * K5 / 6))

    square = x * x
    discriminant = K3 * K3 - 4 * K1 * K5
    pulls = discriminant > 0
    larger = jnp.where(pulls, K3 + jnp.sqrt(jnp.where(pulls, discriminant, 1.0)), 1.0)
    begin, end = jax.lax.stop_gradient((2 * K1 / larger, larger / jnp.where(pulls, 2 * K5, 1.0)))
    before = integral(jnp.where(pulls & (square > begin), begin, square))
    return before + jnp.where(pulls & (square > end), integral(square) - integral(end), 0.0)


def quintic(K1: Scalar, K3: Scalar, K5: Scalar, x: Values) -> tuple[Values, Values, Values]:
    """Value, slope and half the curvature of K1 x - K3 x^3 + K5 x^5: what a step of Halley's method takes."""
    square = x * x
    hardening = square * K5
    value = x * (K1 - square * (K3 - hardening))
    return value, K1 - square * (3 * K3 - 5 * hardening), x * (10 * hardening - 3 * K3)


@jax.custom_jvp
def loading_strain(K1: Scalar, K3: Scalar, K5: Scalar, stress: Values, floor: Scalar) -> Values:
    """Smallest scaled strain, not on a branch already left behind, at which loading reaches the stress.

    Args:
        K1, K3, K5: factors of x, -x^3 and x^5 [MPa].
        stress: stress [MPa]; 0 is returned for stress <= 0.
        floor: scaled strain already seen; behind the peak of a curve that is not monotone there is no way back.

    Returns:
        Scaled strain [-]; derivatives by the implicit-function rule, 0 out of contact.
    """
    target = jnp.maximum(stress, 0.0)
    # The barrier makes two loops over the data, which on a CPU take four fifths of the time of a single one.
    x = jax.lax.optimization_barrier(_start(K1, K3, K5, target, floor))
    # The slope vanishes only where the curve just stops being monotone, and there at the root itself: stay there. Stay,
    # too, once the stress is met but for rounding, which over a small slope would be a large step.
    noise = 8 * jnp.finfo(x.dtype).eps * K1
    rounding = 2 * jnp.finfo(x.dtype).eps * target
    for _ in range(HALLEY_STEPS):
        stress_there, slope, half_curvature = quintic(K1, K3, K5, x)
        excess = stress_there - target
        squared = slope * slope
        divisor = jnp.maximum(squared - excess * half_curvature, 0.5 * squared)
        moves = (slope > noise) & (jnp.abs(excess) > rounding)
        x = x - recompute(excess * slope / jnp.where(moves, divisor, jnp.inf))
    return x


@loading_strain.defjvp
def _loading_strain_jvp(primals, tangents):
    K1, K3, K5, stress, _ = primals
    dK1, dK3, dK5, dstress, _ = tangents
    x = loading_strain(*primals)
    cube = x * x * x
    slope = tangent_modulus(K1, K3, K5, x)
    # At the peak of a curve that is not monotone the derivative is infinite; a floor keeps it finite.
    smallest = jnp.sqrt(jnp.finfo(x.dtype).eps) * K1
    change = dstress - x * dK1 + cube * dK3 - x * x * cube * dK5
    return x, jnp.where(stress >= 0, recompute(change / jnp.where(slope > smallest, slope, smallest)), 0.0)


def _root(x: Values) -> Values:
    """Square root of the positive part, for code that is never differentiated."""
    return recompute(jnp.sqrt(jnp.maximum(x, 0.0)))


def _rough(x: Values, p: float) -> Values:
    """A power within 5 %, of numbers kept within what float32 can hold."""
    return rough_power(jnp.clip(x, 1e-37, 1e37), p)


def _start(K1: Scalar, K3: Scalar, K5: Scalar, target: Values, floor: Scalar) -> Values:
    # Written with maxima, and with each costly value used in few places: it then compiles to few loops over the data.
    tiny = jnp.finfo(target.dtype).tiny ** 0.5
    discriminant = 9 * K3 * K3 - 20 * K1 * K5
    falls = discriminant > 0
    # Square of the scaled strain at the peak, the smaller root of the slope, without cancellation and division by K5.
    y = recompute(2 * K1 / (3 * K3 + _root(discriminant) + tiny))
    peak = _root(y)
    drop = peak * (K1 - y * (K3 - y * K5)) - target
    first_branch = falls & (drop >= 0) & (floor <= peak)

    # Below a peak, H0 e^2 + H1 e^3 = drop: e = E g(H1 E / H0) with E = sqrt(drop / H0) and g(z) = (1 + 3z/2)^(-1/3),
    # right at both ends and 13 % off at worst between them.
    over_H0 = recompute(1 / jnp.maximum(peak * (3 * K3 - 10 * K5 * y), tiny))
    E = _root(drop * over_H0)
    widening = 1 + jnp.maximum(15 * K5 * y - 1.5 * K3, 0.0) * E * over_H0

    # Around the bend, d^3 + 3 p d = 2 q. With K3 -> 0 there is no bend; the cubic then stands in for K5 x^5.
    over_K5 = recompute(1 / jnp.maximum(K5, tiny))
    bend_squared = 0.3 * K3 * over_K5
    bend = _root(bend_squared)
    factor = recompute(1 / jnp.maximum(2 * K3, _rough(K1 * K5, 0.5)))
    p = (K1 - 1.5 * bend_squared * K3) * factor * (1 / 3)
    secant = K1 - 0.7 * bend_squared * K3
    q = (target - bend * secant) * factor * 0.5
    concave = (q < 0) & ~falls
    half = jnp.abs(q)
    # One cube root for both; that of a start need not be exact.
    root_cubed = jnp.where(first_branch, widening, half + _root(half * half + p * p * p))
    root = jnp.maximum(_rough(root_cubed, 1 / 3), jnp.where(first_branch, 1.0, _root(-p)))
    over_root = recompute(1 / root)
    around_bend = bend + jnp.where(concave, -1.0, 1.0) * (root - p * over_root)

    # An upper bound: K5 x^5 is at most 9/4 of the stress (monotone), or else half of stress + K3 x^3. Where K1 x is
    # more than K5 x^5 the place where they are equal will do.
    quotient = K1 * over_K5
    bound = 1.05 * _rough(jnp.maximum(2.25 * target * over_K5, quotient * _rough(quotient, 0.25)), 0.2)
    bound = jnp.maximum(bound, jnp.where(falls, 2.6, 0.0) * bend)
    bound = jnp.where(concave, target / secant, bound)  # left of the bend, the chord
    x = jnp.where(first_branch, peak - E * over_root, jnp.minimum(around_bend, bound))
    # At or left of the root of a concave piece.
    return jnp.maximum(x, jnp.where((q < 0) | first_branch, target / K1, 0.0))
