import hashlib
import json
import math
from collections import Counter

import numpy as np
import pytest
from asserting import done, refused, snapshot
from helpers import INSTRUMENTS, assert_holds, assert_same_curves

from mcc_jax.campaign import PAPER_DIAMETERS_UM, find_segments, read_campaign
from mcc_jax.cli.demo import NOTHING, SEALED, STRENGTHS, compared, sealed_answer
from mcc_jax.cli.main import cli
from mcc_jax.cli.options import STRAIN_SCALING, UNLOADING
from mcc_jax.law import StrainScaling, Unloading
from mcc_jax.simulate import Instrument, paper_campaign

# What the contract promises; more may be there.
KEYS = {
    *("schema", "method", "converged", "runtime_s", "law", "a", "effective_modulus_MPa"),
    *("log_C1", "log_C3", "log_C5", "noise", "particles", "diagnostics"),
}
PARTICLE_KEYS = {"particle", "eta_p", "C1", "C3", "C5", "zero_um", "rms_um", "kept", "why_not"}
DIAGNOSTICS = {"rhat_max", "ess_bulk_min", "divergences", "pareto_k_max"}


def is_estimate(entry):
    return set(entry) == {"value", "sd", "interval_95"}


def check_contract(content):
    assert set(content) >= KEYS
    assert content["schema"] == 1
    assert content["law"].keys() == {"unloading", "strain_scaling"}
    assert is_estimate(content["a"])
    assert is_estimate(content["effective_modulus_MPa"])
    for name in ("log_C1", "log_C3", "log_C5"):
        assert is_estimate(content[name]["mean"])
        assert is_estimate(content[name]["sd"])
    for particle in content["particles"]:
        assert set(particle) >= PARTICLE_KEYS
        assert all(is_estimate(particle[name]) for name in ("eta_p", "C1", "C3", "C5", "zero_um"))
    assert set(content["diagnostics"]) >= DIAGNOSTICS


def test_names_of_the_options_are_those_of_the_law():
    assert tuple(form.value for form in Unloading) == UNLOADING
    assert tuple(form.value for form in StrainScaling) == STRAIN_SCALING


def test_without_arguments_help_with_examples(run):
    text = done(run())
    assert text == done(run("--help"))
    assert_holds(text, [*cli.commands, "Examples:", "_MCC_JAX_COMPLETE"])
    assert set(cli.commands) == {"demo", "simulate", "convert", "calibrate", "discover", "power", "report", "export"}
    assert "0.1.0" in done(run("--version"))
    for command in cli.commands:
        text = done(run(command, "--help"))
        assert "xample" in text
        assert "--out DIR" in text


@pytest.mark.extended  # `.ci/run` runs the demo as its users do
def test_demo_hides_an_effect_and_finds_it_and_finds_none_where_none_is(run, tmp_path):
    out = tmp_path / "new" / "demo"
    text = done(run("demo", "--out", out))
    assert "SIMULATED" in text
    assert_holds(text, ["1.43", "16 GPa", "6.704", "3.009", "2.66"])
    sealed = (out / SEALED).read_bytes()
    assert hashlib.sha256(sealed).hexdigest() in text.splitlines()[1]
    hidden = json.loads(sealed)
    assert hidden["nonce"] in text
    assert "The name agrees" in text
    assert "FALSE ALARM" not in text
    for folder, verdict in ((out, "NAMED"), (out / NOTHING, "NO_GAP")):
        content = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
        check_contract(content)
        assert content["converged"] is True
        assert len(content["figures"]) >= 5
        found = json.loads((folder / "discovery.json").read_text(encoding="utf-8"))
        assert found["verdict"] == verdict
        assert [e["mechanism"] for e in found["effects"]] == [hidden["mechanism"]][: len(found["effects"])]
        assert {"figures/discovery_where.png", "figures/discovery_ranking.png"} <= set(found["figures"])
        expected = {"report.html", "calibration.json", "discovery.json", "campaign", "figures"}
        expected |= {f"campaign/{name}" for name in ("particles.csv", "curves.csv", "campaign.toml")}
        expected |= {"posterior.nc", "calibration.msgpack", "discovery.msgpack", *content["figures"], *found["figures"]}
        names = {name for name in snapshot(folder) if not name.startswith(NOTHING)}
        assert names == expected | ({SEALED} if folder == out else set())
        for name in (*content["figures"], *found["figures"]):
            assert (folder / name).read_bytes().startswith(b"\x89PNG")
        campaign = read_campaign(folder / "campaign")
        assert campaign.particles == tuple(str(i) for i in range(1, 9))
        assert campaign.columns == {}  # nothing beside the tests tells what is hidden
        assert hidden["mechanism"] not in (folder / "campaign" / "campaign.toml").read_text()
    gap = json.loads((out / "discovery.json").read_text())["gap"]
    assert gap["closed_fraction"] > 0.9
    assert gap["steps"][0]["chi2_per_dof"] > 3
    assert gap["steps"][-1]["chi2_per_dof"] == pytest.approx(1.0, abs=0.2)
    assert "of the 8 particles of the calibrated campaign" in done(
        run("export", out, "--format", "json", "--out", out / "law")
    )


