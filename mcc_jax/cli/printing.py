"""What commands print: lines, tables, results, and what to run next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .._store import json_text
from .session import FIGURES


def say(text: str = "", **style: Any) -> None:
    """Print a line on standard output; colours go to terminals only."""
    click.secho(text, **style)


def say_table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """Print a small table, the first column to the left and the others to the right."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]

    def line(row: tuple[str, ...]) -> str:
        first, *others = zip(row, widths, strict=True)
        return "  ".join(["", first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)]).rstrip()

    say(line(header), bold=True)
    for row in rows:
        say(line(row))


def say_json(content: dict[str, Any]) -> None:
    """Print a result as it is in its file: JSON is UTF-8, whatever the terminal's encoding."""
    click.echo(json_text(content).encode(), nl=False)


def say_files(directory: Path, names: list[str]) -> None:
    """Print what was written where; figures are counted, not listed."""
    figures = [name for name in names if name.startswith(f"{FIGURES}/")]
    say(f"Written into {directory}:")
    for name in (name for name in names if name not in figures):
        say(f"  {name}")
    if figures:
        say(f"  {FIGURES}/ ({len(figures)} png)")


def say_next(*steps: tuple[str, str]) -> None:
    """Print what to run next: a command and what it is for each; a step without a command is left out."""
    for place, (command, purpose) in enumerate(step for step in steps if step[0]):
        say(f"{'Next:' if place == 0 else '     '} {command}", nl=False)
        say(f"   # {purpose}", dim=True)


def sentence(text: str) -> str:
    """A text as a sentence: a capital at its beginning, one full stop at its end."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."
