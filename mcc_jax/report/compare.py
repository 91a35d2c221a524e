"""Measured against predicted, for every particle: computed anew from the campaign and `calibration.json`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..calibrate.data import rows_from_contact
from ..campaign import THRESHOLD_MPA, Campaign, campaign_segments, particle_batch, stress_and_strain
from .posterior import Band
from .read import Results

KINDS = ("load", "hold", "unload", "reload")
POINTS = 40_000
"""About so many points stand in the page, shared among its particles."""

MAX_POINTS, MIN_POINTS = 400, 40
MAX_PARTICLES = POINTS // MIN_POINTS
RIGID_MPA = 1e9
"""Where no test was unloaded the modulus cannot matter; a stiff one keeps the law defined."""


@dataclass(frozen=True)
class Shown:
    """One particle's test from contact on, as the page shows it; every array of shape (n,).

    Attributes:
        name: of the particle.
        why_not: why it took no part in the calibration; None if it did, or nobody asked.
        time_s, force_mN, displacement_um: measured, raw.
        kind: index into `KINDS`.
        used: which points the calibration compared with the law.
        own_um: displacement by the law with this particle's own coefficients and zero, the mean of the posterior's
            predictions where there are some; NaN where there is none.
        typical_um: with those of the population's middle.
        low_um, high_um: central 95 % of what may be measured; NaN where there is no posterior.
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

    @property
    def rms_um(self) -> float | None:
        """Root mean square of measured less predicted at the compared points [um]; None without a prediction."""
        away = (self.displacement_um - self.own_um)[self.used]
        return float(np.sqrt(np.mean(away**2))) if len(away) and np.isfinite(away).all() else None