def test_the_seal_fixes_what_is_hidden():
    drawn, seals = set(), set()
    for seed in range(30):
        effect, text = sealed_answer(seed)
        answer = json.loads(text)
        low, high = STRENGTHS[answer["mechanism"]]
        assert sealed_answer(seed)[1] == text
        assert low <= effect.strength <= high
        assert answer["parameters"][effect.variant.parameter] == effect.strength
        drawn.add(answer["mechanism"])
        seals.add(text)
    assert drawn == set(STRENGTHS)
    assert len(seals) == 30


FOUND = {
    "verdict": "NAMED",
    "candidate_set": [["creep"]],
    "effects": [
        {
            "mechanism": "creep",
            "variant": "kelvin_voigt",
            "parameters": {"c": {"value": 1.1, "sd": 0.1, "interval_95": [0.9, 1.3]}},
        }
    ],
}
HIDDEN = {"mechanism": "creep", "variant": "kelvin_voigt", "parameters": {"c": 1.0}}


@pytest.mark.parametrize(
    ("answer", "found", "right", "words"),
    [
        ({}, {}, True, "off by +10.0 %, 1.0 standard deviations; the true one lies inside"),
        ({"parameters": {"c": 2.0}}, {}, True, "the true one lies OUTSIDE"),
        ({"variant": "logarithmic"}, {}, True, "the formula is another (kelvin voigt, hidden was logarithmic)"),
        ({"mechanism": "frame_compliance"}, {}, False, "WRONG: hidden was frame compliance, found was creep"),
        ({}, {"candidate_set": [["creep", "thermal_drift"]]}, True, "cannot distinguish it from thermal drift"),
        ({}, {"verdict": "NO_GAP", "effects": []}, False, "found was no name (nothing missing)"),
    ],
)
def test_the_demo_says_how_the_discovery_did(answer, found, right, words):
    agrees, sentence = compared(HIDDEN | answer, FOUND | found)
    assert agrees is right
    assert words in sentence


@pytest.mark.extended
def test_simulate_then_calibrate_twice_gives_the_same(run, simulated, tmp_path):
    out = tmp_path / "fit"
    (out / "figures").mkdir(parents=True)
    (out / "figures" / "mine.png").write_text("a file of the user's")
    first = done(run("calibrate", simulated, "--out", out, "--method", "paper"))
    assert "converged" in first
    assert str(out) in first
    one = json.loads((out / "calibration.json").read_text())
    check_contract(one)
    assert all((out / name).is_file() for name in one["figures"])
    assert [p["particle"] for p in one["particles"]] == ["A", "B", "C"]
    text = done(run("calibrate", simulated, "--out", out, "--method", "paper", "--no-figures", "--json"))
    assert text.endswith("}\n")
    two = json.loads(text)
    assert text == (out / "calibration.json").read_text(encoding="utf-8")
    # The figures of the first run would contradict what lies beside them now; the user's own file stays.
    assert set(snapshot(out)) == {"calibration.json", "calibration.msgpack", "figures", "figures/mine.png"}
    assert two["figures"] == []
    assert one["runtime_s"] > 0
    for content in (one, two):
        del content["runtime_s"], content["figures"]
    assert one == two


def test_calibrate_into_the_campaigns_own_folder(run, campaign):
    before = snapshot(campaign)
    reference = ["--method", "paper", "--objective", "reference", "--reference", "B"]
    done(run("calibrate", campaign, "--out", campaign, "--no-figures", *reference))
    after = snapshot(campaign)
    content = json.loads(after.pop("calibration.json"))
    assert after.pop("calibration.msgpack")
    assert after == before
    assert (content["a_objective"], content["reference_particle"]) == ("reference", "B")
    done(run("export", campaign, "--format", "json", "--out", campaign / "law", "--particle", "B"))
    card = json.loads((campaign / "law" / "parameters.json").read_text())
    assert {name: card["parameters"][name]["value"] for name in ("C1", "C3", "C5", "a")} == {
        **{name: content["particles"][1][name]["value"] for name in ("C1", "C3", "C5")},
        "a": content["a"]["value"],
    }
    assert card["particle"]["eta_p"] == pytest.approx(content["particles"][1]["eta_p"]["value"], rel=1e-14)


