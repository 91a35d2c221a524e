"""The log-normal population of plastic coefficients: Table 2 of the paper and what follows from it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import K1, check, close, paper_population

from mcc_jax.law import LogNormal, PlasticPopulation

POPULATION = paper_population()
DRAWS = 200_000


@pytest.fixture(scope="module")
def draws():
    return POPULATION.sample(jax.random.key(20181206), DRAWS)


@pytest.fixture(scope="module")
def kept(draws):
    return np.asarray(jax.vmap(lambda p: p.is_monotone)(draws))


@pytest.mark.parametrize(
    ("index", "exact", "printed"),
    [(0, "7.0093931281847", "7.0094"), (1, "27.234920723507", "27.235"), (2, "144.22882848282", "144.23")],
)
def test_mean_law(index, exact, printed):
    value = POPULATION.mean_law.polynomial[index]
    check(value, exact)
    close(value, float(printed), rel=2e-5)


def test_medians():
    median = POPULATION.median_law
    check(median.C1, "6.7039707493066")
    check(median.C3, "3.0086756543596")
    check(median.C5, "2.6601965206281")
    check(median.polynomial[2], "133.21974728389", rel=1e-14)


def test_yield_stress():
    """C1 / (12 c^2), stress over yield stress and strain of an ideally plastic sphere (eq. 22)."""
    check(POPULATION.yield_stress, "0.4085")
    close(POPULATION.yield_stress, K1 / (12 * 1.43), rel=2e-6)


def test_moments():
    check(jnp.sqrt(POPULATION.C1.variance_of_power(1)) / POPULATION.C1.moment(1), "0.3052743513")
    check(jnp.sqrt(POPULATION.C5.variance_of_power(5)) / POPULATION.C5.moment(5), "0.4148567702")
    check(jnp.sqrt(POPULATION.C1.variance_of_power(1)), "2.13978793994")
    check(jnp.sqrt(POPULATION.C5.variance_of_power(5)), "59.8343059527")
    check(jnp.sqrt(POPULATION.C3.variance_of_power(3)), "4e-7")


@pytest.mark.parametrize(
    ("x", "mean", "sd", "median"),
    [
        (0.1, "0.67514668", "0.21397963", "0.64449435"),
        (0.3, "1.71795113", "0.65819656", "1.59957235"),
        (0.5, "4.60748236", "2.15427659", "4.11073739"),
        (0.6, "9.53812670", "4.82660253", "8.49880712"),
    ],
)
def test_mean_spread_and_median_curve(x, mean, sd, median):
    x = jnp.array(x)
    check(POPULATION.mean_law.stress(x), mean)
    check(POPULATION.stress_sd(x), sd)
    check(POPULATION.median_law.stress(x), median)
    close(POPULATION.stress_sd(jnp.stack([x, x])), np.full(2, float(sd)), scale=1e-8)


def test_probability_of_a_curve_that_falls():
    check(POPULATION.probability_not_monotone, "0.0240368000563", rel=1e-10)


def test_probability_against_draws(draws, kept):
    """Monte Carlo with a fixed seed, within four standard errors."""
    p = float(POPULATION.probability_not_monotone)
    close(np.mean(~kept), p, scale=4 * np.sqrt(p * (1 - p) / DRAWS))


def test_sample_moments(draws):
    for C, order, field in (
        (draws.C1, 1, POPULATION.C1),
        (draws.C3, 3, POPULATION.C3),
        (draws.C5, 5, POPULATION.C5),
    ):
        power = np.asarray(C) ** order
        sd = float(jnp.sqrt(field.variance_of_power(order)))
        close(power.mean(), field.moment(order), scale=5 * sd / np.sqrt(DRAWS) + 1e-9)
        close(power.std(), sd, rel=0.02, scale=1e-7)
        close(np.std(np.log(C)), field.sd, rel=0.01)
    assert abs(np.corrcoef(np.log(draws.C1), np.log(draws.C5))[0, 1]) < 5 / np.sqrt(DRAWS)


def test_samples_are_reproducible_and_differ():
    one, again = (POPULATION.sample(jax.random.key(1), 4) for _ in range(2))
    other = POPULATION.sample(jax.random.key(2), 4)
    np.testing.assert_array_equal(one.C1, again.C1)
    assert not np.any(one.C1 == other.C1)
    assert one.C1.shape == (4,)
    # The three coefficients must not share their random numbers.
    z1, z5 = (jnp.log(one.C1) - 1.9027) / 0.2985, (jnp.log(one.C5) - 0.9784) / 0.0797
    assert not np.any(np.isclose(z1, z5))


@pytest.mark.parametrize("order", [1, 3, 5])
def test_lognormal_from_the_moments_of_a_power(order):
    true = LogNormal(0.9, 0.12)
    again = LogNormal.from_power_moments(order, true.moment(order), true.variance_of_power(order))
    close(np.array([again.mean, again.sd]), np.array([0.9, 0.12]), rel=1e-13)


def test_population_without_spread_is_its_median():
    sure = PlasticPopulation(*(LogNormal(jnp.log(c), 0.0) for c in (7.0, 3.0, 2.7)))
    close(np.array(sure.mean_law.polynomial), np.array(sure.median_law.polynomial), rel=1e-14)
    assert sure.stress_sd(jnp.array(0.5)) == 0
    close(np.asarray(sure.sample(jax.random.key(0), 3).C5), np.full(3, 2.7), rel=1e-14)
