"""Effects on no list."""

from __future__ import annotations

import numpy as np

from ..path import UNLOAD
from .effect import Array, Campaign, Effect, State


class _Unlisted(Effect):
    mechanism = "unlisted"


class EncoderError(_Unlisted):
    text = "gamma += th*sin(2 pi gamma/{P} um) (periodic interpolation error of the displacement encoder)"
    start, unit, protocols = 0.05, "um", ("P0",)

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"P": float(rng.uniform(9, 16))}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return theta * np.sin(2 * np.pi * s.gamma / self.drawn.P)


class Ringing(_Unlisted):
    text = (
        "gamma += th*exp(-t_r/{tau}s)*sin(2 pi t_r/{P}s) after every reversal of the drive, t_r=time since reversal "
        "(ringing of the control loop)"
    )
    start, unit, protocols = 0.1, "um", ("P1",)

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"tau": float(rng.uniform(25, 45)), "P": float(rng.uniform(18, 30))}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        since = c.path.since_turn
        swing = theta * np.exp(-since / self.drawn.tau) * np.sin(2 * np.pi * since / self.drawn.P)
        return np.where(c.path.turns > 0, swing, 0)


class LockUp(_Unlisted):
    text = "sigma_load += th*(eta_p eps)^9 * 1000 MPa (a ninth-power lock-up term in the master law)"
    start, unit, protocols = 0.02, "-", ("P0",)

    def loading(self, theta: float, terms: State) -> None:
        terms.extra = terms.extra + theta * 1000 * terms.x**9


class LayerYields(_Unlisted):
    text = (
        "gamma += th*D_e*exp(-((sigma_max-{s0})/{w})^2) on the way in and kept from sigma_P on unloading "
        "(temporary yielding of a layer around one stress)"
    )
    start, unit = 1e-3, "-"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"s0": float(rng.uniform(3.5, 5)), "w": float(rng.uniform(0.7, 1.1))}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return theta * s.De * np.exp(-(((c.path.peak - self.drawn.s0) / self.drawn.w) ** 2))


class Elbow(_Unlisted):
    text = (
        "unloading and reloading: gamma -= th*delta*D_e/(1+exp((u-{uc})/0.035)) "
        "(elbow: reversible transformation at a fixed load fraction)"
    )
    start, unit = 0.05, "-"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"uc": float(rng.uniform(0.5, 0.65))}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        def transformed(u: Array | float) -> Array | float:
            return 1 / (1 + np.exp((u - self.drawn.uc) / 0.035))

        return -theta * s.delta * s.De * (transformed(s.u) - transformed(1.0))


class SerratedFlow(_Unlisted):
    text = "sigma_load *= 1+th*sin(2 pi eps/{P}) (serrated flow: fibril layers buckle periodically in strain)"
    start, unit = 0.01, "-"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"P": float(rng.uniform(0.05, 0.075))}

    def loading(self, theta: float, terms: State) -> None:
        terms.factor = terms.factor * (1 + theta * np.sin(2 * np.pi * terms.eps / self.drawn.P))


class Backlash(_Unlisted):
    text = (
        "gamma -= th*(1-exp(-t_r/3s)) while the force falls, 0 otherwise, t_r=time since reversal "
        "(backlash of the lead screw: a fixed lost motion at each reversal)"
    )
    start, unit, protocols, reloads = 0.1, "um", ("P1",), 1

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return -theta * (c.path.branch == UNLOAD) * (-np.expm1(-c.path.since_turn / 3.0))


class LoadCellError(_Unlisted):
    text = "true force = F*(1+th*sin(2 pi F/{P} mN)) (load-cell linearity error with a common period)"
    start, unit = 0.005, "-"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"P": float(rng.uniform(90, 160))}

    def stress(self, theta: float, c: Campaign, peak: Array, stress: Array) -> tuple[Array, Array]:
        force = c.path.force
        felt = force * (1 + theta * np.sin(2 * np.pi * force / self.drawn.P)) / c.particles.area[c.owner]
        highest = np.empty_like(felt)
        for samples in c.path.slices:
            highest[samples] = np.maximum.accumulate(felt[samples])
        return highest, felt


FORMULAS = (EncoderError, Ringing, LockUp, LayerYields, Elbow, SerratedFlow, Backlash, LoadCellError)
