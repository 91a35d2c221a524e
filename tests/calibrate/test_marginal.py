"""Particles integrated out of the population's likelihood, against quadrature, Monte Carlo and dense algebra."""

import itertools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from joint_cases import (
    COEFFICIENTS,
    DIAMETERS,
    KINDS,
    POINTS,
    dense,
    random_marginal,
    random_population,
    random_precision,
    random_tests,
    true_latent,
)
from scipy.special import roots_hermitenorm
from scipy.stats import multivariate_normal

from mcc_jax import Model
from mcc_jax.calibrate.forward import Point, Straight
from mcc_jax.calibrate.marginal import Marginal, summarise
from mcc_jax.calibrate.noise import Noise
from mcc_jax.calibrate.population import Scatter, moments
from mcc_jax.calibrate.small_matrices import Cholesky
from mcc_jax.campaign import particle_batch
from mcc_jax.law import StrainScaling

FLAT = np.array([0.15, 0.45, -0.1])
PLAIN = Model().scatter
EFFECTS = Scatter(varying=((1, False), (0, True)))
"""Two amplitudes that vary, of either sign and of one, and a further number."""
SCATTERS = {
    "plain": PLAIN,
    "modulus-master": Model(modulus_scatter=True, strain_scaling=StrainScaling.MASTER).scatter,
    "shape-contact": Model(shape_scatter=True, strain_scaling=StrainScaling.CONTACT).scatter,
    "both-master": Model(modulus_scatter=True, shape_scatter=True, strain_scaling=StrainScaling.MASTER).scatter,
    "effects": EFFECTS,
}
scatters = pytest.mark.parametrize("scatter", list(SCATTERS.values())[:4], ids=list(SCATTERS)[:4])
SOME = ["effects", "both-master"]
extremes = pytest.mark.parametrize("scatter", [SCATTERS[n] for n in SOME], ids=SOME)

latent_moments = eqx.filter_jit(moments)
likelihood = eqx.filter_jit(lambda population, marginal: marginal.log_likelihood(population))
draw = eqx.filter_jit(lambda population, marginal, *numbers: marginal.draw(population, *numbers))
around_mode = eqx.filter_jit(lambda population, marginal: marginal.laplace(population))


def case(scatter, seed=0, *, scale=0.05, **changes):
    """A population, and tests that know each number to about `scale`, with best fits as far from each other."""
    rng = np.random.default_rng(seed)
    varying, numbers = len(scatter.varying), 3 if scatter.varying else 0
    spread = {"modulus_scatter": scale * scatter.modulus, "shape_scatter": scale * scatter.shape}
    effects = {"theta": 1 + rng.random(numbers), "theta_scatter": scale * (0.5 + rng.random(varying))}
    tau = scale * (0.5 + rng.random(3))
    population = random_population(rng, scatter, **{"tau": tau, **spread, **effects, **changes})
    mean = np.asarray(latent_moments(population, jnp.asarray(FLAT), scatter)[0])
    theta = np.asarray(population.theta) + scale * rng.standard_normal((3, numbers))
    point = Point(jnp.asarray(mean + scale * rng.standard_normal((3, 4))), jnp.zeros(3), jnp.asarray(theta))
    return population, random_marginal(rng, scatter, point, FLAT, scale=scale)


def numbers_at(population, marginal: Marginal, xi):
    """u of the docstring of `Marginal`, of every particle at deviations of shape (N, many, k), written out."""
    scatter, own = marginal.scatter, marginal.scatter.of_latent
    mean, factor = (np.asarray(v) for v in latent_moments(population, marginal.flatness, scatter))
    away = mean[:, None] + np.einsum("npk,nmk->nmp", factor, xi[..., :own]) - np.asarray(marginal.point.latent)[:, None]
    powers = np.array([1.0, 3.0, 5.0])
    theta = np.broadcast_to(np.asarray(population.theta), (*xi.shape[:2], len(population.theta))).copy()
    for j, (k, signed) in enumerate(scatter.varying):
        moved = float(population.theta_scatter[j]) * xi[..., own + j]
        theta[..., k] = theta[..., k] + moved if signed else theta[..., k] * np.exp(moved)
    kappa = np.concatenate([np.expm1(powers * away[..., :3]) / powers, away[..., 3:]], -1)
    return np.concatenate([kappa, theta - np.asarray(marginal.point.theta)[:, None]], -1)


