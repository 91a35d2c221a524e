"""Estimates as result files have them, value, standard deviation and interval, the same for every method, and the table
of the law's parameters that people see."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from .._format import plain, with_sd
from .judgement import MODULUS_OPEN
from .numpyro_model import Model
from .population import COEFFICIENTS

NO_SAMPLER: dict[str, None] = dict.fromkeys(("rhat_max", "ess_bulk_min", "divergences", "pareto_k_max"))
"""Diagnostics of methods that draw nothing."""


def finite(value: float | None) -> float | None:
    """The number, or None if it is not finite: JSON knows neither NaN nor infinity."""
    return float(value) if value is not None and math.isfinite(value) else None


def estimate(
    value: float | None, sd: float | None = None, interval_95: tuple[float, float] | None = None
) -> dict[str, Any]:
    """One estimate; what a method does not give, or what is not finite, is None."""
    ends = None if interval_95 is None else [finite(end) for end in interval_95]
    return {"value": finite(value), "sd": finite(sd), "interval_95": None if ends is None or None in ends else ends}


def normal_estimate(value: float, sd: float, least: float = -math.inf) -> dict[str, Any]:
    """An estimate with a normal error, cut off below `least`; without error where it is not finite."""
    return estimate(value, sd, (max(value - 1.96 * sd, least), value + 1.96 * sd))


def log_estimate(log: float, sd: float) -> dict[str, Any]:
    """An estimate from its logarithm's mean and standard deviation."""
    return exponential(normal_estimate(log, min(sd, 5.0) if math.isfinite(sd) else math.nan))


def summary(draws: np.ndarray) -> dict[str, Any]:
    """Mean, standard deviation and central 95 % interval of draws."""
    low, high = np.quantile(draws, [0.025, 0.975])
    return estimate(float(np.mean(draws)), float(np.std(draws)), (float(low), float(high)))


def exponential(one: Mapping[str, Any]) -> dict[str, Any]:
    """The estimate of exp of what is estimated."""
    value, sd, ends = one["value"], one["sd"], one["interval_95"]
    middle = None if value is None else power_of_e(value)
    scaled = None if middle is None or sd is None else middle * sd
    return estimate(middle, scaled, None if ends is None else (power_of_e(ends[0]), power_of_e(ends[1])))


def power_of_e(log: float) -> float:
    """The exponential, infinite where it overflows."""
    return math.inf if log > math.log(sys.float_info.max) else math.exp(log)


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
    """A parameter of the law with what is known of it."""

    name: str  # as in files, with its unit
    label: str  # for people
    estimate: Mapping[str, Any]
    factor: float = 1.0  # what people see is the estimate times this factor, in this unit
    unit: str = ""

    @property
    def text(self) -> str:
        """Value ± standard deviation with the unit."""
        return f"{with_sd(self.estimate, self.factor)} {self.unit}".rstrip()


def quantities(content: Mapping[str, Any]) -> Iterator[Quantity]:
    """The law's parameters in a `calibration.json`, or in the parameters before and after of a `discovery.json`."""
    yield Quantity("a", "shape parameter a", content["a"])
    is_open = any(one["check"] == MODULUS_OPEN for one in content.get("findings", []))
    modulus = dict.fromkeys(content["a"]) if is_open else content["effective_modulus_MPa"]
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
