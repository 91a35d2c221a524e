"""Derivatives of the law: both modes, against finite differences, and finite wherever branches meet."""

import functools

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    SOME_FORMS,
    all_finite,
    between,
    close,
    paper_law,
    paper_particle,
    shape_factor,
    thetas,
    unpack,
)
from hypothesis import given, settings

from mcc_jax.law import AbstractContactLaw, History, Unloading

STEPS = 6


@functools.cache
def compiled(unloading, scaling, by_scan):
    """Ways through the law as a function of every input, scaled: values, and both Jacobians."""

    def routes(z, base, unit):
        inputs = base + unit * z
        law, p = unpack(inputs[:8], unloading, scaling)
        displacement, force = inputs[8 : 8 + STEPS], inputs[8 + STEPS : 8 + 2 * STEPS]
        state = History(inputs[-1])
        if by_scan:  # by `step` and `step_load`
            path, path_load = (
                functools.partial(f, law) for f in (AbstractContactLaw.path, AbstractContactLaw.path_load)
            )
        else:
            path, path_load = law.path, law.path_load
        return jnp.stack([path(p, state, displacement)[1], path_load(p, state, force)[1]])

    values = jax.jit(jax.vmap(routes, in_axes=(0, None, None)))
    return values, jax.jit(lambda *a: (jax.jacfwd(routes)(*a), jax.jacrev(routes)(*a)))


def random_test(seed, theta, unloading, scaling):
    """Displacements and forces that load, unload and leave contact, away from the kinks of the model."""
    rng = np.random.default_rng(seed)
    law, p = unpack(theta, unloading, scaling)
    eta, D_e = shape_factor(theta)
    peaks = np.zeros(STEPS + 1)
    peaks[0] = rng.uniform(0.05, 0.3)
    loads = rng.random(STEPS) < 0.5
    for i in range(STEPS):
        peaks[i + 1] = peaks[i] + loads[i] * rng.uniform(0.02, 0.05)
    x = jnp.asarray(peaks)
    K1, K3, K5 = (np.asarray(k) for k in law.plastic.polynomial)
    force = np.asarray(p.force(jnp.asarray(K1 * peaks - K3 * peaks**3 + K5 * peaks**5)))
    recovered = np.asarray(p.displacement(law.recoverable_strain(p, x / eta)))
    shares = np.where(rng.random(STEPS) < 0.2, 1.3, rng.uniform(0.05, 0.9, STEPS))
    displacement = peaks[1:] * D_e / eta - np.where(loads, 0, shares * recovered[1:])
    ratios = np.where(rng.random(STEPS) < 0.2, -0.1, rng.uniform(0.05, 0.95, STEPS))
    base = np.concatenate([theta, displacement, np.where(loads, 1, ratios) * force[1:], [peaks[0] * D_e / eta]])
    unit = np.concatenate([np.abs(theta) + (np.arange(8) < 4), recovered[1:], force[1:], recovered[:1]])
    return base, unit


def compare(unloading, scaling, theta, seed, by_scan):
    base, unit = random_test(seed, theta, unloading, scaling)
    values, jacobians = compiled(unloading, scaling, by_scan)
    forward, reverse = (np.asarray(j) for j in jacobians(np.zeros_like(base), base, unit))
    scale = np.max(np.abs(forward), axis=(1, 2), keepdims=True)
    assert np.all(np.isfinite(forward))
    assert np.all(np.abs(forward - reverse) <= 1e-12 * scale)
    # Fourth-order central differences, one input at a time.
    h, eye = 2e-4, np.eye(base.size)
    at = np.asarray(values(np.concatenate([k * h * eye for k in (1, -1, 2, -2)]), base, unit)).reshape(4, -1, 2, STEPS)
    differences = np.moveaxis((8 * (at[0] - at[1]) - (at[2] - at[3])) / (12 * h), 0, -1)
    off = np.abs(forward - differences) / scale
    worst = np.unravel_index(np.argmax(off), off.shape)
    assert off.max() < 1e-7, f"route, step, input {worst}: {forward[worst]} is not {differences[worst]}"
    return forward, scale


@SOME_FORMS
@settings(max_examples=6, deadline=None, derandomize=True)
@given(theta=thetas(softening=between(0.0, 0.8)), seed=st.integers(0, 10**6))
def test_forward_is_reverse_is_finite_difference(unloading, scaling, theta, seed):
    """By parameters, geometry, history and the path, of `path` and `path_load`."""
    compare(unloading, scaling, theta, seed, by_scan=False)


