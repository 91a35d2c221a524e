"""A law with effects is a law: by hand, driven, differentiated, by name, without what is the instrument's."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, paper_law, paper_particle

from mcc_jax import InputError, MccLaw, drive
from mcc_jax.effects import LIBRARY, AbstractEffect, Variant
from mcc_jax.geometry import Particle
from mcc_jax.law import Plastic
from mcc_jax.simulate import simulate_batch

LAW, PARTICLE = paper_law(), paper_particle(3)
# Load, hold, unload: one force a second.
FORCE = jnp.concatenate([jnp.linspace(0.0, 150.0, 61), jnp.full(120, 150.0), jnp.linspace(147.5, 0.0, 60)])
TIME = jnp.arange(len(FORCE), dtype=float)


@pytest.mark.extended
def test_batches_and_the_state_that_is_carried_on():
    creep, frame = LIBRARY["creep"]["logarithmic"], LIBRARY["frame_compliance"]["linear"]
    law = LAW.with_effects(creep.build(0.01, tau_s=10.0), frame.build(0.0015))
    laws = jax.tree.map(lambda x: jnp.stack([x, x]), law)
    two = jax.tree.map(lambda x: jnp.stack([x, x]), PARTICLE)
    both = simulate_batch(laws, two, jnp.stack([FORCE, 0.5 * FORCE]), times=jnp.stack([TIME, TIME]), control="load")
    whole = drive(law, PARTICLE, FORCE, time=TIME, control="load")
    np.testing.assert_allclose(both.displacement[0], whole.displacement, rtol=1e-13)
    first = drive(law, PARTICLE, FORCE[:90], time=TIME[:90], control="load")
    rest = drive(law, PARTICLE, FORCE[90:], time=TIME[90:], control="load", state=first.state)
    np.testing.assert_allclose(rest.displacement, whole.displacement[90:], rtol=1e-10)


def test_what_belongs_to_the_instrument_is_left_out():
    law = LAW.with_effects("frame_compliance", "thermal_drift", "platen_sink_in", "damage", "size_effect", "creep")
    assert [effect.name.split(":")[0] for effect in law.of_particle().effects] == ["damage", "size_effect", "creep"]


@pytest.mark.extended
def test_a_variant_of_ones_own_and_a_frame_add_compliance_times_force_and_nothing_else():
    class Glue(AbstractEffect):
        """Displacement lost to a layer of glue."""

        def observe(self, context):
            return self.amplitude * context.force

    glue = Variant("glue", "linear", Glue, "c_um_per_mN", "um/mN", 1, (1e-4, 1e-2), "d = c F", "", "")
    assert LAW.with_effects(glue).effects[0].name == "glue:linear"
    base = drive(LAW, PARTICLE, FORCE, control="load").displacement
    for variant in (glue, LIBRARY["frame_compliance"]["linear"]):
        moved = drive(LAW.with_effects(variant), PARTICLE, FORCE, time=TIME, control="load").displacement
        close(moved - base, variant.typical * FORCE, rel=1e-12, scale=1e-12 * float(base.max()))


def test_effects_are_taken_by_name_and_anything_else_is_refused():
    assert MccLaw(Plastic(7.0, 3.0, 2.7), 1.4, 16000.0, effects="creep").effects[0].name.startswith("creep:")
    with pytest.raises(InputError, match="there is no mechanism 'rust'"):
        LAW.with_effects("rust")
    with pytest.raises(InputError, match="an effect must be"):
        LAW.with_effects(3.0)


@pytest.mark.extended
def test_energy_with_damage_is_the_work_of_the_path():
    """What a damaged particle gives back is the integral of its force over its own unloading."""
    law = LAW.with_effects("damage", "size_effect")
    top = 60.0
    path = jnp.concatenate([jnp.linspace(0.0, top, 2001), jnp.linspace(top, 0.0, 4001)])
    force = drive(law, PARTICLE, path, time=jnp.arange(len(path), dtype=float)).force
    work = jnp.concatenate([jnp.zeros(1), jnp.cumsum(0.5 * (force[1:] + force[:-1]) * jnp.diff(path))])
    state = eqx.tree_at(lambda s: s.displacement_max, law.init(PARTICLE), jnp.asarray(top))
    found = law.energy(PARTICLE, state, jnp.asarray(top))
    close(found.work, work[2000], rel=1e-5)
    close(found.recoverable, work[2000] - work[-1], rel=1e-4)
    undamaged = LAW.with_effects("size_effect").energy(PARTICLE, state, jnp.asarray(top)).recoverable
    assert float(found.recoverable) > float(undamaged)


def test_energy_that_is_not_known_is_refused_by_name():
    sphere = Particle(200.0, 200.0, 200.0)
    for effect in ("creep", "frame_compliance", "finite_hardening_exponent"):
        law = LAW.with_effects(effect)
        with pytest.raises(InputError, match=f"the energy of a law with {effect}"):
            law.energy(sphere, law.init(sphere), jnp.asarray(1.0))
