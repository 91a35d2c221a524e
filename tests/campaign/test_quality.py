"""What instruments do to tests is found, corrected where the record allows, and reported; sound tests stay."""

from dataclasses import replace

import faulty
import numpy as np
import pytest
from faulty import exact, noisy
from hypothesis import given, settings
from hypothesis import strategies as st

from mcc_jax.campaign import Campaign, Finding, campaign_findings, check_tests
from mcc_jax.campaign.findings import has_error
from mcc_jax.campaign.force_zero import open_zero

SEEDS = st.integers(0, 2**31 - 1)
quickly = settings(max_examples=15)


def only(campaign, check):
    """The single finding of a campaign, which is of that check."""
    checked = check_tests(campaign)
    (found,) = campaign_findings(checked)
    assert found.check == check, str(found)
    return checked, found


# ---- sound tests -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(10))
def test_a_sound_campaign_without_air_readings_stays_what_it_is(seed):
    campaign = noisy(exact(), seed)
    checked = check_tests(campaign)
    assert campaign_findings(checked) == ()
    assert checked.raw is campaign
    assert all(now is before for now, before in zip(checked.curves, campaign.curves, strict=True))


@pytest.mark.parametrize(("step_mN", "step_um"), [(0.5, 0.0), (5.0, 0.0), (0.0, 0.1), (0.0, 1.0), (2.0, 0.5)])
def test_a_coarse_read_out_is_no_fault(step_mN, step_um):
    def rounded(time, *channels):
        steps = zip(channels, (step_mN, step_um), strict=True)
        return time, *(step * np.round(values / step) if step else values for values, step in steps)

    checked = check_tests(faulty.changed(noisy(exact(), 3), rounded))
    assert campaign_findings(checked) == ()


@quickly
@given(SEEDS, st.integers(10, 60), st.booleans())
def test_a_hold_is_no_saturation(seed, readings, exactly):
    """Creep under a constant force, which a set-point column repeats to the last digit."""
    rng = np.random.default_rng(seed)

    def held(time, force, path):
        top = int(np.argmax(force))
        creep = 0.003 * path[top] * np.log1p(np.arange(1, readings + 1) / 5) / np.log1p(readings / 5)
        noise = np.zeros(readings) if exactly else 0.05 * rng.standard_normal(readings)
        return faulty.inserted(time, force, path, top, force[top] + noise, creep)

    checked = check_tests(noisy(faulty.changed(exact(), held), seed, noise_mN=0.0 if exactly else 0.05))
    assert not [one for one in campaign_findings(checked) if one.check == "saturation"]


# ---- the zero of force -----------------------------------------------------------------------------------------------


@quickly
@given(SEEDS, st.floats(-30, 30), st.integers(15, 120))
def test_the_zero_of_force_in_the_air_is_taken_off_with_its_error(seed, offset_mN, readings):
    campaign = faulty.in_air(noisy(exact(), seed), offset_mN=offset_mN, readings=readings, seed=seed)
    checked = check_tests(campaign)
    assert checked.raw is campaign
    for raw, curve in zip(campaign.curves, checked.curves, strict=True):
        kept = curve.checked
        np.testing.assert_array_equal(kept.rows, np.arange(len(raw)))
        np.testing.assert_allclose(curve.force_mN + kept.force_zero_mN, raw.force_mN, atol=1e-9)
        assert np.array_equal(curve.displacement_um, raw.displacement_um)
        # Noise of 0.05 mN, averaged; autocorrelation by chance makes it larger, not smaller.
        alone = 0.05 / np.sqrt(readings)
        assert 0.4 * alone < kept.force_zero_sd_mN < 4 * alone
        assert abs(kept.force_zero_mN - offset_mN) < 5 * kept.force_zero_sd_mN
    found = campaign_findings(checked)
    assert found or abs(offset_mN) < 1
    assert all(one.level == "info" for one in found)
    assert all("before contact; this was taken off" in one.sentence for one in found)


def test_an_offset_that_no_answer_can_feel_is_taken_off_without_a_word():
    checked = check_tests(faulty.in_air(noisy(exact(), 0), offset_mN=0.1))
    assert campaign_findings(checked) == ()
    assert all(abs(curve.checked.force_zero_mN - 0.1) < 0.05 for curve in checked.curves)


