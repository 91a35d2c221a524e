"""The elastic branch f(s), its inverse and its energy."""

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from helpers import EPS, check, close
from hypothesis import given, settings
from scipy.integrate import quad

from mcc_jax.formulas import recovery
from mcc_jax.law import energy_ratio, stress_ratio

f = eqx.filter_jit(eqx.filter_vmap(stress_ratio))
f_inverse = eqx.filter_jit(eqx.filter_vmap(recovery))
g = eqx.filter_jit(eqx.filter_vmap(energy_ratio))


@mpmath.workdps(60)
def exact_f(s):
    s = mpmath.mpf(float(s))
    return float(2 / mpmath.pi * (mpmath.acos(s) - s * mpmath.sqrt(1 - s * s)))


@mpmath.workdps(60)
def exact_g(s):
    s = mpmath.mpf(float(s))
    root = mpmath.sqrt(1 - s * s)
    return float(2 / mpmath.pi * (root - s * mpmath.acos(s) - root**3 / 3))


@mpmath.workdps(40)
def exact_recovery(ratio):
    target = mpmath.pi * mpmath.mpf(float(ratio))
    start = mpmath.cbrt(6 * target) if ratio < 0.3 else target
    return float(mpmath.cos(mpmath.findroot(lambda E: E - mpmath.sin(E) - target, start) / 2))


@pytest.fixture(scope="module")
def shares():
    """Shares of recovered strain, dense in the middle and towards both ends."""
    ends = np.logspace(-14, -2, 61)
    return np.concatenate([[0.0], ends, np.linspace(0.01, 0.99, 197), 1 - ends[::-1]])


@pytest.mark.extended
@pytest.mark.parametrize(
    ("s", "printed"),
    [
        (0.0, ["1", "-1.2732395447", "0", "1.2732395447"]),
        (0.5, ["0.391002218956", "-1.10265779084", "0.735105193896", "1.96028051706"]),
    ],
)
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_up_to_third_order(s, printed, mode):
    function = stress_ratio
    for order, text in enumerate(printed):
        check(function(jnp.array(s)), text)
        if order < 3:
            function = mode(function)


def test_is_the_punch_decomposition():
    """The force left when the pressure of flat punches has shrunk to radius a = t a_P, by quadrature."""
    for s in (0.25, 0.7):
        t2 = 1 - s * s
        left, _ = quad(lambda r: 4 / np.pi * r * np.arcsin(np.sqrt((t2 - r * r) / (1 - r * r))), 0, np.sqrt(t2))  # noqa: B023
        close(stress_ratio(jnp.array(s)), left, rel=1e-8)


@pytest.mark.parametrize("dtype", EPS)
def test_stress_ratio_accuracy(shares, dtype):
    s = np.unique(shares.astype(dtype))
    s = s[s < 1]
    exact = np.array([exact_f(x) for x in s])
    actual = np.asarray(f(jnp.asarray(s)))
    assert actual.dtype == dtype
    close(actual, exact, scale=(4e-16 if dtype == np.float64 else 2e-7))
    close(actual, exact, rel=(1e-13 if dtype == np.float64 else 3.1e-6))
    close(f(jnp.array([1 - 1e-14, 1 - 1e-10])), [exact_f(1 - 1e-14), exact_f(1 - 1e-10)], rel=1e-13)


@pytest.mark.parametrize("dtype", EPS)
def test_energy_ratio_accuracy(shares, dtype):
    s = np.unique(shares.astype(dtype))
    s = s[s < 1]
    exact = np.array([exact_g(x) for x in s])
    close(g(jnp.asarray(s)), exact, rel=(1e-14 if dtype == np.float64 else 3e-6))


@pytest.mark.parametrize("dtype", EPS)
def test_recovery_accuracy(shares, dtype):
    """Against Kepler's equation E - sin E = pi r, s = cos(E/2), in high precision."""
    ratios = np.unique(shares.astype(dtype))[1::7]
    ratios = ratios[(ratios > 0) & (ratios < 1)]
    exact = [exact_recovery(r) for r in ratios]
    actual = f_inverse(jnp.asarray(ratios))
    assert actual.dtype == dtype
    close(actual, exact, scale=(4e-16 if dtype == np.float64 else 2e-7))


@pytest.mark.extended
def test_ends_are_exact_and_outside_is_flat():
    outside = jnp.array([-jnp.inf, -1.0, -1e-300, 0.0, 1.0, 1.0 + 2**-52, 2.0, jnp.inf])
    released = np.array([0, 0, 0, 0, 1, 1, 1, 1])
    np.testing.assert_array_equal(f(outside), 1 - released)
    close(f_inverse(outside), 1 - released, scale=2**-53)
    np.testing.assert_array_equal(f_inverse(outside)[4:], 0)
    close(g(outside), (1 - released) * 4 / (3 * np.pi), rel=4e-16)
    for function in (stress_ratio, recovery, energy_ratio):
        slope = jax.vmap(jax.grad(function))(outside[jnp.array([0, 1, 2, 5, 6, 7])])
        np.testing.assert_array_equal(slope, 0)


@pytest.mark.parametrize("function", [stress_ratio, recovery, energy_ratio])
@pytest.mark.parametrize("mode", [jax.grad, jax.jacfwd])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_derivative_is_finite_everywhere(function, mode, dtype):
    tiny = jnp.finfo(dtype).tiny
    points = jnp.array([0.0, tiny, 1e-12, 1e-9, 0.5, 1 - 1e-6, 1.0, 1.5, -0.5], dtype)
    slope = jax.jit(jax.vmap(mode(function)))(points)
    assert slope.dtype == dtype
    assert jnp.all(jnp.isfinite(slope))


def test_derivative_at_the_onset_is_one_sided():
    close(jax.grad(stress_ratio)(jnp.array(0.0)), -4 / np.pi, rel=1e-15)
    close(jax.grad(recovery)(jnp.array(1.0)), -np.pi / 4, rel=1e-15)
    close(jax.grad(energy_ratio)(jnp.array(0.0)), -1.0, rel=1e-15)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(r=st.floats(0, 1), s=st.floats(0, 1))
def test_inverse_both_ways(r, s):
    close(f(f_inverse(jnp.array([r]))), np.array([r]), scale=4.5e-16)
    # s from f loses what f' = -(4/pi) sqrt(1 - s^2) lacks near s = 1.
    back = f_inverse(f(jnp.array([s])))
    close(back, np.array([s]), scale=4e-16 + 1e-15 * (1 - s))


@settings(max_examples=30, deadline=None, derandomize=True)
@given(s=st.floats(0, 0.999))
def test_energy_is_the_integral_of_stress(s):
    area, _ = quad(lambda t: 2 / np.pi * (np.arccos(t) - t * np.sqrt(1 - t * t)), s, 1, epsabs=1e-13)
    close(g(jnp.array([s]))[0], area, scale=1e-11)
    slope = jax.grad(energy_ratio)(jnp.array(s))
    close(slope, -stress_ratio(jnp.array(s)), rel=1e-15)
