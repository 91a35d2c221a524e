import os
import shutil

import pytest
from asserting import refused, snapshot

from mcc_jax import calibrate
from mcc_jax.cli import calibrate as command

PROGRAMMES = {
    "never leaves zero": ("rate = 1\n[[step]]\nramp_to = 0\n", "zero"),
    "endless": ("rate = 1e-30\n[[step]]\nramp_to = 1\n", "higher rate"),
    "too many points": ("rate = 1\npoints = 1000000000\n[[step]]\nramp_to = 1\n", "fewer points"),
}


@pytest.mark.parametrize("kind", PROGRAMMES)
def test_bad_programme(run, tmp_path, kind):
    text, word = PROGRAMMES[kind]
    (tmp_path / "steps.toml").write_text(text)
    line = refused(run("simulate", "--programme", tmp_path / "steps.toml", "--out", tmp_path / "sim"))
    assert word in line
    assert "steps.toml" in line
    assert not (tmp_path / "sim").exists()


# {c}: a campaign, {d}: a damaged one, {f}: a file, {n}: nothing there, {o}: a folder with old results
COMMAND_LINES = {
    "calibrate {d} --out {o}": "damaged/curves.csv, row 3, column 'force_mN': 'nan'",
    "calibrate {d} --out {n}": "damaged/curves.csv, row 3, column 'force_mN': 'nan'",
    "calibrate {o} --out {n}": "particles.csv is missing",
    "calibrate {n} --out {o}": "no such folder",
    "calibrate {f} --out {o}": "not a campaign folder",
    "calibrate {c}/curves.csv --out {o}": "is a file, not a campaign folder",
    "calibrate {c} --out {f}": "is a file, not a folder",
    "calibrate {c} --out /proc/nothing/here --no-figures": "cannot be written",
    "calibrate {c} --out {o} --method paper --reference Z": "'Z'",
    "calibrate {c} --out {o} --reference A": "belongs to --method paper",
    "calibrate {c} --out {o} --priors {n}": "no such file",
    "calibrate {c} --out {o} --threshold-MPa -1": "-1.0 is not in the range x>=0",
    "calibrate {c} --out {o} --threshold-MPa nan": "'nan'",
    "calibrate {c} --out {o} --method paper --threshold-MPa 1000": "usable particles",
    "calibrate {c} --out {o} --threshold-MPa 1000": "no particle can be used",
    "calibrate {c} --out {o} --seed -1": "--seed",
    "calibrate {c} --out ": "--out",
    "calibrate --out {o}": "Missing argument 'CAMPAIGN'",
    "calibrate {c} --out {o} --no-figure": "--no-figures",
    "calibrat {c} --out {o}": "'calibrate'",
    "discover {c} --out {o} --exclude wobble": "frame_compliance, thermal_drift",
    "discover {c} --out {o} --held-out": "--no-held-out",
    "--nonsense": "--nonsense",
    "demo --out {f}": "is a file",
    "convert {n} --out {o} --diameters 1,2,3": "no such file",
    "convert {f} --out {o} --diameters 1,2,3": "--mapping",
    "convert {c}/curves.csv --out {o} --mapping {f}": "TOML",
    "simulate --out {o} --particles {c}/curves.csv": "curves.csv, row 3",
    "simulate --out {o} --programme {n}": "there is no such file",
    "simulate --out {o} --programme {f} --rate 1": "--programme",
    "simulate --out {o} --points 9 --interval-s 1": "--points",
    "simulate --out {o} --interval-s 1e-9": "rows",
    "simulate --out {o} --rate 1e-15": "higher rate",
    "simulate --out {o} --hold-s inf": "--hold-s",
    "simulate --out {o} --levels 0.5,,1": "--levels",
    "simulate --out {o} --unload-to 0.1": "two --levels",
    "simulate --out {o} --levels 0.5,1 --unload-to 0.6": "--unload-to",
    "simulate --out {o} --peak-stress 16:7": "LOW:HIGH",
    "simulate --out {o} --peak-strain 0.3": "--control displacement",
    "simulate --out {o} --control displacement --peak-strain 0.3 --peak-stress 5": "--peak-stress",
    "simulate --out {o} --control displacement --peak-strain 1e9": "less extreme values",
    "simulate --out {o} --a -5": "shape factor",
    "simulate --out {o} --unloading wrong": "'printed', 'punch', 'punch_exact'",
    "simulate --out {o} --resolution-mN 1e9": "zero",
    "simulate --out {o} --effect wobble": "Known: frame_compliance, thermal_drift",
    "simulate --out {o} --effect humidity": "relative_humidity_percent",
}


