"""Force on the branch that starts at a peak: force against displacement, with derivatives in closed form."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from .._numerics import shared
from .._types import Scalar, Values
from .loading_inverse import secant_modulus, tangent_modulus
from .recovery import stress_ratio
from .recovery_limit import SHARE, recovery_limit
from .unloading import StrainScaling, Unloading

AREA = 1e-3 * jnp.pi / 4
"""Effective area over the diameter squared, times what makes mN of MPa um^2."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def branch_coefficients(
    unloading: Unloading,
    scaling: StrainScaling,
    K1: Scalar,
    K3: Scalar,
    K5: Scalar,
    modulus: Scalar,
    eta: Scalar,
    diameter: Scalar,
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    r"""What `branch_force` needs, from the law and the particle.

    With :math:`A = \tfrac{\pi}{4} D_e^2`, the stress :math:`\sigma = K_1 x - K_3 x^3 + K_5 x^5` at
    :math:`x = \eta_p \gamma / D_e` becomes a force as a quintic of the displacement, and the recoverable displacement

    .. math:: k_m = A K_m (\eta_p / D_e)^m, \qquad c = \frac{D_e^3}{k\, \eta_p^p\, (\bar E A)^n}

    with k and n of the `Unloading` form and p of the `StrainScaling`. Derivatives are written out, because reverse mode
    then takes half as many operations.

    Args:
        unloading: form of the recovered strain.
        scaling: how the shape factor enters it.
        K1: factor of x [MPa].
        K3: factor of -x^3 [MPa].
        K5: factor of x^5 [MPa].
        modulus: effective modulus [MPa].
        eta: shape factor [-].
        diameter: effective diameter [um].

    Returns:
        k1 [mN/um], k3 [mN/um^3], k5 [mN/um^5] and c [um^3/mN for n = 1, um^3/mN^2 for n = 2].
    """
    first, third, fifth, _ = _powers(eta, diameter)
    return K1 * first, K3 * third, K5 * fifth, _compliance(unloading, scaling, modulus, eta, diameter)


@branch_coefficients.defjvp
def _branch_coefficients_jvp(unloading, scaling, primals, tangents):
    K1, K3, K5, modulus, eta, diameter = primals
    dK1, dK3, dK5, dmodulus, deta, ddiameter = tangents
    first, third, fifth, square = _powers(eta, diameter)
    by_eta, by_diameter = AREA * diameter, AREA * eta
    values = *_, c = branch_coefficients(unloading, scaling, *primals)
    n, p = unloading.stress_power, scaling.power
    dc = (3 - 2 * n) * shared(c / diameter) * ddiameter - n * shared(c / modulus) * dmodulus
    changes = (
        first * dK1 + K1 * (by_eta * deta + by_diameter * ddiameter),
        third * dK3 + K3 * square * (3 * by_eta * deta - by_diameter * ddiameter),
        fifth * dK5 + K5 * (square * square) * (5 * by_eta * deta - 3 * by_diameter * ddiameter),
        dc - p * shared(c / eta) * deta if p else dc,
    )
    # Transposed, these are barriers for the cotangents, which otherwise would be computed again for each input. One for
    # each: what does not depend on the input at hand has no transpose.
    return values, tuple(map(jax.lax.optimization_barrier, changes))


def _powers(eta, diameter):
    """k_m / K_m for m = 1, 3, 5, and the square of the scaled strain over the displacement."""
    slope = shared(eta / diameter)
    square = slope * slope
    first = AREA * (eta * diameter)
    third = first * square
    return first, third, third * square, square


