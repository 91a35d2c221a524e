"""The population's prior against NumPyro's distributions, and its most probable value."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_cases import random_summary
from mcc_jax.calibrate.fit import population_at
from mcc_jax.calibrate.transforms import (
    LogPosterior,
    PriorNumbers,
    constrain,
    most_probable,
    recentred,
    spread_of,
    spread_slope,
    unconstrain,
)

from mcc_jax import InputError, JointModel
from mcc_jax.calibrate import NormalPrior, Priors
from mcc_jax.calibrate.model import prior_numbers
from mcc_jax.calibrate.population import Population

PLAIN = JointModel().scatter
MODULUS, BOTH = JointModel(modulus_scatter=True).scatter, JointModel(modulus_scatter=True, shape_scatter=True).scatter
SCATTERS = [PLAIN, MODULUS, JointModel(shape_scatter=True).scatter, BOTH]
FLAT = jnp.asarray(np.random.default_rng(0).uniform(0.0, 0.6, 12))
NUMBERS = PriorNumbers(
    a=jnp.asarray([1.0, 1.2, -1.5, 4.0]),
    log_modulus=jnp.asarray([9.2, 1.0]),
    mu_1=jnp.asarray([1.8, 0.7]),
    mu_5=jnp.asarray([1.0, 0.3]),
    softening=jnp.asarray([-1.1, 0.6]),
    spread=jnp.asarray([[0.5, 1.0], [0.1, 4.0], [0.2, 1.0], [0.3, 1.0], [0.25, 2.0]]),
    log_noise=jnp.asarray([0.1, 0.5]),
    centre=jnp.asarray([2.1, 1.3, 1.2]),
    blur=jnp.asarray([0.02, 0.01, 0.03]),
    flatness=FLAT,
)


def as_vector(population, scatter):
    """a, log modulus, means, log noise and spreads in a row."""
    p = population
    further = [p.modulus_scatter] * scatter.modulus + [p.shape_scatter] * scatter.shape
    return jnp.stack([p.a, p.log_modulus, *p.mu, p.log_noise, *p.tau, *further])


def model_log_density(population):
    """The same prior in NumPyro's words, of the population as `as_vector` gives it."""
    n = NUMBERS
    mean, sd, low, high = n.a
    a, log_modulus, mu_1, mu_3, mu_5, log_noise = population[:6]
    total = dist.TruncatedNormal(mean, sd, low=low, high=high).log_prob(a)
    total += dist.Normal(*n.log_modulus).log_prob(log_modulus)
    total += dist.Normal(*n.mu_1).log_prob(mu_1) + dist.Normal(*n.mu_5).log_prob(mu_5)
    # 6 mu_3 = log(20/9) + mu_1 + 5 mu_5 + log(softening): a change of variables from the softening to mu_3
    softening = 6 * mu_3 - jnp.log(20 / 9) - mu_1 - 5 * mu_5
    total += dist.Normal(*n.softening).log_prob(softening) + jnp.log(6.0)
    return total + dist.Normal(*n.log_noise).log_prob(log_noise)


@pytest.mark.parametrize("scatter", SCATTERS, ids=["plain", "modulus", "shape", "both"])
def test_the_prior_is_numpyro_s_up_to_a_constant(scatter):
    scale, power = np.asarray(NUMBERS.spread)[[0, 1, 2] + [3] * scatter.modulus + [4] * scatter.shape].T
    rng = np.random.default_rng(1)

    @jax.jit
    def both(free):
        def place(f):
            return as_vector(constrain(f, NUMBERS, scatter)[0], scatter)

        population, volume = place(free), jnp.linalg.slogdet(jax.jacfwd(place)(free))[1]
        # tau^2 is a Gamma variable, of which d(tau^2)/d(tau) = 2 tau
        tau = population[6:]
        spreads = jnp.sum(dist.Gamma(1 / (2 * power), 1 / (2 * scale**2)).log_prob(tau**2) + jnp.log(2 * tau))
        return constrain(free, NUMBERS, scatter)[1], model_log_density(population) + spreads + volume

    centre = np.array([0.0, 9.0, 0.0, 0.0, 0.0, 0.0, *[0.0] * scatter.size])
    draws = centre + rng.standard_normal((20, 6 + scatter.size)) * np.array([3, 1, 2, 2, 2, 1, *[1.0] * scatter.size])
    with jax.numpy_dtype_promotion("standard"):
        gap = np.array([float(theirs - ours) for ours, theirs in (both(jnp.asarray(f)) for f in draws)])
    np.testing.assert_allclose(gap, gap[0], rtol=0, atol=1e-9)


