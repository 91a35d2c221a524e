"""The machine: frame, drift, platens."""

from __future__ import annotations

import numpy as np

from ..law import MN_PER_MPA_UM2
from .form import Array, Form, Hooks, State
from .state import contact_radius


def _sink_in() -> Hooks:
    # gamma += F / (2 a_c E*), amplitude 1 / E* in 1/MPa.
    def observable(k: float, g: Array, s: State) -> Array:
        radius = contact_radius(np.maximum(s.eps_P, 1e-4), s.particle.Re)
        return g + k * s.F / MN_PER_MPA_UM2 / (2.0 * radius)

    return {"observable": observable}


def _sink_in_hertz() -> Hooks:
    # Dent of a smooth cap instead of a flat punch: the contact grows with the load itself.
    def observable(k: float, g: Array, s: State) -> Array:
        pressure = 3.0 * s.C1 / 7.0
        radius = np.sqrt(np.maximum(s.F, 0.0) / MN_PER_MPA_UM2 / (np.pi * pressure)) + 0.1 * s.particle.Re
        return g + k * s.F / MN_PER_MPA_UM2 / (2.0 * radius)

    return {"observable": observable}


def _tilt_wedge() -> Hooks:
    # The high edge touches first: the gap under it closes over a tenth of strain.
    return {
        "observable": lambda k, g, s: g + k * s.particle.De * np.sqrt(1.0 - np.exp(-np.maximum(s.eps_P, 0.0) / 0.12))
    }


# fmt: off
FORMS = (
    Form(
        "frame_compliance", "exact", "C F", 1e-3, lambda: {"observable": lambda k, g, s: g + k * s.F}, (5e-5, 5e-3),
        parameter="compliance_um_per_mN",
    ),
    Form(
        "frame_compliance", "stiffening", "C F0 (F/F0)^0.8", 1e-3,
        lambda: {"observable": lambda k, g, s: g + k * 300.0 * (s.F / 300.0) ** 0.8}, (5e-5, 5e-3),
    ),
    Form(
        "frame_compliance", "seated", "C F0 ln(1 + F/F0)", 1e-3,
        lambda: {"observable": lambda k, g, s: g + k * 350.0 * np.log1p(s.F / 350.0)}, (5e-5, 5e-3),
    ),
    Form(
        "thermal_drift", "exact", "v t", 1e-3, lambda: {"observable": lambda k, g, s: g + k * s.t}, (1e-5, 1e-2),
        (1, -1), parameter="rate_um_per_s",
    ),
    Form(
        "thermal_drift", "decaying", "v tau (1 - exp(-t/tau))", 1e-3,
        lambda tau: {"observable": lambda k, g, s: g + k * tau * (1.0 - np.exp(-s.t / tau))}, (1e-5, 2e-2), (1, -1),
        draw=lambda rng, count: {"tau": float(rng.uniform(60.0, 200.0))},
    ),
    Form(
        "thermal_drift", "per_test", "v_i t, v_i of one sign and a spread of 50 %", 1e-3,
        lambda share: {"observable": lambda k, g, s: g + k * share[:, None] * s.t}, (1e-5, 1e-2), (1, -1),
        draw=lambda rng, count: {"share": 1.0 + 0.5 * rng.standard_normal(count)},
    ),
    Form(
        "misalignment", "exact", "alpha a_c", 0.01,
        lambda: {"observable": lambda k, g, s: g + k * contact_radius(s.eps, s.particle.Re)}, (1e-3, 0.08),
    ),
    Form("misalignment", "wedge", "alpha D_e sqrt(1 - exp(-eps/0.12))", 0.01, _tilt_wedge, (1e-3, 0.08)),
    Form("platen_sink_in", "exact", "F/(2 a_c E*)", 1e-4, _sink_in, (5e-6, 1e-3)),
    Form("platen_sink_in", "growing", "F/(2 a(F) E*)", 1e-4, _sink_in_hertz, (5e-6, 1e-3)),
)
# fmt: on
