"""Campaigns about which little can be said: each gets an answer, none an exception, and no answer holds a NaN."""

import json

import numpy as np
import pytest
from campaigns import QUICK, SINGLE, cached, campaign, snapping, subset, with_curves
from helpers import INSTRUMENTS

from mcc_jax.campaign import read_instrument_file
from mcc_jax.discovery import discover
from mcc_jax.effects import LIBRARY

pytestmark = pytest.mark.extended

FEW = {name: LIBRARY[name] for name in ("frame_compliance", "size_effect")}
"""For campaigns of unusual shape, which would compile the whole library again; sizes show in loading alone."""

VERDICTS = {"NO_GAP", "NAMED", "SET", "UNLISTED", "FIT_NOT_CONVERGED"}


def answer(campaign, **options):
    """The answer as JSON, and that it is one."""
    found = discover(campaign, **{**QUICK, **options})
    told = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert told["verdict"] in VERDICTS
    assert len(told["summary"]) > 40
    for effect in found.effects:
        assert effect.variant.sign == 0 or effect.variant.sign * effect.amplitude > 0
    if told["verdict"] in ("NO_GAP", "FIT_NOT_CONVERGED"):
        assert told["effects"] == []
    return told


def test_one_particle():
    told = answer(subset(cached("frame_compliance=0.004"), [0]), library=FEW, confirm=True, experiments=True)
    assert any("rests on the noise model" in note for note in told["notes"])
    assert told["verdict"] in ("NAMED", "SET", "UNLISTED")


def test_two_effects_that_cancel():
    """Compliance and reverse plasticity pull in opposite directions: what is left is small, not to be misnamed."""
    told = answer(campaign("frame_compliance=0.0004", "reverse_plasticity=0.001", seed=1))
    named = {name for names in told["candidate_set"] for name in names}
    assert told["verdict"] != "NAMED" or named & {"frame_compliance", "platen_sink_in", "reverse_plasticity"}


def test_a_load_cell_that_was_not_tared_is_no_physics():
    off_zero = with_curves(cached(programme=SINGLE), lambda c: (c.time_s, c.force_mN + 8.0, c.displacement_um))
    told = answer(off_zero, library=FEW)
    assert told["verdict"] == "NO_GAP"
    assert {one["check"] for one in told["findings"]} == {"zero of force"}
    assert any(one["level"] == "warning" for one in told["findings"])


def test_an_effect_is_named_of_preloaded_particles_too():
    """Records cut in front of 8 mN begin at a force that was there: what they miss is no zero."""
    whole = cached("frame_compliance=0.004", programme=SINGLE)

    def begun(c):
        rows = slice(int(np.argmax(c.force_mN >= 8.0)), None)
        return c.time_s[rows], c.force_mN[rows], c.displacement_um[rows]

    told = answer(with_curves(whole, begun), library=FEW)
    assert told["effects"][0]["mechanism"] == "frame_compliance"
    assert {one["level"] for one in told["findings"] if one["check"] == "zero of force"} <= {"info"}


def test_particles_that_snap_through_take_no_part():
    told = answer(snapping(), library=FEW)
    (found,) = (one for one in told["findings"] if one["check"] == "snap-through")
    assert found["particles"] == ["3", "6"]


def nothing_but_noise():
    rng = np.random.default_rng(0)

    def noise(c):
        return c.time_s, c.force_mN, 3 * rng.normal(size=len(c.time_s)) + np.linspace(0, 60, len(c.time_s))

    return with_curves(cached(), noise)


@pytest.mark.parametrize("make", [nothing_but_noise, lambda: cached("frame_compliance=0.2")])
def test_what_is_beyond_belief_is_a_gap(make):
    assert answer(make(), library=FEW)["verdict"] != "NO_GAP"


def test_loading_only():
    def rise(c):
        top = int(np.argmax(c.force_mN)) + 1
        return c.time_s[:top], c.force_mN[:top], c.displacement_um[:top]

    lacking = ("creep", "adhesion", "unloading_shape", "reload_hysteresis")
    library = FEW | {name: LIBRARY[name] for name in lacking}
    told = answer(with_curves(cached(programme=SINGLE), rise), library=library)
    assert told["verdict"] == "NO_GAP"
    silent = {one["mechanism"]: one["needs"] for one in told["untestable"]}
    assert set(silent) == {"frame_compliance", *lacking}
    assert "unloading" in silent["adhesion"]


def test_an_indentation_s_gap_is_mostly_closed_by_a_formula():
    """Ten indentations of fused silica with a sharp tip: not cellulose, no platens, no particle."""
    campaign = read_instrument_file(INSTRUMENTS / "FS1.txt", diameters_um=(60.0,) * 3)
    indentation = answer(campaign, library=FEW, confirm=True)
    assert indentation["verdict"] == "UNLISTED"
    assert indentation["gap"]["closed_fraction"] > 0.8
    assert "square root" in indentation["closure"]["formula"]  # of a sharp tip, displacement goes with that of force
    assert "of no solid" in indentation["summary"]  # nothing of the unloading is left to the modulus
