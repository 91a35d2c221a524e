"""Coordinates of the effects' numbers: they can be gone back, and tests are straight in them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcc_jax.calibrate.straightening import Straight, coordinates, numbers

pytestmark = pytest.mark.extended

PLACES = ((1, 0), (2, 0))
AT = np.array([0.02, 30.0, 2.0, 0.3])
exponents = st.floats(-3, 3, allow_subnormal=False)
logs = st.floats(-0.3, 0.3)


def row(shear, power):
    return jax.tree.map(lambda x: x[0], Straight.of(1, shear, power))


def of_one(shear, power):
    return row(np.array([0.0, *shear, 0.0]), np.array([0.0, *power, 0.0]))


@settings(deadline=None, max_examples=50)
@given(st.tuples(exponents, exponents), st.tuples(exponents, exponents), st.tuples(logs, logs, logs, logs))
def test_there_and_back(shear, power, logs):
    theta, straight = jnp.asarray(AT * np.exp(np.array(logs))), of_one(shear, power)
    away, factor = coordinates(theta, jnp.asarray(AT), straight, PLACES)
    np.testing.assert_allclose(numbers(away, jnp.asarray(AT), straight, PLACES), theta, rtol=1e-9)
    np.testing.assert_allclose(away[0], theta[0] * factor[0] - AT[0], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(away[3], theta[3] - AT[3], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("time", [3.0, 30.0, 3000.0])
def test_creep_far_beyond_the_record_is_a_straight_line_of_its_coordinates(time):
    """A ln(1 + t/tau) is A/tau (t - t^2/(2 tau)) there: with shear and power of -1 it is u t - ..., linear in both."""
    t = np.linspace(0.1, 10.0, 20)
    at, straight = jnp.asarray(np.array([1e-3, 1e4])), row(np.array([0.0, -1.0]), np.array([0.0, -1.0]))

    def prediction(away):
        amplitude, tau = numbers(away, at, straight, ((1, 0),))
        return amplitude * jnp.log1p(t / tau)

    there = coordinates(jnp.asarray(np.array([1e-3 * time / 1e4, time])), at, straight, ((1, 0),))[0]
    linear = prediction(jnp.zeros(2)) + jax.jacfwd(prediction)(jnp.zeros(2)) @ there
    exact = prediction(there)
    bent = np.abs(np.asarray(linear - exact)) / np.asarray(exact)
    assert bent.max() < (10 / time) ** 2  # the next term of the series is a third of it
