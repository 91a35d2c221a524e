"""Tests on Gram matrices against the same questions asked of tall dense matrices."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_systems import FORMULAS, G, random_campaign
from scipy.integrate import quad
from scipy.stats import norm

from mcc_jax.discover.cross_validation import held_out
from mcc_jax.discover.evidence import (
    Pair,
    formula_weights,
    log_evidence,
    log_evidence_at_random,
    other_formulas,
    pairs,
    rank,
    weights,
)
from mcc_jax.discover.pop_in import ODD, SCALES
from mcc_jax.discover.score import project, project_summed

pytestmark = pytest.mark.long  # compiles for long

seeds = st.integers(0, 10_000)


def same(got, wanted, scale=None):
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max() if scale is None else scale)


# ---- projection ------------------------------------------------------------------------------------------------------


@given(seed=seeds, inside=st.sampled_from([(), (2,), (0, 5)]), some=st.booleans())
@settings(max_examples=20)
def test_projection_is_generalised_least_squares(seed, inside, some):
    system, dense = random_campaign(seed)
    chosen = np.array([0, 2, 3, 6]) if some else np.arange(7)
    nuisance = [*system.globals, *(system.column(k) for k in inside)]
    looked_at = np.array([system.column(k) for k in range(len(FORMULAS)) if k not in inside])
    view = project(system, looked_at, inside=np.array(nuisance[G:], int), particles=chosen if some else None)
    B, M = dense.stacked(nuisance, chosen)
    r, _ = dense.stacked([0], chosen)
    D, _ = dense.stacked(looked_at, chosen)
    prior = np.diag([*dense.prior, *[1e-12] * len(inside)])
    inner = B.T @ M @ B + prior
    theta = -np.linalg.solve(inner, B.T @ M @ r[:, 0])
    same(view.theta, theta)
    same(view.covariance, np.linalg.inv(inner))
    left = r[:, 0] + B @ theta
    across = D - B @ np.linalg.solve(inner, B.T @ M @ D)
    points = dense.columns.shape[1]
    for row in range(len(chosen)):
        at = slice(row * points, (row + 1) * points)
        same(view.scores[row], -across[at].T @ M[at, at] @ left[at], 1e-8)
        same(view.information[row], across[at].T @ M[at, at] @ across[at])
        same(view.residual[row], left[at] @ M[at, at] @ left[at])
    same(view.survival, np.diagonal(across.T @ M @ across) / np.diagonal(D.T @ M @ D))
    same(view.similarity(), _cosines(across, M), 1e-9)


def _cosines(X, M):
    both = X.T @ M @ X
    length = np.sqrt(np.diagonal(both))
    return both / length[:, None] / length[None]


@given(seed=seeds)
@settings(max_examples=10)
def test_score_and_information_are_those_of_the_marginal_likelihood(seed):
    """Score and curvature of the log likelihood with the population's best values at every amplitude."""
    system, dense = random_campaign(seed)
    view = project(system, system.candidate_columns)
    B, M = dense.stacked(list(system.globals))
    k = seed % len(FORMULAS)
    d, _ = dense.stacked([system.column(k)])
    r, _ = dense.stacked([0])

    def profile(theta):
        left = (r + theta * d)[:, 0]
        inner = B.T @ M @ B + np.diag(dense.prior)
        pull = B.T @ M @ left
        return -0.5 * (left @ M @ left - pull @ np.linalg.solve(inner, pull))

    # A quadratic, so differences are exact. The part of the score that comes from the population's prior, not from
    # the particles, stays out of the particles' scores.
    h = 1.0
    slope = (profile(h) - profile(-h)) / (2 * h)
    beta = -np.linalg.solve(B.T @ M @ B + np.diag(dense.prior), B.T @ M @ np.concatenate([r, d], 1))
    same(view.scores[:, k].sum(), slope + beta[:, 0] @ (dense.prior * beta[:, 1]), 1e-7)


