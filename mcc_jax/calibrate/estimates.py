"""Estimates as result files have them, value, standard deviation and interval, the same for every method; and what
follows from the contents of a `calibration.json`: a table of the law's parameters, and laws."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._errors import InputError
from .._format import first_few, plain, with_sd
from ..campaign import Curve
from ..effects import AbstractEffect, Variant
from ..law import LogNormal, MccLaw, Plastic, PlasticPopulation, StrainScaling, Unloading
from .judgement import modulus_is_open
from .numpyro_model import Model
from .population import COEFFICIENTS

NO_SAMPLER: dict[str, None] = dict.fromkeys(("rhat_max", "ess_bulk_min", "divergences", "pareto_k_max"))
"""Diagnostics of methods that draw nothing."""

RIGID_MPA = 1e9  # where no test was unloaded the modulus cannot matter; a stiff one keeps the law defined


def finite(value: float) -> float | None:
    """The number, or None if it is not finite: JSON knows neither NaN nor infinity."""
    return float(value) if math.isfinite(value) else None


def estimate(
    value: float | None, sd: float | None = None, interval_95: tuple[float, float] | None = None
) -> dict[str, Any]:
    """One estimate; what a method does not give, or what is not finite, is None."""
    known = interval_95 is not None and all(math.isfinite(end) for end in interval_95)
    return {
        "value": None if value is None else finite(value),
        "sd": None if sd is None else finite(sd),
        "interval_95": [float(end) for end in interval_95] if interval_95 is not None and known else None,
    }


def normal_estimate(value: float, sd: float, least: float = -math.inf) -> dict[str, Any]:
    """An estimate with a normal error, cut off below `least`; without error where it is not finite."""
    return estimate(value, sd, (max(value - 1.96 * sd, least), value + 1.96 * sd))


def log_estimate(log: float, sd: float) -> dict[str, Any]:
    """An estimate from its logarithm's mean and standard deviation."""
    value = power_of_e(log)
    if not math.isfinite(sd):
        return estimate(value)
    sd = min(sd, 5.0)
    return estimate(value, value * sd, (value * math.exp(-1.96 * sd), value * math.exp(1.96 * sd)))


def summary(draws: np.ndarray) -> dict[str, Any]:
    """Mean, standard deviation and central 95 % interval of draws."""
    low, high = np.quantile(draws, [0.025, 0.975])
    return estimate(float(np.mean(draws)), float(np.std(draws)), (float(low), float(high)))


def exponential(estimate: Mapping[str, Any]) -> dict[str, Any]:
    """The estimate of exp of what is estimated."""

    def exp(value: float) -> float:
        return math.exp(min(value, 700.0))

    value, sd, ends = estimate["value"], estimate["sd"], estimate["interval_95"]
    middle = None if value is None else exp(value)
    return {
        "value": middle,
        "sd": None if middle is None or sd is None else middle * sd,
        "interval_95": None if ends is None else [exp(end) for end in ends],
    }


def power_of_e(log: float) -> float:
    """The exponential, infinite where it overflows."""
    try:
        return math.exp(log)
    except OverflowError:
        return math.inf


def force_zero(curve: Curve) -> dict[str, Any]:
    """The zero of force [mN] that was taken off a test; null where no reading before contact shows it."""
    checked = curve.checked
    if checked is None or not (checked.force_zero_mN or checked.force_zero_sd_mN):
        return estimate(None)
    return normal_estimate(checked.force_zero_mN, checked.force_zero_sd_mN)


