"""Particles spread over the devices of all processes, and their arrays back on the host.

Every process calls the same functions with the same campaign and gets the same result. Each holds and computes its
particles only; what is summed over all of them is exchanged. Decisions are taken on the host from numbers that are the
same everywhere: an array goes there through `host`, never by `numpy.asarray`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ._data import Tests, enlarged

AXIS = "particles"
"""Name of the only axis of the mesh."""


def mesh_of(x: Any) -> Mesh | None:
    """The mesh over which an array is spread; None where one device has it all."""
    place = getattr(x, "sharding", None)
    return place.mesh if isinstance(place, NamedSharding) and isinstance(place.mesh, Mesh) else None


def spread(tests: Tests) -> Tests:
    """The same tests with their particles spread over all devices of all processes (`jax.distributed`).

    Copies of the last particle that count for nothing are added until the number divides evenly. With fewer particles
    than devices, and one process, nothing is spread.
    """
    devices = jax.devices()
    if len(devices) < 2 or (len(tests) < len(devices) and jax.process_count() == 1):
        return tests
    missing = -len(tests) % len(devices)
    tests = enlarged(tests, len(tests) + missing if missing else 0)
    place = NamedSharding(Mesh(np.array(devices), (AXIS,)), PartitionSpec(AXIS))

    def put(x: Any) -> Any:
        values = np.asarray(x)
        return jax.make_array_from_callback(values.shape, place, lambda index: values[index])

    return jax.tree.map(put, tests)


def count_of(tests: Tests) -> int:
    """Number of particles, without copies that only fill up."""
    return len(tests) if tests.weight is None else int(host(tests.weight).sum())


def host(x: Any) -> np.ndarray:
    """An array on the host, whole, wherever its parts are; all processes must ask for it together."""
    if isinstance(x, jax.Array) and not (x.is_fully_addressable or x.is_fully_replicated):
        from jax.experimental import multihost_utils

        return np.asarray(multihost_utils.process_allgather(x, tiled=True))
    return np.asarray(x)


def local(tree: Any, count: int | None = None) -> Any:
    """The same arrays on this process's default device; of those with particles in front, the first `count`."""
    return jax.tree.map(lambda x: jnp.asarray(host(x)[:count] if count is not None else host(x)), tree)
