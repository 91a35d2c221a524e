"""`mcc-jax discover` on tests with a compliant frame hidden in them, and on tests without anything hidden."""

import json
import shutil

import pytest
from asserting import done, snapshot
from helpers import assert_holds

from mcc_jax.campaign import PAPER_DIAMETERS_UM
from mcc_jax.discovery.sentences import verdict_in_words
from mcc_jax.effects import LIBRARY

pytestmark = pytest.mark.extended

# What the contract promises; more may be there.
KEYS = {
    *("schema", "verdict", "summary", "effects", "candidate_set", "ranking", "untestable", "where", "closure", "gap"),
    *("parameters_before", "parameters_after", "next_experiments", "runtime_s"),
}
EFFECT = {"mechanism", "variant", "probability", "p_family_wise", "equation", "explanation", "parameters"}
RANKED = {"mechanism", "statistic", "estimate", "detection_limit", "unit"}
PLACE = {"segment", "load_fraction", "strain", "share", "particles"}
STEP = {"added", "chi2_per_dof", "systematic_um", "elpd", "elpd_se"}
ESTIMATE = {"value", "sd", "interval_95"}
HIDDEN = 0.004
QUICK = ("--no-experiments", "--no-posterior")


def check_contract(content):
    assert set(content) >= KEYS
    assert content["schema"] == 1
    assert content["verdict"] in {"NO_GAP", "NAMED", "SET", "UNLISTED", "FIT_NOT_CONVERGED"}
    assert len(content["candidate_set"]) == len(content["effects"])
    for effect, names in zip(content["effects"], content["candidate_set"], strict=True):
        assert set(effect) >= EFFECT
        assert names[0] == effect["mechanism"]
        assert all(set(estimate) == ESTIMATE for estimate in effect["parameters"].values())
    for entry in content["ranking"]:
        assert set(entry) >= RANKED
        assert entry["detection_limit"] > 0
    assert sum(entry["probability"] for entry in content["ranking"]) == pytest.approx(1)
    assert all(set(entry) == {"mechanism", "needs"} for entry in content["untestable"])
    ranked = {entry["mechanism"] for entry in content["ranking"]}
    assert ranked | {entry["mechanism"] for entry in content["untestable"]} == set(LIBRARY)
    for place in content["where"]:
        assert set(place) >= PLACE
        assert 0 < place["share"] <= 1
    gap = content["gap"]
    assert gap["floor"] == 1
    assert all(set(step) >= STEP for step in gap["steps"])
    for estimate in (content["parameters_before"]["a"], content["parameters_before"]["effective_modulus_MPa"]):
        assert set(estimate) == ESTIMATE


@pytest.fixture(scope="module")
def tests(run, tmp_path_factory):
    """Ten particles of the paper's sizes: with a compliant frame, and as the law says."""
    folder = tmp_path_factory.mktemp("tests")
    rows = (f"{i},{D1},{D2},{D3}" for i, (D1, D2, D3) in enumerate(PAPER_DIAMETERS_UM[:10], 1))
    (folder / "ten.csv").write_text("\n".join(["particle,D1_um,D2_um,D3_um", *rows, ""]))
    base = ["simulate", "--particles", folder / "ten.csv", "--points", "150", "--noise-um", "0.02", "--seed", "3"]
    base += ["--levels", "0.5,1,1", "--unload-to", "0.3", "--hold-s", "30", "--peak-stress", "8:14"]
    done(run(*base, "--out", folder / "null"))
    done(run(*base, "--out", folder / "frame", "--effect", f"frame_compliance={HIDDEN}"))
    return folder


@pytest.fixture(scope="module")
def found(run, tests, tmp_path_factory):
    """What the command finds in the tests with the frame: its words, and where its files are."""
    out = tmp_path_factory.mktemp("found") / "new"
    return done(run("discover", tests / "frame", "--out", out, *QUICK)), out


