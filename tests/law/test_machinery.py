"""One law, many ways through it: scan, closed form, batches, single precision, both kinds of control."""

import functools
import itertools

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ALL_FORMS,
    PAPER_THETA,
    between,
    close,
    displacement_along,
    force_along,
    paper_law,
    paper_particle,
    scaled_paths,
    shape_factor,
    thetas,
    unpack,
    with_dtype,
)
from hypothesis import given, settings

from mcc_jax.geometry import Particle
from mcc_jax.law import AbstractContactLaw, History, MccLaw, Plastic, StrainScaling, Unloading


@functools.cache
def routes(unloading, scaling):
    """Closed form and scan, compiled: f(theta, start, displacements or forces)."""

    def along(route, theta, start, path):
        law, p = unpack(theta, unloading, scaling)
        state, response = route(law, p, History(start), path)
        return state.displacement_max, response

    return {
        name: jax.jit(functools.partial(along, getattr(cls, name_of)))
        for name, cls, name_of in (
            ("path", MccLaw, "path"),
            ("path by scan", AbstractContactLaw, "path"),
            ("load", MccLaw, "path_load"),
            ("load by scan", AbstractContactLaw, "path_load"),
        )
    }


@ALL_FORMS
@settings(max_examples=10, deadline=None, derandomize=True)
@given(theta=thetas(), x=scaled_paths(), start=st.one_of(st.just(0.0), between(0.0, 0.6)))
def test_closed_form_is_the_scan(unloading, scaling, theta, x, start):
    """Random paths with holds, revisited levels, negative values and a starting history."""
    run = routes(unloading, scaling)
    eta, D_e = shape_factor(theta)
    path, start = jnp.asarray(x * D_e / eta), jnp.asarray(start * D_e / eta)
    (peak, force), (peak_scan, force_scan) = (run[name](theta, start, path) for name in ("path", "path by scan"))
    scale = float(jnp.max(jnp.abs(force)))
    assert peak == peak_scan == max(float(start), float(path.max()))
    close(force, force_scan, scale=1e-13 * scale)
    assert jnp.all(force >= 0)
    # The forces now drive the particle, together with pulls and forces beyond.
    pulls = jnp.where(jnp.arange(path.size) % 7 == 3, -0.1 * scale, force)
    (peak, d), (peak_scan, d_scan) = (run[name](theta, start, pulls) for name in ("load", "load by scan"))
    close(peak, peak_scan, rel=1e-13)
    close(d, d_scan, scale=1e-13 * float(jnp.max(jnp.abs(path))))
    assert jnp.all(d <= peak)


@ALL_FORMS
@settings(max_examples=10, deadline=None, derandomize=True)
@given(theta=thetas(softening=between(0.0, 0.8)), x=scaled_paths(), start=st.one_of(st.just(0.0), between(0.0, 0.6)))
def test_load_control_undoes_displacement_control(unloading, scaling, theta, x, start):
    run = routes(unloading, scaling)
    eta, D_e = shape_factor(theta)
    path, start = jnp.asarray(x * D_e / eta), jnp.asarray(start * D_e / eta)
    _, force = run["path"](theta, start, path)
    _, back = run["load"](theta, start, force)
    loaded = np.asarray(force) > 1e-9 * float(force.max())
    close(back[loaded], path[loaded], rel=1e-13, scale=1e-13 * float(jnp.max(jnp.abs(path))))
    _, again = run["path"](theta, start, back)
    # On a stiff branch one rounding of the displacement is many of the force.
    law, p = unpack(theta, unloading, scaling)
    recovered = p.displacement(law.recoverable_strain(p, jnp.asarray(np.array([0.1, 0.3, 0.7]) / eta)))
    stiffest = float(jnp.max(1 / recovered))
    rounding = 1e-14 + 4e-16 * float(jnp.max(jnp.abs(path))) * stiffest
    close(again, force, scale=10 * rounding * max(float(force.max()), 1e-3))


@ALL_FORMS
def test_loading_inverse_meets_the_force(unloading, scaling):
    """Residual of the force under load control: at most 1e-14 of it, from 1e-9 to 1e4 mN."""
    law, p = paper_law(unloading, scaling), paper_particle(4)
    force = jnp.logspace(-9, 4, 200)
    d = displacement_along(law, p, force)
    close(force_along(law, p, d), force, rel=1e-14)