def log_tests(population, marginal: Marginal, xi):
    """The log likelihood in the docstring of `Marginal`, shape (N, many)."""
    u = numbers_at(population, marginal, xi)
    border = np.concatenate([u, -np.ones((*u.shape[:2], 1))], -1)
    noise = float(population.log_noise)
    square = np.einsum("nmp,npq,nmq->nm", border, np.asarray(marginal.gram), border)
    return np.asarray(marginal.log_scale - marginal.count * noise)[:, None] - 0.5 * np.exp(-2 * noise) * square


@scatters
def test_moments_are_those_of_the_latent_vector_as_defined(scatter):
    population, _ = case(scatter)
    mean, factor = (np.asarray(v) for v in latent_moments(population, jnp.asarray(FLAT), scatter))

    def vector(deviation, flat):
        """b and e of a particle whose log C, log modulus and a deviate by so many standard deviations."""
        rest = list(deviation[3:])
        modulus = float(population.modulus_scatter) * rest.pop(0) if scatter.modulus else 0.0
        shape = float(population.shape_scatter) * rest.pop(0) if scatter.shape else 0.0
        log_eta = np.log(1 + (float(population.a) + shape) * flat)
        b = np.asarray(population.mu) + np.asarray(population.tau) * deviation[:3] + log_eta
        return np.append(b, float(population.log_modulus) + modulus + scatter.power * log_eta)

    for i, flat in enumerate(FLAT):
        np.testing.assert_allclose(mean[i], vector(np.zeros(scatter.size), flat), rtol=1e-12)
        for k, step in enumerate(1e-5 * np.eye(scatter.size)):
            slope = (vector(step, flat) - vector(-step, flat)) / 2e-5
            np.testing.assert_allclose(factor[i, :, k], slope, rtol=1e-7, atol=1e-9)


def integrals(population, marginal):
    """Log of the likelihoods integrated over the deviations, by quadrature around the most probable ones."""
    at, k = around_mode(population, marginal), marginal.scatter.size
    node, weight = roots_hermitenorm(12)
    z = np.stack(np.meshgrid(*[node] * k, indexing="ij"), -1).reshape(-1, k)
    log_weight = sum(np.meshgrid(*[np.log(weight)] * k, indexing="ij")).ravel() + 0.5 * (z**2).sum(1)
    turn = np.swapaxes(np.linalg.inv(np.linalg.cholesky(np.asarray(at.hessian))), 1, 2)
    xi = np.asarray(at.deviations)[:, None] + np.einsum("njk,mk->nmj", turn, z)
    log_prior = -0.5 * (xi**2).sum(-1) - 0.5 * k * np.log(2 * np.pi)
    inside = log_weight + log_tests(population, marginal, xi) + log_prior
    return np.logaddexp.reduce(inside, axis=1) + np.linalg.slogdet(turn)[1]


@pytest.mark.extended
@extremes
@pytest.mark.parametrize(("scale", "tolerance"), [(1e-3, 2e-4), (0.01, 2e-3), (0.05, 0.05)])
def test_the_likelihood_is_the_integral_over_the_particle(scatter, scale, tolerance):
    """Laplace's method: the better, the sharper the tests; measured ones know a coefficient to 0.01 or less."""
    one = case(scatter, 1, scale=scale)
    np.testing.assert_allclose(likelihood(*one), integrals(*one), rtol=0, atol=tolerance)


