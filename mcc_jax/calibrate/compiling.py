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


def even_batch(count: int, most: int) -> int:
    """How many of `count` to work on at once, at most `most`: without a remainder, if that is not far fewer.

    `jax.lax.map` compiles its function again for the remainder.
    """
    most = max(1, min(count, most))
    even = next(size for size in range(most, 0, -1) if count % size == 0)
    return even if 2 * even >= most else most


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
    """Forget what JAX has compiled, everybody's, where the process would soon hold more than the system allows.

    Every compiled function holds about three memory maps, a campaign of a new length several hundred functions, and
    Linux allows a process 65,530 maps: after some thirty campaigns XLA would fail ("LLVM compilation error: Cannot
    allocate memory") and take the process along. What is needed again is compiled again. Other systems have no such
    limit, and nothing happens there.
    """
    try:
        with MAPS.open("rb") as lines:
            used = sum(1 for _ in lines)
        most = int(MAX_MAPS.read_text())
    except (OSError, ValueError):
        return
    if used > FULL * most:
        jax.clear_caches()
