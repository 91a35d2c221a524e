"""The closed-form references: Hertz, exactly for an elliptic contact, and the plastic similarity solution."""

import math

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from helpers import EBAR, K1, between, check, close, first_in_core, paper_particle, sphere
from hypothesis import given, settings

from mcc_jax.geometry import Particle
from mcc_jax.law import (
    hertz_shape_factor,
    hertz_stress,
    ideal_plastic_stress,
    similarity_strength,
    similarity_stress,
)

ONE = jnp.array(1.0)
factor = eqx.filter_jit(hertz_shape_factor)


@mpmath.workdps(40)
def exact_factor(ratio):
    """Johnson's eqs. 4.26-4.28 as they stand, with mpmath's elliptic integrals."""
    curvature = mpmath.mpf(ratio) ** 2

    def excess(q):
        b = mpmath.exp(-q)
        K, E = mpmath.ellipk(1 - b * b), mpmath.ellipe(1 - b * b)
        return mpmath.log((E / b**2 - K) / (K - E) / curvature)

    start = mpmath.log(ratio)
    b = mpmath.exp(-mpmath.findroot(excess, (start * 1.02, start * 1.34), solver="anderson", tol=1e-35))
    m = 1 - b * b
    K, E = mpmath.ellipk(m), mpmath.ellipe(m)
    F1 = mpmath.cbrt(4 / (mpmath.pi * m) * b ** mpmath.mpf(1.5) * mpmath.sqrt((E / b**2 - K) * (K - E)))
    return float(mpmath.pi / 2 / mpmath.sqrt(b) * F1 / K)


@pytest.mark.parametrize(
    ("ratio", "printed"),
    [
        (1.0, "1"),
        (213.54 / 196.07, "1.0004046425"),
        (217.51 / 155.32, "1.00628084216"),
        (205.93 / 121.04, "1.01557169157"),
        (2.0, "1.02636302342"),
        (3.0, "1.065193511"),
        (5.0, "1.136767894"),
    ],
)
def test_hertz_shape_factor_values(ratio, printed):
    check(factor(Particle(ratio, 1.0, 1.0)), printed)
    check(factor(Particle(70.0, 70 * ratio, 30.0)), printed)


@pytest.mark.parametrize("ratio", [1.0001, 1.01, 1.3, 4.0, 30.0, 1e3, 1e6])
def test_hertz_shape_factor_to_the_last_digits(ratio):
    close(factor(Particle(ratio, 1.0, 1.0)), exact_factor(ratio), rel=1e-15)
    close(factor(Particle(*(jnp.float32(v) for v in (ratio, 1, 1)))), exact_factor(ratio), rel=1e-6)


@pytest.mark.parametrize("mode", first_in_core([jax.jacfwd, jax.jacrev]))
@pytest.mark.parametrize("dtype", [pytest.param(jnp.float32, marks=pytest.mark.extended), jnp.float64])
def test_hertz_shape_factor_derivatives(mode, dtype):
    function = jax.jit(jax.vmap(lambda D1: hertz_shape_factor(Particle(D1, jnp.asarray(100, dtype), D1))))
    first = jax.jit(jax.vmap(mode(lambda D1: hertz_shape_factor(Particle(D1, jnp.asarray(100, dtype), D1)))))
    second = jax.jit(
        jax.vmap(mode(jax.jacfwd(lambda D1: hertz_shape_factor(Particle(D1, jnp.asarray(100, dtype), D1)))))
    )
    D1 = jnp.array([100.0, 100.001, 37.0, 1000.0], dtype)
    assert jnp.all(jnp.isfinite(first(D1)))
    assert first(D1)[0] == 0
    # log eta_e = (log D1/D2)^2 / 18 + ... : even and analytic, unlike the closed form of the paper.
    close(second(D1)[0], 1 / 9 / 100**2, rel=1e-5)
    assert jnp.all(jnp.isfinite(second(D1)))
    if dtype == jnp.float64:
        close(first(D1), (function(D1 + 1e-3) - function(D1 - 1e-3)) / 2e-3, scale=1e-10)
        close(second(D1), (first(D1 + 1e-3) - first(D1 - 1e-3)) / 2e-3, scale=1e-10)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(log_ratio=between(-5, 5), step=between(1e-3, 1))
def test_hertz_shape_factor_is_symmetric_and_grows_with_elongation(log_ratio, step):
    ratio = math.exp(log_ratio)
    value = factor(Particle(ratio, 1.0, 1.0))
    assert value == factor(Particle(1.0, ratio, 1.0))
    assert value >= 1
    assert factor(Particle(ratio * math.exp(math.copysign(step, log_ratio)), 1.0, 1.0)) > value