def shifted(campaign, offset_mN, share=0.0):
    """The tests as a load cell reads them whose zero is off, begun at a share of the first step of their ramp."""
    return faulty.changed(campaign, lambda t, F, d: (t, F + offset_mN + share * (F[1] - F[0]), d))


def test_a_record_that_begins_below_zero_without_air_was_not_tared():
    checked, found = only(shifted(noisy(exact(), 0), -10.0), "zero of force")
    assert found.level == "warning"
    assert found.particles == exact().particles
    assert "Tare the load cell" in found.remedy
    for curve in checked.curves:
        # The first reading may lie a step of the ramp behind contact; its error has room for that.
        assert abs(curve.checked.force_zero_mN + 10.0) < curve.checked.force_zero_sd_mN


def test_a_record_that_begins_above_zero_without_air_leaves_its_zero_open():
    checked, found = only(shifted(noisy(exact(), 0), 20.0), "zero of force")
    assert found.level == "info"
    assert "preload" in found.sentence
    assert all(c.checked is None or c.checked.force_zero_mN == 0.0 for c in checked.curves)
    zero, error = open_zero(checked)
    assert zero == pytest.approx(20.0, abs=0.5)
    assert 0.1 < error < 3.0
    # Had the load cell not been tared: every test of it is off, seen by itself or not.
    tared = check_tests(checked.raw, zero_mN=(20.0, error))
    assert open_zero(tared) is None
    assert all(c.checked.force_zero_mN == 20.0 for c in tared.curves)


@pytest.mark.parametrize("offset_mN", [-10.0, 20.0])
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_tests_of_one_load_cell_determine_its_zero_together(offset_mN, share):
    """Every record begins at the same part of the first step of its ramp: the line over steps meets the zero."""
    checked = check_tests(shifted(noisy(exact(), 0), offset_mN, share))
    zero = open_zero(checked)[0] if offset_mN > 0 else checked.curves[0].checked.force_zero_mN
    assert abs(zero - offset_mN) < 0.3
    assert len({c.checked and c.checked.force_zero_mN for c in checked.curves} - {None}) == 1


def test_tests_that_share_no_zero_are_taken_one_by_one():
    campaign, offsets = noisy(exact(), 0), np.linspace(-30.0, -5.0, 4)
    for name, offset in zip(campaign.particles, offsets, strict=True):
        campaign = faulty.changed(campaign, lambda t, F, d, off=offset: (t, F + off, d), only=(name,))
    checked = check_tests(campaign)
    for curve, offset in zip(checked.curves, offsets, strict=True):
        if curve.checked is not None:  # a small particle's record may begin beyond what is a zero
            assert abs(curve.checked.force_zero_mN - offset) < 0.5
            assert curve.checked.force_zero_sd_mN == -curve.checked.force_zero_mN


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_a_record_that_begins_within_a_step_of_its_ramp_is_not_remarked(share):
    checked = check_tests(shifted(noisy(exact(), 0), 0.0, share))
    assert campaign_findings(checked) == ()
    assert open_zero(checked) is None


def test_of_many_tests_some_begin_far_from_zero_by_chance():
    """One of a thousand noisy first readings lies below three standard deviations: that shifts no zero."""
    campaign = exact()
    curves = tuple(curve for seed in range(60) for curve in noisy(campaign, seed).curves)
    names = tuple(f"P{k}" for k in range(len(curves)))
    many = Campaign(names, np.tile(campaign.diameters_um, (60, 1)), curves)
    assert min(float(curve.force_mN[0]) for curve in curves) < -3 * 0.05
    checked = check_tests(many)
    assert campaign_findings(checked) == ()
    assert open_zero(checked) is None


@pytest.mark.parametrize("drift_mN", [-20.0, -5.0, 3.0, 8.0])
def test_a_drift_in_the_air_is_reported_with_its_change_as_error(drift_mN):
    campaign = faulty.in_air(noisy(exact(), 1), drift_mN=drift_mN)
    checked = check_tests(campaign)
    found = campaign_findings(checked)
    assert {one.check for one in found} == {"zero of force"}
    assert "warning" in {one.level for one in found}
    assert not has_error(found)
    assert {name for one in found for name in one.particles} == set(campaign.particles)
    assert all("drift" in one.sentence and "settle" in one.remedy for one in found)
    corrected = [curve.checked for curve in checked.curves if curve.checked.force_zero_sd_mN > 0]
    assert corrected
    for kept in corrected:
        # The change along nine tenths of the air.
        assert kept.force_zero_sd_mN == pytest.approx(0.9 * abs(drift_mN) / np.sqrt(12), rel=0.05)
        assert abs(kept.force_zero_mN - drift_mN) < kept.force_zero_sd_mN


