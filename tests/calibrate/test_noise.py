"""The noise filter against dense Gaussian algebra, and what is estimated with it against known numbers."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.stats import multivariate_normal

from mcc_jax.calibrate.noise import (
    Linear,
    Noise,
    NoisePrior,
    Whitening,
    estimate_noise,
    particle_scales,
    restricted_likelihood,
    whitening,
)

POINTS = 12
STEPS = st.lists(st.floats(0.0, 0.5, allow_subnormal=False), min_size=POINTS, max_size=POINTS).map(
    lambda s: np.array([0.0, *s[1:]])
)
MASKS = st.lists(st.booleans(), min_size=POINTS, max_size=POINTS).map(np.array)
SIZES = st.floats(0.01, 2.0, allow_subnormal=False)
SEEDS = st.integers(0, 2**32 - 1)
SETTINGS = settings(max_examples=60)


# Loading, a branch behind its peak, loading on, and another branch.
BRANCH = np.repeat([0, 1, 2, 3], POINTS // 4)
ONE_BRANCH = np.repeat([0, 1], POINTS // 2)


def dense_covariance(four, scale, step, compliance, peak=None, branch=None):
    """The covariance in the docstring of `noise`, written out."""
    white, force, correlated, length = four
    path = np.cumsum(step)
    wander = correlated**2 * np.exp(-np.abs(path[:, None] - path) / length)
    total = np.diag(white**2 + (force * compliance) ** 2) + wander
    if peak is not None:
        for b in np.unique(branch):
            c = np.where(branch == b, peak, 0.0)
            total = total + force**2 * np.outer(c, c)
    return scale**2 * total


def still_branches():
    """Compliance, and branches whose peaks move nothing."""
    return jnp.ones(POINTS), jnp.zeros(POINTS), jnp.asarray(BRANCH)


def noise_of(four, scale=(1.0,)):
    return Noise(*(jnp.asarray(float(v)) for v in four), jnp.asarray(np.asarray(scale, float)))


@jax.jit
def whitened(four, scale, step, mask, compliance, residual, peak, branch):
    noise = Noise(*four, jnp.ones(1))
    filtered = whitening(noise, scale, step, mask, compliance, peak, branch)
    return filtered(residual), filtered.log_det


@SETTINGS
@given(STEPS, MASKS, SIZES, SIZES, st.none() | SIZES, SIZES, SIZES, SEEDS)
def test_whitening_is_the_dense_gaussian(step, mask, white, force, correlated, length, scale, seed):
    rng = np.random.default_rng(seed)
    compliance, residual, peak = rng.standard_normal((3, POINTS))
    # Where residuals are correlated, one branch; without correlation, any number.
    branch = BRANCH if correlated is None else ONE_BRANCH
    peak = np.where(branch % 2 == 1, peak, 0.0)
    four = (white, force, correlated or 0.0, length)
    arguments = (tuple(map(np.float64, four)), np.float64(scale), step, mask, compliance, residual, peak, branch)
    independent, log_det = whitened(*arguments)
    assert np.all(np.asarray(independent)[~mask] == 0)
    covariance = dense_covariance(four, scale, step, compliance, peak, branch)[mask][:, mask]
    used = residual[mask]
    expected = multivariate_normal(cov=covariance).logpdf(used) if mask.any() else 0.0
    actual = -0.5 * (np.sum(np.asarray(independent) ** 2) + float(log_det) + mask.sum() * np.log(2 * np.pi))
    np.testing.assert_allclose(actual, expected, rtol=1e-7, atol=1e-8)


@SETTINGS
@given(STEPS, MASKS, SIZES, SIZES, SEEDS)
def test_masked_points_count_for_nothing(step, mask, correlated, length, seed):
    rng = np.random.default_rng(seed)
    compliance, peak, one, two = rng.standard_normal((4, POINTS))
    other = np.where(mask, one, two)
    arguments = (tuple(map(np.float64, (0.3, 0.2, correlated, length))), np.float64(1.0), step, mask, compliance)
    for a, b in zip(*(whitened(*arguments, r, peak, BRANCH) for r in (one, other)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_whitening_is_linear_and_whitens():
    rng = np.random.default_rng(2)
    step, compliance = np.append(0.0, rng.random(POINTS - 1) / 5), rng.standard_normal(POINTS)
    four = (0.2, 0.3, 0.5, 0.3)
    peak = np.where(ONE_BRANCH == 1, rng.standard_normal(POINTS), 0.0)
    path = (step, np.full(POINTS, True), compliance, peak, ONE_BRANCH)
    filtered = whitening(noise_of(four), jnp.asarray(1.7), *map(jnp.asarray, path))
    L = np.asarray(jax.vmap(filtered, in_axes=1, out_axes=1)(jnp.eye(POINTS)))
    covariance = dense_covariance(four, 1.7, step, compliance, peak, ONE_BRANCH)
    np.testing.assert_allclose(L @ covariance @ L.T, np.eye(POINTS), rtol=0, atol=1e-12)


def test_two_branches_of_correlated_residuals_are_nearly_the_dense_gaussian():
    """The filter carries a little of one branch's direction into what follows; as in tests, correlation is weak."""
    rng = np.random.default_rng(3)
    step, mask = np.full(POINTS, 0.05), np.full(POINTS, True)
    compliance, peak = np.full(POINTS, 0.1), np.where(BRANCH % 2 == 1, 0.3, 0.0)
    four = (0.02, 0.05, 0.01, 0.2)
    covariance = dense_covariance(four, 1.0, step, compliance, peak, BRANCH)
    for _ in range(5):
        r = np.linalg.cholesky(covariance) @ rng.standard_normal(POINTS)
        independent, log_det = whitened(
            tuple(map(np.float64, four)), np.float64(1.0), step, mask, compliance, r, peak, BRANCH
        )
        actual = -0.5 * (np.sum(np.asarray(independent) ** 2) + float(log_det) + POINTS * np.log(2 * np.pi))
        assert abs(actual - multivariate_normal(cov=covariance).logpdf(r)) < 0.3


