"""`mcc-jax discover`, and `mcc-jax power`, which asks the same of a campaign before it is measured."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._errors import InputError
from .._store import Stage, json_text, results
from . import options as common
from .session import (
    drop_earlier,
    joint_model,
    provenance,
    read_without,
    say,
    say_files,
    say_json,
    say_next,
    say_table,
    sentence,
    session,
    write_figures,
)

if TYPE_CHECKING:
    from .._types import Progress
    from ..discovery import Discovery

DISCOVERY, POWER = "discovery.json", "power.json"
ROWS = 6
"""Rows of the table; the file has all mechanisms."""


@click.command(short_help="Find, name and add what the law misses.")
@common.campaign
@common.out(required=True)
@common.exclude
@common.leave_out
@common.threshold(default=0.0)
@common.priors()
@common.law
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
def discover(
    campaign: Path,
    out: Path,
    no_held_out: bool,
    no_experiments: bool,
    no_posterior: bool,
    no_figures: bool,
    as_json: bool,
    **options: Any,
) -> None:
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

        require_mechanisms(options["exclude"])
        data = read_without(campaign, options["leave_out"], progress)
        parts = {"experiments": not no_experiments, "posterior": not no_posterior}
        origin = provenance("discover", campaign, options | {"held_out": not no_held_out} | parts)
        chosen: dict[str, Any] = {name: options[name] for name in ("exclude", "threshold_MPa", "seed")} | parts
        with results(out) as stage:
            found = find(data, model=joint_model(options), confirm=not no_held_out, progress=progress, **chosen)
            content = write_discovery(found, stage, origin=origin, figures=not no_figures, progress=progress)
    if as_json:
        say_json(content)
        return
    from ..calibrate.results import DISCOVERY_ARCHIVE
    from ..report.texts import calibration_with_found

    say_discovery(content)
    say_files(out, [*content["figures"], DISCOVERY_ARCHIVE, DISCOVERY])
    say_next(
        (calibration_with_found(content, shlex.quote(str(campaign))), "the law with what was found"),
        (f"mcc-jax report {shlex.quote(str(out))}", "all of it on one page"),
    )


def require_mechanisms(names: tuple[str, ...]) -> None:
    """Refuse to exclude what does not exist, before anything is computed."""
    from ..effects import LIBRARY

    for name in names:
        if name not in LIBRARY:
            raise InputError(f"there is no mechanism {name!r}", remedy=f"--exclude takes one of: {', '.join(LIBRARY)}")
    if set(names) >= set(LIBRARY):
        raise InputError("every mechanism is excluded", remedy="Leave one to look for")


def write_discovery(
    found: Discovery, stage: Stage, *, origin: Mapping[str, Any], figures: bool, progress: Progress
) -> dict[str, Any]:
    """Write `discovery.json` and the figures into the stage; see `write_calibration`."""

    def draw() -> Mapping[str, Any]:
        from ..plots import discovery_figures

        return discovery_figures(found)

    names = write_figures(stage, draw if figures else None, progress)
    drop_earlier(stage, DISCOVERY, names)
    return found.write(stage.folder, figures=names, provenance=dict(origin))


def say_discovery(content: dict[str, Any]) -> None:
    """Print verdict, summary, notes, and the head of the ranking."""
    import textwrap

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
            _with_unit(entry["estimate"], ".3g", entry["unit"]),
            _with_unit(entry["detection_limit"], ".2g", entry["unit"]),
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


def _with_unit(value: float | None, form: str, unit: str) -> str:
    return ("unknown" if value is None else format(value, form)) + ("" if unit == "-" else f" {unit}")


@click.command(short_help="Say what a planned campaign could show.")
@common.campaign
@common.out(required=True)
@common.exclude
@common.leave_out
@common.threshold(default=0.0)
@common.priors()
@common.law
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
        from ..discovery import power_of_campaign
        from ..effects import LIBRARY

        require_mechanisms(options["exclude"])
        data = read_without(campaign, options["leave_out"], progress)
        with results(out) as stage:
            found = power_of_campaign(
                data,
                library={name: m for name, m in LIBRARY.items() if name not in options["exclude"]},
                model=joint_model(options),
                threshold_MPa=options["threshold_MPa"],
                progress=progress,
            )
            content = found.to_json()
            (stage.folder / POWER).write_text(json_text(content), encoding="utf-8")
    if as_json:
        say_json(content)
        return
    rows = []
    for entry in content["mechanisms"]:
        ends = entry["detection_limit"], entry["plausible"][1]
        limits = (_with_unit(value, ".2g", entry["unit"]) for value in ends)
        rows.append((entry["mechanism"], *limits, "yes" if entry["visible"] else "no"))
    say_table(("mechanism", "found from", "largest plausible", "can be seen"), rows)
    for entry in content["untestable"]:
        say(f"{entry['mechanism']} needs {entry['needs']}.")
    for entry in content["inseparable"]:
        one, other = entry["pair"]
        say(f"{one} and {other} look alike ({100 * entry['similarity']:.0f} %).")
    say()
    say_files(out, [POWER])