def test_the_population_at_unbounded_coordinates():
    scatter = BOTH
    free = jnp.asarray([0.3, 9.0, 2.0, -1.0, 0.5, -0.2, -0.4, 0.1, -0.2, -0.3, 0.2])
    population: Population = population_at(free, NUMBERS, scatter)
    a = -1.5 + 5.5 / (1 + np.exp(-0.3))
    tau = 0.1 * np.array([0.5, 0.1, 0.2]) * np.sinh([0.4, 0.1, 0.2]) ** np.array([1, 4, 1])
    width = np.sqrt(tau**2 / 12 + np.array([0.02, 0.01, 0.03]) ** 2)
    mu = np.array([2.1, 1.3, 1.2]) + width * np.array([2.0, -1.0, 0.5]) - np.log(1 + a * np.asarray(FLAT)).mean()
    np.testing.assert_allclose(float(population.a), a, rtol=1e-12)
    np.testing.assert_allclose(population.mu, mu, rtol=1e-12)
    np.testing.assert_allclose(population.tau, tau, rtol=1e-12)
    np.testing.assert_allclose(float(population.modulus_scatter), 0.03 * np.sinh(0.3), rtol=1e-12)
    np.testing.assert_allclose(float(population.shape_scatter), 0.025 * np.sinh(0.2) ** 2, rtol=1e-12)
    assert float(population.log_noise) == -0.2
    plain = population_at(free[:9], NUMBERS, PLAIN)
    assert float(plain.modulus_scatter) == float(plain.shape_scatter) == 0.0


def test_the_slope_of_a_spread_is_its_derivative():
    x = jnp.asarray([0.4, -0.1, 2.0, 1e-3, -3.0])
    slope = jax.jacfwd(lambda x: spread_of(x, NUMBERS.spread))(x)
    found = spread_slope(np.asarray(x), np.asarray(NUMBERS.spread))
    np.testing.assert_allclose(found, np.abs(np.diagonal(slope)), rtol=1e-12)


def test_recentred_coordinates_describe_the_same_population():
    free = jnp.asarray([0.3, 9.0, 2.0, -1.0, 0.5, -0.2, -0.4, 0.1, -0.2])
    numbers, moved = recentred(NUMBERS, free)
    np.testing.assert_array_equal(moved[2:5], 0.0)
    before, after = (as_vector(constrain(f, n, PLAIN)[0], PLAIN) for f, n in ((free, NUMBERS), (moved, numbers)))
    np.testing.assert_allclose(after, before, rtol=1e-13)


