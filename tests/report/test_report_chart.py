"""The chart of a page: predictions that are true, bands that hold what they say, and at most so many points."""

import dataclasses
import math

import numpy as np
from asserting import estimate
from results_folder import MODULUS, NAMES, NOISE, calibration, changed
from results_folder import C as COEFFICIENTS

from mcc_jax.calibrate.curves import KINDS
from mcc_jax.report import read_results
from mcc_jax.report.chart import chart, compare
from mcc_jax.report.checks import share_inside


def test_prediction_with_the_true_coefficients_is_the_measurement(without_posterior):
    shown = compare(read_results(without_posterior))
    assert [one.name for one in shown] == list(NAMES)
    for one in shown[:-1]:
        np.testing.assert_allclose(one.own_um, one.displacement_um, atol=1e-7)
        assert one.rms_um < 1e-7
        assert set(one.kind.tolist()) == {KINDS.index(k) for k in ("load", "hold", "unload", "reload")}
    assert np.isnan(shown[-1].own_um).all()
    assert "fewer than 12" in shown[-1].why_not
    assert shown[-1].rms_um is None


def test_a_wrong_coefficient_shows_as_misfit(without_posterior):
    content = calibration()
    content["particles"][0]["C1"]["value"] *= 1.05
    one = compare(changed(without_posterior, particles=content["particles"]))[0]
    assert one.rms_um > 0.5


def test_own_modulus_and_own_shape_are_used_where_they_scatter(without_posterior):
    content = calibration()["particles"]
    for entry in content[:-1]:
        entry["effective_modulus_MPa"] = estimate(MODULUS)
    scatter, wrong = estimate(0.1), estimate(2000.0)
    found = changed(without_posterior, particles=content, modulus_scatter=scatter, effective_modulus_MPa=wrong)
    for one in compare(found)[:-1]:
        np.testing.assert_allclose(one.own_um, one.displacement_um, atol=1e-7)
        assert np.abs(one.typical_um - one.own_um)[one.kind == KINDS.index("unload")].max() > 0.1
    found = changed(without_posterior, shape_scatter=scatter, a=estimate(0.5))
    for one in compare(found)[:-1]:
        np.testing.assert_allclose(one.own_um, one.displacement_um, atol=1e-7)


def test_the_typical_particle_is_the_median_or_for_the_papers_method_the_mean(folder):
    """Where C5 dominates, E[C5^5] of a log-normal is larger than its median: the mean law is stiffer."""
    median = compare(read_results(folder))[0]
    mean = compare(changed(folder, method="paper"))[0]
    top = np.argmax(median.force_mN)
    assert mean.typical_um[top] < median.typical_um[top]
    pairs = zip((1, 3, 5), COEFFICIENTS[0], strict=True)
    log_C = {f"log_C{k}": {"mean": estimate(math.log(c)), "sd": estimate(0.0)} for k, c in pairs}
    for method in ("paper", "least-squares"):
        one = compare(changed(folder, method=method, figures=[], **log_C))[0]
        np.testing.assert_allclose(one.typical_um, one.own_um, atol=1e-7)


def test_bands_hold_what_the_noise_says(results, shown):
    assert share_inside(shown) == 1.0  # tests without noise, bands with it
    for one in shown[:-1]:
        np.testing.assert_allclose(one.own_um, one.displacement_um, atol=NOISE / 4)  # of 500 draws
        np.testing.assert_allclose(one.high_um - one.low_um, 2 * 1.96 * NOISE, rtol=0.15)
        np.testing.assert_allclose((one.high_um + one.low_um) / 2, one.displacement_um, atol=NOISE / 3)
    assert np.isnan(shown[-1].low_um).all()


def test_of_many_points_turns_stay_and_of_many_particles_the_worst(without_posterior, shown, monkeypatch):
    monkeypatch.setattr("mcc_jax.report.chart.POINTS", 80)
    monkeypatch.setattr("mcc_jax.report.chart.FEWEST", 20)
    few = compare(read_results(without_posterior))
    for one, all_of_it in zip(few, shown, strict=True):
        assert len(one.force_mN) < 45 < len(all_of_it.force_mN)
        assert one.force_mN.max() == all_of_it.force_mN.max()
        assert one.force_mN[-1] == all_of_it.force_mN[-1]
    content = calibration()["particles"]
    content[1]["C1"]["value"] *= 1.5
    worst = changed(without_posterior, particles=content)
    monkeypatch.setattr("mcc_jax.report.chart.POINTS", 20)
    assert [one.name for one in compare(worst)] == [NAMES[1]]


def test_rounding_in_the_page_does_not_show(shown):
    away = 1e-4 * np.random.default_rng(0).standard_normal(len(shown[0].own_um))
    one = dataclasses.replace(shown[0], displacement_um=shown[0].own_um + away)
    column = chart([one], ["1"], [""])["data"]["particles"][0]
    residual = np.array(column["displacement"]) - np.array(column["own"])
    np.testing.assert_allclose(residual, away, atol=2e-6)
