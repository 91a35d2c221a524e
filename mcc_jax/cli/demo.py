"""`mcc-jax demo`."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._store import Stage, results
from . import options as common
from .calibrate import say_calibration
from .discover import DISCOVERY
from .outputs import REPORT
from .printing import say, say_files, say_table
from .session import provenance, session, write_result

if TYPE_CHECKING:
    from .._types import Progress
    from ..simulate import HiddenEffect

SEALED = "sealed.json"

STRENGTHS = {
    "reload_hysteresis": (0.15, 0.3),
    "frame_compliance": (2e-3, 4e-3),
    "creep": (3e-4, 6e-4),
    "unloading_shape": (0.08, 0.15),
}
"""What may be hidden, and between which amplitudes: effects that eight particles show beyond doubt.

`benchmarks/results/` says how often weaker and other ones are found.
"""
CAMPAIGN_FILES = ("particles.csv", "curves.csv", "campaign.toml")
NOTHING = "nothing-hidden"
PARTICLES = 8


@click.command(short_help="Hide an effect and find it, and repeat with nothing hidden.")
@common.out(default="mcc-jax-demo", show_default=True)
@common.seed("Draws what is hidden, the particles and the noise.")
def demo(out: Path, seed: int) -> None:
    """Hide in simulated tests an effect that the law does not contain, find it, add it to the law, and break the seal.

    Eight particles are simulated from the paper's tables (Bommireddy et al. 2018), which publishes its measured curves
    as pictures only. The seed draws what is hidden; a SHA-256 of the answer is printed before anything is computed.
    DIR gets campaign/, calibration.json of the law alone, posterior.nc, discovery.json, figures/, report.html, which
    shows it all in a browser, and the broken seal, sealed.json. In DIR/nothing-hidden is the same for
    tests in which nothing is hidden: there nothing may be found.

    \b
    Example:
      mcc-jax demo --out try --seed 1
    """
    with session() as progress, results(out) as stage:
        effect, sealed = sealed_answer(seed)
        say("Something that the law does not contain is hidden in simulated tests. The answer is sealed, SHA-256:")
        say(f"  {hashlib.sha256(sealed.encode()).hexdigest()}", bold=True)
        calibration, found = _job(stage, effect, {"seed": seed, "hidden": "sealed"}, progress)
        (stage.folder / SEALED).write_text(sealed, encoding="utf-8")
        inner = Stage(stage.directory / NOTHING, stage.folder / NOTHING)
        inner.folder.mkdir()
        absent = dataclasses.replace(effect, amplitude=0.0)  # the law alone, by the program compiled above
        settings = {"seed": seed, "hidden": "nothing"}
        _, nothing = _job(inner, absent, settings, lambda step: progress(f"nothing hidden: {step}"))
        stage.stale += [f"{NOTHING}/{name}" for name in inner.stale]
    say(
        f"\nThe tests are SIMULATED from the paper's tables, not measured: {PARTICLES} particles, each with its own "
        "C1, C3\nand C5 drawn from Table 2, two cycles with holds, noise of 0.02 um and 0.05 mN.\n"
    )
    _say_found(calibration, found)
    agrees, sentence = compared(json.loads(sealed), found)
    say("\nThe seal is broken. Hidden was:", bold=True)
    say(f"  {sealed.strip()}")
    say(sentence, fg="green" if agrees else "red", bold=True)
    say(f"  (The seal is the SHA-256 of {SEALED}: sha256sum {shlex.quote(str(out / SEALED))})\n")
    from ..discovery.sentences import headline

    right = nothing["verdict"] == "NO_GAP"
    say(f"The same with nothing hidden: {headline(nothing)}", nl=False)
    say("\n" if right else " That is a FALSE ALARM.\n", fg="red", bold=True)
    figures = [*calibration["figures"], *found["figures"]]
    files = [*(f"campaign/{n}" for n in CAMPAIGN_FILES), *calibration["files"], "calibration.json", DISCOVERY, SEALED]
    say_files(out, [*figures, *files, REPORT])
    say(f"  {NOTHING}/ (the same, with nothing hidden)\n")
    say(f"What next? Open {out / REPORT} in a browser: it shows all of this, and what it means. Then, for example:")
    folder = shlex.quote(str(out / "campaign"))
    for comment, command in (
        ("the same particles by the paper's own steps", f"calibrate {folder} --out paper --method paper"),
        ("hide something yourself", "simulate --out hidden --levels 0.5,1 --hold-s 30 --noise-um 0.02 --effect creep"),
        ("find it", "discover hidden --out found"),
        ("your own tests, from an instrument's file", "convert FILE --out tests --diameters 200,190,180"),
    ):
        say(f"  mcc-jax {command}", nl=False)
        say(f"   # {comment}", dim=True)


def _job(
    stage: Stage, effect: HiddenEffect, settings: dict[str, Any], progress: Progress
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Simulate, calibrate, discover, report; the contents of the two results."""
    import numpy as np

    from ..calibrate import sample
    from ..campaign.csv import write_files
    from ..discovery import discover
    from ..report import read_results, report_page
    from ..simulate import Programme, paper_campaign

    progress("simulating the campaign")
    seed = settings["seed"]
    programme = Programme.cycles(levels=(0.5, 1.0, 1.0), unload_to=0.3, hold_s=20.0, points=150)
    made = paper_campaign(seed, programme=programme, effects=(effect,)).select(np.arange(20) < PARTICLES)
    # Whatever gives the truth is taken out.
    campaign = dataclasses.replace(made, columns={}, metadata=dataclasses.replace(made.metadata, other={}))
    write_files(campaign, stage.folder / "campaign")
    origin = provenance("demo", stage.folder / "campaign", settings, folder="campaign")
    written: dict[str, Any] = {"origin": origin, "figures": True, "progress": progress}
    content = write_result(sample(campaign, seed=seed, progress=progress), stage, **written)
    found = discover(campaign, experiments=False, seed=seed, progress=progress)
    missing = write_result(found, stage, **written)
    page = report_page(read_results(stage.folder, name=stage.directory.resolve().name), progress=progress)
    (stage.folder / REPORT).write_text(page, encoding="utf-8")
    return content, missing


