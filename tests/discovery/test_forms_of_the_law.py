"""Tests that follow another of the law's own forms of unloading miss nothing: they follow that form."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from campaigns import QUICK, base_of, cached

from mcc_jax.calibrate import Model, Priors
from mcc_jax.discovery import discover
from mcc_jax.effects import LIBRARY
from mcc_jax.geometry import Particle
from mcc_jax.law import Unloading

PUNCH = (450.0, "punch")
FEW = {name: LIBRARY[name] for name in ("frame_compliance", "damage")}


def test_a_law_in_another_form_unloads_from_its_peaks_as_before():
    base = base_of(cached("frame_compliance=0.004"))
    forces = np.max(np.where(base.tests.mask, base.tests.force, 0.0), axis=1)

    def stiffness(base):
        """1 / delta^2, where the power of the modulus and the constant enter, of every test at its peak."""
        law = jax.vmap(lambda latent: base.model.forms.law(latent, jnp.zeros(0)))(base.state.point.latent)
        stress = np.asarray(jax.vmap(Particle.stress)(base.tests.particle, jnp.asarray(forces)))
        form = base.model.unloading
        return form.constant * (np.asarray(law.effective_modulus) / stress) ** form.stress_power

    there = base.in_form(Unloading.PUNCH)
    np.testing.assert_allclose(stiffness(there), stiffness(base), rtol=1e-9)
    assert there.model.chosen_priors.effective_modulus_MPa == Priors.default("punch").effective_modulus_MPa
    back = there.in_form(Unloading.PRINTED)
    np.testing.assert_allclose(back.state.point.latent, base.state.point.latent, rtol=1e-12)
    np.testing.assert_allclose(back.state.population, base.state.population, rtol=1e-12)


def test_tests_in_the_punch_form_miss_nothing():
    found = discover(cached(form=PUNCH), library=FEW, **QUICK)
    assert (found.verdict, found.model.unloading) == ("NO_GAP", Unloading.PUNCH)
    assert found.summary.startswith("The tests follow the law in its form of unloading 'punch', not 'printed'")
    assert abs(np.log(found.parameters_before["effective_modulus_MPa"]["value"] / 450.0)) < 0.3
    assert found.law().unloading is Unloading.PUNCH
    moduli = re.search(r"effective modulus (\S+) ± \S+ GPa, not (\S+) ± \S+ GPa", found.summary).groups()
    assert float(moduli[0]) == pytest.approx(0.45, rel=0.3)
    assert float(moduli[1]) > 1.5  # of the printed form


@pytest.mark.extended
def test_an_effect_is_named_in_the_form_that_the_tests_follow():
    for form in (PUNCH, (16_000.0, "printed")):
        found = discover(cached("frame_compliance=0.006", form=form), library=FEW, **QUICK)
        assert [effect.mechanism for effect in found.effects] == ["frame_compliance"]
        assert found.model.unloading is Unloading(form[1])


@pytest.mark.extended
def test_priors_of_ones_own_belong_to_their_form():
    """A prior of the modulus is meant for the form that was asked for: no other is tried."""
    model = replace(Model(), priors=Priors())
    found = discover(cached(form=PUNCH), model, library=FEW, **QUICK)
    assert found.model is None or found.model.unloading is Unloading.PRINTED
    assert found.verdict != "NO_GAP"
