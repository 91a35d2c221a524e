"""Sizes, shape factors and the conversion between curves and force-displacement.

Those of the paper's particles are columns of `tests/law/test_particles_table.py`.
"""

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import A, between, check, close, paper_particle, sphere
from hypothesis import given, settings

from mcc_jax.campaign.paper import PAPER_DIAMETERS_UM
from mcc_jax.geometry import Particle, elastic_shape_factor, plastic_shape_factor

DIAMETERS = between(1, 1000)


@eqx.filter_jit
def sizes_and_shapes(particle, a):
    return (
        particle.effective_diameter,
        plastic_shape_factor(particle, a),
        elastic_shape_factor(particle),
        particle.flatness,
        particle.mean_diameter,
    )


def test_sphere():
    for size in (1e-3, 1.0, 100.0, 1e4):
        for a in (-0.85, 0.0, A):
            assert plastic_shape_factor(sphere(size), a) == 1
        assert elastic_shape_factor(sphere(size)) == 1
        assert sphere(size).flatness == 0
        close(sphere(size).effective_diameter, size, rel=1e-15)
        close(sphere(size).mean_diameter, size, rel=1e-15)
        close(sphere(size).effective_area, np.pi * size**2 / 4, rel=1e-15)


@settings(max_examples=100)
@given(D1=DIAMETERS, D2=DIAMETERS, D3=DIAMETERS, a=between(-2, 2))
def test_exchange_of_D1_and_D2_changes_no_bit(D1, D2, D3, a):
    one, other = (sizes_and_shapes(Particle(*D, D3), jnp.asarray(a)) for D in ((D1, D2), (D2, D1)))
    np.testing.assert_array_equal(one, other)


@settings(max_examples=50)
@given(D=st.tuples(DIAMETERS, DIAMETERS, DIAMETERS), factor=between(0.01, 100))
def test_shape_does_not_depend_on_size(D, factor):
    small, large = (sizes_and_shapes(Particle(*d), jnp.asarray(A)) for d in (D, tuple(factor * d for d in D)))
    close(large[0], factor * small[0], rel=1e-14)
    for i in (1, 3):
        close(large[i], small[i], scale=1e-14 * max(1, D[2] ** 2 / (D[0] * D[1])))
    close(large[2], small[2], rel=1e-13)


@settings(max_examples=50)
@given(D=st.tuples(DIAMETERS, DIAMETERS, DIAMETERS), value=between(1e-6, 1e6))
def test_conversions_and_their_inverses(D, value):
    p, value = Particle(*D), jnp.asarray(value)
    close(p.strain(p.displacement(value)), value, rel=4e-16)
    close(p.stress(p.force(value)), value, rel=1e-15)


def test_units():
    """1 MPa on 1 um^2 is 1 uN = 1e-3 mN; strain is displacement over 2 R_e."""
    p = sphere(100.0)
    close(p.force(jnp.array(10.0)), 10e6 * np.pi * (50e-6) ** 2 * 1e3, rel=1e-15)
    check(p.force(jnp.array(10.0)), "78.5398163397")
    close(p.strain(jnp.array(25.0)), 0.25)
    q = paper_particle(12)
    close(q.stress(jnp.array(275.525225175)), 10.0, rel=1e-11)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("diameters", [(100.0, 100.0, 100.0), (80.0, 100.0, 60.0), (100.0, 80.0, 60.0)])
def test_derivatives_of_the_shape_factors(dtype, mode, diameters):
    D = jnp.array(diameters, dtype)
    for factor in (lambda p: plastic_shape_factor(p, jnp.asarray(A, dtype)), elastic_shape_factor):
        slope = mode(lambda D, factor=factor: factor(Particle(*D)))(D)
        assert slope.dtype == dtype
        assert np.all(np.isfinite(slope))
        # A shape is the same at every size (Euler's theorem).
        close(slope @ D, 0.0, scale=20 * float(jnp.finfo(dtype).eps))
        if dtype == jnp.float64:
            step = 1e-4
            ahead = [factor(Particle(*(D + step * e))) - factor(Particle(*(D - step * e))) for e in jnp.eye(3)]
            # Beside D1 = D2 the closed form grows as |D1 - D2|^1.531.
            close(slope, np.array(ahead) / (2 * step), scale=1e-8)
    if diameters[0] == diameters[1]:
        np.testing.assert_array_equal(mode(lambda D: elastic_shape_factor(Particle(*D)))(D), 0)


def test_batch_by_vmap_only():
    particles = eqx.filter_vmap(Particle)(*jnp.asarray(PAPER_DIAMETERS_UM.T))
    alone = [sizes_and_shapes(paper_particle(i + 1), A)[1] for i in range(20)]
    together = eqx.filter_vmap(sizes_and_shapes, in_axes=(0, None))(particles, A)[1]
    close(together, np.array(alone), rel=2e-16)
    with pytest.raises((ValueError, TypeError)):  # TypeError from the run-time type checker of the tests
        Particle(jnp.ones(2), 1.0, 1.0)


def test_precision_is_that_of_the_input():
    p = Particle(*(jnp.float32(d) for d in (213.54, 196.07, 186.33)))
    for value in (p.effective_diameter, p.effective_area, plastic_shape_factor(p, 1.43), elastic_shape_factor(p)):
        assert value.dtype == jnp.float32
    close(plastic_shape_factor(p, 1.43), 1.24420062209, rel=3e-7)