def test_the_amplitude_of_an_effect_in_the_law_is_found_without_noise():
    """The residual is minus 0.7 of a signature and the population's own: both come back, whatever the prior's width."""

    system, dense = random_campaign(3)
    X = dense.columns.copy()
    k, beta = 2, np.array([0.3, -0.2, 0.1, 0.5, -0.4])
    X[:, :, 0] = -0.7 * X[:, :, system.column(k)] - np.einsum("npq,q->np", X[:, :, system.globals], beta)
    from linear_systems import Dense, system_of

    exact = replace(
        system_of(Dense(dense.own, X, dense.prior), system.candidates, system.places, system.words),
        prior=np.full(G, 1e-12),
    )
    view = project(exact, exact.candidate_columns[:0], inside=np.array([exact.column(k)]))
    np.testing.assert_allclose(view.theta, [*beta, 0.7], rtol=1e-8)
    assert view.residual.sum() < 1e-8 * exact.gram[:, 0, 0].sum()
    alone = project(exact, exact.candidate_columns)
    np.testing.assert_allclose(alone.estimate[k], 0.7, rtol=1e-8)
    np.testing.assert_allclose(alone.gaussian[k], 0.7 * np.sqrt(alone.total[k]), rtol=1e-8)


def test_a_column_that_the_population_can_make_survives_in_nothing():
    system, dense = random_campaign(5)

    from linear_systems import Dense, system_of

    X = dense.columns.copy()
    mix = np.array([1.0, -2.0, 0.5, 0.3, 1.0])
    X[:, :, system.column(4)] = np.einsum("npq,q->np", X[:, :, system.globals], mix)
    twin = system_of(Dense(dense.own, X, dense.prior), system.candidates, system.places, system.words)
    view = project(replace(twin, prior=np.full(G, 1e-12)), twin.candidate_columns)
    assert view.survival[4] < 1e-10
    assert (np.delete(view.survival, 4) > 0.5).all()


def test_particles_that_are_not_usable_take_no_part():

    system, _ = random_campaign(7)
    usable = np.array([True, True, False, True, False, True, True])
    left_out = project(replace(system, usable=usable), system.candidate_columns)
    named = project(system, system.candidate_columns, particles=np.flatnonzero(usable))
    np.testing.assert_array_equal(left_out.scores, named.scores)
    np.testing.assert_array_equal(left_out.particles, [0, 1, 3, 5, 6])


@given(seed=seeds)
@settings(max_examples=10)
def test_absorbing_gives_every_particle_its_own_amount(seed):
    system, dense = random_campaign(seed)
    columns = np.array([system.column(1), system.column(3)])
    absorbed = system.absorbing(columns)
    for i, X in enumerate(dense.columns):
        Z = np.concatenate([dense.own[i], X[:, columns]], 1)
        same(absorbed.gram[i], X.T @ np.linalg.solve(np.eye(len(Z)) + Z @ Z.T, X))


def test_absorbing_nothing_changes_nothing():
    system, _ = random_campaign(1)
    np.testing.assert_array_equal(system.absorbing(np.array([], int)).gram, system.gram)


def test_columns_lie_one_after_the_other():
    system, _ = random_campaign(1)
    together = np.concatenate(
        [[0], system.globals, system.candidate_columns, system.place_columns, system.word_columns]
    )
    np.testing.assert_array_equal(together, np.arange(system.gram.shape[1]))


# ---- evidence --------------------------------------------------------------------------------------------------------


def integral(U, information, sign):
    """Mean over the prior of the likelihood ratio, by quadrature."""
    total = 0.0
    for s in SCALES:
        peak = U / (information + 1 / s**2)
        width = 1 / np.sqrt(information + 1 / s**2)
        low, high = peak - 12 * width, peak + 12 * width
        if sign > 0:
            low, high = max(low, 0.0), max(high, 12 * width)
        if sign < 0:
            low, high = min(low, -12 * width), min(high, 0.0)
        factor = 1.0 if sign == 0 else 2.0

        def ratio(t, s=s, factor=factor):
            return factor * np.exp(U * t - 0.5 * information * t * t) * norm.pdf(t, 0, s)

        total += quad(ratio, low, high, epsrel=1e-11, epsabs=0, limit=400)[0]
    return total / len(SCALES)


@pytest.mark.parametrize("sign", [-1, 0, 1])
@pytest.mark.parametrize(("U", "information"), [(0.0, 0.0), (3.0, 4.0), (-20.0, 100.0), (60.0, 900.0), (5.0, 1e4)])
def test_evidence_is_an_integral(U, information, sign):
    got = log_evidence(np.array([U]), np.array([information]), np.array([sign]))
    np.testing.assert_allclose(got, [np.log(integral(U, information, sign))], rtol=1e-8, atol=1e-9)


