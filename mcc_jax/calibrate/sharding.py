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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from .._errors import InputError
from .compiling import compiled
from .data import Tests, longer

AXIS = "particles"
"""Name of the only axis of the mesh of a process's devices."""


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


def filled_rows(count: int) -> np.ndarray:
    """Rows 0 to `count` - 1, and the last one again until blocks are full: few numbers of rows, few compilations."""
    return np.minimum(np.arange(count + -count % block_size(count)), count - 1)


def filled_up(tests: Tests, block: int) -> Tests:
    """The same tests among as many more as whole blocks take: copies of the last particle that count for nothing.

    Every particle gets a weight, whether copies are needed or not: one kind of arrays, one compilation.
    """
    more = -len(tests) % block
    weight = np.ones(len(tests)) if tests.weight is None else np.asarray(tests.weight)
    return replace(longer(tests, len(tests) + more), weight=jnp.asarray(np.pad(weight, (0, more))))


def count_of(tests: Tests) -> int:
    """Number of particles, without padding."""
    return len(tests) if tests.weight is None else int(np.asarray(tests.weight).sum())


@dataclass(frozen=True)
class Parts:
    """This process's own particles, cut along `axis` into waves: a block for each of its devices at the same time."""

    waves: Sequence[Any]
    axis: int = 0

    def map(self, function: Callable[..., Any], *others: Parts) -> Parts:
        """A function of every wave, and of the same waves of others."""
        several = zip(self.waves, *(one.waves for one in others), strict=True)
        return Parts(tuple(function(*waves) for waves in several), self.axis)


@dataclass(frozen=True)
class _Cut(Sequence[Any]):
    """Waves that are cut out each time they are asked for: `part` of each row of blocks in `own`."""

    part: Callable[[np.ndarray], Any]
    own: np.ndarray

    def __len__(self) -> int:
        return len(self.own)

    def __getitem__(self, wave: Any) -> Any:
        return self.part(self.own[wave])


class Blocks:
    """How `count` particles, padding included, are cut into `number` blocks of `size`; which are this process's own."""

    def __init__(self, count: int, size: int = 0) -> None:
        """Cut `count` particles into blocks of `size`; 0 for a single block.

        Raises:
            ValueError: if the blocks do not come out even.
        """
        self.count, self.size = count, size or count
        if self.count % self.size:
            raise ValueError(f"{count} particles are not a whole number of blocks of {size}")
        self.number = self.count // self.size
        # A single block is computed by every process for itself: that is quicker than to wait for another's.
        self.processes = jax.process_count() if self.number > 1 else 1
        process = jax.process_index() if self.processes > 1 else 0
        share = -(-self.number // self.processes)
        devices = jax.local_devices()[:share]
        self.mesh = Mesh(np.array(devices), (AXIS,)) if len(devices) > 1 else None
        self._share = share
        rounds = -(-share // len(devices))
        # Where blocks do not come out even, the last one is computed again, and discarded.
        own = np.minimum(process * share + np.minimum(np.arange(rounds * len(devices)), share - 1), self.number - 1)
        self._own = own.reshape(rounds, len(devices))

    @property
    def whole_here(self) -> bool:
        """Whether one device of every process has all particles at once."""
        return self.number == 1

    def cut(self, tree: Any, axis: int = 0, *, kept: bool = True) -> Parts:
        """This process's own particles of arrays of all; numbers without axes stay as they are.

        Parts that are not kept are cut out each time they are asked for: of very many particles a second copy of all
        would be large.
        """
        if self.whole_here:
            return Parts((tree,), axis)

        def part(blocks: np.ndarray) -> Any:
            rows = (blocks[:, None] * self.size + np.arange(self.size)[None]).ravel()
            return jax.tree.map(
                lambda x: x if jnp.ndim(x) == 0 else self._placed(np.take(np.asarray(x), rows, axis), axis), tree
            )

        return Parts(tuple(map(part, self._own)) if kept else _Cut(part, self._own), axis)

    def keys(self, key: Any) -> Parts:
        """A random key for every block."""
        if self.whole_here:
            return Parts((key[None],))
        data = np.asarray(jax.random.key_data(jax.random.split(key, self.number)))
        return Parts(tuple(jax.random.wrap_key_data(self._placed(data[blocks], 0)) for blocks in self._own))

    def each(self, function: Callable[..., Any], *arguments: Any, axis: int = 0) -> Parts:
        """A function of one block, applied to all of this process's own.

        Args:
            function: from `compiled`, for all devices at once; any other calls compiled functions one after the other.
            arguments: `Parts`, or what all blocks share.
            axis: of the particles in every array of the result.
        """

        def wave(w: int) -> Any:
            chosen = tuple(a.waves[w] if isinstance(a, Parts) else a for a in arguments)
            if self.mesh is None or not hasattr(function, "__wrapped__"):
                return function(*chosen)
            axes = tuple(a.axis if isinstance(a, Parts) else -1 for a in arguments)
            return _on_all_devices(chosen, axes, axis, function, self.mesh)

        return Parts(tuple(wave(w) for w in range(len(self._own))), axis)

    def all(self, function: Callable[..., Any], *arguments: Any, axis: int = 0) -> Any:
        """The same, of all particles."""
        return self.whole(self.each(function, *arguments, axis=axis))

    def whole(self, parts: Parts) -> Any:
        """Arrays of all particles, the same bits on every process, from each process's own."""
        if self.whole_here:
            return parts.waves[0]
        axis, own = parts.axis, self._share * self.size
        trees = [jax.tree.flatten(wave) for wave in parts.waves]
        waves = zip(*(leaves for leaves, _ in trees), strict=True)
        leaves = [_first(np.concatenate([np.asarray(v) for v in several], axis), own, axis) for several in waves]
        if self.processes > 1:
            leaves = [np.concatenate(several, axis) for several in zip(*_exchanged(leaves), strict=True)]
        return jax.tree.unflatten(trees[0][1], [jnp.asarray(_first(x, self.count, axis)) for x in leaves])

    def _placed(self, x: np.ndarray, axis: int) -> Any:
        if self.mesh is None:
            return jnp.asarray(x)
        return jax.device_put(x, NamedSharding(self.mesh, _along(axis)))


def _first(x: np.ndarray, count: int, axis: int) -> np.ndarray:
    return x[(slice(None),) * axis + (slice(count),)]


def _along(axis: int) -> PartitionSpec:
    return PartitionSpec(*[None] * axis, AXIS)


@compiled
def _on_all_devices(arguments: Any, axes: Any, axis: int, function: Any, mesh: Any) -> Any:
    """A function of one block on every device of a mesh, each with a block of its own."""
    arrays, rest = eqx.partition(arguments, eqx.is_array)
    places = tuple(
        jax.tree.map(lambda x, a=a: _along(a) if a >= 0 and x.ndim else PartitionSpec(), one)
        for one, a in zip(arrays, axes, strict=True)
    )
    run = jax.shard_map(
        lambda own: function(*eqx.combine(own, rest)),
        mesh=mesh,
        in_specs=(places,),
        out_specs=_along(axis),
        check_vma=False,
    )
    return run(arrays)


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
    """Make sure that all processes have the same tests.

    Raises:
        InputError: if they do not.
    """
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
