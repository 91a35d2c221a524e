"""Channels at the end of their range are found, their readings censored, and the turning point is worked out."""

import faulty
import numpy as np
import pytest
from faulty import exact, noisy
from hypothesis import given, settings
from hypothesis import strategies as st

from mcc_jax.campaign import Curve, campaign_findings, check_tests
from mcc_jax.campaign.saturation import censor_displacement, censor_force

SEEDS = st.integers(0, 2**31 - 1)
quickly = settings(max_examples=15)


@pytest.mark.extended
@quickly
@given(SEEDS, st.floats(0.85, 0.98))
def test_the_turning_point_that_the_force_channel_did_not_see_is_worked_out(seed, share):
    campaign = noisy(exact(), seed)
    checked = check_tests(faulty.clipped(campaign, share))
    (found,) = campaign_findings(checked)
    assert (found.check, found.level, found.particles) == ("saturation", "warning", campaign.particles)
    assert "force stays at" in found.sentence
    assert "larger range" in found.remedy
    for true, raw, curve in zip(exact().curves, checked.raw.curves, checked.curves, strict=True):
        kept = curve.checked
        end = raw.force_mN.max()
        assert np.count_nonzero(~kept.compared) == 1
        (top,) = np.flatnonzero(~kept.compared)
        assert top == np.argmax(curve.force_mN)
        sd = kept.force_sd_mN[top]
        assert 0 < sd < 0.02 * true.force_mN.max()
        assert abs(curve.force_mN[top] - true.force_mN.max()) < 5 * sd
        assert abs(curve.displacement_um[top] - true.displacement_um.max()) < 0.2
        # All others are readings below the end of the range, to the last bit.
        rest = np.delete(np.arange(len(curve)), top)
        assert np.array_equal(curve.force_mN[rest], raw.force_mN[kept.rows[rest]])
        assert (curve.force_mN[rest] < end).all()
        assert not kept.force_sd_mN[rest].any()


def test_far_beyond_the_range_the_turning_point_is_not_relied_on():
    (found,) = campaign_findings(check_tests(faulty.clipped(noisy(exact(), 0), 0.6)))
    assert found.level == "error"
    assert "too far beyond the range" in found.sentence


@quickly
@given(SEEDS, st.floats(0.8, 0.985))
def test_a_displacement_at_the_end_of_its_range_is_not_compared(seed, share):
    campaign = noisy(exact(), seed)
    checked = check_tests(faulty.clipped(campaign, share, channel="displacement"))
    (found,) = campaign_findings(checked)
    assert (found.check, found.level, found.particles) == ("saturation", "warning", campaign.particles)
    assert "displacement stays at" in found.sentence
    assert "larger range of displacement" in found.remedy
    for raw, curve in zip(checked.raw.curves, checked.curves, strict=True):
        assert np.array_equal(raw.displacement_um, curve.displacement_um)
        hidden = ~curve.compared
        assert hidden[raw.displacement_um == raw.displacement_um.max()].all()
        # Readings near the end are those that noise brought below it; the rest stay.
        assert not hidden[raw.displacement_um < raw.displacement_um.max() - 0.3].any()


def ramp(turn, *, shape="triangle", count=301, noise=0.02, seed=0):
    """Displacement up and down under displacement control, and a force that is elastic-plastic in it."""
    phase = np.linspace(0, 1, count)
    way = 1 - np.abs(2 * phase - 1) if shape == "triangle" else np.sin(np.pi * phase)
    loading = 100 * way + 40 * way**3
    top = int(np.argmax(way))
    force = np.where(np.arange(count) <= top, loading, np.maximum(140 - 300 * (1 - way), 0.0))
    path = 50 * way + noise * np.random.default_rng(seed).standard_normal(count)
    return Curve(np.arange(count, dtype=float), np.minimum(force, turn * 140), path)


@pytest.mark.parametrize("shape", ["triangle", "sine"])
@pytest.mark.parametrize("share", [0.85, 0.9, 0.95])
def test_ramps_of_any_course_turn_behind_the_end_of_the_range(shape, share):
    seen, kept = censor_force(ramp(share, shape=shape))
    top = int(np.argmax(seen.force_mN))
    assert abs(seen.force_mN[top] - 140) < max(5 * kept.force_sd_mN[top], 0.5)


@quickly
@given(SEEDS, st.sampled_from(["triangle", "sine"]))
def test_a_ramp_within_the_range_is_left_alone(seed, shape):
    curve = ramp(2.0, shape=shape, seed=seed)
    assert censor_force(curve) is None
    assert censor_displacement(curve) is None


def test_a_record_that_ends_at_the_end_of_the_range_is_seen_too():
    curve = ramp(0.9)
    half = slice(0, 151)
    seen, kept = censor_force(Curve(curve.time_s[half], curve.force_mN[half], curve.displacement_um[half]))
    assert abs(seen.force_mN[-1] - 140) < 5 * kept.force_sd_mN[-1]
