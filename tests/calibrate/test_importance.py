"""Weighted draws of the population: of known densities, against NUTS, where weights fail, and of many particles."""

import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from threadpoolctl import threadpool_info, threadpool_limits

from mcc_jax import Model, paper_campaign, sample
from mcc_jax.calibrate import draws as drawing
from mcc_jax.calibrate import particles
from mcc_jax.calibrate.importance import sample_weighted
from mcc_jax.calibrate.mode import LogPosterior, Shapes, seeded
from mcc_jax.calibrate.noise import standard_promotion
from mcc_jax.calibrate.particles import correction
from mcc_jax.calibrate.running import one_blas_thread

SIGNED = (5, 6, 7)


class Normal(LogPosterior):
    """A density whose draws are known: normal, and even in the spreads' coordinates."""

    centre: Array
    width: Array

    def log_density(self, free):
        away, other = (free - self.centre) / self.width, (free + self.centre) / self.width
        even = jnp.logaddexp(-0.5 * away**2, -0.5 * other**2)
        signed = jnp.isin(jnp.arange(len(free)), jnp.asarray(SIGNED))
        return jnp.sum(jnp.where(signed, even, -0.5 * away**2))


CENTRE = np.array([0.3, 9.0, 0.0, 1.0, -1.0, 2.0, 0.0, 1.0, 0.1])
WIDTH = np.array([1e-6, 1e-5, 1.0, 1.0, 1.0, 0.05, 0.5, 0.1, 1e-3])
"""In the order of the model's sites: a, modulus, three means, three spreads, noise."""


@pytest.fixture(scope="module")
def normal(paper_posterior):
    target = paper_posterior.fit.target
    assert tuple(target.signed()) == SIGNED
    return Normal(target.model, target.marginal, jnp.asarray(CENTRE), jnp.asarray(WIDTH))


@pytest.mark.extended
@pytest.mark.parametrize("off", [0.0, 0.4], ids=["at the mode", "beside it"])
def test_weighted_draws_are_those_of_a_known_density(normal, off):
    start = jnp.asarray((CENTRE + off * WIDTH) * np.where(np.arange(9) == 5, -1, 1))  # of either sign
    found = sample_weighted(jax.random.key(0), start, jnp.diag(jnp.asarray(WIDTH**2)), normal, chains=2, draws=2000)
    free = found.free
    assert free.shape == (4000, 9)
    assert found.population.mu.shape == (4000, 3)
    mean, sd = CENTRE.copy(), WIDTH.copy()
    mean[6], sd[6] = WIDTH[6] * np.sqrt(2 / np.pi), WIDTH[6] * np.sqrt(1 - 2 / np.pi)  # half-normal
    np.testing.assert_array_less(np.abs(free.mean(0) - mean), 0.08 * sd)
    np.testing.assert_allclose(free.std(0), sd, rtol=0.08)
    # The integral of a product of normal densities, of which those of the spreads stand twice.
    integral = np.sum(np.log(WIDTH * np.sqrt(2 * np.pi))) + len(SIGNED) * np.log(2)
    assert abs(found.log_evidence - integral) < 4 * found.error + 1e-6
    assert found.error < 0.05


@pytest.mark.extended
def test_a_hopeless_proposal_is_refused(normal):
    # So far off that no draw is near the posterior: the weights cannot tell where it is.
    far, narrow = jnp.asarray(CENTRE + 50 * WIDTH), jnp.diag(jnp.asarray(1e-6 * WIDTH**2))
    assert not sample_weighted(jax.random.key(0), far, narrow, normal, chains=2, draws=50).good


def assert_same(posterior, other, tolerance):
    """Means and standard deviations of the population differ by no more than this share of a standard deviation."""
    assert posterior.converged, posterior.failures()
    for name, wanted in other.named_population().items():
        found, sd = posterior.named_population()[name], wanted.std()
        assert abs(found.mean() - wanted.mean()) < tolerance * sd, name
        assert found.std() == pytest.approx(sd, rel=tolerance), name


