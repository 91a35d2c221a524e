"""Effects fitted as they are: what first order misses, further numbers between the grid's, and the limits."""

import numpy as np
import pytest
from campaigns import campaign, refined_system

from mcc_jax.discover.evidence import rank
from mcc_jax.discover.gauss_newton import refit, system_at
from mcc_jax.discover.score import project
from mcc_jax.effects import LIBRARY, Mechanism

pytestmark = pytest.mark.long  # compiles for long

COMPLIANCE, CREEP, TAU = 0.03, 0.001, 11.0
"""A frame softer than any first-order formula bears, and a creep whose time lies between the grid's values."""

SMALL = {
    name: Mechanism(name, LIBRARY[name].explanation, (LIBRARY[name][variant],))
    for name, variant in {"frame_compliance": "linear", "creep": "kelvin_voigt"}.items()
}


def candidate(system, name):
    """The best formula of a mechanism."""
    found = rank(system, project(system, system.candidate_columns))
    return found.best[found.names.index(name)]


@pytest.fixture(scope="module")
def soft():
    base, signals, system = refined_system(campaign(f"frame_compliance={COMPLIANCE}"), SMALL)
    k = candidate(system, "frame_compliance")
    inside = np.array([system.column(k)])
    linear = float(project(system, inside[:0], inside=inside).theta[-1])
    return base, signals, system, k, linear, refit(base, (system.candidates[k],), system.prior)


@pytest.fixture(scope="module")
def creeping():
    base, _, system = refined_system(campaign(f"creep:kelvin_voigt={CREEP},tau_s={TAU}"), SMALL)
    k = candidate(system, "creep")
    return base, system, k, refit(base, (system.candidates[k],), system.prior)


def test_a_large_amplitude_is_found_where_first_order_misses_it(soft):
    *_, linear, found = soft
    unit = found.formulas[0].variant.plausible[1]
    assert found.converged
    assert found.physical
    off, sd = found.own(0)[0] * unit - COMPLIANCE, found.spread(0)[0] * unit
    assert abs(off) < 3 * sd
    assert abs(off) < abs(linear * unit - COMPLIANCE)


def test_a_further_number_is_found_between_the_grid_s_values(creeping):
    _, system, k, found = creeping
    assert found.converged
    tau = found.formulas[0].nuisance(found.own(0))["tau_s"]
    width = found.spread(0)[1]
    assert tau != system.candidates[k].nuisance["tau_s"]
    assert abs(np.log(tau / TAU)) < 3 * width
    assert width < 0.3


def test_neighbours_on_the_grid_lead_to_the_same_minimum(creeping):
    base, system, k, found = creeping
    tau = system.candidates[k].nuisance["tau_s"]
    others = [c for c in system.candidates if c.mechanism == "creep" and c.nuisance["tau_s"] != tau]
    near = min(others, key=lambda c: abs(np.log(c.nuisance["tau_s"] / TAU)))
    again = refit(base, (near,), system.prior)
    assert again.converged
    # The grid's value is a weak prior of its own, so the minima are not the same to the last digit.
    assert again.deviance == pytest.approx(found.deviance, abs=2.0)
    assert again.own(0)[0] == pytest.approx(found.own(0)[0], abs=found.spread(0)[0])


def test_the_extended_law_fits_better_than_the_base_law(soft):
    base, _, system, _, _, found = soft
    alone = refit(base, (), system.prior)
    assert len(alone.state.theta) == 0
    assert np.isfinite(alone.deviance)
    assert alone.deviance > found.deviance + 100


def test_around_the_extended_law_nothing_is_left_to_move(soft):
    base, signals, system, k, _, found = soft
    there = system_at(base, system, signals, [k], found)
    inside = np.array([there.column(k)])
    fitted = project(there, inside[:0], inside=inside)
    assert there.at[k] == found.own(0)[0]
    assert abs(fitted.theta[-1]) < 0.1 * found.spread(0)[0]
    # What is left is noise: chi2 per point about 1, where the base law leaves more.
    left = fitted.residual.sum() / there.points.sum()
    assert left < project(system, inside[:0]).residual.sum() / system.points.sum()
    assert left < 1.1


def test_two_effects_together(soft):
    base, _, system, k, *_ = soft
    other = candidate(system, "creep")
    both = refit(base, (system.candidates[k], system.candidates[other]), system.prior)
    unit = both.formulas[0].variant.plausible[1]
    assert abs(both.own(0)[0] * unit - COMPLIANCE) < 4 * both.spread(0)[0] * unit
    assert abs(both.own(1)[0]) < 4 * both.spread(1)[0]


def test_a_refit_replaces_the_linear_gain_in_the_ranking(soft):
    _, _, system, k, *_ = soft
    view = project(system, system.candidate_columns)
    other = candidate(system, "creep")
    before = rank(system, view)
    after = rank(system, view, refitted={k: 0.0, other: 500.0})
    assert before.names[0] == "frame_compliance"
    assert after.names[0] == "creep"
    assert after.gain[0] == 500.0


def test_more_numbers_than_slots_are_refused(soft):
    base, _, system, k, *_ = soft
    with pytest.raises(ValueError, match="at most"):
        refit(base, (system.candidates[k],) * 7, system.prior)
