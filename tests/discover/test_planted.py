"""Effects planted in linear systems of known answer: named, both named, or nothing."""

from dataclasses import replace

import numpy as np
import pytest
from linear_systems import FORMULAS, Dense, planted, random_campaign, system_of

from mcc_jax.discover.candidates import candidates_of, located
from mcc_jax.discover.dictionary import waves, words
from mcc_jax.discover.evidence import evidence_of_any, log_evidence, pairs, random_probability, rank
from mcc_jax.discover.forward_selection import WORTH, WORTH_OF_WAVE, pursue
from mcc_jax.discover.model_selection import name_missing
from mcc_jax.discover.noise_estimation import systematic, unbounded
from mcc_jax.discover.omnibus import p_nothing_left
from mcc_jax.discover.score import project, smallest_of_families
from mcc_jax.effects import LIBRARY

pytestmark = pytest.mark.long  # compiles for long

NOTHING = np.array([], int)


@pytest.mark.parametrize("name", [mechanism for mechanism, _ in FORMULAS])
def test_a_planted_effect_is_named(name):
    system = planted(1, {name: 8.0})
    assert p_nothing_left(system, 0, []) < 0.01
    ranking = rank(system, project(system, system.candidate_columns))
    assert ranking.names[0] == name
    assert ranking.probability[0] > 0.9
    best = project(system, system.candidate_columns, inside=np.array([system.column(ranking.best[0])]))
    assert best.residual.sum() < project(system, NOTHING).residual.sum() - 25


@pytest.mark.parametrize("two", [("frame_compliance", "adhesion"), ("creep", "thermal_drift")])
def test_two_planted_effects_are_both_named(two):
    system = planted(2, dict.fromkeys(two, 9.0))
    best = pairs(system, project(system, system.candidate_columns))[0]
    i, j = best.stronger, best.weaker
    assert {system.candidates[k].mechanism for k in (i, j)} == set(two)
    columns, _ = systematic(system)
    assert {system.column(i), system.column(j)} <= set(columns.tolist())


def test_an_amplitude_comes_back_within_its_error():
    strength = 12.0
    for seed in range(6):
        system = planted(seed, {"creep": strength})
        k = [c.mechanism for c in system.candidates].index("creep")
        view = project(system, system.candidate_columns)
        assert abs(view.gaussian[k] - strength) < 4


def test_nothing_planted_nothing_found():
    """Forty campaigns: p is not small more often than by chance (P(more than 6 of 40 below 5 %) = 0.3 %)."""
    p = [p_nothing_left(random_campaign(100 + seed, particles=12)[0], seed, []) for seed in range(40)]
    assert np.sum(np.array(p) < 0.05) <= 6
    assert np.median(p) > 0.25


@pytest.mark.parametrize("name", ["frame_compliance", "creep", "adhesion", "reload_hysteresis"])
def test_an_effect_of_the_impossible_sign_is_not_named(name):
    system = planted(3, {name: -9.0})
    ranking = rank(system, project(system, system.candidate_columns))
    assert ranking.names[0] != name
    position = ranking.names.index(name)
    assert ranking.probability[position] < 0.05
    for pair in pairs(system, project(system, system.candidate_columns)):
        i, j = pair.stronger, pair.weaker
        assert name not in {system.candidates[k].mechanism for k in (i, j)} or _right_way(system, i, j)


def _right_way(system, i, j):
    both = np.array([system.column(i), system.column(j)])
    theta = project(system, NOTHING, inside=both).theta[len(system.globals) :]
    signs = np.array([system.candidates[k].variant.sign for k in (i, j)])
    return bool(((signs == 0) | (theta * signs > 0)).all())


def test_what_is_systematic_leaves_nothing_where_nothing_is():
    taken = [len(systematic(random_campaign(200 + seed, particles=12)[0])[0]) for seed in range(20)]
    assert np.mean(taken) < 0.2


