"""The forward model and its derivatives against simulated campaigns and finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ALL_IN_TIME
from joint_cases import COEFFICIENTS, DIAMETERS, SNAPPING, effective_diameter, flatness, simulated, true_latent

from mcc_jax import Instrument, Programme, Unloading
from mcc_jax.calibrate.data import select_tests
from mcc_jax.calibrate.forward import displacement, linearise, linearise_with_force, raw_residual
from mcc_jax.calibrate.particle_fit import linear_start

forms = pytest.mark.parametrize("unloading", list(Unloading), ids=lambda u: u.value)
CYCLES = Programme.cycles(levels=(0.5, 1.0), unload_to=0.3, points=60)

residual_of = eqx.filter_jit(raw_residual)
linearised = eqx.filter_jit(linearise)
linearised_with_force = eqx.filter_jit(linearise_with_force)
starts = jax.jit(jax.vmap(linear_start))


def measured_with(unloading, **options):
    return select_tests(simulated(unloading=unloading, programme=CYCLES, **options)).tests


@ALL_IN_TIME
def test_noise_free_tests_leave_no_residual(unloading, scaling):
    """b = log(C eta) and e = log Ebar + p log eta (half of p in the punch forms) are all that a law knows of shape."""
    tests = measured_with(unloading, scaling=scaling)
    latent = jnp.asarray(true_latent(unloading=unloading, scaling=scaling))
    residual = np.asarray(residual_of(latent, jnp.zeros(4), tests, unloading))
    assert np.asarray(tests.mask).sum() > 4 * 40
    np.testing.assert_allclose(residual, 0.0, atol=1e-9)
    # Another modulus, or a zero, does leave one: the test above could fail.
    assert np.abs(residual_of(latent.at[:, 3].add(0.01), jnp.zeros(4), tests, unloading)).max() > 1e-3


def test_the_zero_is_subtracted_from_what_was_measured():
    tests = measured_with(Unloading.PRINTED)
    zero = jnp.asarray([1.0, -2.0, 0.0, 3.5])
    residual = np.asarray(residual_of(jnp.asarray(true_latent()), zero, tests, Unloading.PRINTED))
    expected = np.where(np.asarray(tests.mask), -np.asarray(zero)[:, None], 0.0)
    np.testing.assert_allclose(residual, expected, atol=1e-9)


@forms
def test_derivatives_are_finite_differences(unloading):
    tests = measured_with(unloading)
    rng = np.random.default_rng(0)
    # Beside the truth, so that nothing is special about the point.
    latent = jnp.asarray(true_latent(unloading=unloading) + 0.02 * rng.standard_normal((4, 4)))
    zero = jnp.asarray(rng.standard_normal(4))
    residual, J = (np.asarray(v) for v in linearised(latent, zero, tests, unloading))
    np.testing.assert_allclose(residual, residual_of(latent, zero, tests, unloading), rtol=1e-12, atol=1e-12)
    mask = np.asarray(tests.mask)
    assert np.all(J[~mask] == 0)
    h = 1e-5
    for j in range(5):
        step = h * np.eye(5)[j]
        up, down = (
            np.asarray(residual_of(latent + s * step[None, :4], zero + s * step[4], tests, unloading)) for s in (1, -1)
        )
        slope = (up - down) / (2 * h)
        np.testing.assert_allclose(J[..., j], slope, rtol=1e-5, atol=1e-5 * np.abs(slope).max())
    # Each coefficient does something, and the modulus on unloading only.
    loading = np.asarray(tests.loading)
    assert np.all(np.abs(J[..., :3]).max(axis=(0, 1)) > 0.1)
    assert np.all(J[..., 3][loading] == 0)
    force = np.asarray(tests.force)
    assert np.all(J[..., 3][mask & ~loading & (force < 0.95 * np.maximum.accumulate(force, axis=1))])


def own_slope(latent, particle, force, unloading, h):
    """Change of the k-th displacement with the k-th force alone, by central differences."""

    def at(k, step):
        return displacement(latent, particle, force.at[k].add(step), unloading)[k]

    index = jnp.arange(len(force))
    return jax.vmap(lambda k: (at(k, h) - at(k, -h)) / (2 * h))(index)


def peak_slope(latent, particle, force, unloading, h):
    """Change of the k-th displacement with the largest force before it, by central differences."""
    index = jnp.arange(len(force))

    def at(k, step):
        peak = jnp.argmax(jnp.where(index < k, force, -jnp.inf))
        return displacement(latent, particle, force.at[peak].add(step), unloading)[k]

    return jax.vmap(lambda k: (at(k, h) - at(k, -h)) / (2 * h))(index)


slopes = eqx.filter_jit(
    lambda latent, tests, unloading, h: jax.vmap(lambda w, p, f: own_slope(w, p, f, unloading, h))(
        latent, tests.particle, tests.force
    )
)

peak_slopes = eqx.filter_jit(
    lambda latent, tests, unloading, h: jax.vmap(lambda w, p, f: peak_slope(w, p, f, unloading, h))(
        latent, tests.particle, tests.force
    )
)


@pytest.mark.long
@forms
@pytest.mark.parametrize("hum", [0.0, 0.5], ids=["clean", "noisy"])
def test_how_noise_of_force_moves_a_prediction(unloading, hum):
    """On loading, unloading and reloading, and where noise makes loading go back for a point."""
    tests = measured_with(unloading, instrument=Instrument(force_noise_mN=hum), peak_MPa=5.0)
    latent = jnp.asarray(true_latent(unloading=unloading))
    *_, moved, by_peak = (np.asarray(v) for v in linearised_with_force(latent, jnp.zeros(4), tests, unloading))
    h = 1e-5
    expected = np.asarray(slopes(latent, tests, unloading, h))
    force = np.asarray(tests.force)
    highest = np.maximum.accumulate(force, axis=1)
    before = np.concatenate([np.full((4, 1), -np.inf), highest[:, :-1]], 1)
    # Within h of the largest force so far there is a kink.
    smooth = (np.abs(force - before) > 3 * h) & (force > 0.05 * highest)
    used = np.asarray(tests.mask) & smooth
    record = force > before
    for where in (used & record, used & ~record):
        assert where.sum() > 20
        np.testing.assert_allclose(moved[where], expected[where], rtol=1e-4, atol=1e-7)
    assert np.all(moved[used] > 0)
    # The whole branch moves with the force at its peak; loading has none.
    assert np.all(by_peak[used & record] == 0)
    expected = np.asarray(peak_slopes(latent, tests, unloading, h))
    where = used & ~record
    np.testing.assert_allclose(by_peak[where], expected[where], rtol=1e-4, atol=1e-6)
    # Elastic points move less than loading moves: unloading is steeper.
    assert np.median(moved[used & ~record]) < np.median(moved[used & record])


# ---- the start without iteration -------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.0, 0.013, -0.013, 0.03, -0.03])
def test_the_start_lands_near_the_truth(offset):
    """With the recorded contact off by a share of the effective diameter."""
    tests = measured_with(Unloading.PRINTED)
    reach = jnp.asarray(effective_diameter(DIAMETERS))
    contact = tests.contact + offset * reach
    b, zero = starts(tests.particle, tests.force, tests.displacement, tests.loading, contact)
    ratio = np.exp(np.asarray(b) - true_latent()[:, :3])
    assert np.all(np.abs(ratio - 1) < 0.2), ratio
    assert np.all(np.abs(np.asarray(zero)) < 0.004 * np.asarray(reach))


def test_the_start_of_a_particle_that_snaps_is_finite():
    C = COEFFICIENTS.copy()
    C[1], C[2] = SNAPPING, SNAPPING * np.array([0.7, 1.0, 0.97])
    tests = select_tests(simulated(C, programme=CYCLES)).tests
    for offset in (0.0, 0.03, -0.03):
        contact = tests.contact + offset * jnp.asarray(effective_diameter(DIAMETERS))
        for values in starts(tests.particle, tests.force, tests.displacement, tests.loading, contact):
            assert np.all(np.isfinite(np.asarray(values)))


def test_the_start_of_an_impossible_record_is_finite():
    tests = measured_with(Unloading.PRINTED)
    for displaced in (-50.0, 0.0):
        measured = jnp.full_like(tests.displacement, displaced)
        for values in starts(tests.particle, tests.force, measured, tests.loading, tests.contact):
            assert np.all(np.isfinite(np.asarray(values)))


def test_flatness_and_eta_are_the_geometry_s():
    tests = measured_with(Unloading.PRINTED)
    actual = eqx.filter_vmap(lambda p: p.flatness)(tests.particle)
    np.testing.assert_allclose(actual, flatness(DIAMETERS), rtol=1e-14)
