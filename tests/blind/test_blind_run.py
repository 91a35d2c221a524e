"""The runner: resumes, survives whatever a solver does, and ends in tables."""

import json
import os
import shutil

import pytest

from benchmarks import _report
from benchmarks.blind import adapter, run, score, sealing
from benchmarks.blind.generator import tiers

pytestmark = pytest.mark.long  # compiles for long


def small(folder, count):
    cases = [tiers.Case(f"r{k}", "T0", "clean", "P0", count=2, resample=True) for k in range(count)]
    sealing.seal(folder, cases, master=1, jobs=1)
    return folder


def test_every_mood_of_a_solver_is_a_result(tmp_path):
    folder = small(tmp_path / "run", 6)
    results = run.solve(folder, solver="fake_solvers:moody", jobs=2, timeout=6.0)
    status = {key: (entry["status"], entry["error"]) for key, entry in results.items()}
    assert status["c00001"][0] == "crash"
    assert "ValueError: no" in status["c00001"][1]
    assert status["c00002"][0] == "timeout"
    assert status["c00003"] == ("crash", "the process died")
    assert status["c00004"] == ("invalid", "verdict 'PERHAPS'")
    assert status["c00005"][0] == status["c00006"][0] == "ok"


def test_a_run_goes_on_where_it_stopped(tmp_path):
    folder = small(tmp_path / "run", 3)
    run.solve(folder, solver="fake_solvers:silent", jobs=1, keys=["c00001"])
    path = folder / "results.jsonl"
    path.write_text(path.read_text() + '{"key": "c00002", "status": "o')  # stopped while writing
    results = run.solve(folder, solver="fake_solvers:silent", jobs=1)
    assert set(results) == {"c00001", "c00002", "c00003"}
    assert sum('"key": "c00001"' in line for line in path.read_text().splitlines()) == 1
    before = path.read_text().split()
    run.solve(folder, solver="fake_solvers:moody", jobs=1)
    assert path.read_text().split() == before


@pytest.mark.parametrize(("solver", "steady"), [("silent", True), ("unsteady", False)])
def test_one_command_from_seal_to_tables(tmp_path, capsys, solver, steady):
    folder = tmp_path / "run"
    command = [
        "--out",
        str(folder),
        "--tiers",
        "T0,T6",
        "--fraction",
        "0.003",
        "--seed",
        "3",
        "--jobs",
        "1",
        "--repeat",
        "1",
    ]
    run.main([*command, "--solver", f"fake_solvers:{solver}"])
    text = capsys.readouterr().out
    assert f"{(folder / 'seal.txt').read_text().split()[0]}" in text
    assert "# Blind test of the discovery workflow" in text
    row = next(line for line in text.splitlines() if line.startswith("| same seed, same answer"))
    assert row.endswith("PASS |") == steady
    found, _, content = score.outcomes(folder)
    assert len(found) == len(content["answers"]) == 6
    score.report(folder)


def test_runs_are_scored_together_and_each_against_its_own_seal(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sealing, "SEALED", tmp_path)
    monkeypatch.setattr(_report, "RESULTS", tmp_path)
    folders = [tmp_path / name for name in ("one", "two")]
    for seed, folder in enumerate(folders):
        cases = [tiers.Case(f"r{k}", "T0", "clean", "P0", count=2, resample=True) for k in range(2 + seed)]
        sealing.seal(folder, cases, master=seed, jobs=1, name=folder.name)
        shutil.copy(folder / "seal.txt", tmp_path / f"{folder.name}.txt")
        run.solve(folder, solver="fake_solvers:silent", jobs=1, repeat=1)
    score.main([*map(str, folders), "--write"])
    table = {row["metric"]: row for row in json.loads((tmp_path / "blind_runs.json").read_text())[TOGETHER]}
    assert table["false alarm, clean null"]["observed"] == "0.0% (0/5)"
    assert table["same seed, same answer"]["observed"].endswith("(2/2)")
    with pytest.raises(SystemExit, match="given twice"):
        score.main([str(folders[0])] * 2)
    with pytest.raises(SystemExit):
        score.main([*map(str, folders), "--seal", str(folders[0] / "seal.txt")])
    assert "--seal is for one run" in capsys.readouterr().err
    (tmp_path / "two.txt").write_text("0" * 64)
    with pytest.raises(sealing.SealBroken):
        score.main([*map(str, folders), "--write"])


TOGETHER = "Acceptance, all runs together"


def test_a_broken_seal_is_not_scored(tmp_path):
    folder = small(tmp_path / "run", 1)
    run.solve(folder, solver="fake_solvers:silent", jobs=1)
    answers = json.loads((folder / "answers.json").read_text())
    answers["answers"]["c00001"]["effects"] = [{"mechanism": "creep"}]
    (folder / "answers.json").write_text(json.dumps(answers))
    with pytest.raises(sealing.SealBroken):
        score.report(folder)


