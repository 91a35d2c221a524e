"""The seal and the runner: resuming, crashes, time-outs, renewed processes."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.blind import adapter, plan, run, seal, workers
from benchmarks.blind.settings import Running

pytestmark = pytest.mark.extended

FAST = Running(timeout_s=2.0, start_timeout_s=60.0, renew_after=2)


@pytest.fixture(scope="module")
def sealed(tmp_path_factory):
    """A few small nulls of a run, sealed."""
    place = tmp_path_factory.mktemp("bench")
    cases = [c for c in plan.plan(3) if c.kind == "null" and c.particles == 5][:6]
    return place, cases, seal.seal("day-3", place / "work", place / "sealed", cases)


@pytest.fixture(autouse=True)
def _path(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=":")


def test_the_seal_holds_and_breaks(sealed):
    place, cases, digest = sealed
    assert (place / "sealed/day-3.txt").read_text().startswith(f"{digest}  answers.json\nday-3: 6 campaigns")
    assert seal.seal("day-3", place / "work", place / "sealed", cases) == digest
    answers = seal.open_answers("day-3", place / "work", place / "sealed")
    assert len(answers) == 6
    key = next(iter(answers))
    assert seal.truth_of("day-3", key, answers[key], place / "work")[0].max() == 0
    (place / "other").mkdir()
    (place / "other/day-3.txt").write_text("0" * 64 + "  answers.json\n")
    with pytest.raises(seal.SealBroken, match=r"not the file that was sealed"):
        seal.open_answers("day-3", place / "work", place / "other")
    with pytest.raises(seal.SealBroken, match="other answers"):
        seal.seal("day-3", place / "work", place / "other", cases)
    with pytest.raises(SystemExit, match="DATE-SEED"):
        seal.master_of("today")
    tasks = json.loads((place / "work/day-3/tasks.json").read_text())  # nothing of what is hidden
    assert all(list(task) == ["subset"] for task in tasks.values())


def test_parts_resume_and_processes_are_renewed(sealed, tmp_path):
    place, *_ = sealed
    given = {"solver": "fake_solvers:silent", "work": place / "work", "results": tmp_path, "running": FAST}
    assert run.solve("day-3", (1, 2), **given) == 3
    part = tmp_path / "day-3/part_1_of_2.jsonl"
    first, second, third = (json.loads(line) for line in part.read_text().splitlines())
    processes = [row["discovery"]["summary"] for row in (first, second, third)]
    assert processes[0] == processes[1] != processes[2]
    assert [row["cold"] for row in (first, second, third)] == [True, False, True]
    # A line cut off by a stop is solved again, the others are not.
    part.write_text("\n".join(json.dumps(row) for row in (first, second)) + "\n" + json.dumps(third)[:30])
    assert run.solve("day-3", (1, 2), **given) == 1
    assert run.solve("day-3", (1, 1), **given) == 3
    found = run.read_outcomes(tmp_path / "day-3")
    assert len(found) == 6
    assert all(row["status"] == "ok" for row in found.values())
    with pytest.raises(SystemExit, match="not 100"):
        run.solve("day-3", subset=100, **given)


def test_a_gap_is_asked_for_where_something_was_named(sealed, tmp_path):
    place, *_ = sealed
    given = {"work": place / "work", "results": tmp_path, "running": FAST}
    run.solve("day-3", solver="fake_solvers:naming", **given)
    odd = sum(int(key[1:]) % 2 for key in run.read_outcomes(tmp_path / "day-3"))
    assert 0 < odd < 6
    assert run.solve("day-3", solver="fake_solvers:silent", label="gap", named="day-3", **given) == odd


def test_a_crash_a_hang_and_a_dead_process_cost_one_campaign_each():
    names = ("crash", "fine", "hang", "nonsense", "die", "fine")
    running = replace(FAST, renew_after=10)
    found = list(workers.outcomes([(n, Path(n)) for n in names], "fake_solvers:moody", running=running))
    assert [row["status"] for row in found] == ["crash", "ok", "timeout", "invalid", "crash", "ok"]
    assert found[0]["error"] == "ValueError: no"
    assert found[2]["error"] == "no answer in 2 s"
    assert found[4]["error"] == "the process died"
    assert found[3]["error"] == "verdict 'PERHAPS'"


def test_an_unknown_solver_shows_in_every_outcome():
    (row,) = workers.outcomes([("a", Path("a"))], "fake_solvers:nobody", running=FAST)
    assert row["status"] == "crash"
    assert "nobody" in row["error"]
    with pytest.raises(ValueError, match="no solver"):
        adapter.find("nobody")
