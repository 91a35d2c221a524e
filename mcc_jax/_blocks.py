"""Many contacts at once, a block that fits a processor's cache at a time, over every device."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from . import arguments
from ._errors import InputError

CONTACTS = 512  # in a block: the few arrays that a loop over one takes then come from a core's first cache
NUMBERS = 4096  # of one array in a block of paths: with the dozen arrays between, half of a small core's second cache


def in_blocks[**P, R](
    function: Callable[P, R], *, block: int | None = None, devices: tuple[Any, ...] | None = None
) -> Callable[P, R]:
    """Map a function of one contact over many contacts, in blocks: the values of `jax.vmap(function)`.

    What a block needs in between stays in a core's cache, so that gradients are several times faster on a CPU, which
    works on one block at a time for each device it shows: set ``jax.config.update("jax_num_cpu_devices", cores)``
    before the first computation and pass ``devices=tuple(jax.devices())``. On a GPU, `jax.vmap` alone is faster unless
    memory is short. Differentiate inside, ``in_blocks(jax.grad(energy))``, where each contact has its own parameters:
    outside it works as well, and computes each block twice in reverse mode.

    Args:
        function: of one contact; its positional arguments are trees of arrays without a batch axis.
        block: contacts in a block, >= 1; if None, what suits a cache: 512, or fewer where each brings a path. The
            actual one may be smaller, so that blocks come out even.
        devices: JAX devices over which the contacts are divided, in equal shares; the default device if None.

    Returns:
        A function of the same arguments with one more axis in front, of one length in every array. It raises
        `InputError` if lengths differ, or cannot be divided by the devices.
    """
    if block is not None:
        block = arguments.whole(block, "block, a number of contacts,", least=1)
    one = jax.checkpoint(function)

    def share(*arguments: Any) -> Any:
        leaves = jax.tree.leaves(arguments)
        count, numbers = len(leaves[0]), max(math.prod(leaf.shape[1:]) for leaf in leaves)
        largest = block or max(1, min(CONTACTS, NUMBERS // max(numbers, 1)))
        if count <= largest:
            return jax.vmap(one)(*arguments)
        return jax.lax.map(lambda contact: one(*contact), arguments, batch_size=even_size(count, largest))

    def call(*arguments: Any) -> Any:
        _check(arguments, len(devices or ()) or 1)
        if devices is None or len(devices) == 1:
            return share(*arguments)
        axis, mesh = PartitionSpec("contacts"), Mesh(np.array(devices), ("contacts",))
        return jax.shard_map(share, mesh=mesh, in_specs=axis, out_specs=axis)(*arguments)

    return call  # pyright: ignore[reportReturnType]


def even_size(count: int, block: int) -> int:
    """The largest block, from `block` down to half of it, that leaves no remainder, which would be compiled again."""
    block = max(1, min(count, block))
    return next((size for size in range(block, (block - 1) // 2, -1) if count % size == 0), block)


def _check(arguments: Any, shares: int) -> None:
    shapes = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(arguments)}
    if len(shapes) != 1 or () in shapes:
        problem = f"arrays of lengths {sorted(s[0] if s else 0 for s in shapes)} are not one batch of contacts"
        raise InputError(problem, remedy="Give every array one axis in front, of one length.")
    (count,) = next(iter(shapes))
    if count % shares:
        raise InputError(f"{count} contacts cannot be shared by {shares} devices", remedy="Pad them to a multiple.")
