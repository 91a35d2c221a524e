"""The runner notices what it must, goes on behind it, and gives the same inputs again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from random import Random

import pytest
from mutators import mutate
from runner import Watched, run, shares
from targets import READERS
from worker import case_of

pytestmark = pytest.mark.extended

ROOT = Path(__file__).parents[2]


def test_every_fault_is_noticed_and_kept(tmp_path):
    plan = shares("bad_targets", 9)
    table = run(Watched("bad_targets", plan, 0, tmp_path, seconds=0.5, double=False))
    assert [(v["refused"], v["read"], v["failures"]) for v in table.values()] == [
        (0, 1, 0),
        *[(0, 0, 1)] * 7,
        (1, 0, 0),
    ]
    kept = {file.parents[2].name: file for file in tmp_path.glob("*/*/0/failure.txt")}
    kinds = {name: file.parents[1].name for name, file in kept.items()}
    assert kinds["fault_1"].startswith("KeyError")
    assert kinds["fault_2"] == "hang"
    assert kinds["fault_3"].startswith("MemoryError")
    assert kinds["fault_4"] == "died-6"
    assert kinds["fault_5"] == "message"
    assert kinds["fault_6"].startswith("UserWarning")
    assert kinds["fault_7"] == "left"
    assert len(kinds) == 7
    for name in ("fault_1", "fault_2", "fault_4"):  # where it was, even of a process that hung or died
        assert "bad_targets.py" in kept[name].read_text()
    assert "--seed 0 --first 0 --inputs 1" in kept["fault_1"].read_text()
    assert (kept["fault_2"].with_name("number")).read_bytes() == b"2"


def test_inputs_are_told_by_seed_and_number():
    for reader in READERS:
        assert case_of(reader, 3, 17) == case_of(reader, 3, 17)
        assert any(case_of(reader, 3, 17) != case_of(reader, 3, number) for number in (18, 19, 20))
        assert any(case_of(reader, 3, number) != case_of(reader, 4, number) for number in (17, 18, 19))


def test_damage_keeps_files_small():
    rng = Random(0)
    assert max(len(mutate(rng, b"1,2\n" * 99, b"x")) for _ in range(300)) <= 1 << 20


def test_the_command_names_what_it_did(tmp_path):
    command = [sys.executable, "-m", "tests.fuzzing", "--inputs", "20", "--only", "diameters", "--out", tmp_path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "diameters" in done.stdout
    assert "20 inputs with seed 0" in done.stdout
