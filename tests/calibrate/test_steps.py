"""Each step of the paper's calibration against what it must give in closed form or on exact data."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ALL_FORMS
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_cases import A, flatness
from scipy.integrate import trapezoid

from mcc_jax import Instrument, Programme, paper_campaign, paper_law
from mcc_jax.calibrate import fit_shape_parameter, strain_table
from mcc_jax.calibrate.paper_steps import (
    MasterCurve,
    StrainTable,
    campaign_branches,
    choose_reference,
    fit_effective_modulus,
    fit_polynomial,
    fit_population,
    full_objective,
    master_curve,
    objective_at,
    reference_objective,
)
from mcc_jax.campaign import adjust, find_segments, loading_curve
from mcc_jax.law import LogNormal


@pytest.fixture(scope="module")
def exact():
    """The paper's particles of one material, without noise."""
    return paper_campaign(0, shared_material=True, instrument=Instrument())


@pytest.fixture(scope="module")
def scattered():
    return paper_campaign(0)


@pytest.fixture(scope="module")
def table(scattered):
    return strain_table(adjust(scattered), scattered.diameters_um)


# ---- adjustment ----


def test_loading_curve_is_the_law_at_the_measured_points(exact):
    law = paper_law()
    for i in (0, 5, 15):
        curve = loading_curve(exact.curves[i], exact.diameters_um[i], find_segments(exact.curves[i]))
        expected = np.asarray(law.plastic.strain(jnp.asarray(curve.stress_MPa[1:]))) / _eta(exact)[i]
        np.testing.assert_allclose(curve.strain[1:], expected, rtol=1e-9)


def test_adjusted_curves_meet_at_the_threshold_in_the_mean_of_the_raw_strains(scattered):
    raw, adjusted = adjust(scattered, 0.0), adjust(scattered, 0.2)
    at = np.array([float(c.at(0.2)) for c in raw.curves])
    assert adjusted.strain == pytest.approx(at.mean(), rel=1e-12)
    for curve in adjusted.curves:
        assert float(curve.at(0.2)) == pytest.approx(at.mean(), rel=1e-12)
        # Straight below the threshold, from the origin.
        assert float(curve.at(0.1)) == pytest.approx(at.mean() / 2, rel=1e-12)
    np.testing.assert_allclose(adjusted.shift, at.mean() - at, rtol=1e-9, atol=1e-12)


def test_adjusted_curves_do_not_depend_on_each_test_s_zero():
    plain = paper_campaign(3, instrument=Instrument())
    shifted = paper_campaign(3, instrument=Instrument(zero_um=2.0))
    a, b = adjust(plain), adjust(shifted)
    # The common strain at the threshold moves with the mean zero; the curves' shapes above it do not move at all.
    for one, two in zip(a.curves, b.curves, strict=True):
        np.testing.assert_allclose(one.at(5.0) - a.strain, two.at(5.0) - b.strain, rtol=1e-6)


def test_particles_below_the_threshold_are_left_out_with_the_reason():
    weak = paper_campaign(0, programme=Programme.cycles(levels=(0.02,)), instrument=Instrument())
    with pytest.raises(ValueError, match="threshold"):
        adjust(weak, -0.1)
    adjustment = adjust(weak)
    assert 0 < adjustment.kept.sum() < 20
    for reason, curve in zip(adjustment.why_not, adjustment.curves, strict=True):
        assert (reason is None) == (curve is not None)
        assert reason is None or "not the threshold of 0.2 MPa" in reason


@pytest.mark.extended
def test_cycles_give_the_same_loading_curve_as_one_ramp():
    programme = Programme.cycles(levels=(0.3, 0.6, 1.0), unload_to=0.05, points=900)
    ramp, cycles = (
        paper_campaign(1, shared_material=True, instrument=Instrument(), programme=p) for p in (None, programme)
    )
    for i in range(0, 20, 5):
        one = loading_curve(ramp.curves[i], ramp.diameters_um[i], find_segments(ramp.curves[i]))
        many = loading_curve(cycles.curves[i], cycles.diameters_um[i], find_segments(cycles.curves[i]))
        grid = np.linspace(0.5, 0.98 * one.stress_max_MPa, 50)
        np.testing.assert_allclose(many.at(grid), one.at(grid), rtol=2e-3)


# ---- master curve ----


def test_the_master_curve_is_the_sample_s_own_as_far_as_a_fifth_of_the_particles(scattered, table):
    master, curves = master_curve(table, 1.43), adjust(scattered).curves
    k = int(np.searchsorted(master.stress_MPa, 5.0))
    values = [eta * float(c.at(master.stress_MPa[k])) for eta, c in zip(table.shape_factor(1.43), curves, strict=True)]
    assert master.mean[k] == pytest.approx(np.mean(values), rel=1e-12)
    assert master.sd[k] == pytest.approx(np.std(values, ddof=1), rel=1e-12)
    assert master.count[k] == 20
    tops = np.sort([c.stress_max_MPa for c in curves])
    assert master.count.min() > 4
    # The fifth largest of twenty maxima is the last stress that more than four particles reach.
    assert master.stress_MPa[-1] == pytest.approx(tops[-5], abs=table.stress_MPa[1])


# ---- shape parameter ----


def objectives(table):
    """Both objectives, and the row of the reference particle."""
    row = choose_reference(table)
    return {"full": full_objective(table), "reference": reference_objective(table, row)}, row