def test_simulate_by_default_is_the_paper_campaign_with_a_perfect_instrument(run, tmp_path):
    text = done(run("simulate", "--out", tmp_path / "sim", "--seed", "4"))
    assert "20 particles" in text
    mine, papers = read_campaign(tmp_path / "sim"), paper_campaign(4, instrument=Instrument())
    np.testing.assert_array_equal(mine.diameters_um, PAPER_DIAMETERS_UM)
    assert mine.columns == papers.columns
    assert_same_curves(mine.curves, papers.curves)


def test_simulate_keeps_columns_and_forgets_older_truth(run, simulated, tmp_path):
    again = ["simulate", "--particles", simulated / "particles.csv", "--points", "20"]
    done(run(*again, "--out", tmp_path / "sim", "--C1", "7", "--a", "0.9", "--effective-modulus", "9000"))
    campaign = read_campaign(tmp_path / "sim")
    assert campaign.particles == ("A", "B", "C")
    assert campaign.columns["batch"] == ("x", "y", "y")
    assert set(campaign.columns["true_C1"]) == {"7.0"}
    simulation = campaign.metadata.other["simulation"]
    assert (simulation["a"], simulation["effective_modulus_MPa"]) == (0.9, 9000.0)
    assert set(campaign.columns) == {"batch", "true_C1", "true_C3", "true_C5", "true_monotone"}


def test_simulate_options_do_what_they_say(run, simulated, tmp_path):
    base = ["simulate", "--particles", simulated / "particles.csv", "--out", tmp_path / "sim"]
    done(run(*base, "--peak-stress", "10", "--levels", "0.5,1", "--unload-to", "0.1", "--hold-s", "20", "--rate", "4"))
    campaign = read_campaign(tmp_path / "sim")
    kinds = [part.kind for part in find_segments(campaign.curves[0])]
    assert kinds == ["load", "hold", "unload", "reload", "load", "hold", "unload"]
    for curve, (D1, D2, D3) in zip(campaign.curves, campaign.diameters_um, strict=True):
        peak = 10e-3 * math.pi * (D1 * D2 / D3 / 2) ** 2
        assert curve.force_mN.max() == pytest.approx(peak, rel=1e-12)
        assert curve.time_s[-1] == pytest.approx((0.5 + 0.4 + 0.9 + 1) * peak / 4 + 40)
    displacement = ["--control", "displacement", "--rate", "0.5", "--peak-strain", "0.2:0.3", "--interval-s", "2"]
    done(run(*base, *displacement, "--resolution-um", "0.5", "--resolution-mN", "0.25", "--zero-um", "3"))
    campaign = read_campaign(tmp_path / "sim")
    assert campaign.metadata.control == "displacement"
    assert campaign.metadata.displacement_resolution_um == 0.5
    assert len({len(curve) for curve in campaign.curves}) == 3
    for curve, (D1, D2, D3) in zip(campaign.curves, campaign.diameters_um, strict=True):
        assert (np.ptp(curve.displacement_um) + 0.5) / (D1 * D2 / D3) >= 0.2
        assert np.ptp(curve.displacement_um) - 0.5 <= 0.3 * (D1 * D2 / D3)
        np.testing.assert_array_equal(curve.displacement_um % 0.5, 0)
        np.testing.assert_array_equal(curve.force_mN % 0.25, 0)
        assert curve.time_s[1] == 2


def test_simulate_hides_effects(run, simulated, tmp_path):
    base = ["simulate", "--particles", simulated / "particles.csv", "--points", "30"]
    done(run(*base, "--out", tmp_path / "plain"))
    effects = ["--effect", "frame_compliance=0.002", "--effect", "creep:logarithmic,tau_s=5"]
    text = done(run(*base, "--out", tmp_path / "sim", *effects))
    assert "Hidden effect: frame_compliance, linear, compliance_um_per_mN 0.002." in text
    plain, hidden = (read_campaign(tmp_path / name) for name in ("plain", "sim"))
    for one, other in zip(plain.curves, hidden.curves, strict=True):
        assert (other.displacement_um[1:] > one.displacement_um[1:] + 0.0019 * one.force_mN[1:]).all()
    told = hidden.metadata.other["simulation"]["effects"]
    assert [effect["variant"] for effect in told] == ["linear", "logarithmic"]
    assert told[1]["tau_s"] == 5


