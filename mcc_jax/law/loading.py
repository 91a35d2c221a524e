"""Virgin loading of a law whose three terms carry factors that depend on strain and rate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from .._types import Values
from ..effects import AbstractEffect, Factors, Record
from ..formulas import Formulas, loading_strain
from ..geometry import Particle

Effects = tuple[AbstractEffect, ...]
NEWTON_STEPS = 6  # from a start within a few per cent, to rounding: tests/effects/test_physics.py


def strain_under(effects: Effects, law: Formulas, particle: Particle, record: Record, stress: Values) -> Values:
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


def loading_factors(effects: Effects, law: Formulas, particle: Particle, record: Record, strain: Values) -> Factors:
    """Product of the factors of all effects on the three terms of loading."""
    one = jnp.ones_like(strain)
    product = (one, one, one)
    for effect in effects:
        f1, f3, f5 = effect.loading(law, particle, record, strain)
        product = (product[0] * f1, product[1] * f3, product[2] * f5)
    return product


def _root(effects: Effects, law: Formulas, particle: Particle, record: Record, target: Values) -> Values:
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


def _slope(stress: Callable[[Values], Values], strain: Values, law: Formulas, particle: Particle) -> Values:
    """Slope of stress over strain, kept above a thousandth of the initial one, where a curve stops being monotone."""
    slope = jax.jvp(stress, (strain,), (jnp.ones_like(strain),))[1]
    least = 1e-3 * law.plastic.C1 * law.shape_factor(particle)
    return jnp.where(slope > least, slope, least)


def _stress(effects: Effects, law: Formulas, particle: Particle, record: Record, strain: Values) -> Values:
    K1, K3, K5 = law.plastic.polynomial
    f1, f3, f5 = loading_factors(effects, law, particle, record, strain)
    x = law.shape_factor(particle) * strain
    square = x * x
    return x * (K1 * f1 - square * (K3 * f3 - square * (K5 * f5)))