def effect_entries(model: Model, estimates: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Entries of `calibration.json`, one for each effect, from estimates by the names of sites."""
    entries = []
    for v in model.effects:
        parameters = {v.parameter: estimates[v.mechanism]}
        parameters |= {n.name: estimates[f"{v.mechanism}.{n.name}"] for n in v.nuisances}
        entry = {"mechanism": v.mechanism, "variant": v.name, "equation": v.equation, "parameters": parameters}
        if v.mechanism in model.varying:
            entry["differs_between_particles"] = estimates[f"tau_{v.mechanism}"]
        entries.append(entry)
    return entries


class Quantity(NamedTuple):
    """A parameter of the law with what is known of it.

    Attributes:
        name: as in files, with its unit.
        label: for people.
        estimate: value, standard deviation and 95 % interval.
        factor, unit: what people see is the estimate times this factor, in this unit.
    """

    name: str
    label: str
    estimate: Mapping[str, Any]
    factor: float = 1.0
    unit: str = ""

    @property
    def text(self) -> str:
        """Value ± standard deviation with the unit."""
        return f"{with_sd(self.estimate, self.factor)} {self.unit}".rstrip()


def quantities(content: Mapping[str, Any]) -> Iterator[Quantity]:
    """The law's parameters in a `calibration.json`, or in the parameters before and after of a `discovery.json`."""
    yield Quantity("a", "shape parameter a", content["a"])
    modulus = dict.fromkeys(content["a"]) if modulus_is_open(content) else content["effective_modulus_MPa"]
    yield Quantity("effective_modulus_MPa", "effective modulus", modulus, 1e-3, "GPa")
    if "modulus_at_peaks_MPa" in content:
        peaks = content["modulus_at_peaks_MPa"]
        yield Quantity("modulus_at_peaks_MPa", "effective modulus at the peaks", peaks, 1e-3, "GPa")
    for name in COEFFICIENTS:
        log = content[f"log_{name}"]
        yield Quantity(f"{name}_median", f"{name}, median", exponential(log["mean"]))
        yield Quantity(f"{name}_sd_of_log", f"{name}, sd of its logarithm", log["sd"])
    for effect in content.get("effects", ()):
        label = plain(f"{effect['mechanism']}, {effect['variant']}")
        for name, one in effect["parameters"].items():
            yield Quantity(f"{effect['mechanism']}.{name}", f"{label}: {name}", one)
    if "yield_stress_MPa" in content:
        yield Quantity("yield_stress_MPa", "yield stress", content["yield_stress_MPa"], 1.0, "MPa")


# ---- laws ------------------------------------------------------------------------------------------------------------

Variants = Mapping[str, Variant]
"""The formulas of a law's effects, by "mechanism:variant"."""


def law_of(
    content: Mapping[str, Any],
    particle: str | None = None,
    diameters_um: np.ndarray | None = None,
    variants: Variants | None = None,
) -> MccLaw:
    """The law that a `calibration.json` describes, of the median particle or of one of these diameters [um].

    Raises:
        InputError: for a particle that took no part, or a parameter without a value.
    """
    entry = None if particle is None else entry_of(content, particle)
    if entry is None:
        C = [math.exp(_number(content[f"log_{name}"]["mean"], f"log_{name}")) for name in COEFFICIENTS]
    else:
        C = [_number(entry[name], name) for name in COEFFICIENTS]
    for name in ("a", "effective_modulus_MPa"):
        _number(content[name], name)
    return _law(content, C, variants, entry, diameters_um)


def laws_of(
    content: Mapping[str, Any], names: list[str], diameters_um: np.ndarray, variants: Variants | None = None
) -> tuple[MccLaw, MccLaw]:
    """Laws of particles that took part, each with its own coefficients, and as many times that of the typical particle.

    The typical law has the medians of the coefficients; of the paper's method it is the law of the expected stress.
    """
    entries = {entry["particle"]: entry for entry in content["particles"]}
    own = []
    for name, size in zip(names, diameters_um, strict=True):
        C = [entries[name][coefficient]["value"] for coefficient in COEFFICIENTS]
        own.append(_law(content, C, variants, entries[name], size))
    logs = [content[f"log_{name}"] for name in COEFFICIENTS]
    C = [np.nan] * 3
    if all(log["mean"]["value"] is not None for log in logs):
        population = PlasticPopulation(*(LogNormal(log["mean"]["value"], log["sd"]["value"] or 0.0) for log in logs))
        law = population.mean_law if content["method"] == "paper" else population.median_law
        C = [float(law.C1), float(law.C3), float(law.C5)]
    typical = [_law(content, C, variants)] * len(names)

    def together(laws: list[MccLaw]) -> MccLaw:
        return jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v, float) for v in x]), *laws)

    return together(own), together(typical)


def _law(
    content: Mapping[str, Any],
    C: Any,
    variants: Variants | None,
    entry: Mapping[str, Any] | None = None,
    size: np.ndarray | None = None,
) -> MccLaw:
    """The law with these coefficients, and with what differs between particles in the entry of one."""
    a = content["a"]["value"] or 0.0
    modulus: Any = content["effective_modulus_MPa"]["value"] or RIGID_MPA
    amplitudes: Mapping[str, Any] = {}
    if entry is not None:
        modulus = (entry.get("effective_modulus_MPa") or {}).get("value") or modulus
        amplitudes = entry.get("amplitudes") or {}
        eta = entry["eta_p"]["value"]
        if content.get("shape_scatter") is not None and eta is not None and size is not None:
            flatness = 1 - size[2] ** 2 / (size[0] * size[1])  # eta_p = 1 + a (1 - D3^2/(D1 D2))
            a = a if abs(flatness) < 1e-6 else (eta - 1) / flatness

    def effect(one: Mapping[str, Any]) -> AbstractEffect:
        variant = (variants or {})[f"{one['mechanism']}:{one['variant']}"]
        values = {key: parameter["value"] for key, parameter in one["parameters"].items()}
        strength = values.pop(variant.parameter)
        own = amplitudes.get(one["mechanism"])
        return variant.build(strength if own is None else own["value"], **values)

    form = Unloading(content["law"]["unloading"]), StrainScaling(content["law"]["strain_scaling"])
    return MccLaw(Plastic(*C), a, modulus, *form, effects=tuple(map(effect, content.get("effects", ()))))


def entry_of(content: Mapping[str, Any], particle: str) -> Mapping[str, Any]:
    """What the contents of a `calibration.json` say of one particle.

    Raises:
        InputError: if it is not there or took no part, naming those that did.
    """
    entries = {str(entry["particle"]): entry for entry in content["particles"]}
    if particle not in entries:
        raise InputError(f"there is no particle {particle!r}", remedy=f"There are: {first_few(entries, 12)}.")
    if not entries[particle]["kept"]:
        raise InputError(
            f"particle {particle!r} took no part in the calibration: {entries[particle]['why_not']}",
            remedy="Take another particle or, without one, the population.",
        )
    return entries[particle]


def _number(estimate: Mapping[str, Any], name: str) -> float:
    value = estimate["value"]
    if value is None and name == "effective_modulus_MPa":
        raise InputError("holds no effective modulus", remedy="Calibrate on tests that unload.")
    if value is None or (name.startswith("log_") and abs(value) > 100):
        raise InputError(f"{name} has no sensible value", remedy="Calibrate again on tests that determine it.")
    return float(value)
