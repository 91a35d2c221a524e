"""What happens once and stays: cracks that run, a rough surface that is crushed flat."""

from __future__ import annotations

import numpy as np

from ..particles import MAX_BURSTS
from .effect import Array, Campaign, Effect, State, log_uniform


class _PopIn(Effect):
    mechanism = "pop_in"
    start, unit = 0.2, "um at D_e=200"


class PopInOne(_PopIn):
    text = "gamma += th*e_i*H(max F - F_i): one burst per particle, F_i uniform in 0.15-0.9 F_max, e_i~Exp(1)+0.3"
    unit = "um"

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        p, path, owner = c.particles, c.path, c.owner
        at = (0.15 + 0.75 * p.uniform[:, 0]) * path.largest_force
        size = 0.3 + np.array([sizes[0] for _, sizes, _ in p.bursts])
        return theta * size[owner] * (path.peak * p.area[owner] >= at[owner])


class PopInSeveral(_PopIn):
    text = (
        "gamma += th*(D_e/200)*sum_j e_ij H(max sigma - s_ij): 1+Poisson(2) bursts per particle, "
        "s_ij Weibull(4)*{s0} MPa, e_ij~Exp(1)"
    )

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"s0": float(rng.uniform(4, 7))}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        out = np.zeros(len(c.path))
        for i, samples in enumerate(c.path.slices):
            number, sizes, strengths = c.particles.bursts[i]
            for k in range(min(number, MAX_BURSTS)):
                passed = c.path.peak[samples] >= self.drawn.s0 * strengths[k]
                out[samples] += theta * c.particles.De[i] / 200 * sizes[k] * passed
        return out


class PopInArrested(_PopIn):
    text = (
        "60 % of the particles crack once at u_i*F_max (u_i in 0.3-0.95): "
        "gamma += th*(D_e/200)*(1-exp(-(max F-F_i)+/(0.015 F_max))) (crack arrests over a short load range)"
    )
    start = 0.3

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        p, path, owner = c.particles, c.path, c.owner
        at = (0.3 + 0.65 * p.uniform[:, 1]) * path.largest_force
        size = (p.uniform[:, 2] < 0.6) * (0.5 + p.uniform[:, 3])
        beyond = np.maximum(path.peak * p.area[owner] - at[owner], 0) / (0.015 * path.largest_force[owner])
        return theta * size[owner] * p.De[owner] / 200 * (-np.expm1(-beyond))


class _Toe(Effect):
    mechanism = "toe_asperity"
    start, unit = 2e-3, "-"


class ToeExponential(_Toe):
    text = "gamma -= th*D_e*exp(-sigma_max/{st})"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"st": log_uniform(rng, 0.4, 1.2)}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return -theta * s.De * np.exp(-c.path.peak / self.drawn.st)


class ToeLayer(_Toe):
    text = (
        "gamma += th*h_i*(1-exp(-(sigma_max/{st})^{p})), h_i = exp(0.3 z_i) um per particle "
        "(Greenwood-Williamson layer crushed flat, measured from first contact)"
    )
    start, unit = 0.5, "um"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"st": log_uniform(rng, 0.4, 1.0), "p": float(rng.uniform(0.6, 0.9))}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        thickness = np.exp(0.3 * c.particles.normal[c.owner, 1])
        return theta * thickness * (-np.expm1(-((c.path.peak / self.drawn.st) ** self.drawn.p)))


class ToeBandis(_Toe):
    text = "gamma += th*D_e*(sigma_max/{st})/(1+sigma_max/{st}) (hyperbolic closure of the rough layer, Bandis)"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"st": log_uniform(rng, 0.3, 0.8)}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        x = c.path.peak / self.drawn.st
        return theta * s.De * x / (1 + x)


FORMULAS = (PopInOne, PopInSeveral, PopInArrested, ToeExponential, ToeLayer, ToeBandis)
