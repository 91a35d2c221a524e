"""The noise against dense normal distributions, and what is estimated with it against known numbers."""

from dataclasses import replace

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from joint_cases import ELASTIC, KINDS, POINTS, dense, random_tests
from scipy.stats import multivariate_normal

from mcc_jax.calibrate.data import READING_UM
from mcc_jax.calibrate.noise import (
    Noise,
    Whitening,
    estimate_noise,
    grams_and_likelihoods,
    particle_scales,
    whitening,
)
from mcc_jax.calibrate.numpyro_model import RecordNoise
from mcc_jax.calibrate.priors import NoisePrior

FOUR = (0.2, 0.3, 0.5, 0.3)
kinds = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind[0].value)


@eqx.filter_jit
def filters(four, scale, tests, linear, correlation, along) -> Whitening:
    noise = Noise(*(jnp.asarray(v, float) for v in four), scale)
    return jax.vmap(lambda s, *one: whitening(noise, s, *one, correlation, along))(scale, tests, linear)


@eqx.filter_jit
def log_probability(loc, filtered, factor, value):
    return RecordNoise(loc, filtered, factor).log_prob(value)


def expected(four, scale, factor, tests, linear, away, kind):
    """Log densities of the tests, and what the steps of the display count for besides."""
    found = []
    for i in range(len(tests)):
        mask = np.asarray(tests.mask[i])
        covariance = factor**2 * dense(four, scale[i], tests, linear, i, kind)[mask][:, mask]
        found.append(multivariate_normal(cov=covariance).logpdf(away[i][mask]) if mask.any() else 0.0)
    return np.array(found)


def found_density(four, scale, factor, tests, linear, away, kind):
    filtered = filters(four, jnp.asarray(scale), tests, linear, *kind)
    values = log_probability(jnp.ones_like(tests.force), filtered, jnp.asarray(factor), jnp.asarray(away + 1.0))
    # Reading a display of finite steps is misfit whatever the law says.
    return np.asarray(values + 0.5 * jax.vmap(lambda f: f.reading)(filtered) / factor**2)


@settings(max_examples=30)
@given(
    st.sampled_from([(KINDS[0], None), *((kind, 0.2) for kind in KINDS)]),
    st.integers(0, 2**32 - 1),
    st.sampled_from([(0.0, 1.0), (0.5, 1.7), (1.0, 0.6)]),
)
def test_the_density_is_the_dense_normal_one(case, seed, more):
    """With a branch at the end, errors of its peak and of the zero of force, a scale and a common factor."""
    rng, (kind, known), (masked, factor) = np.random.default_rng(seed), case, more
    tests, linear = random_tests(rng, masked=masked, zero_sd=known, peak_sd=known, count=2)
    four, scale = np.exp(0.7 * rng.standard_normal(4)) * FOUR, np.exp(0.5 * rng.standard_normal(2))
    away = rng.standard_normal((2, POINTS))
    wanted = expected(four, scale, factor, tests, linear, away, kind)
    np.testing.assert_allclose(
        found_density(four, scale, factor, tests, linear, away, kind), wanted, rtol=1e-7, atol=1e-7
    )


@pytest.mark.extended
def test_the_density_has_a_slope_where_some_peaks_were_worked_out():
    """Peaks that were read have no error of their own: a root there has no derivative."""
    rng = np.random.default_rng(2)
    tests, linear = random_tests(rng, peak_sd=0.2, count=2)
    tests = replace(tests, peak_sd=jnp.zeros_like(tests.peak_sd).at[0].set(0.2))
    away = jnp.asarray(rng.standard_normal((2, POINTS)))

    def density(logs):
        filtered = filters(jnp.exp(logs), jnp.ones(2), tests, linear, *KINDS[0])
        return jnp.sum(log_probability(jnp.ones_like(tests.force), filtered, jnp.asarray(1.0), away))

    logs = jnp.log(jnp.asarray(FOUR))
    slope = np.asarray(jax.grad(density)(logs))
    for k, unit in enumerate(np.eye(4)):
        up, down = (float(density(logs + sign * 1e-5 * unit)) for sign in (1, -1))
        assert slope[k] == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-4)


@pytest.mark.extended
def test_white_noise_of_two_branches_is_dense_too():
    rng = np.random.default_rng(5)
    tests, linear = random_tests(rng, elastic=ELASTIC, zero_sd=0.4, count=3)
    four, scale, away = (0.2, 0.3, 0.0, 0.3), np.array([0.5, 1.0, 2.0]), rng.standard_normal((3, POINTS))
    wanted = expected(four, scale, 1.3, tests, linear, away, KINDS[0])
    np.testing.assert_allclose(found_density(four, scale, 1.3, tests, linear, away, KINDS[0]), wanted, rtol=1e-8)


