"""Damage and densification: a path that is driven gives back no more energy than it took, or is refused in one line."""

import itertools

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import between
from hypothesis import given, settings

from benchmarks import energy_paths
from mcc_jax import InputError, MccLaw, Particle, Plastic, Programme, Unloading, drive, simulate_campaign
from mcc_jax.dem import half_contact
from mcc_jax.effects import LIBRARY, find_variant
from mcc_jax.law import TESTED_STRAIN, StrainScaling
from mcc_jax.simulate import RESULTS, HiddenEffect, law_for_each, simulate_batch

AT_PEAK = [v for m in ("damage", "densification_stiffening") for v in LIBRARY[m] if v.name != "cyclic"]
AT_PEAK.sort(key=lambda v: v.name not in ("square", "stress"))  # what gains most is what a quick run takes
CASES = list(zip(AT_PEAK, itertools.cycle(Unloading), strict=False))  # each formula with one form of unloading
PARTICLE = Particle(105.0, 92.0, 85.0)
RAMP = 300  # points of each ramp; the quadrature is then right to 1e-5 of the work
QUADRATURE = 1e-4
MODULUS = {Unloading.PRINTED: 300.0, Unloading.PUNCH: 450.0, Unloading.PUNCH_EXACT: 380.0}


def law_of(unloading=Unloading.PUNCH, modulus=None, C1=16.0, softening=0.3, scaling=StrainScaling.RAW):
    C3 = (softening * 20 / 9 * C1 * 2.7**5) ** (1 / 6)
    return MccLaw(Plastic(C1, C3, 2.7), 1.43, MODULUS[unloading] if modulus is None else modulus, unloading, scaling)


def gaining(amplitude=4.0, **law):
    return law_of(**law).with_effects(find_variant("damage:square").build(amplitude))


def reach(law, particle):
    """Displacement at which the paper's tests ended."""
    return float(particle.displacement(TESTED_STRAIN / law.shape_factor(particle)))


def load_at_the_end():
    """Force [mN] there."""
    return float(law_of().contact(PARTICLE).loading(jnp.asarray(reach(law_of(), PARTICLE))))


def forces(law, particle, peaks, depths):
    """Load to each peak [um] and unload by a share of its force, the last time wholly."""
    carried = [float(law.contact(particle).loading(jnp.asarray(p))) for p in np.maximum.accumulate(peaks)]
    turns = [0.0]
    for force, depth in zip(carried, depths, strict=True):
        turns += [force, force * (1 - depth)]
    turns += [carried[-1], 0.0]
    steps = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0, 1, RAMP))
    return np.concatenate([low + (high - low) * steps for low, high in itertools.pairwise(turns)])


def balance(response):
    """Work done on the particle up to each point [nJ], and the work put in, by the trapezoidal rule."""
    force = np.asarray(response.force)
    pieces = 0.5 * (force[1:] + force[:-1]) * np.diff(response.displacement)
    return np.cumsum(pieces), np.cumsum(np.maximum(pieces, 0))


def largest_gain(response):
    """Largest fall of the work done from one full release to a later one, over the work put in until then."""
    net, put_in = balance(response)
    released = np.flatnonzero(np.asarray(response.force)[1:] == 0)
    released = released[put_in[released] > 0]
    best = np.maximum.accumulate(np.concatenate([[0.0], net[released]]))[:-1]
    return float(np.max((best - net[released]) / put_in[released]))