@pytest.mark.extended
@pytest.mark.parametrize("scatter", SCATTERS.values(), ids=SCATTERS)
def test_the_likelihood_of_sharp_tests_is_the_dense_normal_one(scatter):
    """Where kappa is as good as the latent vector itself, all is normal; and draws are those of the conditional."""
    scale = 1e-6
    population, marginal = case(scatter, 2, scale=scale)
    still = np.zeros((3, 1, scatter.size))
    u = numbers_at(population, marginal, still)[:, 0]
    steps = 1e-3 * np.eye(scatter.size)[None] * np.ones((3, 1, 1))
    J = np.swapaxes((numbers_at(population, marginal, steps) - numbers_at(population, marginal, -steps)) / 2e-3, 1, 2)
    noise = np.exp(2 * float(population.log_noise))
    actual, drawn = np.asarray(likelihood(population, marginal)), around_mode(population, marginal)
    for i in range(3):
        L, g = np.asarray(marginal.gram[i, :-1, :-1]), np.asarray(marginal.gram[i, :-1, -1])
        spread, best = noise * np.linalg.inv(L), np.linalg.solve(L, g)
        gaussian = multivariate_normal(best, spread + J[i] @ J[i].T, allow_singular=True).logpdf(u[i])
        at_best = -0.5 * (float(marginal.gram[i, -1, -1]) - g @ best) / noise
        at_best += float(marginal.log_scale[i] - marginal.count[i] * population.log_noise)
        expected = at_best + gaussian + 0.5 * np.linalg.slogdet(2 * np.pi * spread)[1]
        np.testing.assert_allclose(actual[i], expected, rtol=0, atol=2e-3)
        hessian = np.eye(scatter.size) + J[i].T @ L @ J[i] / noise
        mean = np.linalg.solve(hessian, J[i].T @ (g - L @ u[i])) / noise
        np.testing.assert_allclose(drawn.deviations[i], mean, atol=2e-3)
        np.testing.assert_allclose(drawn.hessian[i], hessian, rtol=0, atol=1e-3 * np.abs(hessian).max())


@pytest.mark.extended
def test_a_direction_without_data_is_no_trouble():
    population, marginal = case(PLAIN)
    blind = replace(marginal, gram=marginal.gram.at[:, 2].set(0.0).at[:, :, 2].set(0.0))
    assert np.all(np.isfinite(likelihood(population, blind)))
    # What nothing is known about changes nothing, up to the square of how far the coefficient may scatter.
    one, two = (
        np.asarray(likelihood(replace(population, tau=population.tau.at[2].set(t)), blind)) for t in (0.0, 0.03)
    )
    np.testing.assert_allclose(two, one, rtol=0, atol=0.6 * (5 * 0.03) ** 2)


@pytest.mark.extended
@extremes
def test_spreads_of_zero_are_regular_and_their_signs_do_not_matter(scatter):
    population, marginal = case(scatter, 3)
    none = replace(population, modulus_scatter=jnp.zeros(()), shape_scatter=jnp.zeros(()))

    @jax.jit
    def expand(spreads):
        def total(s):
            at = replace(none, tau=s[:3], theta_scatter=s[3:])
            return jnp.sum(marginal.log_likelihood(at))

        return jax.value_and_grad(total)(spreads)

    size = 3 + len(scatter.varying)
    value, slope = expand(jnp.zeros(size))
    np.testing.assert_array_equal(slope, 0.0)
    # Smooth there: the slope grows in proportion to the spread, to either side.
    beside, other = (np.asarray(expand(jnp.full(size, h))[1]) for h in (1e-5, -1e-5))
    np.testing.assert_allclose(beside, -other, rtol=1e-6)
    np.testing.assert_allclose(beside, 0.1 * np.asarray(expand(jnp.full(size, 1e-4))[1]), rtol=1e-2)
    assert np.all(beside != 0)
    at_mean = log_tests(none, marginal, np.zeros((3, 1, scatter.size)))
    np.testing.assert_allclose(float(value), at_mean.sum(), rtol=1e-12)
    spreads = np.append(np.asarray(population.tau), np.asarray(population.theta_scatter))
    before = float(expand(jnp.asarray(spreads))[0])
    for signs in itertools.product([1.0, -1.0], repeat=size):
        np.testing.assert_allclose(float(expand(jnp.asarray(spreads * np.array(signs)))[0]), before, rtol=1e-12)


