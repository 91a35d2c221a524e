"""From the numbers in a `calibration.json` to laws: of the median particle, of one particle, of many."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._errors import InputError
from ..effects import AbstractEffect, Variant
from ..law import LogNormal, MccLaw, Plastic, PlasticPopulation, StrainScaling, Unloading
from .population import COEFFICIENTS

RIGID_MPA = 1e9
"""Where no test was unloaded the modulus cannot matter; a stiff one keeps the law defined."""


Variants = Mapping[str, Variant]
"""The formulas of a law's effects, by "mechanism:variant"."""


def law_of(
    content: Mapping[str, Any],
    particle: str | None = None,
    diameters_um: np.ndarray | None = None,
    variants: Variants | None = None,
) -> MccLaw:
    """The law that a `calibration.json` describes, of the median particle or of one of these diameters [um]."""
    entry = None if particle is None else entry_of(content, particle)
    if entry is None:
        C = [math.exp(_number(content[f"log_{name}"]["mean"], f"log_{name}")) for name in COEFFICIENTS]
    else:
        C = [_number(entry[name], name) for name in COEFFICIENTS]
    a = _number(content["a"], "a")
    modulus = _number(content["effective_modulus_MPa"], "effective_modulus_MPa")
    return _law(content, C, a, modulus, variants, entry, diameters_um)


def _law(
    content: Mapping[str, Any], C: Any, a: float, modulus: float, variants: Variants | None,
    entry: Mapping[str, Any] | None = None, size: np.ndarray | None = None,
) -> MccLaw:  # fmt: skip
    """The law with these numbers, and with those of a particle's entry that differ between particles."""
    amplitudes: Mapping[str, Any] = {}
    if entry is not None:
        a = _own_shape(content, entry, size, a)
        modulus = (entry.get("effective_modulus_MPa") or {}).get("value") or modulus
        amplitudes = entry.get("amplitudes") or {}
    form = Unloading(content["law"]["unloading"]), StrainScaling(content["law"]["strain_scaling"])
    effects = (built(one, variants, amplitudes.get(one["mechanism"])) for one in content.get("effects", ()))
    return MccLaw(Plastic(*C), a, modulus, *form, effects=tuple(effects))


def laws_of(
    content: Mapping[str, Any], names: list[str], diameters_um: np.ndarray, variants: Variants | None = None
) -> tuple[MccLaw, MccLaw]:
    """Laws of particles that took part, each with its own numbers, and as many times that of the typical particle.

    The typical law has the medians of the coefficients; of the paper's method it is the law of the expected stress.
    """
    a = content["a"]["value"] or 0.0
    modulus = content["effective_modulus_MPa"]["value"] or RIGID_MPA
    own = []
    for name, size in zip(names, diameters_um, strict=True):
        entry = entry_of(content, name)
        C = [entry[coefficient]["value"] for coefficient in COEFFICIENTS]
        own.append(_law(content, C, a, modulus, variants, entry, size))
    typical = [_law(content, _typical(content), a, modulus, variants)] * len(names)

    def together(laws: list[MccLaw]) -> MccLaw:
        return jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v, float) for v in x]), *laws)

    return together(own), together(typical)


def entry_of(content: Mapping[str, Any], particle: str) -> Mapping[str, Any]:
    """What the contents say of one particle.

    Raises:
        InputError: if it is not there or took no part, naming those that did.
    """
    entries = {str(entry["particle"]): entry for entry in content["particles"]}
    if particle not in entries:
        shown = ", ".join(list(entries)[:12]) + (", ..." if len(entries) > 12 else "")
        raise InputError(f"there is no particle {particle!r}", remedy=f"There are: {shown}.")
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
        raise InputError(f"{name} has no sensible value", remedy="Calibrate again on tests that tell it.")
    return float(value)


def _own_shape(content: Mapping[str, Any], entry: Mapping[str, Any], size: np.ndarray | None, a: float) -> float:
    """This particle's own a, where it differs from particle to particle: eta_p = 1 + a (1 - D3^2/(D1 D2))."""
    eta = entry["eta_p"]["value"]
    if content.get("shape_scatter") is None or eta is None or size is None:
        return a
    flatness = 1 - size[2] ** 2 / (size[0] * size[1])
    return a if abs(flatness) < 1e-6 else (eta - 1) / flatness


def _typical(content: Mapping[str, Any]) -> np.ndarray:
    pairs = [content[f"log_{name}"] for name in COEFFICIENTS]
    means = [pair["mean"]["value"] for pair in pairs]
    if any(mean is None for mean in means):
        return np.full(3, np.nan)
    parts = [LogNormal(m, pair["sd"]["value"] or 0.0) for m, pair in zip(means, pairs, strict=True)]
    population = PlasticPopulation(*parts)
    law = population.mean_law if content["method"] == "paper" else population.median_law
    return np.array([float(law.C1), float(law.C3), float(law.C5)])


def built(entry: Mapping[str, Any], variants: Variants | None, amplitude: Mapping[str, Any] | None) -> AbstractEffect:
    """The effect that an entry of a result describes; with the amplitude of one particle, where it differs."""
    name = f"{entry['mechanism']}:{entry['variant']}"
    variant = (variants or {})[name]
    values = {key: one["value"] for key, one in entry["parameters"].items()}
    strength = values.pop(variant.parameter) if amplitude is None else amplitude["value"]
    values.pop(variant.parameter, None)
    return variant.build(strength, **values)
