"""Force on the branch that starts at a peak: force against displacement, with derivatives in closed form."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from .._numerics import shared
from .._types import Scalar, Values
from .loading_inverse import secant_modulus, tangent_modulus
from .recovery import stress_ratio
from .recovery_limit import SHARE, least_stiffness
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
    inverse: Scalar,
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    r"""What `branch_force` needs, from the law and the particle: products only.

    With :math:`A = \tfrac{\pi}{4} D_e^2`, the stress :math:`\sigma = K_1 x - K_3 x^3 + K_5 x^5` at
    :math:`x = \eta_p \gamma / D_e` becomes a force as a quintic of the displacement, and the recoverable displacement

    .. math:: k_m = A K_m (\eta_p / D_e)^m, \qquad e = k\, \eta_p^p\, (\bar E A)^n / D_e^3

    with k and n of the `Unloading` form and p of the `StrainScaling`. Derivatives are written out, because reverse mode
    then takes half as many operations.

    Args:
        unloading: form of the recovered strain.
        scaling: how the shape factor enters it.
        K1, K3, K5: factors of x, -x^3 and x^5 [MPa].
        modulus: effective modulus [MPa].
        eta: shape factor [-].
        diameter: effective diameter [um].
        inverse: one over it; derivatives take it as a function of the diameter.

    Returns:
        k1 [mN/um], k3 [mN/um^3], k5 [mN/um^5] and e [mN/um^3 for n = 1, mN^2/um^3 for n = 2].
    """
    first, third, fifth, _ = _powers(eta, diameter, inverse)
    e = modulus**unloading.stress_power * _per_modulus(unloading, scaling, eta, diameter, inverse)
    return K1 * first, K3 * third, K5 * fifth, e


@branch_coefficients.defjvp
def _branch_coefficients_jvp(unloading, scaling, primals, tangents):
    K1, K3, K5, modulus, eta, diameter, inverse = primals
    dK1, dK3, dK5, dmodulus, deta, ddiameter, _ = tangents
    first, third, fifth, square = _powers(eta, diameter, inverse)
    by_eta, by_diameter = AREA * diameter, AREA * eta
    n, p = unloading.stress_power, scaling.power
    values = *_, e = branch_coefficients(unloading, scaling, *primals)
    of_modulus = (1 if n == 1 else 2 * modulus) * _per_modulus(unloading, scaling, eta, diameter, inverse)
    de = of_modulus * dmodulus + (2 * n - 3) * (e * inverse) * ddiameter
    changes = (
        first * dK1 + K1 * (by_eta * deta + by_diameter * ddiameter),
        third * dK3 + K3 * square * (3 * by_eta * deta - by_diameter * ddiameter),
        fifth * dK5 + K5 * (square * square) * (5 * by_eta * deta - 3 * by_diameter * ddiameter),
        de + p * shared(e / eta) * deta if p else de,
    )
    # Transposed, these are barriers for the cotangents, which otherwise would be computed again for each input. One for
    # each: what does not depend on the input at hand has no transpose.
    return values, tuple(map(jax.lax.optimization_barrier, changes))


def _powers(eta, diameter, inverse):
    """k_m / K_m for m = 1, 3, 5, and the square of the scaled strain over the displacement."""
    slope = eta * inverse
    square = slope * slope
    first = AREA * (eta * diameter)
    third = first * square
    return first, third, third * square, square


def _per_modulus(unloading, scaling, eta, diameter, inverse):
    n = unloading.stress_power
    return unloading.constant * AREA**n * eta**scaling.power * (inverse if n == 1 else diameter)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def branch_force(power: int, k1: Scalar, k3: Scalar, k5: Scalar, e: Scalar, peak: Values, drop: Values) -> Values:
    r"""Force after the displacement dropped from its peak.

    .. math:: F = F_P f(d M / F_P), \quad F_P = k_P \gamma_P, \quad k_P = k_1 - k_3 \gamma_P^2 + k_5 \gamma_P^4, \quad
        M = \max\left(\gamma_P \sqrt{e\, k_P^{2-n} / \gamma_P^{n-1}}, k_P, \tfrac{8}{3 \pi} T\right)

    with T the slope of loading at the peak. :math:`\Delta = F_P / M` is the recoverable displacement: of the three
    terms the first is the formula, the others are its `recovery_limit`.

    Derivatives are written out, because reverse mode then stores half as many arrays along a path. With
    :math:`h = -\tfrac12 s f'`:

    .. math:: dF = (f + 2 h)\, dF_P - 2 h \Delta\, dM + M f'\, d(d)

    where :math:`2 h \Delta\, dM = h\, [(2 - n)\, dF_P + k_P\, d\gamma_P + F_P\, de/e]` by the formula.

    Args:
        power: n, 1 (printed form) or 2 (punch forms).
        k1, k3, k5: initial slope of loading, factors of its softening and its hardening term.
        e: one over the factor of the recoverable displacement squared.
        peak: largest displacement so far.
        drop: how far the displacement is below it, >= 0; 0 is loading, with the derivative of loading.

    Returns:
        Force; zero where no force was carried at the peak.
    """
    _, _, force, _, _, ratio, _, _ = _branch(power, k1, k3, k5, e, peak, drop)
    return force * ratio


@branch_force.defjvp
def _branch_force_jvp(power, primals, tangents):
    _, k3, k5, _, peak, _ = primals
    dk1, dk3, dk5, de, dpeak, ddrop = tangents
    secant, tangent, force, stiffness, s, ratio, limited, steep = _branch(power, *primals)
    # The force and all derivatives need these: without a barrier XLA computes them again in the loop of each output.
    s, ratio, stiffness = jax.lax.optimization_barrier((s, ratio, stiffness))
    square = peak * peak
    inside = (s > 0) & (s < 1)
    s = jnp.where(inside, s, 0.0)
    fall = jnp.where(inside, 4 / jnp.pi * shared(jnp.sqrt((1 - s) * (1 + s))), 0.0)
    h = 0.5 * s * fall
    with_force = jnp.where(limited, jnp.where(steep, 2.0, 0.0), float(power))
    with_peak = jnp.where(limited, jnp.where(steep, 0.0, -2.0), 1.0)
    factor = jnp.where(secant > 0, ratio + with_force * h, 0.0)
    flexibility = shared(1 / stiffness)
    span = force * flexibility
    by_slope = jnp.where(limited & steep, 2 / SHARE * h * span, 0.0)
    by_peak = factor * tangent - with_peak * h * secant
    by_peak = by_peak + by_slope * peak * (6 * k3 - 20 * square * k5)
    by_e = jnp.where(limited, 0.0, h * peak * span * (span if power == 1 else flexibility))  # h F_P / e
    by_drop = fall * stiffness
    # The same for each factor of a tangent: one barrier for each, so that what a derivative does not need is left out.
    factors = factor * peak, by_slope, by_peak, by_e, by_drop
    by_force, by_slope, by_peak, by_e, by_drop = map(jax.lax.optimization_barrier, factors)
    change = (by_force - by_slope) * dk1 - square * ((by_force - 3 * by_slope) * dk3)
    change = change + square * square * ((by_force - 5 * by_slope) * dk5) + by_peak * dpeak
    change = change - by_e * de - by_drop * ddrop
    # Transposed, this is a barrier for the cotangent, which otherwise would be computed again for each input.
    return force * ratio, jax.lax.optimization_barrier(change)


def _branch(power, k1, k3, k5, e, peak, drop):
    """Secant, tangent and force at the peak, peak force over recoverable displacement, its recovered share, force left.

    And whether the recoverable displacement is at its limit, and whether loading is steep there.
    """
    secant, tangent = secant_modulus(k1, k3, k5, peak), tangent_modulus(k1, k3, k5, peak)
    force = peak * secant
    square = e * secant if power == 1 else e * peak
    carries = (force > jnp.finfo(force.dtype).tiny) & (square > 0)
    root = shared(jnp.sqrt(jnp.where(carries, square, 1.0)))
    formula = peak * root if power == 1 else root
    least, steep = least_stiffness(secant, tangent)
    limited = carries & (least > formula)
    stiffness = jnp.where(carries, jnp.where(limited, least, formula), 1.0)
    s = jnp.where(carries, drop * stiffness * shared(1 / jnp.where(carries, force, 1.0)), 1.0)
    return secant, tangent, force, stiffness, s, jnp.where(drop <= 0, 1.0, stress_ratio(s)), limited, steep
