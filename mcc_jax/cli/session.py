"""What commands do around their work: precision, progress, the campaign, the model, the files of a result."""

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
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._errors import InputError
from .._extras import extra
from .._store import Stage
from ..files import RESULT_BYTES, read_regular

if TYPE_CHECKING:
    from .._types import Progress
    from ..calibrate import LeastSquares, Model, PaperCalibration, Posterior
    from ..campaign import Campaign
    from ..discovery import Discovery

    type Calibration = PaperCalibration | LeastSquares | Posterior

PROGRAM = "mcc-jax"
DONE, DEFECT, BAD_INPUT, NOT_CONVERGED, INTERRUPTED = 0, 1, 2, 3, 130
FIGURES, POSTERIOR = "figures", "posterior.nc"
OWN_FILES = re.compile(rf"{FIGURES}/[A-Za-z0-9_-]+\.png|posterior\.nc|calibration\.msgpack")
PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "numpyro", "arviz", "numpy", "scipy")


@contextlib.contextmanager
def session() -> Iterator[Progress]:
    """Double precision, and progress on standard error: a function to be called with each step as it begins."""
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
    """Let the next process find what this one compiles, in the user's folder for caches, one for each machine, but if
    others could write to it, since what is there will be run. JAX's own settings have precedence."""
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
    """Write a line for each step as it begins, with the seconds since the command began; held back for `QUIET_S`,
    counted from the second step, so that bad input is answered by its error alone."""
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


def read_without(folder: Path, left_out: tuple[str, ...], progress: Progress) -> Campaign:
    """The campaign in a folder without the particles of `--leave-out`."""
    from ..campaign import read_campaign

    progress("reading the campaign")
    campaign = read_campaign(folder)
    return campaign.without(*left_out) if left_out else campaign


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

    settings = {name: value.name if isinstance(value, Path) else value for name, value in settings.items()}
    versions = {"mcc_jax": __version__, "python": platform.python_version(), **{n: version(n) for n in PACKAGES}}
    return {
        "campaign": {"folder": folder or str(campaign.resolve()), "sha256": file_checksums(campaign)},
        "settings": {"command": command, **settings},
        "versions": versions,
    }


def write_result(
    result: Calibration | Discovery, stage: Stage, *, origin: Mapping[str, Any], figures: bool, progress: Progress
) -> dict[str, Any]:
    """Write a calibration or a discovery, its figures and its posterior, if it is one; the contents of the JSON."""
    from ..calibrate import Posterior

    progress("drawing the figures" if figures else "writing")
    names = _write_figures(result, stage) if figures else []
    files = [result.archive_file]
    if isinstance(result, Posterior):
        progress("writing the posterior")
        with extra("netcdf"):
            import h5netcdf  # noqa: F401
            import h5py  # noqa: F401
        result.to_arviz(seed=result.seed).to_netcdf(stage.folder / POSTERIOR, engine="h5netcdf")
        files.append(POSTERIOR)
    # Files that an earlier result lists as its own become stale, but for those that this run writes.
    with contextlib.suppress(ValueError, AttributeError, TypeError, RecursionError):  # there is none, or it is damaged
        earlier = json.loads(read_regular(stage.directory / result.content_file, RESULT_BYTES, ""))
        listed = [name for key in ("figures", "files") for name in earlier.get(key, ())]
        own = [name for name in listed if isinstance(name, str) and OWN_FILES.fullmatch(name)]
        stage.stale += [name for name in own if name not in (*names, *files)]
    return result.write(stage.folder, figures=names, files=files, provenance=dict(origin))


def _write_figures(result: Any, stage: Stage) -> list[str]:
    from .. import plots

    draw = {
        "PaperCalibration": plots.paper_figures,
        "LeastSquares": plots.least_squares_figures,
        "Posterior": plots.posterior_figures,
        "Discovery": plots.discovery_figures,
    }[type(result).__name__]
    (stage.folder / FIGURES).mkdir(exist_ok=True)
    return sorted(f"{FIGURES}/{path.name}" for path in plots.save_figures(draw(result), stage.folder / FIGURES))