def test_vmap_is_the_loop():
    """Over laws, particles and paths at once."""
    rng = np.random.default_rng(5)
    n = 6
    numbers = np.arange(1, n + 1)
    particles = eqx.filter_vmap(Particle)(*jnp.array([[p.D1, p.D2, p.D3] for p in map(paper_particle, numbers)]).T)
    C = jnp.asarray(PAPER_THETA[:3] * rng.uniform(0.95, 1.05, (n, 3)))
    laws = eqx.filter_vmap(lambda C, E: MccLaw(Plastic(*C), 1.43, E))(C, jnp.linspace(8e3, 2e4, n))
    paths = jnp.asarray(rng.uniform(0, 60, (n, 15)))

    def both(law, p, path):
        force = law.path(p, law.init(p), path)[1]
        return force, law.path_load(p, law.init(p), force)[1]

    force, displacement = eqx.filter_jit(eqx.filter_vmap(both))(laws, particles, paths)
    one = eqx.filter_jit(both)
    for i in range(n):
        law, p = (jax.tree.map(lambda x, i=i: x[i], tree) for tree in (laws, particles))
        f, d = one(law, p, paths[i])
        close(force[i], f, scale=1e-13 * float(f.max()))
        close(displacement[i], d, rel=1e-13)


@pytest.mark.extended
def test_new_numbers_do_not_recompile():
    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def run(law, p, state, path):
        state, force = law.path(p, state, path)
        return state, force, law.path_load(p, state, force)[1], law.energy(p, state, path[0])

    path = jnp.linspace(0.0, 50.0, 9)
    for factor in (1.0, 1.1, 0.9):
        law = paper_law(plastic=Plastic(7.0 * factor, 3.0 / factor, 2.7), modulus=16000.0 * factor)
        run(law, Particle(200.0 * factor, 190.0, 160.0), History(3.0 * factor), factor * path)


@pytest.mark.extended
@pytest.mark.parametrize("number", [1, 6, 12, 16, 20])
def test_single_precision(number):
    """Printed form: within 3e-6 of the peak stress, from the same rounded inputs."""
    single = with_dtype(paper_law(), jnp.float32), with_dtype(paper_particle(number), jnp.float32)
    eta = float(single[0].shape_factor(single[1]))
    top = float(single[1].effective_diameter) / eta
    knots = np.array([0.0, 0.35, 0.32, 0.5, 0.47, 0.48, 0.465, 0.67, 0.6]) * top
    path = np.concatenate([np.linspace(a, b, 400) for a, b in itertools.pairwise(knots)]).astype(np.float32)

    def run(law, p, path):
        force = law.path(p, law.init(p), path)[1]
        return force, law.path_load(p, law.init(p), force)[1]

    force, displacement = eqx.filter_jit(run)(*single, jnp.asarray(path))
    double = tuple(with_dtype(t, jnp.float64) for t in single)
    exact, _ = eqx.filter_jit(run)(*double, jnp.asarray(path, jnp.float64))
    assert force.dtype == displacement.dtype == jnp.float32
    peak = np.maximum.accumulate(np.asarray(exact))
    close(force, exact, scale=3e-6 * float(peak[-1]))
    loaded = np.asarray(force) > 1e-3 * peak
    close(displacement[loaded], path[loaded], scale=2e-6 * float(path.max()))


@settings(max_examples=20, deadline=None, derandomize=True)
@given(theta=thetas(), x=scaled_paths(steps=16, low=0.0), factor=between(1.01, 2))
def test_a_stiffer_particle_recovers_less_and_carries_less(theta, x, factor):
    run = routes(Unloading.PRINTED, StrainScaling.RAW)["path"]
    eta, D_e = shape_factor(theta)
    path = jnp.asarray(x * D_e / eta)
    stiff = theta * np.where(np.arange(8) == 4, factor, 1.0)
    soft_force, stiff_force = (run(t, jnp.array(0.0), path)[1] for t in (theta, stiff))
    assert jnp.all(stiff_force <= soft_force * (1 + 1e-12))


def test_bad_shapes_are_refused():
    with pytest.raises((ValueError, TypeError)):
        Plastic(jnp.ones(3), 3.0, 2.7)
    with pytest.raises((ValueError, TypeError)):
        History(jnp.zeros(2))


def test_a_step_of_many_contacts_is_one_loop_for_each_result():
    """Quotients and roots used in several places stay within the loop of their users (`_numerics.recompute`)."""
    law, p = unpack(PAPER_THETA, Unloading.PRINTED, StrainScaling.RAW)
    arguments = jax.tree.map(lambda x: jnp.full(100_000, x), (law, p, History(jnp.asarray(20.0)), jnp.asarray(19.0)))
    text = jax.jit(jax.vmap(MccLaw.step)).lower(*arguments).compile().as_text()
    assert text[text.index("ENTRY") :].count(" fusion(") == 2
