"""Particles integrated out of the population's likelihood, against quadrature, Monte Carlo and dense algebra."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import first_in_time
from joint_cases import random_population, random_summary
from scipy.special import roots_hermitenorm

from mcc_jax import JointModel, StrainScaling
from mcc_jax.calibrate.population import Summary, draw_latent, laplace, marginal_likelihood, moments

FLAT = np.array([0.15, 0.45, -0.1])
PLAIN = JointModel().scatter
SCATTERS = [
    PLAIN,
    JointModel(modulus_scatter=True, strain_scaling=StrainScaling.MASTER).scatter,
    JointModel(shape_scatter=True, strain_scaling=StrainScaling.CONTACT).scatter,
    JointModel(modulus_scatter=True, shape_scatter=True, strain_scaling=StrainScaling.MASTER).scatter,
]
NAMES = ["plain", "modulus-master", "shape-contact", "both-master"]
scatters = pytest.mark.parametrize("scatter", SCATTERS, ids=NAMES)
extremes = pytest.mark.parametrize("scatter", first_in_time(SCATTERS[::-3]), ids=NAMES[::-3])

likelihood = eqx.filter_jit(marginal_likelihood)
latent_moments = eqx.filter_jit(moments)
draw = eqx.filter_jit(draw_latent)
around_mode = eqx.filter_jit(laplace)


def case(scatter, seed=0, *, scale=0.05, **changes):
    """A population, and tests that know each coefficient to about `scale`, with best fits as far from each other."""
    rng = np.random.default_rng(seed)
    tau = scale * (0.5 + rng.random(3))
    spread = {"modulus_scatter": scale * scatter.modulus, "shape_scatter": scale * scatter.shape}
    population = random_population(rng, scatter, **{"tau": tau, **spread, **changes})
    summary = random_summary(rng, 3)
    mean = np.asarray(latent_moments(population, jnp.asarray(FLAT), scatter)[0])
    return population, eqx.tree_at(
        lambda s: (s.point, s.precision, s.score, s.zero_slope),
        summary,
        (
            jnp.asarray(mean + scale * rng.standard_normal((3, 4))),
            summary.precision / (8 * scale**2),
            summary.score / scale,
            summary.zero_slope / scale,
        ),
    )


def straightened(summary, i, w):
    """kappa of the docstring of `Summary`, at latent vectors of shape (..., 4)."""
    away = w - np.asarray(summary.point[i])
    powers = np.array([1.0, 3.0, 5.0])
    return np.concatenate([np.expm1(powers * away[..., :3]) / powers, away[..., 3:]], -1)


def log_test(summary: Summary, i, w, log_noise):
    """The log likelihood in the docstring of `Summary`."""
    kappa = straightened(summary, i, w)
    square = np.einsum("...p,pq,...q->...", kappa, np.asarray(summary.precision[i]), kappa)
    bracket = float(summary.squares[i]) + square - 2 * kappa @ np.asarray(summary.score[i])
    return -float(summary.count[i]) * log_noise - 0.5 * np.exp(-2 * log_noise) * bracket


@scatters
def test_moments_are_those_of_the_latent_vector_as_defined(scatter):
    population, _ = case(scatter)
    mean, factor = (np.asarray(v) for v in latent_moments(population, jnp.asarray(FLAT), scatter))
    a, mu, tau = float(population.a), np.asarray(population.mu), np.asarray(population.tau)

    def latent(deviation):
        """b and e of a particle whose log C, log modulus and a deviate by so many standard deviations."""
        C = mu + tau * deviation[:3]
        rest = list(deviation[3:])
        modulus = float(population.log_modulus) + (float(population.modulus_scatter) * rest.pop(0) if rest else 0.0)
        return C, modulus, a + (float(population.shape_scatter) * rest.pop(0) if rest else 0.0)

    def vector(deviation, flat):
        full = np.zeros(5)
        full[:3] = deviation[:3]
        left = list(deviation[3:])
        full[3] = left.pop(0) if scatter.modulus else 0.0
        full[4] = left.pop(0) if scatter.shape else 0.0
        C, modulus, shape = latent(full)
        log_eta = np.log(1 + shape * flat)
        return np.append(C + log_eta, modulus + scatter.power * log_eta)

    for i, flat in enumerate(FLAT):
        np.testing.assert_allclose(mean[i], vector(np.zeros(scatter.size), flat), rtol=1e-12)
        for k in range(scatter.size):
            step = 1e-5 * np.eye(scatter.size)[k]
            slope = (vector(step, flat) - vector(-step, flat)) / 2e-5
            np.testing.assert_allclose(factor[i, :, k], slope, rtol=1e-7, atol=1e-9)


def integral(population, summary, scatter, i):
    """Log of the likelihood integrated over a particle's deviations, by quadrature around the most probable ones."""
    at = around_mode(population, summary, jnp.asarray(FLAT), scatter)
    mean, factor = (np.asarray(v[i]) for v in (at.mean, at.factor))
    k = scatter.size
    node, weight = roots_hermitenorm({3: 32, 4: 18, 5: 12}[k])
    z = np.stack(np.meshgrid(*[node] * k, indexing="ij"), -1).reshape(-1, k)
    log_weight = sum(np.meshgrid(*[np.log(weight)] * k, indexing="ij")).ravel() + 0.5 * (z**2).sum(1)
    turn = np.linalg.inv(np.linalg.cholesky(np.asarray(at.hessian[i]))).T
    xi = np.asarray(at.deviations[i]) + z @ turn.T
    log_prior = -0.5 * (xi**2).sum(1) - 0.5 * k * np.log(2 * np.pi)
    inside = log_test(summary, i, mean + xi @ factor.T, float(population.log_noise)) + log_prior
    return np.logaddexp.reduce(log_weight + inside) + np.linalg.slogdet(turn)[1]


