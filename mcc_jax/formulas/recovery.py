r"""The elastic branch in one variable: how stress falls as strain is recovered, its inverse and its energy.

With :math:`s = (\epsilon_P - \epsilon)/\delta = \sqrt{1 - \phi^2}`, linear in strain, the arcsine law of unloading is

.. math:: \sigma / \sigma_P = f(s) = \tfrac{2}{\pi}\left[\arccos s - s\sqrt{1 - s^2}\right].

The printed form in :math:`\phi` loses all digits near both ends and has no derivative at the onset. Here every function
is an exact power of the distance to the singular end times a polynomial. Accuracy: 4e-16 of the peak in float64, 2e-7
in float32.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from .._numerics import horner, recompute, two_thirds_power
from .._types import Values
from ..arguments import values
from .recovery_coefficients import ENERGY_64, RATIO_32, RATIO_64, RECOVERY_32, RECOVERY_64


def _is_double(x: Values) -> bool:
    return x.dtype == jnp.float64


def stress_ratio(s: Any) -> Values:
    r"""Stress over peak stress :math:`f(s)` [-] after a share s of the strain is recovered: 1 for s <= 0, 0 for s >= 1.

    Relative accuracy is kept towards s = 1. The derivative is :math:`-\tfrac{4}{\pi}\sqrt{1 - s^2}` on 0 <= s < 1, else
    0.

    References:
        Bommireddy et al. (2018), eq. 23, with phi^2 = 1 - s^2.
    """
    return _stress_ratio(values(s, "s"))


@jax.custom_jvp
def _stress_ratio(s: Values) -> Values:
    u = jnp.clip(1 - s, 0, 1)
    return u * recompute(jnp.sqrt(u)) * horner(RATIO_64 if _is_double(u) else RATIO_32, 2 * u - 1)


@_stress_ratio.defjvp
def _stress_ratio_jvp(primals, tangents):
    (s,), (ds,) = primals, tangents
    inside = (s >= 0) & (s < 1)
    chord = jnp.where(inside, (1 - s) * (1 + s), 1.0)
    return stress_ratio(s), jnp.where(inside, -4 / jnp.pi * recompute(jnp.sqrt(chord)), 0.0) * ds


def recovery(ratio: Any) -> Values:
    r"""Inverse of `stress_ratio`: the recovered share of strain [-] at a share of the peak stress.

    Solves Kepler's equation of eccentricity 1, :math:`E - \sin E = \pi\,\sigma/\sigma_P` with :math:`s = \cos(E/2)`, in
    closed form: 1 for ratio <= 0, 0 for ratio >= 1. The derivative grows as ratio^(-1/3) towards full release and is 0
    beyond it, where the platen no longer touches.
    """
    return _recovery(values(ratio, "ratio"))


@jax.custom_jvp
@jax.jit  # traced once for all its users
def _recovery(ratio: Values) -> Values:
    r = jnp.clip(ratio, 0, 1)
    w = two_thirds_power(r)
    rest = recompute((1 - r) * (1 + r) / (1 + w * (1 + w)))  # 1 - w, all digits kept towards the peak
    return jnp.clip(rest * horner(RECOVERY_64 if _is_double(w) else RECOVERY_32, 2 * w - 1), 0, 1)


@_recovery.defjvp
def _recovery_jvp(primals, tangents):
    (ratio,), (dratio,) = primals, tangents
    s = recovery(ratio)
    inside = (ratio > 0) & (ratio <= 1) & (s < 1)
    chord = jnp.where(inside, (1 - s) * (1 + s), 1.0)
    return s, jnp.where(inside, recompute(-jnp.pi / 4 / jnp.sqrt(chord)), 0.0) * dratio


def energy_ratio(s: Any) -> Values:
    r"""Elastic energy [-] still stored at a recovered share s, over :math:`\sigma_P \delta`: 4/(3 pi) at the onset.

    .. math:: g(s) = \int_s^1 f = \tfrac{2}{\pi}\left[\sqrt{1 - s^2} - s\arccos s - \tfrac13 (1 - s^2)^{3/2}\right]
    """
    return _energy_ratio(values(s, "s"))


@jax.custom_jvp
def _energy_ratio(s: Values) -> Values:
    u = jnp.clip(1 - s, 0, 1)
    return u * u * jnp.sqrt(u) * horner(ENERGY_64, 2 * u - 1)


@_energy_ratio.defjvp
def _energy_ratio_jvp(primals, tangents):
    (s,), (ds,) = primals, tangents
    return energy_ratio(s), jnp.where((s >= 0) & (s < 1), -stress_ratio(s), 0.0) * ds
