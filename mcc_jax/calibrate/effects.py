"""Effects of a calibrated law as result files hold them, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..effects import AbstractEffect, Variant, find_variant
from .estimates import estimate, summary
from .model import Model
from .population import Population


def effect_numbers(population: Population, model: Model) -> dict[str, np.ndarray]:
    """Numbers of the effects by the names of their sites, with the leading axes of the population."""
    theta, spread = np.asarray(population.theta), np.asarray(population.theta_scatter)
    named = {name: theta[..., k] for k, name in enumerate(model.forms.names)}
    return named | {f"tau_{name}": spread[..., j] for j, name in enumerate(model.varying_places)}


def effect_entries(model: Model, draws: Mapping[str, Any], estimates: bool = False) -> list[dict[str, Any]]:
    """Entries of `calibration.json`, one for each effect.

    Args:
        model: the model.
        draws: of every number by the name of its site, or its estimate.
        estimates: whether they are estimates already.
    """

    def told(name: str) -> dict[str, Any]:
        value = draws[name]
        return value if estimates else (summary(value) if np.ndim(value) else estimate(float(value)))

    entries = []
    for v in model.effects:
        parameters = {v.parameter: told(v.mechanism)}
        parameters |= {n.name: told(f"{v.mechanism}.{n.name}") for n in v.nuisances}
        entry: dict[str, Any] = {
            "mechanism": v.mechanism,
            "variant": v.name,
            "equation": v.equation,
            "parameters": parameters,
        }
        if v.mechanism in model.varying:
            entry["differs_between_particles"] = told(f"tau_{v.mechanism}")
        entries.append(entry)
    return entries


def built(
    entry: Mapping[str, Any],
    variants: Mapping[str, Variant] | None = None,
    amplitude: Mapping[str, Any] | None = None,
) -> AbstractEffect:
    """The effect that an entry of a result describes.

    Args:
        entry: of `calibration.json`.
        variants: formulas that are not in the library, by "mechanism:variant".
        amplitude: of one particle, where it differs.
    """
    name = f"{entry['mechanism']}:{entry['variant']}"
    variant = (variants or {}).get(name) or find_variant(name)
    values = {key: one["value"] for key, one in entry["parameters"].items()}
    strength = values.pop(variant.parameter) if amplitude is None else amplitude["value"]
    values.pop(variant.parameter, None)
    return variant.build(strength, **values)
