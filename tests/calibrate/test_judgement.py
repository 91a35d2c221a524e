"""Particles unlike all others, the answer without them, an unknown modulus; and the answers that corrections give."""

import functools

import faulty
import numpy as np
import pytest
from asserting import estimate
from hypothesis import given, settings
from hypothesis import strategies as st

from mcc_jax import least_squares
from mcc_jax._errors import InputError
from mcc_jax.calibrate import judgement
from mcc_jax.calibrate.judgement import MODULUS_OPEN, judged, unknown_modulus, unlike_others
from mcc_jax.campaign import check_tests

TRUTH_MPA = faulty.MODULUS_MPA
NAMES = tuple(f"P{i}" for i in range(12))


@functools.cache
def clean():
    return faulty.campaign(8)


@functools.cache
def calibrated(kind):
    """One shape of arrays, and so one compilation, for all of them."""
    campaign = {
        "clean": clean,
        "offset and force": lambda: faulty.clipped(faulty.in_air(clean(), offset_mN=-20.0, readings=15), 0.9),
        "path": lambda: faulty.clipped(clean(), 0.98, channel="displacement"),
        "hidden": lambda: faulty.clipped(clean(), 0.85, channel="displacement"),
        "broken": lambda: faulty.broken(clean(), only=("3",)),
        "spiked": lambda: faulty.spiked(clean(), height=60.0, channel="force"),
    }[kind]()
    return least_squares(campaign, without_flagged=kind == "broken")


def modulus(kind):
    return calibrated(kind).answer()["effective_modulus_MPa"]


@pytest.mark.extended
@pytest.mark.parametrize("kind", ["offset and force", "path", "spiked", "broken"])
def test_the_modulus_holds_the_truth_and_is_as_sharp_as_the_clean_tests_allow(kind):
    low, high = modulus(kind)["interval_95"]
    clean_low, clean_high = modulus("clean")["interval_95"]
    assert low <= TRUTH_MPA <= high
    assert high - low < 2 * (clean_high - clean_low)
    assert calibrated(kind).converged
    assert calibrated("clean").findings == ()


@pytest.mark.extended
def test_what_was_found_and_taken_off_stands_in_the_result():
    content = calibrated("offset and force").to_json()
    assert {one["check"]: one["level"] for one in content["findings"]} == {
        "zero of force": "info",
        "saturation": "warning",
    }
    for told in content["findings"]:
        assert any(told["sentence"] in warning for warning in content["warnings"])
    for particle in content["particles"]:
        zero = particle["force_zero_mN"]
        assert abs(zero["value"] + 20.0) < 5 * zero["sd"]
    raw = calibrated("offset and force").campaign.raw
    assert raw.curves[0].force_mN[:15].mean() == pytest.approx(-20.0, abs=0.1)


@pytest.mark.extended
def test_a_modulus_that_no_unloading_tells_is_told_as_unknown():
    found = {one.check: one for one in calibrated("hidden").findings}
    assert set(found) == {"saturation", MODULUS_OPEN}
    assert "displacement is at the end of its range" in found[MODULUS_OPEN].sentence
    assert "larger range of displacement" in found[MODULUS_OPEN].remedy
    assert found[MODULUS_OPEN].level == "warning"
    low, high = modulus("hidden")["interval_95"]
    assert low < TRUTH_MPA < high


@pytest.mark.extended
def test_a_broken_particle_is_named_with_the_answer_without_it():
    (found,) = calibrated("broken").findings
    assert (found.check, found.particles) == ("breakage", ("3",))
    rest = least_squares(clean().without("3"), without_flagged=False).answer()["effective_modulus_MPa"]
    value = f"{1e-3 * rest['value']:.4g}"
    assert f"without it the modulus is {value}" in found.sentence
    assert "with it the modulus is" in found.sentence