@pytest.mark.extended
@kinds
def test_correlated_noise_of_two_branches_is_nearly_dense(kind):
    """The filter carries a little of one branch's direction into what follows; as in tests, correlation is weak."""
    rng = np.random.default_rng(3)
    tests, linear = random_tests(rng, elastic=ELASTIC, masked=0.0)
    still = jnp.full((1, POINTS), 0.1)
    linear = replace(linear, by_force=still, by_peak=3 * still)
    record = replace(tests.record, time=jnp.asarray(0.05 * np.arange(POINTS)[None]))
    tests = replace(tests, path=record.time, record=record, peak_error=jnp.asarray(1.0 * ELASTIC[None]))
    four = (0.02, 0.05, 0.01, 0.2)
    factor = np.linalg.cholesky(dense(four, 1.0, tests, linear, kind=kind))
    for _ in range(5):
        away = (factor @ rng.standard_normal(POINTS))[None]
        gap = found_density(four, np.ones(1), 1.0, tests, linear, away, kind)
        assert np.abs(gap - expected(four, np.ones(1), 1.0, tests, linear, away, kind)).max() < 0.3


@pytest.mark.extended
@kinds
def test_draws_have_the_covariance_of_the_density(kind):
    """They are linear in standard normal numbers: their covariance is the product of the columns."""
    rng = np.random.default_rng(7)
    tests, linear = random_tests(rng, zero_sd=0.6, peak_sd=0.3)
    (filtered,) = [jax.tree.map(lambda x: x[0], filters(FOUR, jnp.ones(1), tests, linear, *kind))]
    columns = jax.vmap(lambda x: filtered.colour(x[:POINTS], x[POINTS:-1], x[-1]))(jnp.eye(2 * POINTS + 1))
    used = np.asarray(tests.mask[0])
    covariance = np.einsum("kn,km->nm", columns, columns)[used][:, used]
    np.testing.assert_allclose(covariance, dense(FOUR, 1.0, tests, linear, kind=kind)[used][:, used], rtol=1e-6)


def test_white_noise_only_divides_and_a_display_reads_in_steps():
    rng = np.random.default_rng(2)
    tests, linear = random_tests(rng, masked=0.0)
    still = replace(linear, by_peak=jnp.zeros((1, POINTS)))
    filtered = jax.tree.map(lambda x: x[0], filters((0.5, 0.0, 0.0, 1.0), jnp.full(1, 2.0), tests, still, *KINDS[0]))
    np.testing.assert_allclose(filtered(linear.residual[0][:, None])[:, 0], linear.residual[0], rtol=1e-14)
    np.testing.assert_allclose(float(filtered.log_det), 0.0, atol=1e-12)
    np.testing.assert_allclose(float(filtered.reading), POINTS * READING_UM**2, rtol=1e-12)


def likelihoods(scale, tests, linear, logs, zero_sd=2.0):
    return grams_and_likelihoods(scale, tests, linear, logs, jnp.asarray(zero_sd), *KINDS[0])[1]


@pytest.mark.extended
@pytest.mark.parametrize("scale", [1.0, 0.6])
def test_restricted_likelihood_is_the_dense_normal_one_with_the_numbers_in_the_covariance(scale):
    rng = np.random.default_rng(0)
    tests, linear = random_tests(rng, count=2)
    noise, zero_sd = Noise.of(FOUR, jnp.asarray([scale, 1.0])), 1.5
    actual = likelihoods(noise.scale, tests, linear, noise.logs[None], zero_sd)[:, 0]
    for i in range(2):
        mask = np.asarray(tests.mask[i])
        X = np.concatenate([np.asarray(linear.columns[i]), np.full((POINTS, 1), zero_sd)], 1)
        total = (dense(FOUR, (scale, 1.0)[i], tests, linear, i) + X @ X.T)[mask][:, mask]
        wanted = multivariate_normal(cov=total).logpdf(np.asarray(linear.residual[i])[mask])
        np.testing.assert_allclose(actual[i], wanted + 0.5 * mask.sum() * np.log(2 * np.pi), rtol=1e-9)


KNOWN = np.array([0.02, 0.05, 0.04, 0.2])
WEAK = NoisePrior(jnp.asarray([0.05, 0.02, 0.01, 0.5]), jnp.asarray([1.5, 1.0, 1.5, 1.0]))
COUNT, LENGTH = 10, 100


