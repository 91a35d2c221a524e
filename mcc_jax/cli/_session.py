"""What a command does around its work: precision, progress, printing."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any

import click

Tell = Callable[[str], None]


@contextlib.contextmanager
def session(steps: int) -> Iterator[Tell]:
    """Double precision, and progress on standard error if that is a terminal.

    Args:
        steps: how many times the command will call the function it gets.

    Yields:
        A function that is called with the name of each step as it begins.
    """
    with _progress(steps) as tell:
        tell("loading the library")
        for noisy in ("jax", "matplotlib"):  # hints about accelerators and caches are not for a pipe
            logging.getLogger(noisy).setLevel(logging.ERROR)
        import jax

        jax.config.update("jax_enable_x64", True)
        yield tell


@contextlib.contextmanager
def _progress(steps: int) -> Iterator[Tell]:
    if sys.stderr is None or not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(24), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False) as bar:
        task = bar.add_task("", total=steps + 1, completed=-1)
        yield lambda step: bar.update(task, description=step, advance=1)


def say(text: str = "", **style: Any) -> None:
    """Print a line on standard output; colours go to terminals only."""
    click.secho(text, **style)


def say_table(header: tuple[str, ...], rows: list[tuple[str, ...]], *, text_columns: int = 1) -> None:
    """Print a small table, the first `text_columns` columns to the left and the others to the right."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]

    def line(row: tuple[str, ...]) -> str:
        cells = (
            c.ljust(w) if i < text_columns else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))
        )
        return ("  " + "  ".join(cells)).rstrip()

    say(line(header), bold=True)
    for row in rows:
        say(line(row))
