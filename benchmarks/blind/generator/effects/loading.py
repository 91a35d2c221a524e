"""The law of loading: hardening, size, shape, events, toe, friction, humidity."""

from __future__ import annotations

from typing import Any

import numpy as np

from .form import HUMIDITY, Array, Form, Hooks, State
from .state import contact_radius


def _hardening() -> Hooks:
    # k = 1 / (2 m) in the loading term and in the exponent of unloading.
    return {
        "flow": lambda k, y, x, s: y + s.C1 * (np.maximum(x, 1e-12) ** (1.0 + k) - x),
        "recovered_fraction": lambda k, f, s: f ** (1.0 / (1.0 + k)),
    }


def _hardening_normalised() -> Hooks:
    # The strength is referred to a strain of 0.2, and the contact coefficient follows 1.43 exp(-0.97 / m).
    def flow(k: float, y: Array, x: Array, s: State) -> Array:
        return y + s.C1 * x * (np.exp(-1.94 * k * (1.0 + k)) * (np.maximum(x, 1e-12) / 0.2) ** k - 1.0)

    return {"flow": flow}


def _size_gradient() -> Hooks:
    # Strain-gradient hardening: sqrt(1 + length / size).
    return {
        "C1": lambda k, C, s: C * np.sqrt(np.maximum(1.0 + k * 200.0 / s.particle.De, 0.05) / np.maximum(1.0 + k, 0.05))
    }


def _shape_power() -> Hooks:
    # The shape factor as a power of D_e / D3 beyond its first order.
    return {"shape": lambda k, eta, s: eta + k * (s.particle.q**-1.0 - 1.0 - (1.0 - s.particle.q))}


def _pop_in(at: Array, size: Array) -> Hooks:
    def observable(k: float, g: Array, s: State) -> Array:
        passed = s.sigma_P[:, :, None] >= at[:, None, :] * s.peak[:, :, None]
        return g + k * s.particle.De * (passed * size[:, None, :]).sum(axis=2)

    return {"observable": observable}


def _pop_in_burst(at: Array, size: Array) -> Hooks:
    # The crack runs over a few per cent of the load instead of at once.
    def observable(k: float, g: Array, s: State) -> Array:
        over = (s.sigma_P / s.peak)[:, :, None] - at[:, None, :]
        return g + k * s.particle.De * (size[:, None, :] * -np.expm1(-np.maximum(over, 0.0) / 0.02)).sum(axis=2)

    return {"observable": observable}


def _draw_pop_in(rng: np.random.Generator, count: int) -> dict[str, Any]:
    events = 2
    size = rng.exponential(1.0, (count, events)) * (rng.random((count, events)) < 0.6)
    if not size.any():
        size[0, 0] = 1.0
    return {"at": rng.uniform(0.15, 0.95, (count, events)), "size": size}


def _draw_cascade(rng: np.random.Generator, count: int) -> dict[str, Any]:
    events = 7
    return {"at": rng.uniform(0.1, 0.98, (count, events)), "size": 0.35 * rng.exponential(1.0, (count, events))}


def _toe_power() -> Hooks:
    # Asperities flattened as a power of the stress.
    return {"strain": lambda k, e, s: e - k / (1.0 + s.sigma_P / 0.3) ** 1.5}


def _friction() -> Hooks:
    def flow(k: float, y: Array, x: Array, s: State) -> Array:
        eps = np.minimum(x / s.eta, 0.9)
        return y * (1.0 + 2.0 * k / 3.0 * contact_radius(eps, 1.0) / (2.0 * (1.0 - eps)))

    return {"flow": flow}


def _friction_slab() -> Hooks:
    # Slab analysis with the height measured from D3 and sticking in the middle of the contact.
    def flow(k: float, y: Array, x: Array, s: State) -> Array:
        eps = np.minimum(x / s.eta, 0.9)
        height = np.maximum(s.particle.D3 / s.particle.De - 0.6 * eps, 0.1)
        z = 2.0 * k * 1.1 * np.sqrt(eps) / height
        return y * np.where(z > 1e-6, 2.0 * (np.expm1(z) - z) / np.maximum(z, 1e-9) ** 2, 1.0 + z / 3.0)

    return {"flow": flow}


def _humid(s: State) -> Array:
    return (s.particle.columns["relative_humidity_percent"] - 40.0) / 10.0


def _humidity() -> Hooks:
    return {
        "C1": lambda k, C, s: C * np.exp(-k * _humid(s)),
        "modulus": lambda k, E, s: E * np.exp(-0.5 * k * _humid(s)),
    }


