"""The scorer on answers made by hand: a perfect solver passes every row, a bad one fails where it is bad."""

import json

import numpy as np
import pytest

from benchmarks import _report
from benchmarks.blind import scoring, sealing, smoke
from benchmarks.blind.generator import effects, tiers


def estimate(value, sd):
    return {"value": value, "sd": sd, "interval_95": [value - 1.96 * sd, value + 1.96 * sd]}


def answer_to(case):
    """What `campaigns.build` would keep of a case, without simulating it."""
    struck = {"lambda_residual": case.effects[0][2]} if case.effects else {}
    hidden = [
        {
            "mechanism": m,
            "form": f,
            "amplitude": 2e-3,
            "lambda": v,
            "lambda_target": v,
            "plausible": True,
            "lambda_residual": v,
            **struck,
        }
        for m, f, v in case.effects
    ]
    twins = []
    if case.tier == "T1":
        other = next(name for name in effects.MECHANISMS if name != case.effects[0][0])
        strength = case.effects[0][2]
        rho = 0.95 if strength <= 5 else 0.2
        twins = [
            {
                "mechanism": other,
                "rho": rho,
                "expected_dll": 0.5 * strength**2 * (1 - rho**2),
                "realised_dll": 0.5 if strength <= 5 else 99.0,
            }
        ]
    truth = {"a": 1.43, "effective_modulus_MPa": 16e3, "log_C1": 1.9027}
    return {
        "case": case.record(),
        "master_seed": 1,
        "effects": hidden,
        "twins": twins,
        "truth": truth,
        "rho_pair": 0.1,
        "oracle": {
            "best": hidden[0]["mechanism"] if hidden else None,
            "statistics": {
                name: 9.0 if hidden and name == hidden[0]["mechanism"] else 1.0
                for name in ("creep", "damage", *(e["mechanism"] for e in hidden))
            },
        },
    }


def perfect(answer, number):
    """The discovery a perfect solver would return; `number` spreads the estimates as their errors say."""
    case, hidden = answer["case"], answer["effects"]
    pull = 2.05 * (-1) ** number if number % 20 == 0 else 0.9 * (-1) ** number
    struck = case["tier"] in ("T4", "T5")
    named = [] if struck or case["tier"] == "T6" else [e["mechanism"] for e in hidden]
    verdict = "UNLISTED" if struck else "NAMED" if named else "NO_GAP"
    sets = [[name] for name in named]
    if answer["twins"] and answer["twins"][0]["realised_dll"] < 2:
        verdict, sets = "SET", [[named[0], answer["twins"][0]["mechanism"]]]
    steps = [{"added": None, "chi2_per_dof": 1.3 if hidden else 1.0, "systematic_um": 0.1, "elpd": 0.0, "elpd_se": 1.0}]
    steps += [{"added": n, "chi2_per_dof": 1.0, "systematic_um": 0.0, "elpd": 9.0, "elpd_se": 1.0} for n in named]
    return {
        "verdict": verdict,
        "effects": [
            {
                "mechanism": n,
                "probability": 0.97,
                "parameters": {"compliance_um_per_mN": estimate(2e-3 + 1e-4 * pull, 1e-4)},
            }
            for n in named
        ],
        "candidate_set": sets,
        "ranking": [{"mechanism": n, "probability": 0.99 if number % 10 else 0.01} for n in named]
        + [
            {
                "mechanism": "humidity" if named != ["humidity"] else "creep",
                "probability": 0.01 if number % 10 else 0.99,
            }
        ],
        "untestable": [{"mechanism": case["cell"], "needs": "other data"}] if case["tier"] == "T6" else [],
        "gap": {"floor": 1.0, "steps": steps, "closed_fraction": 0.97},
        "closure": None,
        "parameters_before": {
            "effective_modulus_MPa": estimate(12e3, 1e3),
            "log_C1": {"mean": estimate(2.4, 0.1)},
            "a": estimate(1.0, 0.1),
        },
        "parameters_after": {
            "effective_modulus_MPa": estimate(16e3 + 1e3 * pull, 1e3),
            "log_C1": {"mean": estimate(1.9027 + 0.1 * pull, 0.1)},
            "a": estimate(1.43 + 0.1 * pull, 0.1),
        },
        "next_experiments": [{"experiment": "hold", "separates": sets[0]}] if verdict == "SET" else [],
        "runtime_s": 3.0,
    }


