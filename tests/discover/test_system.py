"""The linear system against differences of the real forward model; noise estimated without what is systematic."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from campaigns import campaign

from mcc_jax.calibrate import Model
from mcc_jax.campaign import THRESHOLD_MPA
from mcc_jax.discover.discrepancy import Closure
from mcc_jax.discover.legacy.fit import population_at
from mcc_jax.discover.legacy.forward import law_of, raw_residual
from mcc_jax.discover.legacy.population import moments
from mcc_jax.discover.linear_model import base_fit, build_system, signals_of, tails_of
from mcc_jax.discover.noise_estimation import refined, systematic
from mcc_jax.discover.normal_equations import BATCH, in_batches
from mcc_jax.discover.result import Discovery
from mcc_jax.discover.score import project
from mcc_jax.effects import LIBRARY, Mechanism

pytestmark = pytest.mark.long  # searches for effects for minutes; `.ci/run` does so once, as its users do

MODEL = Model(modulus_scatter=True)
CHOSEN = {"frame_compliance": "linear", "rate_dependence": "flow_log_strain_rate", "damage": "exponential"}
SMALL = {
    name: Mechanism(name, LIBRARY[name].explanation, (LIBRARY[name][variant],)) for name, variant in CHOSEN.items()
}
CHECKED = (0, 7)
"""Particles whose Gram matrices are compared."""


@pytest.fixture(scope="module")
def fitted():
    base = base_fit(campaign("frame_compliance=0.004"), MODEL, threshold_MPa=THRESHOLD_MPA)
    signals = signals_of(base, SMALL)
    return base, signals, build_system(base, signals)


@pytest.fixture(scope="module")
def whitened(fitted):
    """Residual, deviations, zero, population and formulas of all particles by differences, whitened."""
    base, signals, _ = fitted
    fit, tests, scatter = base.fit, base.tests, base.legacy_model.scatter
    population = population_at(fit.mode, fit.numbers, scatter)

    def mean_of(step):
        moved = eqx.tree_at(
            lambda p: (p.a, p.log_modulus, p.mu),
            population,
            (population.a + step[0], population.log_modulus + step[1], population.mu + step[2:]),
        )
        return moments(moved, tests.flatness, scatter)[0]

    residual = jax.jit(lambda latent, zero: raw_residual(latent, zero, tests, base.model.unloading))

    def slope(move, h):
        (w1, z1), (w0, z0) = move(h), move(-h)
        return (residual(w1, z1) - residual(w0, z0)) / (2 * h)

    mean, factor = moments(population, tests.flatness, scatter)
    own = [slope(lambda h, j=j: (fit.latent + h * factor[:, :, j], fit.zero), 1e-5) for j in range(4)]
    zero = slope(lambda h: (fit.latent, fit.zero + h), 1e-4)
    away = slope(lambda h: (fit.latent + h * (mean - fit.latent), fit.zero), 1e-5)
    back = (fit.zero - tests.contact)[:, None] * zero
    first = residual(fit.latent, fit.zero) + away - back

    def globally(j):
        return lambda h: (fit.latent + mean_of(jnp.zeros(5).at[j].set(h)) - mean_of(jnp.zeros(5)), fit.zero)

    by_population = [slope(globally(j), 1e-5) for j in range(5)]

    def with_effect(effect, amplitude):
        strong = eqx.tree_at(lambda e: e.amplitude, effect, amplitude)
        one = lambda w, p, r: law_of(w, base.model.unloading).with_effects(strong).respond(p, r)  # noqa: E731
        return jax.vmap(one)(fit.latent, tests.particle, base.records)

    formulas = []
    for c in signals.candidates:
        h = jnp.asarray(1e-5 * c.unit_amplitude)
        respond = jax.jit(lambda amplitude, effect=c.effect: with_effect(effect, amplitude))
        added = (respond(h) - respond(-h)) / 2e-5
        formulas.append(jnp.where(tests.mask, -added, 0.0))

    def white(column):
        return np.asarray(jax.vmap(lambda f, x: f(x))(fit.filters, column))

    inner = [white(c) for c in (*own, base.legacy_model.zero_sd * zero)]
    return np.stack(inner, 2), np.stack([white(c) for c in (first, *by_population, *formulas)], 2)


@pytest.mark.parametrize("particle", CHECKED)
def test_gram_matrices_are_those_of_the_forward_model(fitted, whitened, particle):
    system = fitted[2]
    Z, X = (v[particle] for v in whitened)
    dense = X.T @ np.linalg.solve(np.eye(len(Z)) + Z @ Z.T, X)
    got = system.gram[particle][: len(dense), : len(dense)]
    scale = np.sqrt(np.outer(np.diagonal(dense), np.diagonal(dense)))
    keep = np.diagonal(dense) > 1e-9 * np.diagonal(dense).max()
    assert keep.sum() == 9
    np.testing.assert_allclose((got / scale)[keep][:, keep], (dense / scale)[keep][:, keep], atol=2e-4)


def test_signals_are_differences_of_the_extended_law(fitted, whitened):
    base, signals, _ = fitted
    count = len(signals.candidates)
    mine = np.asarray(jax.vmap(lambda f, x: jax.vmap(f)(x))(base.fit.filters, jnp.where(
        base.tests.mask[:, None], signals.added, 0.0
    )))  # fmt: skip
    wanted = np.moveaxis(whitened[1][:, :, -count:], 1, 2)
    size = np.abs(wanted).max(axis=(0, 2), keepdims=True)
    np.testing.assert_allclose(mine / size, wanted / size, atol=1e-4)


def test_signals_are_found_by_the_system_s_columns(fitted):
    _, signals, system = fitted
    np.testing.assert_array_equal(signals.of(system.candidate_columns[1:3]), signals.added[:, 1:3])
    np.testing.assert_array_equal(signals.of(system.word_columns[:1])[:, 0], signals.seen[:, len(system.places)])


def test_system_is_symmetric_positive_and_counts_its_points(fitted):
    base, _, system = fitted
    np.testing.assert_allclose(system.gram, np.swapaxes(system.gram, 1, 2), rtol=1e-8, atol=1e-6)
    values = np.linalg.eigvalsh(system.gram / np.abs(system.gram).max())
    assert values.min() > -1e-9
    np.testing.assert_array_equal(system.points, np.asarray(base.tests.mask).sum(1))
    assert system.usable.all()
    assert len(system.gram[0]) == system.word_columns[-1] + 1


def test_noise_is_what_it_would_be_if_nothing_were_hidden(fitted):
    """Hidden compliance looks like correlated noise and scatter; taken off, both are as in the campaign without it."""
    base, signals, system = fitted
    plain = base_fit(campaign(), MODEL, threshold_MPa=THRESHOLD_MPA)
    better, changed = refined(base, system, signals)
    assert changed
    again, _ = refined(better, build_system(better, signals), signals)
    for name in ("displacement", "force", "correlated", "length"):
        hidden, restored, true = (float(getattr(b.fit.noise, name)) for b in (base, again, plain))
        assert abs(np.log(restored / true)) < 0.3, name
        assert abs(np.log(restored / true)) <= abs(np.log(hidden / true)) + 0.02, name
    np.testing.assert_allclose(again.fit.noise.scale, plain.fit.noise.scale, rtol=0.1)

    def scatter(b):
        population = population_at(b.fit.mode, b.fit.numbers, b.legacy_model.scatter)
        return float(population.modulus_scatter), *np.asarray(population.tau).tolist()

    assert scatter(base)[0] > 0.1
    assert scatter(again)[0] < 0.05
    np.testing.assert_allclose(scatter(again)[1:], scatter(plain)[1:], atol=0.01)
    np.testing.assert_array_equal(better.fit.latent, base.fit.latent)


def test_nothing_is_taken_off_where_nothing_is_hidden():
    plain = base_fit(campaign(seed=1), MODEL, threshold_MPa=THRESHOLD_MPA)
    signals = signals_of(plain, SMALL)
    system = build_system(plain, signals)
    columns, _ = systematic(system)
    assert len(columns) <= 1
    if not len(columns):
        same, changed = refined(plain, system, signals)
        assert same is plain
        assert not changed


@pytest.mark.parametrize("count", [1, BATCH - 1, BATCH, BATCH + 3, 2 * BATCH])
def test_batches_give_what_all_together_give(count):
    rng = np.random.default_rng(count)
    rows = (jnp.asarray(rng.normal(size=(count, 3))), {"b": jnp.asarray(rng.normal(size=count))})
    sizes = []

    def one(a, tree):
        sizes.append(len(a))
        return a * tree["b"][:, None], tree["b"] ** 2

    first, second = in_batches(one, rows)
    assert set(sizes) == {BATCH}
    np.testing.assert_array_equal(first, np.asarray(rows[0]) * np.asarray(rows[1]["b"])[:, None])
    np.testing.assert_array_equal(second, np.asarray(rows[1]["b"]) ** 2)


def test_all_points_of_loading_count_at_a_threshold_of_zero(fitted):
    base, *_ = fitted
    whole = base_fit(base.campaign, MODEL, threshold_MPa=0.0)
    loading = np.asarray(whole.tests.loading)
    assert (np.asarray(whole.tests.mask) & loading).sum() > (np.asarray(base.tests.mask) & loading).sum()
    stress = (
        np.asarray(whole.tests.force) / (np.pi / 4 * np.asarray(whole.tests.effective_diameter)[:, None] ** 2) * 1e3
    )
    counted = stress[np.asarray(whole.tests.mask) & loading]
    assert 0 < counted.min() < THRESHOLD_MPA


def test_the_correction_of_a_formula_stands_at_the_rows_of_the_tests(fitted):
    base, signals, system = fitted
    words, coefficients = system.word_columns[[1, 4]], np.array([2e-3, -1e-3])
    formula = tuple(system.word(int(w)) for w in words)
    with_formula = signals.with_formula(base, (*formula, formula[0]), -signals.of(np.append(words, words[0])))
    system = build_system(base, with_formula)
    # The formula that tests 0 and 3 are judged by has the first word only.
    folds = ((np.array([0, 3]), system.formula_columns[2:]),)
    closure = Closure(system.formula_columns[:2], coefficients, coefficients, "", 0.0, 1.0, (), {}, folds)
    answer = SimpleNamespace(base=base, system=system, closure=closure)
    found = Discovery.correction_um(answer)
    assert list(found) == list(base.campaign.particles)
    # What is added to the prediction is taken off the residual.
    residual = np.einsum("w,nwp->np", coefficients, np.asarray(signals.of(words)))
    for i, (rows, curve) in enumerate(zip(base.selection.rows, base.campaign.curves, strict=True)):
        whole = found[base.campaign.particles[i]]
        assert len(whole) == len(curve)
        np.testing.assert_allclose(whole[rows], -residual[i, : len(rows)], rtol=1e-12)
        assert np.isnan(np.delete(whole, rows)).all()
    apart = Discovery.correction_um(answer, held_out=True)
    others = np.setdiff1d(np.arange(len(base.tests)), [0, 3])
    own = project(system, words[:0], inside=system.formula_columns[2:], particles=others).theta[-1]
    for i, rows in enumerate(base.selection.rows):
        name = base.campaign.particles[i]
        one = -own * np.asarray(signals.of(words))[i, 0, : len(rows)]
        np.testing.assert_allclose(apart[name][rows], one if i in (0, 3) else found[name][rows], rtol=1e-8, atol=1e-12)
    assert Discovery.correction_um(SimpleNamespace(base=base, system=system, closure=None)) == {}


@pytest.mark.parametrize(("freedom", "low", "high"), [(4, 3.2, 5.0), (6, 4.8, 8.0), (np.inf, 25.0, np.inf)])
def test_tails_of_noise_are_found(freedom, low, high):
    rng = np.random.default_rng(3)
    white = 0.7 * (rng.standard_normal(6000) if np.isinf(freedom) else rng.standard_t(freedom, 6000))
    assert low <= tails_of(white) <= high
    # One jump in every test is no heavy tail.
    jumping = white.copy()
    jumping[::300] = 15.0
    assert tails_of(jumping) >= 0.75 * min(tails_of(white), 30.0)


def test_simulated_noise_is_normal(fitted):
    assert fitted[2].tails > 15
