"""What the numbers say, in plain words."""

from __future__ import annotations

import shlex
from typing import Any

from .._format import interval, listed, number, percent, plain, probability
from ..discovery.settings import ENOUGH
from ..plots.style import is_simulated
from .read import Results

METHODS = {
    "bayes": "the joint posterior of all tests at once",
    "least-squares": "joint least squares of all tests at once (Optimistix)",
    "paper": "the paper's own steps, one after the other",
}
SURE = {"bayes": "with 95 % probability", "least-squares": "as the 95 % confidence interval"}


def quantity(name: str) -> str:
    """A key with its unit for a person: `compliance_um_per_mN` is "compliance [µm/mN]"."""
    units = {"um": "µm", "percent": "%"} | {one: one for one in ("mN", "MPa", "s")}
    words = name.split("_")
    start = next((k for k in range(1, len(words)) if all(w in units or w == "per" for w in words[k:])), len(words))
    unit = "".join("/" if word == "per" else units[word] for word in words[start:])
    label = " ".join(words[:start])
    return f"{label} [{'1' * unit.startswith('/')}{unit}]" if unit else label


def simulated(results: Results) -> bool:
    """Whether these data were computed, not measured."""
    return results.campaign is not None and is_simulated(results.campaign.metadata)


def is_law_alone(results: Results) -> bool:
    """Whether the calibration is of the law without the effects that were found to be missing in it."""
    found, calibration = results.discovery, results.calibration
    return bool(found and found["effects"] and calibration and not calibration.get("effects"))


def beside_the_law(results: Results) -> str:
    """What follows "the law" where the calibration's is meant: " alone", " with" its effects, or nothing."""
    if is_law_alone(results):
        return " alone"
    effects = (results.calibration or {}).get("effects")
    return f" with {listed([plain(effect['mechanism']) for effect in effects])}" if effects else ""


def calibration_sentences(content: dict[str, Any], beside: str = "", *, alone: bool = False) -> list[str]:
    """A `calibration.json` in a few sentences; `beside` is what follows "the law", see `beside_the_law`.

    If it is of the law `alone`, without effects that were found to be missing, its numbers are those of a law that is
    known to be wrong: they are not shown.
    """
    count, used = len(content["particles"]), sum(entry["kept"] for entry in content["particles"])
    found = [
        f"The law{beside} was calibrated on {used} of {count} particles by {METHODS[content['method']]}"
        + ("." if content["converged"] else "; it did NOT converge, so its numbers may not be relied on.")
    ]
    if alone:
        return found
    sure = SURE.get(content["method"])
    if sure is None:
        found.append("This method gives values without uncertainty; the posterior (mcc-jax calibrate) gives both.")
    else:
        known = [
            f"{name} lies between {interval(content[key], factor)}{unit}".replace(" to ", " and ")
            for name, key, factor, unit in (
                ("the shape parameter a, how much more flat particles are strained than spheres,", "a", 1.0, ""),
                ("the effective modulus", "effective_modulus_MPa", 1e-3, " GPa"),
            )
            if content[key]["interval_95"] is not None
        ]
        if known:
            found.append(f"Given the law{beside} and these tests, {listed(known)}, each {sure}.")
    misfit = content["diagnostics"].get("own_misfit")
    if misfit is not None:
        found.append(
            f"With its own curve of loading (coefficients C₁, C₃, C₅) the law{beside} follows a particle's "
            f"displacement to {percent(misfit)} of its range (median over the particles)."
        )
    return found


def next_steps(results: Results, folder: str) -> list[tuple[str, str]]:
    """What to do next: a sentence and a command (or nothing) each, the most urgent first."""
    steps: list[tuple[str, str]] = []
    content, found = results.calibration, results.discovery
    if results.campaign is None:
        steps.append(("Show measured against predicted:", f"mcc-jax report {folder} --campaign CAMPAIGN"))
    if content is None:
        steps.append(("Calibrate the law on these tests:", f"mcc-jax calibrate CAMPAIGN --out {folder}"))
    elif not content["converged"]:
        steps.append((_resolve(found), ""))
    elif content["method"] != "bayes":
        what = (
            "the uncertainty of every number" if content["method"] == "paper" else "the posterior, not only a best fit"
        )
        steps.append((f"Get {what}:", f"mcc-jax calibrate CAMPAIGN --out {folder}"))
    if found is None:
        steps.append(("Ask what the law misses:", f"mcc-jax discover CAMPAIGN --out {folder}"))
    else:
        steps += _after(found, added=results.has_found)
    if content is not None and content["converged"] and (found is None or found["verdict"] == "NO_GAP"):
        steps.append(("Predict tests that you plan:", "mcc-jax simulate --out planned"))
    return steps


def calibration_with_found(found: dict[str, Any], campaign: str) -> str:
    """The command that calibrates the law with the effects of a `discovery.json`; empty where no options can say it.

    `campaign` is the folder of the tests, quoted for a shell.
    """
    named = [":".join(filter(None, (effect["mechanism"], effect["variant"]))) for effect in found["effects"]]
    if not named or found["closure"]:
        return ""
    options = " ".join(f"--effect {shlex.quote(name)}" for name in named)
    return f"mcc-jax calibrate {campaign} {options} --out with-effect"


def _resolve(found: dict[str, Any] | None) -> str:
    if found is not None and found["effects"]:
        return (
            "The law alone does not fit these tests, which may be why its calibration did not converge; what failed "
            "is listed under Checks."
        )
    return "Resolve what failed under Checks before anything else."


def _after(found: dict[str, Any], *, added: bool) -> list[tuple[str, str]]:
    """What to do after a discovery; `added` if the page is of the law with what was added already."""
    verdict = found["verdict"]
    if found["next_experiments"]:
        best = found["next_experiments"][0]
        names, power = listed([plain(n) for n in best["separates"]]), probability(best["power"])
        test = f"{best['experiment']}, {number(best['particles'])} further particles"
        if best["power"] >= ENOUGH:
            return [(f"Measure: {test}. It would separate {names} with probability {power}.", "")]
        doubt = f"No further test of those tried on paper would surely separate {names}."
        return [(f"{doubt} The best: {test}, would do so with probability {power}.", "")]
    if found["checks"]:
        first = found["checks"][0]
        return [(f"Check directly. For {plain(first['mechanism'])}: {first['check']}. For the others, see below.", "")]
    if verdict in ("NAMED", "SET", "UNLISTED"):
        if added:
            return [("Use the law together with what was added: the parameters below are of both.", "")]
        use = "Use the law together with what was added (parameters “after” below), not alone"
        command = calibration_with_found(found, "CAMPAIGN")
        return [(f"{use}. All about it, from every particle's curve to the checks:" if command else f"{use}.", command)]
    if verdict == "NO_GAP" and found["untestable"]:
        needs = sorted({entry["needs"] for entry in found["untestable"]})
        return [(f"To learn about more mechanisms, the tests need {listed(needs)}.", "")]
    return []