def test_simulate_by_a_programme_file(run, simulated, tmp_path):
    programme = tmp_path / "steps.toml"
    programme.write_text("rate = 3\npoints = 50\n[[step]]\nramp_to = 1\n[[step]]\nhold_s = 9\n[[step]]\nramp_to = 0\n")
    base = ["simulate", "--particles", simulated / "particles.csv", "--out", tmp_path / "sim"]
    done(run(*base, "--programme", programme, "--noise-um", "0.1", "--noise-mN", "0.1", "--unloading", "punch"))
    campaign = read_campaign(tmp_path / "sim")
    simulation = campaign.metadata.other["simulation"]
    assert simulation["unloading"] == "punch"
    assert simulation["displacement_noise_um"] == 0.1
    assert campaign.curves[0].force_mN[:1] != 0
    assert "not a measurement" in campaign.metadata.provenance


@pytest.mark.extended
def test_convert_then_calibrate_says_that_the_law_does_not_fit(run, tmp_path):
    tests, fit = tmp_path / "tests", tmp_path / "fit"
    text = done(run("convert", INSTRUMENTS / "FS1.txt", "--out", tests, "--diameters", "200,190,180"))
    campaign = read_campaign(tests)
    counts = Counter(part.kind for curve in campaign.curves for part in find_segments(curve))
    assert "10 tests, 12000 points" in text
    for kind in ("load", "hold", "unload", "reload"):
        assert f"{counts[kind]} {kind}" in text
    assert counts["unload"] == 80  # 8 cycles each
    result = run("calibrate", tests, "--out", fit, "--method", "paper", "--no-figures")
    assert result.exit_code == (0 if json.loads((fit / "calibration.json").read_text())["converged"] else 3)
    assert "describes these tests badly" in result.stdout
    assert snapshot(fit).keys() == {"calibration.json", "calibration.msgpack"}


def test_convert_a_folder_keeps_its_words_short(run, tmp_path):
    folder, mapping, out = tmp_path / "my tests", tmp_path / "map.toml", tmp_path / "out"
    folder.mkdir()
    for i in range(1, 41):
        (folder / f"P{i}.txt").write_text(f"t,F,d\n0,0,0\n1,{i},1\n2,-,1\n3,0,0.5\n")
    (folder / ".hidden").write_text("x")
    mapping.write_text(
        'missing = ["-"]\n[columns]\ntime = { column = "t", unit = "s" }\nforce = { column = "F", unit = "N" }\n'
        'displacement = { column = "d", unit = "um" }\n'
    )
    arguments = ("convert", folder, "--out", out, "--mapping", mapping, "--diameters", "200,190,180")
    text = done(run(*arguments, "--leave-out", "P7", "--leave-out", "P1?.txt"))
    assert len(text.splitlines()) < 12
    for piece in (
        "29 tests, 87 points (folder my tests, 29 files, mapped by map.toml",
        "Max force 1000 to 40000 mN, max displacement 1 um.",
        "Note: 1 file ignored because of the name: .hidden.",
        "Note: 11 files skipped as asked: P7.txt, P10.txt,",
        "Note: 29 rows with a missing reading were dropped, in 29 tests.",
    ):
        assert piece in text
    names = read_campaign(out).particles
    assert names[:7] == ("P1", "P2", "P3", "P4", "P5", "P6", "P8")
    assert names[-1] == "P40"
    table = folder / "sizes.csv"
    table.write_text("file;D1_um;D2_um;D3_um\n" + "".join(f"P{i}.txt;20{i},5;190;180\n" for i in range(1, 41)))
    text = done(run("convert", folder, "--out", out, "--mapping", mapping, "--diameters", table))
    assert "1 file skipped as asked: sizes.csv" in text
    assert read_campaign(out).diameters_um[3].tolist() == [204.5, 190, 180]
    table.unlink()
    assert "--leave-out P99 fits no file" in refused(run(*arguments, "--leave-out", "P99"))


def test_json_of_odd_names_is_utf8(run, campaign):
    for name in ("particles.csv", "curves.csv"):
        file = campaign / name
        file.write_text(file.read_text().replace("\nA,", "\nπ [bold],"), encoding="utf-8")
    text = done(run("calibrate", campaign, "--out", campaign / "fit", "--method", "paper", "--no-figures", "--json"))
    assert json.loads(text)["particles"][0]["particle"] == "π [bold]"
    assert "π [bold]" in text