@extremes
@pytest.mark.parametrize(("scale", "tolerance"), [(1e-3, 2e-4), (0.01, 2e-3), (0.05, 0.05)])
def test_marginal_likelihood_is_the_integral_over_the_particle(scatter, scale, tolerance):
    """Laplace's method: the better, the sharper the tests; measured ones know a coefficient to 0.01 or less."""
    population, summary = case(scatter, 1, scale=scale)
    actual = np.asarray(likelihood(population, summary, jnp.asarray(FLAT), scatter))
    expected = [integral(population, summary, scatter, i) for i in range(3)]
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance)


@extremes
def test_the_integral_is_the_mean_weight_of_draws(scatter):
    """Draws and their volume are a proposal for the very integral: Monte Carlo instead of quadrature."""
    population, summary = case(scatter, 2)
    rng = np.random.default_rng(0)
    numbers = jnp.asarray(rng.standard_normal((4000, 3, scatter.size + 1)))

    @jax.jit
    def many(numbers):
        def one(n):
            drawn = draw_latent(population, summary, jnp.asarray(FLAT), scatter, n[:, :-1], n[:, -1])
            return drawn.latent, drawn.deviations, drawn.log_volume

        return jax.lax.map(one, numbers, batch_size=500)

    latent, deviations, volume = (np.asarray(v) for v in many(numbers))
    noise = float(population.log_noise)
    for i in range(3):
        sd = float(summary.zero_sd[i]) * np.exp(noise)
        prior = -0.5 * (deviations[:, i] ** 2).sum(1)
        proposal = -0.5 * (np.asarray(numbers[:, i, :-1]) ** 2).sum(1) - (volume[:, i] - np.log(sd))
        log_weight = log_test(summary, i, latent[:, i], noise) + prior - proposal
        found = np.logaddexp.reduce(log_weight) - np.log(4000)
        error = np.std(np.exp(log_weight - found)) / np.sqrt(4000)
        np.testing.assert_allclose(found, integral(population, summary, scatter, i), rtol=0, atol=5 * error + 1e-3)
        # A proposal that fits: the weights hardly scatter, and hardly a draw is out of range.
        possible = np.isfinite(log_weight)
        assert possible.mean() > 0.995
        assert np.std(log_weight[possible]) < 0.8


@scatters
def test_marginal_likelihood_of_sharp_tests_is_the_dense_gaussian(scatter):
    """Where kappa is as good as the latent vector itself, all is Gaussian."""
    population, summary = case(scatter, 2, scale=1e-6)
    mean, factor = (np.asarray(v) for v in latent_moments(population, jnp.asarray(FLAT), scatter))
    actual = np.asarray(likelihood(population, summary, jnp.asarray(FLAT), scatter))
    noise = float(population.log_noise)
    for i in range(3):
        L, g = np.asarray(summary.precision[i]), np.asarray(summary.score[i])
        spread = np.exp(2 * noise) * np.linalg.inv(L)
        best = np.asarray(summary.point[i]) + np.linalg.solve(L, g)
        away = best - mean[i]
        total = spread + factor[i] @ factor[i].T
        gaussian = -0.5 * (np.linalg.slogdet(total)[1] + away @ np.linalg.solve(total, away))
        at_best = log_test(summary, i, best, noise)
        expected = at_best + 0.5 * np.linalg.slogdet(spread)[1] + gaussian
        np.testing.assert_allclose(actual[i], expected, rtol=0, atol=1e-3)