def test_heavy_tails_of_the_noise_make_jumps_less_of_a_wonder():
    """What shows in a few points of a test has the tails of the noise; what differs in size alone has not."""
    jump = ("pop_in", next(v.name for v in LIBRARY["pop_in"].variants if located(v)))
    system, _ = random_campaign(5, particles=12, formulas=(jump,) * 16)  # sixteen places
    view = project(system, system.candidate_columns)
    view.scores[:, 0] = 0.0
    view.scores[:3, 0] = 3.0 * np.sqrt(view.information[:3, 0, 0])
    p = {tails: random_probability(replace(system, tails=tails), view, 0) for tails in (3.0, 8.0, np.inf)}
    assert 1.5 * p[np.inf] < p[8.0] < p[3.0] / 1.3


def test_a_regression_over_particles_is_worth_what_its_correlation_is():
    """An effect of the particles' sizes, say: its error holds it, so its t ends at the root of their number."""
    rng = np.random.default_rng(8)
    count = 20
    x = rng.standard_normal((4000, count))
    y = rng.standard_normal((4000, count))
    R = np.einsum("ij,ij->i", x, y) / np.sqrt((x**2).sum(1) * (y**2).sum(1))
    # Both means are known here: one degree of freedom more than `unbounded` takes.
    worth = unbounded(np.sqrt(count) * R, count)
    assert np.abs(worth.mean()) < 0.05
    assert 0.9 < worth.std() < 1.05
    assert 0.5 * 0.0027 < np.mean(np.abs(worth) > 3) + 1e-3 < 3 * 0.0027
    strong = unbounded(np.array([-4.4, 1.0, 3.2, 4.4]), count)
    assert strong[0] == -strong[3]
    assert abs(strong[1] - 1.0) < 0.1
    assert 3.2 < strong[2] < 4.4 < strong[3] < np.inf
    np.testing.assert_array_equal(unbounded(np.array([1.5]), 3), [1.5])


def test_effects_between_particles_are_those_of_size_shape_and_humidity():
    between = {c.mechanism for c in candidates_of(LIBRARY) if c.between_particles}
    assert between == {"size_effect", "shape_second_order", "humidity"}


def test_a_gap_with_which_no_name_has_anything_to_do_is_no_set_of_names():
    """A word explains it, weakly; the names all explain less than chance does."""
    system, dense = random_campaign(12, particles=20, points=60, own=4, words_used=12)
    word = int(system.word_columns[3])
    X = dense.columns.copy()
    X[:, :, 0] -= 3.5 / np.sqrt(project(system, np.array([word])).total[0]) * X[:, :, word]
    system = system_of(Dense(dense.own, X, dense.prior), system.candidates, system.places, system.words)
    view = project(system, system.candidate_columns)
    ranking = rank(system, view)
    assert ranking.log_evidence[0] <= 0
    verdict, chosen, sets, _ = name_missing(system, view, ranking, None, 0, lambda _: None)
    assert (verdict, chosen, sets) == ("UNLISTED", [], [])
    columns, gain = pursue(system)
    assert word in columns
    assert gain < 50


def test_evidence_of_any_mechanism_is_the_mean_over_mechanisms_and_formulas():
    system, _ = random_campaign(8, formulas=(*FORMULAS, ("creep", "viscous_flow")))
    view = project(system, np.concatenate([system.place_columns, system.candidate_columns]))
    t = np.random.default_rng(4).normal(size=(5, len(view.columns))) * 2
    found = evidence_of_any(system, view)(t)
    information, count = view.total[len(system.places) :], len(FORMULAS) + 1
    each = np.exp(log_evidence(t[:, len(system.places) :] * np.sqrt(information), information, system.signs))
    creep = [i for i, c in enumerate(system.candidates) if c.mechanism == "creep"]
    alone = np.setdiff1d(np.arange(count), creep)
    np.testing.assert_allclose(np.exp(found), each[:, alone].sum(1) + each[:, creep].mean(1), rtol=1e-10)
    assert evidence_of_any(system, view)(t[0]) == pytest.approx(found[0])