def known_tests(four, scale):
    """Tests that are linear in four numbers and a zero, with noise of known size."""
    rng = np.random.default_rng(7)
    path = np.broadcast_to(np.linspace(0, 1.6, LENGTH), (COUNT, LENGTH))
    tests, linear = random_tests(rng, count=COUNT, points=LENGTH, elastic=np.arange(LENGTH) >= 60, masked=0.1)
    branch = np.where(path > 1, 63, np.arange(LENGTH))
    tests = replace(tests, path=jnp.asarray(path), branch=jnp.asarray(branch), peak_error=jnp.asarray(1.0 * (path > 1)))
    rows = np.stack([np.sqrt(path), path, path**2, np.where(path > 1, path - 1, 0.0)], -1)
    by_force = 0.05 + rng.random((COUNT, 1)) * np.exp(-2 * path)
    by_peak = np.where(path > 1, 0.1 + 0.2 * rng.random((COUNT, 1)), 0.0)
    linear = replace(linear, by_force=jnp.asarray(by_force), by_peak=jnp.asarray(by_peak))
    residual = np.einsum("nkp,np->nk", rows, rng.standard_normal((COUNT, 4))) + rng.standard_normal((COUNT, 1))
    for i in range(COUNT):
        residual[i] += np.linalg.cholesky(dense(four, scale[i], tests, linear, i)) @ rng.standard_normal(LENGTH)
    mask = np.asarray(tests.mask)
    return tests, replace(
        linear,
        residual=jnp.asarray(np.where(mask, residual, 0.0)),
        columns=jnp.asarray(np.where(mask[..., None], rows, 0.0)),
    )


def estimate(tests, linear, start, **options):
    def log_likelihoods(logs):
        return likelihoods(start.scale, tests, linear, logs)

    return estimate_noise(log_likelihoods, WEAK, start, **options)


@pytest.fixture(scope="module")
def estimated():
    scale = np.exp(0.5 * np.random.default_rng(11).standard_normal(COUNT))
    tests, linear = known_tests(KNOWN, scale)
    start = Noise.of(np.asarray(WEAK.median), jnp.asarray(scale))
    return tests, linear, start, estimate(tests, linear, start)


def test_known_noise_is_recovered(estimated):
    *_, start, found = estimated
    assert found.converged
    assert np.all((found.log_sd > 0.01) & (found.log_sd < 0.7))
    off = (np.asarray(found.noise.logs) - np.log(KNOWN)) / found.log_sd
    assert np.all(np.abs(off) < 3), off
    np.testing.assert_array_equal(found.noise.scale, start.scale)


@pytest.mark.extended
def test_the_estimate_is_the_maximum_and_its_volume_laplace_s(estimated):
    tests, linear, start, found = estimated

    def loss(logs):
        each = likelihoods(start.scale, tests, linear, jnp.asarray(logs)[None])
        return -(float(jnp.sum(each)) + float(WEAK.log_density(logs)))

    best = np.asarray(found.noise.logs)
    for direction in np.eye(4):
        assert min(loss(best - 0.1 * direction), loss(best + 0.1 * direction)) > loss(best)
    volume = 0.5 * np.linalg.slogdet(2 * np.pi * np.asarray(found.covariance))[1]
    np.testing.assert_allclose(float(found.log_evidence), float(WEAK.log_density(best)) + volume, rtol=1e-9)


@pytest.mark.extended
def test_data_without_noise_end_at_the_bound_and_stay_finite():
    tests, linear = known_tests((1e-9, 0.0, 0.0, 1.0), np.ones(COUNT))
    found = estimate(tests, linear, Noise.of(np.asarray(WEAK.median), jnp.ones(COUNT)))
    assert np.all(np.isfinite(np.asarray(found.noise.logs)))
    assert np.all(np.isfinite(found.log_sd))
    assert float(found.noise.displacement) < 1e-3


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


def test_one_bad_particle_among_good_ones_keeps_its_own_scale_and_extreme_ones_have_one():
    freedom, expected = np.full(10, 200.0), np.append(np.ones(9), 5.0)
    np.testing.assert_allclose(particle_scales(np.ones(10), freedom * expected**2, freedom), expected, rtol=0.05)
    for squares in ([0.0, 100.0], [0.0, 0.0], [1e12, 1.0]):
        scale = particle_scales(np.ones(2), np.array(squares), np.array([100.0, 100.0]))
        assert np.all(np.isfinite(scale) & (scale > 0))