@pytest.fixture(scope="module")
def perfect_run():
    found = []
    for number, case in enumerate(tiers.plan(seeds=2)):
        answer = answer_to(case)
        result = {"status": "ok", "wall_s": 3.0, "cold": number == 0, "discovery": perfect(answer, number)}
        found.append(scoring.Outcome(f"c{number:05d}", answer, result))
    results = {o.key: o.result for o in found}
    results["c00000#repeat"] = {**found[0].result, "discovery": {**found[0].found, "runtime_s": 9.0}}
    results["c00000#cold"] = {**found[0].result, "wall_s": 80.0}
    return found, results


def rows(found, results=None):
    return {row["metric"]: row for row in scoring.acceptance(found, results or {})}


def changed(found, which, **discovery):
    """The outcomes with the answers of some of them altered."""
    out = []
    for o in found:
        altered = {**o.result, "discovery": {**o.found, **discovery}}
        out.append(scoring.Outcome(o.key, o.answer, altered) if which(o) else o)
    return out


def test_a_perfect_solver_passes_every_row_that_can_be_measured(perfect_run):
    table = rows(*perfect_run)
    judged = {name: row["result"] for name, row in table.items() if row["gate"] != "none"}
    bad = {name: table[name] for name, result in judged.items() if result is False}
    assert not bad
    missing = {name for name, result in judged.items() if result == "not measured"}
    assert missing == {
        "closure, T4, lambda>=20: NRMSE of the correction on held-out particles (median)",
        "proposed experiment resolves the set (simulated)",
    }


def test_rows_without_gate_are_never_passed(perfect_run):
    assert all(row["result"] == "-" for row in rows(*perfect_run).values() if row["gate"] == "none")


def test_false_alarms_are_counted_with_their_interval(perfect_run):
    found, results = perfect_run
    clean = [o for o in found if o.case["cell"] == "clean"]
    alarmed = {o.key for o in clean[:10]}
    told = changed(
        found, lambda o: o.key in alarmed, verdict="NAMED", effects=[{"mechanism": "creep"}], candidate_set=[["creep"]]
    )
    row = rows(told, results)["false alarm, clean null"]
    assert row["observed"] == "10.0% (10/100)"
    assert row["result"] is False
    assert row["95% interval"] == "4.9-17.6%"
    assert rows(told, results)["false alarm, heavy tails"]["result"] is True


@pytest.mark.parametrize(
    ("status", "verdict"), [("crash", None), ("timeout", None), ("invalid", "NO_GAP"), ("ok", "FIT_NOT_CONVERGED")]
)
def test_no_answer_is_a_failure_everywhere(perfect_run, status, verdict):
    found, _ = perfect_run
    lost = [
        scoring.Outcome(
            o.key,
            o.answer,
            {
                "status": status,
                "error": "gone",
                "wall_s": 1.0,
                "cold": False,
                "discovery": verdict and {**o.found, "verdict": verdict},
            },
        )
        for o in found
    ]
    table = rows(lost)
    failed = [name for name, row in table.items() if row["result"] is False]
    for metric in (
        "false alarm, clean null",
        "top-1, exact formula, lambda=10, P1",
        "true effect in the set, exact, lambda>=5",
        "false UNLISTED, T1 and T2",
        "UNLISTED said, T4 and T5, residual lambda>=10",
        "two effects, both named, abs(rho)<.7",
        "UNTESTABLE said, with the data needed (T6)",
        "held-out gap closed, lambda>=20 (mean share)",
    ):
        assert metric in failed
    assert sum(row["campaigns"] for row in scoring.failures(lost)) == len(lost)
    assert not any(
        row["result"] is True for name, row in table.items() if name.startswith(("false", "top", "true", "two", "UN"))
    )


