"""Work, what can be got back and what is lost; and the limit of recovery, by which no contact gives back more."""

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ALL_FORMS,
    FORMS,
    PAPER_THETA,
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

from benchmarks import energy_paths
from mcc_jax.formulas import Contact
from mcc_jax.law import History, MccLaw, Plastic, StrainScaling, Unloading

ROUNDING = 1e-13
"""Of the energy put in: a few hundred pieces of work add up."""


@eqx.filter_jit
def along(law, particle, peak, displacements):
    """Energies at displacements, each with a peak of its own or one for all."""
    peaks = jnp.broadcast_to(peak, displacements.shape)
    return jax.vmap(lambda peak, d: law.energy(particle, History(peak), d))(peaks, displacements)


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
    # Unloading and reloading lose nothing.
    close(e.dissipated, jnp.full(14, e.dissipated[0]), scale=1e-15 * float(e.work[0]))
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
    for d in (0.0, -5.0):  # a virgin particle
        assert jax.tree.leaves(law.energy(p, law.init(p), jnp.array(d))) == [0, 0, 0]


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
    found = along(law, p, peaks, peaks)
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
def balance(law, particle, strain):
    """Dissipated energy and loading force at peaks, with the derivative of the one over the other."""

    def dissipated(peak):
        return law.energy(particle, History(peak), peak).dissipated

    def one(strain):
        peak = particle.displacement(strain)
        lost, slope = jax.value_and_grad(dissipated)(peak)
        force = law.step(particle, law.init(particle), peak)[1]
        residual = law.residual_displacement(particle, History(peak))
        return lost / (force * peak), slope / force, residual / peak

    return jax.vmap(one)(strain)


@pytest.mark.extended
@ALL_FORMS
@pytest.mark.parametrize("modulus", [0.3, 1.0, 30.0, 400.0, 16000.0])
@pytest.mark.parametrize("softening", [0.0, 0.5, 1.0, 1.5])
def test_what_is_lost_never_falls_as_the_peak_grows(unloading, scaling, modulus, softening):
    """From 1e-9 to four times the tested range, for soft moduli, and for curves that fall (9 C3^6 / (20 C1 C5^5) > 1).

    Where the curve falls, what is lost grows while force is given back.
    """
    C1, C5 = 7.0, 2.7
    plastic = Plastic(C1, (softening * 20 / 9 * C1 * C5**5) ** (1 / 6), C5)
    law = paper_law(unloading, scaling, modulus=modulus, plastic=plastic)
    lost, slope, residual = balance(law, paper_particle(6), jnp.geomspace(1e-9, 4 * 0.67, 2000))
    assert jnp.all(lost > 0)
    assert jnp.all(slope > -1e-12)
    assert jnp.all(residual > -1e-15)


@pytest.mark.extended
@ALL_FORMS
def test_random_paths_gain_nothing(unloading, scaling):
    law, particle = energy_paths.draw(3, 1000, unloading, scaling)
    whole, between = energy_paths.gains(*energy_paths.single(law, particle, *energy_paths.choices(3, 1000)))
    assert whole.max() < 0
    assert between.max() <= ROUNDING


@pytest.mark.extended
def test_the_paths_would_show_a_gain(monkeypatch):
    """Without the limit the printed form gains on them, so the test above can fail."""

    def none(self, peak):
        return jnp.full_like(peak, jnp.inf), jnp.ones_like(peak), jnp.zeros_like(peak, bool)

    jax.clear_caches()
    monkeypatch.setattr(Contact, "limit", none)
    law, particle = energy_paths.draw(3, 200, *FORMS[0])
    whole, between = energy_paths.gains(*energy_paths.single(law, particle, *energy_paths.choices(3, 200)))
    jax.clear_caches()
    assert whole.max() > 0.1
    assert between.max() > 0.1


def switch(law, particle):
    """Peak displacement where the limit begins to hold at small strain."""
    free = law.recoverable_strain(particle, jnp.array(0.02))  # of the printed form nearly constant there
    low, high = 1e-9, 2 * float(free)
    for _ in range(60):
        middle = 0.5 * (low + high)
        held = law.recoverable_strain(particle, jnp.array(middle)) >= middle
        low, high = (middle, high) if held else (low, middle)
    return float(particle.displacement(jnp.array(low)))


