"""What follows from the contents of a `calibration.json`: laws, and every test of a campaign next to its law."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._errors import InputError
from .._format import described, first_few
from ..campaign import Campaign, Segment, campaign_segments, particle_batch
from ..effects import AbstractEffect, Record, Variant
from ..geometry import Particle
from ..law import LogNormal, MccLaw, Plastic, PlasticPopulation, StrainScaling, Unloading
from .data import MOST_POINTS, padded_length, records_of, row_kinds, rows_from_contact
from .population import COEFFICIENTS
from .running import Blocks, compiled

KINDS = ("load", "hold", "unload", "reload")
RIGID_MPA = 1e9  # where no test was unloaded the modulus cannot matter; a stiff one keeps the law defined


# ---- laws ------------------------------------------------------------------------------------------------------------

Variants = Mapping[str, Variant]  # the formulas of a law's effects, by "mechanism:variant"


def law_of(
    content: Mapping[str, Any],
    particle: str | None = None,
    diameters_um: np.ndarray | None = None,
    variants: Variants | None = None,
) -> MccLaw:
    """The law that a `calibration.json` describes, of the median particle or of one of these diameters [um]; raises
    `InputError` for a particle that took no part, or a parameter without a value."""
    entry = None if particle is None else entry_of(content, particle)
    if entry is None:
        C = [math.exp(_number(content[f"log_{name}"]["mean"], f"log_{name}")) for name in COEFFICIENTS]
    else:
        C = [_number(entry[name], name) for name in COEFFICIENTS]
    for name in ("a", "effective_modulus_MPa"):
        _number(content[name], name)
    return _law(content, C, entry, diameters_um, variants)


def _typical_coefficients(content: Mapping[str, Any]) -> list[float]:
    """The medians of C1, C3 and C5; of the paper's method those of the law of the expected stress."""
    logs = [content[f"log_{name}"] for name in COEFFICIENTS]
    if any(log["mean"]["value"] is None for log in logs):
        return [math.nan] * 3
    population = PlasticPopulation(*(LogNormal(log["mean"]["value"], log["sd"]["value"] or 0.0) for log in logs))
    law = population.mean_law if content["method"] == "paper" else population.median_law
    return [float(law.C1), float(law.C3), float(law.C5)]