@pytest.mark.extended
@pytest.mark.parametrize(("variant", "unloading"), CASES, ids=lambda one: getattr(one, "label", None))
@settings(max_examples=10)
@given(
    amplitude=between(-6.0, 12.0),
    modulus=between(np.log(100.0), np.log(20e3)),
    law=st.fixed_dictionaries({"C1": between(4.0, 20.0), "softening": between(0.0, 0.95)}),
    D=st.tuples(between(60.0, 300.0), between(0.7, 1.0), between(0.6, 1.0)),
    first=between(0.1, 1.0),
    growths=st.tuples(*[st.one_of(between(0.0, 0.1), between(0.0, 0.3))] * 5),  # gained between peaks near each other
    depths=st.tuples(*[st.one_of(st.just(1.0), between(0.05, 1.0))] * 6),
)
def test_energy_out_is_at_most_energy_in_or_it_is_refused(
    variant, unloading, amplitude, modulus, law, D, first, growths, depths
):
    law = law_of(unloading, np.exp(modulus), **law).with_effects(variant.build(amplitude))
    particle = Particle(D[0], D[0] * D[1], D[0] * D[2])
    peaks = reach(law, particle) * first * np.cumprod([1.0, *(1 + np.array(growths))])
    path = forces(law, particle, peaks, depths)
    given = {"time": np.arange(len(path), dtype=float), "control": "load"}
    quiet = drive(law, particle, path, **given, throw=False)
    # From a virgin particle nothing gains in all, the limit sees to that; between releases it may.
    net, put_in = balance(quiet)
    assert np.min(net / put_in) > -QUADRATURE
    try:
        driven = drive(law, particle, path, **given)
    except InputError as refusal:
        assert quiet.result == RESULTS.gains_energy
        text = str(refusal)
        assert f"{variant.mechanism}:{variant.name} the particle, loaded beyond a strain of 0." in text
    else:
        assert driven.result == RESULTS.successful
        assert largest_gain(driven) <= QUADRATURE


@pytest.mark.extended
@pytest.mark.parametrize("unloading", Unloading)
def test_what_is_refused_would_have_gained(unloading):
    """Loaded to the strain named and released, then loaded further and released: more comes back than went in."""
    law = gaining(8.0, unloading=unloading)
    top = reach(law, PARTICLE)
    at_top = eqx.tree_at(lambda s: s.displacement_max, law.init(PARTICLE), jnp.asarray(top))
    strain = float(law.gain_strain(PARTICLE, at_top))
    assert 0 < strain < 0.6
    peaks = float(PARTICLE.displacement(jnp.asarray(strain))) * np.array([1.0, 1.02, 1.02])
    path = forces(law, PARTICLE, peaks, [1.0, 1.0, 1.0])
    response = drive(law, PARTICLE, path, time=np.arange(len(path), dtype=float), control="load", throw=False)
    assert response.result == RESULTS.gains_energy
    assert largest_gain(response) > 5 * QUADRATURE


@pytest.mark.extended
def test_only_what_is_driven_counts():
    """Up to the strain of the message the same law is driven, in both ways of control; just beyond, in neither."""
    law = gaining(5.0)
    path = jnp.linspace(0.0, reach(law, PARTICLE), 60)
    time = jnp.arange(60.0)
    with pytest.raises(InputError, match="damage:square the particle, loaded beyond a strain of 0"):
        drive(law, PARTICLE, path, time=time)
    state = eqx.tree_at(lambda s: s.displacement_max, law.init(PARTICLE), path[-1])
    edge = float(PARTICLE.displacement(law.gain_strain(PARTICLE, state)))
    for share, fine in ((0.98, True), (1.02, False)):
        response = drive(law, PARTICLE, path * (share * edge / path[-1]), time=time, throw=False)
        assert (response.result == RESULTS.successful) == fine
        again = drive(law, PARTICLE, response.force, time=time, control="load", throw=False)
        assert again.result == response.result
    more = drive(law, PARTICLE, path[:1], time=time[:1], state=state, throw=False)  # it has been there before
    assert more.result == RESULTS.gains_energy
    assert drive(law.without_effects(), PARTICLE, path).result == RESULTS.successful


@pytest.mark.extended
def test_it_is_refused_where_a_particle_code_refuses_it():
    """A particle driven to the end of the tests, and its half contact, whose energies are written separately."""
    law, particle = energy_paths.draw(8, 400, Unloading.PUNCH, StrainScaling.RAW)
    rng = np.random.default_rng(2)
    effects = tuple(
        eqx.filter_vmap(v.build)(jnp.asarray(rng.choice([0.0, 1.0], 400) * rng.uniform(*v.plausible, 400)))
        for v in AT_PEAK
        if v.name in ("exponential", "threshold", "stress")
    )
    law = law._with(effects)

    @eqx.filter_jit
    @eqx.filter_vmap
    def both(law, p):
        end = p.displacement(TESTED_STRAIN / law.shape_factor(p))
        state = eqx.tree_at(lambda s: s.displacement_max, law.init(p), end)
        return half_contact(law, p).is_passive, jnp.isinf(law.gain_strain(p, state))

    passive, ours = both(law, particle)
    assert 100 < np.sum(passive) < 400
    np.testing.assert_array_equal(passive, ours)


