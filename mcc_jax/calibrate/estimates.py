"""Estimates as result files hold them: value, standard deviation, interval; the same for every method."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..campaign import Curve
from .model import Model
from .population import Population

NO_SAMPLER: dict[str, None] = dict.fromkeys(("rhat_max", "ess_bulk_min", "divergences", "pareto_k_max"))
"""Diagnostics of methods that draw nothing."""


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


def force_zero(curve: Curve) -> dict[str, Any]:
    """The zero of force [mN] that was taken off a test; null where no reading in the air shows it."""
    checked = curve.checked
    if checked is None or not (checked.force_zero_mN or checked.force_zero_sd_mN):
        return estimate(None)
    return normal_estimate(checked.force_zero_mN, checked.force_zero_sd_mN)


def normal_estimate(value: float, sd: float, least: float = -math.inf) -> dict[str, Any]:
    """An estimate with a normal error, cut off below `least`; without error where it is not finite."""
    return estimate(value, sd, (max(value - 1.96 * sd, least), value + 1.96 * sd))


def summary(draws: np.ndarray) -> dict[str, Any]:
    """Mean, standard deviation and central 95 % interval of draws."""
    low, high = np.quantile(draws, [0.025, 0.975])
    return estimate(float(np.mean(draws)), float(np.std(draws)), (float(low), float(high)))


def log_estimate(log: float, sd: float) -> dict[str, Any]:
    """An estimate from its logarithm's mean and standard deviation."""
    value = power_of_e(log)
    if not math.isfinite(sd):
        return estimate(value)
    sd = min(sd, 5.0)
    return estimate(value, value * sd, (value * math.exp(-1.96 * sd), value * math.exp(1.96 * sd)))


def power_of_e(log: float) -> float:
    """The exponential, infinite where it overflows."""
    try:
        return math.exp(log)
    except OverflowError:
        return math.inf


def effect_numbers(population: Population, model: Model) -> dict[str, np.ndarray]:
    """Numbers of the effects by the names of their sites, with the leading axes of the population."""
    theta, spread = np.asarray(population.theta), np.asarray(population.theta_scatter)
    named = {name: theta[..., k] for k, name in enumerate(model.forms.names)}
    return named | {f"tau_{name}": spread[..., j] for j, name in enumerate(model.varying_places)}


def effect_entries(model: Model, draws: Mapping[str, Any], estimates: bool = False) -> list[dict[str, Any]]:
    """Entries of `calibration.json`, one for each effect.

    `draws` are those of every number by the name of its site, or estimates already.
    """

    def of(name: str) -> dict[str, Any]:
        value = draws[name]
        return value if estimates else (summary(value) if np.ndim(value) else estimate(float(value)))

    entries = []
    for v in model.effects:
        parameters = {v.parameter: of(v.mechanism)}
        parameters |= {n.name: of(f"{v.mechanism}.{n.name}") for n in v.nuisances}
        entry: dict[str, Any] = {
            "mechanism": v.mechanism,
            "variant": v.name,
            "equation": v.equation,
            "parameters": parameters,
        }
        if v.mechanism in model.varying:
            entry["differs_between_particles"] = of(f"tau_{v.mechanism}")
        entries.append(entry)
    return entries
