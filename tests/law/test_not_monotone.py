"""Laws whose loading curve falls somewhere: 2.4 % of the paper's population."""

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    all_finite,
    between,
    close,
    master_strain,
    master_stress,
    paper_particle,
    scaled_paths,
    shape_factor,
    thetas,
    unpack,
)
from hypothesis import given, settings

from mcc_jax.law import History, MccLaw, Plastic

EXAMPLE = Plastic(4.0, 3.0, 2.4)
FALLING = between(1.01, 3.0)  # 9 C3^6 / (20 C1 C5^5); above 1.8 the bare quintic is tensile


@eqx.filter_jit
def under_displacement(law, p, state, path):
    return law.path(p, state, path)


@eqx.filter_jit
def under_load(law, p, state, path):
    return law.path_load(p, state, path)


def envelope(plastic, targets, end):
    """Smallest scaled strain at which the running maximum of the curve reaches each stress, by brute force."""
    x = np.linspace(0, end, 400_001)
    highest = np.maximum.accumulate(np.asarray(master_stress(plastic, jnp.asarray(x))))
    index = np.searchsorted(highest, targets)
    return x[np.maximum(index - 1, 0)], x[index]


@settings(max_examples=25, deadline=None, derandomize=True)
@given(numbers=st.tuples(between(1, 20), between(1.5, 4)), softening=FALLING)
def test_load_control_snaps_through(numbers, softening):
    """Strain under load is the running-maximum envelope: it jumps from the peak over the trough."""
    C1, C5 = numbers
    plastic = Plastic(C1, (softening * 20 / 9 * C1 * C5**5) ** (1 / 6), C5)
    assert not plastic.is_monotone
    K1, K3, K5 = (float(k) for k in plastic.polynomial)
    peak = np.sqrt((3 * K3 - np.sqrt(9 * K3**2 - 20 * K1 * K5)) / (10 * K5))
    top = float(master_stress(plastic, jnp.array(peak)))
    end = 4 * np.sqrt(K3 / K5)
    targets = top * np.array([1e-6, 0.1, 0.5, 0.9, 0.99, 0.9999, 1.0001, 1.01, 1.5, 3.0])
    x = np.asarray(master_strain(plastic, jnp.asarray(targets)))
    low, high = envelope(plastic, targets, end)
    assert np.all(x >= low - 1e-9 * end)
    assert np.all(x <= high + 1e-9 * end)
    close(master_stress(plastic, jnp.asarray(x)), targets, rel=1e-9)
    assert np.all(x[:6] < peak)
    trough = np.sqrt((3 * K3 + np.sqrt(9 * K3**2 - 20 * K1 * K5)) / (10 * K5))
    assert np.all(x[6:] > trough)


@pytest.mark.extended
@settings(max_examples=20, deadline=None, derandomize=True)
@given(theta=thetas(softening=FALLING), fractions=st.lists(between(0.01, 3), min_size=12, max_size=12))
def test_forces_are_met_under_load_control(theta, fractions):
    """Loading, unloading and reloading by force: displacement control then gives back each force."""
    law, p = unpack(theta)
    K1, K3, K5 = (float(k) for k in law.plastic.polynomial)
    peak = np.sqrt((3 * K3 - np.sqrt(9 * K3**2 - 20 * K1 * K5)) / (10 * K5))
    force = p.force(master_stress(law.plastic, jnp.array(peak))) * jnp.asarray(fractions)
    _, d = under_load(law, p, law.init(p), force)
    _, back = under_displacement(law, p, law.init(p), d)
    close(back, force, rel=1e-6, scale=1e-9 * float(force.max()))
    highest = np.maximum.accumulate(np.asarray(force))
    peaks = np.maximum.accumulate(np.asarray(d))
    grows = np.diff(highest) > 1e-12 * highest[1:]  # not by a rounding only
    assert np.all(np.diff(peaks)[grows] > 0)


@pytest.mark.extended
def test_behind_the_peak_there_is_no_way_back():
    """A particle pushed down the falling branch and then loaded by force goes on to the rising branch."""
    law, p = MccLaw(EXAMPLE, 1.43, 16000.0), paper_particle(1)
    scale = float(p.effective_diameter / law.shape_factor(p))
    state = History(0.32 * scale)
    at = float(law.step(p, state, state.displacement_max)[1])
    top = float(p.force(EXAMPLE.stress(jnp.array(0.290470885402))))
    assert at < top
    _, d = under_load(law, p, state, jnp.array([at * (1 + 1e-9), (at + top) / 2, 1.01 * top]))
    x = np.asarray(d) / scale
    assert np.all(x > 0.345075622969)
    assert np.all(np.diff(x) > 0)
    close(under_displacement(law, p, state, d)[1], jnp.array([at * (1 + 1e-9), (at + top) / 2, 1.01 * top]), rel=1e-12)
    # Below the force reached it unloads elastically from where it is.
    _, d = under_load(law, p, state, jnp.array([0.5 * at]))
    close(under_displacement(law, p, state, d)[1], jnp.array([0.5 * at]), rel=1e-12)


@pytest.mark.extended
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_a_tensile_quintic_carries_nothing(dtype, mode):
    """K3^2 > 4 K1 K5: pushed into the range where the polynomial pulls, the particle has no force and no stiffness."""
    C = [4.0, 3.6, 2.4]
    theta = jnp.asarray([*C, 1.43, 16000.0, 200.0, 210.0, 160.0], dtype)
    eta, D_e = shape_factor(np.asarray(theta, float))
    K1, K3, K5 = C[0], C[1] ** 3, C[2] ** 5
    dead = np.sqrt(K3 / (2 * K5))
    assert K1 - K3 * dead**2 + K5 * dead**4 < 0
    x = jnp.asarray(np.array([0.1, dead, dead, dead * 0.99, 0.2, 0.9, dead]) * D_e / eta, dtype)

    def forces(theta, x):
        law, p = unpack(theta)
        return law.path(p, law.init(p), x)[1]

    force = jax.jit(forces)(theta, x)
    assert force.dtype == dtype
    np.testing.assert_array_equal(force[1:5], 0)
    assert force[0] > 0
    assert force[5] > 0
    assert all_finite(jax.jit(mode(forces, argnums=(0, 1)))(theta, x))

    def displacements(theta, f):
        law, p = unpack(theta)
        return law.path_load(p, History(jnp.asarray(dead * D_e / eta, dtype)), f)[1]

    f = jnp.asarray([0.0, -1.0, 0.1, 1.0, 0.5, 0.0], dtype)
    assert jnp.all(jnp.isfinite(jax.jit(displacements)(theta, f)))
    assert all_finite(jax.jit(mode(displacements, argnums=(0, 1)))(theta, f))


@pytest.mark.extended
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@settings(max_examples=10, deadline=None, derandomize=True)
@given(theta=thetas(softening=FALLING), x=scaled_paths(steps=16, high=1.0))
def test_derivatives_are_finite(mode, theta, x):
    eta, D_e = shape_factor(theta)
    path = jnp.asarray(x * D_e / eta)
    assert all_finite(jacobian(mode, theta, path))


@eqx.filter_jit
def jacobian(mode, theta, path):
    def both(theta, path):
        law, p = unpack(theta)
        force = law.path(p, law.init(p), path)[1]
        return force, law.path_load(p, law.init(p), jax.lax.stop_gradient(force))[1]

    return mode(both, argnums=(0, 1))(jnp.asarray(theta), path)
