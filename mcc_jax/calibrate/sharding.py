"""Particles in blocks of a fixed size, spread over the processes and the devices of each.

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
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from .._errors import InputError
from ..arguments import is_traced
from .compiling import compiled
from .data import Tests

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
        """Cut `count` particles into blocks of `size`; of `block_size` if 0."""
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
        A function from `compiled` runs on all devices at once, any other calls compiled functions one after the other.
        """
        if self.number == 1 and self.size == self.count:
            return function(*particles, *shared)
        mesh = self._mesh if hasattr(function, "__wrapped__") else None
        sharding = None if mesh is None else NamedSharding(mesh, PartitionSpec(AXIS))

        def some(blocks: np.ndarray) -> Any:
            rows = self._rows(blocks)
            own = jax.tree.map(lambda x: jax.device_put(np.asarray(x)[rows], sharding) if np.ndim(x) else x, particles)
            return function(*own, *shared) if mesh is None else _on_all_devices(own, shared, function, mesh)

        return self._gathered([some(blocks) for blocks in self._own])

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
            leaves = [np.concatenate(several) for several in zip(*_exchanged(leaves), strict=True)]
            whole = jax.tree.unflatten(structure, leaves)
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

    return jax.shard_map(run, mesh=mesh, in_specs=((cut, whole),), out_specs=PartitionSpec(AXIS), check_vma=False)(
        arrays
    )


def _exchanged(arrays: list[np.ndarray]) -> list[list[np.ndarray]]:
    """The same arrays of every process, in the order of the processes."""
    from jax.experimental.multihost_utils import process_allgather

    # As bytes, in one message: no conversion touches a bit.
    message = np.concatenate([np.frombuffer(np.ascontiguousarray(x).tobytes(), np.uint8) for x in arrays])
    received = np.asarray(process_allgather(message))
    ends = np.cumsum([x.nbytes for x in arrays])
    return [
        [
            np.frombuffer(row[end - x.nbytes : end].tobytes(), x.dtype).reshape(x.shape)
            for x, end in zip(arrays, ends, strict=True)
        ]
        for row in received
    ]


def require_same(tests: Tests) -> None:
    """Raise `InputError` unless all processes have the same tests."""
    if jax.process_count() == 1:
        return
    digest = hashlib.sha256()
    for x in jax.tree.leaves(tests):
        digest.update(repr(x.shape).encode())
        digest.update(np.ascontiguousarray(np.asarray(x)).tobytes())
    if len({bytes(one[0]) for one in _exchanged([np.frombuffer(digest.digest(), np.uint8)])}) > 1:
        raise InputError(
            "the processes were given different tests",
            remedy="Every process must call the calibration with the same campaign and the same settings.",
        )
