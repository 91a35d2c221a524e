"""Force on the branch that starts at a peak: force against displacement, with derivatives in closed form."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from .._numerics import shared
from .._types import Scalar, Values
from ._loading_inverse import secant_modulus, tangent_modulus
from ._recovery import stress_ratio
from ._unloading import StrainScaling, Unloading

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

    and :math:`\Delta` at most what `recoverable_share` allows. Derivatives are written out, because reverse mode then
    stores half as many arrays along a path. With :math:`h = -\tfrac12 s f'`, where the formula holds:

    .. math:: dF = (f + n h)\, dF_P - h k_P\, d\gamma_P + h F_P\, dc/c + F_P f'\, d(d)/\Delta

    and in general :math:`dF = f\, dF_P + 2 h F_P\, d\log\Delta + F_P f'\, d(d)/\Delta`.

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
    secant, span, s, ratio, all_strain, all_work = _branch(power, *primals)
    # The force and all derivatives need these: without a barrier XLA computes them again in the loop of each output.
    s, ratio = jax.lax.optimization_barrier((s, ratio))
    force = peak * secant
    square = peak * peak
    inside = (s > 0) & (s < 1)
    s = jnp.where(inside, s, 0.0)
    fall = jnp.where(inside, 4 / jnp.pi * shared(jnp.sqrt((1 - s) * (1 + s))), 0.0)
    h = 0.5 * s * fall
    by_constants = peak * (dk1 - square * (dk3 - square * dk5))
    dforce = by_constants + tangent_modulus(k1, k3, k5, peak) * dpeak
    # The terms with h are 2 h F_P d(log Delta): by the formula, where all strain is recovered, and where all work is.
    own = jnp.where(all_strain | all_work, 0.0, h)
    share = shared(jnp.where(all_work, 2 * h * secant / work_per_square(k1, k3, k5, peak), 0.0))
    factor = jnp.where(secant > 0, ratio + power * own - jnp.where(all_work, 2 * h, 0.0), 0.0)
    by_peak = jnp.where(all_strain, 2 * h, -own) * secant + share * secant
    by_work = share * peak * (dk1 / 2 - square * (dk3 / 4 - square * (dk5 / 6)))
    change = factor * dforce + by_peak * dpeak + by_work + shared(own * force / c) * dc
    change = change - shared(force * fall / span) * ddrop
    # Transposed, this is a barrier for the cotangent, which otherwise would be computed again for each input.
    return force * ratio, jax.lax.optimization_barrier(change)


def work_per_square(k1: Scalar, k3: Scalar, k5: Scalar, peak: Values) -> Values:
    """Work of loading over the square of the displacement."""
    square = peak * peak
    return k1 / 2 - square * (k3 / 4 - square * (k5 / 6))


MOST_RECOVERED = 0.75 * jnp.pi
r"""Work over force, times this, is the recovered displacement that gives back all work: :math:`1/g(0)`."""


def recoverable_share(secant: Values, work: Values) -> Values:
    r"""Largest share of its displacement that a contact can recover and give back no more work than it took.

    .. math:: \min\left(1,\ \tfrac{3 \pi}{4} \frac{W}{F_P \gamma_P}\right)

    Args:
        secant: peak force over peak displacement, or stress over strain.
        work: work of loading over the square of the same.
    """
    positive = secant > 0
    return jnp.minimum(1.0, MOST_RECOVERED * shared(work / jnp.where(positive, secant, 1.0)))


def _branch(power, k1, k3, k5, c, peak, drop):
    """Secant, recoverable displacement (1 if nothing was carried), its recovered share, share of peak force left, and
    whether all strain or all work is recovered."""
    secant = secant_modulus(k1, k3, k5, peak)
    square = c * secant if power == 1 else c * peak * secant * secant
    share = recoverable_share(secant, work_per_square(k1, k3, k5, peak))
    most = shared(share * peak) ** 2
    bound = square > most
    square = jnp.where(bound, most, square)
    carries = (peak > 0) & (square > 0)
    span = shared(jnp.sqrt(jnp.where(carries, square, 1.0)))
    s = jnp.where(carries, shared(drop / span), 1.0)
    left = jnp.where(drop <= 0, 1.0, stress_ratio(s))
    return secant, span, s, left, bound & (share >= 1), bound & (share < 1)