def _compliance(unloading, scaling, modulus, eta, diameter):
    n = unloading.stress_power
    stiffness = unloading.constant * eta**scaling.power * (modulus * AREA) ** n
    return shared((diameter if n == 1 else 1 / diameter) / stiffness)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def branch_force(power: int, k1: Scalar, k3: Scalar, k5: Scalar, c: Scalar, peak: Values, drop: Values) -> Values:
    r"""Force after the displacement dropped from its peak.

    .. math:: F = F_P f(d / \Delta), \quad F_P = k_P \gamma_P, \quad k_P = k_1 - k_3 \gamma_P^2 + k_5 \gamma_P^4, \quad
        \Delta^2 = c\, k_P^n \gamma_P^{n-1}

    and :math:`\Delta` no larger than `recovery_limit`.

    Derivatives are written out, because reverse mode then stores half as many arrays along a path. With
    :math:`h = -\tfrac12 s f'`:

    .. math:: dF = (f + n h)\, dF_P - h k_P\, d\gamma_P + h F_P\, dc/c + F_P f'\, d(d)/\Delta

    where the formula holds. At the limit the terms in h are those of :math:`2 h F_P\, d\Delta/\Delta`, that is
    :math:`2 h k_P\, d\gamma_P` or :math:`2 h\, (dF_P - F_P\, dT/T)` with T the slope of loading.

    Args:
        power: n, 1 (printed form) or 2 (punch forms).
        k1: initial slope of loading.
        k3: factor of the softening term.
        k5: factor of the hardening term.
        c: factor of the recoverable displacement squared.
        peak: largest displacement so far.
        drop: how far the displacement is below it, >= 0; 0 is loading, with the derivative of loading.

    Returns:
        Force; zero where no force was carried at the peak.
    """
    secant, _, _, ratio, _, _ = _branch(power, k1, k3, k5, c, peak, drop)
    return peak * secant * ratio


@branch_force.defjvp
def _branch_force_jvp(power, primals, tangents):
    k1, k3, k5, c, peak, _ = primals
    dk1, dk3, dk5, dc, dpeak, ddrop = tangents
    secant, span, s, ratio, limited, steep = _branch(power, *primals)
    # The force and all derivatives need these: without a barrier XLA computes them again in the loop of each output.
    s, ratio = jax.lax.optimization_barrier((s, ratio))
    force = peak * secant
    square = peak * peak
    inside = (s > 0) & (s < 1)
    s = jnp.where(inside, s, 0.0)
    fall = jnp.where(inside, 4 / jnp.pi * shared(jnp.sqrt((1 - s) * (1 + s))), 0.0)
    h = 0.5 * s * fall
    with_force = jnp.where(limited, jnp.where(steep, 2.0, 0.0), float(power))
    with_peak = jnp.where(limited, jnp.where(steep, 0.0, -2.0), 1.0)
    factor = jnp.where(secant > 0, ratio + with_force * h, 0.0)
    # At the limit F_P / T is the span over a constant.
    by_slope = jnp.where(limited & steep, 2 / SHARE * h * span, 0.0)
    by_peak = factor * tangent_modulus(k1, k3, k5, peak) - with_peak * h * secant
    by_peak = by_peak + by_slope * peak * (6 * k3 - 20 * square * k5)
    by_c = jnp.where(limited, 0.0, shared(h * force / c))
    by_drop = shared(force * fall / span)
    # The same for each factor of a tangent: one barrier for each, so that what a derivative does not need is left out.
    factors = factor * peak, by_slope, by_peak, by_c, by_drop
    by_force, by_slope, by_peak, by_c, by_drop = map(jax.lax.optimization_barrier, factors)
    change = (by_force - by_slope) * dk1 - square * ((by_force - 3 * by_slope) * dk3)
    change = change + square * square * ((by_force - 5 * by_slope) * dk5) + by_peak * dpeak
    change = change + by_c * dc - by_drop * ddrop
    # Transposed, this is a barrier for the cotangent, which otherwise would be computed again for each input.
    return force * ratio, jax.lax.optimization_barrier(change)


def _branch(power, k1, k3, k5, c, peak, drop):
    """Secant, recoverable displacement (1 if nothing was carried), its recovered share, share of peak force left.

    And whether the recoverable displacement is at its limit, and whether loading is steep there.
    """
    secant = secant_modulus(k1, k3, k5, peak)
    square = c * secant if power == 1 else c * peak * secant * secant
    carries = (peak > 0) & (square > 0)
    span = shared(jnp.sqrt(jnp.where(carries, square, 1.0)))
    limit, steep = recovery_limit(peak, secant, tangent_modulus(k1, k3, k5, peak))
    limited = carries & (span > limit)
    span = jnp.where(limited, limit, span)
    s = jnp.where(carries, shared(drop / span), 1.0)
    return secant, span, s, jnp.where(drop <= 0, 1.0, stress_ratio(s)), limited, steep
