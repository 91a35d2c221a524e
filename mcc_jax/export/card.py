"""The parameter card: everything that a person needs to code the law again, as JSON."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
from typing import Any

import equinox as eqx

from .._extras import own_version
from ..effects import LIBRARY
from ..geometry import Particle
from ..law import TESTED_STRAIN, MccLaw
from .origin import Origin, checked, numbers

UNITS = {"C1": "1", "C3": "1", "C5": "1", "a": "1", "effective_modulus_MPa": "MPa"}
FORMULAE = {
    "effective_diameter": "D_e = D1 D2 / D3, D3 along the compression",
    "strain": "eps = displacement / D_e",
    "stress": "sigma = force / (pi D_e^2 / 4); 1 MPa um^2 = 1e-3 mN",
    "shape_factor": "eta_p = 1 + a (1 - D3^2 / (D1 D2))",
    "loading": "sigma / MPa = C1 x - (C3 x)^3 + (C5 x)^5 with x = eta_p eps, for eps >= eps_P",
    "history": "eps_P is the largest strain so far, sigma_P the loading stress there",
    "recovered_strain": "delta^2 = (sigma_P / E)^n / (k eta_p^p eps_P), but delta no larger than recovery_limit",
    "recovery_limit": "the smaller of eps_P and (3 pi/8) sigma_P / (d sigma/d eps at eps_P on loading): no cycle gains "
    "energy; it holds where the formula would create some (printed form: peak strains below about 0.01), elsewhere the "
    "formula is untouched",
    "unloading": "sigma = sigma_P g(s), g(s) = (2/pi) (acos s - s sqrt(1 - s^2)), s = (eps_P - eps) / delta, "
    "for eps < eps_P; 0 for s >= 1; reloading retraces it",
    "unloading_slope": "dg/ds = -(4/pi) sqrt(1 - s^2)",
    "monotone": "stress never falls on loading if 9 C3^6 <= 20 C1 C5^5",
    "pair_of_particles": "each of two half contacts takes a share d_i of the overlap, F_i = force of a platen test at "
    "displacement 2 d_i; F_1 = F_2 on loading; F = F_P g(q), q = (overlap_P - overlap) / (recovered_1 + recovered_2) "
    "on unloading, recovered_i half that of the platen test, each with its own limit",
}


def card(law: MccLaw, particle: Particle | None = None, *, origin: Origin | None = None) -> dict[str, Any]:
    """The parameter card of a law, ready for `json.dump`.

    It has parameters with unit and uncertainty, form of the law, its effects with equation and numbers, validity,
    formulae in words, provenance, warnings and a checksum (SHA-256) over the law and its numbers; of a particle its
    size and shape factor. Uncertainty and provenance are those of `origin`; nothing is claimed without.

    References:
        Bommireddy et al. (2018), eqs. 13, 16, 23, 24.
    """
    origin = checked(law, particle, origin, needed=False)
    values = numbers(law)
    form = {
        "unloading": law.unloading.value,
        "strain_scaling": law.strain_scaling.value,
        "k": law.unloading.constant,
        "n": law.unloading.stress_power,
        "p": law.strain_scaling.power,
    }
    unknown = {"sd": None, "interval_95": None}
    parameters = {
        name: {**unknown, **origin.estimates.get(name, {}), "value": value, "unit": UNITS[name]}
        for name, value in values.items()
    }
    K1, K3, K5 = (float(K) for K in law.plastic.polynomial)
    effects = {"effects": described(law)} if law.effects else {}
    return {
        "schema": 1,
        "what": "loading-unloading contact law of micro-crystalline cellulose particles",
        "coefficients_of": "the population: exp(mean of log C)" if origin.particle is None else origin.particle,
        "law": form,
        "parameters": parameters,
        **effects,
        "uncertainty": "sd and interval_95 are those of the estimate; scatter between particles is in population.sd",
        "polynomial_MPa": {"K1": K1, "K3": K3, "K5": K5, "formula": "sigma = K1 x - K3 x^3 + K5 x^5"},
        "population": None if origin.population is None else dict(origin.population),
        "is_monotone": bool(law.is_monotone),
        "particle": None if particle is None else _geometry(law, particle, origin),
        "validity": {
            "scaled_strain_max": TESTED_STRAIN,
            "stress_there_MPa": TESTED_STRAIN * (K1 - TESTED_STRAIN**2 * (K3 - TESTED_STRAIN**2 * K5)),
            "words": f"single particles between platens, along D3, eta_p eps up to {TESTED_STRAIN}; rate independent, "
            "no adhesion, no friction; contacts of one particle do not know of each other"
            + ("; all but what the effects say, which act on the numbers given here" if law.effects else ""),
        },
        "formulae": FORMULAE,
        "units": {"stress": "MPa", "length": "um", "force": "mN"},
        "provenance": {
            "software": "mcc_jax",
            "version": own_version(),
            "calibration": None if origin.calibration is None else dict(origin.calibration),
            "reference": "Bommireddy, Agarwal, Yettella, Tomar, Gonzalez (2018), arXiv:1812.06173",
        },
        "warnings": list(origin.warnings),
        "sha256": checksum({"law": form, "values": values, **effects}),
    }


def described(law: MccLaw) -> list[dict[str, Any]]:
    """The effects of a law: name, equation, the amplitude's unit where it is known, and numbers by name."""
    effects = []
    for effect in law.effects:
        mechanism, _, name = effect.name.partition(":")
        known = next((v for v in LIBRARY.get(mechanism, ()) if v.name == name), None)
        numbers = {field.name: getattr(effect, field.name) for field in dataclasses.fields(effect)}
        numbers = {name: float(value) for name, value in numbers.items() if eqx.is_inexact_array(value)}
        if known is None:
            more = {"equation": (inspect.getdoc(effect) or "").partition("\n")[0]}
        else:
            more = {"equation": known.equation, "unit": known.unit}
            numbers = {known.parameter if name == "amplitude" else name: value for name, value in numbers.items()}
        effects.append({"name": effect.name, **more, "numbers": numbers})
    return effects


def in_words(law: MccLaw) -> list[str]:
    """A line for each effect of a law."""
    numbers = lambda effect: ", ".join(f"{name} = {value:.6g}" for name, value in effect["numbers"].items())  # noqa: E731
    return [f"Effect {one['name']}: {one['equation']}; {numbers(one)}." for one in described(law)]


def checksum(content: Any) -> str:
    """SHA-256 of the canonical JSON of some content: sorted keys, no spaces."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _geometry(law: MccLaw, particle: Particle, origin: Origin) -> dict[str, Any]:
    return {
        **{f"{name}_um": float(getattr(particle, name)) for name in ("D1", "D2", "D3")},
        "effective_diameter_um": float(particle.effective_diameter),
        "effective_area_um2": float(particle.effective_area),
        "eta_p": float(law.shape_factor(particle)),
        "displacement_valid_um": TESTED_STRAIN * float(particle.effective_diameter / law.shape_factor(particle)),
        "from": origin.geometry,
    }
