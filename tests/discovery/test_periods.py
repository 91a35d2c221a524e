"""What repeats with time, with travel or with force is found by its period."""

import numpy as np
import pytest
from campaigns import QUICK, base_of, cached, with_curves
from scipy.integrate import dblquad

from mcc_jax.discovery import discover
from mcc_jax.discovery.periods import Periodogram, periodograms
from mcc_jax.discovery.search import Search
from mcc_jax.discovery.verify import p_anything
from mcc_jax.effects import LIBRARY

FEW = {name: LIBRARY[name] for name in ("frame_compliance", "damage")}


def disturbed(size_um, period_s):
    """A campaign whose displacements swing with the temperature of the room."""
    return with_curves(
        cached(),
        lambda c: (c.time_s, c.force_mN, c.displacement_um + size_um * np.sin(2 * np.pi * c.time_s / period_s)),
    )


def search_of(whole):
    return Search(base_of(whole), FEW, FEW, lambda _: None)


def test_the_period_of_a_disturbance_is_found():
    search = search_of(disturbed(0.1, 53.0))
    drive, clock, *others = periodograms(search.natural, search.null)
    assert [one.coordinate for one in (drive, clock, *others)] == ["drive", "clock", "force", "travel", "strain"]
    assert 1 / clock.best == pytest.approx(53.0, rel=0.003)
    assert clock.power.max() > drive.power.max() + 20
    assert p_anything(search, 0) < 0.01


def test_the_period_of_an_error_of_the_load_cell_is_found():
    """Force reads too much by 1 % of itself times a sine with a period of a tenth of the largest force."""
    top = max(float(curve.force_mN.max()) for curve in cached().curves)
    period = 0.1 * top

    def read(c):
        return c.time_s, c.force_mN * (1 + 0.01 * np.sin(2 * np.pi * c.force_mN / period)), c.displacement_um

    search = search_of(with_curves(cached(), read))
    drive, clock, force, *_ = periodograms(search.natural, search.null)
    assert 1 / force.best == pytest.approx(period, rel=0.02)
    assert force.power.max() > max(drive.power.max(), clock.power.max()) + 20
    assert p_anything(search, 0) < 0.01


@pytest.mark.extended
def test_powers_of_noise_are_exponential():
    """Their mean is 1, and none of some hundred exceeds ten: no frequency is seen where there is none."""
    search = search_of(cached())
    for one in periodograms(search.natural, search.null):
        assert np.mean(one.power) == pytest.approx(1.0, abs=0.35)
        assert one.power.max() < 10
    assert p_anything(search, 0) > 0.05


@pytest.mark.parametrize("power", [0.0, 3.0, 40.0])
def test_log_evidence_of_a_sinusoid_is_the_integral_over_its_amplitudes(power):
    information, size = 7.0, 0.9
    score = np.sqrt(2 * power * information)  # of the cosine; the sine's is zero

    def density(b, a):
        return np.exp(score * a - information * (a**2 + b**2) / 2 - (a**2 + b**2) / (2 * size**2)) / (
            2 * np.pi * size**2
        )

    exact = np.log(dblquad(density, -12, 12, -6, 6)[0])
    one = Periodogram("clock", np.ones(1), np.array([power]), np.array([information]), 1.0)
    assert one.log_ratio(np.array([size]), one.power[None])[0] == pytest.approx(exact, rel=1e-6)


def test_an_unknown_frequency_costs_the_number_of_those_tried():
    powers = np.zeros(100)
    powers[30] = 200.0
    one = Periodogram("clock", np.arange(1.0, 101), powers, np.ones(100), 31.0)
    assert one.of_choice(np.array([1.0, 3.0])) == pytest.approx(-np.log(100))


def test_sinusoids_of_a_period_repeat_with_it_and_have_a_variance_of_one():
    one = Periodogram("clock", np.ones(1), np.ones(1), np.ones(1), 1 / 7.0)
    x = np.linspace(0, 70, 1001)
    np.testing.assert_allclose(one.columns([(x, 1.0)]), one.columns([(x + 7.0, 1.0)]), atol=1e-9)
    np.testing.assert_allclose(np.sum(one.columns([(x, 1.0)]) ** 2, -1), 1.0, rtol=1e-9)


@pytest.mark.extended
def test_a_disturbance_with_time_is_described_by_its_period():
    found = discover(disturbed(0.15, 53.0), library=FEW, **QUICK)
    assert found.verdict == "UNLISTED"
    assert "sin(2 pi t/5" in found.closure.formula
    assert found.closure.coordinate == "clock"
