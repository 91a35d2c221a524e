"""A shortcut for many particles: the exact likelihood by regression."""

import jax
import numpy as np
import pytest

from mcc_jax import paper_campaign, sample
from mcc_jax.calibrate import draws as drawing
from mcc_jax.calibrate import particles
from mcc_jax.calibrate.particles import correction

pytestmark = pytest.mark.extended


def test_a_slope_is_found_through_any_rotation_of_the_parameters():
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((1000, 3)) @ rng.standard_normal((3, 3)) + 5.0
    draws = np.concatenate([draws, draws[:, :1]], 1)  # one parameter twice
    slope = np.array([0.3, -0.2, 0.1, 0.0])
    log_weight, error = correction(lambda _, rows: 1e3 + draws[rows] @ slope, draws)
    np.testing.assert_allclose(log_weight, (draws - draws.mean(0)) @ slope, atol=1e-8)
    assert error < 1e-8


def test_the_error_is_that_of_the_random_numbers():
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((4000, 2))
    noise = {0: 0.4, 1: -0.2}
    log_weight, error = correction(lambda which, rows: (1 + noise[which]) * draws[rows, 0], draws)
    assert error == pytest.approx(0.3, rel=0.05)
    assert np.polyfit(draws[:, 0], log_weight, 1)[0] == pytest.approx(1.1, rel=0.01)


def test_blocks_of_particles_are_drawn_as_all_at_once(paper_posterior):
    """Every number of the likelihood stays with the particles of its block; two of none are not cut."""
    fit, population = paper_posterior.fit, jax.tree.map(lambda x: x[0, ::4], paper_posterior.population)
    exact, key = drawing.exact_likelihood(fit), jax.random.key(0)
    whole, blocks = (particles.Drawer(exact, size).all(key, population) for size in (0, 10))
    for name in ("zero", "log_likelihood"):
        found, wanted = np.asarray(getattr(blocks, name)), np.asarray(getattr(whole, name))
        assert found.shape == wanted.shape == (250, 20)
        np.testing.assert_array_less(np.abs(found.mean(0) - wanted.mean(0)), 0.6 * wanted.std(0), err_msg=name)


def test_the_shortcuts_agree_with_exact_weights(paper_posterior, monkeypatch):
    monkeypatch.setattr(particles, "COMPARED", 40_000)  # so that twenty particles count as many
    many = sample(paper_campaign(0))
    assert many.leapfrogs == 0
    assert not many.weights_applied
    assert many.converged, many.failures()
    for name, wanted in paper_posterior.named_population().items():
        found, sd = many.named_population()[name], wanted.std()
        assert abs(found.mean() - wanted.mean()) < 0.15 * sd, name
        assert found.std() == pytest.approx(sd, rel=0.15), name
    for name in ("C", "zero_um"):
        found, wanted = getattr(many, name), getattr(paper_posterior, name)
        sd = wanted.std((0, 1))
        np.testing.assert_array_less(np.abs(found.mean((0, 1)) - wanted.mean((0, 1))), 0.25 * sd, err_msg=name)
        np.testing.assert_allclose(found.std((0, 1)), sd, rtol=0.25, err_msg=name)
