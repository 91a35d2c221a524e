"""Sudden steps at any point of first loading: their algebra, where they are found, and that noise is none."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from campaigns import MODEL, campaign
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm
from scipy.stats import t as student

from mcc_jax.campaign import Campaign
from mcc_jax.discover import discover
from mcc_jax.discover.evidence import evidence_of_steps, jumps, random_probability
from mcc_jax.discover.legacy.fit import population_at
from mcc_jax.discover.legacy.population import moments
from mcc_jax.discover.linear_model import base_fit, build_system, first_loaded, signals_of
from mcc_jax.discover.pop_in import ODD, over_tests, tamed
from mcc_jax.discover.score import project
from mcc_jax.effects import LIBRARY

pytestmark = pytest.mark.long  # compiles for long

BREAKING = {name: LIBRARY[name] for name in ("pop_in", "frame_compliance")}
BROKEN = {2: (0.8, 0.8), 7: (0.65, 0.6)}
"""Test: share of the largest force at which it jumps, by how much [um]."""


def place_of(curve, share):
    return int(np.argmax(curve.force_mN >= share * curve.force_mN.max()))


def with_jumps(whole, broken):
    curves = list(whole.curves)
    for i, (share, size) in broken.items():
        later = np.arange(len(curves[i])) >= place_of(curves[i], share)
        curves[i] = replace(curves[i], displacement_um=curves[i].displacement_um + size * later)
    return Campaign(whole.particles, whole.diameters_um, tuple(curves), whole.columns, whole.metadata)


def system_of(whole):
    base = base_fit(whole, MODEL, threshold_MPa=0.0)
    system = build_system(base, signals_of(base, BREAKING))
    return base, system, project(system, system.candidate_columns)


@pytest.fixture(scope="module")
def broken():
    return system_of(with_jumps(campaign(), BROKEN))


@pytest.fixture(scope="module")
def whole():
    return system_of(campaign())


@pytest.mark.parametrize("particle", [0, 7])
def test_steps_are_columns_like_any_other(broken, particle):
    """Against dense matrices: the particle's own parameters integrated out of whitened steps."""
    base, system, _ = broken
    fit, tests, scatter = base.fit, base.tests, base.legacy_model.scatter
    data = base.linear()
    _, factor = moments(population_at(fit.mode, fit.numbers, scatter), tests.flatness, scatter)
    white = jax.tree.map(lambda leaf: leaf[particle], fit.filters)
    J, S = np.asarray(data.jacobian[particle]), np.asarray(factor[particle])
    own = np.column_stack([J[:, :4] @ S, float(base.legacy_model.zero_sd) * J[:, 4]])
    used = np.asarray(tests.mask[particle])
    first = np.asarray(first_loaded(tests))[particle]
    count = len(used)
    step = -5.0 * np.tril(np.ones((count, count))) * used[:, None] * first[None]
    Z, D = (np.asarray(jax.vmap(white)(jnp.asarray(columns.T))).T for columns in (own, step))
    M = np.linalg.inv(np.eye(len(Z)) + Z @ Z.T)
    steps = system.steps
    np.testing.assert_allclose(steps.among[particle], D.T @ M @ D, atol=1e-6 * np.abs(D.T @ M @ D).max())
    added = signals_of(base, BREAKING).of(system.candidate_columns[-1:])[particle, 0]
    frame = np.asarray(white(jnp.where(tests.mask[particle], added, 0.0)))
    wanted = D.T @ M @ frame
    np.testing.assert_allclose(
        steps.cross[particle][:, system.candidate_columns[-1]], wanted, atol=1e-6 * np.abs(wanted).max()
    )
    assert np.isnan(steps.stress[particle][~first]).all()
    force = np.asarray(tests.force)[particle]
    assert force[used].max() == force[used & first].max()
    assert first.sum() > 30


def test_jumps_are_found_where_they_are(broken):
    base, system, view = broken
    assert evidence_of_steps(system, view) > 3
    assert random_probability(system, view, 0) <= 0.01
    found = {jump.particle: jump for jump in jumps(system, view)}
    assert set(found) == set(BROKEN)
    for i, (share, size) in BROKEN.items():
        jump = found[i]
        at = place_of(base.campaign.curves[i], share)
        assert abs(5 * jump.size - size) < 4 * 5 * jump.sd
        rows = base.selection.rows[i]
        place = int(np.searchsorted(rows, at))
        around = system.steps.stress[i][max(place - 2, 0) : place + 3]
        assert np.nanmin(around) <= jump.stress_MPa <= np.nanmax(around)
        assert jump.probability > 0.9


