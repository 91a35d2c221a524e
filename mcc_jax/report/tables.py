"""What the tables of the page show: facts of the campaign, parameters, particles."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from .._format import interval, number, plain, span, with_sd
from ..calibrate.curves import FittedCurve
from ..calibrate.estimates import quantities
from ..campaign import Campaign, campaign_segments, effective_diameter_um
from .read import Results

GREEK = {
    "sigma": "σ",
    "eps": "ε",
    "tau": "τ",
    "eta": "η",
    "kappa": "κ",
    "gamma": "γ",
    "mu": "μ",
    "alpha": "α",
    "phi": "φ",
    "pi": "π",
    "Delta": "Δ",
}
KINDS = {"approach": "approach", "load": "loading", "hold": "hold", "unload": "unloading", "reload": "reloading"}


def measured(campaign: Campaign) -> list[tuple[str, str]]:
    """Facts of a campaign, name and value."""
    sizes = campaign.diameters_um
    effective = [effective_diameter_um(one) for one in sizes]
    peaks = [float(curve.force_mN.max()) for curve in campaign.curves]
    stress = [1e3 * p / (math.pi * (d / 2) ** 2) for p, d in zip(peaks, effective, strict=True)]
    flatness = 1 - sizes[:, 2] ** 2 / (sizes[:, 0] * sizes[:, 1])
    counts = Counter(part.kind for parts in campaign_segments(campaign) for part in parts)
    segments = ", ".join(f"{counts[kind]} × {word}" for kind, word in KINDS.items() if counts[kind])
    meta = campaign.metadata
    resolution = [
        f"{number(value)} {unit}"
        for value, unit in ((meta.force_resolution_mN, "mN"), (meta.displacement_resolution_um, "µm"))
        if value is not None
    ]
    return [
        ("Tests", f"{len(campaign)} particles, {sum(len(c) for c in campaign.curves)} points"),
        ("Diameters", span(sizes.ravel(), "µm")),
        ("Flatness 1 − D₃²/(D₁D₂)", span(flatness, "", 2)),
        ("Largest force", span(peaks, "mN")),
        ("Largest stress", span(stress, "MPa", 3)),
        ("Segments", segments),
        ("Duration", span([float(c.time_s[-1] - c.time_s[0]) for c in campaign.curves], "s")),
        ("Control", {"load": "force", "displacement": "displacement", None: "not recorded"}[meta.control]),
        ("Resolution", ", ".join(resolution) or "not recorded"),
        *([("Punch", f"{number(punch)} µm diameter")] if (punch := meta.punch_diameter_um) is not None else []),
        ("Corrections before", ", ".join(map(plain, meta.corrections)) or "none recorded"),
        ("Provenance", meta.provenance or "not recorded"),
    ]


def changes(found: dict[str, Any]) -> list[tuple[str, list[tuple[str, str | None]]]]:
    """What a discovery did to the parameters: name, and before and after the value with its error, and its interval."""
    sides = [
        {one.name: one for one in quantities(side)} if side else {}
        for side in (found["parameters_before"], found["parameters_after"])
    ]
    rows = []
    for name in sides[0]:
        pair = [side[name] for side in sides if name in side]
        if len(pair) == 2 and not name.endswith("_sd_of_log") and all(q.estimate["value"] is not None for q in pair):
            first = pair[0]
            label = f"{first.label} [{first.unit}]" if first.unit else first.label
            cells = [(with_sd(q.estimate, q.factor), interval(q.estimate, q.factor)) for q in pair]
            rows.append((label, cells))
    return rows


def equation(text: str) -> Any:
    """An equation as the library writes it, for a page: Greek letters, indices and powers."""
    from markupsafe import Markup, escape

    def name(match: re.Match[str]) -> str:
        letter, number, below = match["letter"], match["number"] or "", (match["below"] or "_")[1:]
        return f"<i>{GREEK.get(letter, letter)}</i>" + (f"<sub>{number}{below}</sub>" if number or below else "")

    # An `s` after a number is a second, and the `a` of "on a reload" no length.
    second = r"(?!(?<=[\da][ /])s\b|(?<=N/)s\b)"
    letters = rf"(?P<letter>{'|'.join(GREEK)}|[A-Za-z])(?P<number>\d)?(?P<below>_\w+)?\b"
    written = re.sub(rf"(?<!on )\b{second}{letters}", name, str(escape(text)).replace("&#39;", "′"))
    raised = r"\^(?:\((?P<bracketed>[^()]*)\)|(?P<plain>-?(?:<i>\w+</i>|[\d.]*\d)))"
    written = re.sub(raised, lambda match: f"<sup>{match['bracketed'] or match['plain']}</sup>", written)
    for pattern, sign in ((r"(?<=[\s(>])-", "−"), (r"\bum\b", "µm")):
        written = re.sub(pattern, sign, written)
    return Markup(written)


def spread(log: dict[str, Any]) -> str:
    """How much particles differ in a coefficient, in words: of mean and standard deviation of its logarithm."""
    mean, sd = log["mean"]["value"], log["sd"]["value"]
    if mean is None or sd is None or not abs(mean) + abs(sd) < 300:
        return "How much particles differ; these data do not show it."
    if sd < 1e-3:
        return "How much particles differ: hardly at all in these data."
    low, high = number(math.exp(mean - sd), 3), number(math.exp(mean + sd), 3)
    return f"How much particles differ: two of three lie between {low} and {high}."


def particle_facts(results: Results, shown: Sequence[FittedCurve]) -> list[str]:
    """One line about each particle, for the line below the chart."""
    campaign = results.campaign
    assert campaign is not None
    entries = {e["particle"]: e for e in results.calibration["particles"]} if results.calibration else {}
    facts = []
    for one in shown:
        sizes = " × ".join(number(d) for d in campaign.diameters_um[campaign.index(one.name)])
        parts = [f"D₁ × D₂ × D₃ = {sizes}\N{NO-BREAK SPACE}µm"]
        eta = entries.get(one.name, {}).get("eta_p", {}).get("value")
        if eta is not None:
            parts.append(f"shape factor {number(eta, 3)}")
        if one.why_not is not None:
            parts.append(f"not used: {one.why_not}")
        elif one.rms_um is not None:
            parts.append(f"root mean square of test − law {number(one.rms_um, 2)}\N{NO-BREAK SPACE}µm")
        facts.append("; ".join(parts) + ".")
    return facts


def particle_rows(results: Results) -> list[dict[str, Any]]:
    """The table of particles: sizes, what was measured, what was found, and whether it was used."""
    campaign, content = results.campaign, results.calibration
    entries = {e["particle"]: e for e in content["particles"]} if content else {}
    names = list(campaign.particles) if campaign is not None else list(entries)
    rows = []
    for i, name in enumerate(names):
        entry = entries.get(name)
        row: dict[str, Any] = {"name": name, "kept": None if entry is None else entry["kept"]}
        row["why_not"] = None if entry is None else entry["why_not"]
        if campaign is not None:
            row["sizes"] = [number(d) for d in campaign.diameters_um[i]]
            row["peak"] = number(float(np.max(campaign.curves[i].force_mN)))
            row["points"] = len(campaign.curves[i])
        if entry is not None:
            row["eta"] = number(entry["eta_p"]["value"], 3)
            row["C"] = [with_sd(entry[c]) if entry["kept"] else "–" for c in ("C1", "C3", "C5")]
            own = entry.get("own_rms_um", entry["rms_um"])
            row["rms"] = number(own, 2) if entry["kept"] else "–"
        rows.append(row)
    return rows