def test_hertz_stress_values_in_both_conventions():
    strain = jnp.array(1e-3)
    check(hertz_stress(strain, EBAR), "0.607370703716")
    check(hertz_stress(strain, EBAR, contacts=2), "0.214737971646")
    check(hertz_stress(strain, EBAR) / hertz_stress(strain, EBAR, contacts=2), "2.828427")
    close(hertz_stress(ONE, 1.0), 8 * np.sqrt(2) / (3 * np.pi), rel=1e-15)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(number=st.integers(1, 20), strain=between(1e-6, 0.1))
def test_hertz_stress_is_the_force_law(number, strain):
    """F = 4/3 Ebar sqrt(R_e) (eta_e gamma)^1.5 (eq. 1 of the paper), in mN from um and MPa."""
    p = paper_particle(number)
    eta = factor(p)
    force = 4 / 3 * EBAR * np.sqrt(p.effective_radius) * (eta * p.displacement(jnp.array(strain))) ** 1.5 * 1e-3
    close(p.force(hertz_stress(jnp.array(strain), EBAR, eta)), force, rel=1e-13)


@pytest.mark.parametrize(
    ("exponent", "printed"),
    [
        (1, "1.59648769799"),
        (2, "5.9088047015"),
        (5, "11.5331567289"),
        (10, "14.1364078633"),
        (math.inf, "17.16"),
    ],
)
def test_similarity_constants(exponent, printed):
    check(similarity_stress(ONE, 1.0, exponent), printed)
    check(similarity_stress(ONE, 1.0, jnp.asarray(float(exponent))), printed)
    inverse = 0 if exponent == math.inf else 1 / exponent
    shared = similarity_stress(ONE, 1.0, exponent, contacts=2)
    close(shared, similarity_stress(ONE, 1.0, exponent) / 2 ** (1 + inverse / 2), rel=1e-15)


def test_similarity_tends_to_ideal_plasticity():
    strain = jnp.linspace(0, 0.05, 6)
    for contacts, prefactor in ((1, 17.16), (2, 8.58)):
        ideal = ideal_plastic_stress(strain, 0.41, contacts=contacts)
        close(ideal, prefactor * 0.41 * strain, rel=1e-15)
        close(similarity_stress(strain, 0.41, math.inf, contacts=contacts), ideal, rel=1e-15)
        close(similarity_stress(strain, 0.41, 1e9, contacts=contacts), ideal, rel=1e-7)
    check(ideal_plastic_stress(ONE, K1 / 17.16), "7.0094")


def test_similarity_strength():
    close(similarity_strength(0.4, 1600.0, 2.0), np.sqrt(0.4 * 1600), rel=1e-15)
    close(similarity_strength(0.4, 1600.0, 1), 1600.0, rel=1e-15)
    close(similarity_strength(0.4, 1600.0, math.inf), 0.4, rel=1e-15)


STRESSES = [
    lambda e, c: hertz_stress(e, 100.0, 1.1, contacts=c),
    lambda e, c: similarity_stress(e, 3.0, 4.0, contacts=c),
    lambda e, c: similarity_stress(e, 3.0, math.inf, contacts=c),
    lambda e, c: ideal_plastic_stress(e, 3.0, contacts=c),
]


@pytest.mark.parametrize("stress", STRESSES)
@pytest.mark.parametrize("contacts", [0, 3, -1])
def test_other_numbers_of_contacts_are_refused(stress, contacts):
    with pytest.raises(ValueError, match=r"contacts=1 .*contacts=2 "):
        stress(ONE, contacts)


@pytest.mark.parametrize("stress", STRESSES)
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_no_stress_out_of_contact_and_finite_derivatives(stress, mode, dtype):
    strain = jnp.array([-0.1, 0.0, 1e-12, 0.1], dtype)
    values = stress(strain, 1)
    assert values.dtype == dtype
    np.testing.assert_array_equal(values[:2], 0)
    slopes = jax.vmap(mode(lambda e: stress(e, 1)))(strain)
    assert jnp.all(jnp.isfinite(slopes))
    assert slopes[0] == 0
    assert slopes[3] > 0


def test_sphere_needs_no_shape_factor():
    strain = jnp.array([0.01, 0.02])
    np.testing.assert_array_equal(hertz_stress(strain, 5.0, factor(sphere())), hertz_stress(strain, 5.0))
