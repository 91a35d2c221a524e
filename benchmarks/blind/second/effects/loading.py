"""The loading curve: hardening, friction, rate, cracks; and what differs by a law from particle to particle."""

from __future__ import annotations

from functools import partial

import numpy as np

from ..law import CONTACT_AREA, unloading_ratio
from ..particles import MAX_BURSTS
from .effect import Array, Campaign, Formula, State

RATE_UNIT = 1e-3
"""Strain rate in 1/s at which rate formulas leave the law as it is."""

SIZE_UM, USUAL_PERCENT = 200, 40
"""Size and relative humidity at which these formulas leave the law as it is."""

_hard = partial(Formula, "finite_hardening_exponent", start=0.02, unit="1/(2m)", largest=0.25)
_friction = partial(Formula, "platen_friction", start=0.05, unit="mu")
_rate = partial(Formula, "rate_dependence", start=0.01, protocols=("P2",))
_pop = partial(Formula, "pop_in", start=0.2, unit="um at D_e=200")
_size = partial(Formula, "size_effect", wide=True)
_shape = partial(Formula, "shape_second_order", start=0.3)
_humid = partial(Formula, "humidity", start=0.05, unit="per % water", largest=0.3, humidity=True)


def power(x: Array, exponent: float) -> Array:
    """x to the exponent, safe at zero."""
    return np.maximum(x, 1e-12) ** exponent


def _first_power(th: float, terms: State, n: State) -> None:
    terms.first = terms.C1 * power(terms.x, 1 + th)


def _bent_unloading(th: float, c: Campaign, s: State, recovered: Array, n: State) -> Array:
    return unloading_ratio(power(recovered, 1 + th)) - unloading_ratio(recovered)


def _storakers(th: float, terms: State, n: State) -> None:
    y = power(terms.x, 1 + th)
    terms.first = terms.C1 * y * 3 ** (-2 * th) * np.exp(-1.94 * th * (1 + th)) * n.q**th
    terms.third = -((terms.C3 * y) ** 3)
    terms.fifth = (terms.C5 * y) ** 5


def _height(terms: State) -> Array:
    """Height of the squeezed particle, um; never less than 0.15 D3."""
    D3 = terms.D[:, 2]
    return np.maximum(D3 - terms.eps * terms.De, 0.15 * D3)


def _thin(th: float, terms: State, n: State) -> None:
    contact = terms.De * np.sqrt(CONTACT_AREA * terms.eps)
    terms.factor = terms.factor * (1 + 2 * th / 3 * contact / _height(terms))


def _disc(th: float, terms: State, n: State) -> None:
    D, height = terms.D, _height(terms)
    volume = np.pi / 6 * D[:, 0] * D[:, 1] * D[:, 2]
    radius = np.sqrt(volume / (np.pi * height)) * (-np.expm1(-6 * terms.eps))
    y = np.clip(2 * th * radius / height, 1e-4, 6)
    terms.factor = terms.factor * 2 * (np.expm1(y) - y) / y**2


def _sticking(th: float, terms: State, n: State) -> None:
    contact = terms.De * np.sqrt(CONTACT_AREA * terms.eps)
    thin = th * 2 / (3 * 3**0.5) * contact / _height(terms)
    terms.factor = terms.factor * (1 + thin * contact / (contact + terms.De / 4))


def _log_rate(terms: State) -> Array:
    """Logarithm of the strain rate on the unchanged loading curve."""
    return np.log(terms.stress_rate / terms.slope / RATE_UNIT)


def _rate_first(th: float, terms: State, n: State) -> None:
    terms.first = terms.first * np.maximum(0.1, 1 + th * _log_rate(terms))


def _rate_power(th: float, terms: State, n: State) -> None:
    terms.factor = terms.factor * np.exp(np.clip(th * _log_rate(terms), -2, 2))


def _cowper(th: float, terms: State, n: State) -> None:
    terms.factor = terms.factor * (1 + th * (terms.stress_rate / terms.slope / RATE_UNIT) ** (1 / n.p))


def _pop_one(th: float, c: Campaign, s: State, n: State) -> Array:
    p, path, owner = c.particles, c.path, c.owner
    at = (0.15 + 0.75 * p.uniform[:, 0]) * path.largest_force
    size = 0.3 + np.array([sizes[0] for _, sizes, _ in p.bursts])
    return th * size[owner] * (path.peak * p.area[owner] >= at[owner])


