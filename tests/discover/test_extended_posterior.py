"""The posterior of the extended law: its summaries are those of the shifted tests, and it holds the truth."""

import json
import sys
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from campaigns import cached, refined_system

from mcc_jax.discover import discover
from mcc_jax.discover.extensions import Extensions
from mcc_jax.discover.legacy.draws import Length
from mcc_jax.discover.legacy.linearise import linear_data, summarise
from mcc_jax.discover.posterior import _movable, extended_posterior
from mcc_jax.effects import LIBRARY

pytestmark = pytest.mark.long  # compiles for long

HIDDEN = 0.004
FRAME = {"frame_compliance": LIBRARY["frame_compliance"]}


@pytest.fixture(scope="module")
def extended():
    """Base fit and fit of the extended law of tests with a compliant frame."""
    base, signals, system = refined_system(cached(f"frame_compliance={HIDDEN}"), FRAME)
    return base, Extensions(base, system, signals).fit((0,))


@pytest.fixture(scope="module")
def posterior(extended):
    return extended_posterior(*extended)


@pytest.mark.long
def test_moved_summaries_are_those_of_moved_residuals(extended):
    base, found = extended
    fit, tests, state, zero_sd = base.fit, base.tests, found.state, base.legacy_model.zero_sd
    data = linear_data(fit.latent, fit.zero, tests, zero_sd, base.model.unloading)

    def at(residual):
        moved = eqx.tree_at(lambda d: (d.residual, d.jacobian), data, (residual, found.jacobian))
        return summarise(state.latent, state.zero, tests, moved, fit.noise, zero_sd)

    summary, filters, _ = at(found.residual)
    away = state.zero - tests.contact
    movable = _movable(summary, state.theta, found.residual, found.jacobian, found.columns, filters, away, zero_sd)
    change = jnp.asarray([0.1])
    expected, _, _ = at(found.residual + jnp.einsum("nsp,s->np", found.columns, change))
    moved = movable.at(state.theta + change)
    for name in ("point", "precision", "score", "squares", "count", "zero", "zero_slope", "zero_sd"):
        one, other = (np.asarray(getattr(s, name)) for s in (moved, expected))
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max(), err_msg=name)
    assert not np.allclose(moved.score, summary.score, rtol=1e-3)


def test_it_converges_and_holds_the_truth(posterior):
    assert posterior.failures() == []
    assert posterior.pareto_k_joint < 0.7
    amplitude = posterior.effect_draws(0)["compliance_um_per_mN"]
    assert amplitude.shape == (4, 1000)
    assert abs(amplitude.mean() - HIDDEN) < 4 * amplitude.std()
    assert amplitude.std() < 0.05 * HIDDEN
    found = posterior.parameters()
    for name, truth in (("a", 1.43), ("effective_modulus_MPa", 16_000.0)):
        assert abs(found[name]["value"] - truth) < 4 * found[name]["sd"], found[name]
    assert json.dumps(posterior.to_json(), allow_nan=False)


def test_it_agrees_with_the_fit_it_started_from(extended, posterior):
    _, found = extended
    own, spread = found.own(0)[0], found.spread(0)[0]
    amplitude = posterior.effect_draws(0)["compliance_um_per_mN"] / found.formulas[0].variant.plausible[1]
    assert abs(amplitude.mean() - own) < spread
    assert 0.5 < amplitude.std() / spread < 2


@pytest.mark.long
def test_the_same_seed_gives_the_same_draws_and_few_draws_are_told(extended, posterior):
    again = extended_posterior(*extended)
    np.testing.assert_array_equal(again.population.theta, posterior.population.theta)
    short = extended_posterior(*extended, length=Length(4, 20, 20), seed=1)
    assert any("ESS" in failure for failure in short.failures())


def test_an_impossible_sign_is_not_sampled_but_told(monkeypatch):
    fit = Extensions.fit

    def turned(self, chosen):
        found = fit(self, chosen)
        return replace(found, state=eqx.tree_at(lambda s: s.theta, found.state, -found.state.theta))

    monkeypatch.setattr(
        sys.modules[discover.__module__], "LARGE", np.inf
    )  # named to first order; the fit as it is comes with the posterior
    monkeypatch.setattr(Extensions, "fit", turned)
    found = discover(cached(f"frame_compliance={HIDDEN}"), library=FRAME, confirm=False, experiments=False)
    assert [effect.mechanism for effect in found.effects] == ["frame_compliance"]
    assert found.effects[0].amplitude > 0
    assert found.posterior is None
    assert any("not sampled" in note for note in found.notes)
