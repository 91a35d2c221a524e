"""Independent weighted draws of the population: of known densities, against NUTS, and what happens where they fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from joint_cases import random_summary
from mcc_jax.calibrate.transforms import LogPosterior, most_probable, unconstrain

from mcc_jax import calibrate_bayes, paper_campaign
from mcc_jax.calibrate import draws as drawing
from mcc_jax.calibrate.importance import sample_weighted
from mcc_jax.calibrate.model import prior_numbers
from mcc_jax.calibrate.population import Scatter
from mcc_jax.calibrate.priors import Priors
from mcc_jax.calibrate.sampling import sample_population

COUNT = 200


@pytest.fixture(scope="module")
def target():
    """Summaries of particles drawn from a population whose log C3 does not scatter."""
    rng = np.random.default_rng(1)
    summary, flat = random_summary(rng, COUNT, precision=2000.0), rng.uniform(0.05, 0.4, COUNT)
    truth = np.concatenate([np.log([6.5, 3.0, 2.7]) + rng.standard_normal((COUNT, 3)) * [0.3, 0.0, 0.08]], 1)
    point = np.concatenate([truth + np.log(1 + 1.4 * flat)[:, None], np.full((COUNT, 1), 9.6)], 1)
    spread = np.linalg.cholesky(np.linalg.inv(np.asarray(summary.precision)))
    point += np.einsum("nij,nj->ni", spread, rng.standard_normal((COUNT, 4)))
    summary = jax.tree.map(jnp.asarray, summary)
    summary = type(summary)(**{**vars(summary), "point": jnp.asarray(point), "score": jnp.zeros((COUNT, 4))})
    return LogPosterior(prior_numbers(Priors(), jnp.asarray(flat)), summary, Scatter(newton=0))


class Normal(LogPosterior):
    """A density whose draws are known: normal, and even in the spreads' coordinates."""

    centre: Array
    width: Array

    def log_density(self, free):
        away = (free - self.centre) / self.width
        even = jnp.logaddexp(-0.5 * away[6:] ** 2, -0.5 * ((free + self.centre) / self.width)[6:] ** 2)
        return jnp.sum(-0.5 * away[:6] ** 2) + jnp.sum(even)


CENTRE = np.array([0.3, 9.0, 0.0, 1.0, -1.0, 0.1, 2.0, 0.0, 1.0])
WIDTH = np.array([1e-6, 1e-5, 1.0, 1.0, 1.0, 1e-3, 0.05, 0.5, 0.1])


@pytest.fixture(scope="module")
def normal(target):
    return Normal(target.numbers, target.summary, target.scatter, jnp.asarray(CENTRE), jnp.asarray(WIDTH))


@pytest.mark.parametrize("off", [0.0, 0.4], ids=["at the mode", "beside it"])
def test_weighted_draws_are_those_of_a_known_density(normal, off):
    start = jnp.asarray((CENTRE + off * WIDTH) * np.where(np.arange(9) == 6, -1, 1))  # of either sign
    chains, population = sample_weighted(
        jax.random.key(0), start, jnp.diag(jnp.asarray(WIDTH**2)), normal, chains=2, draws=2000
    )
    assert chains.position.shape == (2, 2000, 9)
    assert not chains.divergent.any()
    assert not chains.steps.any()
    assert population.mu.shape == (4000, 3)
    free = np.asarray(chains.position).reshape(-1, 9)
    mean, sd = CENTRE.copy(), WIDTH.copy()
    mean[7], sd[7] = WIDTH[7] * np.sqrt(2 / np.pi), WIDTH[7] * np.sqrt(1 - 2 / np.pi)  # half-normal
    np.testing.assert_array_less(np.abs(free.mean(0) - mean), 0.08 * sd)
    np.testing.assert_allclose(free.std(0), sd, rtol=0.08)


def test_a_hopeless_proposal_is_refused(normal):
    # So far off that no draw is near the posterior: the weights cannot tell where it is.
    far, narrow = jnp.asarray(CENTRE + 50 * WIDTH), jnp.diag(jnp.asarray(1e-6 * WIDTH**2))
    assert sample_weighted(jax.random.key(0), far, narrow, normal, chains=2, draws=50) is None


@pytest.mark.long
def test_weighted_draws_are_those_of_the_sampler(target):
    start = unconstrain(1.0, 9.6, np.log([6.5, 3.0, 2.7]), np.array([0.3, 0.02, 0.1]), target.numbers, target.scatter)
    *mode, converged = most_probable(start, target)
    assert converged
    _, weighted = sample_weighted(jax.random.key(3), *mode, target, chains=2, draws=2000)
    accept = jnp.asarray(np.asarray(0.8))
    _, sampled = sample_population(jax.random.split(jax.random.key(1)), *mode, target, accept, warmup=300, draws=2000)
    found, wanted = named(weighted), named(sampled)
    for name, values in wanted.items():
        values, other = np.asarray(values), np.asarray(found[name])
        sd = values.std()
        assert abs(other.mean() - values.mean()) < 0.12 * sd, name
        assert other.std() == pytest.approx(sd, rel=0.12), name
        np.testing.assert_allclose(np.quantile(other, [0.05, 0.95]), np.quantile(values, [0.05, 0.95]), atol=0.25 * sd)


def named(population):
    return {
        "a": population.a,
        "log_modulus": population.log_modulus,
        "log_noise": population.log_noise,
        **{f"mu {j}": population.mu[:, j] for j in range(3)},
        **{f"tau {j}": population.tau[:, j] for j in range(3)},
    }


@pytest.mark.long
def test_nuts_takes_over_where_weights_are_not_good_enough(paper_posterior, monkeypatch):
    assert paper_posterior.leapfrogs == 0
    monkeypatch.setattr(drawing, "sample_weighted", lambda *_, **__: None)
    sampled = calibrate_bayes(paper_campaign(0))
    assert sampled.leapfrogs > 1
    assert sampled.converged, sampled.failures()
    for name, wanted in paper_posterior.named_population().items():
        found, sd = sampled.named_population()[name], wanted.std()
        assert abs(found.mean() - wanted.mean()) < 0.1 * sd, name
        assert found.std() == pytest.approx(sd, rel=0.1), name