def test_a_gap_that_many_formulas_explain_is_found_where_none_is_significant():
    """The evidence of mechanisms counts together: six formulas nearly alike say more than the best of them."""
    found, largest = [], []
    for seed in range(20):
        system, dense = random_campaign(300 + seed, particles=12)
        X, first = dense.columns.copy(), system.column(0)
        for k in range(1, 6):
            X[:, :, system.column(k)] = X[:, :, first] * system.signs[k] + 0.3 * X[:, :, system.column(k)]
        once = system_of(Dense(dense.own, X, dense.prior), system.candidates, system.places, system.words)
        X[:, :, 0] -= X[:, :, first] * system.signs[0] * 3.0 / np.sqrt(project(once, np.array([first])).total)
        system = system_of(Dense(dense.own, X, dense.prior), system.candidates, system.places, system.words)
        view = project(system, system.candidate_columns)
        families = [[evidence_of_any(system, view)], [np.ones(len(view.columns), bool)]]
        p = [smallest_of_families(view, system.signs, seed, family) for family in families]
        found.append(p[0])
        largest.append(p[1])
    assert np.median(found) < np.median(largest)
    assert np.median(found) < 0.05


def test_a_weak_wave_of_any_phase_is_found_by_sine_and_cosine():
    """Neither is worth a word alone; the phase of an air conditioning is nobody's choice."""
    system, dense = random_campaign(12, particles=20, points=60, own=4, words_used=12)
    some = (*words()[:8], *waves()[:4])
    system = system_of(dense, system.candidates, system.places, some)
    both = system.quadratures[0]
    by_chance = project(system, both)
    size = np.linalg.solve(by_chance.similarity(), 3.4 - by_chance.gaussian)  # so that each has 3.4 standard errors
    X = dense.columns.copy()
    X[:, :, 0] -= X[:, :, both] @ (size / np.sqrt(by_chance.total))
    system = system_of(Dense(dense.own, X, dense.prior), system.candidates, system.places, some)
    assert project(system, system.word_columns).gaussian.max() ** 2 < WORTH
    columns, gain = pursue(system)
    assert columns == both.tolist()
    assert gain > WORTH_OF_WAVE
    assert p_nothing_left(system, 0, []) < 0.01
    assert pursue(system, most=1) == ([], 0.0)


TWO = ("frame_compliance", "adhesion")


def _asked(system):
    view = project(system, system.candidate_columns)
    return name_missing(system, view, rank(system, view), None, 0, lambda _: None)


def test_two_names_stand_where_they_explain_more_than_words():
    system = planted(2, dict.fromkeys(TWO, 9.0))
    verdict, chosen, sets, steps = _asked(system)
    assert verdict == "NAMED"
    assert {system.candidates[k].mechanism for k in chosen} == set(TWO)
    assert [names[0] for names in sets] == [system.candidates[k].mechanism for k in chosen]
    assert len(steps) == 2


def test_two_names_do_not_stand_where_one_word_explains_as_much():
    """A word that is the sum of both signatures, planted: the names imitate it to the last digit, but are two."""
    system, dense = random_campaign(2, particles=20, points=60, own=4)
    total = project(system, system.candidate_columns).total
    names = [c.mechanism for c in system.candidates]
    X = dense.columns.copy()
    word = system.word_columns[0]
    X[:, :, word] = sum(X[:, :, system.column(names.index(n))] / np.sqrt(total[names.index(n)]) for n in TWO)
    X[:, :, 0] -= 9.0 * X[:, :, word]
    system = system_of(Dense(dense.own, X, dense.prior), system.candidates, system.places, system.words)
    best = pairs(system, project(system, system.candidate_columns))[0]
    assert {names[best.stronger], names[best.weaker]} == set(TWO)
    found, gain = pursue(system)
    assert found[0] == word
    assert best.gain > gain - 5.0
    assert _asked(system)[:3] == ("UNLISTED", [], [])
