"""What a command does around its work: precision, progress, printing."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import stat
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any

import click

from .._errors import InputError

Tell = Callable[[str], None]
PROGRAM = "mcc-jax"
DONE, DEFECT, BAD_INPUT, NOT_CONVERGED, INTERRUPTED = 0, 1, 2, 3, 130


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
        _keep_compiled(jax.config)
        require_device()
        yield tell


def require_device() -> None:
    """Start JAX on the device that it was told to use. Raises `InputError` if there is none of that kind."""
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # of a platform that is not installed it says either
        asked = os.environ.get("JAX_PLATFORMS") or jax.config.read("jax_platforms") or "the default"
        why = " ".join(str(error).split()).split(" (set JAX_PLATFORMS")[0][:160]  # its hint is in the remedy
        raise InputError(
            f"JAX finds no device for JAX_PLATFORMS={asked}" + (f" ({why})" if why else ""),
            remedy="Unset JAX_PLATFORMS to compute on the processor, or install JAX for your accelerator",
        ) from None


CACHE_BYTES = 300 * 2**20
"""At most so much of the disk is used for compiled functions; the oldest make room."""


def _keep_compiled(config: Any) -> None:
    """Let the next process find what this one compiles, in the user's folder for caches.

    A setting of one's own (JAX_COMPILATION_CACHE_DIR, JAX_ENABLE_COMPILATION_CACHE=0) has precedence. Compiled code
    belongs to one machine: where several share a home, each has a folder. It is code that will be run, so nobody else
    may be able to write it: a folder that is not ours alone is made so, or left where it cannot be.
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
    """Whether a folder is there, no link, ours, and open to nobody else; made so where it can be."""
    try:
        for one in (*reversed(folder.parents), folder):  # mkdir(parents=True) would leave those above to the umask
            one.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if not stat.S_ISDIR(found.st_mode):
            return False
        if hasattr(os, "geteuid") and found.st_uid != os.geteuid():
            return False
        if os.name == "posix" and stat.S_IMODE(found.st_mode) != 0o700:
            if stat.S_IMODE(found.st_mode) & 0o022:
                # Others could write here until now, so what lies here may be theirs.
                shutil.rmtree(folder)
                folder.mkdir(mode=0o700)
            folder.chmod(0o700)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


def import_writers(*, figures: bool, posterior: bool) -> None:
    """Import what draws and what writes posteriors: seconds of Python, beside compilers that leave it a core."""
    if figures:
        from .. import plots  # noqa: F401
    if posterior:
        import arviz  # noqa: F401


@contextlib.contextmanager
def beside[R](work: Callable[[], R]) -> Iterator[Callable[[], R]]:
    """Let work go on in a thread of its own while the block runs.

    The block ends when the work has ended, too: an interpreter that ends under a compiler or an import may crash. Only
    an interrupt does not wait, since nothing of the work is kept and the process ends at once.

    Yields:
        A function that waits for the work and returns its result, or raises what it raised. Work of which nobody
        asks for the result may fail unnoticed.
    """
    future: Future[R] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:  # whatever it is, it is raised where the result is asked for
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    try:
        yield future.result
    except Exception:
        wait([future])
        raise
    wait([future])


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
