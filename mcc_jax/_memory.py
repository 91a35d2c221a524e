"""Room for compiled functions in a process that lives long."""

from __future__ import annotations

from pathlib import Path

import jax

MAPS = Path("/proc/self/maps")
MAX_MAPS = Path("/proc/sys/vm/max_map_count")
FULL = 0.6
"""Share of the memory maps a process may have at which compiled functions are forgotten."""


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