def test_a_slower_speed_up_to_a_preload_is_no_drift():
    def two_speeds(time, force, path):
        preload = int(np.argmax(force > 0.05 * force.max()))
        share = np.linspace(0, preload, 4 * preload + 1)
        index = np.arange(len(force), dtype=float)
        f, d = np.interp(share, index, force), np.interp(share, index, path)
        values = np.concatenate([f, force[preload + 1 :]]), np.concatenate([d, path[preload + 1 :]])
        return (time[0] + (time[1] - time[0]) * np.arange(len(values[0])), *values)

    assert campaign_findings(check_tests(noisy(faulty.changed(exact(), two_speeds), 2))) == ()


# ---- readings --------------------------------------------------------------------------------------------------------


@quickly
@given(SEEDS, st.integers(10, 280), st.floats(0.15, 1e4), st.sampled_from([-1, 1]), st.sampled_from(["force", "path"]))
def test_a_spike_is_left_out_and_nothing_else_is(seed, at, height, sign, channel):
    campaign = noisy(exact(), seed)
    channel = "force" if channel == "force" else "displacement"
    curve = campaign.curves[1]
    reach = float(np.ptp(curve.force_mN if channel == "force" else curve.displacement_um))
    faulted = faulty.spiked(campaign, height=sign * height * reach, channel=channel, at=at, only=("2",))
    checked, found = only(faulted, "spikes")
    assert (found.level, found.particles) == ("info", ("2",))
    assert channel in found.sentence
    np.testing.assert_array_equal(checked.curves[1].checked.rows, np.delete(np.arange(len(curve)), at))
    assert checked.curves[0] is faulted.curves[0]


@quickly
@given(SEEDS, st.integers(15, 120), st.integers(12, 30), st.sampled_from(["force", "displacement", "both"]))
def test_readings_that_stick_are_left_out(seed, start, readings, channel):
    campaign = faulty.stuck(noisy(exact(), seed), start=start, readings=readings, channel=channel, only=("3",))
    checked, found = only(campaign, "stuck readings")
    assert (found.level, found.particles) == ("info", ("3",))
    gone = np.setdiff1d(np.arange(len(campaign.curves[2])), checked.curves[2].checked.rows)
    np.testing.assert_array_equal(gone, np.arange(start + 1, start + readings))
    assert "force" in found.sentence or channel == "displacement"


# ---- breakage --------------------------------------------------------------------------------------------------------


@quickly
@given(SEEDS, st.floats(0.3, 0.95), st.floats(0.0, 0.5))
def test_a_record_counts_up_to_where_the_particle_broke(seed, at, left):
    campaign = faulty.broken(noisy(exact(), seed), at=at, left=left, only=("2",))
    checked, found = only(campaign, "breakage")
    assert (found.level, found.particles) == ("warning", ("2",))
    assert "Particle 2" in found.sentence
    assert "broke" in found.sentence
    assert found.remedy
    raw, curve = campaign.curves[1], checked.curves[1]
    last = int(np.argmax(raw.force_mN >= at * noisy(exact(), seed).curves[1].force_mN.max()))
    assert abs(len(curve) - 1 - last) <= 3
    for name in ("time_s", "force_mN", "displacement_um"):
        np.testing.assert_array_equal(getattr(curve, name), getattr(raw, name)[: len(curve)])


def test_quick_unloading_is_no_breakage():
    """The platens part: displacement falls with the force."""

    def quick(time, force, path):
        top = int(np.argmax(force))
        rows = np.concatenate([np.arange(top + 1), np.arange(top + 40, len(force), 40)])
        return time[: len(rows)], force[rows], path[rows]

    found = campaign_findings(check_tests(noisy(faulty.changed(exact(), quick), 0)))
    assert "breakage" not in [one.check for one in found]


