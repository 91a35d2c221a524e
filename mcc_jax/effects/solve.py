"""Loading and recovery of a law whose terms and modulus carry factors that depend on strain, rate and peak."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from .._types import Scalar, Values
from ..geometry import Particle
from ..law import MccLaw, Unloading, loading_strain, recovery_limit
from .effect import AbstractEffect, Factors
from .record import Record

NEWTON_STEPS = 6
Effects = tuple[AbstractEffect, ...]


def strain_under(effects: Effects, law: MccLaw, particle: Particle, record: Record, stress: Values) -> Values:
    r"""Strain of virgin loading at a stress when effects change the loading curve.

    Solves :math:`f_1 K_1 x - f_3 K_3 x^3 + f_5 K_5 x^5 = \sigma`, :math:`x = \eta_p \epsilon`, with factors
    :math:`f_j(\epsilon)`: the base law's inverse with the factors at its own strain, then Newton's method. Derivatives
    follow from the implicit-function rule, as one Newton step from the frozen root is differentiated.

    Args:
        effects: those whose `loading` acts.
        law: the law.
        particle: the particle.
        record: the points; its rates may enter.
        stress: stress [MPa]; 0 is returned at and below zero.
    """
    target = jnp.where(stress >= 0, stress, 0.0)
    still, fixed, body, points = jax.tree.map(jax.lax.stop_gradient, (effects, law, particle, record))
    root = _root(still, fixed, body, points, jax.lax.stop_gradient(target))

    def residual(strain: Values) -> Values:
        return _stress(effects, law, particle, record, strain) - target

    slope = _slope(lambda strain: _stress(still, fixed, body, points, strain), root, fixed, body)
    return root - residual(root) / slope


def _root(effects: Effects, law: MccLaw, particle: Particle, record: Record, target: Values) -> Values:
    eta = law.shape_factor(particle)
    K1, K3, K5 = (jnp.broadcast_to(k, target.shape) for k in law.plastic.polynomial)
    strain = _inverse(K1, K3, K5, target) / eta
    f1, f3, f5 = loading_factors(effects, law, particle, record, strain)
    strain = _inverse(K1 * f1, K3 * f3, K5 * f5, target) / eta

    def stress(strain: Values) -> Values:
        return _stress(effects, law, particle, record, strain)

    def newton(_: Any, strain: Values) -> Values:
        change = (target - stress(strain)) / _slope(stress, strain, law, particle)
        limit = 0.3 * strain
        return strain + jnp.where(change > limit, limit, jnp.where(change < -limit, -limit, change))

    # Written out, the steps would multiply what is to be compiled.
    return jax.lax.fori_loop(0, NEWTON_STEPS, newton, strain)


def _inverse(K1: Values, K3: Values, K5: Values, stress: Values) -> Values:
    zero = jnp.zeros_like(K1)
    return (jax.vmap(loading_strain) if stress.ndim else loading_strain)(K1, K3, K5, stress, zero)


def _slope(stress: Callable[[Values], Values], strain: Values, law: MccLaw, particle: Particle) -> Values:
    """Slope of stress over strain, kept above a thousandth of the initial one, where a curve stops being monotone."""
    slope = jax.jvp(stress, (strain,), (jnp.ones_like(strain),))[1]
    least = 1e-3 * law.plastic.C1 * law.shape_factor(particle)
    return jnp.where(slope > least, slope, least)


def _stress(effects: Effects, law: MccLaw, particle: Particle, record: Record, strain: Values) -> Values:
    K1, K3, K5 = law.plastic.polynomial
    f1, f3, f5 = loading_factors(effects, law, particle, record, strain)
    x = law.shape_factor(particle) * strain
    square = x * x
    return x * (K1 * f1 - square * (K3 * f3 - square * (K5 * f5)))


def loading_factors(effects: Effects, law: MccLaw, particle: Particle, record: Record, strain: Values) -> Factors:
    """Product of the factors of all effects on the three terms of loading."""
    one = jnp.ones_like(strain)
    product = (one, one, one)
    for effect in effects:
        f1, f3, f5 = effect.loading(law, particle, record, strain)
        product = (product[0] * f1, product[1] * f3, product[2] * f5)
    return product


def recoverable_displacement(
    law: MccLaw, particle: Particle, peak_displacement: Values, peak_force: Values, factor: Values | Scalar
) -> Values:
    """Displacement [um] recovered on full release from a peak, with a factor on the effective modulus.

    The law's own formulas (`MccLaw.recoverable_strain`), in terms of force and displacement at the peak. Their limit
    takes the slope of loading over its secant from the law without `loading` effects, so that it stays in closed form.
    """
    eta = law.shape_factor(particle)
    x = eta * particle.strain(peak_displacement)
    tiny = jnp.finfo(x.dtype).tiny ** 0.5
    moved = x > tiny
    secant = jnp.where(moved, particle.stress(peak_force), law.plastic.C1) / jnp.where(moved, x, 1.0)
    modulus = law.effective_modulus * factor
    shape = eta ** (1 - law.strain_scaling.power)
    if law.unloading is Unloading.PRINTED:
        square = shape * secant / (law.unloading.constant * modulus)
    else:
        square = shape * x * (secant / modulus) ** 2 / law.unloading.constant
    carries = moved & (square > jnp.finfo(square.dtype).tiny)
    recoverable = jnp.sqrt(jnp.where(carries, square, 1.0))
    limit, _ = recovery_limit(particle.strain(peak_displacement), law.plastic.secant(x), law.plastic.tangent(x))
    recoverable = jnp.where(recoverable > limit, limit, recoverable)
    return particle.displacement(jnp.where(carries, recoverable, 0.0))