def test_without_correlation_it_only_divides():
    step = jnp.asarray(np.full(POINTS, 0.1))
    mask, residual = jnp.asarray(np.full(POINTS, True)), jnp.arange(POINTS, dtype=float)
    filtered = whitening(noise_of((0.5, 0.0, 0.0, 1.0)), jnp.asarray(2.0), step, mask, *still_branches())
    np.testing.assert_allclose(filtered(residual), residual, rtol=1e-14)
    np.testing.assert_allclose(float(filtered.log_det), 0.0, atol=1e-14)


# ---- parameters integrated out ---------------------------------------------------------------------------------------


def linear_problem(four, scale, *, points=POINTS, count=1, seed=0, masked=0.1):
    """Tests that are linear in three parameters of their own, with noise as the docstring of `noise` has it."""
    rng = np.random.default_rng(seed)
    path = np.linspace(0, 1.6, points)
    residual = np.empty((count, points))
    jacobian, compliance = np.empty((count, points, 3)), np.empty((count, points))
    step = np.broadcast_to(np.append(0.0, np.diff(path)), (count, points))
    branch = np.broadcast_to((path > 1).astype(int), (count, points))
    peak = np.where(branch == 1, 0.1 + 0.2 * rng.random((count, 1)), 0.0)
    for i in range(count):
        jacobian[i] = np.stack([np.ones(points), path, rng.random() + np.sqrt(path)], 1)
        compliance[i] = 0.05 + rng.random() * np.exp(-2 * path)
        covariance = dense_covariance(four, scale[i], step[i], compliance[i], peak[i], branch[i])
        noise = np.linalg.cholesky(covariance) @ rng.standard_normal(points)
        residual[i] = noise + jacobian[i] @ rng.standard_normal(3)
    mask = rng.random((count, points)) >= masked
    prior = np.tile([0.5, 1.0, 2.0], (count, 1))
    arrays = (residual, jacobian, prior, step, mask, compliance, peak, branch)
    return Linear(*(jnp.asarray(v) for v in arrays))


@pytest.mark.parametrize("scale", [1.0, 0.6])
def test_restricted_likelihood_is_the_dense_gaussian_with_the_parameters_in_the_covariance(scale):
    four = (0.2, 0.3, 0.5, 0.3)
    data = linear_problem(four, (1.0, 1.0), count=2)
    noise = noise_of(four, (scale, 1.0))
    actual = np.asarray(jax.jit(restricted_likelihood)(noise, data))
    for i in range(2):
        mask, J = np.asarray(data.mask[i]), np.asarray(data.jacobian[i])
        r, prior = np.asarray(data.residual[i])[mask], np.asarray(data.prior[i])
        path = (np.asarray(v[i]) for v in (data.step, data.compliance, data.peak, data.branch))
        V = dense_covariance(four, (scale, 1.0)[i], *path)
        total = (V + J @ np.diag(1 / prior) @ J.T)[mask][:, mask]
        expected = multivariate_normal(cov=total).logpdf(r)
        constant = 0.5 * mask.sum() * np.log(2 * np.pi) - 0.5 * np.log(prior).sum()
        np.testing.assert_allclose(actual[i], expected + constant, rtol=1e-9)


KNOWN = np.array([0.02, 0.05, 0.04, 0.2])
WEAK = NoisePrior(jnp.asarray([0.05, 0.02, 0.01, 0.5]), jnp.asarray([1.5, 1.0, 1.5, 1.0]))


@pytest.fixture(scope="module")
def estimated():
    rng = np.random.default_rng(11)
    scale = np.exp(0.5 * rng.standard_normal(10))
    data = linear_problem(KNOWN, scale, points=100, count=10, seed=7)
    start = noise_of(WEAK.median, scale)
    return data, start, estimate_noise(data, WEAK, start)


def test_known_noise_is_recovered(estimated):
    _, start, (noise, sd, converged) = estimated
    sd = np.asarray(sd)
    assert converged
    assert np.all((sd > 0.01) & (sd < 0.5))
    off = (np.asarray(noise.logs) - np.log(KNOWN)) / sd
    assert np.all(np.abs(off) < 3), off
    np.testing.assert_array_equal(noise.scale, start.scale)