def _humidity_glass() -> Hooks:
    # Softening about 55 % as at a glass transition.
    def drop(k: float, s: State) -> Array:
        rh = s.particle.columns["relative_humidity_percent"]
        return np.exp(-4.0 * k * (1.0 / (1.0 + np.exp(-(rh - 55.0) / 8.0)) - 0.13))

    return {"C1": lambda k, C, s: C * drop(k, s), "modulus": lambda k, E, s: E * drop(0.5 * k, s)}


# fmt: off
FORMS = (
    Form(
        "finite_hardening_exponent", "exact", "C1 x^(1+k), unloading exponent 2 (1+k), k = 1/(2m)", 0.02, _hardening,
        (0.005, 0.25), largest=0.6,
    ),
    Form(
        "finite_hardening_exponent", "normalised", "C1 x c(m) (x/0.2)^k", 0.02, _hardening_normalised, (0.005, 0.25),
        largest=0.6,
    ),
    Form(
        "finite_hardening_exponent", "whole", "sigma (x/0.3)^k", 0.02,
        lambda: {"flow": lambda k, y, x, s: y * (np.maximum(x, 1e-12) / 0.3) ** k}, (0.005, 0.25), largest=0.6,
    ),
    Form(
        "size_effect", "exact", "C1 (D_e/200)^-n", 0.5,
        lambda: {"C1": lambda k, C, s: C * (s.particle.De / 200.0) ** -k}, (0.05, 0.8), largest=1.5,
    ),
    Form(
        "size_effect", "gradient", "C1 sqrt((1 + k 200/D_e)/(1 + k))", 0.5, _size_gradient, (0.1, 50.0), largest=100.0,
    ),
    Form(
        "size_effect", "linear", "C1 (1 + k (200/D_e - 1))", 0.5,
        lambda: {"C1": lambda k, C, s: C * np.maximum(1.0 + k * (200.0 / s.particle.De - 1.0), 0.05)}, (0.05, 0.8),
        largest=1.2,
    ),
    Form(
        "shape_second_order", "exact", "eta + b (1 - q)^2", 0.3,
        lambda: {"shape": lambda k, eta, s: eta + k * (1.0 - s.particle.q) ** 2}, (0.03, 1.5), (1, -1), largest=3.0,
    ),
    Form(
        "shape_second_order", "in_plane", "eta + c ln^2(D1/D2)", 0.1,
        lambda: {"shape": lambda k, eta, s: eta + k * np.log(s.particle.D1 / s.particle.D2) ** 2}, (0.02, 0.6), (1, -1),
        largest=1.5,
    ),
    Form(
        "shape_second_order", "power", "eta + b (1/q - 1 - (1 - q))", 0.3, _shape_power, (0.02, 1.0), (1, -1),
        largest=1.0,
    ),
    Form("pop_in", "exact", "sum D_j H(F - F_j)", 2e-3, _pop_in, (3e-4, 0.05), draw=_draw_pop_in),
    Form(
        "pop_in", "burst", "sum D_j (1 - exp(-(F - F_j)/(0.02 F_max)))", 2e-3, _pop_in_burst, (3e-4, 0.05),
        draw=_draw_pop_in,
    ),
    Form("pop_in", "cascade", "seven small D_j H(F - F_j)", 2e-3, _pop_in, (3e-4, 0.05), draw=_draw_cascade),
    Form(
        "toe_asperity", "exact", "-d D_e exp(-sigma_max/0.6)", 3e-3,
        lambda: {"strain": lambda k, e, s: e - k * np.exp(-s.sigma_P / 0.6)}, (3e-4, 0.05),
    ),
    Form("toe_asperity", "power", "-d D_e (1 + sigma_max/0.3)^-1.5", 3e-3, _toe_power, (3e-4, 0.05)),
    Form(
        "toe_asperity", "root", "d D_e (1 - exp(-sqrt(sigma_max/0.25)))", 3e-3,
        lambda: {"strain": lambda k, e, s: e + k * (1.0 - np.exp(-np.sqrt(s.sigma_P / 0.25)))}, (3e-4, 0.05),
    ),
    Form("platen_friction", "exact", "sigma (1 + (2 mu/3) a_c/h)", 0.05, _friction, (0.01, 0.6), largest=3.0),
    Form(
        "platen_friction", "slab", "sigma 2 (exp(z) - 1 - z)/z^2, z = 2 mu a/h", 0.05, _friction_slab, (0.01, 0.6),
        largest=2.0,
    ),
    Form(
        "humidity", "exact", "C1 exp(-k dw), E exp(-k dw/2), dw = (RH - 40)/10", 0.1, _humidity, (0.01, 0.4),
        needs=(HUMIDITY,), largest=0.6,
    ),
    Form(
        "humidity", "glass", "softening about 55 % RH", 0.1, _humidity_glass, (0.01, 0.4), needs=(HUMIDITY,),
        largest=0.6,
    ),
)
# fmt: on
