"""How the functions of a calibration are compiled and run."""

from __future__ import annotations

import importlib
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import jax
from threadpoolctl import threadpool_limits

from .._numerics import compiled as compiled

MAPS = Path("/proc/self/maps")
MAX_MAPS = Path("/proc/sys/vm/max_map_count")
FULL = 0.6  # share of the memory maps a process may have at which compiled functions are forgotten


def compiled_quickly[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """`compiled` for what runs a few times only: another third less time to compile, at some times less speed."""
    return compiled(function, 0)


def imported_meanwhile(*names: str) -> None:
    """Import what is needed later while the first programs are compiled: together they would take seconds longer."""
    for name in names:
        threading.Thread(target=importlib.import_module, args=(name,), daemon=True).start()


def one_blas_thread[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """A function that calls NumPy and JAX in turn, with one thread of NumPy's BLAS.

    Its matrices are small here, and threads that wait for the next one take the cores from JAX: on two cores all would
    take a third longer.
    """
    return cast(Any, threadpool_limits.wrap(limits=1, user_api="blas"))(function)


def side_by_side[A, B](function: Callable[[A], B], arguments: Iterable[A]) -> list[B]:
    """What a function returns for each of its arguments, on as many threads as there are cores."""
    arguments = list(arguments)
    if len(arguments) == 1:
        return [function(arguments[0])]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, arguments))


def make_room() -> None:
    """Forget what JAX has compiled where the process would soon hold more memory maps than Linux allows.

    Every compiled function holds about three of 65,530 maps, a campaign of a new length several hundred functions:
    after some thirty campaigns XLA would fail ("LLVM compilation error: Cannot allocate memory").
    """
    try:
        with MAPS.open("rb") as lines:
            used = sum(1 for _ in lines)
        most = int(MAX_MAPS.read_text())
    except (OSError, ValueError):
        return
    if used > FULL * most:
        jax.clear_caches()
