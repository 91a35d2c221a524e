"""Work, what can be got back and what is lost."""

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ALL_FORMS,
    SOME_FORMS,
    all_finite,
    between,
    close,
    force_along,
    paper_law,
    paper_particle,
    shape_factor,
    thetas,
    unpack,
)
from hypothesis import given, settings

from mcc_jax.law import Energy, History, Plastic


@eqx.filter_jit
def along(law, particle, peak, displacements):
    return jax.vmap(lambda d: law.energy(particle, History(peak), d))(displacements)


@pytest.mark.extended
@ALL_FORMS
@settings(max_examples=8, deadline=None, derandomize=True)
@given(theta=thetas(), x=between(0.1, 0.7), share=between(0.05, 1.2))
def test_work_is_the_integral_of_force(unloading, scaling, theta, x, share):
    """Up, down and up again, by Gauss-Legendre on every smooth piece."""
    law, p = unpack(theta, unloading, scaling)
    eta, D_e = shape_factor(theta)
    peak = jnp.asarray(x * D_e / eta)
    recovered = p.displacement(law.recoverable_strain(p, p.strain(peak)))
    end = peak - share * recovered
    nodes, weights = np.polynomial.legendre.leggauss(40)
    up = jnp.asarray((nodes + 1) / 2) * peak
    # The branch starts as a power 3/2 at full release: a quadratic map makes it smooth there.
    lowest = jnp.maximum(peak - recovered, end)
    t, dt = (nodes + 1) / 2, weights / 2
    down = lowest + jnp.asarray(t**2) * (peak - lowest)
    F = np.asarray(force_along(law, p, jnp.concatenate([up, peak[None], down])))
    loaded = float(np.sum(weights / 2 * F[:40]) * peak)
    returned = float(np.sum(dt * 2 * t * F[41:]) * (peak - lowest))
    state = along(law, p, peak, jnp.stack([peak, end]))
    close(state.work[0], loaded, rel=1e-12)
    close(state.work[0] - state.work[1], returned, rel=1e-7, scale=1e-11 * loaded)
    close(law.contact(p).work(peak), loaded, rel=1e-12)


@ALL_FORMS
@settings(max_examples=8, deadline=None, derandomize=True)
@given(theta=thetas(), x=between(0.02, 0.7))
def test_balance(unloading, scaling, theta, x):
    law, p = unpack(theta, unloading, scaling)
    eta, D_e = shape_factor(theta)
    peak = jnp.asarray(x * D_e / eta)
    recovered = p.displacement(law.recoverable_strain(p, p.strain(peak)))
    displacements = peak - recovered * jnp.linspace(0, 1.3, 14)
    e = along(law, p, peak, displacements)
    close(e.work, e.recoverable + e.dissipated, rel=1e-15)
    close(
        e.dissipated, jnp.full(14, e.dissipated[0]), scale=1e-15 * float(e.work[0])
    )  # unloading, reloading lose nothing
    assert jnp.all(jnp.diff(e.recoverable) <= 0)
    assert jnp.all(e.recoverable >= 0)
    assert e.recoverable[-1] == 0
    # 4/(3 pi) sigma_P delta, over the volume pi R_e^2 D_e.
    F = force_along(law, p, peak[None])[0]
    close(e.recoverable[0], 4 / (3 * np.pi) * F * recovered, rel=1e-13)


def test_further_loading_counts_from_the_new_peak():
    law, p = paper_law(), paper_particle(2)
    fresh = law.energy(p, law.init(p), jnp.array(50.0))
    again = law.energy(p, History(30.0), jnp.array(50.0))
    for one, other in zip(jax.tree.leaves(fresh), jax.tree.leaves(again), strict=True):
        assert one == other
    close(fresh.work, law.contact(p).work(jnp.array(50.0)), rel=1e-15)


@pytest.mark.extended
@SOME_FORMS
@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_energy_is_finite_with_its_derivatives_everywhere(unloading, scaling, mode, dtype):
    theta = jnp.asarray([7.0, 3.0, 2.7, 1.43, 16000.0, 200.0, 210.0, 160.0], dtype)

    @jax.jit
    @jax.vmap
    def both(peak, d):
        def energy(theta, peak, d):
            law, p = unpack(theta, unloading, scaling)
            return law.energy(p, History(peak), d)

        return energy(theta, peak, d), mode(energy, argnums=(0, 1, 2))(theta, peak, d)

    peaks = jnp.array([0, 0, 0, 80, 80, 80, 80, 80, 80], dtype)
    now = jnp.array([0, -5, 10, 80, jnp.nextafter(jnp.asarray(80, dtype), jnp.asarray(0, dtype)), 79, 40, 0, 90], dtype)
    values, slopes = both(peaks, now)
    assert isinstance(values, Energy)
    assert all_finite((values, slopes))
    for i in (0, 1):  # a virgin particle
        assert values.work[i] == values.recoverable[i] == values.dissipated[i] == 0


@settings(max_examples=20, deadline=None, derandomize=True)
@given(x=between(0.05, 0.7), share=st.floats(0.01, 0.99))
def test_force_is_the_slope_of_the_stored_energy(x, share):
    law, p = paper_law(), paper_particle(9)
    eta = float(law.shape_factor(p))
    peak = p.displacement(jnp.array(x / eta))
    d = peak - share * p.displacement(law.recoverable_strain(p, p.strain(peak)))
    slope = stored_slope(p, peak, d)
    close(slope, force_along(law, p, jnp.stack([peak, d]))[1], rel=1e-9)


@eqx.filter_jit
def stored_slope(p, peak, d):
    return jax.grad(lambda d: paper_law().energy(p, History(peak), d).recoverable)(d)


@pytest.mark.extended
@pytest.mark.parametrize("C3", [3.0, 3.29, 3.3, 3.6, 4.2])
def test_no_work_where_the_quintic_would_pull(C3):
    """The force is zero there; the work is that of the force, and its slope is the force, also in the coefficients."""
    p, plastic = paper_particle(4), Plastic(4.0, C3, 2.4)
    law = paper_law(plastic=plastic)
    scale = float(p.effective_diameter / law.shape_factor(p))
    path = jnp.linspace(0.0, 1.2 * scale, 40_001)
    F = np.asarray(force_along(law, p, path))
    work = np.concatenate([[0.0], np.cumsum(0.5 * (F[1:] + F[:-1])) * float(path[1])])
    peaks = path[::4000]
    found = along_peaks(law, p, peaks)
    close(found.work, work[::4000], rel=1e-6, scale=1e-12)
    assert jnp.all(jnp.diff(found.dissipated) >= -1e-12)
    slopes = jax.vmap(jax.grad(lambda d: law.contact(p).work(d)))(peaks)
    close(slopes, F[::4000], scale=1e-11 * F.max())
    x = jnp.asarray(1.1)
    exact = np.asarray(jax.jacrev(lambda K: Plastic.from_polynomial(*K).curve.work(x))(jnp.asarray(plastic.polynomial)))
    for k in range(3):
        up, down = (jnp.asarray(plastic.polynomial).at[k].multiply(1 + h) for h in (1e-6, -1e-6))
        slope = (Plastic.from_polynomial(*up).curve.work(x) - Plastic.from_polynomial(*down).curve.work(x)) / (
            up[k] - down[k]
        )
        close(exact[k], slope, rel=2e-5)


@eqx.filter_jit
def along_peaks(law, particle, peaks):
    return jax.vmap(lambda d: law.energy(particle, History(d), d))(peaks)