def _law(
    content: Mapping[str, Any],
    C: Any,
    entry: Mapping[str, Any] | None,
    size: np.ndarray | None,
    variants: Variants | None,
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
    """What a `calibration.json` says of one particle; raises `InputError` if it is not there or took no part."""
    entries = {str(entry["particle"]): entry for entry in content["particles"]}
    if particle not in entries:
        raise InputError(f"there is no particle {particle!r}", remedy=f"There are: {first_few(entries, 12)}.")
    if not entries[particle]["kept"]:
        problem = f"particle {particle!r} took no part in the calibration: {entries[particle]['why_not']}"
        raise InputError(problem, remedy="Take another particle or, without one, the population.")
    return entries[particle]


def _number(estimate: Mapping[str, Any], name: str) -> float:
    value = estimate["value"]
    if value is None and name == "effective_modulus_MPa":
        raise InputError("holds no effective modulus", remedy="Calibrate on tests that unload.")
    if value is None or (name.startswith("log_") and abs(value) > 100):
        raise InputError(f"{name} has no sensible value", remedy="Calibrate again on tests that determine it.")
    return float(value)


# ---- curves ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FittedCurve:
    """One particle's test from contact on, and what the law says of it; every array of shape (n,).

    Attributes:
        name: of the particle.
        why_not: why it took no part in the calibration; None if it did, or it was not calibrated.
        time_s, force_mN, displacement_um: measured, raw.
        kind: index into `KINDS`.
        used: which points the calibration compared with the law.
        own_um: displacement by the law with this particle's own coefficients and zero, the mean of the posterior's
            predictions where there are some; NaN where there is none.
        typical_um: with those of the population's median.
        low_um, high_um: ends of the central 95 % of what may be measured; NaN where there is no posterior.
    """

    name: str
    why_not: str | None
    time_s: np.ndarray
    force_mN: np.ndarray
    displacement_um: np.ndarray
    kind: np.ndarray
    used: np.ndarray
    own_um: np.ndarray
    typical_um: np.ndarray
    low_um: np.ndarray
    high_um: np.ndarray

    __repr__ = described()

    @property
    def rms_um(self) -> float | None:
        """Root mean square of measured less predicted at the compared points [um]; None without a prediction."""
        away = (self.displacement_um - self.own_um)[self.used]
        return float(np.sqrt(np.mean(away**2))) if len(away) and np.isfinite(away).all() else None

    @property
    def inside(self) -> np.ndarray:
        """Of every compared point with a band, whether it lies inside; empty without a posterior."""
        known = self.used & np.isfinite(self.low_um)
        return ((self.displacement_um >= self.low_um) & (self.displacement_um <= self.high_um))[known]


def measured_curves(campaign: Campaign) -> tuple[FittedCurve, ...]:
    """The tests of a campaign that nobody calibrated."""
    return tuple(_measured(campaign, campaign_segments(campaign), {})[0])


def fitted_curves(
    content: Mapping[str, Any],
    campaign: Campaign,
    compared: Mapping[int, tuple[np.ndarray, np.ndarray]],
    predictions: Callable[[str], np.ndarray | None],
    variants: Variants | None = None,
) -> tuple[FittedCurve, ...]:
    """Tests with what a calibrated law predicts; `compared` and `predictions` are those of a `Calibration`."""
    segments = campaign_segments(campaign)
    curves, rows = _measured(campaign, segments, compared)
    entry_by_name = {entry["particle"]: entry for entry in content["particles"]}
    entries = [entry_by_name[name] for name in campaign.particles]
    curves = [replace(one, why_not=entry["why_not"]) for one, entry in zip(curves, entries, strict=True)]
    C = [[entry[name]["value"] for name in COEFFICIENTS] for entry in entries]
    places = [i for i, entry in enumerate(entries) if entry["kept"] and None not in C[i]]
    if not places:
        return tuple(curves)
    own = [_law(content, C[i], entries[i], campaign.diameters_um[i], variants) for i in places]
    typical = [_law(content, _typical_coefficients(content), None, None, variants)] * len(places)
    laws = (jax.tree.map(lambda *x: jnp.asarray(np.stack(x, dtype=float)), *each) for each in (own, typical))
    both = responses_um(campaign, places, segments, [rows[i] for i in places], *laws)
    for i, own_um, typical_um in zip(places, *both, strict=True):
        one, zero = curves[i], entries[i]["zero_um"]["value"] or 0.0
        length = len(one.kind)
        one = replace(one, own_um=own_um[:length] + zero, typical_um=typical_um[:length] + zero)
        draws = predictions(one.name) if i in compared else None
        if draws is not None:
            # Of two hundred draws mean and standard deviation say the ends of a near-normal band better than quantiles.
            centre, half = draws.mean(0), 1.96 * draws.std(0)
            low, high = (np.where(one.used, centre + sign * half, np.nan) for sign in (-1, 1))
            # Means of coefficients are not the coefficients of the mean.
            one = replace(one, own_um=np.where(one.used, centre, one.own_um), low_um=low, high_um=high)
        curves[i] = one
    return tuple(curves)


def _measured(
    campaign: Campaign,
    segments: Sequence[tuple[Segment, ...]],
    compared: Mapping[int, tuple[np.ndarray, np.ndarray]],
) -> tuple[list[FittedCurve], list[np.ndarray]]:
    """All tests without a law, and their rows: those that were compared, else all from contact on, thinned."""
    found, all_rows = [], []
    for i, (name, curve) in enumerate(zip(campaign.particles, campaign.curves, strict=True)):
        rows = compared[i][0] if i in compared else rows_from_contact(curve, segments[i], MOST_POINTS)
        used = compared[i][1] if i in compared else np.ones(len(rows), bool)
        kind = np.argmax(row_kinds(segments[i])[rows, None] == np.array(KINDS), axis=1)
        measured = curve.time_s[rows], curve.force_mN[rows], curve.displacement_um[rows]
        found.append(FittedCurve(name, None, *measured, kind, used, *[np.full(len(rows), np.nan)] * 4))
        all_rows.append(rows)
    return found, all_rows


@compiled
def responses(laws: MccLaw, particles: Particle, records: Record) -> Array:
    """Displacement [um] of particles by a law each, along a record each, shape (N, points)."""
    return jax.vmap(lambda law, *one: law.respond(*one))(laws, particles, records)


def responses_um(
    campaign: Campaign,
    places: list[int],
    segments: Sequence[tuple[Segment, ...]],
    rows: Sequence[np.ndarray],
    *laws: MccLaw,
) -> list[np.ndarray]:
    """Displacement [um] of tests at some places of a campaign, at some rows of each, shape (N, points), by each of the
    laws, whose arrays have the particles first."""
    # Campaigns of similar size and length share one compilation.
    record, _, _ = records_of(campaign, places, segments, rows, padded_length(max(map(len, rows))))
    sizes, blocks = particle_batch(campaign.diameters_um[places]), Blocks(len(places))
    return [np.asarray(blocks.all(responses, (one, sizes, record))) for one in laws]