def _say_found(calibration: dict[str, Any], found: dict[str, Any]) -> None:
    """Print what the law alone said, where it fails, the name, and what adding it did."""
    from ..calibrate.estimates import quantities
    from ..campaign import PAPER_EFFECTIVE_MODULUS_MPA, PAPER_LOG_C, PAPER_SHAPE_PARAMETER
    from ..discovery.sentences import headline

    say_calibration(calibration, numbers=False)
    for place in found["where"][:3]:
        low, high = (100 * share for share in place["load_fraction"])
        at = "" if place["segment"] == "hold" else f" between {low:.0f} and {high:.0f} % of the largest load"
        say(f"Where: {100 * place['share']:.0f} % of the disagreement is on {place['segment']}{at}.")
    say(f"Discovery: {headline(found, 'simulated tests')}", bold=True)
    gap = found["gap"]
    if gap["closed_fraction"] is not None:
        before, after = (gap["steps"][i]["chi2_per_dof"] for i in (0, -1))
        predicted = f"chi2 per point {before:.3g} by the law alone, {after:.3g} with what was added; 1 is noise"
        say(f"Each particle predicted from the others: {predicted}.")
    say()
    sides = {"law alone": found["parameters_before"], "with what was added": found["parameters_after"]}
    texts = {name: {one.label: one.text for one in quantities(side)} for name, side in sides.items() if side}
    truth = {
        "shape parameter a": f"{PAPER_SHAPE_PARAMETER:g}",
        "effective modulus": f"{PAPER_EFFECTIVE_MODULUS_MPA / 1e3:g} GPa",
        **{f"{name}, median": f"{math.exp(mean):.4g}" for name, (mean, _) in PAPER_LOG_C.items()},
    }
    rows = [(label, *(side[label] for side in texts.values()), value) for label, value in truth.items()]
    say_table(("quantity", *texts, "the truth"), rows)
    say("After ±: the standard deviation.")


def sealed_answer(seed: int) -> tuple[HiddenEffect, str]:
    """Draw what is hidden, and the answer as text, with a number used once, without which it could be guessed."""
    import numpy as np

    from ..effects import find_variant
    from ..simulate import HiddenEffect

    rng = np.random.default_rng([seed, 0x5EA1])
    name = list(STRENGTHS)[int(rng.integers(len(STRENGTHS)))]
    low, high = STRENGTHS[name]
    amplitude = float(f"{low * (high / low) ** rng.random():.3g}")
    variant = find_variant(name)
    effect = HiddenEffect(variant, amplitude)
    answer = {"mechanism": name, "variant": variant.name, "parameters": effect.numbers, "nonce": rng.bytes(16).hex()}
    return effect, json.dumps(answer) + "\n"


def compared(answer: dict[str, Any], found: dict[str, Any]) -> tuple[bool, str]:
    """Whether a discovery (discovery.json) named what was hidden (sealed.json), and in a sentence how both agree."""
    from .._format import plain
    from ..discovery.sentences import verdict_in_words

    hidden = answer["mechanism"]
    named = [effect["mechanism"] for effect in found["effects"]]
    if named != [hidden]:
        names = " and ".join(map(plain, named)) or f"no name ({verdict_in_words(found)})"
        return False, f"The discovery is WRONG: hidden was {plain(hidden)}, found was {names}."
    effect = found["effects"][0]
    rivals = [plain(name) for name in found["candidate_set"][0] if name != hidden]
    doubt = f", though these tests cannot distinguish it from {' or '.join(rivals)}" if rivals else ""
    if effect["variant"] != answer["variant"]:
        formulas = f"{plain(effect['variant'])}, hidden was {plain(answer['variant'])}"
        return True, f"The name agrees{doubt}; the formula is another ({formulas}), so amplitudes do not compare."
    name, true = next(iter(answer["parameters"].items()))
    value, sd, ends = (effect["parameters"][name][key] for key in ("value", "sd", "interval_95"))
    where = "unknown" if ends is None else "inside" if ends[0] <= true <= ends[1] else "OUTSIDE"
    off = f"{100 * (value / true - 1):+.1f} %"
    spread = "" if not sd else f", {abs(value - true) / sd:.1f} standard deviations"
    return True, (
        f"The name agrees{doubt}. The amplitude found is off by {off}{spread}; "
        f"the true one lies {where} its 95 % interval."
    )
