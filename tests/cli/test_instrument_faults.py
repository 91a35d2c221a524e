"""What the instrument did is told by every command, in the files and on the page; particles can be left out by name."""

import json

import faulty
import numpy as np
import pytest
from asserting import done, refused
from helpers import assert_holds

from mcc_jax.campaign import Campaign, write_campaign

pytestmark = pytest.mark.extended

FIT = ("--method", "paper", "--no-figures")


@pytest.fixture(scope="module")
def tests(tmp_path_factory):
    """Five particles with an offset in the air, of which the third breaks; do not write into it."""
    folder = tmp_path_factory.mktemp("faulty") / "campaign"
    campaign = faulty.in_air(faulty.broken(faulty.campaign(5), only=("3",)), offset_mN=20.0)
    write_campaign(campaign, folder)
    return folder


@pytest.fixture(scope="module")
def fitted(run, tests, tmp_path_factory):
    """`calibrate`, then `report`: what was printed, and the folder."""
    out = tmp_path_factory.mktemp("fitted") / "out"
    printed = done(run("calibrate", tests, "--out", out, *FIT))
    done(run("report", out, "--campaign", tests))
    return printed, out


def test_findings_are_in_the_result_on_the_terminal_and_on_the_page(fitted):
    printed, out = fitted
    content = json.loads((out / "calibration.json").read_text())
    found = {one["check"]: one for one in content["findings"]}
    assert found["zero of force"]["level"] == "info"
    assert found["breakage"]["particles"] == ["3"]
    assert "without it the modulus is" in found["breakage"]["sentence"]
    for one in found.values():
        assert one["sentence"] in " ".join(printed.split())
    for entry in content["particles"]:
        assert entry["force_zero_mN"]["value"] == pytest.approx(20.0, abs=0.1)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert_holds(page, ["Tests: breakage", "the particle broke at", "Tests: zero of force"])


def test_leave_out_takes_particles_out_by_name(run, tests, tmp_path):
    done(run("calibrate", tests, "--out", tmp_path / "out", "--leave-out", "3", "--leave-out", "5", *FIT))
    content = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert [entry["particle"] for entry in content["particles"]] == ["1", "2", "4"]
    assert [one["check"] for one in content["findings"]] == ["zero of force"]
    assert content["provenance"]["settings"]["leave_out"] == ["3", "5"]


def test_leave_out_refuses_a_name_that_is_not_there(run, tests, tmp_path):
    line = refused(run("calibrate", tests, "--out", tmp_path / "out", "--leave-out", "33", *FIT))
    assert "there is no particle '33'. There are: 1, 2, 3, 4, 5" in line
    everything = [word for name in "12345" for word in ("--leave-out", name)]
    assert "no particle would be left" in refused(run("calibrate", tests, "--out", tmp_path / "out", *everything, *FIT))


def test_a_calibration_that_did_not_converge_ends_with_status_3(run, tmp_path):
    """Tests that never unload have no modulus in the paper's method."""

    def loading(time, force, path):
        top = int(np.argmax(force))
        return time[:top], force[:top], path[:top]

    write_campaign(faulty.changed(faulty.campaign(4), loading), tmp_path / "loading")
    result = run("calibrate", tmp_path / "loading", "--out", tmp_path / "out", *FIT)
    assert (result.exit_code, result.stderr) == (3, "")
    assert "NOT converged" in result.stdout
    assert json.loads((tmp_path / "out" / "calibration.json").read_text())["converged"] is False
    as_json = run("calibrate", tmp_path / "loading", "--out", tmp_path / "again", "--json", *FIT)
    assert as_json.exit_code == 3
    assert json.loads(as_json.stdout)["effective_modulus_MPa"]["value"] is None


def test_convert_reports_what_it_finds(run, tmp_path):
    """A mapped file of one test with an offset of force."""
    one: Campaign = faulty.in_air(faulty.campaign(1), offset_mN=20.0)
    one.to_dataframe().to_csv(tmp_path / "air.csv", index=False)
    (tmp_path / "m.toml").write_text(
        'delimiter = "comma"\ndecimal_mark = "."\n[columns]\n'
        'time = { column = "time_s", unit = "s" }\nforce = { column = "force_mN", unit = "mN" }\n'
        'displacement = { column = "displacement_um", unit = "um" }\n'
    )
    mapping = ("--mapping", tmp_path / "m.toml", "--diameters", "213.54,196.07,186.33")
    text = done(run("convert", tmp_path / "air.csv", "--out", tmp_path / "out", *mapping))
    assert "mN before contact" in " ".join(text.split())