def test_a_solver_that_always_names_the_same_is_found_out(perfect_run):
    found, results = perfect_run
    stuck = changed(
        found,
        lambda o: True,
        verdict="NAMED",
        effects=[{"mechanism": "creep", "probability": 0.9}],
        candidate_set=[["creep"]],
    )
    table = rows(stuck, results)
    assert table["top-1, exact formula, lambda=10, P1"]["observed"].startswith("5.0%")
    assert table["calibration of the stated probability, ECE"]["result"] is False
    assert table["two effects, false discoveries among names"]["result"] is False
    assert table["mean size of the set, lambda=10"]["result"] is True
    counts = scoring.confusion(stuck)
    assert all(set(row) == {"creep"} for row in counts.values())


def test_a_solver_that_never_decides_is_found_out(perfect_run):
    found, results = perfect_run
    everything = [list(effects.MECHANISMS)]
    vague = changed(found, lambda o: o.verdict in ("NAMED", "SET"), verdict="SET", candidate_set=everything)
    table = rows(vague, results)
    assert table["true effect in the set, exact, lambda>=5"]["result"] is True
    assert table["mean size of the set, lambda=5"]["result"] is False
    assert table["'cannot separate' said, lambda^2(1-rho^2)>=30 (pairs)"]["result"] is False


def test_who_leads_the_ranking_counts_whatever_the_verdict(perfect_run):
    found, results = perfect_run
    one = next(o for o in found if o.tier == "T1")
    ranked = [{"mechanism": "other", "probability": 0.3}, {"mechanism": one.truth[0], "probability": 0.6}]
    led = {**one.result, "discovery": {**one.found, "verdict": "NO_GAP", "effects": [], "ranking": ranked}}
    assert scoring.Outcome("c", one.answer, led).leads
    assert not scoring.Outcome("c", one.answer, led).right
    for other in (
        [],
        [{"mechanism": "other", "probability": 1.0}],
        [{**ranked[0]}, {**ranked[1], "probability": None}],
    ):
        lost = {**led, "discovery": {**led["discovery"], "ranking": other}}
        assert not scoring.Outcome("c", one.answer, lost).leads
    metrics = [row["metric"] for row in scoring.acceptance(found, results)]
    assert len(set(metrics)) == len(metrics)


def test_campaigns_off_their_strength_do_not_count_for_it(perfect_run):
    found, _ = perfect_run
    o = next(o for o in found if o.tier == "T1" and o.strength == 10.0)
    weak = json.loads(json.dumps(o.answer))
    weak["effects"][0]["lambda"] = 7.0
    assert scoring.Outcome("c", weak, o.result).strength is None
    assert scoring.by_mechanism([scoring.Outcome("c", weak, o.result)])[0]["off strength"] == 1


def test_biased_parameters_fail(perfect_run):
    found, results = perfect_run
    off = {
        "effective_modulus_MPa": estimate(12e3, 1e3),
        "log_C1": {"mean": estimate(1.9027, 0.1)},
        "a": estimate(1.43, 0.1),
    }
    table = rows(changed(found, lambda o: o.tier == "T1", parameters_after=off), results)
    assert table["95% interval covers effective_modulus_MPa"]["result"] is False
    assert table["bias of effective_modulus_MPa, in SE (absolute mean)"]["observed"].startswith("4")
    assert table["95% interval covers log_C1"]["result"] is False  # 100 % is too wide
    assert table["bias of a, in SE (absolute mean)"]["result"] is True


def test_the_time_from_nothing_is_that_of_the_campaign_solved_alone(perfect_run):
    found, results = perfect_run
    name = "run time of one campaign of 20, cold (largest)"
    assert rows(found, results)[name]["observed"].startswith("80 s")
    slow = {**results, "c00000#cold": {**results["c00000#cold"], "wall_s": 91.0}}
    assert rows(found, slow)[name]["result"] is False


