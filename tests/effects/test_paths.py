"""One law, several ways through it: closed form, steps, displacement control, batches, padding, a record's pieces."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tested import BASE, FORCE, HUMIDITY, LAW, PARTICLE, RECORD, TIME, VARIANTS

from mcc_jax.effects import LIBRARY

ADDITIVE = ("creep", "adhesion", "reload_hysteresis", "ratcheting", "unloading_shape", "pop_in", "toe_asperity")
OBSERVED = ("frame_compliance", "thermal_drift", "platen_sink_in", "misalignment", "reverse_plasticity")
PARAMETERS = ("damage", "densification_stiffening", "size_effect", "shape_second_order", "humidity")
LOADING = ("rate_dependence", "platen_friction", "finite_hardening_exponent")


def law_with(*mechanisms, share=0.3, first_only=False):
    """The law with all variants of some mechanisms, or the first of each, at once."""
    variants = [v for v in VARIANTS if v.mechanism in mechanisms]
    if first_only:
        variants = [LIBRARY[m].variants[0] for m in mechanisms]
    return LAW.with_effects(*(v.build(share * v.typical) for v in variants))


# What differs between path and step is the framework and the memories; formulas are the same code in both.
EVERYTHING = law_with(*ADDITIVE, *OBSERVED, *PARAMETERS, *LOADING, share=0.2, first_only=True)
MEMORIES = law_with("creep")


@eqx.filter_jit
def along(law, force, time, particle=PARTICLE):
    return law.path_load(particle, law.init(particle, jnp.asarray(HUMIDITY)), force, time)


@eqx.filter_jit
def by_steps(law, force, time, particle=PARTICLE):
    start = law.init(particle, jnp.asarray(HUMIDITY))
    return jax.lax.scan(lambda past, now: law.step_load(particle, past, *now), start, (force, time))


@pytest.mark.extended
def test_closed_form_is_the_scan():
    for law in (EVERYTHING, MEMORIES):
        (state, path), (state_by_steps, steps) = along(law, FORCE, TIME), by_steps(law, FORCE, TIME)
        assert jnp.max(jnp.abs(path - BASE)) > 0.5
        np.testing.assert_allclose(path, steps, rtol=1e-10, atol=1e-10)
        for one, other in zip(jax.tree.leaves(state), jax.tree.leaves(state_by_steps), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10)


def test_respond_is_the_path_of_a_virgin_particle():
    np.testing.assert_allclose(
        eqx.filter_jit(MEMORIES.respond)(PARTICLE, RECORD), along(MEMORIES, FORCE, TIME)[1], rtol=1e-12
    )


@pytest.mark.extended
def test_padding_changes_nothing():
    """A batch repeats the last point of a shorter test, time included."""
    padded = jax.tree.map(lambda x: jnp.pad(x, (0, 7), mode="edge") if x.ndim else x, RECORD)
    law = law_with("creep", "thermal_drift", "ratcheting", "humidity", "damage", first_only=True)
    run = eqx.filter_jit(law.respond)
    whole, longer = run(PARTICLE, RECORD), run(PARTICLE, padded)
    np.testing.assert_allclose(longer[: FORCE.size], whole, rtol=1e-13)
    np.testing.assert_allclose(longer[FORCE.size :], np.full(7, whole[-1]), rtol=1e-13)


@pytest.mark.extended
def test_displacement_control_undoes_load_control():
    """Without the drift, whose displacement may fall while force grows; and where the platen touches."""
    law = law_with("frame_compliance", "creep", "damage", "reload_hysteresis", "platen_friction", first_only=True)
    _, displacement = along(law, FORCE, TIME)

    @eqx.filter_jit
    def back(displacement):
        return law.path(PARTICLE, law.init(PARTICLE, jnp.asarray(HUMIDITY)), displacement, TIME)[1]

    force = np.asarray(back(displacement))
    loaded = np.asarray(FORCE) > 1e-6
    np.testing.assert_allclose(force[loaded], np.asarray(FORCE)[loaded], rtol=1e-8, atol=1e-7)
    np.testing.assert_allclose(force[~loaded], 0, atol=1e-6)
    # Holding the platen still relaxes the force of a creeping particle.
    top = int(jnp.argmax(FORCE))
    held = jnp.where(jnp.arange(FORCE.size) > top, displacement[top], displacement)
    relaxed = np.asarray(back(held))[top:]
    assert (np.diff(relaxed) <= 1e-9).all()
    assert relaxed[-1] < 0.999 * relaxed[0]


@pytest.mark.extended
def test_derivatives_under_displacement_control():
    """Implicit rule in both modes against finite differences: by amplitudes and by the displacement itself."""
    names = ("frame_compliance", "creep", "platen_friction")
    points, time = jnp.asarray([0.0, 60.0, 90.0, 88.0, 87.5, 95.0]), jnp.arange(6.0) * 30
    inputs, unit = jnp.asarray([2e-3, 3e-4, 0.05, 0.01]), jnp.asarray([1e-3, 1e-4, 0.01, 0.1])
    weights = jnp.asarray(np.random.default_rng(2).normal(size=6))

    def force(inputs):
        effects = tuple(LIBRARY[n].variants[0].build(a) for n, a in zip(names, inputs[:3], strict=True))
        law = LAW.with_effects(*effects)
        return law.path(PARTICLE, law.init(PARTICLE), points + inputs[3], time)[1]

    @jax.jit
    def evaluate(inputs):
        value, push = jax.linearize(force, inputs)
        return value, jax.vmap(push)(jnp.diag(unit)), jax.linear_transpose(push, inputs)(weights)[0]

    value, forward, reverse = evaluate(inputs)
    assert jnp.all(value[1:] > 1)
    np.testing.assert_allclose(forward @ weights, reverse * unit, rtol=1e-9)
    for i in range(4):
        move = 1e-3 * unit * jnp.eye(4)[i]
        numeric = (evaluate(inputs + move)[0] - evaluate(inputs - move)[0]) / 2e-3
        np.testing.assert_allclose(numeric, forward[i], atol=1e-5 * jnp.abs(forward[i]).max())


@pytest.mark.extended
def test_out_of_contact_there_is_no_force():
    law = law_with("creep", "frame_compliance", first_only=True)
    state = law.init(PARTICLE)
    state, force = law.step(PARTICLE, state, jnp.asarray(-3.0), jnp.asarray(1.0))
    assert force == 0
    state, force = law.step(PARTICLE, state, jnp.asarray(60.0), jnp.asarray(50.0))
    assert force > 10
    _, force = law.step(PARTICLE, state, jnp.asarray(20.0), jnp.asarray(60.0))
    assert force == 0


def test_two_effects_that_only_add_are_their_sum():
    names = ("frame_compliance", "toe_asperity")
    parts = [law_with(n, first_only=True).respond(PARTICLE, RECORD) for n in names]
    both = law_with(*names, first_only=True).respond(PARTICLE, RECORD)
    np.testing.assert_allclose(both - BASE, (parts[0] - BASE) + (parts[1] - BASE), atol=1e-12)


def test_effects_act_through_each_other():
    """Humidity softens the particle whose damage then shows: not the sum, but the same in either order."""
    humidity, damage = (LIBRARY[n].variants[0].build(LIBRARY[n].variants[0].typical) for n in ("humidity", "damage"))
    one, other = (LAW.with_effects(*e).respond(PARTICLE, RECORD) for e in ((humidity, damage), (damage, humidity)))
    np.testing.assert_allclose(one, other, rtol=1e-12)
    alone = [LAW.with_effects(e).respond(PARTICLE, RECORD) - BASE for e in (humidity, damage)]
    assert jnp.max(jnp.abs(one - BASE - alone[0] - alone[1])) > 1e-3


@pytest.mark.extended
def test_new_numbers_do_not_recompile():
    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def run(law, particle, record):
        return law.respond(particle, record)

    for factor in (0.0, 0.5, 1.0):
        variant = LIBRARY["toe_asperity"].variants[0]
        effect = variant.build(factor * variant.typical, stress_scale_MPa=0.3 + factor)
        run(LAW.with_effects(effect), PARTICLE, RECORD)
