"""The machine: load train, tilted and yielding platens."""

from __future__ import annotations

import numpy as np

from ..particles import MPA_UM2_PER_MN
from .effect import Array, Campaign, Effect, State, log_uniform


class _Frame(Effect):
    mechanism = "frame_compliance"
    start, unit = 1e-3, "um/mN"


class FrameLinear(_Frame):
    text = "gamma += th*F"

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return theta * c.path.force


class FrameStiffening(_Frame):
    text = "gamma += th*Fk*ln(1+F/Fk), Fk={Fk} mN (joints of the load train stiffen with load)"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"Fk": log_uniform(rng, 250, 700)}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return theta * self.drawn.Fk * np.log1p(c.path.force / self.drawn.Fk)


class FrameBallSeat(_Frame):
    text = "gamma += th*(F/100mN)^(2/3) (Hertzian ball seat in the load train)"
    start, unit = 0.1, "um at 100 mN"

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return theta * (c.path.force / 100) ** (2 / 3)


class _Tilt(Effect):
    mechanism = "misalignment"
    start, unit, largest = 0.01, "rad", 0.08


class TiltContact(_Tilt):
    text = "gamma += th*a_c(gamma), a_c=2R_e sqrt(c2 eps)"

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return theta * s.contact


class TiltPerTest(_Tilt):
    text = "gamma += th*|z_i|*a_c(gamma_max): tilt differs from test to test, wedge gap closes for good"

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return theta * np.abs(c.particles.normal[c.owner, 2]) * s.contact_P


class TiltCap(_Tilt):
    text = "gamma += th*R_e*sqrt(1-(1-min(gamma_max/D3,1))^2) (spherical-cap contact radius, tilted flat punch)"

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        depth = np.minimum(s.gamma_P / s.D3, 1)
        return theta * s.Re * np.sqrt(1 - (1 - depth) ** 2)


class _SinkIn(Effect):
    mechanism = "platen_sink_in"
    start, unit = 1e-4, "1/MPa"


class SinkInPunch(_SinkIn):
    text = "gamma += th*F/(2 a_c), th=1/E*_p, a_c=2R_e sqrt(c2 eps)"

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return theta * c.path.force * MPA_UM2_PER_MN / (2 * s.contact)


class SinkInUniform(_SinkIn):
    text = "gamma += th*16 F/(3 pi^2 a), a=a_P*phi (uniform pressure; contact shrinks on unloading)"

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        radius = np.maximum(s.contact_P * s.phi, 0.02 * s.contact_P)
        return theta * 16 * c.path.force * MPA_UM2_PER_MN / (3 * np.pi**2 * radius)


class SinkInLayer(_SinkIn):
    text = (
        "gamma += th*(F/(2 a_v))*(1-exp(-{H}/a_v)), a_v=sqrt(V/(pi(D3-gamma)))*(1-exp(-6 eps_P)) "
        "(finite compliant layer under the particle)"
    )

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"H": log_uniform(rng, 80, 300)}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        D = c.particles.D[c.owner]
        volume = np.pi / 6 * np.prod(D, 1)
        height = np.maximum(D[:, 2] - s.gamma_P, 0.15 * D[:, 2])
        radius = np.sqrt(volume / (np.pi * height)) * (-np.expm1(-6 * s.eps_P))
        return theta * c.path.force * MPA_UM2_PER_MN / (2 * radius) * (-np.expm1(-self.drawn.H / radius))


FORMULAS = (
    *(FrameLinear, FrameStiffening, FrameBallSeat),
    *(TiltContact, TiltPerTest, TiltCap),
    *(SinkInPunch, SinkInUniform, SinkInLayer),
)