def test_a_cut_of_bias_is_judged_by_what_was_drawn(perfect_run):
    """A campaign's particles lie away from the population by chance, whatever the effect."""
    found, results = perfect_run
    name = "bias of log_C1 cut by adding the effect (mean over mechanisms biased by more than 1 SE)"
    assert rows(found, results)[name]["result"] is True
    estimates = {"log_C1": {"mean": estimate(2.4, 0.1)}}
    wrong = changed(found, lambda o: o.tier == "T1", parameters_after=estimates)
    assert rows(wrong, results)[name]["result"] is False
    drawn = [
        scoring.Outcome(o.key, {**o.answer, "truth": {**o.answer["truth"], "log_C1_drawn": 2.4 + 0.01}}, o.result)
        for o in changed(wrong, lambda o: True, parameters_before={"log_C1": {"mean": estimate(2.9, 0.1)}})
    ]
    assert rows(drawn, results)[name]["result"] is True


def test_clopper_pearson():
    assert scoring.interval(0, 500) == pytest.approx((0.0, 1 - 0.025 ** (1 / 500)))
    assert scoring.interval(20, 20) == pytest.approx((0.025 ** (1 / 20), 1.0))
    assert scoring.interval(5, 10) == pytest.approx((0.1870860, 0.8129140), abs=1e-6)
    assert scoring.interval(0, 0) == (0.0, 1.0)


def test_reliability():
    pairs = [(0.9, True)] * 9 + [(0.9, False)] + [(0.3, True)] * 5 + [(0.3, False)] * 5
    table, error = scoring.reliability(pairs)
    assert table == [(pytest.approx(0.3), 0.5, 10), (pytest.approx(0.9), pytest.approx(0.9), 10)]
    assert error == pytest.approx(0.1)
    assert scoring.reliability([(1.0, True)]) == ([(1.0, 1.0, 1)], 0.0)
    assert scoring.reliability([]) == ([], None)


def test_determinism_ignores_the_time_only(perfect_run):
    found, results = perfect_run
    assert rows(found, results)["same seed, same answer"]["result"] is True
    other = {**results, "c00000#repeat": {**found[0].result, "discovery": {**found[0].found, "summary": "else"}}}
    assert rows(found, other)["same seed, same answer"]["result"] is False


def test_follow_up_counts_sets_that_collapse(perfect_run, monkeypatch):
    found, results = perfect_run
    asked = next(o for o in found if o.verdict == "SET")
    key = f"{asked.key}+next"
    name = asked.truth[0]
    resolved = {
        "status": "ok",
        "wall_s": 1,
        "cold": False,
        "discovery": {"verdict": "NAMED", "effects": [{"mechanism": name}], "candidate_set": [[name]]},
    }
    metric = "proposed experiment resolves the set (simulated)"
    assert rows(found, {**results, key: resolved})[metric]["observed"] == "100.0% (1/1)"
    sure = "  of these with a stated power of 0.9 or more"
    for power in (0.95, 0.3):
        monkeypatch.setitem(asked.found["next_experiments"][0], "power", power)
        assert ("1/1" in rows(found, {**results, key: resolved})[sure]["observed"]) == (power > 0.9)
    assert rows(found, {**results, key: asked.result})[metric]["observed"] == "0.0% (0/1)"


