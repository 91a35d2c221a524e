"""Starts workers, watches them, and goes on behind an input that hung or killed one."""

from __future__ import annotations

import contextlib
import importlib
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from worker import COLUMNS, Part, keep, progress_of

SECONDS = 5.0
POLL_S = 0.05
IN_MEMORY = Path("/dev/shm")


@dataclass(frozen=True)
class Watched:
    """One run: which readers, with which inputs, and where failures go."""

    module: str
    plan: tuple[Part, ...]
    seed: int
    out: Path
    seconds: float = SECONDS
    double: bool = True


def shares(module: str, inputs: int, first: int = 0, only: Sequence[str] = ()) -> tuple[Part, ...]:
    """The inputs dealt out to the readers, at least one to each."""
    readers = [r for r in importlib.import_module(module).READERS if not only or r.name in only]
    whole = sum(r.share for r in readers)
    return tuple((r.name, first, first + max(1, round(inputs * r.share / whole))) for r in readers)


def run(run: Watched) -> dict[str, dict[str, float]]:
    """The table: for every reader of the plan the counts, the slowest input and the peak of memory.

    Hangs and deaths of the process count as failures of the input that it was reading.
    """
    readers = importlib.import_module(run.module).READERS
    plan = list(run.plan)
    with tempfile.TemporaryDirectory(dir=IN_MEMORY if IN_MEMORY.is_dir() else None) as folder:
        shared = Path(folder) / "progress"
        here, table = progress_of(shared, len(readers), "w+")
        while plan:
            here[:] = -1, -1, np.inf
            try:
                kind, text = _one_worker(run, plan, shared, here)
            except KeyboardInterrupt:  # the table so far is worth printing
                break
            if kind is None:
                break
            place, number = int(here[0]), int(here[1])
            if np.isinf(here[2]):
                raise RuntimeError(f"the worker broke between two inputs ({kind}):\n{text}")
            reader = readers[place]
            keep(run.out, reader, run.seed, number, kind, text)
            table[place][0] += 1
            table[place][3] += 1
            table[place][4] = max(table[place][4], 1e3 * run.seconds if kind == "hang" else 0.0)
            plan = _behind(plan, reader.name, number)
        names = [name for name, _, _ in run.plan]
        found = {r.name: dict(zip(COLUMNS, table[i].tolist(), strict=True)) for i, r in enumerate(readers)}
        return {name: found[name] for name in names}


def _behind(plan: list[Part], name: str, number: int) -> list[Part]:
    at = next(i for i, part in enumerate(plan) if part[0] == name)
    rest = [(name, number + 1, plan[at][2])] if number + 1 < plan[at][2] else []
    return rest + plan[at + 1 :]


def _one_worker(run: Watched, plan: list[Part], shared: Path, here: np.ndarray) -> tuple[str | None, str]:
    """Watch one worker; what ended it, or None, and what it said of that."""
    settings = asdict(run) | {"plan": plan, "out": str(run.out.absolute()), "shared": str(shared)}
    said = shared.with_name("said")
    with said.open("w+b") as stream:
        worker = subprocess.Popen(
            [sys.executable, Path(__file__).with_name("worker.py"), json.dumps(settings)], stdout=stream, stderr=stream
        )
        try:
            while worker.poll() is None:
                if time.monotonic() - here[2] > run.seconds:
                    worker.send_signal(signal.SIGUSR1)
                    time.sleep(0.2)
                    worker.kill()
                    worker.wait()
                    return "hang", said.read_text(errors="replace")[-20_000:]
                with contextlib.suppress(subprocess.TimeoutExpired):
                    worker.wait(POLL_S)
        finally:
            if worker.poll() is None:
                worker.kill()
                worker.wait()
    if worker.returncode == 0:
        return None, ""
    return f"died-{abs(worker.returncode)}", said.read_text(errors="replace")[-20_000:]
