"""Calibrating for the command line: files, figures and a summary. Imported once the command runs."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .._errors import InputError
from .._store import Stage
from ..calibrate import BayesCalibration, JointModel, LeastSquaresCalibration, PaperCalibration
from ..calibrate.judgement import MODULUS_OPEN
from ..campaign import Campaign, Finding
from ..files import LIMITS, read_regular
from .figures import FIGURES, write_figures
from .session import Tell, say

RESULT, POSTERIOR = "calibration.json", "posterior.nc"
Calibration = PaperCalibration | LeastSquaresCalibration | BayesCalibration


def write_calibration(
    calibration: Calibration, stage: Stage, *, origin: Mapping[str, Any], figures: bool, tell: Tell
) -> dict[str, Any]:
    """Write `calibration.json`, the figures and, if there is one, the posterior into the stage.

    Figures that an earlier calibration lists as its own, and this one does not draw, become stale.

    Args:
        calibration: what was found.
        stage: where to write.
        origin: data, settings and versions, as `provenance` gives them.
        figures: whether to draw.
        tell: progress.

    Returns:
        The contents of the file.
    """
    draw = functools.partial(_save, calibration) if figures else None
    names = write_figures(stage, RESULT, draw, tell)
    files = []
    if isinstance(calibration, BayesCalibration):
        from ..calibrate import write_posterior

        tell("writing the posterior")
        write_posterior(calibration, stage.folder / POSTERIOR)
        files = [POSTERIOR]
    elif _is_ours(stage.directory / RESULT):
        stage.stale.append(POSTERIOR)  # of an earlier run: it would contradict what lies beside it now
    return calibration.write(stage.folder, figures=names, files=files, provenance=dict(origin))


def _save(calibration: Calibration, folder: Path) -> list[Path]:
    from ..plots import least_squares_figures, paper_figures, posterior_figures, save_figures

    if isinstance(calibration, BayesCalibration):
        return save_figures(posterior_figures(calibration), folder)
    if isinstance(calibration, LeastSquaresCalibration):
        return save_figures(least_squares_figures(calibration), folder)
    return save_figures(paper_figures(calibration), folder)


def joint_model(
    unloading: str, strain_scaling: str, modulus_scatter: bool, shape_scatter: bool, priors: Path | None
) -> JointModel:
    """The model that the options describe.

    Raises:
        InputError: for a file of priors that cannot be used.
    """
    from ..calibrate import read_priors
    from ..law import StrainScaling, Unloading

    form = Unloading(unloading)
    priors_given = None if priors is None else read_priors(priors, form)
    return JointModel(form, StrainScaling(strain_scaling), modulus_scatter, shape_scatter, priors_given)


def _is_ours(file: Path) -> bool:
    """Whether an earlier result says that it wrote a posterior beside it."""
    try:
        return POSTERIOR in json.loads(read_regular(file, LIMITS.result_bytes, ""))["files"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return False


def main_numbers(content: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and value of what matters most in a `calibration.json`."""
    modulus = content["effective_modulus_MPa"]
    rows = [
        ("shape parameter a", _estimate(content["a"])),
        (
            "effective modulus",
            "unknown" if modulus["value"] is None or _modulus_open(content) else f"{_estimate(modulus, 1e-3)} GPa",
        ),
    ]
    for name in ("C1", "C3", "C5"):
        mean = content[f"log_{name}"]["mean"]
        median = _exp(mean["value"])
        spread = None if mean["sd"] is None or median is None else median * mean["sd"]
        rows.append((f"{name}, median", _estimate({"value": median, "sd": spread})))
        rows.append((f"{name}, sd of its logarithm", _estimate(content[f"log_{name}"]["sd"])))
    rows.append(("yield stress sigma_y", f"{_estimate(content['yield_stress_MPa'])} MPa"))
    return rows


def _modulus_open(content: dict[str, Any]) -> bool:
    return any(one["check"] == MODULUS_OPEN for one in content.get("findings", []))


def _estimate(estimate: dict[str, Any], factor: float = 1.0) -> str:
    """A value with its standard deviation, which decides the digits of both."""
    value, sd = estimate["value"], estimate["sd"]
    if value is None or sd is None or not sd > 0:
        return _number(None if value is None else value * factor)
    value, sd = value * factor, sd * factor
    digits = max(0, 1 - math.floor(math.log10(sd)))
    if digits > 6 or abs(value) >= 1e6:
        return f"{value:.4g} +- {sd:.2g}"
    return f"{value:.{digits}f} +- {sd:.{digits}f}"


def _exp(value: float | None) -> float | None:
    return None if value is None or value > 700 else math.exp(value)


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4g}"


def left_out(campaign: Campaign, names: tuple[str, ...]) -> Campaign:
    """The campaign without the particles of `--leave-out`.

    Raises:
        InputError: for a name that is not there, or if none is left.
    """
    for name in names:
        require_particle(name, campaign.particles, campaign.source, option="--leave-out")
    return campaign.without(*names) if names else campaign


def say_state(content: dict[str, Any]) -> None:
    """Print how many particles took part, whether the fit converged, and whether its numbers can be true."""
    used = sum(entry["kept"] for entry in content["particles"])
    law = content["law"]
    say(
        f"Method {content['method']}: {used} of {len(content['particles'])} particles, "
        + (f"a by the {content['a_objective']} objective, " if "a_objective" in content else "")
        + f"unloading {law['unloading']}, strain scaling {law['strain_scaling']}; "
        + _state(content)
    )


def _state(content: dict[str, Any]) -> str:
    if not content["converged"]:
        return "NOT converged."
    bad = any(one["level"] == "bad" for one in content["findings"])
    return "the optimisers converged, but NOT TO BE TRUSTED: see below." if bad else "converged."


def say_warnings(content: dict[str, Any]) -> None:
    """Print what a reader of the numbers must know."""
    bad = {str(Finding.from_json(one)) for one in content["findings"] if one["level"] == "bad"}
    for warning in sorted(content["warnings"], key=lambda text: text not in bad):
        colour = "red" if warning in bad else "yellow"
        say(f"Warning: {warning[:1].upper()}{warning[1:].rstrip('.')}.", fg=colour, bold=warning in bad)
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


def require_particle(name: str | None, names: tuple[str, ...], source: str, *, option: str = "--reference") -> None:
    """Refuse a particle that is not there, before anything is computed.

    Raises:
        InputError: naming those that are.
    """
    if name is not None and name not in names:
        shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise InputError(
            f"there is no particle {name!r}", file=source or None, remedy=f"{option} takes one of: {shown}"
        )
