"""Proposed experiments: their power is the share of campaigns, drawn in another way, in which one name is left."""

from dataclasses import replace

import numpy as np
import pytest
from linear_systems import Dense, random_campaign, system_of

from mcc_jax.discover.evidence import rank
from mcc_jax.discover.experiments import COPIES, ENOUGH, MAX_PARTICLES, _Trial, _Truth
from mcc_jax.discover.extensions import serious
from mcc_jax.discover.model_selection import LIKE_THE_BEST
from mcc_jax.discover.score import project

pytestmark = pytest.mark.long  # compiles for long

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


def trial_of(system, ranking=None, refitted=None):
    """Further tests like those that were made."""
    trial = _Trial.of(system, system, ranking or both_members(ranking_of(system)), [], refitted or {})
    assert trial is not None
    return trial


def both_members(ranking):
    return replace(ranking, probability=np.array([0.5, 0.5]))


def known(trial, amplitude, sd=0.0):
    """The first name alone may be true, with this amplitude: as large as it is, not as large as it looked."""
    one = np.ones(1)
    return replace(trial, truths=(_Truth(1.0, np.zeros(1, int), one, amplitude * one, sd * one),))


def together(one, other):
    """The tests of two systems as one campaign."""
    gram, points = (np.concatenate([getattr(s, name) for s in (one, other)]) for name in ("gram", "points"))
    return replace(one, gram=gram, points=points, usable=np.ones(len(points), bool))


@pytest.mark.parametrize(("likeness", "strength"), [(0.5, 2.5), (0.8, 4.0), (0.8, 7.0), (0.95, 5.0)])
def test_power_is_the_share_of_campaigns_in_which_one_name_is_left(likeness, strength):
    system, dense, amplitude = twins(likeness, strength)
    trial = known(trial_of(system), amplitude)
    later = [drawn_again(system, dense, amplitude, s) for s in range(60)]
    found = [ranking_of(together(system, further)).members(LIKE_THE_BEST) for further in later]
    share = np.mean([names == [TRUE] for names in found])
    power = np.mean([trial.power(PARTICLES, seed) for seed in range(4)])
    assert abs(power - share) < 0.2


def test_more_particles_tell_more_and_the_fewest_that_are_enough_are_proposed():
    system, _, amplitude = twins(0.93, 4.0)
    trial = known(trial_of(system), amplitude)
    tried = [round(c * PARTICLES) for c in COPIES]
    powers = [trial.power(n, 0) for n in tried]
    assert powers[0] < ENOUGH < powers[-1]
    assert np.all(np.diff(powers) > -0.15)
    particles, power = trial.fewest(0)
    enough = next(n for n, p in zip(tried, powers, strict=True) if p >= ENOUGH)
    assert (particles, power) == (enough, powers[tried.index(enough)])


def test_what_is_not_sure_of_its_size_tells_less_of_its_name():
    system, _, amplitude = twins(0.93, 4.0)
    trial = trial_of(system)
    sure, unsure = (known(trial, amplitude, share * amplitude) for share in (0.0, 0.6))
    powers = [np.mean([one.power(4 * PARTICLES, seed) for seed in range(4)]) for one in (sure, unsure)]
    assert powers[1] < powers[0] - 0.1


def test_what_was_fitted_as_it_is_counts_as_it_was_fitted():
    system, _, _ = twins(0.8, 4.0)
    ranking = both_members(ranking_of(system))
    drops = {0: 40.0, 1: 10.0}
    made = trial_of(system, ranking, drops).made
    np.testing.assert_allclose(made.gaussian**2, [40.0, 10.0])
    first = next(t for t in trial_of(system, ranking, drops).truths if t.formulas[0] == 0)
    np.testing.assert_allclose(first.amplitude, np.sqrt(40.0 / made.total[0]))
    # The twin that explains nothing any more, fitted as it is, leaves the name alone without any further test.
    assert trial_of(system, ranking, {0: 40.0, 1: 0.0}).truths[0].share == 0.5
    assert known(trial_of(system, ranking, {0: 40.0, 1: 0.0}), 0.0).power(1, 0) > 0.9


def test_what_cannot_be_told_apart_is_said_so():
    system, _, _ = twins(1.0, 8.0)
    ranking = ranking_of(system)
    assert set(ranking.members(LIKE_THE_BEST)) == {TRUE, TWIN}
    particles, power = trial_of(system, ranking).fewest(0)
    assert particles <= MAX_PARTICLES
    assert power < 0.1


def test_a_test_that_shows_nothing_of_a_member_is_not_proposed():
    system, _, _ = twins(1.0, 8.0)
    blind = replace(system, candidates=system.candidates[:1], gram=np.delete(np.delete(system.gram, 7, 1), 7, 2))
    assert _Trial.of(system, blind, ranking_of(system), [], {}) is None


def test_the_same_seed_gives_the_same_power():
    system, _, _ = twins(0.9, 6.0)
    ranking = replace(ranking_of(system), probability=np.array([0.6, 0.4]))
    assert trial_of(system, ranking).fewest(3) == trial_of(system, ranking).fewest(3)


def test_the_best_formulas_of_every_serious_mechanism_are_fitted_whatever_is_known_beforehand():
    """Beforehand the common formula counts most; one that the data ask for more is fitted, too."""
    names = [("adhesion", n) for n in ("jkr_nominal", "bond", "stretched_tail", "jkr")] + [("creep", "kelvin_voigt")]
    system, _ = random_campaign(3, particles=PARTICLES, points=POINTS, formulas=names)
    ranking = rank(system, project(system, system.candidate_columns))
    ranking = replace(
        ranking,
        names=("adhesion", "creep"),
        log_evidence=np.array([20.0, 2.5]),
        gain=np.array([44.0, 12.0]),
        at_random=(False, False),
        evidence=np.array([-2.0, 0.5, 20.0, -3.0, 2.5]),
        favour=np.array([-1.0, -2.0, 18.0, -5.0, 2.0]),
    )
    assert serious(system, ranking) == [2, 0, 1, 4]
    assert serious(system, replace(ranking, log_evidence=np.array([20.0, 1.5]))) == [2, 0, 1]
    assert serious(system, replace(ranking, gain=np.array([44.0, 5.0]))) == [2, 0, 1]
