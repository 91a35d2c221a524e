"""Effects on no list."""

from __future__ import annotations

import numpy as np

from .form import Array, Form, Hooks, State
from .state import below


def _bump() -> Hooks:
    # A shell that buckles: stiffer in one window of strain, on loading only.
    return {"flow": lambda k, y, x, s: y * (1.0 + k * np.exp(-(((x / s.eta - 0.15) / 0.035) ** 2)))}


def _ripple() -> Hooks:
    # Layers that collapse one after the other.
    return {"strain": lambda k, e, s: e + k * np.sin(2.0 * np.pi * s.eps_P / 0.06)}


def _kink() -> Hooks:
    # A second spring comes off at 0.6 of the peak load.
    return {"strain": lambda k, e, s: e - k * np.maximum(0.6 - s.u, 0.0)}


def _locking() -> Hooks:
    # Pores of one size lock at a master strain.
    return {"flow": lambda k, y, x, s: y * (1.0 + k / (1.0 + np.exp(-(x - 0.33) / 0.012)))}


def _room() -> Hooks:
    # The room's air conditioning.
    return {"observable": lambda k, g, s: g + k * np.sin(2.0 * np.pi * s.t / 47.0)}


def _encoder() -> Hooks:
    # Interpolation error of the displacement gauge.
    return {"observable": lambda k, g, s: g + k * np.sin(2.0 * np.pi * g / 10.0)}


def _backlash() -> Hooks:
    # Dead band of the drive at every reversal into unloading.
    return {"observable": lambda k, g, s: g + k * (1.0 - np.exp(-(1.0 - s.u) / 0.02)) * s.path.unloading}


def _seating() -> Hooks:
    # Every particle settles on its base at the same stress.
    return {"strain": lambda k, e, s: e + k / (1.0 + np.exp(-(s.sigma_P - 3.0) / 0.25))}


def _wobble() -> Hooks:
    # The controller rings after each reversal.
    return {
        "observable": lambda k, g, s: (
            g + k * np.exp(-s.path.since_turn / 6.0) * np.cos(2.0 * np.pi * s.path.since_turn / 9.0)
        )
    }


def _mid_bump() -> Hooks:
    # Interlocked fibres let go in the middle of unloading.
    return {"strain": lambda k, e, s: e - k * np.exp(-(((s.u - 0.5) / 0.1) ** 2)) * below(s)}


def _shape_strain() -> Hooks:
    # The shape factor fades as the particle is squeezed flat, with a knee.
    return {"flow": lambda k, y, x, s: y * (1.0 - k * (s.eta - 1.0) * np.maximum(x / s.eta - 0.2, 0.0))}


def _second_contact() -> Hooks:
    # A shoulder of the particle touches at a given displacement and carries load like a spring.
    def flow(k: float, y: Array, x: Array, s: State) -> Array:
        gap = 0.12 * (1.0 + 0.3 * (s.particle.q - 0.6))
        return y + k * np.maximum(x / s.eta - gap, 0.0) * np.exp(-np.maximum(x / s.eta - gap, 0.0) / 0.05)

    return {"flow": flow}


# fmt: off
FORMS = (
    Form("unlisted", "stiffness_bump", "sigma (1 + k exp(-((eps-0.15)/0.035)^2))", 0.03, _bump, largest=0.5),
    Form("unlisted", "strain_ripple", "k sin(2 pi eps_P / 0.06)", 1e-3, _ripple),
    Form("unlisted", "unloading_kink", "-k (0.6 - u)_+", 2e-3, _kink),
    Form(
        "unlisted", "pore_locking", "sigma (1 + k logistic((x-0.33)/0.012))", 0.03, _locking, (0.0, np.inf), (1,),
        largest=1.0,
    ),
    Form("unlisted", "room_temperature", "k sin(2 pi t / 47 s)", 0.05, _room),
    Form("unlisted", "gauge_interpolation", "k sin(2 pi gamma / 10 um)", 0.05, _encoder),
    Form("unlisted", "drive_backlash", "k (1 - exp(-(1-u)/0.02)) on unloading", 0.2, _backlash),
    Form("unlisted", "common_seating", "k logistic((sigma_P - 3)/0.25)", 2e-3, _seating),
    Form("unlisted", "controller_ringing", "k exp(-t/6 s) cos(2 pi t/9 s) after reversals", 0.1, _wobble),
    Form("unlisted", "mid_unloading_bump", "-k exp(-((u-0.5)/0.1)^2) on unloading", 1e-3, _mid_bump),
    Form("unlisted", "fading_shape", "sigma (1 - k (eta-1)(eps-0.2)_+)", 0.5, _shape_strain, largest=6.0),
    Form("unlisted", "second_contact", "+ k (eps-gap)_+ exp(-(eps-gap)/0.05)", 1.0, _second_contact, largest=40.0),
)
# fmt: on