def test_evidence_at_random_is_an_integral_over_every_particle():
    rng = np.random.default_rng(4)
    information = rng.uniform(1.0, 300.0, (5, 4))
    scores = rng.normal(size=(5, 4)) * np.sqrt(information) * 2
    sign = np.array([1, 1, 0, -1])
    groups = [np.array([0, 1]), np.array([2]), np.array([3])]
    got = log_evidence_at_random(scores, information, sign, groups)
    for members, value in zip(groups, got, strict=True):
        by_scale = []
        for s in SCALES:
            product = 1.0
            for i in range(5):
                one = 0.0
                for k in members:
                    U, h = scores[i, k], information[i, k]
                    low, high = {0: (-12 * s, 12 * s), 1: (0, 12 * s), -1: (-12 * s, 0)}[int(sign[k])]
                    factor = 1 if sign[k] == 0 else 2
                    at = U / (h + 1 / s**2)
                    inside = [at] if low < at < high else None
                    one += quad(
                        lambda t, U=U, h=h, s=s, f=factor: f * np.exp(U * t - 0.5 * h * t * t) * norm.pdf(t, 0, s),
                        low, high, points=inside, epsrel=1e-11, epsabs=0, limit=400,
                    )[0]  # fmt: skip
                product *= 1 / (ODD + (1 - ODD) / (one / len(members)))
            by_scale.append(product)
        assert value == pytest.approx(np.log(np.mean(by_scale)), rel=1e-8)


def test_evidence_is_finite_for_any_amount_of_information():
    U = np.array([0.0, 1e6, -1e6, 1e3])
    information = np.array([0.0, 1e6, 1e6, 1e-12])
    for sign in (-1, 0, 1):
        assert np.isfinite(log_evidence(U, information, np.full(4, sign))).all()


# ---- naming on the system --------------------------------------------------------------------------------------------


def test_pairs_take_away_what_two_columns_together_do():
    system, _ = random_campaign(8)
    view = project(system, system.candidate_columns)
    best = pairs(system, view)
    assert best
    assert [p.log_evidence for p in best] == sorted((p.log_evidence for p in best), reverse=True)
    both = view.information.sum(0)
    U = view.scores.sum(0)
    sign = np.array([c.variant.sign for c in system.candidates])
    for pair in best:
        i, j = pair.stronger, pair.weaker
        theta = np.linalg.solve(both[np.ix_([i, j], [i, j])], U[[i, j]])
        assert ((sign[[i, j]] == 0) | (theta * sign[[i, j]] > 0)).all()
        assert pair.gain == pytest.approx(theta @ U[[i, j]], rel=1e-9)


SEVERAL = (
    ("frame_compliance", "linear"),
    ("frame_compliance", "stiffening"),
    ("frame_compliance", "conical_seat"),
    ("adhesion", "bond"),
    ("adhesion", "jkr"),
    ("unloading_shape", "symmetric_bow"),
)


@pytest.mark.parametrize("most", [1, 3])
def test_other_formulas_of_a_pair_take_away_most_beside_the_one_that_stays(most):
    system, _ = random_campaign(8, formulas=SEVERAL)
    view = project(system, system.candidate_columns)
    U, both, names = view.scores.sum(0), view.information.sum(0), [c.mechanism for c in system.candidates]
    checked = 0
    for pair in pairs(system, view):
        found = other_formulas(system, view, pair, most)
        for own, other in (pair.both, pair.both[::-1]):
            gains = {}
            for k, name in enumerate(names):
                theta = np.linalg.solve(both[np.ix_([k, other], [k, other])], U[[k, other]]) if k != other else [0.0]
                if name == names[own] and k != own and (system.signs[k] == 0 or theta[0] * system.signs[k] > 0):
                    gains[k] = theta @ U[[k, other]]
            expected = sorted(gains, key=lambda k: -gains[k])[:most]
            kept = [next(iter(set(p.both) - {other})) for p in found if other in p.both and own not in p.both]
            assert kept == expected
            checked += len(kept)
        assert all({names[k] for k in p.both} == {names[k] for k in pair.both} for p in found)
    assert checked > 3


def test_a_pair_is_as_evident_as_one_and_then_the_other_beside_it():
    """Against the second one's evidence where the first is projected off; every family here is one formula."""
    system, _ = random_campaign(8)
    view = project(system, system.candidate_columns)
    alone = log_evidence(view.scores.sum(0), view.total, system.signs)
    for pair in pairs(system, view)[:5]:
        i, j = pair.stronger, pair.weaker
        assert alone[i] >= alone[j]
        beside = project(system, system.candidate_columns[[j]], inside=np.array([system.column(i)]))
        other = log_evidence(beside.scores.sum(0), beside.total, system.signs[[j]])
        assert pair.log_evidence == pytest.approx(alone[i] + other[0], abs=1e-6)


