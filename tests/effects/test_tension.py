"""Adhesion below zero force: the branch in tension, where it breaks, and pull-off in a record."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import paper_law, paper_particle

import mcc_jax as mcc
from mcc_jax.campaign import campaign_findings, check_tests, pull_off
from mcc_jax.effects import LIBRARY
from mcc_jax.effects.record import contact_radius
from mcc_jax.formulas import recovery, stress_ratio

PARTICLE, LAW = paper_particle(3), paper_law()
TOP = 15.0  # um
CONTACT = LAW.contact(PARTICLE)
PEAK_FORCE = float(CONTACT.loading(jnp.asarray(TOP)))
SPAN = float(CONTACT.recovered(jnp.asarray(TOP)).displacement)
RADIUS = float(contact_radius(PARTICLE, PARTICLE.strain(jnp.asarray(TOP))))
DIAMETERS = [float(D) for D in (PARTICLE.D1, PARTICLE.D2, PARTICLE.D3)]


def toughness(work):
    """K_c [MPa um^0.5] of a work of adhesion [mJ/m^2], with the contact's own stiffness of unloading at the peak."""
    modulus = 4 * PEAK_FORCE / (np.pi * SPAN * RADIUS)  # mN/um^2: two contacts in series, each 2 E* a
    return 1e3 * np.sqrt(2 * modulus * 1e-6 * work)


def driven(law, path):
    """Forces [mN] along displacements [um], a second from one to the next."""
    time = np.arange(float(len(path))) if law.effects else None
    return np.asarray(mcc.drive(law, PARTICLE, path, time=time).force)


def unloaded(law, displacement):
    """Forces [mN] on unloading to displacements [um]."""
    return driven(law, np.concatenate([np.linspace(0.0, TOP, 20), displacement]))[20:]


@pytest.mark.parametrize("name", ["jkr_nominal", pytest.param("constant_nominal", marks=pytest.mark.extended)])
def test_in_tension_force_is_what_the_branch_carries_less_the_attraction(name):
    """F = F_P (u' - kappa g(s(u'))) at gamma_P - Delta s(u'), down to its least value, where the contact breaks."""
    stress = 0.3
    effect = LIBRARY["adhesion"][name].build(stress)
    kappa = stress / float(PARTICLE.stress(jnp.asarray(PEAK_FORCE)))
    share = jnp.linspace(0.3, 1.0, 4001)[:-1]
    pulled = np.asarray(stress_ratio(share) - kappa * effect.of(share))
    breaks = int(np.argmin(pulled))
    rows = np.unique(np.linspace(0, breaks - 5, 12).astype(int))
    assert pulled[rows].min() < 0 < pulled[rows].max()
    law = LAW.with_effects(effect)
    np.testing.assert_allclose(
        unloaded(law, TOP - SPAN * np.asarray(share)[rows]), PEAK_FORCE * pulled[rows], atol=1e-9 * PEAK_FORCE
    )
    beyond = TOP - SPAN * np.asarray(share)[breaks + 5 :: 200]
    assert (unloaded(law, beyond) == 0).all()
    # Under load control it stays where the contact broke.
    force = PEAK_FORCE * np.array([0.5, 1.0, 0.5, 0.9 * pulled.min(), 1.01 * pulled.min(), 3 * pulled.min()])
    held = np.asarray(mcc.drive(law, PARTICLE, force, time=np.arange(6.0), control="load").displacement)
    assert held[3] > held[4] == held[5]
    assert held[5] == pytest.approx(TOP - SPAN * float(share[breaks]), abs=1e-3 * SPAN)


def test_a_weak_adhesion_pulls_off_at_the_force_of_johnson_kendall_and_roberts():
    """3/2 pi w R, R = 4 a_P^2 / Delta the radius that full release leaves."""
    work = 0.01  # mJ/m^2
    law = LAW.with_effects(LIBRARY["adhesion"]["kendall"].build(toughness(work)))
    expected = 1.5 * np.pi * 1e-6 * work * 4 * RADIUS**2 / SPAN
    assert expected < 1e-3 * PEAK_FORCE
    at = recovery(jnp.asarray(np.linspace(0.5, 2.0, 41) * expected / PEAK_FORCE))
    force = unloaded(law, TOP - SPAN * np.asarray(at)[::-1])
    assert -force.min() == pytest.approx(expected, rel=0.05)


def curve_of(law, noise, seed=0):
    """A test with air before and behind it, to the last of the contact."""
    path = np.concatenate([np.linspace(0.0, TOP, 150), np.linspace(TOP, TOP - 1.05 * SPAN, 400)])
    force = driven(law, path)
    path = np.concatenate([np.linspace(-2.0, 0.0, 50), path, path[-1] - np.linspace(0.0, 2.0, 50)])
    force = np.concatenate([np.zeros(50), force, np.zeros(50)])
    rng = np.random.default_rng(seed)
    force = force + noise * rng.standard_normal(len(force))
    return mcc.Curve(np.arange(float(len(path))), force, path)


def test_the_work_of_adhesion_comes_out_of_a_record():
    work = 0.5
    law = LAW.with_effects(LIBRARY["adhesion"]["kendall"].build(toughness(work)))
    found = pull_off(curve_of(law, 5e-4), DIAMETERS)
    assert found is not None
    assert found.radius_um == pytest.approx(4 * RADIUS**2 / SPAN, rel=0.1)
    assert found.work_by_jkr == pytest.approx(work, rel=0.15)
    assert found.work_by_dmt == pytest.approx(0.75 * found.work_by_jkr)
    campaign = mcc.Campaign(["p"], [DIAMETERS], [curve_of(law, 5e-4)])
    said = [one for one in campaign_findings(check_tests(campaign)) if one.check == "pull-off"]
    assert len(said) == 1
    assert said[0].level == "info"
    assert f"{found.work_by_jkr:.4g} mJ/m^2 (JKR)" in said[0].sentence


@pytest.mark.parametrize("seed", range(5))
def test_without_adhesion_no_pull_off_is_seen_in_noise(seed):
    assert pull_off(curve_of(LAW, 0.05, seed), DIAMETERS) is None


@pytest.mark.extended
def test_pulling_off_and_touching_again_gains_no_energy():
    """Between places where the particle has let go, no part of a path gives back more than it took."""
    law = LAW.with_effects(LIBRARY["adhesion"]["jkr_nominal"].build(0.3))
    rng = np.random.default_rng(0)
    turns = np.stack([np.sort(rng.uniform(0.5, 1.5, 6)) * TOP, rng.uniform(0.3, 1.2, 6) * TOP - SPAN], 1).ravel()
    path = np.concatenate([[0.0], *(np.linspace(a, b, 200)[1:] for a, b in zip([0.0, *turns], turns, strict=False))])
    force = driven(law, path)
    work = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(path))])
    assert force.min() < 0
    free = np.flatnonzero(force == 0)
    assert np.diff(work[free]).min() > -0.01 * work[-1]  # a step of the path over the snap is not resolved
