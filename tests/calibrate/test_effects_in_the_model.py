"""An effect hidden in a campaign, and in the law that is fitted: recovered, preferred, saved, read, driven."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

import mcc_jax as mcc
from mcc_jax.calibrate.forward import Linearisation, Point, coordinates, residuals
from mcc_jax.calibrate.marginal import straighten, with_products
from mcc_jax.calibrate.running import Blocks
from mcc_jax.effects import find_variant

pytestmark = pytest.mark.extended

CREEP, AMPLITUDE, TAU_S = "creep:logarithmic", 2e-4, 3.0


def creeping(tau_s, amplitude=AMPLITUDE, noise_um=0.08):
    """Eight particles that creep, loaded twice with a hold at each peak; as long as those of other modules.

    The law without effects is then compiled once for all.
    """
    programme = mcc.Programme.cycles(levels=(0.5, 1.0), hold_s=10.0, points=240)
    hidden = mcc.HiddenEffect(find_variant(CREEP), amplitude, {"tau_s": tau_s})
    instrument = mcc.Instrument(displacement_noise_um=noise_um, force_noise_mN=0.05)
    whole = mcc.paper_campaign(0, programme=programme, instrument=instrument, effects=[hidden])
    return whole.without(*whole.particles[8:])


@pytest.fixture(scope="module")
def campaign():
    return creeping(TAU_S)


@pytest.fixture(scope="module")
def posterior(campaign):
    return mcc.sample(campaign, mcc.Model().with_effects(CREEP), seed=0)


def test_amplitude_time_and_modulus_are_recovered(posterior):
    assert posterior.converged, posterior.failures()
    named = posterior.named_population()
    truth = {"creep": AMPLITUDE, "creep.tau_s": TAU_S, "effective_modulus_MPa": 16_000.0, "a": 1.43}
    for name, value in truth.items():
        assert abs(named[name].mean() - value) < 4 * named[name].std(), name
    assert named["creep"].std() < 0.1 * AMPLITUDE


def test_strong_creep_with_a_time_far_from_the_priors_is_found():
    """Undamped steps leave for times of 1e-5 s and 1e5 s in turn, and end in numbers that overflow."""
    fit = mcc.fit(creeping(0.1), mcc.Model().with_effects(CREEP))
    assert fit.converged.all()
    np.testing.assert_allclose(fit.population.theta, [AMPLITUDE, 0.1], rtol=0.15)


def test_what_did_not_come_to_rest_is_told_from_what_does_not_fit(posterior):
    """A misfit as small as the noise is no misfit, however large a factor on the noise has become."""
    fit = replace(posterior.fit, converged=np.array([True, True, False]))
    assert "did not come to rest" in replace(posterior, fit=fit).failures()[0]
    astray = replace(posterior, fit=replace(fit, residual=10 * fit.residual))
    assert "no population was found that fits these tests" in astray.failures()[0]


def second_order_misses(posterior, sd, away):
    """What of a change of all numbers the columns leave, and what columns and bends leave, over the change."""
    fit, model = posterior.fit, posterior.model
    linearisation = Linearisation(fit.tests, model.forms, model.scatter.positive, Blocks(len(fit.tests)))
    linear = linearisation.at(fit.point, sd)
    latent, theta = fit.point.latent + away[None, :4], fit.point.theta * jnp.exp(away[4:])[None]
    moved = residuals(Point(latent, fit.point.zero, theta), fit.tests, model.forms)
    straight, _ = straighten(jnp.broadcast_to(away[:4], latent.shape))
    there = partial(coordinates, places=model.scatter.positive)
    u = jnp.concatenate([straight, jax.vmap(there)(theta, fit.point.theta, linearisation.straight)[0]], 1)
    u2, _ = with_products(u, jnp.zeros((*u.shape, 1)))
    change = np.asarray(linear.residual - moved)
    first = change - np.einsum("npq,nq->np", linear.columns, u)
    second = change - np.einsum("npq,nq->np", np.concatenate([linear.columns, linear.bends], -1), u2)
    return tuple(float(np.sqrt(np.mean(x**2) / np.mean(change**2))) for x in (first, second))


def test_tests_bend_with_the_effects_numbers(posterior):
    """To second order in creep and its time, and in each of them with the particle's own numbers."""
    named = posterior.named_population()
    sd = np.array([named["creep"].std(), np.log(named["creep.tau_s"]).std()])
    away = np.array([0.001, 0.0005, -0.0005, 0.002, 2 * sd[0] / AMPLITUDE, 2 * sd[1]])
    first, second = second_order_misses(posterior, sd, away)
    assert second < 0.3 * first