def test_the_frame_is_found_and_its_size(found):
    _, out = found
    content = json.loads((out / "discovery.json").read_text(encoding="utf-8"))
    check_contract(content)
    assert content["verdict"] in {"NAMED", "SET"}
    assert "frame_compliance" in content["candidate_set"][0]
    for effect in content["effects"]:
        if effect["mechanism"] == "frame_compliance" and effect["variant"] == "linear":
            assert effect["parameters"]["compliance_um_per_mN"]["value"] == pytest.approx(HIDDEN, rel=0.2)
    assert content["gap"]["closed_fraction"] > 0.7
    assert content["next_experiments"] == []
    # The frame had been taken for softness of the particles.
    before, after = (content[f"parameters_{when}"]["effective_modulus_MPa"]["value"] for when in ("before", "after"))
    assert before < after


def test_the_command_says_what_it_found(found):
    text, out = found
    content = json.loads((out / "discovery.json").read_text(encoding="utf-8"))
    assert f"Verdict: {verdict_in_words(content)}" in text
    assert " ".join(content["summary"].split()) in " ".join(text.split())
    assert_holds(text, ["mechanism", "statistic", "detection limit", "probability", "frame_compliance", str(out)])
    assert len(content["figures"]) == 6
    assert set(snapshot(out)) == {"discovery.json", "discovery.msgpack", "figures", *content["figures"]}
    for name in content["figures"]:
        assert (out / name).read_bytes().startswith(b"\x89PNG")


def test_same_seed_same_file_and_stale_figures_go(run, found, tests, tmp_path):
    first = json.loads((found[1] / "discovery.json").read_text(encoding="utf-8"))
    out = tmp_path / "again"
    shutil.copytree(found[1], out)
    (out / "figures" / "mine.png").write_text("a file of the user's")
    text = done(run("discover", tests / "frame", "--out", out, *QUICK, "--no-figures", "--json"))
    assert text == (out / "discovery.json").read_text(encoding="utf-8")
    assert set(snapshot(out)) == {"discovery.json", "discovery.msgpack", "figures", "figures/mine.png"}
    second = json.loads(text)
    for content in (first, second):
        assert content.pop("runtime_s") > 0
        content.pop("figures")
    assert first == second


def test_nothing_is_found_where_nothing_is_hidden_and_excluded_names_are_gone(run, tests, tmp_path):
    excluded = ["--exclude", "toe_asperity", "--exclude", "pop_in"]
    text = done(run("discover", tests / "null", "--out", tmp_path, "--no-held-out", "--no-figures", *excluded))
    content = json.loads((tmp_path / "discovery.json").read_text(encoding="utf-8"))
    assert content["verdict"] == "NO_GAP"
    assert "Verdict: nothing missing" in text
    assert content["effects"] == []
    assert content["gap"]["steps"] == []
    names = {entry["mechanism"] for entry in (*content["ranking"], *content["untestable"])}
    assert names == set(LIBRARY) - {"toe_asperity", "pop_in"}


def test_power_says_what_the_tests_could_show(run, tests, tmp_path):
    others = set(LIBRARY) - {"frame_compliance", "platen_sink_in", "humidity"}
    excluded = [word for name in others for word in ("--exclude", name)]
    text = done(run("power", tests / "null", "--out", tmp_path, *excluded))
    content = json.loads((tmp_path / "power.json").read_text(encoding="utf-8"))
    (frame, sink) = content["mechanisms"]
    assert (frame["mechanism"], frame["unit"], frame["visible"]) == ("frame_compliance", "um/mN", True)
    # Well below what the command above finds without effort.
    assert 1e-6 < frame["detection_limit"] < HIDDEN / 4
    assert sink["detection_limit"] > 0
    assert [one["mechanism"] for one in content["untestable"]] == ["humidity"]
    assert "frame_compliance" in text
    assert "humidity needs" in text
    assert (
        done(run("power", tests / "null", "--out", tmp_path, *excluded, "--json"))
        == json.dumps(content, ensure_ascii=False, indent=2) + "\n"
    )