def test_objectives_are_the_paper_s_integrals(table):
    a, found, (quadratics, row) = 0.7, {"full": 0.0, "reference": 0.0}, objectives(table)
    eta, reached = table.shape_factor(a), table.reached & table.enough
    scaled = eta[:, None] * table.strain
    mean = scaled.sum(axis=0, where=reached) / np.maximum(reached.sum(axis=0), 1)
    for i in range(20):
        for name, middle, r in (
            ("full", mean, reached[i]),
            ("reference", scaled[row], reached[i] & reached[row]),
        ):
            grid = table.stress_MPa[r]
            found[name] += trapezoid((middle[r] - scaled[i, r]) ** 2, grid) / trapezoid(middle[r] ** 2, grid)
    for name, total in found.items():
        assert objective_at(a, quadratics[name]) == pytest.approx(total, rel=1e-10)


@pytest.mark.extended
def test_the_minimum_is_one(table):
    for name, quadratics in objectives(table)[0].items():
        fit = fit_shape_parameter(table, name)
        scan = objective_at(np.append(np.linspace(-0.9, 6, 70), fit.a + np.array([-1e-4, 1e-4])), quadratics)
        assert np.all(fit.objective < scan)


def test_reference_follows_the_paper_s_rule(exact):
    table = strain_table(adjust(exact), exact.diameters_um)
    row = choose_reference(table)
    top = np.array([c.stress_max_MPa for c in adjust(exact).curves])
    assert top[row] >= np.median(top) - 0.1
    high = top >= np.median(top)
    assert abs(table.flatness[row]) <= np.abs(table.flatness[high]).min() + 1e-12


@pytest.mark.extended
@pytest.mark.parametrize("objective", ["full", "reference"])
def test_negative_shape_parameters_are_found_and_equal_particles_have_none(objective):
    grid, reached = np.linspace(0, 5, 200), np.ones((8, 200), bool)
    for flat in (np.linspace(0.0, 0.6, 8), np.full(8, 0.3)):
        strain = np.sqrt(grid) / (1 - 0.85 * flat)[:, None]
        fit = fit_shape_parameter(StrainTable(grid, strain, reached, flat, np.arange(8)), objective)
        if np.ptp(flat):
            assert fit.a == pytest.approx(-0.85, abs=1e-6)
        else:
            assert "same D3^2" in fit.reason


# ---- plastic coefficients ----


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.floats(1, 50), st.floats(0.1, 60), st.floats(20, 500), st.floats(0.3, 1.0))
def test_polynomial_of_exact_points_is_recovered(K1, K3, K5, reach):
    if 9 * K3**2 > 20 * K1 * K5:
        K3 = np.sqrt(20 * K1 * K5 / 9) * 0.99
    x = np.linspace(0.02, reach, 60)
    got, low = fit_polynomial(x, K1 * x - K3 * x**3 + K5 * x**5)
    np.testing.assert_allclose(got, [K1, K3, K5], rtol=1e-5)
    assert not low.any()


def test_moments_give_back_the_log_normal_distributions():
    truth = {"C1": (1.9027, 0.2985), "C3": (1.1015, 0.02), "C5": (0.9784, 0.0797)}
    laws = {name: LogNormal(*v) for name, v in truth.items()}
    x = np.linspace(0.03, 0.65, 300)
    K1, K3, K5 = (float(laws[n].moment(k)) for n, k in (("C1", 1), ("C3", 3), ("C5", 5)))
    stress = K1 * x - K3 * x**3 + K5 * x**5
    variance = sum(float(laws[n].variance_of_power(k)) * x ** (2 * k) for n, k in (("C1", 1), ("C3", 3), ("C5", 5)))
    slope = K1 - 3 * K3 * x**2 + 5 * K5 * x**4
    fit = fit_population(MasterCurve(stress, x, np.sqrt(variance) / slope, np.full(300, 20)))
    for name, (mean, sd) in truth.items():
        got = getattr(fit.population, name)
        assert float(got.mean) == pytest.approx(mean, rel=1e-6)
        assert float(got.sd) == pytest.approx(sd, rel=1e-4)
    assert fit.at_bound == ()


def test_a_spread_that_leaves_nothing_for_a_term_collapses_and_is_named():
    # Spread as of C1 alone, and less than that in the middle: what the paper's own table looks like.
    x = np.linspace(0.03, 0.65, 300)
    stress = 7.0 * x - 27.0 * x**3 + 144.0 * x**5
    slope = 7.0 - 81.0 * x**2 + 720.0 * x**4
    fit = fit_population(MasterCurve(stress, x, 2.0 * x / slope, np.full(300, 20)))
    assert "spread of C3" in fit.at_bound
    assert float(fit.population.C3.sd) == 0.0
    assert float(fit.population.C1.sd) == pytest.approx(np.sqrt(np.log1p((2 / 7) ** 2)), rel=1e-4)


# ---- effective modulus ----


def _eta(campaign):
    return 1 + A * flatness(campaign.diameters_um)


@ALL_FORMS
def test_modulus_of_exact_branches_is_recovered_in_every_form(unloading, scaling):
    campaign = paper_campaign(
        2, shared_material=True, instrument=Instrument(), unloading=unloading, strain_scaling=scaling
    )
    branches = campaign_branches(campaign, adjust(campaign, 0.0))
    fit = fit_effective_modulus(branches, _eta(campaign), unloading, scaling)
    assert not fit.reason
    assert fit.effective_modulus_MPa == pytest.approx(16e3, rel=2e-3)


def test_every_cycle_is_a_branch_and_reloading_belongs_to_it():
    programme = Programme.cycles(levels=(0.4, 0.7, 1.0), unload_to=0.3, points=900)
    campaign = paper_campaign(0, shared_material=True, programme=programme)
    branches = campaign_branches(campaign, adjust(campaign, 0.2))
    assert len(branches) == 60
    fit = fit_effective_modulus(branches, _eta(campaign))
    assert fit.effective_modulus_MPa == pytest.approx(16e3, rel=0.03)
