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
if len(sys.argv) > 1:
    jax.distributed.initialize(f"localhost:{sys.argv[1]}", 2, int(sys.argv[2]))
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

def apart(x, y):
    x, y = np.asarray(x), np.asarray(y)
    return float(np.abs(x - y).max() / np.abs(x).max()) if np.abs(x).max() else float(np.abs(y).max())

def energy(stiffer, devices):
    sides = eqx.tree_at(lambda s: s.k1, packing.sides, packing.sides.k1 * jnp.exp(stiffer))
    return jnp.sum(run(Packing(packing.radius, packing.mass, sides), motion, begin, 6, 5, devices).velocity ** 2)

alone, rows = advance(packing, motion, begin, PRESSING, 2, 40, SKIN)
divided, rows_divided = advance(packing, motion, begin, PRESSING, 2, 40, SKIN, devices=DEVICES)
zero = jnp.zeros(())
slope = jax.jit(jax.value_and_grad(lambda s: energy(s, None)))(zero)
slope_divided = jax.jit(jax.value_and_grad(lambda s: energy(s, DEVICES)))(zero)
forward = jax.jit(lambda s: energy(s, DEVICES)).lower(zero).as_text()
print(json.dumps({
    "devices": len(DEVICES),
    "processes": jax.process_count(),
    "lists": [int(rows.lists[-1]), int(rows_divided.lists[-1])],
    "state": max(map(apart, jax.tree.leaves(alone), jax.tree.leaves(divided))),
    "walls": apart(rows.on_wall, rows_divided.on_wall),
    "pressed": float(np.abs(rows.on_wall).max()),
    "slip": float(np.abs(alone.edges.slip).max()),
    "value": apart(slope[0], slope_divided[0]),
    "gradient": apart(slope[1], slope_divided[1]),
    "slope": float(slope[1]),
    "reductions": forward.count("stablehlo.all_reduce"),
}))
"""


def begun(devices, *arguments):
    environment = {**os.environ, "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"}
    command = [sys.executable, "-c", SCRIPT, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finished(process):
    out, err = process.communicate(timeout=500)
    assert process.returncode == 0, err
    return json.loads(out.splitlines()[-1])


def check(result):
    # Something happens: lists are made anew, walls are pressed, contacts slip.
    assert result["lists"][0] == result["lists"][1] > 0
    assert result["pressed"] > 1e-3
    assert result["slip"] > 1e-9
    assert abs(result["slope"]) > 1
    for name in ("state", "walls", "value", "gradient"):
        assert result[name] <= 1e-12, name
    assert result["reductions"] == 1


def test_four_devices_give_the_numbers_of_one():
    result = finished(begun(4))
    assert (result["devices"], result["processes"]) == (4, 1)
    check(result)


def test_two_processes_give_the_numbers_of_one():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    both = [begun(1, port, k) for k in range(2)]
    for result in map(finished, both):
        assert (result["devices"], result["processes"]) == (2, 2)
        check(result)


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