def test_creep_beyond_the_record_is_drawn_as_widely_as_tests_leave_it_open():
    """Amplitude over time is known, the time is not: a ridge over a decade, without a divergence."""
    far = creeping(1000.0, 100 * AMPLITUDE, 0.02)
    posterior = mcc.sample(far, mcc.Model().with_effects(CREEP), seed=0)
    named = posterior.named_population()
    for name, truth in (("creep", 100 * AMPLITUDE), ("creep.tau_s", 1000.0), ("effective_modulus_MPa", 16_000.0)):
        low, high = np.quantile(named[name], [0.005, 0.995])
        assert low < truth < high, name
    assert posterior.divergences == 0
    ratio = np.log(named["creep"] / named["creep.tau_s"])
    assert ratio.std() < 0.3 * np.log(named["creep.tau_s"]).std()


def test_a_posterior_that_begins_at_a_fit_is_the_same(campaign, posterior):
    again = mcc.sample(campaign, posterior.model, start=posterior.fit)
    assert again.converged
    named = posterior.named_population()
    for name, draws in again.named_population().items():
        assert abs(draws.mean() - named[name].mean()) < 0.1 * named[name].std() + 1e-12, name
    with pytest.raises(mcc.InputError, match="start is of other particles or effects"):
        mcc.sample(campaign, start=posterior.fit)


def test_a_particle_left_out_is_less_probable_than_one_that_was_seen(campaign, posterior):
    """The expected log density is ArviZ' leave-one-out, by particle, and below that of the tests themselves."""
    each = posterior.log_likelihood.reshape(-1, len(posterior.particles))
    elpd = mcc.compare(campaign, [posterior])["elpd"].iloc[0]
    exact = -(logsumexp(-each, axis=0) - np.log(len(each))).sum()
    assert elpd == pytest.approx(exact, abs=1.0)
    assert elpd < (logsumexp(each, axis=0) - np.log(len(each))).sum()


def test_models_are_compared_by_evidence_and_by_particles_left_out(campaign, posterior):
    table = mcc.compare(campaign, [mcc.Model(), posterior])
    base, with_creep = table.to_dict("records")
    assert with_creep["log_evidence"] - base["log_evidence"] > 50
    assert base["elpd_difference"] < -5 * base["elpd_difference_error"] < 0
    assert base["noise_share"] > 0.5 > with_creep["noise_share"]
    assert base["chi2_per_point"] > 2 > with_creep["chi2_per_point"]


def test_least_squares_agrees_with_the_mode(campaign, posterior):
    squares = mcc.least_squares(campaign, mcc.Model().with_effects(CREEP))
    assert squares.converged
    mode, found = posterior.fit.population, squares.to_json()
    effect = found["effects"][0]["parameters"]
    pairs = {
        "a": (found["a"], mode.a),
        "effective_modulus_MPa": (found["effective_modulus_MPa"], np.exp(mode.log_modulus)),
        "creep": (effect["creep_compliance_per_MPa"], mode.theta[0]),
        "creep.tau_s": (effect["tau_s"], mode.theta[1]),
        **{f"mu_{name}": (found[f"log_{name}"]["mean"], mode.mu[j]) for j, name in enumerate(("C1", "C3", "C5"))},
    }
    named = posterior.named_population()
    for name, (optimum, most_probable) in pairs.items():
        assert abs(optimum["value"] - float(most_probable)) < 0.2 * named[name].std(), name


def test_two_formulas_of_one_mechanism_are_refused():
    with pytest.raises(mcc.InputError, match="creep appears twice"):
        mcc.Model().with_effects(CREEP, "creep")