def _pop_several(th: float, c: Campaign, s: State, n: State) -> Array:
    out = np.zeros(len(c.path))
    for i, samples in enumerate(c.path.slices):
        number, sizes, strengths = c.particles.bursts[i]
        for k in range(min(number, MAX_BURSTS)):
            passed = c.path.peak[samples] >= n.s0 * strengths[k]
            out[samples] += th * c.particles.De[i] / 200 * sizes[k] * passed
    return out


def _pop_arrested(th: float, c: Campaign, s: State, n: State) -> Array:
    p, path, owner = c.particles, c.path, c.owner
    at = (0.3 + 0.65 * p.uniform[:, 1]) * path.largest_force
    size = (p.uniform[:, 2] < 0.6) * (0.5 + p.uniform[:, 3])
    beyond = np.maximum(path.peak * p.area[owner] - at[owner], 0) / (0.015 * path.largest_force[owner])
    return th * size[owner] * p.De[owner] / 200 * (-np.expm1(-beyond))


def _scale_curve(values: State, factor: Array) -> None:
    """The whole loading curve times a factor."""
    values.C1 = values.C1 * factor
    values.C3 = values.C3 * factor ** (1 / 3)
    values.C5 = values.C5 * factor ** (1 / 5)


def _size_first(th: float, c: Campaign, values: State, n: State) -> None:
    values.C1 = values.C1 * (c.particles.De / SIZE_UM) ** (-th)


def _size_whole(th: float, c: Campaign, values: State, n: State) -> None:
    _scale_curve(values, (c.particles.De / SIZE_UM) ** (-th))


def _nix_gao(th: float, c: Campaign, values: State, n: State) -> None:
    _scale_curve(values, np.sqrt((1 + th / c.particles.De) / (1 + th / SIZE_UM)))


def _shape_square(th: float, c: Campaign, values: State, n: State) -> None:
    values.eta = np.maximum(0.5, values.eta + n.sign * th * (1 - c.particles.q) ** 2)


def _shape_in_plane(th: float, c: Campaign, values: State, n: State) -> None:
    values.eta = values.eta + th * np.log(c.particles.D[:, 0] / c.particles.D[:, 1]) ** 2


def _shape_elongation(th: float, c: Campaign, values: State, n: State) -> None:
    D = c.particles.D
    elongation = np.maximum(D[:, 0], D[:, 1]) / np.minimum(D[:, 0], D[:, 1]) - 1
    values.eta = values.eta * (1 + th * elongation)


def moisture(percent: Array | float) -> Array | float:
    """Water in % of dry mass at a relative humidity in %: GAB isotherm of microcrystalline cellulose."""
    activity = percent / 100
    monolayer, guggenheim, k = 4.0, 9.0, 0.80
    return monolayer * guggenheim * k * activity / ((1 - k * activity) * (1 - k * activity + guggenheim * k * activity))


def _humid_linear(th: float, c: Campaign, values: State, n: State) -> None:
    factor = np.exp(-th * (c.particles.humidity - USUAL_PERCENT) / 10)
    values.C1, values.modulus = values.C1 * factor, values.modulus * factor


def _humid_isotherm(th: float, c: Campaign, values: State, n: State) -> None:
    water = moisture(c.particles.humidity) - moisture(USUAL_PERCENT)
    values.modulus = values.modulus * np.exp(-th * water)
    values.C1 = values.C1 * np.exp(-th * water / 2)


def _humid_threshold(th: float, c: Campaign, values: State, n: State) -> None:
    factor = np.exp(-th * np.maximum(moisture(c.particles.humidity) - n.w0, 0))
    _scale_curve(values, factor)
    values.modulus = values.modulus * factor