@quickly
@given(SEEDS, st.floats(0.3, 0.8), st.integers(8, 40), st.floats(0.03, 0.2), st.booleans())
def test_force_that_falls_while_the_platens_close_on_is_no_unloading(seed, at, readings, lost, for_good):
    """A slip of a test under displacement: its readings are left out until the force is back, or to the end."""

    def slipping(time, force, path):
        first = int(np.argmax(force >= at * force.max()))
        before = force[first]
        falls = before * (1 - lost * np.arange(1, readings + 1) / readings)
        rises = np.empty(0) if for_good else np.linspace(falls[-1], before, readings + 1)[1:-1]
        more = np.concatenate([falls, rises])
        climb = (path[first] - path[first // 2]) / (first - first // 2) * np.arange(1, len(more) + 1)
        if for_good:
            time, force, path = time[: first + 1], force[: first + 1], path[: first + 1]
        return faulty.inserted(time, force, path, first, more, climb)

    slipped = faulty.changed(exact(), slipping, only=("2",))
    checked, found = only(noisy(slipped, seed), "breakage")
    assert (found.level, found.particles) == ("info", ("2",))
    assert "gives way or slips" in found.sentence
    raw = slipped.curves[1]
    first = int(np.argmax(raw.force_mN >= at * exact().curves[1].force_mN.max()))
    gone = readings if for_good else 2 * readings - 1
    left_out = np.setdiff1d(np.arange(len(raw)), checked.curves[1].checked.rows)
    assert abs(len(left_out) - gone) <= 4
    assert abs(left_out[0] - first - 1) <= 3
    assert np.all(np.diff(left_out) == 1)


# ---- records that lack their loading ---------------------------------------------------------------------------------


@quickly
@given(SEEDS, st.integers(0, 5))
def test_a_record_that_begins_at_its_largest_force_is_named(seed, earlier):
    def unloading(time, force, path):
        top = int(np.argmax(force)) - earlier
        return time[top:], force[top:], path[top:]

    campaign = faulty.changed(noisy(exact(), seed), unloading, only=("2", "4"))
    _, found = only(campaign, "loading")
    assert (found.level, found.particles) == ("warning", ("2", "4"))
    assert "begins at its largest force" in found.sentence
    assert "Join" in found.remedy


def test_a_force_with_the_wrong_sign_is_not_taken_for_a_lost_loading():
    reversed_force = faulty.changed(noisy(exact(), 0), lambda t, f, d: (t, -f, d), only=("2",))
    assert not [one for one in campaign_findings(check_tests(reversed_force)) if one.check == "loading"]


# ---- several faults, and what a checked campaign is ------------------------------------------------------------------


def test_faults_of_several_kinds_are_all_reported():
    campaign = faulty.in_air(noisy(exact(), 4), offset_mN=-15.0)
    campaign = faulty.spiked(campaign, height=1e5, at=150, only=("1",))
    campaign = faulty.broken(campaign, only=("2",))
    campaign = faulty.stuck(campaign, start=100, only=("3",))
    found = {one.check: one for one in campaign_findings(check_tests(campaign))}
    assert found["zero of force"].particles == campaign.particles
    assert [found[name].particles for name in ("spikes", "breakage", "stuck readings")] == [("1",), ("2",), ("3",)]


def test_checking_twice_changes_nothing_more():
    once = check_tests(faulty.in_air(noisy(exact(), 0), offset_mN=20.0))
    assert check_tests(once) is once


def test_leaving_particles_out_keeps_raw_and_checked_together():
    checked = check_tests(faulty.broken(faulty.in_air(noisy(exact(), 0), offset_mN=20.0), only=("2",)))
    rest = checked.without("2")
    assert rest.particles == rest.raw.particles == ("1", "3", "4")
    assert {one.check for one in campaign_findings(rest)} == {"zero of force"}
    assert rest.curves[0] is checked.curves[0]


def test_a_finding_survives_json():
    one = Finding("breakage", "warning", "Particle 2: it broke", "Leave it out", ("2",))
    assert Finding.from_json(one.to_json()) == one
    assert str(one) == "Particle 2: it broke. Leave it out."
    assert has_error([one, replace(one, level="error")])
    assert not has_error([one])
