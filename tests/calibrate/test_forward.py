"""The forward model and its derivatives against simulated campaigns and finite differences."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ALL_FORMS
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_cases import COEFFICIENTS, DIAMETERS, SNAPPING, effective_diameter, simulated, true_latent

from mcc_jax import Instrument, Model, Programme, Unloading
from mcc_jax.calibrate import select_tests
from mcc_jax.calibrate.forward import Forms, Point, Straight, coordinates, linearise, moved, residuals
from mcc_jax.calibrate.particle_fit import linear_starts

forms = pytest.mark.parametrize("unloading", list(Unloading), ids=lambda u: u.value)
CYCLES = Programme.cycles(levels=(0.5, 1.0), unload_to=0.3, hold_s=20.0, points=60)
CREEP = Model().with_effects("creep:logarithmic").forms
PLAIN = Model().forms

residual_of = eqx.filter_jit(residuals)


def measured_with(unloading=Unloading.PRINTED, **options):
    return select_tests(simulated(unloading=unloading, programme=CYCLES, **options))


def point_at(latent, zero=0.0, theta=()):
    latent = jnp.asarray(latent)
    return Point(
        latent, jnp.broadcast_to(jnp.asarray(zero), 4), jnp.broadcast_to(jnp.asarray(theta, float), (4, len(theta)))
    )


@ALL_FORMS
def test_noise_free_tests_leave_no_residual(unloading, scaling):
    """b = log(C eta) and e = log Ebar + p log eta (half of p in the punch forms) are all that a law knows of shape."""
    tests, law = measured_with(unloading, scaling=scaling), Forms(unloading)
    latent = true_latent(unloading=unloading, scaling=scaling)
    assert np.asarray(tests.mask).sum() > 4 * 40
    np.testing.assert_allclose(residual_of(point_at(latent), tests, law), 0.0, atol=1e-9)
    # Another modulus, or a zero, does leave one: the test above could fail.
    away = residual_of(point_at(np.add(latent, [0.0, 0.0, 0.0, 0.01])), tests, law)
    assert np.abs(away).max() > 1e-3


def test_the_zero_is_subtracted_from_what_was_measured():
    tests, zero = measured_with(), np.array([1.0, -2.0, 0.0, 3.5])
    residual = residual_of(point_at(true_latent(), zero), tests, PLAIN)
    np.testing.assert_allclose(residual, np.where(np.asarray(tests.mask), -zero[:, None], 0.0), atol=1e-9)


@pytest.mark.extended
@pytest.mark.parametrize(
    ("unloading", "names"),
    [
        (Unloading.PUNCH, ""),
        (Unloading.PUNCH_EXACT, "creep:logarithmic"),
        (Unloading.PRINTED, "rate_dependence damage"),
        (Unloading.PUNCH_EXACT, "size_effect creep:logarithmic"),
        (Unloading.PRINTED, "platen_friction rate_dependence"),
    ],
)
def test_linearised_tests_have_the_derivatives_of_the_whole_law(unloading, names):
    tests, law = measured_with(unloading), Model(unloading).with_effects(*names.split()).forms
    numbers = [0.5 * v.typical for v in law.effects] + [n.middle for v in law.effects for n in v.nuisances]
    # Beside the truth, so that nothing is special about the point.
    point = point_at(true_latent(unloading=unloading) + 0.02, 0.5, numbers)

    @eqx.filter_jit
    def whole(point):
        def one(x, *test):
            return law.displacement(x[:4], x[4:], *test)

        x = jnp.concatenate([point.latent, point.theta], 1)
        return jax.vmap(jax.jacfwd(one))(x, tests.particle, tests.record)

    linear, slopes, mask = linearise(point, tests, law), np.asarray(whole(point)), np.asarray(tests.mask)
    expected = np.where(mask[..., None], slopes, 0.0)
    scale = np.abs(expected).max((0, 1))
    assert np.all(scale > 0)
    np.testing.assert_allclose(np.asarray(linear.columns) / scale, expected / scale, rtol=0, atol=1e-10)
    np.testing.assert_allclose(linear.residual, residual_of(point, tests, law), atol=1e-10)
    # The modulus acts on unloading only.
    assert np.all(expected[..., 3][np.asarray(tests.loading)] == 0)
    assert np.all(expected[..., 3][mask & (np.asarray(tests.force) < 0.95 * np.asarray(tests.record.peak))])
    # What is not asked for is not there.
    assert linearise(point, tests, law, with_numbers=False).columns.shape == (*mask.shape, 0)


@pytest.mark.extended
@pytest.mark.parametrize(("law", "theta"), [(PLAIN, ()), (CREEP, (3e-4, 10.0))], ids=["plain", "creep"])
@pytest.mark.parametrize("hum", [0.0, 0.5], ids=["clean", "noisy"])
def test_how_errors_of_force_move_a_prediction(law, theta, hum):
    """By a point's own reading, by the peak of its branch, by an error that all forces share: each by differences."""
    tests = measured_with(instrument=Instrument(force_noise_mN=hum), peak_MPa=5.0)
    point = point_at(true_latent(), 0.0, theta)
    linear = linearise(point, tests, law)
    own, elastic, mask = (np.asarray(x) for x in (tests.reading, tests.peak_error > 0, tests.mask))

    @eqx.filter_jit
    def slope(force, peak):
        """Central differences with the record moved by so much per mN."""

        def at(h):
            record = replace(tests.record, force=tests.force + h * force, peak=tests.record.peak + h * peak)
            return -residuals(point, replace(tests, record=record), law)

        return (at(1e-5) - at(-1e-5)) / 2e-5

    one = jnp.where(tests.force > 0, 1.0, 0.0)  # out of contact there is no force to err
    # A reading on loading is its own peak; where an estimate stands in for readings, both are its own.
    by_reading = np.asarray(slope(jnp.where(own, one, 0.0), jnp.where(own & ~elastic, one, 0.0)))
    by_peak = np.asarray(slope(jnp.where(own, 0.0, one), jnp.where(elastic, one, 0.0)))
    offset = np.asarray(slope(one, one))
    # Behind the peak by less than the step of the differences there is a kink.
    smooth = mask & (np.abs(np.asarray(tests.force) - np.asarray(tests.record.peak)) > 1e-3)
    loading = mask & ~elastic & own
    for where in (smooth & elastic, loading):
        assert where.sum() > 20
        np.testing.assert_allclose(np.asarray(linear.by_force)[where], by_reading[where], rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(np.asarray(linear.by_offset)[where], offset[where], rtol=1e-4, atol=1e-6)
        assert np.all(np.asarray(linear.by_force)[where] > 0)
    np.testing.assert_allclose(
        np.asarray(linear.by_peak)[smooth & elastic], by_peak[smooth & elastic], rtol=1e-4, atol=1e-6
    )
    assert theta or np.all(np.asarray(linear.by_peak)[loading] == 0)
    # Elastic points move less than loading moves: unloading is steeper.
    assert np.median(np.asarray(linear.by_force)[smooth & elastic]) < np.median(np.asarray(linear.by_force)[loading])


@pytest.mark.parametrize("offset", [0.0, 0.013, -0.013, 0.03, -0.03])
def test_the_start_lands_near_the_truth(offset):
    """With the recorded contact off by a share of the effective diameter."""
    tests = measured_with()
    reach = jnp.asarray(effective_diameter(DIAMETERS))
    contact = tests.contact + offset * reach
    first = linear_starts(replace(tests, contact=contact), 9.0)[:, 0]
    ratio = np.exp(first[:, :3] - true_latent()[:, :3])
    assert np.all(np.abs(ratio - 1) < 0.2), ratio
    assert np.all(np.abs(first[:, 4]) < 0.004 * np.asarray(reach))


def test_the_start_of_a_particle_that_snaps_and_of_an_impossible_record_is_finite():
    C = COEFFICIENTS.copy()
    C[1], C[2] = SNAPPING, SNAPPING * np.array([0.7, 1.0, 0.97])
    tests = select_tests(simulated(C, programme=CYCLES))
    for offset in (0.0, 0.03, -0.03):
        contact = tests.contact + offset * jnp.asarray(effective_diameter(DIAMETERS))
        assert np.all(np.isfinite(linear_starts(replace(tests, contact=contact), 9.0)))
    for displaced in (-50.0, 0.0):
        measured = jnp.full_like(tests.displacement, displaced)
        assert np.all(np.isfinite(linear_starts(replace(tests, displacement=measured), 9.0)))


# ---- coordinates of the effects' numbers, in which tests are nearly linear -------------------------------------------

PLACES = ((1, 0), (2, 0))
AT = np.array([0.02, 30.0, 2.0, 0.3])
exponents = st.floats(-3, 3, allow_subnormal=False)
logs = st.floats(-0.3, 0.3)


def there_and_back(theta, at, shear, power, places):
    """Coordinates of one particle's numbers and their derivatives, the amplitudes' factors, and the way back."""
    straight = Straight.of(1, np.array(shear), np.array(power))

    def there(theta):
        return coordinates(theta, jnp.asarray(at), jax.tree.map(lambda x: x[0], straight), places)

    away, factor = there(jnp.asarray(theta))
    slope = jax.jacfwd(lambda x: there(x)[0])(jnp.asarray(theta))
    numbers, back = moved(np.asarray(away), at[None], straight, places)
    return away, factor, slope, numbers[0], back[0]


@pytest.mark.extended
@settings(deadline=None, max_examples=50)
@given(st.tuples(exponents, exponents), st.tuples(exponents, exponents), st.tuples(logs, logs, logs, logs))
def test_there_and_back(shear, power, logs):
    theta = AT * np.exp(np.array(logs))
    away, factor, slope, numbers, back = there_and_back(theta, AT, (0, *shear, 0), (0, *power, 0), PLACES)
    np.testing.assert_allclose(numbers, theta, rtol=1e-9)
    unit = AT[:, None] / AT
    np.testing.assert_allclose(slope @ back / unit, np.eye(4), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(away[0], theta[0] * factor[0] - AT[0], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(away[3], theta[3] - AT[3], rtol=1e-12, atol=1e-15)


@pytest.mark.extended
@pytest.mark.parametrize("time", [3.0, 30.0, 3000.0])
def test_creep_far_beyond_the_record_is_a_straight_line_of_its_coordinates(time):
    """A ln(1 + t/tau) is A/tau (t - t^2/(2 tau)) there: with shear and power of -1 it is u t - ..., linear in both."""
    t = np.linspace(0.1, 10.0, 20)
    at, theta, place = np.array([1e-3, 1e4]), np.array([1e-3 * time / 1e4, time]), ((1, 0),)

    def prediction(numbers):
        return numbers[0] * jnp.log1p(t / numbers[1])

    away, *_ = there_and_back(theta, at, (0.0, -1.0), (0.0, -1.0), place)
    *_, back = there_and_back(at, at, (0.0, -1.0), (0.0, -1.0), place)
    linear = prediction(jnp.asarray(at)) + jax.jacfwd(prediction)(jnp.asarray(at)) @ back @ away
    exact = prediction(jnp.asarray(theta))
    bent = np.abs(np.asarray(linear - exact)) / np.asarray(exact)
    assert bent.max() < (10 / time) ** 2  # the next term of the series is a third of it
