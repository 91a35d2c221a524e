"""Significance: p of the largest statistic is uniform where nothing is missing, whatever the noise model is worth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest, norm

from mcc_jax.discover.evidence import log_evidence_at_random
from mcc_jax.discover.score import Projection, common_scatter, family_wise, smallest_of_families

pytestmark = pytest.mark.long  # compiles for long


def simulated(rng, *, particles=20, columns=12, scale=1.0, effect=0.0):
    """Scores of correlated columns under the noise model, times `scale`; the first column's estimate over its standard
    error is `effect` on average."""
    X = rng.normal(size=(particles, 30, columns)) * np.exp(0.3 * rng.normal(size=particles))[:, None, None]
    X[..., 1:2] += X[..., :1]
    information = np.einsum("npk,npl->nkl", X, X)
    noise = rng.normal(size=(particles, 30)) * np.broadcast_to(scale, (particles,))[:, None]
    length = np.sqrt(information[:, 0, 0].sum())
    scores = np.einsum("npk,np->nk", X, noise + effect / length * X[..., 0])
    ones = np.ones(columns)
    none = np.zeros(0)
    at = np.arange(columns)
    return Projection(
        at, np.arange(particles), scores, information, np.ones(particles), none, none, ones, none.astype(int)
    )


def smallest(views, sign):
    return np.array([family_wise(view, sign, seed)[0].min() for seed, view in enumerate(views)])


SIDES = np.array([0, 1, 1, -1] * 3)


def test_p_is_uniform_where_nothing_is_missing():
    """300 campaigns: the smallest family-wise p is uniform (99.9 % band of Kolmogorov's test)."""
    rng = np.random.default_rng(11)
    p = smallest([simulated(rng) for _ in range(300)], SIDES)
    assert kstest(p, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("scale", [0.6, 2.0], ids=["too_wide", "too_narrow"])
def test_a_noise_model_that_is_wrong_by_a_factor_does_not_matter(scale):
    rng = np.random.default_rng(12)
    views = [simulated(rng, scale=scale) for _ in range(200)]
    assert kstest(smallest(views, SIDES), "uniform").pvalue > 1e-3
    # With many directions the common scatter is the square of that factor.
    wide = [common_scatter(simulated(rng, scale=scale, columns=30))[0] for _ in range(20)]
    assert np.mean(wide) == pytest.approx(scale**2, rel=0.05)


def test_no_false_alarms_where_the_noise_model_is_wrong_test_by_test():
    """Tests whose noise differs threefold and more from what the model says, which scores and scatter both show."""
    rng = np.random.default_rng(13)
    views = [simulated(rng, scale=np.exp(0.7 * rng.normal(size=20))) for _ in range(200)]
    assert np.mean(smallest(views, SIDES) <= 0.05) < 0.10


def test_the_noise_model_is_not_trusted_where_columns_scatter_unlike():
    """Where half of the directions scatter eight times as much, the common scatter keeps few degrees of freedom."""
    rng = np.random.default_rng(14)
    trusted = []
    for wrong in (False, True):
        view = simulated(rng, columns=30)
        each = np.einsum("nkk->nk", view.information)
        factor = np.repeat([8.0 if wrong else 1.0, 1.0], 15)
        scores = rng.normal(size=each.shape) * np.sqrt(each) * factor
        information = np.einsum("nk,kl->nkl", each, np.eye(30))
        trusted.append(common_scatter(replace(view, scores=scores, information=information))[1])
    assert trusted[0] > 60
    assert trusted[1] < 6


def test_an_effect_of_five_standard_errors_is_found():
    """In nine of ten campaigns of 20 particles, of which a test on the scatter alone sees six."""
    rng = np.random.default_rng(15)
    p = smallest([simulated(rng, effect=5.0) for _ in range(60)], SIDES)
    assert np.mean(p <= 0.04) > 0.85


def test_only_the_physical_sign_counts():
    """The same strong common score is significant with its own sign or both, and not at all with the other one."""
    view = simulated(np.random.default_rng(2), columns=2, effect=7.0).only(np.array([True, False]))
    p = {sign: family_wise(view, np.array([sign]), 0)[0][0] for sign in (-1, 0, 1)}
    assert p[1] < 1e-3
    assert p[0] < 1e-3
    assert p[-1] > 0.99
    reverse = {sign: family_wise(replace(view, scores=-view.scores), np.array([sign]), 0)[0][0] for sign in (-1, 0, 1)}
    assert (reverse[-1], reverse[0], reverse[1]) == (p[1], p[0], p[-1])


@pytest.mark.parametrize("particles", [1, 2, 3])
def test_few_particles_are_judged_by_the_noise_model(particles):
    rng = np.random.default_rng(particles)
    view = simulated(rng, particles=particles, columns=1)
    p, t = family_wise(view, np.array([1]), 0, few=True)
    z = view.scores.sum() / np.sqrt(view.information.sum())
    assert t[0] == pytest.approx(z)
    assert p[0] == pytest.approx(norm.sf(z), abs=0.03)


SMALL = np.arange(12) < 2


def test_families_together_are_uniform_where_nothing_is_missing():
    """300 campaigns: the smaller of two families' p, judged by its own draws (99.9 % band of Kolmogorov's test)."""
    rng = np.random.default_rng(16)
    views = [simulated(rng) for _ in range(300)]
    p = [smallest_of_families(view, SIDES, seed, [SMALL, ~SMALL]) for seed, view in enumerate(views)]
    assert kstest(p, "uniform").pvalue > 1e-3


def test_families_of_unlike_shares_are_uniform_and_the_larger_share_needs_less():
    """300 campaigns with nothing missing (99.9 % band), and forty in which the first column is 3 standard errors."""
    rng = np.random.default_rng(19)
    views = [simulated(rng) for _ in range(300)]
    p = [smallest_of_families(v, SIDES, i, [SMALL, ~SMALL], shares=(0.9, 0.1)) for i, v in enumerate(views)]
    assert kstest(p, "uniform").pvalue > 1e-3
    views = [simulated(rng, effect=3.0) for _ in range(40)]
    much, alike, little = (
        np.median([smallest_of_families(v, SIDES, 0, [SMALL, ~SMALL], shares=shares) for v in views])
        for shares in ((0.9, 0.1), None, (0.1, 0.9))
    )
    assert much < alike < little


def test_in_a_small_family_an_effect_needs_less():
    rng = np.random.default_rng(17)
    views = [simulated(rng, effect=3.3, columns=60) for _ in range(40)]
    sign = np.zeros(60)
    first = np.arange(60) < 1
    apart = np.array([smallest_of_families(v, sign, 0, [first, ~first]) for v in views])
    together = np.array([smallest_of_families(v, sign, 0, [np.ones(60, bool)]) for v in views])
    assert np.median(apart) < 0.6 * np.median(together)
    # One family is the largest statistic of all; an empty one is none.
    one = [family_wise(v, sign, 0)[0].min() for v in views]
    np.testing.assert_allclose(together, one, atol=2e-3)
    with_none = [smallest_of_families(v, sign, 0, [np.ones(60, bool), np.zeros(60, bool)]) for v in views[:3]]
    np.testing.assert_array_equal(with_none, together[:3])


WAVES = np.arange(12).reshape(6, 2)


def test_two_columns_judged_together_are_uniform_where_nothing_is_missing():
    """300 campaigns: sine and cosine of six waves, correlated like all other columns (99.9 % band)."""
    rng = np.random.default_rng(18)
    every, none = np.ones(12, bool), np.zeros(12)
    views = [simulated(rng) for _ in range(300)]
    p = [smallest_of_families(view, none, seed, [every], pairs=WAVES) for seed, view in enumerate(views)]
    assert kstest(p, "uniform").pvalue > 1e-3


def test_a_wave_of_any_phase_is_found_by_sine_and_cosine_together():
    """3 standard errors on the sine and as much on the cosine: hardly anything alone among sixty, plain together."""
    rng = np.random.default_rng(19)
    pairs, sign, every = np.arange(60).reshape(30, 2), np.zeros(60), [np.ones(60, bool)]
    views = []
    for _ in range(40):
        view = simulated(rng, columns=60)
        size = 3.0 / np.sqrt(view.total[2:4])
        views.append(replace(view, scores=view.scores + view.information[:, :, 2:4] @ size))
    alone = np.array([smallest_of_families(v, sign, 0, every) for v in views])
    together = np.array([smallest_of_families(v, sign, 0, every, pairs=pairs) for v in views])
    assert np.median(together) < 0.3 * np.median(alone)
    # Two columns that are one, and pairs of none, are judged alone.
    doubled = replace(
        views[0],
        scores=np.repeat(views[0].scores[:, :30], 2, 1),
        information=np.repeat(np.repeat(views[0].information[:, :30, :30], 2, 1), 2, 2),
    )
    of_all = [smallest_of_families(doubled, sign, 0, every, pairs=some) for some in (pairs, pairs[:0])]
    assert of_all[0] == of_all[1]


def test_the_same_seed_gives_the_same_probability():
    view = simulated(np.random.default_rng(5))
    first, again, other = (family_wise(view, SIDES, seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_one_odd_test_is_no_effect_that_differs_from_test_to_test():
    """Evidence of one test counts for little more than the odds that something else is wrong with it."""
    count = 20
    information, sign, groups = np.ones((count, 1)) * 400.0, np.array([1.0]), [np.array([0])]
    none = np.zeros((count, 1))
    one, all_of_them = none.copy(), none + 5 * np.sqrt(400.0)
    one[3] = 12 * np.sqrt(400.0)
    nothing, odd, effect = (log_evidence_at_random(U, information, sign, groups)[0] for U in (none, one, all_of_them))
    assert odd < nothing + 8
    assert odd < 3
    assert effect > 40