def compare(results: Results) -> list[Shown]:
    """Every particle of the campaign, at most `MAX_PARTICLES`: then those that the law misses by most.

    Needs double precision, as calibration does. Empty without a campaign.
    """
    campaign = results.campaign
    if campaign is None:
        return []
    entries = {e["particle"]: e for e in results.calibration["particles"]} if results.calibration else {}
    chosen = _chosen(campaign, entries)
    campaign = campaign.select(chosen)
    shown = [_measured(campaign, i, parts, results) for i, parts in enumerate(campaign_segments(campaign))]
    most = min(max(POINTS // len(shown), MIN_POINTS), MAX_POINTS)
    if results.calibration is not None:
        shown = _predicted(campaign, shown, entries, results.calibration)
    return [_thinned(one, most) for one in shown]


def _chosen(campaign: Campaign, entries: dict[str, Any]) -> np.ndarray:
    rms = np.array([entries.get(name, {}).get("rms_um") or 0.0 for name in campaign.particles])
    chosen = np.zeros(len(campaign), bool)
    chosen[np.argsort(-rms, kind="stable")[:MAX_PARTICLES]] = True
    return chosen


def _measured(campaign: Campaign, i: int, segments: Any, results: Results) -> Shown:
    curve, name = campaign.curves[i], campaign.particles[i]
    kind = np.zeros(len(curve), int)
    for part in segments:
        kind[part.start : part.stop] = KINDS.index(part.kind) if part.kind in KINDS else 0
    rows = rows_from_contact(curve, segments, MAX_POINTS)
    used = _compared(curve, campaign.diameters_um[i], segments, kind, results.calibration)[rows]
    force = curve.force_mN[rows]
    middle = low = high = nothing = np.full(len(rows), np.nan)
    band = None if results.posterior is None else results.posterior.bands.get(name)
    if band is not None and _fits(band, force):
        middle, low, high = (ends[: len(rows)] for ends in (band.middle_um, band.low_um, band.high_um))
    measured = (curve.time_s[rows], force, curve.displacement_um[rows])
    return Shown(name, None, *measured, kind[rows], used, middle, nothing, low, high)


def _fits(band: Band, force: np.ndarray) -> bool:
    """Whether a band was drawn at these very forces."""
    return len(band.force_mN) >= len(force) and bool(np.array_equal(band.force_mN[: len(force)], force))


def _compared(curve: Any, diameters: np.ndarray, segments: Any, kind: np.ndarray, calibration: dict | None):
    """The points that a calibration compares: see `select_tests`, and `predict_particles` for the paper's method."""
    from ..calibrate import MIN_RATIO

    stress, _ = stress_and_strain(curve, diameters, segments)
    touching = np.ones(len(curve), bool)
    if segments[0].kind == "approach":
        touching[: segments[0].stop] = False
    if calibration is None:
        return touching
    if calibration["method"] == "paper":
        threshold = calibration.get("adjustment", {}).get("threshold_MPa", THRESHOLD_MPA)
        return touching & (stress > max(threshold, 0.02 * stress.max())) & curve.compared
    told = calibration["provenance"]["settings"].get("threshold_MPa")
    threshold = told if isinstance(told, int | float) else THRESHOLD_MPA
    elastic = (kind == KINDS.index("load")) | (stress >= MIN_RATIO * np.maximum.accumulate(stress))
    return touching & elastic & (stress >= threshold) & curve.compared


def _predicted(campaign: Campaign, shown: list[Shown], entries: dict[str, Any], calibration: dict[str, Any]):
    """The same with predictions, for the particles that the calibration kept."""
    from dataclasses import replace

    from ..simulate import simulate_batch

    known = [_coefficients(entries.get(one.name)) for one in shown]
    rows = [i for i, C in enumerate(known) if C is not None]
    whys = [entries.get(one.name, {}).get("why_not") for one in shown]
    whys = [w or (None if C else "is not in calibration.json") for w, C in zip(whys, known, strict=True)]
    if not rows:
        return [replace(one, why_not=why) for one, why in zip(shown, whys, strict=True)]
    longest = max(len(one.force_mN) for one in shown)
    # Lengths in steps of 64: campaigns of similar length then share one compilation.
    longest += -longest % 64
    force = np.stack([np.pad(shown[i].force_mN, (0, longest - len(shown[i].force_mN)), mode="edge") for i in rows])
    sizes = campaign.diameters_um[rows]
    laws = _laws(calibration, [entries[shown[i].name] for i in rows], sizes)
    both = np.concatenate([sizes, sizes])
    paths = np.concatenate([force, force])
    response = simulate_batch(laws, particle_batch(both), _array(paths), control="load")
    um = np.asarray(response.displacement).reshape(2, len(rows), longest)
    done = dict(enumerate(shown))
    for k, i in enumerate(rows):
        zero = entries[shown[i].name]["zero_um"]["value"] or 0.0
        own, typical = um[:, k, : len(shown[i].force_mN)] + zero
        # Means of coefficients that hang together are not the coefficients of the mean.
        middle = shown[i].own_um
        done[i] = replace(shown[i], own_um=np.where(np.isfinite(middle), middle, own), typical_um=typical)
    return [replace(done[i], why_not=why) for i, why in enumerate(whys)]


def _array(values: np.ndarray):
    import jax.numpy as jnp

    return jnp.asarray(values, float)


def _coefficients(entry: dict[str, Any] | None) -> tuple[float, float, float] | None:
    if entry is None or not entry["kept"]:
        return None
    C1, C3, C5 = (entry[name]["value"] for name in ("C1", "C3", "C5"))
    return None if C1 is None or C3 is None or C5 is None else (C1, C3, C5)


def _laws(calibration: dict[str, Any], entries: list[dict[str, Any]], sizes: np.ndarray):
    """Laws of these particles, then that of the population's middle as many times again."""
    import equinox as eqx

    from ..law import MccLaw, Plastic, StrainScaling, Unloading

    a, modulus = calibration["a"]["value"] or 0.0, calibration["effective_modulus_MPa"]["value"] or RIGID_MPA
    own = np.array([_coefficients(entry) for entry in entries], float)
    typical = np.broadcast_to(_typical(calibration), own.shape)
    moduli = [(entry.get("effective_modulus_MPa") or {}).get("value") or modulus for entry in entries]
    shapes = [_own_shape(calibration, entry, size, a) for entry, size in zip(entries, sizes, strict=True)]
    form, scaling = Unloading(calibration["law"]["unloading"]), StrainScaling(calibration["law"]["strain_scaling"])

    def law(C: Any, a: Any, modulus: Any) -> MccLaw:
        return MccLaw(Plastic(C[0], C[1], C[2]), a, modulus, form, scaling)

    n = len(entries)
    return eqx.filter_vmap(law)(
        _array(np.concatenate([own, typical])),
        _array(np.concatenate([shapes, np.full(n, a)])),
        _array(np.concatenate([moduli, np.full(n, modulus)])),
    )


def _own_shape(calibration: dict[str, Any], entry: dict[str, Any], size: np.ndarray, a: float) -> float:
    """This particle's own a, where it differs from particle to particle: eta_p = 1 + a (1 - D3^2/(D1 D2))."""
    flatness = 1 - size[2] ** 2 / (size[0] * size[1])
    eta = entry["eta_p"]["value"]
    if calibration.get("shape_scatter") is None or eta is None or abs(flatness) < 1e-6:
        return a
    return (eta - 1) / flatness


def _typical(calibration: dict[str, Any]) -> np.ndarray:
    """C1, C3, C5 of the median particle; of the paper's method the law of the expected stress."""
    from ..law import LogNormal, PlasticPopulation

    pairs = [calibration[f"log_{name}"] for name in ("C1", "C3", "C5")]
    means = [pair["mean"]["value"] for pair in pairs]
    if any(mean is None for mean in means):
        return np.full(3, np.nan)
    sds = [pair["sd"]["value"] or 0.0 for pair in pairs]
    parts = [LogNormal(_array(np.asarray(m)), _array(np.asarray(sd))) for m, sd in zip(means, sds, strict=True)]
    population = PlasticPopulation(*parts)
    law = population.mean_law if calibration["method"] == "paper" else population.median_law
    return np.array([float(law.C1), float(law.C3), float(law.C5)])


def _thinned(one: Shown, most: int) -> Shown:
    """At most about so many points; the ends of segments always."""
    from dataclasses import fields, replace

    n = len(one.kind)
    stride = -(-n // most)
    if stride <= 1:
        return one
    turns = np.flatnonzero(np.diff(one.kind)) + 1
    rows = np.unique(np.concatenate([np.arange(0, n, stride), turns, turns - 1, [n - 1]]))
    columns = [f.name for f in fields(one) if f.name not in ("name", "why_not")]
    return replace(one, **{name: getattr(one, name)[rows] for name in columns})