def test_a_direction_without_data_is_no_trouble():
    population, summary = case(PLAIN)
    singular = summary.precision.at[:, 2, :].set(0.0).at[:, :, 2].set(0.0)
    blind = eqx.tree_at(lambda s: (s.precision, s.score), summary, (singular, summary.score.at[:, 2].set(0.0)))
    value = np.asarray(likelihood(population, blind, jnp.asarray(FLAT), PLAIN))
    assert np.all(np.isfinite(value))
    # What nothing is known about changes nothing, up to the square of how far the coefficient may scatter.
    still, wide = (eqx.tree_at(lambda p: p.tau, population, population.tau.at[2].set(t)) for t in (0.0, 0.03))
    one, two = (np.asarray(likelihood(p, blind, jnp.asarray(FLAT), PLAIN)) for p in (still, wide))
    np.testing.assert_allclose(two, one, rtol=0, atol=0.6 * (5 * 0.03) ** 2)


@extremes
def test_a_spread_of_zero_is_a_regular_point(scatter):
    population, summary = case(scatter, 3, tau=np.zeros(3))

    def total(tau):
        at = eqx.tree_at(lambda p: p.tau, population, tau)
        return jnp.sum(marginal_likelihood(at, summary, jnp.asarray(FLAT), scatter))

    expand = jax.jit(jax.value_and_grad(total))
    value, slope = expand(jnp.zeros(3))
    assert np.isfinite(float(value))
    np.testing.assert_array_equal(slope, 0.0)
    # Smooth there: the slope grows in proportion to the spread, to either side.
    beside, other = (np.asarray(expand(jnp.full(3, h))[1]) for h in (1e-5, -1e-5))
    np.testing.assert_allclose(beside, -other, rtol=1e-6)
    np.testing.assert_allclose(beside, 1e-1 * np.asarray(expand(jnp.full(3, 1e-4))[1]), rtol=1e-2)
    assert np.all(beside != 0)
    if scatter.size == 3:
        mean = np.asarray(latent_moments(population, jnp.asarray(FLAT), scatter)[0])
        expected = sum(log_test(summary, i, mean[i], float(population.log_noise)) for i in range(3))
        np.testing.assert_allclose(float(value), expected, rtol=1e-12)


@extremes
def test_the_sign_of_a_spread_does_not_matter(scatter):
    population, summary = case(scatter, 4)
    before = np.asarray(likelihood(population, summary, jnp.asarray(FLAT), scatter))
    for signs in itertools.product([1.0, -1.0], repeat=3):
        turned = eqx.tree_at(lambda p: p.tau, population, population.tau * jnp.asarray(signs))
        np.testing.assert_allclose(likelihood(turned, summary, jnp.asarray(FLAT), scatter), before, rtol=1e-12)


@extremes
def test_the_gradient_is_that_of_the_value(scatter):
    """The iteration towards the most probable deviations is not differentiated, yet the derivative is whole."""
    population, summary = case(scatter, 8, scale=0.01)
    leaves, rebuild = jax.tree.flatten(population)

    @jax.jit
    def total(vector):
        at = jax.tree.unflatten(rebuild, [vector[0], vector[1], vector[2:5], vector[5:8], *vector[8:]])
        return jnp.sum(marginal_likelihood(at, summary, jnp.asarray(FLAT), scatter))

    vector = jnp.concatenate([jnp.atleast_1d(leaf) for leaf in leaves])
    slope = np.asarray(jax.jit(jax.grad(total))(vector))
    for j, step in enumerate(1e-5 * np.eye(len(vector))):
        expected = (float(total(vector + step)) - float(total(vector - step))) / 2e-5
        np.testing.assert_allclose(slope[j], expected, rtol=1e-3, atol=1e-3 * np.abs(slope).max())


def affine(population, summary, scatter, step):
    """Offset and derivative at 0 of the map from standard normal numbers to (latent, zero), for each particle."""
    k = scatter.size
    flat = jnp.asarray(FLAT)

    def at(normal, zero):
        drawn = draw(population, summary, flat, scatter, normal, zero)
        return np.concatenate([np.asarray(drawn.latent), np.asarray(drawn.zero)[:, None]], 1)

    still = jnp.zeros((3, k))
    columns = [
        (at(still.at[:, j].set(step), jnp.zeros(3)) - at(still.at[:, j].set(-step), jnp.zeros(3))) for j in range(k)
    ]
    columns.append(at(still, jnp.full(3, step)) - at(still, jnp.full(3, -step)))
    return at(still, jnp.zeros(3)), np.stack(columns, -1) / (2 * step)


