"""Formulas with fitted numbers: derivatives of the words, numbers that were planted, folds and resamples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from campaigns import campaign

from mcc_jax.calibrate import Model
from mcc_jax.campaign import Campaign, Curve
from mcc_jax.discover import dictionary as words
from mcc_jax.discover.discrepancy import FOLDS, find_closure
from mcc_jax.discover.forward_selection import pursue
from mcc_jax.discover.linear_model import base_fit, build_system, feature_values, signals_of
from mcc_jax.discover.model_selection import chooser
from mcc_jax.discover.score import project
from mcc_jax.discover.variable_projection import MAX_NUMBERS, Fitted, Tuner
from mcc_jax.effects import LIBRARY, Mechanism

pytestmark = pytest.mark.long  # compiles for long

LISTED = {"frame_compliance": Mechanism("frame_compliance", "", LIBRARY["frame_compliance"].variants[:1])}
PLANTED = words.STRAIN_BUMP.at(0.123, 0.021)
"""Between the places and narrower than any of the list."""

AMOUNT = 2e-3


def systems(whole):
    base = base_fit(whole, Model(modulus_scatter=True), threshold_MPa=0.0)
    signals = signals_of(base, LISTED)
    return base, signals, build_system(base, signals)


@pytest.fixture(scope="module")
def clean():
    return systems(campaign(seed=8))


@pytest.fixture(scope="module")
def disturbed(clean):
    """The same campaign with a bump on the law's strain so far."""
    base, _, _ = clean
    plain, added = base.campaign, AMOUNT * np.asarray(feature_values(base, (PLANTED,)))[:, 0]
    curves = list(plain.curves)
    for i, rows, more in zip(base.selection.kept, base.selection.rows, added, strict=True):
        displacement = np.array(curves[i].displacement_um)
        displacement[rows] += more[: len(rows)]
        curves[i] = Curve(curves[i].time_s, curves[i].force_mN, displacement)
    return systems(Campaign(plain.particles, plain.diameters_um, tuple(curves), plain.columns, plain.metadata))


@pytest.fixture(scope="module")
def tuner(disturbed):
    return Tuner(*disturbed)


@pytest.fixture(scope="module")
def found(disturbed):
    base, signals, system = disturbed
    return find_closure(base, signals, system, {}, 0)


def test_every_form_has_as_many_numbers_as_ranges_and_starts_within():
    for word in (*words.words(), *words.further_words()):
        assert len(word.numbers) == len(word.form.low) == len(word.form.high) <= MAX_NUMBERS
        for low, number, high in zip(word.form.low, word.numbers, word.form.high, strict=True):
            assert low <= number <= high, word.text


@pytest.mark.long
def test_derivatives_by_the_numbers_are_differences(tuner):
    """One word of each form, where it is smooth."""
    for form in {word.form: word for word in (*words.words(), *words.further_words())}.values():
        if not form.numbers or form.form in (words.KINK, words.STRAIN_KINK, words.RELEASED_KINK):
            continue
        # Away from the ends of the ranges, where powers begin.
        numbers = np.asarray(form.numbers) + 0.07 * np.minimum(np.asarray(form.form.high) - form.numbers, 1.0)
        columns = np.asarray(tuner._rows.word(form.form.at(*map(float, numbers))))
        for k in range(len(numbers)):
            h = 1e-6 * np.eye(len(numbers))[k]
            ahead, behind = (tuner._rows.word(form.form.at(*map(float, numbers + s * h)))[:, 0] for s in (1, -1))
            slope = (np.asarray(ahead) - np.asarray(behind)) / 2e-6
            size = np.max(np.abs(slope)) + 1e-3 * np.max(np.abs(columns[:, 0]))
            np.testing.assert_allclose(columns[:, 1 + k], slope, atol=1e-4 * size, err_msg=form.text)


def test_derivatives_are_finite_at_the_ends_of_the_ranges(tuner):
    for word in {word.form: word for word in (*words.words(), *words.further_words())}.values():
        for numbers in (word.form.low, word.form.high):
            assert np.isfinite(np.asarray(tuner._rows.word(word.form.at(*numbers)))).all(), word.form.at(*numbers).text


def test_a_planted_bump_is_found_with_its_place_and_width(tuner, disturbed):
    usable = np.flatnonzero(disturbed[2].usable)
    formula = tuner.search(usable)
    assert len(formula.words) == 1
    (word,) = formula.words
    assert word.form is words.STRAIN_BUMP
    np.testing.assert_allclose(word.numbers, PLANTED.numbers, rtol=0.06)
    # Better than any word of the list, and than the nearest of its kind.
    near = words.STRAIN_BUMP.at(0.1, 0.03)
    both = np.abs(tuner.cosines((word, near, PLANTED), usable))
    assert both[0, 2] > 0.99 > both[0, 1]
    assert both[0, 0] == pytest.approx(1.0)