@pytest.mark.extended
@SOME_FORMS
@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_finite_and_continuous_at_the_switch(unloading, scaling, mode, dtype):
    theta = np.array(PAPER_THETA)
    theta[4] = 300.0  # punch forms then switch at a strain that float32 resolves, all forms again at large strain
    law, p = unpack(jnp.asarray(theta), unloading, scaling)
    at = switch(law, p)
    shares = np.array([0, 1e-12, 1e-3, 0.5, 1 - 1e-3, 1 - 1e-7, 1 - 1e-15, 1, 1 + 1e-15, 1 + 1e-7, 1 + 1e-3, 2, 30])
    peaks = jnp.asarray(np.concatenate([shares * at, [150.0, 250.0, 350.0, 1e3]]), dtype)
    releases = jnp.asarray([0.0, 1e-7, 0.3, 0.9, 1.0, 1.3], dtype)

    @jax.jit
    @jax.vmap
    @jax.vmap
    def both(peak, share):
        def force(theta, peak, share):
            law, p = unpack(theta, unloading, scaling)
            recovered = p.displacement(law.recoverable_strain(p, p.strain(peak)))
            now = peak - share * jnp.where(peak > 0, recovered, 1.0)
            f = law.step(p, History(peak), now)[1]
            return f, law.step_load(p, History(peak), 0.5 * f)[1], law.energy(p, History(peak), now).recoverable

        return force(theta_, peak, share), mode(force, argnums=(0, 1, 2))(theta_, peak, share)

    theta_ = jnp.asarray(theta, dtype)
    values, slopes = both(*jnp.meshgrid(peaks, releases, indexing="ij"))
    assert all_finite((values, slopes))
    below, above = (int(np.flatnonzero(shares == s)[0]) for s in (1 - 1e-7, 1 + 1e-7))
    for value in values[:2]:
        close(value[below], value[above], rel=1e-5, scale=3e-6 * float(jnp.max(jnp.abs(value[above]))))


@pytest.mark.extended
@SOME_FORMS
def test_derivatives_equal_differences_where_the_limit_holds(unloading, scaling):
    """At small strain, where it is the peak, and at large strain, where it is the slope of loading."""
    theta = np.array(PAPER_THETA)
    theta[4] = 300.0 if unloading is not Unloading.PRINTED else 30.0

    @jax.jit
    def force(theta, share):
        law, p = unpack(theta[:8], unloading, scaling)
        recovered = jax.lax.stop_gradient(p.displacement(law.recoverable_strain(p, p.strain(theta[8]))))
        return law.step(p, History(theta[8]), theta[9] - share * recovered)[1]

    with_peak = jax.jit(jax.jacfwd(force))
    reverse = jax.jit(jax.jacrev(force))
    for peak in (1e-3, 250.0):
        law, p = unpack(jnp.asarray(theta), unloading, scaling)
        top, bottom, steep = law.contact(p).limit(jnp.array(peak))
        close(p.displacement(law.recoverable_strain(p, p.strain(jnp.array(peak)))), top / bottom, rel=1e-12)
        assert bool(steep) == (peak > 1)
        point = jnp.asarray([*theta, peak, peak])
        exact = np.asarray(with_peak(point, 0.0 + 0.4))
        close(reverse(point, 0.4), exact, rel=1e-9, scale=1e-12 * np.abs(exact).max())
        fixed = float(p.displacement(law.recoverable_strain(p, p.strain(jnp.array(peak)))))

        @jax.jit
        def moved(theta, now):
            law, p = unpack(theta[:8], unloading, scaling)
            return law.step(p, History(theta[8]), now)[1]

        for k in range(9):
            h = 1e-6 * float(point[k])
            now = peak - 0.4 * fixed
            difference = (moved(point.at[k].add(h), now) - moved(point.at[k].add(-h), now)) / (2 * h)
            close(exact[k], difference, rel=2e-6, scale=1e-7 * float(force(point, 0.4)) / float(point[k]))


@pytest.mark.extended
@pytest.mark.parametrize("form", Unloading)
def test_the_inverse_follows_the_limit(form):
    law, p = paper_law(form, modulus=30.0), paper_particle(6)
    for peak in (1e-4, 1.0, 60.0):
        state = History(peak)
        recovered = p.displacement(law.recoverable_strain(p, p.strain(jnp.array(peak))))
        now = peak - recovered * jnp.linspace(0.01, 0.99, 9)
        force = jnp.stack([law.step(p, state, d)[1] for d in now])
        back = jnp.stack([law.step_load(p, state, f)[1] for f in force])
        close(back, now, scale=1e-13 * peak)


def test_nothing_is_carried_without_force():
    law = MccLaw(Plastic(4.0, 3.6, 2.4), 1.43, 16000.0, Unloading.PRINTED, StrainScaling.RAW)  # stress falls to zero
    strain = jnp.linspace(0.0, 1.0, 200)
    recovered = law.recoverable_strain(paper_particle(1), strain)
    stress = law.loading_stress(paper_particle(1), strain)
    assert (stress == 0).sum() > 1
    assert jnp.all((recovered > 0) == (stress > 0))
