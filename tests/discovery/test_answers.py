"""What is said: sentences without private words, formulas that are what they print, shares beside chi2."""

import dataclasses
import json

import numpy as np
import pytest

from mcc_jax.discovery.answer import _averaged
from mcc_jax.discovery.closure import LETTERS, terms_of
from mcc_jax.discovery.discover import _taken_back
from mcc_jax.discovery.heldout import HeldOut
from mcc_jax.discovery.hypothesis import UNLISTED
from mcc_jax.discovery.result import Discovery, Effect
from mcc_jax.discovery.sentences import summary_of
from mcc_jax.discovery.settings import DECISIONS, Decisions
from mcc_jax.effects import find_variant

EST = {"value": 16_000.0, "sd": 100.0, "interval_95": [15_800.0, 16_200.0]}
MODULI = {"effective_modulus_MPa": EST, "modulus_at_peaks_MPa": EST}


@pytest.mark.parametrize("name", LETTERS)
def test_a_term_is_what_it_prints(name):
    x = np.linspace(0.0, 3.0, 17)
    letter = LETTERS[name][0]
    for term in terms_of(name, 0.0, 3.0):
        text = term.text.replace("^", "**").replace("2 pi", "2*np.pi*1").replace("np.pi*1 ", "np.pi*")
        for word in ("exp", "ln", "sqrt", "sin", "cos"):
            text = text.replace(f"{word}(", f"np.{'log' if word == 'ln' else word}(")
        np.testing.assert_allclose(term.function(x), eval(text, {"np": np, letter: x}), rtol=1e-12, atol=1e-12)


def held(before, after):
    points = np.full(4, 100.0)
    chi2 = np.array([before * points, after * points])
    return HeldOut((None, "creep"), chi2, points, np.zeros((2, 4)), np.array([before - 1, after - 1]))


def test_a_share_stands_beside_chi2_and_is_of_what_could_be_closed():
    told = held(3.0, 1.5).to_json()
    assert told["closed_fraction"] == pytest.approx(0.75)
    assert [step["chi2_per_dof"] for step in told["steps"]] == [3.0, 1.5]
    assert held(3.0, 0.9).to_json()["closed_fraction"] == 1.0
    assert held(0.95, 0.9).to_json()["closed_fraction"] is None
    json.dumps(told, allow_nan=False)


def test_the_mean_of_few_particles_follows_student_t():
    one = np.arange(1.0, 7.0), np.full(6, 0.1), np.full(3, 0.3)
    found = _averaged([one], np.ones(1), 5)
    assert found["a"]["interval_95"] == pytest.approx([1 - 0.196, 1 + 0.196], abs=1e-4)
    assert found["log_C1"]["mean"]["interval_95"] == pytest.approx([3 - 0.27764, 3 + 0.27764], abs=1e-4)
    assert found["log_C1"]["mean"]["sd"] == pytest.approx(0.1 * 2**0.5)


@pytest.mark.parametrize(
    ("residual_um", "elpd", "said"),
    [
        ((0.2, 0.1), 5.0, None),
        ((0.2, 0.1), -50.0, "predicted worse"),
        ((0.1, 0.2), 5.0, "8 of 8 lie further"),
        ((0.9, 0.8), 5.0, "misses them by 8 % of their range"),
    ],
)
def test_what_held_out_particles_contradict_is_no_answer(residual_um, elpd, said):
    gain = elpd * (1 + 0.1 * np.arange(8))
    held = HeldOut((None, "creep"), np.ones((2, 8)), np.full(8, 50.0), np.array([np.zeros(8), gain]), np.ones(2))
    objection = held.objection([np.full(8, rms) for rms in residual_um], np.full(8, 10.0))
    assert objection is None if said is None else said in objection


def test_a_weak_effect_that_hardly_helps_is_not_contradicted():
    rng = np.random.default_rng(0)
    after = 1 + 0.01 * rng.choice([-1, 1], 20)
    held = HeldOut((None, "creep"), np.ones((2, 20)), np.full(20, 50.0), rng.normal(0, 1, (2, 20)), np.ones(2))
    assert held.objection([np.ones(20), after], np.full(20, 100.0)) is None


def answer(verdict, amplitude=1e-4, **more):
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
    return dataclasses.replace(found, summary=summary_of(found))


@pytest.mark.parametrize(
    ("winner", "words"), [(("pop_in", "creep"), "pop in and creep"), (UNLISTED, "formula of its own")]
)
def test_what_is_taken_back_is_said_and_is_no_part_of_the_law(winner, words):
    told = _taken_back(answer("NO_GAP"), winner, "8 of 8 lie further from the law")
    assert told.verdict == "FIT_NOT_CONVERGED"
    assert (told.effects, told.parameters_after, told.closure) == ((), {}, None)
    assert words in told.summary
    assert "8 of 8" in told.summary
    assert "_" not in told.summary


@pytest.mark.parametrize("verdict", ["NO_GAP", "NAMED", "SET"])
def test_a_summary_is_plain_english(verdict):
    told = answer(verdict).summary
    assert "reload hysteresis (needs a reload segment)" in told
    assert "_" not in told
    if verdict != "NO_GAP":
        assert "platen sink in" in told
        assert "16.00 ± 0.10 GPa" in told
        assert "off by about 40 %" in told
    assert ("frame compliance" in told) is (verdict == "SET")


def test_two_names_in_place_of_one_are_told_together():
    told = answer("SET", pairs=(("creep", "reverse_plasticity"),)).summary
    assert "cannot distinguish it from frame compliance or creep together with reverse plasticity" in told


def test_an_amplitude_beyond_reason_is_said():
    most = find_variant("platen_sink_in").plausible[1]
    assert "more than is plausible" in answer("NAMED", 1.1 * most).summary
    assert "more than is plausible" not in answer("NAMED", 0.9 * most).summary


def test_named_but_not_closed_is_said():
    assert "named, not closed" in answer("NAMED", held_out=held(9.0, 2.0)).summary
    assert "named, not closed" not in answer("NAMED", held_out=held(9.0, 1.0)).summary


def test_few_numbers_decide():
    assert len(dataclasses.fields(Decisions)) <= 17
    text = Decisions.__doc__ or ""
    assert all(field.name in text for field in dataclasses.fields(Decisions))
    assert Decisions() == DECISIONS