@pytest.mark.extended
@SOME_FORMS
@settings(max_examples=6, deadline=None, derandomize=True)
@given(theta=thetas(softening=between(0.0, 0.8)), seed=st.integers(0, 10**6))
def test_forward_is_reverse_is_finite_difference_step_by_step(unloading, scaling, theta, seed):
    """The same of `step` and `step_load`, which have the same derivatives where nothing ties."""
    forward, scale = compare(unloading, scaling, theta, seed, by_scan=True)
    closed, _ = compare(unloading, scaling, theta, seed, by_scan=False)
    assert np.all(np.abs(forward - closed) <= 1e-11 * scale)


# ---- where branches meet --------------------------------------------------------------------------------------------

THETA = [7.0, 3.0, 2.7, 1.43, 16000.0, 200.0, 210.0, 160.0]
PEAK = 80.0


def special_points(law, p, dtype):
    """(state, displacement) and (state, force) at every place where the model has a branch or a kink."""
    # In NumPy: JAX would compile each of these operations.
    peak, zero = np.asarray(PEAK, dtype)[()], np.asarray(0, dtype)[()]
    state = History(jnp.asarray(peak))
    end = np.asarray(law.residual_displacement(p, state))[()]
    top = np.asarray(law.step(p, state, jnp.asarray(peak))[1])[()]
    # A load so small that single precision cannot square it is out of its reach.
    small = [1e-9, 1e-6] if dtype == jnp.float32 else [1e-30, 1e-9]
    below = [np.nextafter(peak, zero), peak * (1 - 1e-12), peak * (1 - 1e-9), (peak + end) / 2]
    beyond = [np.nextafter(end, peak), end, np.nextafter(end, zero), end - 1, zero, -peak]
    displacements = [peak, *below, *beyond, peak + 1]
    forces = [top, np.nextafter(top, zero), top * (1 - 1e-12), top * (1 - 1e-9), top / 2, top * 1e-6]
    forces += [np.finfo(dtype).tiny, zero, -zero, -top, top * 1.5]
    pairs = []
    for values, extreme in ((displacements, peak), (forces, top)):
        virgin = [-extreme, zero, *small, extreme]
        h = [PEAK] * len(values) + [0.0] * len(virgin)
        pairs.append((np.asarray(h, dtype), np.asarray(values + virgin, dtype)))
    return pairs


def finite_everywhere(unloading, scaling, dtype, function):
    """Value and both Jacobians of function(law, particle, state, value, load) at every special point."""
    theta = jnp.asarray(THETA, dtype)

    @functools.partial(jax.jit, static_argnums=2)
    def everything(h, value, load):
        def scalars(theta, h, value):
            law, p = unpack(theta, unloading, scaling)
            return function(law, p, History(h), value, load)

        def one(*arguments):
            jacobians = (mode(scalars, argnums=(0, 1, 2))(*arguments) for mode in (jax.jacfwd, jax.jacrev))
            return scalars(*arguments), *jacobians

        return jax.vmap(one, in_axes=(None, 0, 0))(theta, h, value)

    for load, (h, values) in enumerate(special_points(*unpack(theta, unloading, scaling), dtype)):
        outputs, forward, reverse = everything(h, values, bool(load))
        assert outputs.dtype == dtype
        assert all_finite((outputs, forward, reverse))
        accuracy = 1e-4 if dtype == jnp.float32 else 1e-12
        for one, other in zip(forward, reverse, strict=True):
            axes = tuple(range(1, one.ndim))
            one, other = np.asarray(one), np.asarray(other)
            scale = np.max(np.abs(one), axis=axes, keepdims=True)
            assert np.all(np.abs(one - other) <= accuracy * scale)


def along_a_path(law, particle, state, value, load):
    """To the place, back to half of it, and there again: a reload."""
    run = law.path_load if load else law.path
    # Constant, or the derivatives by the peak force and by half of it would cancel to mere rounding at tiny forces.
    half = jax.lax.stop_gradient(0.5 * value)
    return run(particle, state, jnp.stack([value, half, value]))[1]


def one_step(law, particle, state, value, load):
    state, response = (law.step_load if load else law.step)(particle, state, value)
    return jnp.stack([response, state.displacement_max])


def energies(law, particle, state, value, load):
    """Where the particle then is: at the displacement, or where the force takes it."""
    now = law.step_load(particle, state, value)[1] if load else value
    return jnp.stack(jax.tree.leaves(law.energy(particle, state, now)))


@pytest.mark.extended
@pytest.mark.parametrize("function", [along_a_path, one_step, energies])
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@SOME_FORMS
def test_value_and_derivatives_are_finite_where_branches_meet(unloading, scaling, dtype, function):
    finite_everywhere(unloading, scaling, dtype, function)