@pytest.mark.parametrize("line", COMMAND_LINES)
def test_bad_command_line(run, simulated, tmp_path, line):
    file, old = tmp_path / "file.txt", tmp_path / "old"
    file.write_text("nothing of use\n")
    old.mkdir()
    (old / "calibration.json").write_text("old")
    damaged = shutil.copytree(simulated, tmp_path / "damaged")
    (damaged / "curves.csv").write_text("particle,time_s,force_mN,displacement_um\nA,0,0,0\nA,1,nan,1\n")
    before = snapshot(tmp_path)
    places = {"c": simulated, "d": damaged, "f": file, "n": tmp_path / "nothing", "o": old}
    line_shown = refused(run(*(word.format(**places) for word in line.split(" "))))
    assert COMMAND_LINES[line] in line_shown
    assert snapshot(tmp_path) == before


def test_control_characters_and_line_breaks_stay_in_one_line(run, tmp_path):
    assert "\ufffd" in refused(run("calibrate", "no\n\x1b[31msuch", "--out", tmp_path / "fit"))
    refused(run("calibrate", "x", "--out", tmp_path / "fit", "--method", "a\nb"))
    refused(run("cali\nbrate"))
    if os.name != "nt":  # a name of undecodable bytes
        refused(run("calibrate", os.fsdecode(b"bad\xff"), "--out", tmp_path / "fit"))


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (RuntimeError("two\nlines"), 1, "internal error: RuntimeError: two lines. This is a defect"),
        (KeyError("name"), 1, "internal error: KeyError"),
        (MemoryError(), 2, "not enough memory"),
        (OSError(28, "No space left on device"), 2, "No space left"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (BrokenPipeError(), 0, ""),
    ],
)
def test_whatever_is_raised_leaves_old_results(run, simulated, tmp_path, monkeypatch, error, status, words):
    old = tmp_path / "old"
    old.mkdir()
    (old / "calibration.json").write_text("old")
    (old / "note.txt").write_text("a file of the user's")

    def fail(calibration, stage, **_):
        (stage.folder / "calibration.json").write_text("half")
        raise error

    monkeypatch.setattr(calibrate, "sample", lambda *_, **__: None)
    monkeypatch.setattr(command, "write_result", fail)
    monkeypatch.delenv("MCC_JAX_DEBUG", raising=False)
    before = snapshot(tmp_path)
    for out in (old, tmp_path / "new"):
        result = run("calibrate", simulated, "--out", out)
        assert result.exit_code == status
        assert words in result.stderr
        assert result.stderr.count("\n") == (1 if words else 0)
        assert "Traceback" not in result.stderr
        assert snapshot(tmp_path) == before


def test_debug_shows_the_traceback_of_a_defect_only(run, simulated, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("planted")

    monkeypatch.setattr(command, "write_result", fail)
    arguments = ["calibrate", simulated, "--out", tmp_path / "fit", "--method", "paper"]
    result = run("--debug", *arguments)
    assert (result.exit_code, "Traceback" in result.stderr) == (1, True)
    monkeypatch.setenv("MCC_JAX_DEBUG", "1")
    assert "Traceback" in run(*arguments).stderr
    refused(run("calibrate", tmp_path / "nothing", "--out", tmp_path / "fit"))