# fmt: off
FORMULAS = (
    _hard(
        "HardeningBoth", "C1 x -> C1 x^(1+th), th=1/(2m); unloading phi^2=1-((eps_P-eps)/delta)^(2(1+th))",
        {"loading": _first_power, "unloading": _bent_unloading},
    ),
    _hard(
        "HardeningLoading", "C1 x -> C1 x^(1+th) (loading branch only; flow is perfect plastic on unloading)",
        {"loading": _first_power},
    ),
    _hard(
        "HardeningStorakers",
        "C1 x -> C1*3^(-2th)*exp(-1.94 th(1+th))*(x)^(1+th)*{q}^th, x^3 and x^5 terms in x^(1+th) too "
        "(Storakers c2(m), kappa=sig_y^(1-1/m)E^(1/m))", {"loading": _storakers}, {"q": ("log", 2, 20)},
    ),
    _friction(
        "FrictionThin", "sigma_load *= 1+(2 th/3)*a_c/h, a_c=2R_e sqrt(c2 eps), h=D3-gamma", {"loading": _thin},
        start=0.02,
    ),
    _friction(
        "FrictionDisc", "sigma_load *= 2(e^y-y-1)/y^2, y=2 th a_v/h, a_v=sqrt(V/(pi h)) (1-exp(-6 eps)) "
        "(exact sliding disc, contact from volume conservation)", {"loading": _disc},
    ),
    _friction(
        "FrictionSticking",
        "sigma_load *= 1+th*(2/(3 sqrt3))*(a_c/h)*a_c/(a_c+R_e/2) (sticking friction factor, stick zone grows)",
        {"loading": _sticking}, unit="m",
    ),
    _rate(
        "RateFirstTerm", "C1 -> C1*(1+th*ln(edot/1e-3)), edot = local strain rate of first loading",
        {"loading": _rate_first},
    ),
    _rate(
        "RatePower", "sigma_load -> sigma_load*(edot/1e-3)^th (strain-rate sensitivity on the whole master law)",
        {"loading": _rate_power},
    ),
    _rate(
        "RateCowperSymonds", "sigma_load -> sigma_load*(1+th*(edot/1e-3)^(1/{p})) (Cowper-Symonds)",
        {"loading": _cowper}, {"p": ("even", 3, 5)}, start=0.02,
    ),
    _pop(
        "PopInOne",
        "gamma += th*e_i*H(max F - F_i): one burst per particle, F_i uniform in 0.15-0.9 F_max, e_i~Exp(1)+0.3",
        {"displacement": _pop_one}, unit="um",
    ),
    _pop(
        "PopInSeveral", "gamma += th*(D_e/200)*sum_j e_ij H(max sigma - s_ij): 1+Poisson(2) bursts per particle, "
        "s_ij Weibull(4)*{s0} MPa, e_ij~Exp(1)", {"displacement": _pop_several}, {"s0": ("even", 4, 7)},
    ),
    _pop(
        "PopInArrested", "60 % of the particles crack once at u_i*F_max (u_i in 0.3-0.95): "
        "gamma += th*(D_e/200)*(1-exp(-(max F-F_i)+/(0.015 F_max))) (crack arrests over a short load range)",
        {"displacement": _pop_arrested}, start=0.3,
    ),
    _size("SizeFirstTerm", "C1 -> C1*(D_e/200)^(-th)", {"coefficients": _size_first}, start=0.5, largest=1.2),
    _size(
        "SizeStrength", "sigma_load -> sigma_load*(D_e/200)^(-th) (strength of the whole master law)",
        {"coefficients": _size_whole}, start=0.3, largest=1.5,
    ),
    _size(
        "SizeNixGao", "sigma_load -> sigma_load*sqrt((1+th/D_e)/(1+th/200)) (Nix-Gao, whole master law)",
        {"coefficients": _nix_gao}, start=50.0, unit="um", largest=2000.0,
    ),
    _shape(
        "ShapeSquare", "eta_p += {sg}th*(1-q)^2, q=D3^2/(D1 D2)", {"coefficients": _shape_square}, largest=2.0,
        signed=True,
    ),
    _shape("ShapeInPlane", "eta_p += th*ln(D1/D2)^2 (in-plane aspect)", {"coefficients": _shape_in_plane}, largest=2.5),
    _shape(
        "ShapeElongation", "eta_p -> eta_p*(1+th*(max(D1,D2)/min(D1,D2)-1)) (in-plane elongation, linear)",
        {"coefficients": _shape_elongation}, start=0.1, largest=0.6,
    ),
    _humid(
        "HumidityLinear", "C1 -> C1 e^(-th dw), Ebar -> Ebar e^(-th dw), dw=(RH-40)/10 (about 1 % water per 10 % RH)",
        {"coefficients": _humid_linear}, unit="per 10 % RH",
    ),
    _humid(
        "HumidityIsotherm", "w=GAB(RH); Ebar -> Ebar e^(-th (w-w40)), C1 -> C1 e^(-th/2 (w-w40)) (GAB isotherm M0=4 %)",
        {"coefficients": _humid_isotherm},
    ),
    _humid(
        "HumidityThreshold",
        "all of C1, C3^3, C5^5 and Ebar *= exp(-th*(w-{w0})+), w=GAB(RH) (plasticised above about {w0} % water)",
        {"coefficients": _humid_threshold}, {"w0": ("even", 4.2, 5.2)},
    ),
)
# fmt: on