@pytest.mark.parametrize("a", [-1.4, 0.0, 1.43, 3.9])
def test_to_free_and_back(a):
    mu, tau = np.array([1.8, 1.1, 1.0]), np.array([0.3, 0.05, 0.1])
    free = unconstrain(a, 9.5, mu, tau, NUMBERS, MODULUS)
    population = population_at(free, NUMBERS, MODULUS)
    np.testing.assert_allclose(float(population.a), a, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(float(population.log_modulus), 9.5)
    np.testing.assert_allclose(population.mu, mu)
    np.testing.assert_allclose(population.tau, tau)


@pytest.fixture(scope="module")
def summary():
    """Tests of twelve particles of a population, each coefficient known to about a percent."""
    rng = np.random.default_rng(5)
    log_eta = np.log(1 + 1.4 * np.asarray(FLAT))
    point = np.array([1.9, 1.1, 1.0, 9.6]) + rng.standard_normal((12, 4)) * np.array([0.3, 0.03, 0.08, 0.01])
    point[:, :3] += log_eta[:, None]
    random = random_summary(rng, 12, precision=1e4)
    return eqx.tree_at(
        lambda s: (s.point, s.score), random, (jnp.asarray(point), jnp.asarray(30 * rng.standard_normal((12, 4))))
    )


@pytest.fixture(scope="module")
def posterior(summary):
    return jax.jit(jax.value_and_grad(LogPosterior(NUMBERS, summary, PLAIN).log_density))


@settings(max_examples=60)
@given(
    st.floats(-800, 800), st.sampled_from([0.0, 1e-300, 1e-8, 0.3]), st.floats(-3, 3), st.sampled_from([-1.0, 0.0, 1.0])
)
def test_at_the_bounds_of_a_nothing_is_nan(posterior, unit, tau, mu, log_noise):
    free = jnp.asarray([unit, 9.0, 1.8 + mu, 1.1, 1.0, log_noise, tau, -tau, tau])
    value, slope = posterior(free)
    assert np.isfinite(float(value))
    assert np.all(np.isfinite(np.asarray(slope)))


@pytest.mark.parametrize("flat", [[0.0, 0.0], [0.6, 0.2], [-0.3, -0.1], [-0.4, 0.7], [-3.0, 0.99]])
def test_within_the_bounds_of_a_every_shape_factor_is_positive(flat):
    numbers = prior_numbers(Priors(), jnp.asarray(flat))
    _, _, low, high = np.asarray(numbers.a)
    assert low < high
    for a in (low, high):
        assert np.all(1 + a * np.asarray(flat) > 0.01)


@pytest.mark.parametrize(("mean", "flat"), [(2.0, [-0.8, 0.3]), (-4.0, [0.3, 0.6])])
def test_a_prior_of_a_that_contradicts_the_shapes_is_told_or_survived(mean, flat):
    """Particles for which every believable `a` would give a shape factor below zero."""
    prior = Priors(a=NormalPrior(mean, 0.05))
    try:
        numbers = prior_numbers(prior, jnp.asarray(flat))
    except InputError:
        return  # to refuse it is as good
    _, _, low, high = np.asarray(numbers.a)
    assert low < high
    assert np.isfinite(float(constrain(jnp.zeros(9), numbers, PLAIN)[1]))


@pytest.fixture(scope="module")
def mode(summary):
    numbers = NUMBERS
    start = unconstrain(1.0, 9.2, np.array([1.8, 1.1, 1.0]), np.array([0.3, 0.1, 0.2]), numbers, PLAIN)
    return start, most_probable(start, LogPosterior(numbers, summary, PLAIN))


def test_the_mode_is_one(posterior, mode):
    start, (free, covariance, converged) = mode
    assert converged
    value, slope = posterior(free)
    width = np.sqrt(np.diag(np.asarray(covariance)))
    assert np.all(np.abs(np.asarray(slope)) * width < 1e-3)
    assert float(value) > float(posterior(start)[0])
    for direction in np.eye(9):
        for sign in (-1, 1):
            assert float(posterior(free + 0.3 * sign * width * direction)[0]) < float(value)


def test_the_covariance_is_the_inverse_curvature(posterior, mode):
    _, (free, covariance, _) = mode
    assert np.all(np.linalg.eigvalsh(np.asarray(covariance)) > 0)
    steps = 1e-4 * np.eye(9)
    rows = [np.asarray(posterior(free - s)[1]) - np.asarray(posterior(free + s)[1]) for s in steps]
    curvature = np.array(rows) / 2e-4
    scale = np.sqrt(np.diag(curvature))
    product = np.asarray(covariance) * scale * scale[:, None] @ (curvature / scale / scale[:, None])
    np.testing.assert_allclose(product, np.eye(9), atol=1e-2)


@pytest.mark.parametrize("seed", range(6))
def test_the_start_does_not_matter(summary, mode, seed):
    _, (free, covariance, _) = mode
    width = np.sqrt(np.diag(np.asarray(covariance)))
    rng = np.random.default_rng(seed)
    mu = np.array([1.8, 1.1, 1.0]) + rng.uniform(-0.5, 0.5, 3)
    tau = np.exp(rng.uniform(np.log(0.03), np.log(0.6), 3))
    elsewhere = unconstrain(rng.uniform(-1.0, 3.5), rng.uniform(8.5, 10.5), mu, tau, NUMBERS, PLAIN)
    again, _, converged = most_probable(elsewhere, LogPosterior(NUMBERS, summary, PLAIN))
    assert converged
    expected, found = np.asarray(free).copy(), np.asarray(again).copy()
    expected[6:], found[6:] = np.abs(expected[6:]), np.abs(found[6:])
    assert np.all(np.abs(found - expected) < 1e-2 * width)
