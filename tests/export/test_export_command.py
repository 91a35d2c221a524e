import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from asserting import estimate, refused
from calibrations import content, write
from compiling import PAIR, PLATES, WALL, build_driver, head, run_driver

from mcc_jax.cli.outputs import FORMATS as OFFERED
from mcc_jax.export import FORMATS, read_calibration

FILES = {
    "json": {"parameters.json", "parameters_golden.csv"},
    "csv": {"master_curve.csv", "unloading_curve.csv", "master_curve.json", "master_curve_golden.csv"},
    "c": {"mcc_law.h", "mcc_law_golden.csv", "mcc_law_pair_golden.csv"},
    "lammps": {"lammps.md", "mcc_law.h", "mcc_law_golden.csv", "mcc_law_pair_golden.csv"},
    "yade": {"yade.md", "mcc_law.h", "mcc_law_golden.csv", "mcc_law_pair_golden.csv"},
}


def test_the_command_offers_what_there_is():
    assert OFFERED == FORMATS


@pytest.mark.parametrize("form", FILES)
def test_writes_the_artefact_and_its_golden_table(run, tmp_path, form):
    folder = write(tmp_path / "fit")
    result = run("export", folder, "--format", form, "--out", tmp_path / "out")
    assert (result.exit_code, result.stderr) == (0, "")
    assert {p.name for p in (tmp_path / "out").iterdir()} == FILES[form]
    for name in FILES[form]:
        assert f"  {name}\n" in result.stdout
    again = run("export", folder, "--format", form, "--out", tmp_path / "again")
    assert again.exit_code == 0
    for name in FILES[form]:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


@pytest.mark.extended
def test_the_header_passes_its_own_golden_tables(run, tmp_path):
    """As a user would: the files alone, whatever the calibration was."""
    folder, out = write(tmp_path / "fit"), tmp_path / "out"
    assert run("export", folder, "--format", "c", "--out", out, "--particle", "b c", "--seed", 7).exit_code == 0
    program = build_driver(tmp_path, (out / "mcc_law.h").read_text())
    law, particle, _ = read_calibration(folder, particle="b c")
    size = np.array([[float(d) for d in (particle.D1, particle.D2, particle.D3)]])
    single, pair = pd.read_csv(out / "mcc_law_golden.csv"), pd.read_csv(out / "mcc_law_pair_golden.csv")
    partners = (("equal", PAIR, size), ("smaller", PAIR, 0.6 * size), ("wall", WALL, size))
    cases = [(kind, pair[pair["partner"] == name], other) for name, kind, other in partners]
    for kind, table, other in [(PLATES, single, size), *cases]:
        assert table["path"].nunique() == 10  # the last one of small peaks, where the recovery is limited
        for _, rows in table.groupby("path"):
            x = rows["displacement_m"].to_numpy()[None]
            force, tangent, peak = run_driver(program, head(kind, x.shape[1], law, size, other), x)
            assert np.abs(force[0] - rows["force_N"]).max() <= 1e-12 * table["force_N"].max()
            assert np.abs(tangent[0] - rows["tangent_N_per_m"]).max() <= 1e-9 * table["tangent_N_per_m"].max()
            np.testing.assert_allclose(peak[0], rows["displacement_max_m"], rtol=1e-15)


def test_options_arrive(run, tmp_path):
    folder, out = write(tmp_path / "fit"), tmp_path / "out"
    arguments = (folder, "--format", "json", "--out", out)
    assert run("export", *arguments, "--diameters", "120,110,100", "--particle", "A", "--seed", 3).exit_code == 0
    written = json.loads((out / "parameters.json").read_text())
    assert written["coefficients_of"] == "A"
    assert written["particle"]["D2_um"] == 110.0
    first = (out / "parameters_golden.csv").read_text()
    table = tmp_path / "particles.csv"
    table.write_text("particle,D1_um,D2_um,D3_um\nA,200,190,160\n")
    assert run("export", *arguments, "--diameters", table, "--particle", "A").exit_code == 0
    written = json.loads((out / "parameters.json").read_text())["particle"]
    assert (written["D2_um"], written["from"]) == (190.0, "particle A of particles.csv")
    assert run("export", *arguments, "--diameters", table, "--particle", "b c").exit_code == 2
    assert (out / "parameters_golden.csv").read_text() != first


def test_what_is_not_monotone_or_did_not_converge_is_exported_and_said(run, tmp_path):
    folder, out = write(tmp_path / "fit", converged=False, warnings=["the chains disagree"]), tmp_path / "out"
    arguments = (folder, "--out", out, "--particle", "falling", "--format")
    assert "--allow-not-monotone" in refused(run("export", *arguments, "c"))
    assert not out.exists()
    for form in ("c", "json"):
        result = run("export", *arguments, form, "--allow-not-monotone")
        assert result.exit_code == 0
        assert "Warning: The calibration of calibration.json did not converge." in result.stdout
        assert "Warning: The chains disagree." in result.stdout
        assert "Warning: The loading curve is not monotone" in result.stdout
    header = (out / "mcc_law.h").read_text()
    assert "WARNING: the loading curve is not monotone" in header
    assert "WARNING: that calibration did not converge" in header
    written = json.loads((out / "parameters.json").read_text())
    assert written["is_monotone"] is False
    assert "not monotone" in written["warnings"][-1]


def changed(**changes):
    return lambda folder: (folder / "calibration.json").write_text(json.dumps(content(**changes)))


BAD = {
    "no folder": (lambda f: [p.unlink() for p in f.iterdir()] and f.rmdir(), (), "no such folder"),
    "no calibration": (lambda f: (f / "calibration.json").unlink(), (), "calibration.msgpack is missing"),
    "no modulus": (changed(effective_modulus_MPa=estimate(None)), (), "no effective modulus"),
    "negative modulus": (changed(effective_modulus_MPa=estimate(-1.0)), (), "must be positive"),
    "huge modulus": (changed(effective_modulus_MPa=estimate(1e300)), (), "all below 1e+44"),
    "huge mean": (changed(log_C1={"mean": estimate(1e6), "sd": estimate(0.1)}), (), "no sensible value"),
    "steep shape": (changed(a=estimate(-20.0)), (), "the shape factor"),
    "unknown particle": (None, ("--particle", "Z"), "There are: A, b c, falling, out"),
    "particle left out": (None, ("--particle", "out"), "took no part in the calibration: burst at 3 mN"),
    "two diameters": (None, ("--diameters", "1,2"), "1,2: there is no such file"),
    "zero diameter": (None, ("--diameters", "1,0,2"), "--diameters"),
    "empty diameters": (None, ("--diameters", " "), "--diameters"),
    "seed": (None, ("--seed", "-1"), "--seed"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_is_one_line_and_writes_nothing(run, tmp_path, kind):
    damage, options, words = BAD[kind]
    folder, out = write(tmp_path / "fit"), tmp_path / "out"
    if damage is not None:
        damage(folder)
    line = refused(run("export", folder, "--format", "c", "--out", out, *options))
    assert words in line
    assert not out.exists()
    out.mkdir()
    (out / "mcc_law.h").write_text("old")
    refused(run("export", folder, "--format", "c", "--out", out, *options))
    assert [p.read_text() for p in out.iterdir()] == ["old"]


@pytest.mark.extended
def test_help_does_not_import_jax():
    code = "import sys; sys.argv = ['mcc-jax', 'export', '--help']; from mcc_jax.cli import run\n"
    code += "try:\n    run()\nexcept SystemExit:\n    assert 'jax' not in sys.modules\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "--allow-not-monotone" in done.stdout
