"""Virgin loading of a law whose three terms carry factors that depend on strain and rate."""

from __future__ import annotations

from collections.abc import Sequence
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
    r"""Strain of virgin loading at a stress [MPa] when effects change the loading curve; 0 at and below zero.

    Solves :math:`f_1 K_1 x - f_3 K_3 x^3 + f_5 K_5 x^5 = \sigma`, :math:`x = \eta_p \epsilon`, with factors
    :math:`f_j(\epsilon)`: the base law's inverse with the factors at its own strain, then Newton's method. Derivatives
    follow from the implicit-function rule, as one Newton step from the frozen root is differentiated.
    """
    target = jnp.where(stress >= 0, stress, 0.0)
    fixed = jax.tree.map(jax.lax.stop_gradient, (effects, law, particle, record))
    law_there, particle_there, target_there = *fixed[1:3], jax.lax.stop_gradient(target)

    def factors(strain: Values) -> list[Factors]:
        return [effect.loading(*fixed[1:], strain) for effect in fixed[0]]

    def with_slopes(strain: Values) -> tuple[list[Factors], list[Factors]]:
        return jax.jvp(factors, (strain,), (jnp.ones_like(strain),))

    def newton(_: Any, strain: Values) -> Values:
        return newton_step(law_there, particle_there, target_there, strain, *with_slopes(strain))

    start = base_strain(law_there, particle_there, target_there)
    start = base_strain(law_there, particle_there, target_there, factors(start))
    # Written out, the steps would multiply what is to be compiled.
    root = jax.lax.fori_loop(0, NEWTON_STEPS, newton, start)
    residual = stress_at(law, particle, root, [e.loading(law, particle, record, root) for e in effects]) - target
    return root - residual / slope_at(law_there, particle_there, root, *with_slopes(root))


def stress_at(law: Formulas, particle: Particle, strain: Values, factors: Sequence[Factors] = ()) -> Values:
    """Stress [MPa] of virgin loading at a strain, with the factors of effects on its three terms."""
    K1, K3, K5 = _with_factors(law, strain, factors)
    x = law.shape_factor(particle) * strain
    square = x * x
    return x * (K1 - square * (K3 - square * K5))


def slope_at(
    law: Formulas, particle: Particle, strain: Values, factors: Sequence[Factors], slopes: Sequence[Factors]
) -> Values:
    """Slope of `stress_at` over strain, of the factors' own slopes too; kept above a thousandth of the initial one,
    where a curve stops being monotone."""
    one = jnp.ones_like(strain)
    slope = jax.jvp(lambda *at: stress_at(law, particle, *at), (strain, factors), (one, slopes))[1]
    least = 1e-3 * law.plastic.C1 * law.shape_factor(particle)
    return jnp.where(slope > least, slope, least)


def base_strain(law: Formulas, particle: Particle, stress: Values, factors: Sequence[Factors] = ()) -> Values:
    """Strain of virgin loading at a stress, with factors that do not depend on strain."""
    K1, K3, K5 = _with_factors(law, stress, factors)
    inverse = jax.vmap(loading_strain) if stress.ndim else loading_strain
    return inverse(K1, K3, K5, stress, jnp.zeros_like(K1)) / law.shape_factor(particle)


def newton_step(
    law: Formulas,
    particle: Particle,
    stress: Values,
    strain: Values,
    factors: Sequence[Factors],
    slopes: Sequence[Factors],
) -> Values:
    """A step of Newton's method for the strain at a stress, of at most 30 % of the strain."""
    change = (stress - stress_at(law, particle, strain, factors)) / slope_at(law, particle, strain, factors, slopes)
    limit = 0.3 * strain
    return strain + jnp.where(change > limit, limit, jnp.where(change < -limit, -limit, change))


def _with_factors(law: Formulas, like: Values, factors: Sequence[Factors]) -> tuple[Values, Values, Values]:
    K1, K3, K5 = (jnp.broadcast_to(K, like.shape) for K in law.plastic.polynomial)
    for f1, f3, f5 in factors:
        K1, K3, K5 = K1 * f1, K3 * f3, K5 * f5
    return K1, K3, K5
