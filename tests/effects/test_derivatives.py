"""Null, derivatives by the amplitude, and the same law in the form in which a fit has it; every variant."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import with_dtype
from tested import BASE, FORCE, LAW, NAMES, PARTICLE, RECORD, START, VARIANTS, lanes, respond, signature_rows

EVERY = pytest.mark.parametrize("variant", VARIANTS, ids=NAMES)


@EVERY
def test_null_is_the_base_law_and_the_law_of_a_fit_gives_the_same(variant):
    values, slopes = lanes(variant)
    assert np.isfinite(values).all()
    assert np.isfinite(slopes).all()
    np.testing.assert_allclose(values[0], BASE, rtol=1e-12)
    np.testing.assert_allclose(values[6], values[4], rtol=1e-9, atol=1e-9)


@EVERY
def test_derivative_by_the_amplitude(variant):
    """At the null one-sided, as the other side may be another physics; at the typical amplitude central."""
    values, slopes = lanes(variant)
    step = START * variant.typical
    one_sided = (4 * values[1] - values[2] - 3 * values[0]) / (2 * step)
    central = (values[5] - values[3]) / (2 * step)
    scales = np.abs(slopes[0]).max(), np.abs(slopes[4]).max()
    assert min(scales) > 0, "the effect does nothing"
    # On full release adhesion leaves a contact that grows as amplitude^(4/3): its derivative is 0, differences are not.
    smooth = np.asarray(FORCE) > 0 if variant.mechanism == "adhesion" else np.full(FORCE.size, True)
    np.testing.assert_allclose(one_sided[smooth], slopes[0][smooth], atol=3e-5 * scales[0], rtol=0)
    np.testing.assert_allclose(central, slopes[4], atol=3e-5 * scales[1], rtol=0)
    np.testing.assert_array_equal(slopes[0][~smooth], 0)


@pytest.mark.extended
def test_signatures_are_the_derivatives_at_the_null():
    rows, again = signature_rows(RECORD, RECORD)
    np.testing.assert_array_equal(rows, again)
    for variant, row in zip(VARIANTS, rows, strict=True):
        exact = lanes(variant)[1][0]
        np.testing.assert_allclose(row, exact, atol=1e-9 * np.abs(exact).max(), rtol=0)


@functools.cache
def all_effects(dtype):
    """Every variant in one law, compiled once: base, null, and in double precision the derivatives by reverse mode."""
    law, particle, record = (with_dtype(t, dtype) for t in (LAW, PARTICLE, RECORD))
    base = jax.jit(lambda law, p, f: law.path_load(p, law.init(p), f)[1])(law, particle, record.force)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=FORCE.size), dtype)

    def run(amplitudes):
        effects = tuple(v.build(a) for v, a in zip(VARIANTS, amplitudes, strict=True))
        return law.with_effects(*effects).respond(particle, record)

    @jax.jit
    def evaluate(null):
        if dtype == jnp.float32:
            return run(null), null
        value, pull = jax.vjp(run, null)
        return value, pull(weights)[0]

    value, reverse = evaluate(jnp.zeros(len(VARIANTS), dtype))
    return np.asarray(base), np.asarray(value), np.asarray(reverse), np.asarray(weights)


@pytest.mark.extended
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_effects_at_their_null_leave_the_compiled_law_alone(dtype):
    base, value, reverse, _ = all_effects(dtype)
    assert value.dtype == dtype
    np.testing.assert_allclose(value, base, rtol=1e-12 if dtype == jnp.float64 else 2e-7)
    assert np.isfinite(reverse).all()


@pytest.mark.extended
def test_reverse_mode_is_forward_mode():
    """The gradient of a weighted sum at the null, by reverse mode all at once, against each derivative by forward."""
    *_, reverse, weights = all_effects(jnp.float64)
    forward = np.array([weights @ lanes(variant)[1][0] for variant in VARIANTS])
    scale = np.array([np.abs(weights * lanes(variant)[1][0]).sum() for variant in VARIANTS])
    np.testing.assert_array_less(np.abs(forward - reverse), 1e-10 * scale)


SOME = [v for v in VARIANTS if v.name in ("kelvin_voigt", "jkr", "siebel", "heckel", "hertzian_seat", "flow_threshold")]


@pytest.mark.extended
def test_single_precision():
    """At the typical amplitude close to float64."""
    law, particle, record = (with_dtype(t, jnp.float32) for t in (LAW, PARTICLE, RECORD))
    for variant in SOME:
        run = jax.jit(functools.partial(respond, variant, law=law, particle=particle, record=record))
        typical = run(jnp.float32(variant.typical))
        assert typical.dtype == jnp.float32
        np.testing.assert_allclose(typical, lanes(variant)[0][4], atol=5e-4)


@pytest.mark.extended
def test_derivatives_by_nuisance_law_particle_and_force_are_finite():
    """Everything a refit may differentiate, with one effect of each kind, in both modes at once."""
    names = ("kelvin_voigt", "jkr", "cowper_symonds", "heckel", "levelling", "in_plane_aspect")
    chosen = {v.name: v for v in VARIANTS if v.name in names}

    def run(amplitudes, law, particle, force):
        effects = tuple(v.build(a) for v, a in zip(chosen.values(), amplitudes, strict=True))
        record = eqx.tree_at(lambda r: r.force, RECORD, force)
        return law.with_effects(*effects).respond(particle, record)

    @eqx.filter_jit
    def both_modes(*inputs):
        value, pull = eqx.filter_vjp(run, *inputs)
        direction = jax.tree.map(jnp.ones_like, eqx.filter(inputs, eqx.is_inexact_array))
        return pull(jnp.ones_like(value)), eqx.filter_jvp(run, inputs, direction)[1]

    for scale in (0.0, 1.0):
        inputs = jnp.asarray([scale * v.typical for v in chosen.values()]), LAW, PARTICLE, FORCE
        gradient, push = both_modes(*inputs)
        assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(gradient))
        assert jnp.all(jnp.isfinite(push))
        total = sum(jnp.sum(leaf) for leaf in jax.tree.leaves(gradient))
        np.testing.assert_allclose(jnp.sum(push), total, rtol=1e-7)
