"""Calibrating for the command line: files, figures and a summary. Imported once the command runs."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

from .._errors import InputError
from ..calibrate import PaperCalibration
from ._output import Stage, json_text
from ._session import Tell, say

RESULT, FIGURES = "calibration.json", "figures"
_FIGURE = re.compile(rf"{FIGURES}/[A-Za-z0-9_-]+\.png")


def write_calibration(calibration: PaperCalibration, stage: Stage, *, figures: bool, tell: Tell) -> dict[str, Any]:
    """Write `calibration.json` and the figures into the stage.

    Figures that an earlier calibration lists as its own, and this one does not draw, become stale.

    Args:
        calibration: what was found.
        stage: where to write.
        figures: whether to draw.
        tell: progress.

    Returns:
        The contents of the file.
    """
    names: list[str] = []
    tell("drawing the figures" if figures else "writing")
    if figures:
        from ..plots import paper_figures, save_figures

        (stage.folder / FIGURES).mkdir()
        saved = save_figures(paper_figures(calibration), stage.folder / FIGURES)
        names = sorted(f"{FIGURES}/{path.name}" for path in saved)
    stage.stale += [name for name in _listed(stage.directory / RESULT) if name not in names]
    content = calibration.to_json() | {"figures": names}
    (stage.folder / RESULT).write_text(json_text(content), encoding="utf-8")
    return content


def _listed(file: Path) -> list[str]:
    """Figures that an earlier result names; what is no such result names none."""
    try:
        listed = json.loads(file.read_text(encoding="utf-8"))["figures"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    names = listed if isinstance(listed, list) else []
    return [name for name in names if isinstance(name, str) and _FIGURE.fullmatch(name)]


def main_numbers(content: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and value of what matters most in a `calibration.json`."""
    modulus = content["effective_modulus_MPa"]["value"]
    rows = [
        ("shape parameter a", _number(content["a"]["value"])),
        ("effective modulus", "unknown (no unloading)" if modulus is None else f"{_number(modulus / 1e3)} GPa"),
    ]
    for name in ("C1", "C3", "C5"):
        rows.append((f"{name}, median", _number(_exp(content[f"log_{name}"]["mean"]["value"]))))
        rows.append((f"{name}, sd of its logarithm", _number(content[f"log_{name}"]["sd"]["value"])))
    rows.append(("yield stress sigma_y", f"{_number(content['yield_stress_MPa']['value'])} MPa"))
    return rows


def _exp(value: float | None) -> float | None:
    return None if value is None or value > 700 else math.exp(value)


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4g}"


def say_state(content: dict[str, Any]) -> None:
    """Print how many particles took part and whether the fit converged."""
    used = sum(entry["kept"] for entry in content["particles"])
    law = content["law"]
    say(
        f"Method {content['method']}: {used} of {len(content['particles'])} particles, a by the "
        f"{content['a_objective']} objective, unloading {law['unloading']}, strain scaling {law['strain_scaling']}; "
        + ("converged." if content["converged"] else "NOT converged.")
    )


def say_warnings(content: dict[str, Any]) -> None:
    """Print what a reader of the numbers must know."""
    for warning in content["warnings"]:
        say(f"Warning: {warning[:1].upper()}{warning[1:].rstrip('.')}.", fg="yellow")
    for entry in content["particles"]:
        if not entry["kept"]:
            say(f"Not used: particle {entry['particle']}: {entry['why_not']}.", fg="yellow")


def say_files(directory: Path, names: list[str]) -> None:
    """Print what was written where; figures are counted, not listed."""
    figures = [name for name in names if name.startswith(f"{FIGURES}/")]
    say(f"Written into {directory}:")
    for name in names:
        if name not in figures:
            say(f"  {name}")
    if figures:
        say(f"  {FIGURES}/ ({len(figures)} png)")


def require_particle(name: str | None, names: tuple[str, ...], source: str) -> None:
    """Refuse a reference particle that is not there, before anything is computed.

    Raises:
        InputError: naming those that are.
    """
    if name is not None and name not in names:
        shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise InputError(
            f"there is no particle {name!r}", file=source or None, remedy=f"--reference takes one of: {shown}"
        )
