"""What commands share once they run: the campaign, the model, figures, files, and where a result comes from."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._errors import InputError
from .._store import Stage, json_text
from ..files import LIMITS, read_regular
from .session import Tell, say

if TYPE_CHECKING:
    from ..calibrate import Model
    from ..campaign import Campaign

FIGURES = "figures"
PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "numpyro", "arviz", "numpy", "scipy")


def read_without(folder: Path, left_out: tuple[str, ...], tell: Tell) -> Campaign:
    """The campaign in a folder without the particles of `--leave-out`.

    Raises `InputError` if it cannot be read, for a name that is not there, or if none is left.
    """
    from ..campaign import read_campaign

    tell("reading the campaign")
    campaign = read_campaign(folder)
    for name in left_out:
        require_particle(name, campaign, "--leave-out")
    return campaign.without(*left_out) if left_out else campaign


def require_particle(name: str, campaign: Campaign, option: str) -> None:
    """Refuse a particle that is not there, before anything is computed. Raises `InputError` naming those that are."""
    names = campaign.particles
    if name not in names:
        remedy = f"{option} takes one of: {', '.join(names[:12])}{', ...' if len(names) > 12 else ''}"
        raise InputError(f"there is no particle {name!r}", file=campaign.source or None, remedy=remedy)


def joint_model(options: Mapping[str, Any], *, modulus_scatter: bool = True, shape_scatter: bool = False) -> Model:
    """The model that `--unloading`, `--strain-scaling` and `--priors` describe.

    Raises `InputError` for a file of priors that cannot be used.
    """
    from ..calibrate import Model, read_priors
    from ..law import StrainScaling, Unloading

    form = Unloading(options["unloading"])
    priors = None if options["priors"] is None else read_priors(options["priors"], form)
    return Model(form, StrainScaling(options["strain_scaling"]), modulus_scatter, shape_scatter, priors)


def provenance(command: str, campaign: Path, settings: Mapping[str, Any], *, told: str | None = None) -> dict[str, Any]:
    """Folder and checksums of the campaign, settings of the command, versions of what computed.

    Args:
        command: the command's name.
        campaign: the folder that was read.
        settings: the options in force, by name.
        told: the folder as the result shall name it; the absolute path if None.
    """
    import platform
    from importlib.metadata import version

    from .._version import own_version
    from ..campaign import file_checksums

    def plain(value: Any) -> Any:
        return value.name if isinstance(value, Path) else list(value) if isinstance(value, tuple) else value

    versions = {"mcc_jax": own_version(), "python": platform.python_version(), **{n: version(n) for n in PACKAGES}}
    return {
        "campaign": {"folder": told or str(campaign.resolve()), "sha256": file_checksums(campaign)},
        "settings": {"command": command} | {name: plain(value) for name, value in settings.items()},
        "versions": versions,
    }


def listed(result: Path, key: str, pattern: str) -> list[str]:
    """Files that an earlier result names as its own; what is no such result names none."""
    names: Any = None
    with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError):
        names = json.loads(read_regular(result, LIMITS.result_bytes, ""))[key]
    return [n for n in names if isinstance(n, str) and re.fullmatch(pattern, n)] if isinstance(names, list) else []


def write_figures(stage: Stage, result: str, draw: Callable[[], Mapping[str, Any]] | None, tell: Tell) -> list[str]:
    """Draw into the stage; figures that an earlier result lists as its own, and this run does not draw, become stale.

    Args:
        stage: where to write.
        result: name of the file that will name the figures.
        draw: makes the figures; None for no figures.
        tell: progress.

    Returns:
        Names of the figures, relative to the stage.
    """
    names: list[str] = []
    tell("writing" if draw is None else "drawing the figures")
    if draw is not None:
        from ..plots import save_figures

        (stage.folder / FIGURES).mkdir(exist_ok=True)
        names = sorted(f"{FIGURES}/{path.name}" for path in save_figures(draw(), stage.folder / FIGURES))
    earlier = listed(stage.directory / result, "figures", rf"{FIGURES}/[A-Za-z0-9_-]+\.png")
    stage.stale += [name for name in earlier if name not in names]
    return names


def write_result(stage: Stage, result: str, content: dict[str, Any]) -> None:
    """Write a result file into the stage."""
    (stage.folder / result).write_text(json_text(content), encoding="utf-8")


def say_json(content: dict[str, Any]) -> None:
    """Print a result as it stands in its file: JSON is UTF-8, whatever the terminal speaks."""
    click.echo(json_text(content).encode(), nl=False)


def say_files(directory: Path, names: list[str]) -> None:
    """Print what was written where; figures are counted, not listed."""
    figures = [name for name in names if name.startswith(f"{FIGURES}/")]
    say(f"Written into {directory}:")
    for name in names:
        if name not in figures:
            say(f"  {name}")
    if figures:
        say(f"  {FIGURES}/ ({len(figures)} png)")


def sentence(text: str) -> str:
    """A text as a sentence: a capital at its beginning, one full stop at its end."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."
