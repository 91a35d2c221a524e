"""The loading curve: hardening of the solid, friction on the platens."""

from __future__ import annotations

import numpy as np

from ..law import CONTACT_AREA, unloading_ratio
from .effect import Array, Campaign, Effect, State, log_uniform, power


class _Hardening(Effect):
    mechanism = "finite_hardening_exponent"
    start, unit, largest = 0.02, "1/(2m)", 0.25


class HardeningBoth(_Hardening):
    text = "C1 x -> C1 x^(1+th), th=1/(2m); unloading phi^2=1-((eps_P-eps)/delta)^(2(1+th))"

    def loading(self, theta: float, terms: State) -> None:
        terms.first = terms.C1 * power(terms.x, 1 + theta)

    def unloading(self, theta: float, c: Campaign, s: State, recovered: Array, ratio: Array) -> Array:
        return ratio + unloading_ratio(power(recovered, 1 + theta)) - unloading_ratio(recovered)


class HardeningLoading(_Hardening):
    text = "C1 x -> C1 x^(1+th) (loading branch only; flow is perfect plastic on unloading)"

    def loading(self, theta: float, terms: State) -> None:
        terms.first = terms.C1 * power(terms.x, 1 + theta)


class HardeningStorakers(_Hardening):
    text = (
        "C1 x -> C1*3^(-2th)*exp(-1.94 th(1+th))*(x)^(1+th)*{q}^th, x^3 and x^5 terms in x^(1+th) too "
        "(Storakers c2(m), kappa=sig_y^(1-1/m)E^(1/m))"
    )

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"q": log_uniform(rng, 2, 20)}

    def loading(self, theta: float, terms: State) -> None:
        y = power(terms.x, 1 + theta)
        terms.first = terms.C1 * y * 3 ** (-2 * theta) * np.exp(-1.94 * theta * (1 + theta)) * self.drawn.q**theta
        terms.third = -((terms.C3 * y) ** 3)
        terms.fifth = (terms.C5 * y) ** 5


class _Friction(Effect):
    mechanism = "platen_friction"
    start = 0.05


def _height(terms: State) -> Array:
    """Height of the squeezed particle, um; never less than 0.15 D3."""
    D3 = terms.D[:, 2]
    return np.maximum(D3 - terms.eps * terms.De, 0.15 * D3)


class FrictionThin(_Friction):
    text = "sigma_load *= 1+(2 th/3)*a_c/h, a_c=2R_e sqrt(c2 eps), h=D3-gamma"
    start, unit = 0.02, "mu"

    def loading(self, theta: float, terms: State) -> None:
        contact = terms.De * np.sqrt(CONTACT_AREA * terms.eps)
        terms.factor = terms.factor * (1 + 2 * theta / 3 * contact / _height(terms))


class FrictionDisc(_Friction):
    text = (
        "sigma_load *= 2(e^y-y-1)/y^2, y=2 th a_v/h, a_v=sqrt(V/(pi h)) (1-exp(-6 eps)) "
        "(exact sliding disc, contact from volume conservation)"
    )
    unit = "mu"

    def loading(self, theta: float, terms: State) -> None:
        D, height = terms.D, _height(terms)
        volume = np.pi / 6 * D[:, 0] * D[:, 1] * D[:, 2]
        radius = np.sqrt(volume / (np.pi * height)) * (-np.expm1(-6 * terms.eps))
        y = np.clip(2 * theta * radius / height, 1e-4, 6)
        terms.factor = terms.factor * 2 * (np.expm1(y) - y) / y**2


class FrictionSticking(_Friction):
    text = "sigma_load *= 1+th*(2/(3 sqrt3))*(a_c/h)*a_c/(a_c+R_e/2) (sticking friction factor, stick zone grows)"
    unit = "m"

    def loading(self, theta: float, terms: State) -> None:
        contact = terms.De * np.sqrt(CONTACT_AREA * terms.eps)
        thin = theta * 2 / (3 * 3**0.5) * contact / _height(terms)
        terms.factor = terms.factor * (1 + thin * contact / (contact + terms.De / 4))


FORMULAS = (
    *(HardeningBoth, HardeningLoading, HardeningStorakers),
    *(FrictionThin, FrictionDisc, FrictionSticking),
)
