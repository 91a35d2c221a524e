"""`mcc-jax report`: where it writes, and what it says of files that it cannot use."""

import json
import shutil

import numpy as np
import pytest
from asserting import refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from results_folder import calibration, discovery

from mcc_jax import InputError
from mcc_jax.campaign import file_checksums
from mcc_jax.report import read_results
from mcc_jax.report.chart import compare
from mcc_jax.report.lights import lights
from mcc_jax.report.page import _environment, context


def test_the_page_lies_in_the_folder_or_where_out_says(run, folder, tmp_path):
    result = run("report", folder)
    assert (result.exit_code, result.stderr) == (0, ""), result.exception
    assert "Open it in a browser" in result.stdout
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>")
    assert run("report", folder, "--out", tmp_path / "new" / "there").exit_code == 0
    assert (tmp_path / "new" / "there" / "report.html").read_text(encoding="utf-8") == page


DAMAGE = {
    "no JSON": ("calibration.json", b"{\n\n1", "row 3"),
    "not text": ("discovery.json", b"\xff\xfe\x00", "is no JSON"),
    "not finite": ("calibration.json", b'{"schema": NaN}', "NaN"),
    "too deep": ("calibration.json", b"[" * 100_000, "is no JSON"),
    "a list": ("discovery.json", b"[]", "does not hold what it should"),
    "another schema": ("calibration.json", b'{"schema": 2}', "schema 2, this mcc-jax knows 1"),
    "a bad campaign": ("particles.csv", b"particle,D1_um\n1,2\n", "D2"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_told_in_one_line_and_nothing_is_lost(run, folder, name):
    file, content, words = DAMAGE[name]
    (folder / "report.html").write_text("the old page")
    (folder / file).write_bytes(content)
    line = refused(run("report", folder))
    assert file in line
    assert words in line
    assert (folder / "report.html").read_text() == "the old page"


def test_a_wrong_value_is_told_with_its_place(run, folder):
    content = calibration()
    content["particles"][1]["C3"]["value"] = "three"
    (folder / "calibration.json").write_text(json.dumps(content))
    line = refused(run("report", folder))
    assert "particles[1].C3.value" in line
    assert "mcc-jax calibrate" in line


def test_folders_without_results(run, folder, tmp_path):
    assert "no such folder" in refused(run("report", tmp_path / "none"))
    assert not (tmp_path / "none").exists()
    assert "is a file" in refused(run("report", folder / "calibration.json"))
    (tmp_path / "empty").mkdir()
    assert "nothing to report" in refused(run("report", tmp_path / "empty"))
    assert "curves.csv" in refused(run("report", folder, "--campaign", tmp_path / "empty"))
    assert list((tmp_path / "empty").iterdir()) == []


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers(-(10**400), 10**400) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=4,
)


def places(value, path=()):
    """Paths to all that stands inside a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*path, key)
        yield from places(item, (*path, key))


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("scratch")


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_whatever_stands_in_a_result_it_is_refused_or_shown(scratch, data):
    """One place replaced or removed: `InputError`, or a page; never another error."""
    name, content = data.draw(
        st.sampled_from([("calibration.json", calibration()), ("discovery.json", discovery(parameters_after={}))])
    )
    path = data.draw(st.sampled_from(sorted(places(content), key=str)))
    inside = content
    for key in path[:-1]:
        inside = inside[key]
    if data.draw(st.booleans()):
        del inside[path[-1]]
    else:
        inside[path[-1]] = data.draw(JSON)
    shutil.rmtree(scratch)
    scratch.mkdir()
    (scratch / name).write_text(json.dumps(content))
    try:
        found = read_results(scratch)
    except InputError as error:
        told = str(error)
    else:
        told = _environment().get_template("page.html").render(context(found, []), seed=0)
        assert lights(found)
    assert name in told


def test_from_raw_tests_to_the_page_by_the_papers_method(run, folder, tmp_path):
    """The page recomputes from `calibration.json` what the calibration itself had found."""
    fit = tmp_path / "fit"
    result = run("calibrate", folder, "--out", fit, "--method", "paper", "--no-figures", "--threshold-MPa", "0.5")
    assert result.exit_code == 0, result.output
    content = json.loads((fit / "calibration.json").read_text(encoding="utf-8"))
    told = content["provenance"]
    assert told["settings"] == {
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
    assert told["campaign"] == {"folder": str(folder.resolve()), "sha256": file_checksums(folder)}
    assert set(told["versions"]) >= {"mcc_jax", "jax", "python"}
    found = read_results(fit)
    assert found.cautions == ()
    for one, entry in zip(compare(found), content["particles"], strict=True):
        typical = (one.displacement_um - one.typical_um)[one.used]
        assert one.rms_um == pytest.approx(entry["own_rms_um"], rel=1e-9)
        assert np.sqrt(np.mean(typical**2)) == pytest.approx(entry["rms_um"], rel=1e-9)
    assert run("report", fit).exit_code == 0
    assert (fit / "report.html").is_file()