@pytest.mark.extended
@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_a_tie_has_the_loading_tangent(mode):
    """At the peak again: `step` takes it as loading; along a path the equal values share one loading tangent."""
    theta = jnp.asarray(THETA)
    law, p = unpack(theta)
    d = jnp.array(PEAK)
    tangent = jax.grad(lambda d: p.force(law.loading_stress(p, p.strain(d))))(d)
    state, slope = law.init(p), jnp.array([0.0, 1.0])
    close(mode(lambda d: law.step(p, History(PEAK), d)[1])(d), tangent, rel=1e-13)
    for path in (law.path, functools.partial(AbstractContactLaw.path, law)):
        jacobian = jax.jit(mode(lambda v, path=path: path(p, state, v)[1]))(jnp.stack([d, d]))
        close(jnp.sum(jacobian, axis=1), jnp.stack([tangent, tangent]), rel=1e-13)
        assert jnp.all(jnp.isin(jnp.round(jacobian / tangent, 12), slope))
    force = law.step(p, state, d)[1]
    for path in (law.path_load, functools.partial(AbstractContactLaw.path_load, law)):
        jacobian = jax.jit(mode(lambda v, path=path: path(p, state, v)[1]))(jnp.stack([force, force]))
        close(jnp.sum(jacobian, axis=1), jnp.stack([1 / tangent, 1 / tangent]), rel=1e-12)
    # A law's parameters do not care how a tie is shared.
    hold = jnp.stack([d, d, d - 1e-3, d])

    def forces(theta, route):
        law, p = unpack(theta)
        return route(law, p, law.init(p), hold)[1]

    one, other = (jax.jit(mode(lambda t, r=r: forces(t, r)))(theta) for r in (type(law).path, AbstractContactLaw.path))
    close(one, other, rel=1e-11)


@pytest.mark.extended
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("form", Unloading)
def test_slopes_on_the_two_sides_of_the_peak(form, mode):
    law, p = paper_law(form), paper_particle(12)
    peak = p.displacement(jnp.array(0.4))
    state, top = History(peak), law.step(p, History(peak), peak)[1]
    slope = jax.jit(mode(lambda d: law.step(p, state, d)[1]))
    compliance = jax.jit(mode(lambda f: law.step_load(p, state, f)[1]))
    onset = 4 / np.pi * top / p.displacement(law.recoverable_strain(p, p.strain(peak)))
    loading = jax.grad(lambda d: p.force(law.loading_stress(p, p.strain(d))))(peak)
    close(slope(jnp.nextafter(peak, 0.0)), onset, rel=1e-12)
    close(compliance(top * (1 - 1e-14)), 1 / onset, rel=1e-12)
    close(slope(peak), loading, rel=1e-13)
    close(compliance(top), 1 / loading, rel=1e-13)
    assert onset > 2 * loading


@pytest.mark.extended
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_out_of_contact_nothing_depends_on_the_platen(mode):
    law, p = paper_law(), paper_particle(1)
    state = History(80.0)
    for d in (-5.0, 0.0, 60.0):
        assert mode(lambda d: law.step(p, state, d)[1])(jnp.array(d)) == 0
    for f in (0.0, -3.0):
        assert mode(lambda f: law.step_load(p, state, f)[1])(jnp.array(f)) == 0
        close(law.step_load(p, state, jnp.array(f))[1], law.residual_displacement(p, state), rel=1e-14)
        assert mode(lambda f: law.step_load(p, law.init(p), f)[1])(jnp.array(-3.0)) == 0


@pytest.mark.extended
def test_second_derivatives_of_a_fit_are_finite():
    """Hessian of a misfit over the parameters, with unloading inside the branch."""
    law, p = paper_law(), paper_particle(1)
    path = jnp.concatenate([jnp.linspace(0, 100, 12), jnp.linspace(100, 98.5, 6)])
    data = law.path(p, law.init(p), path)[1]

    def misfit(theta):
        law, p = unpack(theta)
        return jnp.sum((law.path(p, law.init(p), path)[1] - 1.01 * data) ** 2)

    theta = jnp.array([7.0, 3.0, 2.7, 1.43, 16000.0, 213.54, 196.07, 186.33])
    hessian = jax.jit(jax.hessian(misfit))(theta)
    assert jnp.all(jnp.isfinite(hessian))
    close(hessian, hessian.T, rel=1e-9, scale=1e-9 * float(jnp.max(jnp.abs(hessian))))