@pytest.mark.extended
@extremes
def test_the_gradient_is_that_of_the_value(scatter):
    """The iteration towards the most probable deviations is not differentiated, yet the derivative is whole."""
    population, marginal = case(scatter, 8, scale=0.01)
    vector, rebuild = jax.flatten_util.ravel_pytree(population)
    total = jax.jit(lambda v: jnp.sum(marginal.log_likelihood(rebuild(v))))
    slope = np.asarray(jax.jit(jax.grad(total))(vector))
    for j, step in enumerate(1e-5 * np.eye(len(vector))):
        expected = (float(total(vector + step)) - float(total(vector - step))) / 2e-5
        np.testing.assert_allclose(slope[j], expected, rtol=1e-3, atol=1e-3 * np.abs(slope).max())


@pytest.mark.extended
@extremes
def test_draws_are_made_of_their_deviations_and_the_volume_is_that_of_the_map(scatter):
    population, marginal = case(scatter, 6)
    k = scatter.size
    numbers = jnp.asarray(np.random.default_rng(0).standard_normal((3, k + 1)))

    def place(numbers):
        drawn = marginal.draw(population, numbers[:, :k], numbers[:, k])
        return jnp.concatenate([drawn.deviations, drawn.zero[:, None]], 1)

    J = np.asarray(jax.jit(jax.jacfwd(place))(numbers))
    drawn = draw(population, marginal, numbers[:, :k], numbers[:, k])
    for i in range(3):
        sign, expected = np.linalg.slogdet(J[i, :, i])
        assert sign == 1.0
        np.testing.assert_allclose(float(drawn.log_volume[i]), expected, rtol=1e-9, atol=1e-9)
        assert np.all(np.delete(J[i], i, axis=1) == 0)
    u = numbers_at(population, marginal, np.asarray(drawn.deviations)[:, None])[:, 0]
    np.testing.assert_allclose(drawn.theta - marginal.point.theta, u[:, 4:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(drawn.latent[:, 3] - marginal.point.latent[:, 3], u[:, 3], rtol=1e-9, atol=1e-12)
    sd = np.asarray(marginal.zero_sd) * np.exp(float(population.log_noise))
    zero = np.asarray(marginal.zero) + np.einsum("np,np->n", np.asarray(marginal.zero_slope), u)
    np.testing.assert_allclose(drawn.zero, zero + sd * np.asarray(numbers[:, k]), rtol=1e-9)
    np.testing.assert_allclose(drawn.log_likelihood, likelihood(population, marginal), rtol=1e-12)


@pytest.mark.extended
def test_beyond_the_range_of_the_map_and_of_shape_factors_nothing_is_nan():
    population, marginal = case(PLAIN, 3, scale=0.5)
    drawn = draw(population, marginal, jnp.full((3, 3), -9.0), jnp.zeros(3))
    assert np.all(np.isneginf(np.asarray(drawn.log_volume)))
    assert np.all(np.isfinite(np.asarray(drawn.latent)))
    assert np.all(np.isfinite(np.asarray(drawn.zero)))
    population, marginal = case(PLAIN)
    value = np.asarray(likelihood(replace(population, a=jnp.asarray(-1 / 0.45)), marginal))
    assert not np.any(np.isnan(value))
    assert value[1] < value[0] - 100


@pytest.mark.extended
@pytest.mark.parametrize("known", [None, 0.2], ids=["", "errors of zero and peak"])
def test_summaries_of_linear_tests_are_exact(known):
    """Modulus and an amplitude of either sign enter linearly: then nothing is approximate but the display's steps."""
    rng, four, zero_prior = np.random.default_rng(4), (0.2, 0.3, 0.5, 0.3), (0.7, 2.0)
    tests, linear = random_tests(rng, count=3, zero_sd=known, peak_sd=known)
    tests = replace(tests, particle=particle_batch(DIAMETERS[:3]))
    columns = rng.standard_normal((3, POINTS, 6)) * np.asarray(tests.mask)[..., None]
    linear = replace(linear, columns=jnp.asarray(columns))
    scatter = Scatter(modulus=True, varying=((0, True),))
    latent, theta = true_latent()[:3], np.array([0.4, 1.5])
    point = Point(jnp.asarray(latent), jnp.asarray(rng.standard_normal(3)), jnp.asarray(np.tile(theta, (3, 1))))
    noise = Noise.of(four, jnp.asarray([0.5, 1.0, 2.0]))
    straight = Straight.of(3, *2 * (np.zeros(2),))
    marginal, *_ = summarise(point, straight, tests, linear, noise, jnp.asarray(zero_prior), scatter, *KINDS[0])
    log_eta = np.log(1 + 1.2 * np.asarray(tests.flatness))
    effects = {"theta": theta + 0.3, "theta_scatter": np.array([0.6])}
    mu, e = np.log(COEFFICIENTS[0]) + 0.05, latent[0, 3] - 0.2
    population = random_population(rng, scatter, a=1.2, tau=np.zeros(3), mu=mu, log_modulus=e, log_noise=0.0, **effects)
    # The coefficients of each particle stand where the population has them: kappa is what moves the residual.
    away = np.asarray(population.mu) + log_eta[:, None] - latent[:, :3]
    kappa = np.expm1(away * [1.0, 3.0, 5.0]) / [1.0, 3.0, 5.0]
    u = np.column_stack([kappa, float(population.log_modulus) - latent[:, 3], np.full((3, 2), 0.3)])
    actual = np.asarray(likelihood(population, marginal))
    for i in range(3):
        mask = np.asarray(tests.mask[i])
        X = np.asarray(linear.columns[i])
        own = X[:, [3, 4]] * [float(population.modulus_scatter), 0.6]
        zero = zero_prior[0] + float(tests.contact[i]) - float(point.zero[i])
        total = dense(four, float(noise.scale[i]), tests, linear, i) + own @ own.T + zero_prior[1] ** 2
        law = multivariate_normal((X @ u[i] + zero)[mask], total[mask][:, mask])
        expected = law.logpdf(np.asarray(linear.residual[i])[mask])
        np.testing.assert_allclose(actual[i], expected, rtol=1e-9, atol=1e-4)


@jax.jit
def everything(A, b):
    factor = Cholesky(A)
    return factor.solve(b), factor.forward(b), factor.backward(b), factor.inverse(), factor.log_det()


@pytest.mark.extended
@pytest.mark.parametrize("batch", [(), (2, 3)])
@pytest.mark.parametrize("size", [1, 2, 5])
@pytest.mark.parametrize("spread", [0.0, 1.0, 3.0])
def test_a_factor_solves_inverts_and_has_the_determinant(size, batch, spread):
    rng = np.random.default_rng(size)
    A = random_precision(rng, int(np.prod(batch)), size, spread=spread).reshape(*batch, size, size)
    b, tolerance = rng.standard_normal((*batch, size)), np.linalg.cond(A).max() * size * 1e-14
    solved, forward, backward, inverse, log_det = (np.asarray(v) for v in everything(A, b))
    assert (solved.shape, inverse.shape, log_det.shape) == (b.shape, A.shape, batch)
    expected, L = np.linalg.inv(A), np.linalg.cholesky(A)
    scale, scale_of_L = np.abs(expected).max(), np.abs(np.linalg.inv(L)).max()
    np.testing.assert_allclose(inverse, expected, rtol=0, atol=tolerance * scale)
    np.testing.assert_allclose(log_det, np.linalg.slogdet(A)[1], rtol=0, atol=1e-12 + tolerance)
    for found, matrix, unit in ((solved, A, scale), (forward, L, scale_of_L), (backward, L.mT, scale_of_L)):
        wanted = np.linalg.solve(matrix, b[..., None])[..., 0]
        np.testing.assert_allclose(found, wanted, rtol=0, atol=10 * tolerance * unit)
