import os

import pytest
from asserting import refused, snapshot

from mcc_jax import calibrate
from mcc_jax.cli import calibrate as command


def edit(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def fourth_row(folder, cells):
    lines = (folder / "curves.csv").read_text().splitlines()
    lines[3] = cells
    (folder / "curves.csv").write_text("\n".join(lines) + "\n")


def zero_campaign(folder):
    lines = (folder / "curves.csv").read_text().splitlines()
    rows = [",".join([*line.split(",")[:2], "0", "0"]) for line in lines[1:]]
    (folder / "curves.csv").write_text("\n".join([lines[0], *rows]) + "\n")


DAMAGE = {
    "no curves": (lambda c: (c / "curves.csv").unlink(), ["curves.csv is missing"]),
    "no column": (
        lambda c: edit(c / "curves.csv", "force_mN", "load_mN"),
        ["curves.csv", "row 1", "'force_mN' is missing"],
    ),
    "NaN": (lambda c: fourth_row(c, "A,2,nan,1"), ["curves.csv", "row 4", "'force_mN'", "nan"]),
    "all zero": (zero_campaign, ["curves.csv", "zero"]),
    "particle without diameters": (
        lambda c: edit(c / "particles.csv", "C,97.56", "D,97.56"),
        ["particles.csv", "row 4", "'D'"],
    ),
    "bad metadata": (lambda c: (c / "campaign.toml").write_text("control = \n"), ["campaign.toml", "row 1", "TOML"]),
    "binary": (lambda c: (c / "curves.csv").write_bytes(b"\0\1\2" * 99), ["curves.csv", "binary"]),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_campaign(run, campaign, tmp_path, kind):
    damage, words = DAMAGE[kind]
    damage(campaign)
    out = tmp_path / "fit"
    line = refused(run("calibrate", campaign, "--out", out))
    for word in words:
        assert word in line
    assert not out.exists()
    out.mkdir()
    (out / "calibration.json").write_text("old")
    refused(run("calibrate", campaign, "--out", out))
    assert snapshot(out) == {"calibration.json": b"old"}


PROGRAMMES = {
    "not toml": ("rate = = 2\n", "steps.toml"),
    "no step": ("rate = 2\n", "step"),
    "misspelt": ("rat = 2\n[[step]]\nramp_to = 1\n", "rat"),
    "no rate": ("[[step]]\nramp_to = 1\n", "step 1"),
    "text for a number": ('rate = "fast"\n[[step]]\nramp_to = 1\n', "'fast'"),
    "never leaves zero": ("rate = 1\n[[step]]\nramp_to = 0\n", "zero"),
    "both": ("rate = 1\npoints = 3\ninterval_s = 1\n[[step]]\nramp_to = 1\n", "interval_s"),
    "endless": ("rate = 1e-30\n[[step]]\nramp_to = 1\n", "rate"),
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


# {c}: a campaign, {f}: a file, {n}: nothing there, {o}: a folder with old results
COMMAND_LINES = {
    "calibrate {n} --out {o}": "no such folder",
    "calibrate {f} --out {o}": "not a campaign folder",
    "calibrate {c}/curves.csv --out {o}": "is a file, not a campaign folder",
    "calibrate {o} --out {o}": "particles.csv is missing",
    "calibrate {c} --out {f}": "is a file, not a folder",
    "calibrate {c} --out {f}/below/it --no-figures": "cannot be written",
    "calibrate {c} --out /proc/nothing/here --no-figures": "cannot be written",
    "calibrate {c} --out {o} --method paper --reference Z": "'Z'",
    "calibrate {c} --out {o} --reference A": "belongs to --method paper",
    "calibrate {c} --out {o} --method paper --draws 100": "belongs to --method bayes",
    "calibrate {c} --out {o} --loss cauchy": "belongs to --method least-squares",
    "calibrate {c} --out {o} --draws 3": "--draws",
    "calibrate {c} --out {o} --priors {n}": "no such file",
    "calibrate {c} --out {o} --threshold-MPa -1": "-1.0 is not in the range x>=0",
    "calibrate {c} --out {o} --threshold-MPa nan": "'nan'",
    "calibrate {c} --out {o} --method paper --threshold-MPa 1000": "usable particles",
    "calibrate {c} --out {o} --threshold-MPa 1000": "no particle can be used",
    "calibrate {c} --out {o} --method mcmc": "'mcmc'",
    "calibrate {c} --out {o} --seed -1": "--seed",
    "calibrate {c} --out ": "--out",
    "calibrate {c}": "Missing option '--out'",
    "calibrate --out {o}": "Missing argument 'CAMPAIGN'",
    "calibrate {c} {c} --out {o}": "unexpected extra argument",
    "calibrate {c} --out {o} --no-figure": "--no-figures",
    "calibrat {c} --out {o}": "'calibrate'",
    "discover {c} --out {o} --exclude wobble": "--exclude takes one of: frame_compliance, thermal_drift",
    "discover {c} --out {o} --held-out": "--no-held-out",
    "rapport {c} --out {o}": "No such command 'rapport'",
    "report {n} --out {o}": "No such file or directory",
    "report {f} --out {o}": "Not a directory",
    "report {c} --out {o} --campaign {n}": "no such folder",
    "report --out {o}": "Missing argument 'DIR'",
    "--nonsense": "--nonsense",
    "demo --out {f}": "is a file",
    "demo extra --out {o}": "extra",
    "convert {n} --out {o} --diameters 1,2,3": "no such file",
    "convert {f} --out {o} --diameters 1,2,3": "--mapping",
    "convert {f} --out {o} --diameters 1,2,x": "--diameters",
    "convert {f} --out {o} --diameters {n}": "no such file",
    "convert {f} --out {o} --mapping {n}": "no such file",
    "convert {c}/curves.csv --out {o} --mapping {f}": "TOML",
    "simulate --out {o} --particles {n}": "no such file",
    "simulate --out {o} --particles {c}/curves.csv": "curves.csv, row 3",
    "simulate --out {o} --programme {n}": "no such file",
    "simulate --out {o} --programme {f} --rate 1": "--programme",
    "simulate --out {o} --points 9 --interval-s 1": "--points",
    "simulate --out {o} --points 1": "--points",
    "simulate --out {o} --interval-s 1e-9": "rows",
    "simulate --out {o} --rate 0": "--rate",
    "simulate --out {o} --rate 1e-15": "higher rate",
    "simulate --out {o} --hold-s inf": "--hold-s",
    "simulate --out {o} --levels 0.5,,1": "--levels",
    "simulate --out {o} --unload-to 0.1": "two --levels",
    "simulate --out {o} --levels 0.5,1 --unload-to 0.6": "--unload-to",
    "simulate --out {o} --peak-stress 16:7": "LOW:HIGH",
    "simulate --out {o} --peak-stress -3": "--peak-stress",
    "simulate --out {o} --peak-strain 0.3": "--control displacement",
    "simulate --out {o} --control displacement --peak-strain 0.3 --peak-stress 5": "--peak-stress",
    "simulate --out {o} --control displacement --peak-strain 1e9": "less extreme values",
    "simulate --out {o} --control force": "'force'",
    "simulate --out {o} --shared-material --C1 7 --C3 2 --C5 2": "--shared-material",
    "simulate --out {o} --C1 0": "--C1",
    "simulate --out {o} --a -5": "shape factor",
    "simulate --out {o} --unloading wrong": "'printed', 'punch', 'punch_exact'",
    "simulate --out {o} --noise-um -1": "--noise-um",
    "simulate --out {o} --resolution-mN 1e9": "zero",
    "simulate --out {o} --effect wobble": "Known: frame_compliance, thermal_drift",
    "simulate --out {o} --effect creep:wobble": "it has: kelvin_voigt",
    "simulate --out {o} --effect creep=-1": ">= 0",
    "simulate --out {o} --effect creep,tau=3": "it has: creep_compliance_per_MPa, tau_s",
    "simulate --out {o} --effect humidity": "relative_humidity_percent",
}


@pytest.mark.parametrize("line", COMMAND_LINES)
def test_bad_command_line(run, simulated, tmp_path, line):
    file, old = tmp_path / "file.txt", tmp_path / "old"
    file.write_text("nothing of use\n")
    old.mkdir()
    (old / "calibration.json").write_text("old")
    before = snapshot(tmp_path)
    places = {"c": simulated, "f": file, "n": tmp_path / "nothing", "o": old}
    told = refused(run(*(word.format(**places) for word in line.split(" "))))
    assert COMMAND_LINES[line] in told
    assert snapshot(tmp_path) == before


def test_load_control_programme_has_no_peak_strain(run, tmp_path):
    (tmp_path / "p.toml").write_text("rate = 1\n[[step]]\nramp_to = 1\n")
    line = refused(run("simulate", "--out", tmp_path / "o", "--programme", tmp_path / "p.toml", "--peak-strain", "0.2"))
    assert "--peak-stress" in line


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
    monkeypatch.setattr(command, "write_calibration", fail)
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

    monkeypatch.setattr(command, "write_calibration", fail)
    arguments = ["calibrate", simulated, "--out", tmp_path / "fit", "--method", "paper"]
    result = run("--debug", *arguments)
    assert (result.exit_code, "Traceback" in result.stderr) == (1, True)
    monkeypatch.setenv("MCC_JAX_DEBUG", "1")
    assert "Traceback" in run(*arguments).stderr
    refused(run("calibrate", tmp_path / "nothing", "--out", tmp_path / "fit"))
