"""`mcc-jax report`: where it writes, and what it says of files that it cannot use."""

import json

import numpy as np
import pytest
from asserting import refused

from mcc_jax.campaign import file_checksums
from mcc_jax.report import read_results
from mcc_jax.report.chart import compare


def test_the_page_lies_in_the_folder_or_where_out_says(run, folder, tmp_path):
    result = run("report", folder)
    assert (result.exit_code, result.stderr) == (0, ""), result.exception
    assert "Open it in a browser" in result.stdout
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>")
    assert run("report", folder, "--out", tmp_path / "new" / "there").exit_code == 0
    assert (tmp_path / "new" / "there" / "report.html").read_text(encoding="utf-8") == page


DAMAGE = {
    "no JSON": ("calibration.json", b"{\n\n1", "is damaged"),
    "not text": ("discovery.json", b"\xff\xfe\x00", "is damaged"),
    "too deep": ("calibration.json", b"[" * 100_000, "is damaged"),
    "a wrong value": ("discovery.json", b'{"provenance": {"campaign": 3}}', "$.provenance.campaign"),
    "a damaged archive": ("calibration.msgpack", b"\x90", "cut off"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_reported_in_one_line_and_nothing_is_lost(run, folder, name):
    file, content, words = DAMAGE[name]
    (folder / "report.html").write_text("the old page")
    (folder / file).write_bytes(content)
    line = refused(run("report", folder))
    assert file in line
    assert words in line
    assert (folder / "report.html").read_text() == "the old page"


def test_json_alone_is_no_result(run, folder):
    (folder / "calibration.msgpack").unlink()
    assert "calibration.msgpack is missing next to calibration.json" in refused(run("report", folder))


def test_folders_without_results(run, folder, tmp_path):
    assert "No such file or directory" in refused(run("report", tmp_path / "none"))
    assert not (tmp_path / "none").exists()
    assert "Not a directory" in refused(run("report", folder / "calibration.json"))
    (tmp_path / "empty").mkdir()
    assert "nothing to report" in refused(run("report", tmp_path / "empty"))
    assert "curves.csv" in refused(run("report", folder, "--campaign", tmp_path / "empty"))
    assert list((tmp_path / "empty").iterdir()) == []


def test_from_raw_tests_to_the_page_by_the_papers_method(run, folder, tmp_path):
    """The page recomputes from `calibration.json` what the calibration itself had found."""
    fit = tmp_path / "fit"
    result = run("calibrate", folder, "--out", fit, "--method", "paper", "--no-figures", "--threshold-MPa", "0.5")
    assert result.exit_code == 0, result.output
    content = json.loads((fit / "calibration.json").read_text(encoding="utf-8"))
    origin = content["provenance"]
    assert origin["settings"] == {
        "command": "calibrate",
        "method": "paper",
        "leave_out": [],
        "threshold_MPa": 0.5,
        "objective": "full",
        "reference": None,
        "unloading": "printed",
        "strain_scaling": "raw",
        "seed": 0,
    }
    assert origin["campaign"] == {"folder": str(folder.resolve()), "sha256": file_checksums(folder)}
    assert set(origin["versions"]) >= {"mcc_jax", "jax", "python"}
    found = read_results(fit)
    assert found.cautions == ()
    for one, entry in zip(compare(found), content["particles"], strict=True):
        typical = (one.displacement_um - one.typical_um)[one.used]
        assert one.rms_um == pytest.approx(entry["own_rms_um"], rel=1e-9)
        assert np.sqrt(np.mean(typical**2)) == pytest.approx(entry["rms_um"], rel=1e-9)
    assert run("report", fit).exit_code == 0
    assert (fit / "report.html").is_file()
