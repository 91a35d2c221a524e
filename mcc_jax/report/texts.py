"""What the results say in plain words and in tables: sentences, next steps, facts, parameters, particles, equations."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from .._format import interval, listed, number, percent, plain, span, with_sd
from ..calibrate.curves import FittedCurve
from ..calibrate.estimates import quantities
from ..campaign import Campaign, campaign_segments, effective_diameter_um
from ..discovery.sentences import next_tests
from .read import Results

METHODS = {
    "bayes": "the joint posterior of all tests at once",
    "least-squares": "joint least squares of all tests at once (Optimistix)",
    "paper": "the paper's own steps, one after the other",
}
SURE = {"bayes": "with 95 % probability", "least-squares": "as the 95 % confidence interval"}
GREEK_NAMES = ("sigma", "eps", "tau", "eta", "kappa", "gamma", "mu", "alpha", "phi", "pi", "Delta")
GREEK: dict[str, str] = dict(zip(GREEK_NAMES, "σετηκγμαφπΔ", strict=True))
KINDS = {"approach": "approach", "load": "loading", "hold": "hold", "unload": "unloading", "reload": "reloading"}


def quantity(name: str) -> str:
    """A key with its unit for a person: `compliance_um_per_mN` is "compliance [µm/mN]"."""
    units = {"um": "µm", "percent": "%"} | {one: one for one in ("mN", "MPa", "s")}
    words = name.split("_")
    start = next((k for k in range(1, len(words)) if all(w in units or w == "per" for w in words[k:])), len(words))
    unit = "".join("/" if word == "per" else units[word] for word in words[start:])
    label = " ".join(words[:start])
    return f"{label} [{'1' * unit.startswith('/')}{unit}]" if unit else label


def equation(text: str) -> Markup:
    """An equation as the library writes it, for a page: Greek letters, indices and powers."""

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


def calibration_sentences(content: dict[str, Any], law: str = "the law") -> Iterator[str]:
    """A `calibration.json` in a few sentences; of the law "alone", which lacks something, no numbers are shown."""
    count, used = len(content["particles"]), sum(entry["kept"] for entry in content["particles"])
    end = "." if content["converged"] else "; it did NOT converge, so its numbers may not be relied on."
    yield f"{law.capitalize()} was calibrated on {used} of {count} particles by {METHODS[content['method']]}{end}"
    if law.endswith("alone"):
        return
    shape = "the shape parameter a, how much more a flat particle is strained than a sphere,"
    both = ((shape, "a", 1.0, ""), ("the effective modulus", "effective_modulus_MPa", 1e-3, " GPa"))
    known = [
        f"{name} lies between {interval(content[key], factor)}{unit}".replace(" to ", " and ")
        for name, key, factor, unit in both
        if content[key]["interval_95"] is not None
    ]
    if content["method"] == "paper":
        yield "This method gives values without uncertainty; the posterior (mcc-jax calibrate) gives both."
    elif known:
        yield f"Given {law} and these tests, {listed(known)}, each {SURE[content['method']]}."
    misfit = content["diagnostics"].get("own_misfit")
    if misfit is not None:
        yield (
            f"With its own curve of loading (coefficients C₁, C₃, C₅) {law} follows a particle's displacement to "
            f"{percent(misfit)} of its range (median over the particles)."
        )


def next_steps(results: Results) -> Iterator[tuple[str, str]]:
    """What to do next: a sentence and a command (or nothing) each, the most urgent first."""
    folder, content, found = shlex.quote(results.name), results.calibration, results.discovery
    calibrate = f"mcc-jax calibrate CAMPAIGN --out {folder}"
    if results.campaign is None:
        yield "Show measured against predicted:", f"mcc-jax report {folder} --campaign CAMPAIGN"
    if content is None:
        yield "Calibrate the law on these tests:", calibrate
    elif not content["converged"]:
        lacking = (
            "The law alone does not fit these tests, which may be why its calibration did not converge; what failed "
            "is listed under Checks."
        )
        first = "Resolve what failed under Checks before anything else."
        yield lacking if found is not None and found["effects"] else first, ""
    elif content["method"] != "bayes":
        paper = content["method"] == "paper"
        yield f"Get {'the uncertainty of every number' if paper else 'the posterior, not only a best fit'}:", calibrate
    if found is None:
        yield "Ask what the law misses:", f"mcc-jax discover CAMPAIGN --out {folder}"
    else:
        yield from _after(found, added=results.has_found)
    if content is not None and content["converged"] and (found is None or found["verdict"] == "NO_GAP"):
        yield "Predict tests that you plan:", "mcc-jax simulate --out planned"


def _after(found: dict[str, Any], *, added: bool) -> Iterator[tuple[str, str]]:
    """What to do after a discovery; `added` if the page is of the law with what was added already."""
    separating = next_tests(found["next_experiments"], found["checks"])
    if separating:
        yield " ".join(separating), ""
    elif found["verdict"] == "NO_GAP" and found["untestable"]:
        needs = sorted({entry["needs"] for entry in found["untestable"]})
        yield f"To learn about more mechanisms, the tests need {listed(needs)}.", ""
    elif found["verdict"] in ("NAMED", "SET", "UNLISTED") and added:
        yield "Use the law together with the added effects; the parameters below include them.", ""
    elif found["verdict"] in ("NAMED", "SET", "UNLISTED"):
        use = "Use the law together with what was added (parameters “after” below), not alone"
        command = calibration_with_found(found, "CAMPAIGN")
        yield f"{use}. All about it, from every particle's curve to the checks:" if command else f"{use}.", command


def calibration_with_found(found: dict[str, Any], campaign: str) -> str:
    """The command that calibrates the law with the effects of a `discovery.json`; empty where no options can say it.

    `campaign` is the folder of the tests, quoted for a shell.
    """
    named = [":".join(filter(None, (effect["mechanism"], effect["variant"]))) for effect in found["effects"]]
    if not named or found["closure"]:
        return ""
    options = " ".join(f"--effect {shlex.quote(name)}" for name in named)
    return f"mcc-jax calibrate {campaign} {options} --out with-effect"


def spread(log: dict[str, Any]) -> str:
    """How much particles differ in a coefficient, in words: of mean and standard deviation of its logarithm."""
    mean, sd = log["mean"]["value"], log["sd"]["value"]
    if mean is None or sd is None or not abs(mean) + abs(sd) < 300:
        return "How much particles differ: not determined by these data."
    if sd < 1e-3:
        return "How much particles differ: hardly at all in these data."
    low, high = number(math.exp(mean - sd), 3), number(math.exp(mean + sd), 3)
    return f"How much particles differ: two of three lie between {low} and {high}."


def measured(campaign: Campaign) -> list[tuple[str, str]]:
    """Facts of a campaign, name and value."""
    sizes, meta = campaign.diameters_um, campaign.metadata
    peaks = np.array([curve.force_mN.max() for curve in campaign.curves])
    stress = 1e3 * peaks / (math.pi * np.array([effective_diameter_um(one) / 2 for one in sizes]) ** 2)
    counts = Counter(part.kind for parts in campaign_segments(campaign) for part in parts)
    resolution = [
        f"{number(value)} {unit}"
        for value, unit in ((meta.force_resolution_mN, "mN"), (meta.displacement_resolution_um, "µm"))
        if value is not None
    ]
    return [
        ("Tests", f"{len(campaign)} particles, {sum(len(c) for c in campaign.curves)} points"),
        ("Diameters", span(sizes.ravel(), "µm")),
        ("Flatness 1 − D₃²/(D₁D₂)", span(1 - sizes[:, 2] ** 2 / (sizes[:, 0] * sizes[:, 1]), "", 2)),
        ("Largest force", span(peaks, "mN")),
        ("Largest stress", span(stress, "MPa", 3)),
        ("Segments", ", ".join(f"{counts[kind]} × {word}" for kind, word in KINDS.items() if counts[kind])),
        ("Duration", span([float(c.time_s[-1] - c.time_s[0]) for c in campaign.curves], "s")),
        ("Control", {"load": "force", "displacement": "displacement", None: "not recorded"}[meta.control]),
        ("Resolution", ", ".join(resolution) or "not recorded"),
        *([("Punch", f"{number(punch)} µm diameter")] if (punch := meta.punch_diameter_um) is not None else []),
        ("Corrections before", ", ".join(map(plain, meta.corrections)) or "none recorded"),
        ("Provenance", meta.provenance or "not recorded"),
    ]


def changes(found: dict[str, Any]) -> Iterator[tuple[str, list[tuple[str, str | None]]]]:
    """What a discovery did to the parameters: name, and before and after the value with its error, and its interval."""
    before, after = (
        {one.name: one for one in quantities(side) if one.estimate["value"] is not None} if side else {}
        for side in (found["parameters_before"], found["parameters_after"])
    )
    for name in before:
        if name in after and not name.endswith("_sd_of_log"):
            first = before[name]
            label = f"{first.label} [{first.unit}]" if first.unit else first.label
            both = (first, after[name])
            yield label, [(with_sd(q.estimate, q.factor), interval(q.estimate, q.factor)) for q in both]


def particle_facts(results: Results, shown: Sequence[FittedCurve]) -> Iterator[str]:
    """One line about each particle, for the line below the chart."""
    rows = {name: (diameters, entry) for name, diameters, _, entry in particle_rows(results)}
    for one in shown:
        diameters, entry = rows[one.name]
        parts = [f"D₁ × D₂ × D₃ = {' × '.join(map(number, diameters))}\N{NO-BREAK SPACE}µm"]
        if entry is not None and entry["eta_p"]["value"] is not None:
            parts.append(f"shape factor {number(entry['eta_p']['value'], 3)}")
        if one.why_not is not None:
            parts.append(f"not used: {one.why_not}")
        elif one.rms_um is not None:
            parts.append(f"root mean square of test − law {number(one.rms_um, 2)}\N{NO-BREAK SPACE}µm")
        yield "; ".join(parts) + "."


def particle_rows(results: Results) -> list[tuple[str, Any, Any, Any]]:
    """Name, diameters [um], curve and entry in `calibration.json` of every particle; None for what is not there."""
    campaign, content = results.campaign, results.calibration
    entries = {entry["particle"]: entry for entry in content["particles"]} if content else {}
    if campaign is None:
        return [(name, None, None, entry) for name, entry in entries.items()]
    tests = zip(campaign.particles, campaign.diameters_um, campaign.curves, strict=True)
    return [(*test, entries.get(test[0])) for test in tests]
