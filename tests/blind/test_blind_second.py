"""The second blind test: an independent generator, repeatable campaigns, a folder that is safe, grades by hand."""

import ast
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import fake_solvers
import numpy as np
import pytest

from benchmarks import _report
from benchmarks.blind import run, sealing
from benchmarks.blind.second import __main__ as command
from benchmarks.blind.second import build, campaign, effects, folder, grading, law, path, plan

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "benchmarks/blind/second"
KNOWS_THE_BENCH = {"grading.py", "__main__.py"}
SEED = [0, 17]


# --- independence ----------------------------------------------------------------------------------------------------
def test_the_generator_uses_numpy_and_the_standard_library_only():
    files = [file for file in PACKAGE.rglob("*.py") if file.name not in KNOWS_THE_BENCH]
    assert len(files) > 15
    for file in files:
        depth = len(file.relative_to(PACKAGE).parts)
        for node in ast.walk(ast.parse(file.read_text())):
            found = []
            if isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level <= depth, f"{file.name} reaches out of the package"
                found = [] if node.level else [node.module]
            assert {name.split(".")[0] for name in found} <= {*sys.stdlib_module_names, "numpy"}, file.name
    code = "import sys; from benchmarks.blind.second import folder; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert not {"mcc_jax", "jax", "scipy"} & set(loaded)
    assert not any(name.startswith(("benchmarks.blind.generator", "benchmarks.blind.run")) for name in loaded)


# --- law -------------------------------------------------------------------------------------------------------------
def test_the_paper_s_first_particle():
    """Numbers that the specification prints: strain at 7 MPa on the mean law, and half of the recovery."""
    drawn = campaign.draw(np.random.default_rng(1), 1)
    drawn.particles.C[:] = [7.0094, 27.235 ** (1 / 3), 144.23**0.2]  # the printed mean law
    particles = replace(drawn.particles, D=np.array([[213.54, 196.07, 186.33]]), a=1.43, modulus=np.array([16000.0]))
    drawn = replace(drawn, particles=particles)
    drawn.path.peak[:] = 7.0
    drawn.path.stress[:] = 7.0
    drawn.path.stress[1:] *= 0.391002218956  # half of the displacement is recovered here
    eps = law.simulate(drawn) / particles.De[0]
    assert eps[0] == pytest.approx(0.448764815105, rel=1e-9)
    assert eps[0] - eps[1] == pytest.approx(0.5 * 0.0153826451248, rel=1e-6)


def test_unloading_and_back():
    s = np.linspace(0, 1, 201)
    assert law.recovered_fraction(law.unloading_ratio(s)) == pytest.approx(s, abs=1e-6)


@pytest.mark.parametrize("formula", [*sum(effects.LISTED.values(), ()), *effects.UNLISTED], ids=lambda f: f.__name__)
def test_a_formula_is_nil_at_zero_and_changes_something(formula):
    effect = formula(np.random.default_rng(2))
    rng = np.random.default_rng(3)
    humidity = np.array([12.0, 70.0])
    drawn = campaign.draw(rng, 2, effect.protocols[0], reloads=effect.reloads, wide=effect.wide, humidity=humidity)
    base = law.simulate(drawn)
    # The sliding disc keeps a friction of 1e-4 where its formula would divide by zero.
    assert law.simulate(drawn, [(effect, 0.0)]) == pytest.approx(base, abs=3e-3)
    assert np.abs(law.simulate(drawn, [(effect, effect.start)]) - base).max() > 1e-3
    assert "{" not in effect.describe()


def test_branches_of_a_path_with_two_reloads():
    drawn = campaign.draw(np.random.default_rng(0), 3, "P1", reloads=1)
    for i, samples in enumerate(drawn.path.slices):
        branch = drawn.path.branch[samples]
        legs = branch[np.flatnonzero(np.diff(branch, prepend=-1))]
        up, down, back, hold = path.VIRGIN, path.UNLOAD, path.RELOAD, path.HOLD
        assert legs.tolist() == [up, down, back, up, hold, down, back, down]
        assert drawn.path.unloadings[samples][-1] == 3
        assert sum(owner == i for owner, *_ in drawn.path.reloads) == 2


# --- plan and campaigns ----------------------------------------------------------------------------------------------
def test_plan():
    cases = plan.plan()
    tiers = [case.tier for case in cases]
    assert len(cases) == 135
    assert {tier: tiers.count(tier) for tier in plan.TIERS} == {
        "exact": 40,
        "variant": 60,
        "units": 13,
        "null": 8,
        "unlisted": 8,
        "pair": 6,
    }
    keys = [key for key, *_ in folder.cases(0)]
    assert sorted(keys) == [f"k{n:03d}" for n in range(135)]
    assert [key for key, *_ in folder.cases(0, limit=2)] == keys[:2]
    assert all(case.tier == "null" for *_, case in folder.cases(0, only=["null"]))


def test_seed_zero_still_gives_the_campaigns_that_were_solved():
    key, number, case = folder.cases(0, only=["null"])[0]
    built = build.build(case, [*SEED, number])
    tested, loaded = built.campaign.particles, built.campaign.path
    assert key == "k120"
    assert tested.D[[0, -1]].tolist() == [[103.40, 120.62, 94.43], [139.44, 182.51, 147.55]]
    assert loaded.force[[0, -1]] == pytest.approx([0.64539, 3.98602], abs=2e-5)
    assert built.displacement[[0, -1]] == pytest.approx([0.63102, 74.42725], abs=2e-5)


