"""Particles fitted each on its own: known coefficients from noise-free curves, and curves that snap through."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from joint_cases import COEFFICIENTS, DIAMETERS, NOISE, SNAPPING, modulus_of, simulated, true_latent

from mcc_jax import Instrument, Unloading
from mcc_jax.calibrate import Model, select_tests
from mcc_jax.calibrate.data import root_mean_squares
from mcc_jax.calibrate.fitting import ALONE, _centre
from mcc_jax.calibrate.forward import Forms, residuals, snap
from mcc_jax.calibrate.particle_fit import fit_particles, linear_starts
from mcc_jax.law import StrainScaling

pytestmark = pytest.mark.extended

SNAPS = np.stack([COEFFICIENTS[0], SNAPPING, COEFFICIENTS[2], SNAPPING * np.array([1.0, 1.01, 0.99])])


def fitted(campaign, noise, unloading=Unloading.PRINTED):
    tests = select_tests(campaign)
    return tests, fit(tests, noise, unloading)


def fit(tests, noise, unloading=Unloading.PRINTED, starts=None):
    middle, count = _centre(Model(unloading).chosen_priors), len(tests)
    centre = np.column_stack([np.broadcast_to(middle, (count, 4)), tests.contact])
    width = np.broadcast_to([ALONE] * 4 + [5.0], (count, 5))
    starts = linear_starts(tests, middle[3]) if starts is None else starts
    return fit_particles(tests, np.full(count, noise), centre, width, np.zeros((count, 0)), starts, Forms(unloading))


def rms_um(found, tests):
    return root_mean_squares(tests, residuals(found.point, tests, Forms(Unloading.PRINTED)))


@pytest.mark.parametrize("unloading", [Unloading.PRINTED, Unloading.PUNCH_EXACT], ids=lambda u: u.value)
def test_noise_free_particles_are_recovered(unloading):
    form = {"unloading": unloading, "scaling": StrainScaling.CONTACT}
    _, found = fitted(simulated(**form), 1e-6, unloading)
    assert np.all(np.asarray(found.converged))
    np.testing.assert_allclose(found.point.latent, true_latent(**form), rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.point.zero, 0.0, rtol=0, atol=1e-6)


def test_an_offset_of_the_record_is_the_zero():
    campaign = simulated(instrument=Instrument(zero_um=3.0), seed=4)
    _, found = fitted(campaign, 1e-6)
    offset = np.array([curve.displacement_um[0] for curve in campaign.curves])
    assert np.ptp(offset) > 1
    np.testing.assert_allclose(found.point.latent, true_latent(), rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.point.zero, offset, rtol=0, atol=1e-5)


@pytest.fixture(scope="module")
def snapping():
    campaign = simulated(SNAPS, instrument=NOISE, seed=2)
    return campaign, *fitted(campaign, 0.03)


def test_a_curve_that_snaps_is_reproduced_within_noise(snapping):
    _, tests, found = snapping
    rms = rms_um(found, tests)
    # Read-out noise is 0.02 um; noise of force adds some through the slope, most where a particle snaps.
    assert np.all(rms[[0, 2]] < 0.03)
    assert np.all(rms[[1, 3]] < 0.1), rms
    assert np.all(np.isfinite(np.asarray(found.point.latent)))


def test_without_unloading_the_modulus_stays_at_its_prior():
    tests = select_tests(simulated(instrument=NOISE))
    loading_only = replace(tests, mask=tests.loading)
    centre = _centre(Model().chosen_priors)
    found = fit(loading_only, 0.02)
    np.testing.assert_allclose(found.point.latent[:, 3], centre[3], rtol=1e-6)
    assert np.all(np.abs(np.asarray(found.point.latent)[:, :3] - true_latent()[:, :3]) < 0.05)
    assert abs(float(centre[3]) - np.log(modulus_of(Unloading.PRINTED))) > 0.1
    assert len(DIAMETERS) == len(found.point.zero)


def test_no_snap_through_is_put_where_nothing_shows_it():
    """A sharp rise, F ~ d^2 as under a sharp tip: best fitted by a snap-through below the first load that counts."""
    campaign = simulated(instrument=NOISE, seed=5)
    sharp = [
        replace(curve, displacement_um=8 * np.sqrt(np.maximum(curve.force_mN, 0) / curve.force_mN.max()))
        for curve in campaign.curves
    ]
    tests = select_tests(replace(campaign, curves=tuple(sharp)), threshold_MPa=0.0)
    first = jnp.min(jnp.where(tests.mask & tests.loading, tests.force, jnp.inf), 1)

    def unseen(latent):
        return np.asarray(jax.vmap(snap)(latent, tests.particle) < jnp.log(first))

    alone = fit(tests, 0.03)
    assert unseen(alone.point.latent).any()  # no start led anywhere else: there is nothing better to say
    here = np.column_stack([alone.point.latent, alone.point.zero])
    both = np.stack([here, np.broadcast_to([9.0, 2.5, 4.5, 12.0, 0.0], here.shape)], 1)
    found = fit(tests, 0.03, starts=both)
    assert not unseen(found.point.latent).any()
    assert np.all(rms_um(found, tests) > 0.999 * rms_um(alone, tests))
