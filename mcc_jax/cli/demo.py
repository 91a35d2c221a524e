"""`mcc-jax demo`."""

from __future__ import annotations

import dataclasses
import json
import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._store import Stage, results
from .calibrate import estimate_text, median_text, say_state, say_warnings, write_calibration
from .discover import DISCOVERY, main_finding, write_discovery
from .options import out_option, seed_option
from .report import REPORT
from .sealed import SEALED, compared, sealed_answer
from .session import Tell, beside, import_writers, say, say_table, session
from .shared import provenance, say_files

if TYPE_CHECKING:
    from ..campaign import Campaign
    from ..simulate import HiddenEffect

CAMPAIGN_FILES = ("particles.csv", "curves.csv", "campaign.toml")
NOTHING = "nothing-hidden"
PARTICLES = 8


@click.command(short_help="Hide an effect, find it, and once more with nothing hidden.")
@out_option(default="mcc-jax-demo", show_default=True)
@seed_option("Draws what is hidden, the particles and the noise.")
def demo(out: Path, seed: int) -> None:
    """Hide in simulated tests an effect that the law does not contain, find it, add it to the law, and break the seal.

    Eight particles are simulated from the paper's tables (Bommireddy et al. 2018), which publishes its measured curves
    as pictures only. The seed draws what is hidden; a SHA-256 of the answer is printed before anything is computed.
    DIR gets campaign/, calibration.json of the law alone, posterior.nc, discovery.json, figures/, report.html, which
    shows it all in a browser, and the broken seal, sealed.json. In DIR/nothing-hidden lies the same once more for
    tests in which nothing is hidden: there nothing may be found.

    \b
    Example:
      mcc-jax demo --out try --seed 1
    """
    with session(68) as tell, results(out) as stage:
        secret = sealed_answer(seed)
        say("Something that the law does not contain is hidden in simulated tests. The answer is sealed, SHA-256:")
        say(f"  {secret.sha256}", bold=True)
        hidden, none = ({"seed": seed, "hidden": what} for what in ("sealed", "nothing"))
        calibration, found = _job(stage, secret.effect, hidden, tell)
        (stage.folder / SEALED).write_text(secret.text, encoding="utf-8")
        inner = Stage(stage.directory / NOTHING, stage.folder / NOTHING)
        inner.folder.mkdir()
        _, nothing = _job(inner, None, none, lambda step: tell(f"nothing hidden: {step}"))
        stage.stale += [f"{NOTHING}/{name}" for name in inner.stale]
    answer = json.loads(secret.text)
    say()
    say(
        f"The tests are SIMULATED from the paper's tables, not measured: {PARTICLES} particles, each with C1, C3 and C5"
    )
    say("of its own drawn from Table 2, two cycles with holds, noise of 0.02 um and 0.05 mN.")
    say()
    _say_found(calibration, found)
    say()
    say("The seal is broken. Hidden was:", bold=True)
    say(f"  {secret.text.strip()}")
    agrees, sentence = compared(answer, found)
    say(sentence, fg="green" if agrees else "red", bold=True)
    say(f"  (The seal is the SHA-256 of {SEALED}: sha256sum {shlex.quote(str(out / SEALED))})")
    say()
    right = nothing["verdict"] == "NO_GAP"
    say(f"Once more with nothing hidden: {nothing['verdict']}, {main_finding(nothing)}.", nl=False)
    say("" if right else " That is a FALSE ALARM.", fg="red", bold=True)
    say()
    figures = [*calibration["figures"], *found["figures"]]
    files = [*(f"campaign/{n}" for n in CAMPAIGN_FILES), *calibration["files"], "calibration.json", DISCOVERY, SEALED]
    say_files(out, [*figures, *files, REPORT])
    say(f"  {NOTHING}/ (the same, with nothing hidden)")
    say()
    say(f"What next? Open {out / REPORT} in a browser: it shows all of this, and what it means. Then, for example:")
    folder = shlex.quote(str(out / "campaign"))
    for comment, command in (
        ("the same particles by the paper's own steps", f"calibrate {folder} --out paper --method paper"),
        ("hide something yourself", "simulate --out hidden --levels 0.5,1 --hold-s 30 --noise-um 0.02 --effect creep"),
        ("find it", "discover hidden --out found"),
        ("your own tests, from a tester's file", "convert FILE --out tests --diameters 200,190,180"),
    ):
        say(f"  mcc-jax {command}", nl=False)
        say(f"   # {comment}", dim=True)


