"""The scorer on made-up outcomes, against figures worked out by hand."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from fake_solvers import discovery

from benchmarks.blind import make, refit, rows, score, truth
from benchmarks.blind.outcome import Outcome, calibration_error, share_over, wilson
from benchmarks.blind.plan import Case

TRUTH = {"effective_modulus_MPa": 16000.0, "log_C1": 1.9}


def outcome(kind, verdict, effects=(), hidden=(), *, key="k", status="ok", noise="clean", fault="", **more):
    """Hidden are (mechanism, lambda)."""
    case = {"kind": kind, "generator": "first", "noise": noise, "fault": fault, "particles": 20}
    true = [{"mechanism": m, "formula": "f", "lambda": v, "lambda_residual": v} for m, v in hidden]
    answer = {"case": case, "effects": true, "points": 5000, "particles": 20, "truth": TRUTH}
    answer["correlation"] = more.pop("correlation", 0.1)
    found = discovery(verdict, effects, **more) if status == "ok" else None
    return Outcome(key, answer, {"key": key, "status": status, "discovery": found, "wall_s": 2.0, "cold": False})


def by_name(found):
    return {row.name: row for row in found}


def test_wilson_and_means_over_mechanisms():
    low, high = wilson(8, 10)  # by hand: (0.8 + 0.19207 -+ 1.95996 sqrt(0.016 + 0.0096036)) / 1.384146
    assert (low, high) == pytest.approx((0.490162, 0.943318), abs=2e-6)
    assert wilson(0, 20)[0] == 0.0
    assert share_over([True, False, True, True]) == 0.75
    assert share_over([True, True, True, False], ["a", "a", "a", "b"]) == 0.5
    # Two bins: 0.9 and 0.95 (one right of two), 0.15 (wrong): (|1.85 - 1| + |0.15|) / 3.
    assert calibration_error([0.9, 0.95, 0.15], [True, False, False]) == pytest.approx(1.0 / 3)


def test_singles():
    some = [
        outcome("single", "NAMED", [("creep", 0.9)], [("creep", 20.0)]),
        outcome("single", "SET", [("creep", 0.6)], [("creep", 60.0)], sets=[["creep", "adhesion"]]),
        outcome("single", "NAMED", [("creep", 0.9), ("adhesion", 0.5)], [("creep", 9.6)]),
        outcome("single", "SET", [("damage", 0.5)], [("adhesion", 100.0)], sets=[["damage", "adhesion"]]),
        outcome("single", "NO_GAP", (), [("adhesion", 5.0)]),
        outcome("single", "NO_GAP", (), [("adhesion", 300.0)], status="crash"),
    ]
    found = by_name(rows.singles(some))
    # Creep: two of three right; adhesion: none of two (a crash is wrong); the weak one counts separately.
    row = found["right name alone, lambda >= 10"]
    assert (row.text, row.number, row.passed) == ("33.3 %", 5, False)
    assert found["right name alone, lambda >= 50"].text == "50.0 %"
    assert found["  said as NAMED"].text == "16.7 %"
    assert found["ghost beside the right name, lambda >= 10"].text == "16.7 %"
    assert found["true name reported, lambda >= 10"].text == "75.0 %"
    assert found["right name alone, lambda < 7.5 (oracle less 5 points)"].number == 1


def test_pairs():
    both = [("creep", 30.0), ("adhesion", 40.0)]
    some = [
        outcome("pair", "NAMED", [("creep", 1), ("adhesion", 1)], both),
        outcome("pair", "NAMED", [("creep", 1), ("damage", 1)], both),
        outcome("pair", "NAMED", [("creep", 1)], both, correlation=-0.9),
        outcome("pair", "NAMED", [("creep", 1)], [("creep", 30.0), ("adhesion", 5.0)]),
    ]
    found = by_name(rows.pairs(some))
    assert found["two effects, both named, lambda >= 20, correlation < 0.8"].text == "50.0 %"
    wrong = found["two effects, a wrong name, lambda >= 20, correlation < 0.8"]
    assert (wrong.text, wrong.number, wrong.passed) == ("50.0 %", 2, False)


def test_nulls_and_faults():
    even = [outcome("null", "NO_GAP", p_anything_missing=(k + 0.5) / 40) for k in range(40)]
    found = by_name(rows.nulls([*even, outcome("null", "SET", [("creep", 0.5)], noise="smooth")]))
    assert found["alarm, nothing hidden"].text == "2.4 %"
    assert found["  of these with noise of kind smooth"].text == "100.0 %"
    assert found["bootstrap p values uniform (KS p)"].passed
    low = by_name(rows.nulls([outcome("null", "NO_GAP", p_anything_missing=0.01 * k) for k in range(20)]))
    assert not low["bootstrap p values uniform (KS p)"].passed
    told = [{"check": "zero of force"}]
    some = [
        outcome("fault", "FIT_NOT_CONVERGED", fault="clipping", findings=told),
        outcome("fault", "NO_GAP", fault="force_zero", findings=told),
        outcome("fault", "NAMED", [("pop_in", 1)], fault="breakage"),
    ]
    found = by_name(rows.faults(some))
    assert found["fault of the tester, no physics named"].text == "66.7 %"
    assert found["fault of the tester, told as what it is"].text == "33.3 %"
    assert found["  force_zero told"].text == "100.0 %"


def test_unlisted_places_and_probabilities():
    known = SimpleNamespace(
        curve_error=lambda outcome: outcome.result["error"],
        held_by_places=lambda outcome: (outcome.result["held"], 0.25),
    )
    hidden = [("unlisted", 12.0)]
    said = [outcome("unlisted", "UNLISTED", (), hidden) for _ in range(3)]
    for one, error in zip(said, (0.05, 0.2, None), strict=True):
        one.result["error"] = error
    listed = [outcome("single", v, (), [("creep", 30.0)]) for v in ("UNLISTED", "NO_GAP")]
    found = by_name(rows.unlisted([*said, outcome("unlisted", "NO_GAP", (), hidden)], listed, known))
    assert found["UNLISTED said, residual lambda >= 10"].text == "75.0 %"
    assert found["UNLISTED said where a listed mechanism is true"].text == "50.0 %"
    assert found["curve within 10 % of its range, held out"].text == "50.0 %"
    for one, held in zip(listed, (0.71, 0.69), strict=True):
        one.result["held"] = held
    found = by_name(rows.places(listed, known))
    assert found["places hold >= 70 % of the difference, lambda >= 20"].text == "50.0 %"
    ranked = [{"mechanism": "creep", "probability": 0.5}, {"mechanism": "damage", "probability": 0.5}]
    one = outcome("single", "SET", [("creep", 0.5)], [("creep", 30.0)], sets=[["creep"]], ranking=ranked)
    found = by_name(rows.probabilities([one], [one]))
    assert found["log score of the true name, nats a single campaign"].text == f"{np.log(0.5):.3g}"
    assert found["calibration error of stated probabilities (ECE)"].text == "0.5"
    assert found["coverage of sets less stated mass"].text == "0.5"


def test_closing_and_running():
    def one(chi2, low, high, verdict="NAMED"):
        intervals = {"effective_modulus_MPa": [low, high], "modulus_at_peaks_MPa": [high - 1000, high]}
        after = {name: {"interval_95": ends} for name, ends in intervals.items()}
        after["log_C1"] = {"mean": {"interval_95": [1.8, 2.0]}}
        gap = {"steps": [{"chi2_per_dof": 9.0}, {"chi2_per_dof": chi2}]}
        effects = [("creep", 1)] if verdict == "NAMED" else ()
        return outcome("single", verdict, effects, [("creep", 30.0)], key=str(chi2), gap=gap, parameters_after=after)

    some = [one(1.05, 15000, 17000), one(1.07, 15000, 15500), one(0.99, 15000, 17000, "NO_GAP")]
    found = by_name(rows.closing(some, SimpleNamespace(modulus_at_peaks=lambda outcome: 16500.0)))
    # Half width with 5000 readings: 1.96 * 0.02 + 0.02 = 0.0592.
    assert found["chi2 per point of the extended law within its interval, lambda >= 20"].text == "66.7 %"
    assert found["effective_modulus_MPa within its 95 % interval"].text == "66.7 %"
    assert found["modulus_at_peaks_MPa within its 95 % interval"].text == "66.7 %"
    assert found["log_C1 within its 95 % interval"].text == "100.0 %"
    found = by_name(rows.running(some, {}))
    assert found["search failures among all campaigns"].text.startswith("not measured: 0 of 1")
    found = by_name(rows.running(some, {"0.99": "search failure"}))
    assert found["search failures among all campaigns"].text == "33.3 %"


def test_places_are_segments_and_shares_of_load():
    _, drawn, _ = make.drawn(Case(1, "null", "first", (), "P1", 5, "clean"), 5, 0)
    every = truth.inside_places(drawn, [{"segment": "all", "load_fraction": [0.0, 1.0]}])
    assert every.all()
    up = truth.inside_places(drawn, [{"segment": "loading", "load_fraction": [0.5, 1.0]}])
    s = drawn.slices[0]
    share = drawn.force[s] / drawn.force[s].max()
    assert share[up[s]].min() >= 0.5
    assert 0 < up.mean() < 0.5
    down = truth.inside_places(drawn, [{"segment": "unloading"}])
    assert not (up & down).any()


def test_kinds_of_wrong_verdicts():
    assert refit.kind_of(10.0, 0.0) == "search failure"
    assert refit.kind_of(0.0, 10.0) == "library gap"
    assert refit.kind_of(1.0, 0.0) == "ambiguous"
    assert refit.kind_of(10.0, 0.0, odds=12.0) == "prior odds"
    values = {(): 0.0, ("creep:a",): 5.0, ("creep:b",): 20.0, ("damage:v",): 12.0}
    formulas = {"creep": ["a", "b"], "damage": ["v"]}
    wrong = outcome("single", "NAMED", [("damage", 1)], [("creep", 30.0)])
    found = refit.judge(wrong, formulas, lambda names: values[tuple(names)])
    assert (found["kind"], found["truth"], found["evidence_winner"]) == ("search failure", "creep:b", 12.0)
    half = outcome("pair", "NAMED", [("damage", 1)], [("creep", 30.0), ("damage", 30.0)])
    found = refit.judge(half, formulas, lambda names: 12.0 + 5.0 * (len(names) - 1))
    assert found["kind"] == "prior odds"
    lost = outcome("single", "UNLISTED", (), [("creep", 30.0)])
    assert refit.judge(lost, formulas, lambda names: 0.0)["kind"] == "not compared"


def test_a_report_from_files(tmp_path):
    from benchmarks.blind import plan, run, seal

    cases = [c for c in plan.plan(3) if c.kind == "null" and c.particles == 5][:3]
    work, sealed, results = tmp_path / "work", tmp_path / "sealed", tmp_path / "results"
    seal.seal("day-3", work, sealed, cases)
    keys = sorted(seal.open_answers("day-3", work, sealed))
    for name, verdicts in (("day-3", ("NO_GAP", "UNLISTED", "NO_GAP")), ("day-3-other", ("NO_GAP", "NO_GAP"))):
        (results / name).mkdir(parents=True)
        (results / name / "run.json").write_text(json.dumps({"campaigns": "day-3"}))
        lines = [{"key": k, "status": "ok", "wall_s": 1.0, "cold": False, "discovery": discovery(v)}
                 for k, v in zip(keys, verdicts, strict=False)]  # fmt: skip
        (results / name / "part_1_of_1.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    assert len(run.read_outcomes(results / "day-3")) == 3
    text = score.report(["day-3", "day-3-other"], results, work, sealed)
    assert "3 of 3 campaigns answered" in text
    assert "| alarm, nothing hidden | <= 6.5 % | 33.3 % |" in text
    assert "on the 2 campaigns that both answered" in text
    assert "## Wrong verdicts: 1" in text
    (work / "day-3/answers.json").write_text((work / "day-3/answers.json").read_text() + " ")
    with pytest.raises(seal.SealBroken):
        score.report(["day-3"], results, work, sealed)