def test_follow_up_tests_the_same_material_in_another_way(tmp_path):
    case = tiers.Case(
        "f", "T1", "frame_compliance", "P0", count=3, resample=True, effects=(("frame_compliance", "exact", 5.0),)
    )
    folder = tmp_path / "run"
    sealing.seal(folder, [case], master=1, jobs=1)
    moody = {
        "key": "c00001",
        "status": "ok",
        "error": None,
        "wall_s": 1.0,
        "cold": False,
        "discovery": {
            "verdict": "SET",
            "effects": [{"mechanism": "creep"}],
            "candidate_set": [["creep", "frame_compliance"]],
            "next_experiments": [{"experiment": "hold of 60 s at the peak load"}],
        },
    }
    (folder / "results.jsonl").write_text(json.dumps(moody) + "\n")
    made = run.follow_up(folder, sealing.open_answers(folder), solver="fake_solvers:silent", jobs=1)
    assert made["c00001+next"]["changes"] == {"protocol": "P1"}
    assert made["c00001+next"]["lambda"][0] > 1.0
    after = run.read_results(folder)["c00001+next"]["discovery"]
    assert after["verdict"] == "NO_GAP"
    assert after["asked"] == {"confirm": False, "experiments": False, "posterior": False}
    before, both = (
        [(folder / "campaigns" / key / name).read_text().splitlines() for name in ("particles.csv", "curves.csv")]
        for key in ("c00001", "c00001+next")
    )
    for one, other in zip(before, both, strict=True):
        assert other[: len(one)] == one
        assert all(row.startswith("next-") for row in other[len(one) :])
    assert len(both[0]) == 1 + 2 * 3
    # New particles, not the old ones once more.
    assert not {row.partition(",")[2] for row in before[0][1:]} & {row.partition(",")[2] for row in both[0][4:]}
    sealing.open_answers(folder)


def test_one_campaign_of_twenty_is_solved_alone_once(tmp_path, monkeypatch):
    few = tiers.Case("f", "T1", "frame_compliance", "P0", count=3, resample=True, effects=())
    twenty = tiers.Case("t", "T0", "clean", "P0", count=20)
    folder = tmp_path / "run"
    sealing.seal(folder, [few, twenty], master=1, jobs=1)
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    for _ in range(2):
        run.solve_cold(folder, solver="fake_solvers:silent")
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_multi_thread_eigen=false"
    (key,) = run.read_results(folder)
    base = key.removesuffix("#cold")
    assert len((folder / "campaigns" / base / "particles.csv").read_text().splitlines()) == 21
    assert (folder / "results.jsonl").read_text().count(f'"{key}"') == 1
    assert set(run.solve(folder, solver="fake_solvers:silent", jobs=1)) == {"c00001", "c00002", key}


def test_names_of_solvers_and_experiments():
    assert adapter.find("inprocess") is adapter.in_process
    assert adapter.find("command") is adapter.by_command
    with pytest.raises(ValueError, match="no solver"):
        adapter.find("other")
    P0 = {"protocol": "P0", "count": 20}
    assert adapter.follow_up_of([{"experiment": "a second loading rate, ten times higher"}], P0) == {"protocol": "P2"}
    assert adapter.follow_up_of([{"experiment": "reload after partial unloading"}], P0) == {"protocol": "P1"}
    more = {"experiment": "more particles, tested in the same way", "particles": 60}
    assert adapter.follow_up_of([more], P0) == {"count": 60, "resample": True}
    held = {"experiment": "a hold of 60 s at the largest load", "particles": 40}
    assert adapter.follow_up_of([held], P0) == {"protocol": "P1", "count": 40, "resample": True}
    assert adapter.follow_up_of([held], {"protocol": "P2", "count": 20}) == {"count": 40, "resample": True}
    assert adapter.follow_up_of([{**held, "particles": 20}], {"protocol": "P1", "count": 20}) == {}
    assert adapter.follow_up_of([{"experiment": "diamond platen"}], P0) is None
    assert adapter.follow_up_of([], P0) is None


@pytest.mark.parametrize(
    ("discovery", "said"),
    [
        ({"verdict": "NO_GAP", "effects": []}, None),
        ({"verdict": "SET", "effects": [{"mechanism": "creep"}]}, None),
        ({"verdict": "NAMED", "effects": []}, "NAMED without an effect"),
        ({"verdict": "NO_GAP", "effects": [{"mechanism": "creep"}]}, "NO_GAP with effects"),
        ({"verdict": "?", "effects": []}, "verdict '?'"),
        ({"verdict": "UNLISTED", "effects": None}, "effects are not a list of named effects"),
        ([], "no dictionary"),
    ],
)
def test_answers_are_checked(discovery, said):
    assert adapter.problem(discovery) == said
