"""Records of measured tests: from segments, robust against noise, equal to the clean ones in substance."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tested import FORCE, LAW, PARTICLE, RECORD, TIME, VARIANTS, signature_rows

from mcc_jax import Hold, InputError, Instrument, Programme, Ramp, paper_campaign
from mcc_jax.campaign import available_data, find_segments, humidities, record_of
from mcc_jax.campaign.record import ramp_rates
from mcc_jax.effects import LIBRARY, Need, clean_record

STEPS = (Ramp(0.6, 2.0), Ramp(0.2, 4.0), Ramp(1.0, 1.0), Hold(40.0), Ramp(0.3, 2.0), Ramp(0.9, 2.0), Ramp(0.0, 2.0))


def campaign(noise=0.0, steps=STEPS, points=400):
    instrument = Instrument(displacement_noise_um=noise, force_noise_mN=2.5 * noise)
    return paper_campaign(3, instrument=instrument, programme=Programme("load", steps, points=points))


def test_a_clean_path_is_cut_at_its_turns():
    record = RECORD
    assert record.reloads[-1] == 3
    at = {float(t): i for i, t in enumerate(np.asarray(TIME))}
    assert record.unload_from[at[140.0]] == 160
    assert record.reload_from[at[170.0]] == 100
    assert record.unload_from[at[180.0]] == 130
    assert record.reload_from[at[220.0]] == 110
    assert record.kind[at[280.0]] == 2
    assert record.branch[at[280.0]] == 1
    np.testing.assert_allclose(record.loading_rate[at[80.0]], 2.0, rtol=1e-9)
    np.testing.assert_allclose(record.loading_rate[at[240.0]], 5.0, rtol=1e-9)
    np.testing.assert_allclose(record.loading_rate[at[380.0]], 5.0, rtol=1e-9)
    np.testing.assert_allclose(record.rate[at[380.0]], 3.0, rtol=1e-9)
    # One whole reload would be 60 mN; half of it was made before it turned back.
    np.testing.assert_allclose(record.progress[at[220.0]], 0.5, rtol=1e-9)


@pytest.mark.extended
def test_segments_and_clean_path_tell_the_same():
    for curve in campaign().curves[:3]:
        clean = clean_record(jnp.asarray(curve.force_mN), jnp.asarray(curve.time_s))
        measured = record_of(curve, find_segments(curve, control="load"))
        assert measured.reloads[-1] == clean.reloads[-1] == 2
        # A turning point belongs to the segment before it in one, and to the one after it in the other.
        assert np.mean(np.asarray(measured.branch) != np.asarray(clean.branch)) < 0.03
        same = np.asarray(measured.branch) == np.asarray(clean.branch)
        top = curve.force_mN.max()
        for name, scale in (("unload_from", top), ("reload_from", top), ("loading_rate", 2.0), ("rate", 2.0)):
            difference = np.abs(np.asarray(getattr(measured, name)) - np.asarray(getattr(clean, name)))[same]
            assert np.quantile(difference, 0.97) < 0.02 * scale, name


def test_a_change_of_speed_on_the_way_up_is_seen():
    """A rate jump has no turn in it: one mean rate for the whole ramp would hide what the jump does."""
    steps = (Ramp(0.4, 1.0), Ramp(0.7, 8.0), Ramp(1.0, 0.5), Ramp(0.0, 2.0))
    for curve in campaign(0.02, steps).curves[:3]:
        clean = clean_record(jnp.asarray(curve.force_mN), jnp.asarray(curve.time_s))
        measured = record_of(curve, find_segments(curve, control="load"))
        share = curve.force_mN / curve.force_mN.max()
        for low, high, rate in ((0.02, 0.37, 1.0), (0.45, 0.65, 8.0), (0.73, 0.97, 0.5)):
            inside = (share > low) & (share < high) & (np.asarray(clean.branch) == 1)
            np.testing.assert_allclose(np.asarray(measured.loading_rate)[inside], rate, rtol=0.02)


@pytest.mark.extended
@given(
    jump=st.sampled_from((0.1, 0.4, 2.5, 10.0)),
    place=st.floats(0.25, 0.75),
    noise=st.floats(0.0, 3e-4),
    readings=st.integers(25, 300),
    seed=st.integers(0, 99),
)
def test_a_kink_has_two_rates_and_a_bend_has_one(jump, place, noise, readings, seed):
    time = np.linspace(0.0, 10.0, readings)
    scatter = noise * np.random.default_rng(seed).normal(size=readings)
    kinked = np.interp(time, [0.0, 10 * place, 10.0], np.cumsum([0.0, place, jump * (1 - place)]))
    kinked, slope = kinked / kinked[-1], 0.1 / kinked[-1]
    rates = ramp_rates(time, kinked + scatter, 0.0)
    found = [np.median(rates[part]) for part in (time < 10 * place, time > 10 * place)]
    np.testing.assert_allclose(found, [slope, jump * slope], rtol=0.1)
    for smooth in (time, time**1.5, time**2, np.expm1(time / 5), 1 - np.exp(-time / 4)):
        assert len(set(ramp_rates(time, smooth / smooth[-1] + scatter, 0.0))) == 1


def test_a_hold_too_short_to_be_one_leaves_the_rate_of_its_ramp():
    time = np.arange(14.0)
    force = np.minimum(2.0 * time, 22.0)
    np.testing.assert_allclose(ramp_rates(time, force, 7.0), 2.0, rtol=0.05)


def test_a_faster_ramp_leaves_the_peak_where_it_is():
    """At a higher rate the loading curve begins below the peak before: nothing comes back until it is met again."""
    steps = (Ramp(0.6, 1.0), Hold(30.0), Ramp(0.3, 1.0), Ramp(1.0, 8.0), Ramp(0.0, 8.0))
    measured = campaign(steps=steps)
    curve = measured.curves[0]
    law = LAW.with_effects(LIBRARY["rate_dependence"]["flow_log_force_rate"].build(0.05))
    record = record_of(curve, find_segments(curve))
    record = dataclasses.replace(record, peak=jnp.maximum.accumulate(record.force))  # as records of a fit know it
    clean = clean_record(jnp.asarray(curve.force_mN), jnp.asarray(curve.time_s))
    of_record, of_path = (np.asarray(law.respond(PARTICLE, one)) for one in (record, clean))
    np.testing.assert_allclose(of_record, of_path, atol=2e-2)


def test_rates_of_very_short_ramps():
    assert ramp_rates(np.array([3.0]), np.array([1.0]), 7.0).tolist() == [7.0]
    assert ramp_rates(np.array([3.0, 3.0]), np.array([1.0, 2.0]), 7.0).tolist() == [7.0, 7.0]
    np.testing.assert_allclose(ramp_rates(np.array([1.0, 2.0]), np.array([4.0, 1.0]), 7.0), 3.0)
    # Readings that share one time, as instruments with coarse clocks write them.
    assert np.all(np.isfinite(ramp_rates(np.repeat([0.0, 1.0, 2.0, 3.0], 4), np.linspace(0, 1, 16) ** 2, 7.0)))


@pytest.mark.extended
def test_noise_of_force_does_not_change_what_an_effect_adds():
    """To first order, for every variant: what noise of force makes of its signature is small in comparison."""
    records = []
    for noise in (0.0, 0.03):
        curve = campaign(noise).curves[1]
        records.append(record_of(curve, find_segments(curve, control="load"), relative_humidity_percent=75.0))
    for variant, clean, noisy in zip(VARIANTS, *signature_rows(*records), strict=True):
        assert np.sqrt(np.mean((noisy - clean) ** 2)) < 0.06 * np.abs(clean).max(), variant


@pytest.mark.extended
def test_humidity_comes_from_its_column():
    tests = campaign(points=60)
    assert humidities(tests) is None
    wet = dataclasses.replace(tests, columns={"relative_humidity_percent": tuple(str(30 + i) for i in range(20))})
    np.testing.assert_array_equal(humidities(wet), 30 + np.arange(20))
    assert Need.HUMIDITY_COLUMN in available_data(wet)
    for text in ("x", "-1", "101", "nan"):
        bad = dataclasses.replace(tests, columns={"relative_humidity_percent": (text,) * 20})
        with pytest.raises(InputError, match="relative humidity of particle '1'"):
            humidities(bad)


def test_what_a_campaign_holds():
    simple = paper_campaign(1, programme=Programme.cycles(points=150))
    assert {Need.UNLOADING, Need.SEVERAL_SIZES, Need.SEVERAL_SHAPES, Need.SEVERAL_PEAKS} <= available_data(simple)
    assert not {Need.RELOAD, Need.HOLD, Need.TWO_RATES, Need.HUMIDITY_COLUMN} & available_data(simple)
    assert {Need.RELOAD, Need.SECOND_RELOAD, Need.HOLD, Need.TWO_RATES} <= available_data(campaign())


def test_segments_must_cover_the_curve():
    curve = campaign(points=60).curves[0]
    segments = find_segments(curve)
    with pytest.raises(ValueError, match="cover"):
        record_of(curve, segments[:-1])


def test_times_may_begin_anywhere():
    later = clean_record(FORCE, TIME + 1e4)
    law = LAW.with_effects("creep", "damage")
    one, other = law.respond(PARTICLE, RECORD), law.respond(PARTICLE, later)
    np.testing.assert_allclose(one, other, rtol=1e-9)
