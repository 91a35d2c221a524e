"""How the functions of a calibration are compiled, and run: on threads, and in blocks of particles over processes.

What is done to a particle does not depend on the others, but the bits of its numbers depend on the program that
computes them, and a sampler that sees other bits draws another chain. So the program is one for a block of particles,
whose size and members depend on the campaign alone. Every process computes blocks of its own, on all its local devices;
the numbers are then gathered by all processes, byte by byte, and whatever sums over particles, or concerns the
population, is done by every process for itself: from the same bits, with the same program, on one device.

Several processes therefore give the draws of one. Several devices of one process give the same fits to 1e-9 or so: a
processor's devices share its threads, and sums are divided otherwise. Their draws are other draws of one posterior.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from threadpoolctl import threadpool_limits

from .._errors import InputError
from .._numerics import compiled as compiled
from ..arguments import is_traced
from .data import Tests

Turn = tuple[tuple[Any, ...], tuple[Any, ...]]

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
    """A function with one thread of NumPy's BLAS: matrices are small here, and its waiting threads take the cores from
    JAX, on two of which all would take a third longer."""
    return cast(Any, threadpool_limits.wrap(limits=1, user_api="blas"))(function)


def side_by_side[A, B](function: Callable[[A], B], arguments: Iterable[A]) -> list[B]:
    """What a function returns for each of its arguments, on as many threads as there are cores."""
    arguments = list(arguments)
    if len(arguments) == 1:
        return [function(arguments[0])]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, arguments))


def make_room() -> None:
    """Forget what JAX has compiled where the process would soon hold more memory maps than Linux allows, 65,530. A
    campaign of a new length takes over a thousand; without any left XLA fails ("Cannot allocate memory")."""
    try:
        with MAPS.open("rb") as lines:
            used = sum(1 for _ in lines)
        most = int(MAX_MAPS.read_text())
    except (OSError, ValueError):
        return
    if used > FULL * most:
        jax.clear_caches()


AXIS = "particles"  # the only axis of the mesh of a process's devices

# Sizes of a campaign that is one block: those between are padded, so that few sizes are compiled. The last is the
# most particles of a block: on a processor larger ones are no faster, smaller ones slower (`bench_scale.py`).
BLOCKS = (4, 8, 12, 16, 20, 24, 32, 40, 48, 64)


def block_size(count: int) -> int:
    """Particles of each block of a campaign of that many."""
    most = BLOCKS[-1]
    if count <= most:
        return next(size for size in BLOCKS if size >= count)
    size = -(-count // -(-count // most))
    return size + -size % 4


def padded(tree: Any) -> tuple[Any, np.ndarray]:
    """Arrays of particles with copies of the last one up to whole blocks, and weights: 1 of particles, 0 of copies."""
    count = len(jax.tree.leaves(tree)[0])
    rows = np.arange(count + -count % block_size(count))

    def longer(x: Any) -> Any:
        x = x if is_traced(x) else np.asarray(x)  # of NumPy, so that nothing is compiled
        return jax.device_put(x[np.minimum(rows, count - 1)])

    return jax.tree.map(longer, tree), np.where(rows < count, 1.0, 0.0)


class Blocks:
    """`count` particles in `number` blocks of `size`, the last one padded, of which each process has its own."""

    def __init__(self, count: int, size: int = 0) -> None:
        self.count, self.size = count, size or block_size(count)
        self.number = -(-count // self.size)
        # A single block is computed by every process for itself: that is quicker than to wait for another's.
        self.processes = jax.process_count() if self.number > 1 else 1
        process = jax.process_index() if self.processes > 1 else 0
        self._share = share = -(-self.number // self.processes)
        devices = jax.local_devices()[:share]
        self._mesh = Mesh(np.array(devices), (AXIS,)) if len(devices) > 1 else None
        rounds = -(-share // len(devices))
        # Where blocks do not come out even, the last one is computed again, and discarded.
        own = np.minimum(process * share + np.minimum(np.arange(rounds * len(devices)), share - 1), self.number - 1)
        self._own = own.reshape(rounds, len(devices))

    def all(self, function: Callable[..., Any], particles: tuple[Any, ...], *shared: Any) -> Any:
        """`function(*particles, *shared)` of all particles, a block at a time on each device.

        `particles` are trees of arrays with the particles first, as those of the result; numbers without axes are left.
        A function from `compiled` runs on all devices at once, any other calls compiled functions one after the other;
        on a single device several blocks run on a thread each.
        """
        return self.turns(function, particles, [((), shared)])[0]

    def turns(self, function: Callable[..., Any], particles: tuple[Any, ...], turns: Sequence[Turn]) -> list[Any]:
        """`function(*own, *particles, *shared)` of all particles in every turn (own, shared); `own` are further arrays
        of the particles. The arrays of a block are placed on its device once for all turns."""
        # Several processes exchange their numbers in one order; several devices share the cores as it is.
        run = side_by_side if self.processes == 1 and self._mesh is None else map
        within = map if len(self._own) > 1 else run  # a thread a block: not as many again in each
        if self.number == 1 and self.size == self.count:
            return list(run(lambda turn: function(*turn[0], *particles, *turn[1]), turns))
        mesh = self._mesh if hasattr(function, "__wrapped__") else None
        sharding = None if mesh is None else NamedSharding(mesh, PartitionSpec(AXIS))

        def some(blocks: np.ndarray) -> list[Any]:
            rows = self._rows(blocks)

            def placed(tree: Any) -> Any:
                return jax.tree.map(lambda x: jax.device_put(np.asarray(x)[rows], sharding) if np.ndim(x) else x, tree)

            there = placed(particles)

            def one(turn: Turn) -> Any:
                own = *placed(turn[0]), *there
                return function(*own, *turn[1]) if mesh is None else _on_all_devices(own, turn[1], function, mesh)

            return list(within(one, turns))

        return [self._gathered(list(parts)) for parts in zip(*run(some, self._own), strict=True)]

    def share(self, function: Callable[..., Any], particles: tuple[Any, ...], *shared: Any) -> Any:
        """The same, of all particles of this process in one call; for a function that cuts them into blocks itself."""
        rows = self._rows(self._own.ravel())
        own = jax.tree.map(lambda x: np.asarray(x)[rows] if np.ndim(x) else x, particles)
        return self._gathered([function(*own, *shared)])

    def keys(self, key: Any) -> np.ndarray:
        """Data of a random key for every block, for each of its particles."""
        keys = key[None] if self.number == 1 else jax.random.split(key, self.number)
        return np.repeat(np.asarray(jax.random.key_data(keys)), self.size, axis=0)[: self.count]

    def _rows(self, blocks: np.ndarray) -> np.ndarray:
        return np.minimum((blocks[:, None] * self.size + np.arange(self.size)).ravel(), self.count - 1)

    def _gathered(self, parts: list[Any]) -> Any:
        """Arrays of all particles, the same bits on every process, from each process's own."""
        own = self._share * self.size
        whole = jax.tree.map(lambda *several: np.concatenate(list(map(np.asarray, several)))[:own], *parts)
        if self.processes > 1:
            leaves, structure = jax.tree.flatten(whole)
            whole = jax.tree.unflatten(structure, [np.concatenate(of_processes) for of_processes in _exchanged(leaves)])
        return jax.tree.map(lambda x: jax.device_put(x[: self.count]), whole)


