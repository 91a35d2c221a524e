"""Effects in particle codes: parameters and the modulus at the peak, and what is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import Softer
from test_pair_law import ON_PATH, PARTICLE, UM, cycle, driven, law_of, on_pair, on_wall, with_all

from benchmarks import energy_paths
from mcc_jax import InputError, Particle, Unloading, drive
from mcc_jax.dem import half_contact, pair_recovery, spheres, wall_energy, wall_force
from mcc_jax.effects import LIBRARY, AbstractEffect, find_variant
from mcc_jax.law import StrainScaling

CLOSED = [v for m in ("damage", "densification_stiffening", "size_effect", "shape_second_order") for v in LIBRARY[m]]
CLOSED = [v for v in CLOSED if v.name not in ("cyclic", "locking", "locking_exponential")]
AT_PEAK = [v for v in CLOSED if v.mechanism in ("damage", "densification_stiffening")]
OTHERS = [v for m in LIBRARY.values() for v in m if v not in CLOSED]


@pytest.mark.parametrize("unloading", [Unloading.PRINTED, Unloading.PUNCH])
def test_two_halves_are_the_plate_test(unloading):
    """T1 and T2 with effects: two walls, and two equal particles, give what `drive` gives."""
    law, displacement = with_all(unloading), cycle(45.0)
    expected = 1e-3 * drive(law, PARTICLE, displacement, time=np.arange(len(displacement))).force
    side = half_contact(law, PARTICLE)
    for force, overlaps in ((on_wall(side), 0.5e-6 * displacement), (on_pair(side, side), 1e-6 * displacement)):
        assert np.max(np.abs(driven(force, overlaps) - expected)) <= 1e-12 * np.max(expected)


@pytest.mark.extended
@pytest.mark.parametrize("variant", CLOSED, ids=lambda v: v.label)
def test_every_closed_effect_releases_as_the_law_does(variant):
    """From a peak under load control, which is in closed form: where the platen is at shares of the peak force."""
    law = law_of()._with((variant.build(variant.typical),))
    side = half_contact(law, PARTICLE)
    peak = 1e3 * float(wall_force(side, 0.0, 20e-6))
    forces = peak * np.array([0.0, 1.0, 0.8, 0.3, 0.01])
    _, where = law.path_load(PARTICLE, law.init(PARTICLE), jnp.asarray(forces))
    np.testing.assert_allclose(where[1], 40.0, rtol=1e-12)
    again = [wall_force(side, 20e-6, 0.5e-6 * x) for x in where[1:]]
    np.testing.assert_allclose(1e3 * np.array(again), forces[1:], rtol=1e-9)


def test_by_hand():
    """Damage 1.2 and a peak strain of 0.3 divide the modulus by exp(0.36), and so the printed recovery squared."""
    law, sphere = law_of(), Particle(100.0, 100.0, 100.0)
    plain, damaged = (half_contact(one, sphere) for one in (law, law._with((find_variant("damage").build(1.2),))))
    d = jnp.asarray(0.3 * 50e-6)
    assert pair_recovery(damaged, damaged, 2 * d) == pytest.approx(
        float(np.exp(0.18) * pair_recovery(plain, plain, 2 * d)), rel=1e-13
    )
    assert wall_force(damaged, 0.0, d) == wall_force(plain, 0.0, d)  # it acts on unloading alone


@pytest.mark.extended
def test_an_amplitude_of_zero_changes_nothing():
    law = law_of()
    none = half_contact(law._with(tuple(v.build(0.0) for v in CLOSED)), PARTICLE)
    overlaps = cycle(45.0) * UM
    plain, other = half_contact(law, PARTICLE), half_contact(law_of(C1=11.0), Particle(60.0, 62.0, 50.0))
    for partner in (plain, other):
        without, again = (driven(on_pair(side, partner), overlaps) for side in (plain, none))
        assert np.abs(again - without).max() <= 1e-12 * max(without)
    assert len(jax.tree.leaves(plain)) == 5  # a law without effects carries nothing of them


@pytest.mark.extended
@pytest.mark.parametrize("unloading", list(Unloading))
def test_force_is_continuous(unloading):
    """At the onset, at full release, and where the peak passes the tested compression, from which on damage rests."""
    i = half_contact(with_all(unloading), PARTICLE)
    j = half_contact(law_of(unloading, StrainScaling.CONTACT, C1=11.0), Particle(60.0, 62.0, 50.0))
    peak, span = 34e-6, float(pair_recovery(i, j, 34e-6))
    at = peak - span * np.array([0.0, 1e-12, 1 - 1e-9, 1.0])
    force = np.asarray(ON_PATH(i, j, jnp.full(4, peak), jnp.asarray(at)))
    np.testing.assert_allclose(force[1:], [force[0], 0.0, 0.0], rtol=1e-10, atol=1e-12 * force[0])
    beside = i.tested * jnp.array([1 - 1e-12, 1 + 1e-12])
    widths = jax.vmap(lambda d: pair_recovery(i, i, 2 * d))(beside)
    np.testing.assert_allclose(widths[0], widths[1], rtol=1e-10)


@pytest.mark.extended
@pytest.mark.parametrize("unloading", [Unloading.PRINTED, Unloading.PUNCH])  # the exact punch has another constant only
def test_no_path_of_a_pair_gains_energy(unloading):
    """Random paths to twice the tested range with damage and densification; sides that would gain are left out."""
    law, particle = energy_paths.draw(8, 400, unloading, StrainScaling.RAW)
    rng = np.random.default_rng(2)
    effects = tuple(
        eqx.filter_vmap(v.build)(jnp.asarray(rng.choice([0.0, 1.0], 400) * rng.uniform(*v.plausible, 400)))
        for v in AT_PEAK
        if v.name in ("exponential", "threshold", "stress")
    )
    law = law._with(effects)
    passive = eqx.filter_jit(eqx.filter_vmap(lambda law, p: half_contact(law, p).is_passive))(law, particle)
    kept = np.flatnonzero(passive)
    assert 100 < len(kept) < 400
    law, particle = (jax.tree.map(lambda x: x[kept], tree) for tree in (law, particle))
    paths = (x[kept] for x in energy_paths.choices(8, 400))
    whole, between = energy_paths.gains(*energy_paths.pair(law, particle, *paths))
    assert whole.max() < 0
    assert between.max() <= 1e-13


@pytest.mark.extended
def test_what_would_gain_energy_is_refused_and_flagged():
    law = law_of(Unloading.PUNCH)._with((find_variant("damage:square").build(4.0),))
    with pytest.raises(InputError, match="damage:square a contact would give back more energy") as caught:
        half_contact(law, PARTICLE)
    assert "smaller amplitude" in str(caught.value)
    with pytest.raises(InputError, match="damage:square"):
        spheres(law, [100.0, 80.0])
    side = jax.jit(half_contact)(law, PARTICLE)  # traced, it has no value to refuse
    assert not side.is_passive
    assert not side.is_valid
    lost = jax.jit(jax.vmap(lambda d: wall_energy(side, d, d).dissipated))(side.tested * jnp.linspace(0.01, 1.0, 200))
    assert np.diff(lost).min() < 0  # it would have gained, indeed


@pytest.mark.parametrize("variant", OTHERS, ids=lambda v: v.label)
def test_everything_else_is_refused_by_name(variant):
    effect = variant.build(variant.typical)
    remedy = r"of_particle\(\)" if effect.of_instrument else r"without_effects\(\"" + variant.label
    law = law_of()._with((effect,))
    with pytest.raises(InputError, match=f"half contact of a law with {variant.label} is not known.*{remedy}"):
        half_contact(law, PARTICLE)
    rest = law.of_particle() if effect.of_instrument else law.without_effects(variant.label)
    assert eqx.tree_equal(half_contact(rest, PARTICLE), half_contact(law_of(), PARTICLE))


class Anyhow(AbstractEffect):
    """A user's own effect that says nothing of itself."""

    def stiffness(self, context):
        return 1 / (1 + self.amplitude * context.cycles)


def test_an_effect_of_ones_own():
    side = half_contact(law_of().with_effects(Softer(0.3)), PARTICLE)
    assert pair_recovery(side, side, 20e-6) > pair_recovery(*[half_contact(law_of(), PARTICLE)] * 2, 20e-6)
    with pytest.raises(InputError, match="Anyhow is not known in closed form"):
        half_contact(law_of().with_effects(Anyhow(0.3)), PARTICLE)
