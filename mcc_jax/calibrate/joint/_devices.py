"""Particles spread over the devices of all processes, and their arrays back on the host.

Every process calls the same functions with the same campaign and gets the same result. What is computed particle by
particle is spread, and no number of one depends on where the others are. What concerns all of them (the noise, the
population and its sampler) works on arrays that every process has gathered, in the order of one process: a sampler
takes other turns for a sum that differs in its last bit. An array goes to the host through `host`, never by
`numpy.asarray`; all processes ask for it together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ._data import Tests, enlarged

AXIS = "particles"
"""Name of the only axis of the mesh."""

OWN, ALL = PartitionSpec(AXIS), PartitionSpec()
"""Particles in front, and each device has its own; every device has the whole."""


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


def on_each(function: Callable[..., Any], mesh: Mesh | None, takes: tuple[Any, ...], gives: Any) -> Callable[..., Any]:
    """A function of arrays with particles in front, on every device for its own; itself where there is no mesh.

    The compiler could split it by itself, but then into another program, whose last bits differ.

    Args:
        function: what to compute.
        mesh: the devices.
        takes: `OWN` or `ALL` for each argument, or trees of them.
        gives: the same for the result.
    """
    if mesh is None:
        return function
    return jax.shard_map(function, mesh=mesh, in_specs=takes, out_specs=gives, check_vma=False)


def gathered(tree: Any, tests: Tests) -> Any:
    """Arrays with particles in front, whole and without copies on this process's own device, if the tests are spread;
    otherwise as they are."""
    return tree if mesh_of(tests.force) is None else local(tree, count_of(tests))


def local(tree: Any, count: int | None = None) -> Any:
    """The same arrays on this process's default device; of those with particles in front, the first `count`."""
    return jax.tree.map(lambda x: jnp.asarray(host(x)[:count] if count is not None else host(x)), tree)
