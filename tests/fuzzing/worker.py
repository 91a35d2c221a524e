"""The process that reads damaged files. It may hang or die: the parent sees in a shared file where it was."""

from __future__ import annotations

import faulthandler
import importlib
import json
import os
import resource
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

MEMORY = 1 << 30
COLUMNS = ("inputs", "refused", "read", "failures", "slowest_ms", "peak_MiB", "seconds")
# Before the table: the reader's place, the number of the input, and when it began.
HEAD = 3
Part = tuple[str, int, int]
KEPT = 3
"""So many inputs that fail alike are kept."""


def progress_of(file: Path, readers: int, mode: Any) -> tuple[np.ndarray, np.ndarray]:
    """Where the worker is, and the table so far; both live in the file."""
    shared = np.memmap(file, np.float64, mode, shape=(HEAD + readers * len(COLUMNS),))
    return shared[:HEAD], shared[HEAD:].reshape(readers, len(COLUMNS))


def case_of(reader: Any, seed: int, number: int) -> dict[str, bytes]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zipfile finds names that stand there twice worth a warning
        return reader.damage(Random(f"{seed}/{reader.name}/{number}"), reader.whole)


def keep(out: Path, reader: Any, seed: int, number: int, kind: str, text: str) -> None:
    """Save an input that failed, unless some like it are there."""
    like = out / reader.name.replace(" ", "_") / kind
    folder = like / str(number)
    if like.exists() and len(list(like.iterdir())) >= KEPT:
        return
    for name, content in case_of(reader, seed, number).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    again = f"python -m tests.fuzzing --only {reader.name!r} --seed {seed} --first {number} --inputs 1"
    (folder / "failure.txt").write_text(f"{again}\n\n{text}", encoding="utf-8", errors="backslashreplace")


def outcome(reader: Any, folder: Path) -> tuple[str, str]:
    """How reading ends: refused, read, or a kind of failure with its text."""
    from mcc_jax import InputError

    before = _listing(folder)
    try:
        reader.read(folder)
    except InputError as error:
        if not str(error) or not str(error).isprintable():
            return "message", f"the message is not one printable line: {str(error)!r}"
    except (Exception, SystemExit) as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        own = [f for f in traceback.extract_tb(error.__traceback__) if "mcc_jax/" in f.filename] or [place]
        return f"{type(error).__name__}-{Path(own[-1].filename).name}-{own[-1].lineno}", traceback.format_exc()
    else:
        return ("read", "") if _listing(folder) == before else ("left", f"left behind: {_listing(folder)}")
    return ("refused", "") if _listing(folder) == before else ("left", f"left behind: {_listing(folder)}")


def _listing(folder: Path) -> tuple[list[str], list[str]]:
    return sorted(p.name for p in folder.iterdir()), sorted(p.name for p in folder.parent.iterdir())


def _address_space(status: int) -> int:
    return int(os.pread(status, 64, 0).split()[0]) * resource.getpagesize()


def _limit_memory(size: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (size, resource.RLIM_INFINITY))


def _peak_MiB() -> float:
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def work(*, module: str, plan: Sequence[Part], seed: int, out: str, shared: str, seconds: float) -> None:
    """Go through the plan: reader, first number, number behind the last."""
    readers = {reader.name: (i, reader) for i, reader in enumerate(importlib.import_module(module).READERS)}
    here, table = progress_of(Path(shared), len(readers), "r+")
    folder = Path(shared).parent / "work" / "case"
    with Path("/proc/self/statm").open("rb", buffering=0) as statm:
        for name, first, stop in plan:
            place, reader = readers[name]
            # Undamaged first: importing and compiling are not what is timed.
            _write(reader.whole, folder)
            if (found := outcome(reader, folder))[0] != "read":
                raise RuntimeError(f"{name} does not read its own sample: {found}")
            # From here on the peak is that of this reader.
            Path("/proc/self/clear_refs").write_text("5")
            for number in range(first, stop):
                case = case_of(reader, seed, number)
                _write(case, folder)
                _limit_memory(_address_space(statm.fileno()) + MEMORY)
                here[:] = place, number, time.monotonic()
                kind, text = outcome(reader, folder)
                took = time.monotonic() - here[2]
                here[2] = np.inf
                _limit_memory(resource.RLIM_INFINITY)
                if took > seconds and kind in ("read", "refused"):
                    kind, text = "slow", f"took {took:.1f} s"
                row = table[place]
                row[0] += 1
                row[("refused", "read").index(kind) + 1 if kind in ("refused", "read") else 3] += 1
                row[4] = max(row[4], 1e3 * took)
                row[6] += took
                if kind not in ("refused", "read"):
                    keep(Path(out), reader, seed, number, kind, text)
                if number % 64 == 0 or number == stop - 1:
                    row[5] = max(row[5], _peak_MiB())


def _write(case: dict[str, bytes], folder: Path) -> None:
    shutil.rmtree(folder.parent, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, content in case.items():
        if "/" in name:
            (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)


if __name__ == "__main__":
    faulthandler.enable()
    faulthandler.register(signal.SIGUSR1, all_threads=False)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    warnings.simplefilter("error")
    settings = json.loads(sys.argv[1])
    if settings.pop("double"):
        import jax

        jax.config.update("jax_enable_x64", True)
    work(**settings)
