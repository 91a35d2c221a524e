"""Contacts divided over devices, or over processes, give the numbers of one; single precision errs as documented."""

import json
import os
import socket
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from packed import PRESSING, dense, motion, packing

from mcc_jax.dem import advance, in_single, start

pytestmark = pytest.mark.extended

SCRIPT = """
import json, sys
import jax
jax.config.update("jax_enable_x64", True)
file, *place = sys.argv[1:]
if place:
    jax.distributed.initialize(f"localhost:{place[0]}", 2, int(place[1]))
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from mcc_jax import paper_law
from mcc_jax.dem import (
    Interaction, Motion, Packing, advance, die, run, scattered, set_velocity, spheres, stable_time_step, start,
)

# 25 particles and 65 edges divide among neither two nor four.
RADIUS, SQUEEZE, SKIN, DEVICES = 2.2e-4, 0.72, 4e-6, jax.devices()
PRESSING = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
packing = spheres(paper_law(), jax.random.uniform(jax.random.key(1), (25,), minval=80.0, maxval=120.0))
position, height = scattered(jax.random.key(0), packing.radius, RADIUS)
walls = set_velocity(die(RADIUS, SQUEEZE * height), jnp.asarray(PRESSING))
begin = start(packing, walls, position * jnp.asarray([1.0, 1.0, SQUEEZE]), SKIN, 65)
motion = Motion.of(stable_time_step(packing), Interaction(damping=0.1, friction=0.3, wall_friction=0.3))
found = {"devices": len(DEVICES), "processes": jax.process_count()}

def pressed(name, devices):
    state, rows = advance(packing, motion, begin, PRESSING, 2, 40, SKIN, devices=devices)
    found[name] = int(rows.lists[-1])
    np.savez(f"{file}_{name}.npz", rows.on_wall, *map(np.asarray, jax.tree.leaves(state)))
    return state

def energy(stiffer, devices):
    sides = eqx.tree_at(lambda s: s.k1, packing.sides, packing.sides.k1 * jnp.exp(stiffer))
    return jnp.sum(run(Packing(packing.radius, packing.mass, sides), motion, begin, 6, 5, devices).velocity ** 2)

pressed("divided", DEVICES)
if not place:
    found["slip"] = float(np.abs(pressed("alone", None).edges.slip).max())
    slopes = {n: jax.jit(jax.value_and_grad(lambda s: energy(s, d)))(0.0) for n, d in (("one", None), ("all", DEVICES))}
    found |= {name: [float(x) for x in slope] for name, slope in slopes.items()}
    found["reductions"] = jax.jit(lambda s: energy(s, DEVICES)).lower(0.0).as_text().count("stablehlo.all_reduce")
print(json.dumps(found))
"""


def begun(devices, *arguments):
    """The script in a process of its own, compiled in little time: the numbers do not depend on optimisation."""
    flags = f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level=0"
    command = [sys.executable, "-c", SCRIPT, *map(str, arguments)]
    environment = {**os.environ, "XLA_FLAGS": flags}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finished(process):
    out, err = process.communicate(timeout=500)
    assert process.returncode == 0, err
    return json.loads(out.splitlines()[-1])


def assert_same(one, other):
    """Forces on the walls and all arrays of the state."""
    with np.load(one) as first, np.load(other) as second:
        assert np.abs(first["arr_0"]).max() > 1e-3  # the walls are pressed
        for name in first.files:
            assert np.abs(first[name] - second[name]).max() <= 1e-12 * np.abs(first[name]).max()


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    """Where the script put its arrays with four devices, and what it found."""
    file = tmp_path_factory.mktemp("four") / "found"
    return file, finished(begun(4, file))


def test_four_devices_give_the_numbers_of_one(four):
    file, result = four
    assert (result["devices"], result["processes"], result["reductions"]) == (4, 1, 1)
    assert_same(f"{file}_alone.npz", f"{file}_divided.npz")
    # Something happens: lists are made anew, contacts slip.
    assert result["alone"] == result["divided"] > 0
    assert result["slip"] > 1e-9
    assert abs(result["one"][1]) > 1
    np.testing.assert_allclose(result["all"], result["one"], rtol=1e-12)


def test_two_processes_give_the_numbers_of_one(four, tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    both = [begun(1, tmp_path / str(k), port, k) for k in range(2)]
    for k, result in enumerate(map(finished, both)):
        assert (result["devices"], result["processes"]) == (2, 2)
        assert_same(f"{four[0]}_alone.npz", tmp_path / f"{k}_divided.npz")


def test_single_precision_errs_as_documented():
    """Forces in float32 to about 1e-6, because places stay in float64."""
    begin = start(packing(), dense().walls, dense().position, 1e-5)
    double, rows = advance(packing(), motion(), begin, PRESSING, 3, 100, 1e-5)
    single, rows_single = advance(*in_single(packing(), motion(), begin), PRESSING, 3, 100, 1e-5)
    assert single.edges.overlap_max.dtype == single.wall_history.slip.dtype == single.velocity.dtype == jnp.float32
    assert single.position.dtype == single.walls[1].point.dtype == jnp.float64
    assert rows_single.on_wall.dtype == np.float32
    assert rows.lists[-1] > 0
    largest = np.abs(rows.on_wall).max()
    assert 0 < np.abs(rows_single.on_wall - rows.on_wall).max() <= 5e-6 * largest
    np.testing.assert_allclose(single.position, double.position, rtol=0, atol=5e-6 * 1e-4)
    # The punch has gone as far but for the rounding of the time step, which float32 heights would not allow.
    way = [float(begin.walls[1].point[2] - state.walls[1].point[2]) for state in (double, single)]
    assert abs(way[1] / way[0] - 1) <= 1e-7
