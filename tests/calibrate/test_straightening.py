"""Coordinates of the effects' numbers: they can be gone back, and tests are straight in them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcc_jax.calibrate.linearisation import Straight, coordinates, moved

pytestmark = pytest.mark.extended

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
