"""Figures and the result file that names them. Imported once a command runs."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .._store import Stage, json_text
from ..files import LIMITS, read_regular
from .session import Tell

FIGURES = "figures"
_FIGURE = re.compile(rf"{FIGURES}/[A-Za-z0-9_-]+\.png")


def write_figures(stage: Stage, result: str, draw: Callable[[Path], list[Path]] | None, tell: Tell) -> list[str]:
    """Draw into the stage.

    Figures that an earlier result lists as its own, and this run does not draw, become stale.

    Args:
        stage: where to write.
        result: name of the file that will name the figures.
        draw: saves figures in the folder it gets and returns their files; None for no figures.
        tell: progress.

    Returns:
        Names of the figures, relative to the stage.
    """
    names: list[str] = []
    tell("writing" if draw is None else "drawing the figures")
    if draw is not None:
        (stage.folder / FIGURES).mkdir(exist_ok=True)
        names = sorted(f"{FIGURES}/{path.name}" for path in draw(stage.folder / FIGURES))
    stage.stale += [name for name in _earlier(stage.directory / result) if name not in names]
    return names


def _earlier(file: Path) -> list[str]:
    """Figures that an earlier result names; what is no such result names none."""
    try:
        listed = json.loads(read_regular(file, LIMITS.result_bytes, ""))["figures"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return []
    names = listed if isinstance(listed, list) else []
    return [name for name in names if isinstance(name, str) and _FIGURE.fullmatch(name)]


def write_result(stage: Stage, result: str, content: dict[str, Any]) -> None:
    """Write a result file into the stage."""
    (stage.folder / result).write_text(json_text(content), encoding="utf-8")
