"""Particles spread over processes give the numbers of one; over devices, the same fits and the same posterior."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from joint_cases import five_tests
from spread_run import squares

from mcc_jax.calibrate.running import BLOCKS, Blocks, block_size, padded

pytestmark = pytest.mark.extended

LIMIT_S = 400
HERE = Path(__file__).parent


def start(folder, devices=1, processes=1, process=0, port=0, seed=0, everything=True):
    """One process of a run, its output in files: a full pipe would hold it up."""
    environment = {**os.environ, "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"}
    environment["PYTHONPATH"] = f"{HERE}{os.pathsep}{environment.get('PYTHONPATH', '')}"
    command = [sys.executable, str(HERE / "spread_run.py"), str(folder), f"127.0.0.1:{port}"]
    with (folder / f"output_{process}.txt").open("w") as output:
        return subprocess.Popen(
            [*command, str(processes), str(process), str(seed), str(int(everything))],
            env=environment,
            stdout=output,
            stderr=output,
        )


def finish(folder, running, *, fine=True):
    """Wait for all processes of a run; whatever happens, none is left."""
    try:
        codes = [one.wait(LIMIT_S) for one in running]
    finally:
        for one in running:
            one.kill()
            one.wait()
    if fine:
        said = "\n".join((folder / f"output_{i}.txt").read_text()[-2000:] for i in range(len(running)))
        assert codes == [0] * len(running), said
    return codes


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def arrays(folder, process=0):
    with np.load(folder / f"arrays_{process}.npz") as file:
        return {name: file[name] for name in file.files}


def calibrated(folder, processes=1, devices=1):
    """The folder that so many processes with so many devices each wrote into."""
    port = free_port()
    finish(folder, [start(folder, devices, processes, process, port) for process in range(processes)])
    return folder


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    return calibrated(tmp_path_factory.mktemp("alone"))


@pytest.fixture(scope="module")
def two_processes(tmp_path_factory):
    return calibrated(tmp_path_factory.mktemp("two_processes"), processes=2)


def assert_same(found, wanted):
    assert found.keys() == wanted.keys()
    for name, values in wanted.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-8, atol=1e-8, err_msg=name)


def test_blocks_of_two_processes_with_two_devices_are_those_of_one(tmp_path):
    port = free_port()
    finish(tmp_path, [start(tmp_path, 2, 2, i, port, everything=False) for i in range(2)])
    wanted = squares(five_tests().force)
    for process in range(2):
        told = json.loads((tmp_path / f"devices_{process}.json").read_text())
        assert told == {"devices": 2, "processes": 2}
        np.testing.assert_allclose(arrays(tmp_path, process)["squares"], wanted, rtol=1e-8)


@pytest.mark.parametrize("process", [0, 1])
def test_two_processes_give_the_numbers_of_one(alone, two_processes, process):
    assert json.loads((two_processes / f"devices_{process}.json").read_text()) == {"devices": 1, "processes": 2}
    assert_same(arrays(two_processes, process), arrays(alone))


FITS = ("mode", "covariance", "noise", "noise_log_sd", "scale", "latent", "residual", "variance")


def test_four_devices_give_the_fits_of_one_and_its_posterior(alone, tmp_path):
    """Draws are other draws: a sampler amplifies the last bits, in which devices of a processor differ."""
    four_devices = calibrated(tmp_path, devices=4)
    assert json.loads((four_devices / "devices_0.json").read_text()) == {"devices": 4, "processes": 1}
    found, wanted = arrays(four_devices), arrays(alone)
    assert found.keys() == wanted.keys()
    for name in FITS:
        # Residuals are differences of displacements of some 100 um.
        scale = 100.0 if name == "residual" else np.max(np.abs(wanted[name]))
        np.testing.assert_allclose(found[name], wanted[name], rtol=1e-6, atol=1e-8 * scale, err_msg=name)
    for name in ("a", "effective_modulus_MPa", "mu_C1", "mu_C5"):
        error = wanted[name].std() * (2 / 40) ** 0.5  # a bulk ESS of 40 at least in 120 draws
        assert abs(found[name].mean() - wanted[name].mean()) < 4 * error, name


def test_only_the_first_process_writes_files(alone, two_processes):
    written = {path.name for path in two_processes.glob("*") if not path.stem[-1].isdigit()}
    assert written == {"calibration.json", "posterior.nc"}
    one, two = (json.loads((folder / "calibration.json").read_text()) for folder in (alone, two_processes))
    assert two == one


def test_processes_with_different_campaigns_are_told(tmp_path):
    port = free_port()
    running = [start(tmp_path, processes=2, process=i, port=port, seed=i) for i in range(2)]
    assert all(finish(tmp_path, running, fine=False))
    for i in range(2):
        assert "different tests" in (tmp_path / f"error_{i}.txt").read_text()


@pytest.mark.parametrize("count", [1, 4, 5, 20, 33, 64, 65, 100, 1000, 10_000])
def test_blocks_waste_little_and_have_few_sizes(count):
    size = block_size(count)
    filled = count + -count % size
    assert size <= BLOCKS[-1]
    assert size in BLOCKS or count > BLOCKS[-1]
    assert filled - count <= max(3, count // 3 if count <= BLOCKS[-1] else count // 8)
    assert block_size(filled) == size  # what is filled up once stays as it is


def test_blocks_make_up_the_whole():
    """Of six particles in blocks of four the last is padded; numbers without axes are not cut."""
    tree = {"matrix": np.random.default_rng(1).standard_normal((6, 3)), "number": np.float64(2.0)}
    sizes = []

    def function(own, shared):
        sizes.append(len(own["matrix"]))
        return {"matrix": own["matrix"] * own["number"] + shared, "first": own["matrix"][:, 0]}

    blocks = Blocks(6, 4)
    for cut, wanted in ((blocks.all, [4, 4]), (blocks.share, [8])):
        found = cut(function, (tree,), 1.0)
        assert sizes == wanted
        sizes.clear()
        np.testing.assert_array_equal(found["matrix"], 2 * tree["matrix"] + 1)
        np.testing.assert_array_equal(found["first"], tree["matrix"][:, 0])


def test_padding_counts_for_nothing():
    found, weight = padded(np.arange(5.0))
    np.testing.assert_array_equal(found, [0, 1, 2, 3, 4, 4, 4, 4])
    np.testing.assert_array_equal(weight, [1, 1, 1, 1, 1, 0, 0, 0])


def test_every_block_has_random_numbers_of_its_own():
    keys = Blocks(5, 2).keys(jax.random.key(0))
    assert keys.shape == (5, 2)
    np.testing.assert_array_equal(keys[0], keys[1])
    assert len(np.unique(keys, axis=0)) == 3
