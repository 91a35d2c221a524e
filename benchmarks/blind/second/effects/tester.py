"""The machine: load train, drift, tilted and yielding platens, rough contact."""

from __future__ import annotations

from functools import partial

import numpy as np

from ..particles import MPA_UM2_PER_MN
from .effect import Array, Campaign, Formula, State

_frame = partial(Formula, "frame_compliance", start=1e-3, unit="um/mN")
_drift = partial(Formula, "thermal_drift", start=1e-3, unit="um/s")
_tilt = partial(Formula, "misalignment", start=0.01, unit="rad", largest=0.08)
_sink = partial(Formula, "platen_sink_in", start=1e-4, unit="1/MPa")
_toe = partial(Formula, "toe_asperity", start=2e-3)


def _layer(th: float, c: Campaign, s: State, n: State) -> Array:
    D = c.particles.D[c.owner]
    height = np.maximum(D[:, 2] - s.gamma_P, 0.15 * D[:, 2])
    radius = np.sqrt(np.pi / 6 * np.prod(D, 1) / (np.pi * height)) * (-np.expm1(-6 * s.eps_P))
    return th * c.path.force * MPA_UM2_PER_MN / (2 * radius) * (-np.expm1(-n.H / radius))


def _settling(th: float, c: Campaign, s: State, n: State) -> Array:
    share = 0.6 + 0.4 * np.abs(c.particles.normal[c.owner, 0])
    return n.sign * th * share * n.tau * (-np.expm1(-c.path.time / n.tau))


def _uniform_pressure(th: float, c: Campaign, s: State, n: State) -> Array:
    radius = np.maximum(s.contact_P * s.phi, 0.02 * s.contact_P)
    return th * 16 * c.path.force * MPA_UM2_PER_MN / (3 * np.pi**2 * radius)


def _greenwood(th: float, c: Campaign, s: State, n: State) -> Array:
    thickness = np.exp(0.3 * c.particles.normal[c.owner, 1])
    return th * thickness * (-np.expm1(-((c.path.peak / n.st) ** n.p)))


# fmt: off
FORMULAS = (
    _frame("FrameLinear", "gamma += th*F", {"displacement": lambda th, c, s, n: th * c.path.force}),
    _frame(
        "FrameStiffening", "gamma += th*Fk*ln(1+F/Fk), Fk={Fk} mN (joints of the load train stiffen with load)",
        {"displacement": lambda th, c, s, n: th * n.Fk * np.log1p(c.path.force / n.Fk)}, {"Fk": ("log", 250, 700)},
    ),
    _frame(
        "FrameBallSeat", "gamma += th*(F/100mN)^(2/3) (Hertzian ball seat in the load train)",
        {"displacement": lambda th, c, s, n: th * (c.path.force / 100) ** (2 / 3)}, start=0.1, unit="um at 100 mN",
    ),
    _drift(
        "DriftCommon", "gamma += {sg}th*t (one rate in all tests)",
        {"displacement": lambda th, c, s, n: n.sign * th * c.path.time}, signed=True,
    ),
    _drift(
        "DriftPerTest", "gamma += th*z_i*t, z_i~N(0,1) per test",
        {"displacement": lambda th, c, s, n: th * c.particles.normal[c.owner, 0] * c.path.time},
    ),
    _drift(
        "DriftSettling", "gamma += {sg}th*(0.6+0.4|z_i|)*tau*(1-exp(-t/tau)), tau={tau} s (chamber settles)",
        {"displacement": _settling}, {"tau": ("log", 90, 250)}, signed=True,
    ),
    _tilt(
        "TiltContact", "gamma += th*a_c(gamma), a_c=2R_e sqrt(c2 eps)",
        {"displacement": lambda th, c, s, n: th * s.contact},
    ),
    _tilt(
        "TiltPerTest", "gamma += th*|z_i|*a_c(gamma_max): tilt differs from test to test, wedge gap closes for good",
        {"displacement": lambda th, c, s, n: th * np.abs(c.particles.normal[c.owner, 2]) * s.contact_P},
    ),
    _tilt(
        "TiltCap",
        "gamma += th*R_e*sqrt(1-(1-min(gamma_max/D3,1))^2) (spherical-cap contact radius, tilted flat punch)",
        {"displacement": lambda th, c, s, n: th * s.Re * np.sqrt(1 - (1 - np.minimum(s.gamma_P / s.D3, 1)) ** 2)},
    ),
    _sink(
        "SinkInPunch", "gamma += th*F/(2 a_c), th=1/E*_p, a_c=2R_e sqrt(c2 eps)",
        {"displacement": lambda th, c, s, n: th * c.path.force * MPA_UM2_PER_MN / (2 * s.contact)},
    ),
    _sink(
        "SinkInUniform", "gamma += th*16 F/(3 pi^2 a), a=a_P*phi (uniform pressure; contact shrinks on unloading)",
        {"displacement": _uniform_pressure},
    ),
    _sink(
        "SinkInLayer", "gamma += th*(F/(2 a_v))*(1-exp(-{H}/a_v)), a_v=sqrt(V/(pi(D3-gamma)))*(1-exp(-6 eps_P)) "
        "(finite compliant layer under the particle)", {"displacement": _layer}, {"H": ("log", 80, 300)},
    ),
    _toe(
        "ToeExponential", "gamma -= th*D_e*exp(-sigma_max/{st})",
        {"displacement": lambda th, c, s, n: -th * s.De * np.exp(-c.path.peak / n.st)}, {"st": ("log", 0.4, 1.2)},
    ),
    _toe(
        "ToeLayer", "gamma += th*h_i*(1-exp(-(sigma_max/{st})^{p})), h_i = exp(0.3 z_i) um per particle "
        "(Greenwood-Williamson layer crushed flat, measured from first contact)", {"displacement": _greenwood},
        {"st": ("log", 0.4, 1.0), "p": ("even", 0.6, 0.9)}, start=0.5, unit="um",
    ),
    _toe(
        "ToeBandis",
        "gamma += th*D_e*(sigma_max/{st})/(1+sigma_max/{st}) (hyperbolic closure of the rough layer, Bandis)",
        {"displacement": lambda th, c, s, n: th * s.De * (c.path.peak / n.st) / (1 + c.path.peak / n.st)},
        {"st": ("log", 0.3, 0.8)},
    ),
)
# fmt: on