@pytest.mark.long
def test_gains_are_those_of_the_linear_system(tuner, disturbed, found):
    """Compared in another space, the formula explains as much."""
    closure, system = found
    usable = np.flatnonzero(system.usable)
    formula = tuner.search(usable)
    assert tuple(system.word(int(c)) for c in closure.words) == formula.words
    by_hand = project(system, np.array([], int)).residual.sum()
    by_hand -= project(system, np.array([], int), inside=closure.words).residual.sum()
    assert closure.gain == pytest.approx(by_hand)
    # But for what keeps its size modest.
    assert formula.gain <= closure.gain < 1.1 * formula.gain
    np.testing.assert_allclose(closure.coefficients, AMOUNT, rtol=0.15)
    assert abs(closure.coefficients[0] - AMOUNT) < 4 * closure.sd[0]
    at_all = np.where(disturbed[0].tests.mask[:, None], feature_values(disturbed[0], formula.words), 0.0)
    np.testing.assert_allclose(tuner.values(formula.words), at_all, rtol=1e-9)


def test_the_system_keeps_its_columns_and_gets_those_of_the_formula(disturbed, found):
    _, signals, system = disturbed
    closure, extended = found
    before = len(system.gram[0])
    np.testing.assert_allclose(extended.gram[:, :before, :before], system.gram, rtol=1e-9, atol=1e-9)
    assert len(extended.formula_columns) == len(extended.gram[0]) - before == len(extended.formula)
    np.testing.assert_array_equal(extended.word_columns, system.word_columns)
    np.testing.assert_array_equal(extended.looked_at()[0], system.looked_at()[0])
    assert len(signals.seen[0]) == before - 1 - len(system.globals) - len(system.candidates)
    assert closure.selection_frequency > 0.8


def test_every_particle_is_judged_by_a_formula_found_without_it(found):
    closure, system = found
    usable = np.flatnonzero(system.usable)
    assert len(closure.folds) == FOLDS
    np.testing.assert_array_equal(np.sort(np.concatenate([group for group, _ in closure.folds])), usable)
    choose = chooser(system, 0, closure)
    np.testing.assert_array_equal(choose(usable)[1], closure.words)
    for group, columns in closure.folds:
        assert not np.isin(columns, closure.words).any()
        np.testing.assert_array_equal(choose(usable[usable != group[0]])[1], columns)
        for column in columns:
            assert system.word(int(column)).form is words.STRAIN_BUMP


@pytest.mark.long
def test_the_same_seed_makes_the_same_formula(disturbed, found):
    again, _ = find_closure(*disturbed, {}, 0)
    assert again.formula == found[0].formula
    assert again.selection_frequency == found[0].selection_frequency


def test_a_gap_without_a_word_worth_its_numbers_has_the_listed_words(disturbed, monkeypatch):
    base, signals, system = disturbed
    monkeypatch.setattr(Tuner, "search", lambda self, particles: Fitted())
    closure, extended = find_closure(base, signals, system, {}, 0)
    assert [extended.word(int(c)) for c in closure.words] == [system.word(c) for c in pursue(system)[0]]
    assert closure.gain == pytest.approx(pursue(system)[1])
    assert closure.selection_frequency == 0
    usable = np.flatnonzero(system.usable)
    assert all(len(chooser(extended, 0, closure)(usable[usable != i])[1]) == 0 for i in usable)


def test_nothing_is_found_where_nothing_is_missing(clean):
    base, signals, system = clean
    assert Tuner(*clean).search(np.flatnonzero(system.usable)) == Fitted()
    closure, same = find_closure(base, signals, system, {}, 0)
    assert closure is None
    assert same is system


def test_words_add_up_to_what_the_law_adds(tuner):
    """Their values in micrometres: strain times the effective diameter, 0 where nothing was measured."""
    (values,) = np.moveaxis(np.asarray(tuner.values((words.PEAK_POWER.at(1.0),))), 1, 0)
    contexts, mask = tuner._rows.seen
    diameter = np.asarray(jax.vmap(lambda particle: particle.effective_diameter)(contexts.particle))[:, None]
    expected = diameter * np.maximum(np.asarray(contexts.peak_force) / (np.pi / 4 * diameter**2) * 1e3 / 10, 1e-9)
    np.testing.assert_allclose(values, np.where(np.asarray(mask), expected, 0.0), rtol=1e-9)


@pytest.mark.long
def test_powers_are_finite_where_there_is_no_load():
    """With derivatives, of all forms, at the start of a test."""
    from helpers import paper_law, paper_particle

    from mcc_jax.effects import clean_record

    record = clean_record(jnp.asarray([0.0, 0.0, 10.0, 0.0, 5.0]), jnp.arange(5.0))
    context = paper_law().context(paper_particle(2), record)
    for word in {word.form: word for word in (*words.words(), *words.further_words())}.values():
        numbers = jnp.asarray(word.numbers, float)
        slope = jax.jacfwd(lambda n, word=word: word.form.value(context, n) * jnp.ones(5))(numbers)
        assert np.isfinite(np.asarray(slope)).all(), word.text
