"""Forces at which branches begin: exact where readings are, unbiased and as certain as stated where they are noisy."""

from itertools import pairwise

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from mcc_jax.campaign import Curve, find_segments, turning_forces

PEAK = 300.0
DRAWS = 200


def drive(*corners, points=400, bend=0.0, on_reading=True):
    """Times and forces of straight ramps between (time, force), rising ones bent; turns on a reading or between."""
    when, level = np.array(corners, float).T
    time = np.linspace(0, when[-1], points)
    if on_reading:
        time = np.unique(np.concatenate([time, when]))
    force = np.interp(time, when, level)
    for k, (a, b) in enumerate(pairwise(when)):
        inside = (time >= a) & (time <= b)
        share = (time[inside] - a) / (b - a)
        force[inside] += bend * (level[k + 1] - level[k]) * share * (share - 1)
    return time, force


PATHS = {
    "ramp": ((0, 0), (100, PEAK), (200, 0)),
    "hold": ((0, 0), (100, PEAK), (140, PEAK), (240, 0)),
    "reloads": ((0, 0), (60, 150), (100, 30), (140, 150), (200, PEAK), (300, 0)),
    "reloads with holds": ((0, 0), (60, 150), (80, 150), (120, 30), (160, 150), (220, PEAK), (240, PEAK), (340, 0)),
}


def curve_of(time, force):
    displacement = np.maximum.accumulate(np.abs(force)) ** 0.6 + 0.01 * force
    return Curve(time, force, displacement)


def levels(curve):
    """Every level that branches start from, with its error, in their order."""
    found = turning_forces(curve, find_segments(curve))
    elastic = np.flatnonzero(found.error > 0)
    first = elastic[np.concatenate([[True], np.diff(found.peak[elastic]) != 0])]
    return found, found.peak[first], found.error[first]


def truth(name):
    return [150.0, PEAK] if "reloads" in name else [PEAK]


@settings(max_examples=60)
@given(st.sampled_from(sorted(PATHS)), st.integers(40, 400), st.floats(0.5, 2.0), st.floats(0.0, 0.3))
def test_of_a_clean_record_the_reading_is_the_level(name, points, slower, bend):
    """However coarse it is, and wherever the readings next to a turn or a hold fall."""
    corners = np.array(PATHS[name], float)
    corners[2:, 0] += (slower - 1) * (corners[2, 0] - corners[1, 0])
    time, force = drive(*corners, points=points, bend=bend)
    found, level, _ = levels(curve_of(time, force))
    np.testing.assert_allclose(level, truth(name), rtol=1e-9)
    np.testing.assert_allclose(found.force, force, rtol=1e-9)
    # Virgin loading is its own peak; behind it all stands under the largest force so far.
    np.testing.assert_allclose(found.peak, np.maximum.accumulate(force), rtol=1e-9)


@pytest.mark.parametrize(("bend", "points"), [(0.0, 400), (0.3, 1200)], ids=["straight", "bent"])
@pytest.mark.parametrize("on_reading", [True, False], ids=["on a reading", "between readings"])
@pytest.mark.parametrize("name", ["ramp", "reloads with holds", "hold", "reloads"])
def test_noisy_levels_are_unbiased_and_as_certain_as_stated(name, bend, points, on_reading):
    """Bias of a twentieth of a reading's deviation is let pass; the largest reading is out by one or two."""
    time, force = drive(*PATHS[name], bend=bend, on_reading=on_reading, points=points)
    rng = np.random.default_rng(3)
    for noise in (0.1, 1.0):
        several = [levels(curve_of(time, force + noise * rng.standard_normal(len(force))))[1:] for _ in range(DRAWS)]
        assert all(len(level) == len(truth(name)) for level, _ in several)
        level, error = (np.array(x) for x in zip(*several, strict=True))
        off = (level - truth(name)) / noise
        assert np.all(np.abs(off.mean(0)) < 3 * off.std(0) / np.sqrt(DRAWS) + 0.05), (noise, off.mean(0), off.std(0))
        np.testing.assert_allclose(np.sqrt(np.mean((off / error) ** 2, 0)), 1.0, atol=0.3)
        assert np.mean(error < 0.9) > 0.98


