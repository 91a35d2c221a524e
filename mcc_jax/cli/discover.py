"""`mcc-jax discover`."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._errors import InputError
from .._store import Stage, results
from .options import (
    CampaignFolder,
    exclude_option,
    json_option,
    law_options,
    leave_out_option,
    no_figures_option,
    out_option,
    priors_option,
    seed_option,
    threshold_option,
)
from .session import Tell, beside, import_writers, say, say_table, session
from .shared import joint_model, provenance, read_without, say_files, say_json, sentence, write_figures

if TYPE_CHECKING:
    from ..discover import Discovery

DISCOVERY = "discovery.json"
ROWS = 6
"""So many mechanisms stand in the table; the file has all."""


@click.command(short_help="Find, name and add what the law misses.")
@click.argument("campaign", type=CampaignFolder(), metavar="CAMPAIGN")
@out_option(required=True)
@exclude_option
@leave_out_option
@threshold_option(default=0.0)
@priors_option()
@law_options
@click.option(
    "--no-held-out", is_flag=True, help="Do not repeat the search without each particle: no gap on unseen particles."
)
@click.option("--no-experiments", is_flag=True, help="Do not work out which further test would tell more.")
@click.option(
    "--no-posterior", is_flag=True, help="Do not sample the law with effects: standard errors of its fit instead."
)
@no_figures_option
@seed_option("Seed of the bootstrap.")
@json_option(DISCOVERY)
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
      SET                these data cannot tell several mechanisms apart
      UNLISTED           no listed mechanism explains it; a formula does
      FIT_NOT_CONVERGED  the law cannot be fitted well enough to ask

    \b
    Examples:
      mcc-jax discover my-tests --out found
      mcc-jax discover my-tests --out found --exclude thermal_drift --unloading punch
    """
    with session(20) as tell:
        from ..discover import discover as find

        require_mechanisms(options["exclude"])
        data = read_without(campaign, options["leave_out"], tell)
        parts = {"experiments": not no_experiments, "posterior": not no_posterior}
        origin = provenance("discover", campaign, options | {"held_out": not no_held_out} | parts)
        writers = functools.partial(import_writers, figures=not no_figures, posterior=False)
        with results(out) as stage, beside(writers):
            model = joint_model(options)
            chosen = {name: options[name] for name in ("exclude", "threshold_MPa", "seed")}
            found = find(data, model=model, confirm=not no_held_out, progress=tell, **parts, **chosen)
            content = write_discovery(found, stage, origin=origin, figures=not no_figures, tell=tell)
    if as_json:
        say_json(content)
        return
    say_discovery(content)
    say()
    say_files(out, [*content["figures"], DISCOVERY])


def require_mechanisms(names: tuple[str, ...]) -> None:
    """Refuse to exclude what does not exist, before anything is computed.

    Raises `InputError` naming the mechanisms there are.
    """
    from ..effects import LIBRARY

    for name in names:
        if name not in LIBRARY:
            raise InputError(f"there is no mechanism {name!r}", remedy=f"--exclude takes one of: {', '.join(LIBRARY)}")
    if set(names) >= set(LIBRARY):
        raise InputError("every mechanism is excluded", remedy="Leave one to look for")


def write_discovery(
    found: Discovery, stage: Stage, *, origin: Mapping[str, Any], figures: bool, tell: Tell
) -> dict[str, Any]:
    """Write `discovery.json` and the figures into the stage; see `write_calibration`."""

    def draw() -> Mapping[str, Any]:
        from ..plots import discovery_figures

        return discovery_figures(found)

    names = write_figures(stage, DISCOVERY, draw if figures else None, tell)
    return found.write(stage.folder, figures=names, provenance=dict(origin))


def say_discovery(content: dict[str, Any]) -> None:
    """Print verdict, summary, notes, and the head of the ranking."""
    import textwrap

    say(f"Verdict: {content['verdict']}", bold=True)
    for line in textwrap.wrap(content["summary"], 100, break_on_hyphens=False):
        say(line)
    for text in content["notes"]:
        say(f"Note: {sentence(text)}", fg="yellow")
    if not content["ranking"]:
        return
    say()
    rows = []
    for entry in content["ranking"][:ROWS]:
        unit = "" if entry["unit"] == "-" else f" {entry['unit']}"
        rows.append(
            (
                entry["mechanism"],
                _number(entry["statistic"], ".1f"),
                f"{_number(entry['estimate'], '.3g')}{unit}",
                f"{_number(entry['detection_limit'], '.2g')}{unit}",
                _number(entry["probability"], ".3f"),
            )
        )
    say_table(("mechanism", "statistic", "estimate", "detection limit", "probability"), rows)
    further = len(content["ranking"]) - len(rows)
    say(
        f"Each against the law alone{f'; {further} more in {DISCOVERY}' if further > 0 else ''}. Probability: of the "
        "mechanism, if one is missing."
    )


def _number(value: float | None, form: str) -> str:
    return "unknown" if value is None else format(value, form)


def main_finding(content: dict[str, Any]) -> str:
    """What a discovery found, in one line."""
    verdict = content["verdict"]
    if verdict == "NO_GAP":
        return "nothing is missing in the law that these tests could show"
    if verdict == "FIT_NOT_CONVERGED":
        return "the law cannot be fitted well enough to ask what it lacks"
    if verdict == "UNLISTED":
        return "something is missing that no listed mechanism explains; a formula for it is in discovery.json"
    names = " and ".join(effect["mechanism"].replace("_", " ") for effect in content["effects"])
    sure = "" if verdict == "NAMED" else ", or what these tests cannot tell from it"
    closed = content["gap"]["closed_fraction"]
    gap = "" if closed is None else f"; it closes {100 * closed:.0f} % of the gap on held-out particles"
    return f"missing is {names}{sure}{gap}"
