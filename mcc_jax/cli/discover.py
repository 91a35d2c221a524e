"""`mcc-jax discover`, and `mcc-jax power`, which asks the same of a campaign before it is measured."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import click

from .._store import json_text, results
from . import options as common
from .printing import say, say_files, say_json, say_next, say_table, sentence
from .session import joint_model, provenance, read_without, session, write_result

DISCOVERY, POWER = "discovery.json", "power.json"
ROWS = 6  # rows of the table; the file has all mechanisms


def _of_the_law(command: Any) -> Any:
    """The options that both commands have."""
    given = common.campaign, common.out(required=True), common.exclude, common.leave_out()
    for option in reversed((*given, common.threshold(default=0.0), common.priors(), common.law)):
        command = option(command)
    return command


@click.command(short_help="Find, name and add what the law misses.")
@_of_the_law
@click.option(
    "--no-held-out", is_flag=True, help="Do not repeat the search without each particle: no gap on unseen particles."
)
@click.option("--no-experiments", is_flag=True, help="Do not work out which further test would show more.")
@click.option(
    "--no-posterior", is_flag=True, help="Do not sample the law with effects: standard errors of its fit instead."
)
@common.no_figures
@common.seed("Seed of the bootstrap.")
@common.json(DISCOVERY)
def discover(campaign: Path, out: Path, no_figures: bool, as_json: bool, **options: Any) -> None:
    """Find where the law and the tests in the folder CAMPAIGN disagree, name what is missing, add it to the law, and
    show on particles that took no part that the gap is closed.

    Writes discovery.json and figures/ into DIR, which may be the folder of the campaign or of a calibration.

    \b
    Verdicts, all of them answers (exit status 0):
      NO_GAP             law and tests agree within the noise
      NAMED              one mechanism explains the gap, or several together
      SET                these data cannot distinguish several mechanisms
      UNLISTED           no listed mechanism explains it; a formula does
      FIT_NOT_CONVERGED  the law cannot be fitted well enough to ask

    \b
    Examples:
      mcc-jax discover my-tests --out found
      mcc-jax discover my-tests --out found --exclude thermal_drift --unloading punch
    """
    with session() as progress:
        from ..discovery import discover as find

        data = read_without(campaign, options["leave_out"], progress)
        parts = {part: not options.pop(f"no_{part}") for part in ("held_out", "experiments", "posterior")}
        origin = provenance("discover", campaign, options | parts)
        chosen: dict[str, Any] = {name: options[name] for name in ("exclude", "threshold_MPa", "seed")}
        chosen |= {"confirm": parts.pop("held_out"), **parts}
        with results(out) as stage:
            found = find(data, model=joint_model(options), progress=progress, **chosen)
            content = write_result(found, stage, origin=origin, figures=not no_figures, progress=progress)
    if as_json:
        say_json(content)
        return
    from ..report.texts import calibration_with_found

    say_discovery(content)
    say_files(out, [*content["figures"], *content["files"], DISCOVERY])
    say_next(
        (calibration_with_found(content, shlex.quote(str(campaign))), "the law with what was found"),
        (f"mcc-jax report {shlex.quote(str(out))}", "all of it on one page"),
    )


def say_discovery(content: dict[str, Any]) -> None:
    """Print verdict, summary, notes, and the head of the ranking."""
    import textwrap

    from .._format import with_unit
    from ..discovery.sentences import verdict_in_words

    say(f"Verdict: {verdict_in_words(content)}", bold=True)
    for line in textwrap.wrap(content["summary"], 100, break_on_hyphens=False):
        say(line)
    for text in content["notes"]:
        say(f"Note: {sentence(text)}", fg="yellow")
    rows = [
        (
            entry["mechanism"],
            f"{entry['statistic']:.1f}",
            with_unit(entry["estimate"], entry["unit"], ".3g"),
            with_unit(entry["detection_limit"], entry["unit"]),
            f"{entry['probability']:.3f}",
        )
        for entry in content["ranking"][:ROWS]
    ]
    if rows:
        say()
        say_table(("mechanism", "statistic", "estimate", "detection limit", "probability"), rows)
        further = len(content["ranking"]) - len(rows)
        more = f"; {further} more in {DISCOVERY}" if further else ""
        say(f"Each against the law alone{more}. Probability: of the mechanism, if one is missing.")
    say()


@click.command(short_help="Say what a planned campaign could show.")
@_of_the_law
@common.json(POWER, "a table")
def power(campaign: Path, out: Path, as_json: bool, **options: Any) -> None:
    """Say how large each mechanism must be for the tests in the folder CAMPAIGN to show it, and which they cannot
    distinguish. CAMPAIGN is what `mcc-jax simulate` makes of your plan with your instrument's noise, or a measured
    campaign.

    Writes power.json into DIR.

    \b
    Example: would twelve particles with a hold and a reload do?
      mcc-jax simulate --particles twelve.csv --out planned --levels 0.5,1,1 --hold-s 20 --noise-um 0.05 --noise-mN 0.05
      mcc-jax power planned --out planned
    """
    with session() as progress:
        from .. import arguments
        from .._format import with_unit
        from ..discovery import power_of_campaign
        from ..effects import LIBRARY

        library = dict(LIBRARY)
        for name in options["exclude"]:
            arguments.choice(name, library, "mechanism")
            library.pop(name)
        data = read_without(campaign, options["leave_out"], progress)
        with results(out) as stage:
            settings: dict[str, Any] = {"model": joint_model(options), "threshold_MPa": options["threshold_MPa"]}
            content = power_of_campaign(data, library=library, progress=progress, **settings).to_json()
            (stage.folder / POWER).write_text(json_text(content), encoding="utf-8")
    if as_json:
        say_json(content)
        return
    rows = []
    for entry in content["mechanisms"]:
        ends = entry["detection_limit"], entry["plausible"][1]
        limits = (with_unit(value, entry["unit"]) for value in ends)
        rows.append((entry["mechanism"], *limits, "yes" if entry["visible"] else "no"))
    say_table(("mechanism", "found from", "largest plausible", "can be seen"), rows)
    for entry in content["untestable"]:
        say(f"{entry['mechanism']} needs {entry['needs']}.")
    for entry in content["inseparable"]:
        one, other = entry["pair"]
        say(f"{one} and {other} look alike ({100 * entry['similarity']:.0f} %).")
    say()
    say_files(out, [POWER])