def test_closure_error_sees_only_what_the_base_law_cannot_take_up():
    from benchmarks.blind.generator import campaigns, law

    case = tiers.Case(
        "k",
        "T4",
        "drive_backlash",
        "P1",
        count=4,
        resample=True,
        effects=(("drive_backlash", "unlisted", 20.0),),
        residual=True,
    )
    answer = campaigns.build(case, 3).answer
    drawn, _ = campaigns.design(case, 3)
    hidden = drawn.effects[0](answer["effects"][0]["amplitude"])
    base = law.simulate(drawn.particles, drawn.path)
    change = law.simulate(drawn.particles, drawn.path, hidden) - base

    def error(curves):
        return scoring.closure_error(answer, {str(i + 1): row.tolist() for i, row in enumerate(curves)})

    assert error(change) == pytest.approx(0.0, abs=1e-9)
    stiffer = law.simulate(drawn.particles.with_(modulus=drawn.particles.modulus * 1.05), drawn.path) - base
    assert error(change + stiffer) < 0.01
    assert error(0.5 * change) == pytest.approx(0.5, abs=0.01)
    assert error(np.zeros_like(change)) == pytest.approx(1.0)

    def of_range(curves):
        return scoring.curve_error(answer, {str(i + 1): row.tolist() for i, row in enumerate(curves)})

    assert of_range(change) == pytest.approx(0.0, abs=1e-9)
    assert of_range(change + stiffer) < 0.005
    assert of_range(0.5 * change) == pytest.approx(0.5 * of_range(np.zeros_like(change)), rel=1e-6)
    # A root mean square over a range: below a half for any curve around zero.
    assert 0.05 < of_range(np.zeros_like(change)) < 0.5


def test_tables_and_pictures(perfect_run, tmp_path):
    found, results = perfect_run
    made = scoring.pictures(found, tmp_path, "blind")
    assert made == ["blind_confusion.png", "blind_reliability.png", "blind_power.png"]
    assert all((tmp_path / name).stat().st_size > 10_000 for name in made)
    for table in (
        scoring.acceptance(found, results),
        scoring.by_mechanism(found),
        scoring.by_noise(found),
        scoring.gaps(found),
    ):
        lines = _report.table(table).splitlines()
        assert len({line.count("|") for line in lines}) == 1


def test_smoke_lists_forty_and_knows_right_from_wrong():
    cases = smoke.cases()
    assert len({case.id for case in cases}) == len(cases) == 40
    for number, case in enumerate(cases):
        right = perfect(answer_to(case), number)
        assert smoke.check(case, right) is None
        wrong = "NAMED" if right["verdict"] != "NAMED" else "NO_GAP"
        assert smoke.check(case, {**right, "verdict": wrong, "effects": []}) is not None
    # The list is part of what is sealed: whoever changes it says so here.
    assert smoke.fingerprint() == SMOKE


SMOKE = "f758f8641fb08ab18c319b4fbfe1d9d9016084706ec2c3a99377ff307e427f7a"


# --- the seal --------------------------------------------------------------------------------------------------------
@pytest.fixture
def sealed(tmp_path):
    cases = [tiers.Case(f"s{k}", "T0", "clean", "P0", count=3, resample=True) for k in range(3)]
    digest = sealing.seal(tmp_path / "run", cases, master=4, jobs=1)
    return tmp_path / "run", digest


def test_sealed_answers_open(sealed):
    folder, digest = sealed
    content = sealing.open_answers(folder)
    assert sorted(content["answers"]) == ["c00001", "c00002", "c00003"]
    assert sorted(a["case"]["id"] for a in content["answers"].values()) == ["s0", "s1", "s2"]
    assert (folder / "seal.txt").read_text().startswith(digest)
    assert len(content["nonce"]) == 64
    assert "clean" not in (folder / "tasks.json").read_text()


def test_same_cases_get_another_hash_each_time(tmp_path, sealed):
    cases = [tiers.Case(f"s{k}", "T0", "clean", "P0", count=3, resample=True) for k in range(3)]
    assert sealing.seal(tmp_path / "again", cases, master=4, jobs=1) != sealed[1]


@pytest.mark.parametrize("what", ["answers", "campaign", "seal"])
def test_whatever_is_touched_breaks_the_seal(sealed, what, tmp_path):
    folder, _ = sealed
    if what == "answers":
        path = folder / "answers.json"
        path.write_text(path.read_text().replace("clean", "creep", 1))
    elif what == "campaign":
        with (folder / "campaigns/c00002/curves.csv").open("a") as curves:
            curves.write("\n")
    other = tmp_path / "other.txt"
    other.write_text("0" * 64)
    with pytest.raises(sealing.SealBroken):
        sealing.open_answers(folder, other if what == "seal" else None)
