"""Proposed experiments: their power is the share of campaigns, drawn in another way, in which one name is left."""

from dataclasses import replace

import numpy as np
import pytest
from linear_systems import Dense, random_campaign, system_of

from mcc_jax.discover._experiments import COPIES, ENOUGH, MOST_PARTICLES, _Trial
from mcc_jax.discover._naming import LIKE_THE_BEST
from mcc_jax.discover._score import project
from mcc_jax.discover._search import rank

PARTICLES, POINTS = 10, 60
TRUE, TWIN = "creep", "unloading_shape"
NAMES = ("creep", "kelvin_voigt"), ("unloading_shape", "symmetric_bow")


def twins(likeness, strength, seed=0):
    """A measured system in which one effect has a twin: creep of this estimate over standard error; its dense form."""
    system, dense = random_campaign(seed, particles=PARTICLES, points=POINTS, formulas=NAMES)
    X = dense.columns.copy()
    one, other = (system.column(k) for k in (0, 1))
    scale = np.linalg.norm(X[:, :, one]) / np.linalg.norm(X[:, :, other])
    X[:, :, other] = likeness * X[:, :, one] + np.sqrt(1 - likeness**2) * scale * X[:, :, other]
    alone = system_of(Dense(dense.own, X, dense.prior), system.candidates, system.places, system.words)
    amplitude = strength / np.sqrt(project(alone, alone.candidate_columns).total[0])
    X[:, :, 0] -= amplitude * X[:, :, one]
    dense = Dense(dense.own, X, dense.prior)
    return system_of(dense, system.candidates, system.places, system.words), dense, amplitude


def ranking_of(system):
    return rank(system, project(system, system.candidate_columns))


def drawn_again(system, dense, amplitude, seed):
    """Another campaign of the same particles: new noise and new deviations of every particle."""
    rng = np.random.default_rng([seed, 7])
    X = dense.columns.copy()
    noise = rng.normal(size=X.shape[:2]) + np.einsum("npk,nk->np", dense.own, rng.normal(size=dense.own.shape[::2]))
    X[:, :, 0] = noise - amplitude * X[:, :, system.column(0)]
    return system_of(Dense(dense.own, X, dense.prior), system.candidates, system.places, system.words)


@pytest.mark.parametrize(("likeness", "strength"), [(0.5, 4.0), (0.8, 4.0), (0.8, 7.0), (0.95, 5.0)])
def test_power_is_the_share_of_campaigns_in_which_one_name_is_left(likeness, strength):
    system, dense, amplitude = twins(likeness, strength)
    trial = _Trial.of(system, system, replace(ranking_of(system), probability=np.array([0.5, 0.5])), [])
    assert trial is not None
    # This truth alone, as large as it is, not as large as it looked.
    known = replace(trial, truths=((0, amplitude, 1.0),))
    found = [ranking_of(drawn_again(system, dense, amplitude, s)).members(LIKE_THE_BEST) for s in range(60)]
    share = np.mean([names == [TRUE] for names in found])
    power = np.mean([known.power(1, seed) for seed in range(4)])
    assert abs(power - share) < 0.2


def test_more_particles_tell_more_and_the_fewest_that_are_enough_are_proposed():
    system, _, amplitude = twins(0.8, 4.0)
    trial = _Trial.of(system, system, replace(ranking_of(system), probability=np.array([0.5, 0.5])), [])
    assert trial is not None
    trial = replace(trial, truths=((0, amplitude, 1.0),))
    powers = [trial.power(c, 0) for c in COPIES]
    assert powers[0] < ENOUGH < powers[-1]
    assert np.all(np.diff(powers) > -0.1)
    particles, power = trial.fewest(first=1, seed=0)
    enough = next(c for c, p in zip(COPIES, powers, strict=True) if p >= ENOUGH)
    assert (particles, power) == (enough * PARTICLES, powers[COPIES.index(enough)])
    assert trial.fewest(first=2, seed=0)[0] >= 2 * PARTICLES


def test_what_cannot_be_told_apart_is_said_so():
    system, _, _ = twins(1.0, 8.0)
    ranking = ranking_of(system)
    assert set(ranking.members(LIKE_THE_BEST)) == {TRUE, TWIN}
    trial = _Trial.of(system, system, ranking, [])
    assert trial is not None
    particles, power = trial.fewest(first=1, seed=0)
    assert particles <= MOST_PARTICLES
    assert power < 0.1


def test_a_test_that_shows_nothing_of_a_member_is_not_proposed():
    system, _, _ = twins(1.0, 8.0)
    blind = replace(system, candidates=system.candidates[:1], gram=np.delete(np.delete(system.gram, 7, 1), 7, 2))
    assert _Trial.of(system, blind, ranking_of(system), []) is None


def test_the_same_seed_gives_the_same_power():
    system, _, _ = twins(0.9, 6.0)
    ranking = replace(ranking_of(system), probability=np.array([0.6, 0.4]))
    one, two = (_Trial.of(system, system, ranking, []) for _ in range(2))
    assert one is not None
    assert two is not None
    assert one.fewest(first=1, seed=3) == two.fewest(first=1, seed=3)
