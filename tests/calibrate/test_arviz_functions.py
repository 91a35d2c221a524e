"""The functions of ArviZ run on what `to_arviz` gives, as a statistician would call them."""

import warnings

import arviz as az
import matplotlib
import numpy as np
import pytest

from mcc_jax import paper_campaign, sample

matplotlib.use("agg")
NAMES = ("first", "second")
POPULATION = ["a", "effective_modulus_MPa", "C1_median", "C5_median", "tau_C1", "tau_C5"]

pytestmark = pytest.mark.extended


@pytest.fixture(scope="module")
def by_particle(paper_posterior):
    """The paper's particles, drawn twice."""
    pair = zip(NAMES, (paper_posterior, sample(paper_campaign(0), seed=1)), strict=True)
    return {name: one.to_arviz() for name, one in pair}


def test_summary(by_particle):
    table = az.summary(by_particle["first"], var_names=POPULATION)
    assert list(table.index) == POPULATION
    assert (table["r_hat"].astype(float) < 1.02).all()


def test_particles_left_out(by_particle):
    with warnings.catch_warnings():  # of few particles one may weigh on the rest
        warnings.filterwarnings("ignore", message=".*Pareto", category=UserWarning)
        found = az.loo(by_particle["first"], var_name="test")
        assert np.isfinite(found.elpd)
        table = az.compare(by_particle, var_name="test")
    assert set(table.index) == set(by_particle)
    assert np.isfinite(table["elpd"]).all()


def test_sensitivity_to_the_prior(by_particle):
    table = az.psense_summary(by_particle["first"], var_names=POPULATION, likelihood_var_names="test")
    assert list(table.index) == POPULATION
    assert np.isfinite(table[["prior", "likelihood"]].astype(float)).all(axis=None)


@pytest.mark.parametrize("draw", ["plot_forest", "plot_rank", "plot_pair"])
def test_pictures_of_parameters(by_particle, draw):
    getattr(az, draw)(by_particle["first"], var_names=POPULATION[:3], backend="matplotlib")


@pytest.fixture(autouse=True)
def closed():
    yield
    matplotlib.pyplot.close("all")