@pytest.mark.parametrize("step", [0.5, 1.0, 4.3])
@pytest.mark.parametrize("width", [0.5, 1.0, 2.0])
def test_a_rounded_tip_is_not_sharpened(step, width):
    """A machine turns round in the time of a few readings; where straight ramps would meet it has never been.

    The level may be out by a few deviations of a reading, as the largest reading is, not by a share of a step; if the
    machine turns within half a reading, by half a step, since a sharp tip between readings looks the same.
    """
    rng, noise, away = np.random.default_rng(5), 0.05, []
    for _ in range(20):
        count = int(PEAK / step)
        at = np.arange(-count, count + 1) + rng.uniform(-0.5, 0.5)
        force = PEAK - step * (np.hypot(width, at) - width)
        force -= force[0]
        true = force.max()
        found = levels(curve_of(np.arange(len(at), dtype=float), force + noise * rng.standard_normal(len(at))))[1]
        away.append((found[-1] - true) / noise)
    assert abs(np.median(away)) < max(3.0, 0.5 * step / noise if width < 1 else 0.0)


def test_many_cycles_start_from_their_own_levels():
    """Each one goes a little further than the one before it."""
    tops = np.linspace(100, PEAK, 30)
    corners, now = [(0.0, 0.0)], 0.0
    for top in tops:
        for level, ahead in ((top, 40.0), (0.3 * top, 30.0)):
            now += ahead
            corners.append((now, level))
    time, force = drive(*corners, points=3000)
    rng = np.random.default_rng(1)
    several = [levels(curve_of(time, force + 0.2 * rng.standard_normal(len(force))))[1:] for _ in range(20)]
    off = np.array([(level - tops) / 0.2 for level, _ in several])
    error = np.array([one for _, one in several])
    assert abs(off.mean()) < 3 * off.std() / np.sqrt(off.size)
    np.testing.assert_allclose(np.std(off / error), 1.0, atol=0.3)


def test_a_relaxing_force_shows_its_level_by_the_ramp_alone():
    """While the platen rests the force falls: the mean of that stretch is no level."""
    time, force = drive((0, 0), (100, PEAK), (160, PEAK), (260, 0), points=520)
    rest = (time > 100) & (time <= 160)
    fall = 20 * (1 - np.exp(-(time - 100) / 15))
    force = np.where(rest, PEAK - fall, np.where(time > 160, force * (PEAK - fall[rest][-1]) / PEAK, force))
    displacement = np.interp(time, [0, 100, 160, 260], [0, 10, 10, 7])
    rng, off = np.random.default_rng(2), []
    for _ in range(DRAWS):
        curve = Curve(time, force + 0.5 * rng.standard_normal(len(time)), displacement)
        segments = find_segments(curve, control="displacement")
        assert [part.kind for part in segments] == ["load", "hold", "unload"]
        found = turning_forces(curve, segments)
        off.append((found.peak[-1] - PEAK) / 0.5)
        assert found.reading[segments[1].start + 5 : segments[1].stop].all()
    assert abs(np.mean(off)) < 0.5
    assert np.std(off) < 1.0


def test_forces_are_cut_at_the_level_and_a_hold_repeats_it():
    time, force = drive(*PATHS["reloads with holds"])
    rng = np.random.default_rng(4)
    curve = curve_of(time, force + 0.5 * rng.standard_normal(len(force)))
    segments = find_segments(curve)
    found, level, _ = levels(curve)
    assert np.all(found.force <= found.peak)
    held = np.concatenate([np.arange(part.start + 3, part.stop - 3) for part in segments if part.kind == "hold"])
    assert len(held) > 30
    assert not found.reading[held].any()
    np.testing.assert_array_equal(found.force[held], found.peak[held])
    np.testing.assert_array_equal(np.unique(found.peak[held]), level)
    # Where a reload passes the level before, loading is virgin again.
    loading = found.error == 0
    np.testing.assert_array_equal(found.peak[loading], found.force[loading])


def test_a_record_that_begins_behind_its_peak_starts_where_it_does():
    time, force = drive((0, PEAK), (100, 0))
    found = turning_forces(curve_of(time, force), find_segments(curve_of(time, force)))
    np.testing.assert_allclose(found.peak, PEAK, rtol=1e-9)
    assert np.all(found.error == 1)
