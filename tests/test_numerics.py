import equinox as eqx
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from mcc_jax._numerics import positive_pow, running_max, two_thirds_power

DTYPES = [jnp.float32, jnp.float64]
MODES = [jax.jacfwd, jax.jacrev]
largest_so_far = eqx.filter_jit(running_max)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("power", [1.5, 2.0, 3.0])
@pytest.mark.parametrize("x", [-2.0, -1e-30, 0.0])
def test_positive_pow_vanishes_with_its_derivatives(dtype, mode, power, x):
    x = jnp.array(x, dtype)
    function = lambda x: positive_pow(x, power)  # noqa: E731
    for order in (function, mode(function), mode(mode(function))):
        np.testing.assert_array_equal(order(x), dtype(0), strict=True)


@pytest.mark.parametrize("mode", MODES)
def test_positive_pow_is_the_power_above_zero(mode):
    x, p = jnp.array(0.7), jnp.array(1.531)
    np.testing.assert_allclose(positive_pow(x, p), 0.7**1.531, rtol=1e-15)
    np.testing.assert_allclose(mode(positive_pow)(x, p), 1.531 * 0.7**0.531, rtol=1e-15)
    np.testing.assert_allclose(mode(positive_pow, 1)(x, p), 0.7**1.531 * np.log(0.7), rtol=1e-15)
    np.testing.assert_array_equal(mode(positive_pow, 1)(jnp.array(0.0), p), 0)


jacobians = [jax.jit(mode(running_max)) for mode in MODES]


@settings(max_examples=60)
@given(path=hnp.arrays(np.float64, st.just(12), elements=st.integers(-3, 3).map(float)))
def test_running_max_passes_a_tie_to_the_earliest_whole(path):
    np.testing.assert_array_equal(largest_so_far(jnp.asarray(path)), np.maximum.accumulate(path))
    expected = np.zeros((12, 12))
    for i in range(12):
        expected[i, np.argmax(path[: i + 1])] = 1
    for jacobian in jacobians:
        np.testing.assert_array_equal(jacobian(jnp.asarray(path)), expected)


@pytest.mark.parametrize("steps", [1, 9, 10, 11, 20, 25, 101, 234])
def test_running_max_of_every_length(steps):
    """Values, and the derivative at ties, on both sides of the block lengths that the implementation uses."""
    path = np.random.default_rng(steps).integers(-9, 9, steps) + 0.3 * np.arange(steps) // 4
    np.testing.assert_array_equal(largest_so_far(jnp.asarray(path)), np.maximum.accumulate(path))
    earliest = np.array([np.argmax(path[: i + 1]) for i in range(steps)])
    np.testing.assert_array_equal(jacobians[0](jnp.asarray(path)), np.eye(steps)[earliest])


@pytest.mark.parametrize("dtype", DTYPES)
def test_running_max_of_short_paths_and_of_a_batch(dtype):
    for path in ([0.3], [1.0, 1.0], [-2.0, -3.0, -1.0], [0.0, -0.0, 0.0]):
        path = jnp.array(path, dtype)
        assert running_max(path).dtype == dtype
        np.testing.assert_array_equal(running_max(path), np.maximum.accumulate(path))
    paths = jnp.array([[0.0, 2.0, 1.0], [3.0, 2.0, 4.0]], dtype)
    values, tangents = jax.jvp(jax.vmap(running_max), (paths,), (jnp.arange(6, dtype=dtype).reshape(2, 3),))
    np.testing.assert_array_equal(values, [[0, 2, 2], [3, 3, 4]])
    np.testing.assert_array_equal(tangents, [[0, 1, 1], [3, 3, 5]])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_two_thirds_power_is_exact_to_rounding(dtype):
    x = np.concatenate([np.geomspace(1e-35, 1, 20_001), 1 - np.geomspace(1e-16, 1, 1000)]).astype(dtype)
    want = np.cbrt(x.astype(np.longdouble)) ** 2
    got = np.asarray(two_thirds_power(jnp.asarray(x)), np.longdouble)
    np.testing.assert_array_less(np.abs(got - want), 1.6 * np.finfo(dtype).eps * want + 1e-300)


def test_two_thirds_power_at_the_ends():
    x = np.array([0.0, 5e-324, 1e-310, 1e-40])
    got = np.asarray(two_thirds_power(jnp.asarray([*x, 1.0, jnp.nan])))
    assert ((got[:4] >= 0) & (got[:4] <= x ** (2 / 3) + 1e-300)).all()
    np.testing.assert_array_equal(got[4:], [1, np.nan])