def test_fitting_a_pair_counts_half_of_what_it_takes_away_more():
    pair = Pair(10.0, 30.0, 3, 5)
    assert pair.fitted(34.0) == Pair(12.0, 34.0, 3, 5)


def test_the_common_formula_weighs_as_much_as_all_others_together():
    formulas = (("frame_compliance", "linear"), ("frame_compliance", "softening"), ("frame_compliance", "conical_seat"))
    system, _ = random_campaign(8, formulas=(*formulas, ("creep", "viscous_flow")))
    same(weights(system, formula_weights(system)), np.array([0.5, 0.25, 0.25, 1.0]))


@given(seed=seeds)
@settings(max_examples=10)
def test_probabilities_are_probabilities(seed):
    system, _ = random_campaign(seed)
    ranking = rank(system, project(system, system.candidate_columns))
    assert ranking.probability.sum() == pytest.approx(1.0)
    assert (np.diff(ranking.log_evidence) <= 1e-12).all()
    assert (np.diff(ranking.probability) <= 1e-12).all()
    assert len(ranking.names) == len(set(ranking.names)) == len(FORMULAS)


# ---- held-out particles ----------------------------------------------------------------------------------------------


def test_held_out_results_are_those_of_refits_by_hand():
    system, dense = random_campaign(9, particles=6)
    inside = np.array([system.column(0), system.column(4)])
    got = held_out(system, lambda _: [inside[:0], inside[:1], inside])
    assert got.chi2.shape == (3, 6)
    for step in range(3):
        columns = [*system.globals, *inside[:step]]
        prior = np.diag([*dense.prior, *[1e-12] * step])
        for i in range(6):
            others = [j for j in range(6) if j != i]
            B, M = dense.stacked(columns, others)
            r, _ = dense.stacked([0], others)
            inner = B.T @ M @ B + prior
            theta = -np.linalg.solve(inner, B.T @ M @ r[:, 0])
            X = dense.columns[i]
            left = X[:, 0] + X[:, columns] @ theta
            V = dense.covariance(i)
            assert got.chi2[step, i] == pytest.approx(left @ np.linalg.solve(V, left), rel=1e-9)
            # Predictive density of the left-out residual, its mean's uncertainty included.
            wide = V + X[:, columns] @ np.linalg.solve(inner, X[:, columns].T)
            elpd = -0.5 * (left @ np.linalg.solve(wide, left) + np.linalg.slogdet(wide)[1] - np.linalg.slogdet(V)[1])
            assert got.elpd[step, i] == pytest.approx(elpd, rel=1e-8)


def test_the_fold_that_leaves_a_particle_out_does_not_see_it():
    system, _ = random_campaign(9, particles=6)
    seen = []

    def choose(particles):
        seen.append(tuple(particles))
        return [np.array([], int)]

    held_out(system, choose)
    assert sorted(s for s in seen if len(s) == 5) == sorted(itertools.combinations(range(6), 5))


@pytest.mark.parametrize("left_out", [None, [0], [2, 5, 6], [0, 1, 2, 3, 4]])
@pytest.mark.parametrize("count", [0, 2])
def test_the_sum_over_particles_needs_no_particle(left_out, count):
    """What `project_summed` says from the sum of Gram matrices is what `project` says of the particles."""
    system, _ = random_campaign(5)
    inside = system.candidate_columns[:count]
    particles = None if left_out is None else np.setdiff1d(np.arange(7), left_out)
    whole = project(system, system.word_columns, inside=inside, particles=particles)
    found = project_summed(system.total(particles), system, system.word_columns, inside, 1e-4)
    np.testing.assert_allclose(found.drop, whole.gaussian**2, rtol=1e-9)
    np.testing.assert_allclose(found.residual, whole.residual.sum(), rtol=1e-10)
    # Two columns take away what they take away in the law.
    pairs = np.array([[0, 1], [5, 2]])
    both = project_summed(system.total(particles), system, system.word_columns, inside, 1e-4, pairs).of_both
    for drop, pair in zip(both, pairs, strict=True):
        U, among = whole.scores.sum(0)[pair], whole.information.sum(0)[np.ix_(pair, pair)]
        assert drop == pytest.approx(U @ np.linalg.solve(among, U), rel=1e-9)
    # A column that is inside already takes away nothing.
    one = np.array([[0, 1]])[: count // 2]
    again = project_summed(system.total(particles), system, inside, inside, 1e-4, one)
    np.testing.assert_array_equal(again.drop, np.zeros(count))
    np.testing.assert_array_equal(again.of_both, np.zeros(count // 2))
