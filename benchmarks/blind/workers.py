"""A solver in a process of its own that can be stopped and replaced: a campaign that hangs or kills it costs itself."""

from __future__ import annotations

import contextlib
import multiprocessing
import time
import traceback
from collections.abc import Iterable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from . import adapter
from .settings import SETTINGS, Running


def _serve(pipe: Connection, solver: str, seed: int) -> None:
    """Solve what comes through the pipe until None comes."""
    solve: adapter.Solver | None = None
    with contextlib.suppress(Exception):  # a solver that cannot be found shows in every outcome
        solve = adapter.find(solver)
    pipe.send(None)  # started: from here on time counts
    cold = True
    while (task := pipe.recv()) is not None:
        began = time.perf_counter()
        try:
            discovery = (solve or adapter.find(solver))(Path(task), seed=seed)
            wrong = adapter.problem(discovery)
            outcome = {"status": "invalid" if wrong else "ok", "error": wrong, "discovery": adapter.kept(discovery)}
        except Exception as error:
            outcome = {"status": "crash", **_crash(error, Path(task))}
        pipe.send({"wall_s": time.perf_counter() - began, "cold": cold, "discovery": None, **outcome})
        cold = False


def _crash(error: Exception, folder: Path) -> dict[str, Any]:
    """What an error says and where it came from, without a path of this machine: outcomes are committed."""
    said = f"{type(error).__name__}: {error}".replace(f"{folder.parent}/", "")
    last = traceback.extract_tb(error.__traceback__)[-3:]
    return {"error": said, "trace": [f"{Path(at.filename).name}, line {at.lineno}, in {at.name}" for at in last]}


class Worker:
    """One process, started when a task comes."""

    def __init__(self, solver: str, seed: int, running: Running = SETTINGS.running) -> None:
        self._solver, self._seed, self._running = solver, seed, running
        self._process: Any = None
        self._pipe: Any = None
        self._served = 0

    def ask(self, folder: Path) -> dict[str, Any]:
        """The outcome of one campaign."""
        if self._served >= self._running.renew_after:
            self.stop()
        began = time.monotonic()
        try:
            if self._process is None:
                self._start()
                began = time.monotonic()
            self._served += 1
            self._pipe.send(str(folder))
            if self._pipe.poll(self._running.timeout_s):
                return self._pipe.recv()
            status, error = "timeout", f"no answer in {self._running.timeout_s:g} s"
        except (EOFError, ConnectionResetError, BrokenPipeError):
            status, error = "crash", "the process died"
        except TimeoutError as late:
            status, error = "crash", str(late)
        self.stop(kill=True)
        wall = time.monotonic() - began
        return {"wall_s": wall, "cold": False, "status": status, "error": error, "discovery": None}

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._solver, self._seed), daemon=True)
        self._process.start()
        theirs.close()
        self._served = 0
        if not self._pipe.poll(self._running.start_timeout_s):
            raise TimeoutError(f"the worker did not start in {self._running.start_timeout_s:g} s")
        self._pipe.recv()

    def stop(self, kill: bool = False) -> None:
        """End the process."""
        if self._process is None:
            return
        if not kill:
            with contextlib.suppress(OSError):
                self._pipe.send(None)
            self._process.join(5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._pipe.close()
        self._process = None


def outcomes(
    tasks: Iterable[tuple[str, Path]], solver: str, seed: int = 0, running: Running = SETTINGS.running
) -> Iterator[dict[str, Any]]:
    """Outcomes of campaigns, one after the other; the process is renewed every few."""
    worker = Worker(solver, seed, running)
    try:
        for key, folder in tasks:
            yield {"key": key, **worker.ask(folder)}
    finally:
        worker.stop()