@pytest.mark.extended
def test_nuts_takes_over_where_weights_are_not_good_enough(paper_posterior, monkeypatch):
    assert paper_posterior.leapfrogs == 0
    monkeypatch.setattr(drawing, "sample_weighted", lambda *a, **k: sample_weighted(*a, **k)._replace(good=False))
    sampled = sample(paper_campaign(0))
    assert sampled.leapfrogs > 1
    assert_same(sampled, paper_posterior, 0.1)


@pytest.mark.extended
def test_threads_may_trace_the_model_side_by_side():
    """As the pieces of a proposal do; NumPyro keeps its handlers in one list for all threads."""
    interval = sys.getswitchinterval()

    def trace(count):
        with standard_promotion():
            return jax.eval_shape(seeded(Model().population), Shapes(jnp.zeros(count))).a.shape

    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(4) as pool:
            assert set(pool.map(trace, range(2, 42))) == {()}
    finally:
        sys.setswitchinterval(interval)


def test_numpy_has_one_thread_meanwhile_and_its_own_afterwards():
    def threads():
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    with threadpool_limits(2, "blas"):
        before = threads()
        assert before != {1}
        assert one_blas_thread(threads)() == {1}
        assert threads() == before


@pytest.mark.extended
def test_a_slope_is_found_through_any_rotation_of_the_parameters():
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((1000, 3)) @ rng.standard_normal((3, 3)) + 5.0
    draws = np.concatenate([draws, draws[:, :1]], 1)  # one parameter twice
    slope = np.array([0.3, -0.2, 0.1, 0.0])
    log_weight, error = correction(lambda _, rows: 1e3 + draws[rows] @ slope, draws)
    np.testing.assert_allclose(log_weight, (draws - draws.mean(0)) @ slope, atol=1e-8)
    assert error < 1e-8


@pytest.mark.extended
def test_the_error_is_that_of_the_random_numbers():
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((4000, 2))
    noise = {0: 0.4, 1: -0.2}
    log_weight, error = correction(lambda which, rows: (1 + noise[which]) * draws[rows, 0], draws)
    assert error == pytest.approx(0.3, rel=0.05)
    assert np.polyfit(draws[:, 0], log_weight, 1)[0] == pytest.approx(1.1, rel=0.01)


@pytest.mark.extended
def test_blocks_of_particles_are_drawn_as_all_at_once(paper_posterior):
    """Every number of the likelihood stays with the particles of its block; two of none are not cut."""
    fit, population = paper_posterior.fit, jax.tree.map(lambda x: x[0, ::4], paper_posterior.population)
    exact, key = drawing.exact_likelihood(fit), jax.random.key(0)
    whole, blocks = (particles.Drawer(exact, size).all(key, population) for size in (0, 10))
    for name in ("zero", "log_likelihood"):
        found, wanted = np.asarray(getattr(blocks, name)), np.asarray(getattr(whole, name))
        assert found.shape == wanted.shape == (250, 20)
        np.testing.assert_array_less(np.abs(found.mean(0) - wanted.mean(0)), 0.6 * wanted.std(0), err_msg=name)


@pytest.mark.extended
def test_the_shortcuts_agree_with_exact_weights(paper_posterior, monkeypatch):
    monkeypatch.setattr(particles, "COMPARED", 40_000)  # so that twenty particles count as many
    many = sample(paper_campaign(0))
    assert many.leapfrogs == 0
    assert not many.weights_applied
    assert_same(many, paper_posterior, 0.15)
    for name in ("C", "zero_um"):
        found, wanted = getattr(many, name), getattr(paper_posterior, name)
        sd = wanted.std((0, 1))
        np.testing.assert_array_less(np.abs(found.mean((0, 1)) - wanted.mean((0, 1))), 0.25 * sd, err_msg=name)
        np.testing.assert_allclose(found.std((0, 1)), sd, rtol=0.25, err_msg=name)
