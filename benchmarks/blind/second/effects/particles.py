"""What differs from particle to particle by a law: size, shape, humidity."""

from __future__ import annotations

import numpy as np

from .effect import Array, Campaign, Effect, State

SIZE_UM = 200
USUAL_PERCENT = 40
"""Size and relative humidity at which these formulas leave the law as it is."""


def _scale_curve(values: State, factor: Array) -> None:
    """The whole loading curve times a factor."""
    values.C1 = values.C1 * factor
    values.C3 = values.C3 * factor ** (1 / 3)
    values.C5 = values.C5 * factor ** (1 / 5)


class _Size(Effect):
    mechanism = "size_effect"
    wide = True


class SizeFirstTerm(_Size):
    text = "C1 -> C1*(D_e/200)^(-th)"
    start, unit, largest = 0.5, "-", 1.2

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        values.C1 = values.C1 * (c.particles.De / SIZE_UM) ** (-theta)


class SizeStrength(_Size):
    text = "sigma_load -> sigma_load*(D_e/200)^(-th) (strength of the whole master law)"
    start, unit, largest = 0.3, "-", 1.5

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        _scale_curve(values, (c.particles.De / SIZE_UM) ** (-theta))


class SizeNixGao(_Size):
    text = "sigma_load -> sigma_load*sqrt((1+th/D_e)/(1+th/200)) (Nix-Gao, whole master law)"
    start, unit, largest = 50.0, "um", 2000.0

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        _scale_curve(values, np.sqrt((1 + theta / c.particles.De) / (1 + theta / SIZE_UM)))


class _Shape(Effect):
    mechanism = "shape_second_order"
    start, unit = 0.3, "-"


class ShapeSquare(_Shape):
    text = "eta_p += {sg}th*(1-q)^2, q=D3^2/(D1 D2)"
    largest = 2.0
    signed = True

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        values.eta = np.maximum(0.5, values.eta + self.sign * theta * (1 - c.particles.q) ** 2)


class ShapeInPlane(_Shape):
    text = "eta_p += th*ln(D1/D2)^2 (in-plane aspect)"
    largest = 2.5

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        D = c.particles.D
        values.eta = values.eta + theta * np.log(D[:, 0] / D[:, 1]) ** 2


class ShapeElongation(_Shape):
    text = "eta_p -> eta_p*(1+th*(max(D1,D2)/min(D1,D2)-1)) (in-plane elongation, linear)"
    start, largest = 0.1, 0.6

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        D = c.particles.D
        elongation = np.maximum(D[:, 0], D[:, 1]) / np.minimum(D[:, 0], D[:, 1]) - 1
        values.eta = values.eta * (1 + theta * elongation)


def moisture(percent: Array | float) -> Array | float:
    """Water in % of dry mass at a relative humidity in %: GAB isotherm of microcrystalline cellulose."""
    activity = percent / 100
    monolayer, guggenheim, k = 4.0, 9.0, 0.80
    return monolayer * guggenheim * k * activity / ((1 - k * activity) * (1 - k * activity + guggenheim * k * activity))


class _Humidity(Effect):
    mechanism = "humidity"
    start, unit, largest = 0.05, "per % water", 0.3
    humidity = True


class HumidityLinear(_Humidity):
    text = "C1 -> C1 e^(-th dw), Ebar -> Ebar e^(-th dw), dw=(RH-40)/10 (about 1 % water per 10 % RH)"
    unit = "per 10 % RH"

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        factor = np.exp(-theta * (c.particles.humidity - USUAL_PERCENT) / 10)
        values.C1 = values.C1 * factor
        values.modulus = values.modulus * factor


class HumidityIsotherm(_Humidity):
    text = "w=GAB(RH); Ebar -> Ebar e^(-th (w-w40)), C1 -> C1 e^(-th/2 (w-w40)) (GAB isotherm M0=4 %)"

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        water = moisture(c.particles.humidity) - moisture(USUAL_PERCENT)
        values.modulus = values.modulus * np.exp(-theta * water)
        values.C1 = values.C1 * np.exp(-theta * water / 2)


class HumidityThreshold(_Humidity):
    text = "all of C1, C3^3, C5^5 and Ebar *= exp(-th*(w-{w0})+), w=GAB(RH) (plasticised above about {w0} % water)"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"w0": float(rng.uniform(4.2, 5.2))}

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        factor = np.exp(-theta * np.maximum(moisture(c.particles.humidity) - self.drawn.w0, 0))
        _scale_curve(values, factor)
        values.modulus = values.modulus * factor


FORMULAS = (
    *(SizeFirstTerm, SizeStrength, SizeNixGao),
    *(ShapeSquare, ShapeInPlane, ShapeElongation),
    *(HumidityLinear, HumidityIsotherm, HumidityThreshold),
)