@pytest.mark.long
@extremes
def test_draws_have_the_mean_and_covariance_of_the_conditional_gaussian(scatter):
    """Where tests are sharp, see above."""
    scale = 1e-5
    population, summary = case(scatter, 5, scale=scale)
    mean, factor = (np.asarray(v) for v in latent_moments(population, jnp.asarray(FLAT), scatter))
    origin, matrix = affine(population, summary, scatter, 0.1)
    noise = np.exp(2 * float(population.log_noise))
    for i in range(3):
        prior = factor[i] @ factor[i].T
        L = np.asarray(summary.precision[i])
        best = np.asarray(summary.point[i]) + np.linalg.solve(L, np.asarray(summary.score[i]))
        gain = prior @ np.linalg.inv(prior + noise * np.linalg.inv(L))
        expected, covariance = mean[i] + gain @ (best - mean[i]), prior - gain @ prior
        slope = np.asarray(summary.zero_slope[i])
        zero = float(summary.zero[i]) + slope @ (expected - np.asarray(summary.point[i]))
        whole = np.zeros((5, 5))
        whole[:4, :4] = covariance
        whole[:4, 4] = whole[4, :4] = covariance @ slope
        whole[4, 4] = slope @ covariance @ slope + noise * float(summary.zero_sd[i]) ** 2
        unit = np.array([scale] * 4 + [1.0])
        np.testing.assert_allclose((origin[i] - np.append(expected, zero)) / unit, 0.0, atol=1e-3)
        actual = matrix[i] @ matrix[i].T
        np.testing.assert_allclose(actual / unit / unit[:, None], whole / unit / unit[:, None], rtol=0, atol=2e-3)


@extremes
def test_log_volume_is_that_of_the_map(scatter):
    population, summary = case(scatter, 6)
    k = scatter.size
    numbers = jnp.asarray(np.random.default_rng(0).standard_normal((3, k + 1)))

    def place(numbers):
        drawn = draw_latent(population, summary, jnp.asarray(FLAT), scatter, numbers[:, :k], numbers[:, k])
        return jnp.concatenate([drawn.deviations, drawn.zero[:, None]], 1)

    J = np.asarray(jax.jit(jax.jacfwd(place))(numbers))
    drawn = draw(population, summary, jnp.asarray(FLAT), scatter, numbers[:, :k], numbers[:, k])
    for i in range(3):
        sign, expected = np.linalg.slogdet(J[i, :, i])
        assert sign == 1.0
        np.testing.assert_allclose(float(drawn.log_volume[i]), expected, rtol=1e-9, atol=1e-9)
        others = np.delete(J[i], i, axis=1)
        assert np.all(others == 0)


@extremes
def test_the_deviations_are_what_makes_the_latent_vector_and_the_zero(scatter):
    population, summary = case(scatter, 7)
    rng = np.random.default_rng(1)
    normal, hum = rng.standard_normal((3, scatter.size)), rng.standard_normal(3)
    drawn = draw(population, summary, jnp.asarray(FLAT), scatter, jnp.asarray(normal), jnp.asarray(hum))
    mean, factor = latent_moments(population, jnp.asarray(FLAT), scatter)
    latent = np.asarray(drawn.latent)
    np.testing.assert_allclose(latent, mean + jnp.einsum("npk,nk->np", factor, drawn.deviations), rtol=1e-12)
    sd = np.asarray(summary.zero_sd) * np.exp(float(population.log_noise))
    for i in range(3):
        kappa = straightened(summary, i, latent[i])
        expected = float(summary.zero[i]) + np.asarray(summary.zero_slope[i]) @ kappa + sd[i] * hum[i]
        np.testing.assert_allclose(float(drawn.zero[i]), expected, rtol=1e-9)
    np.testing.assert_allclose(
        drawn.log_likelihood, likelihood(population, summary, jnp.asarray(FLAT), scatter), rtol=1e-12
    )


def test_a_draw_beyond_the_range_of_the_map_is_finite_and_counts_for_nothing():
    population, summary = case(PLAIN, 3, scale=0.5)
    drawn = draw(population, summary, jnp.asarray(FLAT), PLAIN, jnp.full((3, 3), -9.0), jnp.zeros(3))
    assert np.all(np.isneginf(np.asarray(drawn.log_volume)))
    assert np.all(np.isfinite(np.asarray(drawn.latent)))
    assert np.all(np.isfinite(np.asarray(drawn.zero)))


def test_a_shape_factor_that_vanishes_gives_no_nan():
    population, summary = case(PLAIN)
    gone = eqx.tree_at(lambda p: p.a, population, jnp.asarray(-1 / 0.45))
    value = np.asarray(likelihood(gone, summary, jnp.asarray(FLAT), PLAIN))
    assert not np.any(np.isnan(value))
    assert value[1] < value[0] - 100