def _job(
    stage: Stage, effect: HiddenEffect | None, settings: dict[str, Any], tell: Tell
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Simulate, calibrate, discover, report; the contents of the two results."""
    from ..calibrate import sample
    from ..campaign import write_campaign

    tell("simulating the campaign")
    campaign, seed = _campaign(settings["seed"], effect), settings["seed"]
    write_campaign(campaign, stage.folder / "campaign")
    origin = provenance("demo", stage.folder / "campaign", settings, told="campaign")
    with beside(_import_the_rest):  # compilers leave a core to Python
        calibration = sample(campaign, seed=seed, progress=tell)
    from ..discover import discover
    from ..report import read_results, report_page

    # One core draws while the others compile.
    with beside(lambda: discover(campaign, experiments=False, seed=seed, progress=tell)) as found:
        content = write_calibration(calibration, stage, origin=origin, figures=True, tell=tell)
    missing = write_discovery(found(), stage, origin=origin, figures=True, tell=tell)
    name = stage.directory.resolve().name
    page = report_page(read_results(stage.folder, name=name), seed=seed, progress=tell)
    (stage.folder / REPORT).write_text(page, encoding="utf-8")
    return content, missing


def _campaign(seed: int, effect: HiddenEffect | None) -> Campaign:
    """Eight of the paper's particles, tested in the computer; whatever tells the truth is taken out."""
    import numpy as np

    from ..simulate import Programme, paper_campaign

    programme = Programme.cycles(levels=(0.5, 1.0, 1.0), unload_to=0.3, hold_s=20.0, points=150)
    made = paper_campaign(seed, programme=programme, effects=() if effect is None else (effect,))
    some = made.select(np.arange(len(made)) < PARTICLES)
    return dataclasses.replace(some, columns={}, metadata=dataclasses.replace(some.metadata, other={}))


def _import_the_rest() -> None:
    """What the demo needs after calibrating, seconds to import: discovery, drawing, the page, the posterior's file."""
    from .. import discover, report  # noqa: F401

    import_writers(figures=True, posterior=True)


def _say_found(calibration: dict[str, Any], found: dict[str, Any]) -> None:
    """Print what the law alone said, where it fails, the name, and what adding it did."""
    say_state(calibration)
    say_warnings(calibration)
    for place in found["where"][:3]:
        low, high = (100 * share for share in place["load_fraction"])
        at = "" if place["segment"] == "hold" else f" between {low:.0f} and {high:.0f} % of the largest load"
        say(f"Where: {100 * place['share']:.0f} % of the disagreement is on {place['segment']}{at}.")
    say(f"Discovery ({found['verdict']}): {main_finding(found)}.", bold=True)
    gap = found["gap"]
    if gap["closed_fraction"] is not None:
        before, after = (gap["steps"][i]["chi2_per_dof"] for i in (0, -1))
        say(
            f"Each particle predicted from the others: chi2 per point {before:.3g} by the law alone, {after:.3g} with "
            "what was added; 1 is noise."
        )
    say()
    sides = {"law alone": found["parameters_before"], "with what was added": found["parameters_after"]}
    sides = {name: numbers for name, numbers in sides.items() if numbers}
    say_table(("quantity", *sides, "the truth"), _numbers(list(sides.values())))
    say("After +-: the standard deviation.")


def _numbers(sides: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Quantity, its value on every side, and the true one."""
    from ..campaign import PAPER_EFFECTIVE_MODULUS_MPA, PAPER_LOG_C, PAPER_SHAPE_PARAMETER

    moduli = [f"{estimate_text(s['effective_modulus_MPa'], 1e-3)} GPa" for s in sides]
    return [
        ("shape parameter a", *(estimate_text(s["a"]) for s in sides), f"{PAPER_SHAPE_PARAMETER:g}"),
        ("effective modulus", *moduli, f"{PAPER_EFFECTIVE_MODULUS_MPA / 1e3:g} GPa"),
        *(
            (f"{name}, median", *(median_text(s[f"log_{name}"]["mean"]) for s in sides), f"{math.exp(mean):.4g}")
            for name, (mean, _) in PAPER_LOG_C.items()
        ),
    ]
