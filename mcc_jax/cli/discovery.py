"""Discovery for the command line: file, figures and a summary. Imported once the command runs."""

from __future__ import annotations

import functools
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .._errors import InputError
from .._store import Stage
from ..discover import Discovery
from ..effects import LIBRARY
from .figures import write_figures
from .session import Tell, say, say_table

DISCOVERY = "discovery.json"
ROWS = 6
"""So many mechanisms stand in the table; the file has all."""


def require_mechanisms(names: tuple[str, ...]) -> None:
    """Refuse to exclude what does not exist, before anything is computed.

    Raises:
        InputError: naming the mechanisms there are.
    """
    for name in names:
        if name not in LIBRARY:
            raise InputError(f"there is no mechanism {name!r}", remedy=f"--exclude takes one of: {', '.join(LIBRARY)}")
    if set(names) >= set(LIBRARY):
        raise InputError("every mechanism is excluded", remedy="Leave one to look for")


def write_discovery(
    found: Discovery, stage: Stage, *, origin: Mapping[str, Any], figures: bool, tell: Tell
) -> dict[str, Any]:
    """Write `discovery.json` and the figures into the stage.

    Figures that an earlier discovery lists as its own, and this one does not draw, become stale.

    Args:
        found: the answer.
        stage: where to write.
        origin: data, settings and versions, as `provenance` gives them.
        figures: whether to draw.
        tell: progress.

    Returns:
        The contents of the file.
    """
    draw = functools.partial(_save, found) if figures else None
    figures_drawn = write_figures(stage, DISCOVERY, draw, tell)
    return found.write(stage.folder, figures=figures_drawn, provenance=dict(origin))


def _save(found: Discovery, folder: Path) -> list[Path]:
    from ..plots import discovery_figures, save_figures

    return save_figures(discovery_figures(found), folder)


def say_discovery(content: dict[str, Any]) -> None:
    """Print verdict, summary, notes, and the head of the ranking."""
    say(f"Verdict: {content['verdict']}", bold=True)
    for line in textwrap.wrap(content["summary"], 100, break_on_hyphens=False):
        say(line)
    for text in content["notes"]:
        say(f"Note: {text[:1].upper()}{text[1:].rstrip('.')}.", fg="yellow")
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