@settings(max_examples=50)
@given(st.integers(0, 2**31 - 1), st.integers(0, 11), st.floats(50, 1e5))
def test_one_particle_far_from_all_others_is_named(seed, which, times):
    rng = np.random.default_rng(seed)
    rms, reach = 0.05 * np.exp(0.1 * rng.standard_normal(12)), np.exp(rng.uniform(3.5, 4.5, 12))
    assert unlike_others(NAMES, rms, reach) is None
    rms[which] *= times
    reach[which] = np.exp(4.0)
    found = unlike_others(NAMES, rms, reach)
    assert found.particles == (NAMES[which],)
    assert f"Particle {NAMES[which]}" in found.sentence
    assert found.level == "warning"


def test_what_is_like_the_others_or_has_none_to_be_unlike(monkeypatch):
    rms, reach = np.full(12, 0.05), np.full(12, 50.0)
    larger = np.where(np.arange(12) == 3, 20.0, 1.0)
    assert unlike_others(NAMES, rms * larger, reach * larger) is None
    mixture = np.where(np.arange(12) < 5, 20.0, 1.0)
    assert unlike_others(NAMES, rms * mixture, reach) is None
    few = NAMES[:4], np.array([0.05, 0.05, 0.05, 5.0]), np.full(4, 50.0)
    assert unlike_others(*few) is None
    monkeypatch.setattr(judgement, "LEAST", 4)
    assert unlike_others(*few).particles == ("P3",)


def answer(value=16000.0, sd=40.0, *, converged=True):
    return {"converged": converged, "a": estimate(1.43, 0.01), "effective_modulus_MPa": estimate(value, sd)}


@pytest.mark.extended
def test_each_set_of_flagged_particles_is_left_out_once():
    campaign = check_tests(faulty.broken(faulty.clipped(clean(), 0.9, only=("5",)), only=("2",)))
    asked = []

    def again(some):
        asked.append(some.particles)
        return answer(15000.0, converged=False)

    found = judged(campaign, answer(), None, again)
    sentences = {one.check: one.sentence for one in found}
    left_out = [set(campaign.particles) - set(names) for names in asked]
    assert sorted(left_out, key=min) == [{"2"}, {"5"}]
    assert "without it the modulus is 15 +- 0.04 GPa" in sentences["breakage"]
    assert "(not converged), with it the modulus is 16 +- 0.04 GPa" in sentences["breakage"]
    assert judged(campaign, answer(), None, None)[0].sentence.count("without") == 0


def test_flags_of_most_particles_or_of_very_few_are_not_answered_without_them(monkeypatch):
    def again(some):
        pytest.fail("nothing would be left, or it would be too expensive")

    (found,) = judged(check_tests(faulty.clipped(clean(), 0.9)), answer(), None, again)
    assert found.check == "saturation"
    campaign = check_tests(faulty.broken(clean(), only=("2",)))
    monkeypatch.setattr(judgement, "FEW", 0.99 / len(campaign))
    (found,) = judged(campaign, answer(), None, lambda some: answer())
    assert "without it" in found.sentence
    monkeypatch.setattr(judgement, "FEW", 1.01 / len(campaign))
    assert [one.check for one in judged(campaign, answer(), None, again)] == ["breakage"]


def test_an_answer_that_cannot_be_had_is_said():
    campaign = check_tests(faulty.broken(clean(), only=("2",)))

    def again(some):
        raise InputError("no two particles are left")

    (found,) = judged(campaign, answer(), None, again)
    assert "without it there is no answer (no two particles are left)" in found.sentence


@given(st.floats(1e2, 1e6), st.floats(0.0, 3.0))
def test_a_modulus_is_unknown_from_half_its_size_in_error_on(value, share):
    found = unknown_modulus(clean(), answer(value, share * value)["effective_modulus_MPa"])
    assert (found is not None) == (share * value >= 0.5 * value)
    if found is not None:
        assert "too little of their unloading" in found.sentence
        assert "Unload" in found.remedy
    assert unknown_modulus(clean(), answer(value, None)["effective_modulus_MPa"]) is None  # a method without errors


@pytest.mark.parametrize("converged", [True, False])
def test_of_a_fit_that_did_not_converge_no_interval_is_told(converged):
    (found,) = judged(clean(), answer(sd=16_000.0, converged=converged), None, None)
    assert ("between" in found.sentence) is converged