@compiled
def _on_all_devices(particles: Any, shared: Any, function: Any, mesh: Any) -> Any:
    """A function of one block on every device of a mesh, each with a block of its own."""
    arrays, rest = eqx.partition((particles, shared), eqx.is_array)
    cut = jax.tree.map(lambda x: PartitionSpec(AXIS) if x.ndim else PartitionSpec(), arrays[0])
    whole = jax.tree.map(lambda _: PartitionSpec(), arrays[1])

    def run(arrays: Any) -> Any:
        own, common = eqx.combine(arrays, rest)
        return function(*own, *common)

    specs: Any = {"in_specs": ((cut, whole),), "out_specs": PartitionSpec(AXIS)}
    return jax.shard_map(run, mesh=mesh, check_vma=False, **specs)(arrays)


def _exchanged(arrays: list[np.ndarray]) -> list[np.ndarray]:
    """Arrays of all processes, with the processes along a first axis."""
    from jax.experimental.multihost_utils import process_allgather

    # As bytes, in one message: no conversion touches a bit.
    message = np.concatenate([np.frombuffer(x.tobytes(), np.uint8) for x in arrays])
    received = np.asarray(process_allgather(message))
    parts = np.split(received, np.cumsum([x.nbytes for x in arrays])[:-1], axis=1)
    each = ((x, np.ascontiguousarray(part).view(x.dtype)) for x, part in zip(arrays, parts, strict=True))
    return [part.reshape(len(received), *x.shape) for x, part in each]


def require_same(tests: Tests) -> None:
    """Raise `InputError` unless all processes have the same tests."""
    if jax.process_count() == 1:
        return
    digest = hashlib.sha256()
    for x in jax.tree.leaves(tests):
        digest.update(repr(x.shape).encode())
        digest.update(np.asarray(x).tobytes())
    (digests,) = _exchanged([np.frombuffer(digest.digest(), np.uint8)])
    if len(np.unique(digests, axis=0)) > 1:
        remedy = "Every process must call the calibration with the same campaign and the same settings."
        raise InputError("the processes were given different tests", remedy=remedy)
