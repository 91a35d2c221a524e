"""Particles spread over the devices of this process, and their arrays back on the host."""

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
    """The same tests with their particles spread over all devices of this process.

    Copies of the last particle that count for nothing are added until the number divides evenly. With fewer particles
    than devices nothing is spread.
    """
    devices = jax.local_devices()
    if len(devices) < 2 or len(tests) < len(devices):
        return tests
    missing = -len(tests) % len(devices)
    tests = enlarged(tests, len(tests) + missing if missing else 0)
    place = NamedSharding(Mesh(np.array(devices), (AXIS,)), PartitionSpec(AXIS))

    return jax.tree.map(lambda x: jax.device_put(x, place), tests)


def count_of(tests: Tests) -> int:
    """Number of particles, without copies that only fill up."""
    return len(tests) if tests.weight is None else int(host(tests.weight).sum())


def host(x: Any) -> np.ndarray:
    """An array on the host, whole, on whichever devices its parts are."""
    return np.asarray(x)


def local(tree: Any, count: int | None = None) -> Any:
    """The same arrays on the default device; of those with particles in front, the first `count`."""
    return jax.tree.map(lambda x: jnp.asarray(host(x)[:count] if count is not None else host(x)), tree)