def test_the_estimate_is_the_maximum(estimated):
    data, start, (noise, _, _) = estimated

    likelihood = jax.jit(lambda logs: jnp.sum(restricted_likelihood(Noise.from_logs(logs, start.scale), data)))

    def loss(logs):
        return -(float(likelihood(jnp.asarray(logs))) + float(WEAK.log_density(logs)))

    best = np.asarray(noise.logs)
    for direction in np.eye(4):
        for size in (-0.1, 0.1):
            assert loss(best + size * direction) > loss(best)


def test_the_start_does_not_matter(estimated):
    data, start, (noise, _, _) = estimated
    elsewhere = noise_of((0.3, 0.01, 0.005, 0.05), start.scale)
    again, sd, converged = estimate_noise(data, WEAK, elsewhere, uncertainty=False)
    assert converged
    assert np.all(np.isnan(np.asarray(sd)))
    np.testing.assert_allclose(again.logs, noise.logs, atol=5e-3)


def test_data_without_noise_end_at_the_bound_and_stay_finite():
    data = linear_problem((1e-9, 0.0, 0.0, 1.0), np.ones(10), points=100, count=10)
    noise, sd, _ = estimate_noise(data, WEAK, noise_of(WEAK.median, np.ones(10)))
    assert np.all(np.isfinite(np.asarray(noise.logs)))
    assert np.all(np.isfinite(np.asarray(sd)))
    assert float(noise.displacement) < 1e-3


# ---- scales of the particles -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 20])
def test_equal_particles_have_a_scale_of_exactly_one(count):
    freedom = np.full(count, 150.0)
    np.testing.assert_array_equal(particle_scales(np.ones(count), 1.3 * freedom, freedom), 1.0)


def test_chance_alone_seldom_makes_scales_and_small_ones():
    rng = np.random.default_rng(0)
    freedom = rng.integers(50, 250, 20).astype(float)
    draws = [particle_scales(np.ones(20), rng.chisquare(freedom), freedom) for _ in range(200)]
    assert np.mean([np.all(scale == 1.0) for scale in draws]) > 0.7
    assert np.mean([np.abs(np.log(scale)).max() < 0.15 for scale in draws]) > 0.99


def test_unequal_particles_are_recovered_up_to_what_all_share():
    rng = np.random.default_rng(1)
    freedom = np.full(20, 200.0)
    log_scale = 0.4 * rng.standard_normal(20)
    squares = np.exp(2 * log_scale) * rng.chisquare(freedom)
    found = np.log(particle_scales(np.ones(20), squares, freedom))
    # What all share is the noise itself, so only ratios of scales mean something.
    off = found - log_scale
    np.testing.assert_allclose(off - np.median(off), 0.0, atol=4 * np.sqrt(0.5 / 200))
    assert abs(np.median(found)) < 0.05
    # Shrinkage pulls the estimates together, never apart.
    assert np.std(found) < np.std(0.5 * np.log(squares / freedom))


def test_scales_that_fit_already_stay():
    rng = np.random.default_rng(2)
    scale = np.exp(0.4 * rng.standard_normal(20))
    scale /= np.median(scale)
    freedom = np.full(20, 2000.0)
    np.testing.assert_allclose(particle_scales(scale, freedom, freedom), scale, rtol=0.01)


def test_one_bad_particle_among_good_ones_keeps_its_own_scale():
    freedom = np.full(10, 200.0)
    squares = freedom * np.append(np.ones(9), 25.0)
    found = particle_scales(np.ones(10), squares, freedom)
    np.testing.assert_allclose(found, np.append(np.ones(9), 5.0), rtol=0.05)


@pytest.mark.parametrize("squares", [[0.0, 100.0], [0.0, 0.0], [1e12, 1.0]])
def test_scales_of_extreme_residuals_are_finite_and_positive(squares):
    scale = particle_scales(np.ones(2), np.array(squares), np.array([100.0, 100.0]))
    assert np.all(np.isfinite(scale))
    assert np.all(scale > 0)


def test_whitening_of_a_batch_is_that_of_each():
    rng = np.random.default_rng(4)
    step, compliance, r, peak = np.abs(rng.standard_normal((4, 2, POINTS)))
    branch = np.broadcast_to(BRANCH, (2, POINTS))
    mask = rng.random((2, POINTS)) < 0.8
    scale, noise = np.array([0.5, 2.0]), noise_of((0.2, 0.3, 0.5, 0.3), (0.5, 2.0))
    batch: Whitening = jax.vmap(lambda s, *one: whitening(noise, s, *one))(
        noise.scale, *map(jnp.asarray, (step, mask, compliance, peak, branch))
    )
    together = jax.vmap(lambda f, x: f(x))(batch, jnp.asarray(r))
    for i in range(2):
        four = tuple(map(np.float64, (0.2, 0.3, 0.5, 0.3)))
        alone, _ = whitened(four, scale[i], step[i], mask[i], compliance[i], r[i], peak[i], branch[i])
        np.testing.assert_allclose(together[i], alone, rtol=1e-12, atol=1e-14)