def test_the_same_case_twice_is_the_same_campaign(tmp_path):
    _, number, first = folder.cases(0, only=["exact"])[0]
    for k, case in enumerate([replace(first, count=3), replace(plan.plan()[-9], count=2)]):
        seen = []
        for again in ("once", "twice"):
            built = build.build(case, [*SEED, number])
            folder.write(built, tmp_path / str(k) / again)
            files = sorted((tmp_path / str(k) / again).iterdir())
            seen.append(([file.read_bytes() for file in files], built.answer))
        assert seen[0] == seen[1]
        assert seen[0][1]["lambda"] == pytest.approx(case.target, rel=0.05) or case.tier == "unlisted"


# --- folder ----------------------------------------------------------------------------------------------------------
def small(out):
    command.main(["--out", str(out), "--only", "null", "--limit", "2"])
    return json.loads((out / "answers.json").read_text())["answers"]


def test_a_folder_that_holds_something_is_refused(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("keep me")
    with pytest.raises(SystemExit):
        command.main(["--out", str(tmp_path), "--only", "null", "--limit", "1"])
    assert "holds something" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]
    with pytest.raises(FileExistsError):
        folder.make(tmp_path, limit=1)


def test_from_campaigns_to_a_table(tmp_path, capsys, monkeypatch):
    out = tmp_path / "run"
    answers = small(out)
    tasks = json.loads((out / "tasks.json").read_text())
    assert set(tasks) == set(answers) == {place.name for place in (out / "campaigns").iterdir()}

    def solve(place, *, solver, jobs, timeout):
        assert solver == "inprocess"
        results = [
            {"key": key, "status": "ok", "discovery": fake_solvers.silent(place, **task)} for key, task in tasks.items()
        ]
        (place / "results.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in results))

    monkeypatch.setattr(run, "solve", solve)
    monkeypatch.setattr(_report, "RESULTS", tmp_path / "results")
    command.main(["--out", str(out), "--solve", "--jobs", "1", "--score", "--write"])
    text = (tmp_path / "results/blind_second.md").read_text()
    assert text in capsys.readouterr().out
    assert "| null | NO_GAP | 2 of 2 | 100.0 % |" in text
    assert "Not answered rightly" not in text
    (out / "answers.json").write_text("{}")
    with pytest.raises(sealing.SealBroken):
        grading.grades(out)


# --- grades ----------------------------------------------------------------------------------------------------------
def grade(tier, hidden, verdict, names=(), sets=(), status="ok"):
    answer = {
        "tier": tier,
        "mechanisms": list(hidden),
        "formula": "th*|z_i|",
        "lambda": 12.0,
        "protocol": "P0",
        "n_particles": 20,
        "noise": "clean",
    }
    discovery = {"verdict": verdict, "effects": [{"mechanism": name} for name in names], "candidate_set": list(sets)}
    return grading.Grade("k000", answer, {"status": status, "discovery": discovery if status == "ok" else None})


@pytest.mark.parametrize(
    ("given", "right", "in_set"),
    [
        (("null", (), "NO_GAP"), True, False),
        (("null", (), "SET", ("creep",), [["creep"]]), False, False),
        (("null", (), "", (), (), "crash"), False, False),
        (("exact", ("creep",), "NAMED", ("creep",), [["creep"]]), True, True),
        (("variant", ("creep",), "SET", ("damage",), [["damage", "creep"]]), False, True),
        (("variant", ("creep",), "NO_GAP"), False, False),
        (("units", ("creep",), "NAMED", ("creep", "damage"), [["creep"], ["damage"]]), False, True),
        (("units", ("creep",), "FIT_NOT_CONVERGED", ("creep",), [["creep"]]), False, False),
        (("units", ("creep",), "", (), (), "timeout"), False, False),
        (("unlisted", (), "UNLISTED"), True, False),
        (("unlisted", (), "NAMED", ("creep",), [["creep"]]), False, False),
        (("pair", ("creep", "damage"), "NAMED", ("damage", "creep"), [["damage"], ["creep"]]), True, True),
        (("pair", ("creep", "damage"), "NAMED", ("creep",), [["creep", "damage"]]), False, True),
        (("pair", ("creep", "damage"), "NAMED", ("creep",), [["creep"]]), False, False),
    ],
)
def test_grades(given, right, in_set):
    graded = grade(*given)
    assert (graded.right, graded.in_set) == (right, in_set)


def test_table_of_grades():
    graded = [
        grade("exact", ["creep"], "NAMED", ["creep"], [["creep"]]),
        grade("units", ["creep"], "NAMED", ["creep", "damage"], [["creep"], ["damage"]]),
        grade("unlisted", [], "UNLISTED"),
    ]
    rows = {(row["tier"], row["answered"]): row["campaigns"] for row in grading.summary(graded)}
    assert rows["exact", "the only effect named is the true one"] == "1 of 1"
    assert rows["the three together", "the only effect named is the true one"] == "1 of 2"
    assert rows["units", "two named although one is hidden"] == "1 of 1"
    assert rows["unlisted", "UNLISTED"] == "1 of 1"
    assert not any(tier in ("variant", "null", "pair") for tier, _ in rows)
    (row,) = grading.wrong(graded)
    assert row["tier"] == "units"
    assert row["formula"] == "`th*\\|z_i\\|`"
    assert row["sets"] == "creep; damage"
