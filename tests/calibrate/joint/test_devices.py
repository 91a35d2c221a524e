"""Particles spread over several devices give the numbers of one."""

import json
import os
import subprocess
import sys

import numpy as np

SCRIPT = """
import json
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
from mcc_jax.calibrate.joint import JointModel
from mcc_jax.calibrate.joint._data import select_tests
from mcc_jax.calibrate.joint._devices import host, spread
from mcc_jax.calibrate.joint._fit import fit_joint
from mcc_jax.simulate import Programme, paper_campaign
campaign = paper_campaign(0, programme=Programme.cycles(points=60)).select(np.arange(20) < 4)
tests = spread(select_tests(campaign).tests)
fit = fit_joint(tests, JointModel(), 0.02)
print(json.dumps({"devices": len(tests.force.sharding.device_set), "mode": host(fit.mode).tolist(),
                  "latent": host(fit.latent).tolist()}))
"""


def run(devices):
    environment = {**os.environ, "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"}
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_several_devices_give_the_numbers_of_one():
    one, two, three = run(1), run(2), run(3)
    # Four particles do not divide among three devices: two copies that count for nothing fill up.
    assert (one["devices"], two["devices"], three["devices"]) == (1, 2, 3)
    for several in (two, three):
        np.testing.assert_allclose(several["mode"], one["mode"], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(several["latent"][:4], one["latent"], rtol=1e-8)
