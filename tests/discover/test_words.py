"""Words of formulas: their values, waves all at once, and artefacts of room and gauge that no mechanism explains."""

import dataclasses
import json
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from campaigns import campaign
from helpers import paper_law, paper_particle

from mcc_jax.campaign import Campaign, Curve
from mcc_jax.discover import discover
from mcc_jax.discover.dictionary import _since_turn, further_words, map_features, values_of, waves, words
from mcc_jax.discover.discrepancy import meanings
from mcc_jax.discover.linear_model import GLOBALS, System
from mcc_jax.effects import clean_record
from mcc_jax.law import signatures
from mcc_jax.plots import discovery_figures, save_figures

pytestmark = pytest.mark.long  # compiles for long

TIME = jnp.linspace(0.0, 260.0, 131)
FORCE = jnp.interp(TIME, jnp.asarray([0.0, 80, 110, 160, 230, 260]), jnp.asarray([0.0, 160, 160, 40, 180, 90]))
"""Loading to 80 s, a hold of 30 s, unloading to 160 s, reloading to 230 s, unloading."""


def context_of(particle):
    return paper_law().context(particle, clean_record(FORCE, TIME))


@eqx.filter_jit
def together(particle, chosen):
    return values_of(chosen, context_of(particle))


def test_words_of_one_form_computed_together_are_the_words_one_by_one():
    """In any order, among others."""
    whole = (*map_features(), *words())
    chosen = tuple(whole[i] for i in np.random.default_rng(0).permutation(len(whole))[:24])
    assert 1 < len({feature.form for feature in chosen}) < len(chosen)
    found = together(paper_particle(2), chosen)
    context = context_of(paper_particle(2))
    for values, feature in zip(found, chosen, strict=True):
        expected = jnp.broadcast_to(feature.form.value(context, jnp.asarray(feature.numbers)), FORCE.shape)
        np.testing.assert_allclose(values, expected, rtol=1e-12, atol=1e-12)


def test_no_features_are_no_rows():
    assert values_of((), context_of(paper_particle(2))).shape == (0, FORCE.size)


def test_every_word_is_finite_and_has_a_text_of_its_own():
    some = (*words(), *further_words())
    for number in (1, 6):
        assert np.isfinite(together(paper_particle(number), some)).all()
    texts = [word.text for word in some]
    assert len(set(texts)) == len(texts)
    assert {word.text for word in waves()} < set(texts)


def test_instruments_add_micrometres_whatever_the_size():
    """A wave in time is the same number of micrometres for a small particle and for a large one."""
    chosen = tuple(word for word in waves() if "pi t/" in word.text)[:6]
    small, large = (paper_particle(n) for n in (6, 16))
    assert large.effective_diameter > 2 * small.effective_diameter
    one, other = (np.asarray(together(p, chosen)) * float(p.effective_diameter) for p in (small, large))
    np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)
    # The first wave at its first maximum: 1 at D_e = 200 um.
    period = float(re.search(r"t/([\d.]+) s", chosen[0].text)[1])
    np.testing.assert_allclose(one[0], 200 * np.sin(2 * np.pi * TIME / period), atol=0.6)


def test_time_since_the_latest_reversal():
    """A hold belongs to the ramp before it; time begins anew at 110, 160 and 230 s."""
    since = np.asarray(_since_turn(context_of(paper_particle(2))))
    expected = np.asarray(TIME) - np.select([TIME > 230, TIME > 160, TIME > 110], [230.0, 160.0, 110.0], 0.0)
    # The reversal is noticed at the next point, two seconds later.
    assert np.all(np.abs(since - expected) <= 2.0)
    assert (np.diff(since) < 0).sum() == 3


def test_no_effects_have_no_signatures():
    rows = signatures(paper_law(), paper_particle(2), clean_record(FORCE, TIME), ())
    assert rows.shape == (0, FORCE.size)


def test_columns_of_waves_are_theirs():
    some = (*words()[:3], *waves()[:2])
    none = np.zeros(0)
    system = System(np.zeros((1, 1, 1)), none, (), map_features()[:2], some, none, none, none, none)
    start = 1 + len(GLOBALS) + 2
    np.testing.assert_array_equal(system.waves, [start + 3, start + 4])
    np.testing.assert_array_equal(system.quadratures, [[start + 3, start + 4]])
    # Half of a wave is none, nor is one in a formula, of which the phase is fitted.
    half = dataclasses.replace(system, words=(*some, waves()[2]), formula=(waves()[3],))
    np.testing.assert_array_equal(half.quadratures, system.quadratures)


def disturbed(added):
    """A campaign as the law says, with something added to what the gauge reads."""
    plain = campaign(seed=4)
    curves = tuple(Curve(c.time_s, c.force_mN, c.displacement_um + added(c)) for c in plain.curves)
    return Campaign(plain.particles, plain.diameters_um, curves, plain.columns, plain.metadata)


@pytest.mark.long
@pytest.mark.parametrize(
    ("added", "pattern", "period"),
    [
        (lambda c: 0.08 * np.sin(2 * np.pi * c.time_s / 41.0), r"pi t/([\d.]+) s", 41.0),
        # None is listed.
        (lambda c: 0.08 * np.cos(2 * np.pi * c.displacement_um / 7.9), r"pi gamma/([\d.]+) um", 7.9),
    ],
    ids=["air conditioning", "interpolation of the gauge"],
)
def test_a_wave_of_the_instrument_is_a_formula_with_its_period(added, pattern, period, tmp_path):
    found = discover(disturbed(added), experiments=False)
    assert found.verdict == "UNLISTED", found.summary
    seen = [float(p) for p in re.findall(pattern, found.closure.formula)]
    assert seen, found.closure.formula
    assert min(abs(p / period - 1) for p in seen) < 0.01
    # No name, no effect: what is written, drawn and told is about the formula.
    told = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert told["effects"] == told["candidate_set"] == []
    assert told["closure"]["formula"] in told["summary"]
    assert [step["added"] for step in told["gap"]["steps"]] == [None, "formula"]
    assert told["gap"]["closed_fraction"] > 0.8
    left = found.residuals
    assert np.sum(left.white_after**2) < 0.9 * np.sum(left.white_before**2)
    files = save_figures(discovery_figures(found), tmp_path, dpi=80)
    assert {file.stem for file in files} >= {"discovery_before_after", "discovery_gap", "discovery_where"}


def test_a_formula_says_what_its_letters_mean_and_no_others():
    """The s of seconds is no stress."""
    for texts, letters in (
        (["q^1", "s^0.5"], ["q", "s"]),
        (["(cos(2 pi t/41.7 s) - 1) h"], ["t", "h"]),
        (["exp(-r/3 s) h", "sin(2 pi gamma/7.69 um) h"], ["gamma", "r", "h"]),
        (["tanh((eps_P - 0.2)/0.02)", "max(0.5 - u, 0)"], ["u", "eps_P"]),
        (["[reload] 1"], []),
    ):
        assert [meaning.split(" = ")[0] for meaning in meanings(texts)] == letters


def test_every_letter_of_every_word_is_explained():
    functions = {"exp", "max", "tanh", "sin", "cos", "pi", "ln", "reload", "s", "um"}
    for word in (*words(), *further_words()):
        told = {meaning.split(" = ")[0] for meaning in meanings([word.text])}
        letters = set(re.findall(r"[A-Za-z]\w*", word.text)) - functions
        assert letters - {"D_e"} <= told, word.text