@pytest.mark.parametrize("name", ["platen_friction:sticking", "rate_dependence:yield_cowper_symonds"])
def test_what_lifts_the_loading_curve_is_not_given_back(name):
    """Random paths of force at rates that jump by orders of magnitude: these gained up to half of the work put in."""
    law, particle = energy_paths.draw(0, 2000, Unloading.PRINTED, StrainScaling.RAW)
    taken, given_back = energy_paths.with_effect(find_variant(name), law, particle, 0, 2000)
    assert np.all(given_back < taken)


def test_other_effects_do_not_hide_it():
    others = ("frame_compliance", "creep", "size_effect", "humidity")
    path, time = jnp.linspace(0.0, load_at_the_end(), 40), jnp.arange(40.0)
    with pytest.raises(InputError, match="with damage:square the particle") as caught:
        drive(gaining(6.0).with_effects(*others), PARTICLE, path, time=time, control="load")
    assert "creep" not in str(caught.value)
    fine = drive(law_of().with_effects(*others, "damage:cyclic"), PARTICLE, path, time=time, control="load")
    assert fine.result == RESULTS.successful


@pytest.mark.extended
def test_in_a_batch_and_in_a_campaign_the_particle_is_known():
    laws = eqx.filter_vmap(gaining)(jnp.array([0.5, 5.0, 1.0]))
    three = jax.tree.map(lambda x: jnp.repeat(x[None], 3), PARTICLE)
    path = jnp.tile(jnp.linspace(0.0, load_at_the_end(), 30), (3, 1))
    times = jnp.tile(jnp.arange(30.0), (3, 1))
    response = simulate_batch(laws, three, path, times=times, control="load")
    assert np.asarray(response.result == RESULTS.gains_energy).tolist() == [False, True, False]
    assert np.isfinite(response.displacement).all()
    plain = law_for_each(jax.tree.map(lambda x: jnp.repeat(x[None], 2), law_of().plastic), 1.43, 450.0, Unloading.PUNCH)
    hidden = {"particles": ("a", "b"), "effects": [HiddenEffect(find_variant("damage:square"), 5.0)]}
    with pytest.raises(InputError, match="with damage:square particle 'b', loaded beyond a strain of 0"):
        simulate_campaign(plain, [[105.0, 92.0, 85.0]] * 2, [1.0, load_at_the_end()], Programme.cycles(), **hidden)


@pytest.mark.extended
def test_compiled_code_raises_and_derivatives_are_those_of_the_law():
    path, time = jnp.linspace(0.0, load_at_the_end(), 30), jnp.arange(30.0)

    def energy(amplitude, throw):
        response = drive(gaining(amplitude), PARTICLE, path, time=time, control="load", throw=throw)
        return jnp.sum(response.displacement * path)

    compiled = eqx.filter_jit(energy)
    assert np.isfinite(compiled(jnp.asarray(5.0), False))
    with pytest.raises(eqx.EquinoxRuntimeError, match=r"more energy than that took.*throw=False"):
        compiled(jnp.asarray(5.0), True)

    # Down again, so that damage matters.
    path = path * jnp.concatenate([jnp.linspace(0.0, 1.0, 20), jnp.linspace(1.0, 0.3, 10)])
    slopes = [eqx.filter_jit(jax.grad(energy))(jnp.asarray(1.0), throw) for throw in (True, False)]
    assert slopes[0] == slopes[1] != 0
    h = 1e-5
    difference = (energy(1.0 + h, True) - energy(1.0 - h, True)) / (2 * h)
    np.testing.assert_allclose(slopes[0], difference, rtol=1e-6)