def test_noise_does_not_jump(whole):
    _, system, view = whole
    assert evidence_of_steps(system, view) < 1
    assert random_probability(system, view, 0) > 0.01
    assert jumps(system, view) == ()


def test_a_test_whose_noise_is_larger_than_modelled_does_not_jump(broken):
    _, system, view = broken
    assert evidence_of_steps(system, view, np.full(10, 4.0)) < evidence_of_steps(system, view) - 3


def test_where_nobody_looks_for_steps_there_are_none(broken):
    _, system, view = broken
    blind = replace(system, steps=None)
    assert evidence_of_steps(blind, view) == -np.inf
    assert jumps(blind, view) == ()


def test_evidence_of_noise_alone_is_drawn_as_it_is(whole):
    """One in ten of other draws of noise exceeds the largest tenth."""
    _, system, view = whole
    drawn = system.steps.drawn_evidence(view.particles, 400, np.random.default_rng(1))
    values, vectors = np.linalg.eigh(system.steps.among[view.particles])
    factor = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    rng = np.random.default_rng(2)
    scores = [np.einsum("nlk,nk->nl", factor, rng.standard_normal(factor.shape[::2])) for _ in range(200)]
    other = np.array([float(system.steps.evidence(s, view.particles)) for s in scores])
    assert 0.04 < np.mean(other > np.quantile(drawn, 0.9)) < 0.18


def test_an_answer_tells_each_jump():
    found = discover(
        with_jumps(campaign(), BROKEN), library=BREAKING, confirm=False, experiments=False, posterior=False
    )
    assert found.verdict == "NAMED"
    (effect,) = found.effects
    assert effect.mechanism == "pop_in"
    assert effect.amplitude == pytest.approx(0.7, abs=0.15)
    assert sorted(np.flatnonzero(effect.by_particle)) == sorted(BROKEN)
    told = {jump["particle"]: jump for jump in found.to_json()["effects"][0]["jumps"]}
    assert set(told) == {found.base.campaign.particles[i] for i in BROKEN}
    for i, (_, size) in BROKEN.items():
        one = told[found.base.campaign.particles[i]]
        assert abs(one["size_um"] - size) < 4 * one["sd_um"]
    assert "jumps by" in found.summary


# ---- statistics ------------------------------------------------------------------------------------------------------


@given(z=st.floats(-30, 30), tails=st.floats(2.5, 100.0))
def test_deviates_of_tailed_noise_shrink_to_their_probability(z, tails):
    small = float(tamed(np.array(z), tails))
    assert small * z >= 0
    assert abs(small) <= abs(z)
    wanted = student.logsf(abs(z) * np.sqrt(tails / (tails - 2)), tails)
    kept = max(wanted, np.log(1e-300), norm.logsf(abs(z)))
    assert norm.logsf(abs(small)) == pytest.approx(kept, rel=1e-6, abs=1e-9)
    assert float(tamed(np.array(z), np.inf)) == z


def test_one_test_alone_proves_little_of_all():
    calm, one, all_of_them = np.full((20, 1), -2.0), np.full((20, 1), -2.0), np.full((20, 1), 5.0)
    one[3] = 80.0
    values = [float(over_tests(v, (1.0,), ODD)) for v in (calm, one, all_of_them)]
    assert values[1] < values[0] + np.log(1 / ODD) + 2.1
    assert values[2] > 50


@given(share=st.floats(0.01, 0.9), seed=st.integers(0, 1000))
def test_shares_of_tests_are_mixtures(share, seed):
    ratio = np.random.default_rng(seed).normal(size=(6, 3))
    mixed = (1 - share) + share * np.exp(ratio)
    product = np.prod(1 / (ODD + (1 - ODD) / mixed), axis=0)
    assert float(over_tests(ratio, (share,), ODD)) == pytest.approx(float(np.log(product.mean())), abs=1e-10)
    several = np.prod(1 / (ODD + (1 - ODD) / np.stack([mixed, np.exp(ratio)])), axis=1)
    assert float(over_tests(ratio, (share, 1.0), ODD)) == pytest.approx(float(np.log(several.mean())), abs=1e-10)
