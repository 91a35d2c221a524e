r"""The loading curve, a quintic, and its inverse without a data-dependent loop.

An iteration needs a good start where the curve is nearly flat: at its bend when monotonicity is about to be lost, and
at its peak when it is lost. Around the bend b the quintic is *exactly*

.. math:: \sigma(b + d) = \sigma_b + m d + 2 K_3 d^3 + 5 K_5 b\, d^4 + K_5 d^5,

so the root of its cubic part is such a start, and an upper bound to the right of the bend. Around a peak p the curve
falls by :math:`H_0 e^2 + H_1 e^3 + \dots`, :math:`e = p - x`, again a cubic. From these starts four Halley steps reach
the last digit in every case tried: K3 = 0, loss of monotonicity, peaks approached to 1e-14, stresses over 13 decades.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from .._numerics import recompute, rough_power
from .._types import Flag, Scalar, Values

HALLEY_STEPS = 4


class Quintic(eqx.Module):
    """:math:`k_1 x - k_3 x^3 + k_5 x^5`, force against displacement or stress against scaled strain.

    Never below zero: pushing a particle together cannot pull. The bare quintic would where k3^2 > 4 k1 k5.
    """

    k1: Values
    k3: Values
    k5: Values

    def secant(self, x: Values) -> Values:
        """Value over x, as a polynomial: finite at x = 0, where their quotient is not."""
        square = x * x
        value = self.k1 - square * (self.k3 - square * self.k5)
        return jnp.where(value < 0, 0.0, value)  # this way round a parameter that is NaN shows

    def tangent(self, x: Values) -> Values:
        """Slope of the bare quintic."""
        square = x * x
        return self.k1 - square * (3 * self.k3 - 5 * square * self.k5)

    def loading(self, x: Values) -> Values:
        """Force or stress of loading."""
        return x * self.secant(x)

    def work(self, x: Values) -> Values:
        """Integral of loading. The stretch that is cut off ends at roots: derivatives do not depend on its ends."""

        def integral(square: Values) -> Values:
            return square * (self.k1 / 2 - square * (self.k3 / 4 - square * self.k5 / 6))

        square = x * x
        discriminant = self.k3 * self.k3 - 4 * self.k1 * self.k5
        pulls = discriminant > 0
        larger = jnp.where(pulls, self.k3 + jnp.sqrt(jnp.where(pulls, discriminant, 1.0)), 1.0)
        begin, end = jax.lax.stop_gradient((2 * self.k1 / larger, larger / jnp.where(pulls, 2 * self.k5, 1.0)))
        before = integral(jnp.where(pulls & (square > begin), begin, square))
        return before + jnp.where(pulls & (square > end), integral(square) - integral(end), 0.0)

    @property
    def is_monotone(self) -> Flag:
        r"""Whether loading never falls: :math:`9 k_3^2 \le 20 k_1 k_5`. It does in 2.4 % of the paper's draws."""
        return 9 * self.k3 * self.k3 <= 20 * self.k1 * self.k5

    def halley(self, x: Values) -> tuple[Values, Values, Values]:
        """Value, slope and half the curvature of the bare quintic: what a step of Halley's method takes."""
        square = x * x
        hardening = square * self.k5
        value = x * (self.k1 - square * (self.k3 - hardening))
        return value, self.k1 - square * (3 * self.k3 - 5 * hardening), x * (10 * hardening - 3 * self.k3)


@jax.custom_jvp
def reached(curve: Quintic, stress: Values, floor: Scalar) -> Values:
    """Smallest x at which loading reaches a stress, 0 for stress <= 0; derivatives by the implicit-function rule.

    `floor` is the largest x so far: behind the peak of a curve that is not monotone there is no way back.
    """
    target = jnp.maximum(stress, 0.0)
    # The barrier makes two loops over the data, which on a CPU take four fifths of the time of a single one.
    x = jax.lax.optimization_barrier(_start(curve, target, floor))
    # The slope vanishes only where the curve just stops being monotone, and there at the root itself: stay there. Stay,
    # too, once the stress is met but for rounding, which over a small slope would be a large step.
    noise = 8 * jnp.finfo(x.dtype).eps * curve.k1
    rounding = 2 * jnp.finfo(x.dtype).eps * target
    for _ in range(HALLEY_STEPS):
        stress_there, slope, half_curvature = curve.halley(x)
        excess = stress_there - target
        squared = slope * slope
        divisor = jnp.maximum(squared - excess * half_curvature, 0.5 * squared)
        moves = (slope > noise) & (jnp.abs(excess) > rounding)
        x = x - recompute(excess * slope / jnp.where(moves, divisor, jnp.inf))
    return x


@reached.defjvp
def _reached_jvp(primals, tangents):
    curve, stress, _ = primals
    change, dstress, _ = tangents
    x = reached(*primals)
    cube = x * x * x
    slope = curve.tangent(x)
    # At the peak of a curve that is not monotone the derivative is infinite; a floor keeps it finite.
    smallest = jnp.sqrt(jnp.finfo(x.dtype).eps) * curve.k1
    total = dstress - x * change.k1 + cube * change.k3 - x * x * cube * change.k5
    return x, jnp.where(stress >= 0, recompute(total / jnp.where(slope > smallest, slope, smallest)), 0.0)


def _root(x: Values) -> Values:
    """Square root of the positive part, for code that is never differentiated."""
    return recompute(jnp.sqrt(jnp.maximum(x, 0.0)))


def _rough(x: Values, p: float) -> Values:
    """A power within 5 %, of numbers kept within what float32 can hold."""
    return rough_power(jnp.clip(x, 1e-37, 1e37), p)


def _start(curve: Quintic, target: Values, floor: Scalar) -> Values:
    K1, K3, K5 = curve.k1, curve.k3, curve.k5
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

    # Around the bend, d^3 + 3 p d = 2 q. With K3 -> 0 there is no bend; the cubic then replaces K5 x^5.
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
