"""Two processes that share a campaign's particles give the numbers of one."""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

PART = Path(__file__).with_name("process_part.py")
LIMIT_S = 400.0
TOLERANCE = 1e-8


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def together(count, folder):
    """What `count` processes print, started at once; all are ended if one fails or none comes to an end in time."""
    address = f"127.0.0.1:{free_port()}"
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"} | {"JAX_PLATFORMS": "cpu"}
    files = [[(folder / f"{count}-{i}.{kind}").open("w+") for kind in ("out", "err")] for i in range(count)]
    arguments = [[address, str(count), str(i)] if count > 1 else [] for i in range(count)]
    running = [
        subprocess.Popen([sys.executable, str(PART), *a], env=environment, stdout=out, stderr=err)
        for a, (out, err) in zip(arguments, files, strict=True)
    ]
    deadline = time.monotonic() + LIMIT_S
    try:
        while any(p.poll() is None for p in running) and not any(p.poll() for p in running):
            assert time.monotonic() < deadline, "the processes did not come to an end"
            time.sleep(0.2)
    finally:
        for process in running:
            if process.poll() is None:
                process.kill()
            process.wait()
        told = [(_whole(out), _whole(err)) for out, err in files]
    assert all(p.returncode == 0 for p in running), "\n".join(err[-2000:] for _, err in told)
    return [json.loads(out.splitlines()[-1]) for out, _ in told]


def _whole(file):
    with file:
        file.seek(0)
        return file.read()


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("processes")
    (one,) = together(1, folder)
    return one, *together(2, folder)


def close(found, expected, name):
    for one, two in zip(found, expected, strict=True):
        one, two = np.asarray(one), np.asarray(two)
        assert one.shape == two.shape, name
        np.testing.assert_allclose(one, two, rtol=TOLERANCE, atol=TOLERANCE * np.max(np.abs(two)), err_msg=name)


def test_each_process_holds_its_part_only(runs):
    one, *two = runs
    assert one["processes"] == 1
    assert one["parts"][0][0] == 5
    for part in two:
        assert part["processes"] == 2
        assert [shape[0] for shape in part["parts"]] == [3]  # of six, one of them a copy that counts for nothing


@pytest.mark.parametrize("name", ["fit", "posterior", "likelihood", "least squares"])
def test_two_processes_give_the_numbers_of_one(runs, name):
    one, *two = runs
    for part in two:
        close(part[name], one[name], name)


def test_both_processes_write_the_same_json(runs):
    _, first, second = runs
    assert first["json"] == second["json"]
    assert first["fit"] == second["fit"]
    assert first["posterior"] == second["posterior"]
