"""What commands do around their work: precision, progress, the campaign, the model, figures, files, printing."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._errors import InputError
from .._store import Stage, json_text
from ..files import RESULT_BYTES, read_regular

if TYPE_CHECKING:
    from .._types import Progress
    from ..calibrate import Model
    from ..campaign import Campaign

PROGRAM = "mcc-jax"
DONE, DEFECT, BAD_INPUT, NOT_CONVERGED, INTERRUPTED = 0, 1, 2, 3, 130
FIGURES = "figures"
OWN_FILES = re.compile(rf"{FIGURES}/[A-Za-z0-9_-]+\.png|posterior\.nc|calibration\.msgpack")
PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "numpyro", "arviz", "numpy", "scipy")


@contextlib.contextmanager
def session() -> Iterator[Progress]:
    """Double precision, and progress on standard error: the present step on a terminal, a line for each elsewhere.

    Yields a function to be called with the name of each step as it begins.
    """
    with _progress() as progress:
        progress("loading the library")
        for noisy in ("jax", "matplotlib"):  # hints about accelerators and caches are not for a pipe
            logging.getLogger(noisy).setLevel(logging.ERROR)
        import jax

        jax.config.update("jax_enable_x64", True)
        _keep_compiled(jax.config)
        try:
            jax.devices()
        except (RuntimeError, AssertionError) as error:  # of a platform that is not installed it says either
            asked = os.environ.get("JAX_PLATFORMS") or jax.config.read("jax_platforms") or "the default"
            why = " ".join(str(error).split()).split(" (set JAX_PLATFORMS")[0][:160]  # its hint is in the remedy
            problem = f"JAX finds no device for JAX_PLATFORMS={asked}" + (f" ({why})" if why else "")
            remedy = "Unset JAX_PLATFORMS to compute on the processor, or install JAX for your accelerator"
            raise InputError(problem, remedy=remedy) from None
        yield progress


CACHE_BYTES = 300 * 2**20  # most disk used for compiled functions; the oldest are removed


def _keep_compiled(config: Any) -> None:
    """Let the next process find what this one compiles, in the user's folder for caches, one for each machine.

    JAX_COMPILATION_CACHE_DIR and JAX_ENABLE_COMPILATION_CACHE=0 have precedence. What is there will be run, so a folder
    that others could write to is not used.
    """
    if config.jax_compilation_cache_dir is not None or not config.jax_enable_compilation_cache:
        return
    import platform

    import platformdirs

    above = platformdirs.user_cache_path("mcc_jax")
    folder = above / f"{platform.node()}-{platform.machine()}"
    if _private(above) and _private(folder):
        config.update("jax_compilation_cache_dir", str(folder))
        config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
        config.update("jax_persistent_cache_min_entry_size_bytes", 0)
        config.update("jax_compilation_cache_max_size", CACHE_BYTES)


def _private(folder: Path) -> bool:
    """Whether a folder, made where it is missing, is no link, ours, and nobody else may write to it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return False
    ours = os.name != "posix" or (found.st_uid == os.geteuid() and not found.st_mode & 0o022)
    return ours and stat.S_ISDIR(found.st_mode) and os.access(folder, os.W_OK)


@contextlib.contextmanager
def _progress() -> Iterator[Progress]:
    if sys.stderr is None:
        yield lambda _: None
        return
    if not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        with _logged(sys.stderr) as progress:
            yield progress
        return
    from rich.console import Console
    from rich.text import Text

    with Console(stderr=True).status("") as status:
        yield lambda step: status.update(Text(step))  # a text has no markup


QUIET_S = 2.0
"""Without a terminal, a command that works no longer than this after the library is loaded reports no progress."""


@contextlib.contextmanager
def _logged(stream: Any) -> Iterator[Progress]:
    """Write a line for each step as it begins, with the seconds since the command began.

    Lines are held back for `QUIET_S`, counted from the second step, so that bad input is answered by its error alone.
    """
    began, lines, lock = time.monotonic(), list[str](), threading.Lock()

    def write() -> None:
        with lock, contextlib.suppress(OSError):  # a reader that is gone does not end the work
            stream.write("".join(lines))
            lines.clear()
            stream.flush()

    timer = threading.Timer(QUIET_S, write)
    timer.daemon = True

    def progress(step: str) -> None:
        with lock:
            lines.append(f"{PROGRAM}: {time.monotonic() - began:6.1f} s  {step}\n")
        if timer.finished.is_set():  # it has written once
            write()
        elif len(lines) == 2 and timer.ident is None:
            timer.start()

    try:
        yield progress
        if timer.finished.is_set():
            progress("done")
    finally:
        timer.cancel()
        if timer.ident is not None:
            timer.join()


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


def read_without(folder: Path, left_out: tuple[str, ...], progress: Progress) -> Campaign:
    """The campaign in a folder without the particles of `--leave-out`."""
    from ..campaign import read_campaign

    progress("reading the campaign")
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
    """The model that `--unloading`, `--strain-scaling` and `--priors` describe."""
    from ..calibrate import Model, read_priors
    from ..law import StrainScaling, Unloading

    form = Unloading(options["unloading"])
    priors = None if options["priors"] is None else read_priors(options["priors"], form)
    return Model(form, StrainScaling(options["strain_scaling"]), modulus_scatter, shape_scatter, priors)


def provenance(
    command: str, campaign: Path, settings: Mapping[str, Any], *, folder: str | None = None
) -> dict[str, Any]:
    """Folder (absolute, or as `folder`) and checksums of the campaign, settings in force, versions of packages."""
    import platform
    from importlib.metadata import version

    from .._version import __version__
    from ..campaign import file_checksums

    settings = {
        name: value.name if isinstance(value, Path) else list(value) if isinstance(value, tuple) else value
        for name, value in settings.items()
    }
    versions = {"mcc_jax": __version__, "python": platform.python_version(), **{n: version(n) for n in PACKAGES}}
    return {
        "campaign": {"folder": folder or str(campaign.resolve()), "sha256": file_checksums(campaign)},
        "settings": {"command": command, **settings},
        "versions": versions,
    }


def drop_earlier(stage: Stage, result: str, names: Sequence[str]) -> None:
    """Files that an earlier `result` lists as its own become stale, but for those that this run writes."""
    with contextlib.suppress(ValueError, AttributeError, TypeError, RecursionError):  # there is none, or it is damaged
        earlier = json.loads(read_regular(stage.directory / result, RESULT_BYTES, ""))
        listed = [name for key in ("figures", "files") for name in earlier.get(key, ())]
        own = [name for name in listed if isinstance(name, str) and OWN_FILES.fullmatch(name)]
        stage.stale += [name for name in own if name not in names]


def write_figures(stage: Stage, draw: Callable[[], Mapping[str, Any]] | None, progress: Progress) -> list[str]:
    """Draw into the stage, unless `draw` is None; the figures' names."""
    progress("writing" if draw is None else "drawing the figures")
    if draw is None:
        return []
    from ..plots import save_figures

    (stage.folder / FIGURES).mkdir(exist_ok=True)
    return sorted(f"{FIGURES}/{path.name}" for path in save_figures(draw(), stage.folder / FIGURES))


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
