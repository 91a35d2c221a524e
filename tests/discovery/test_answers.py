"""What is reported: sentences without private words, formulas that are what they print, shares next to chi2."""

import json

import numpy as np
import pytest

from mcc_jax.discovery.answer import averaged
from mcc_jax.discovery.closure import LETTERS, terms_of
from mcc_jax.discovery.result import Discovery, Effect
from mcc_jax.discovery.sentences import summary_of
from mcc_jax.discovery.verify import HeldOut
from mcc_jax.effects import find_variant

EST = {"value": 16_000.0, "sd": 100.0, "interval_95": [15_800.0, 16_200.0]}
MODULI = {"effective_modulus_MPa": EST, "modulus_at_peaks_MPa": EST}


@pytest.mark.parametrize("name", LETTERS)
def test_a_term_is_what_it_prints(name):
    x = np.linspace(0.0, 3.0, 17)
    letter = LETTERS[name][0]
    for term, values in terms_of(letter, x, 0.0, 3.0).items():
        text = term.replace("^", "**").replace("2 pi", "2*np.pi*1").replace("np.pi*1 ", "np.pi*")
        for word in ("exp", "ln", "sqrt", "sin", "cos"):
            text = text.replace(f"{word}(", f"np.{'log' if word == 'ln' else word}(")
        np.testing.assert_allclose(values, eval(text, {"np": np, letter: x}), rtol=1e-12, atol=1e-12)


def held(before=2.0, after=1.0, elpd=((0.0,) * 4,) * 2):
    """Held-out results of as many particles as `elpd` has."""
    elpd = np.array(elpd)
    points = np.full(elpd.shape[1], 100.0)
    chi2, repeating = np.array([before * points, after * points]), np.array([before - 1, after - 1])
    return HeldOut((None, "creep"), chi2, points, elpd, repeating, np.zeros((*elpd.shape, 3)))


def test_a_share_is_given_with_chi2_and_is_of_what_could_be_closed():
    found = held(3.0, 1.5).to_json()
    assert found["closed_fraction"] == pytest.approx(0.75)
    assert [step["chi2_per_dof"] for step in found["steps"]] == [3.0, 1.5]
    assert held(3.0, 0.9).to_json()["closed_fraction"] == 1.0
    assert held(0.95, 0.9).to_json()["closed_fraction"] is None
    json.dumps(found, allow_nan=False)


def test_the_mean_of_few_particles_follows_student_t():
    one = np.arange(1.0, 7.0), np.full(6, 0.1), np.full(3, 0.3)
    found = averaged([one], np.ones(1), 5)
    assert found["a"]["interval_95"] == pytest.approx([1 - 0.196, 1 + 0.196], abs=1e-4)
    assert found["log_C1"]["mean"]["interval_95"] == pytest.approx([3 - 0.27764, 3 + 0.27764], abs=1e-4)
    assert found["log_C1"]["mean"]["sd"] == pytest.approx(0.1 * 2**0.5)


@pytest.mark.parametrize(
    ("rms_um", "elpd", "said"),
    [
        ((0.2, 0.1), 5.0, None),
        ((0.2, 0.1), -50.0, "predicted worse"),
        ((0.1, 0.2), 5.0, "8 of 8 lie further"),
        ((0.9, 0.8), 5.0, "misses them by 8 % of their range"),
    ],
)
def test_what_held_out_particles_contradict_is_no_answer(rms_um, elpd, said):
    found = held(elpd=[np.zeros(8), elpd * (1 + 0.1 * np.arange(8))])
    objection = found.objection([np.full(8, rms) for rms in rms_um], np.full(8, 10.0))
    assert objection is None if said is None else said in objection


def test_a_weak_effect_that_hardly_helps_is_not_contradicted():
    rng = np.random.default_rng(0)
    after = 1 + 0.01 * rng.choice([-1, 1], 20)
    assert held(elpd=rng.normal(0, 1, (2, 20))).objection([np.ones(20), after], np.full(20, 100.0)) is None


def summary(verdict, amplitude=1e-4, **more):
    effect = Effect(find_variant("platen_sink_in"), {}, amplitude, 0.001, 0.97, 0.002, misfit=0.4)
    named = verdict in ("NAMED", "SET")
    sets = ((effect.mechanism, "frame_compliance") if verdict == "SET" else (effect.mechanism,),) if named else ()
    found = Discovery(
        verdict, "", None, None, 0, 0.0,
        effects=(effect,) if named else (), candidate_set=sets, p_any=0.002 if verdict != "NO_GAP" else 0.4,
        parameters_before=MODULI,
        parameters_after=MODULI if named else {},
        untestable=({"mechanism": "reload_hysteresis", "needs": "a reload segment"},), **more,
    )  # fmt: skip
    return summary_of(found)


@pytest.mark.parametrize("verdict", ["NO_GAP", "NAMED", "SET"])
def test_a_summary_is_plain_english(verdict):
    text = summary(verdict)
    assert "reload hysteresis (needs a reload segment)" in text
    assert "_" not in text
    if verdict != "NO_GAP":
        assert "platen sink in" in text
        assert "16.00 ± 0.10 GPa" in text
        assert "off by about 40 %" in text
    assert ("frame compliance" in text) is (verdict == "SET")


def test_a_summary_says_what_limits_the_answer():
    pairs = (("creep", "reverse_plasticity"),)
    text = summary("SET", pairs=pairs)
    assert "cannot distinguish it from frame compliance or creep together with reverse plasticity" in text
    most = find_variant("platen_sink_in").plausible[1]
    assert "more than is plausible" in summary("NAMED", 1.1 * most)
    assert "more than is plausible" not in summary("NAMED", 0.9 * most)
    assert "named, not closed" in summary("NAMED", held_out=held(9.0, 2.0))
    assert "named, not closed" not in summary("NAMED", held_out=held(9.0, 1.0))
