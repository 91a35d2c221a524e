"""Unloading: bonds, stiffness, shape, reverse yield."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..law import unloading_ratio
from .form import Array, Form, Hooks, State
from .state import below

_S = np.linspace(0.0, 1.0, 401)


def _invert_unloading(stress: Callable[[Array, Array], Array], state: State) -> Array:
    """First s at which the decreasing curve `stress(s)` (a function of (n, t, k) arrays) falls to the stress."""
    out = np.empty_like(state.sigma)
    for i in range(len(out)):
        s = np.broadcast_to(_S, (out.shape[1], _S.size))
        left = np.minimum.accumulate(stress(s, state.sigma_P[i][:, None]) - state.sigma[i][:, None], axis=1)
        j = np.argmax(left <= 1e-12, axis=1)
        j = np.where(left[:, -1] > 1e-12, _S.size - 1, j)
        rows = np.arange(len(j))
        high, low = left[rows, np.maximum(j - 1, 0)], left[rows, j]
        part = np.where(high > low, high / np.where(high > low, high - low, 1.0), 1.0)
        out[i] = np.where(j > 0, _S[np.maximum(j - 1, 0)] + (_S[1] - _S[0]) * np.clip(part, 0.0, 1.0), 0.0)
    return out


def _bond(strength: Callable[[Array], Array]) -> Hooks:
    """Recovered fraction when a tension `strength(s)` per unit amplitude opposes the separation of the contact.

    The change is computed on one grid for both curves, so that nothing is left at amplitude zero.
    """

    def recovered(k: float, value: Array, s: State) -> Array:
        def held(f: Array, sigma_P: Array) -> Array:
            return sigma_P * unloading_ratio(f) - k * strength(f)

        free = _invert_unloading(lambda f, sigma_P: sigma_P * unloading_ratio(f), s)
        return np.clip(value + _invert_unloading(held, s) - free, 0.0, 1.0)

    return {"recovered_fraction": recovered}


def _adhesion() -> Hooks:
    def strength(f: Array) -> Array:
        phi = np.sqrt((1.0 - f) * (1.0 + f))
        return phi**1.5 * (1.0 - np.exp(-(1.0 - phi) / 0.1))

    return _bond(strength)


def _adhesion_dugdale() -> Hooks:
    # A constant stress over the part of the contact that still holds, taking over as the first tenth is unloaded.
    def strength(f: Array) -> Array:
        return (1.0 - f**2) * -np.expm1(-((f / 0.35) ** 2))

    return _bond(strength)


def _damage_lemaitre() -> Hooks:
    # Damage grows with the square of the strain from a threshold.
    return {"modulus": lambda k, E, s: E / (1.0 + k * np.maximum(s.eps_P - 0.15, 0.0) ** 2 / 0.25)}


def _work(s: State) -> Array:
    x = s.x
    return (s.C1 * x**2 / 2.0 - s.C3**3 * x**4 / 4.0 + s.C5**5 * x**6 / 6.0) / s.eta


def _porosity(eps_P: Array) -> Array:
    return 0.42 * np.exp(-2.2 * eps_P)


def _densification_power() -> Hooks:
    # Open-cell form: the modulus as a power of the relative density.
    return {"modulus": lambda k, E, s: E * ((1.0 - _porosity(s.eps_P)) / (1.0 - _porosity(0.35))) ** k}


def _unloading_shape_power() -> Hooks:
    # Partly a power law in the recovered displacement, as in the reduction of indentation records.
    return {"recovered_fraction": lambda k, f, s: np.clip((1.0 - k) * f + k * (1.0 - np.sqrt(s.u)), 0.0, 1.0)}


def _reverse_threshold() -> Hooks:
    # Reverse yield begins when the load has fallen to 0.45 of its peak.
    return {"strain": lambda k, e, s: e - k * np.maximum(1.0 - s.u / 0.45, 0.0) ** 1.5}


# fmt: off
FORMS = (
    Form("adhesion", "exact", "sigma - s phi^1.5 r(phi)", 0.5, _adhesion, (0.02, 3.0), largest=6.0),
    Form(
        "adhesion", "dugdale", "sigma - s (1 - f^2)(1 - exp(-(f/0.35)^2))", 0.5, _adhesion_dugdale, (0.02, 3.0),
        largest=6.0,
    ),
    Form(
        "damage", "exact", "E exp(-k (eps_P - e0))", 1.0,
        lambda: {"modulus": lambda k, E, s: E * np.exp(-k * (s.eps_P - 0.3))}, (0.1, 8.0), largest=14.0,
    ),
    Form("damage", "lemaitre", "E / (1 + k (eps_P - 0.15)^2 / 0.25)", 1.0, _damage_lemaitre, (0.1, 12.0), largest=80.0),
    Form(
        "damage", "work", "E exp(-k w / w0)", 1.0, lambda: {"modulus": lambda k, E, s: E * np.exp(-k * _work(s) / 1.5)},
        (0.05, 3.0), largest=8.0,
    ),
    Form(
        "densification_stiffening", "exact", "E exp(-b p)", 1.0,
        lambda: {"modulus": lambda k, E, s: E * np.exp(-k * _porosity(s.eps_P))}, (0.2, 10.0), largest=30.0,
    ),
    Form(
        "densification_stiffening", "power", "E ((1-p)/(1-p0))^b", 1.0, _densification_power, (0.2, 8.0), largest=30.0,
    ),
    Form(
        "densification_stiffening", "linear", "E (1 + b (eps_P - 0.35))", 1.0,
        lambda: {"modulus": lambda k, E, s: E * np.maximum(1.0 + k * (s.eps_P - 0.35), 0.05)}, (0.1, 6.0), largest=6.0,
    ),
    Form(
        "unloading_shape", "exact", "s^(1+k) for s", 0.1,
        lambda: {"recovered_fraction": lambda k, f, s: f ** (1.0 + k)}, (0.01, 0.6), (1, -1), largest=0.7,
    ),
    Form(
        "unloading_shape", "power_law", "(1-k) s + k (1 - sqrt(u))", 0.1, _unloading_shape_power, (0.02, 1.0),
        largest=1.0,
    ),
    Form(
        "reverse_plasticity", "exact", "-c (1 - u)^4 on unloading", 2e-3,
        lambda: {"strain": lambda k, e, s: e - k * (1.0 - s.u) ** 4 * below(s)}, (2e-4, 0.03),
    ),
    Form("reverse_plasticity", "threshold", "-c (1 - u/0.45)_+^1.5", 2e-3, _reverse_threshold, (2e-4, 0.03)),
    Form(
        "reverse_plasticity", "cubic", "-c (d_el/0.02)(1 - u/0.7)_+^3", 2e-3,
        lambda: {"strain": lambda k, e, s: e - k * (s.delta / 0.02) * np.maximum(1.0 - s.u / 0.7, 0.0) ** 3},
        (2e-4, 0.03),
    ),
)
# fmt: on
