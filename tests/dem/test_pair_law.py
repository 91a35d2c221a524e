"""The pair rule: the plate test again, equal force, symmetry, limits, one history scalar, derivatives."""

import functools
import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from two_scalars import bisected_path

from mcc_jax import InputError, MccLaw, Particle, Plastic, Unloading
from mcc_jax.dem import half_contact, pair_energy, pair_force, pair_split, sides_of, wall_energy, wall_force
from mcc_jax.law import StrainScaling
from mcc_jax.simulate import paper_population

UM, MN = 1e-6, 1e-3
FORMS = [(u, s) for u in Unloading for s in (StrainScaling.RAW, StrainScaling.MASTER)]
MODULUS = {Unloading.PRINTED: 16000.0, Unloading.PUNCH: 450.0, Unloading.PUNCH_EXACT: 380.0}
PARTICLE = Particle(105.0, 92.0, 85.0)


def law_of(unloading=Unloading.PRINTED, scaling=StrainScaling.RAW, C1=16.0, C3=3.4, C5=2.7, a=1.43, modulus=None):
    modulus = MODULUS[unloading] if modulus is None else modulus
    return MccLaw(Plastic(C1, C3, C5), a, modulus, unloading, scaling)


def with_all(unloading, scaling=StrainScaling.CONTACT):
    """A law with effects on parameters and on the modulus at the peak."""
    at_peak = "damage:threshold", "densification_stiffening:heckel"
    return law_of(unloading, scaling).with_effects(*at_peak, "size_effect:flow_and_modulus", "shape_second_order")


def cycle(largest):
    """Load, unload, reload further, release, reload: overlaps, starting out of contact."""
    turns = np.array([-0.02, 0.6, 0.45, 0.8, 0.3, 1.0, -0.02, 0.9]) * largest
    return np.concatenate([np.linspace(a, b, 15) for a, b in itertools.pairwise(turns)])


def driven(force, overlaps):
    """Forces along a path of overlaps of one contact, the history being the running maximum before each."""
    before = np.maximum.accumulate(np.concatenate([[0.0], overlaps[:-1]]))
    return force(jnp.asarray(np.maximum(before, 0.0)), jnp.asarray(overlaps))


PAIRS, SPLITS, WALLS = (jax.jit(jax.vmap(f)) for f in (pair_force, pair_split, wall_force))
ON_PATH = jax.jit(jax.vmap(pair_force, (None, None, 0, 0)))
WALL_PATH = jax.jit(jax.vmap(wall_force, (None, 0, 0)))


def on_wall(side):
    return functools.partial(WALL_PATH, side)


def on_pair(i, j):
    return functools.partial(ON_PATH, i, j)


def drawn(seed, count):
    """Sides of particles drawn from the paper's population, those monotone, with sizes and shapes that differ."""
    keys = jax.random.split(jax.random.key(seed), 4)
    plastic = paper_population().sample(keys[0], count)
    size = jax.random.uniform(keys[1], (count,), minval=40.0, maxval=150.0)
    shape = jax.random.uniform(keys[2], (count, 2), minval=0.9, maxval=1.2)
    modulus = jax.random.uniform(keys[3], (count,), minval=8000.0, maxval=20000.0)

    def one(plastic, size, shape, modulus):
        return half_contact(MccLaw(plastic, 1.43, modulus), Particle(size * shape[0], size * shape[1], size))

    sides = jax.jit(jax.vmap(one))(plastic, size, shape, modulus)
    return sides_of(sides, np.flatnonzero(jax.vmap(lambda side: side.is_monotone)(sides)))


@pytest.mark.parametrize(("unloading", "scaling"), FORMS)
def test_walls_and_identical_pairs_are_the_plate_test(unloading, scaling):
    """T1 and T2: a particle between plates is two half contacts, each compressed by half the platen displacement; so is
    a pair of equal particles, whose overlap is the platen displacement."""
    law, displacement = law_of(unloading, scaling), cycle(45.0)
    expected = MN * law.path(PARTICLE, law.init(PARTICLE), jnp.asarray(displacement))[1]
    side = half_contact(law, PARTICLE)
    for force in (driven(on_wall(side), 0.5 * displacement * UM), driven(on_pair(side, side), displacement * UM)):
        assert np.max(np.abs(force - expected)) <= 1e-12 * np.max(expected)


def test_equal_force_symmetry_and_order():
    """T3: both sides carry the same force; exchanging them changes nothing."""
    sides = drawn(0, 2000)
    half = sides.k1.shape[0] // 2
    i, j = sides_of(sides, np.arange(half)), sides_of(sides, np.arange(half, 2 * half))
    overlap = (i.tested + j.tested) * np.random.default_rng(1).uniform(0.0, 1.3, half)
    d_i, d_j = SPLITS(i, j, overlap)
    force_i, force_j = WALLS(i, jnp.zeros_like(overlap), d_i), WALLS(j, jnp.zeros_like(overlap), d_j)
    np.testing.assert_allclose(force_i, force_j, rtol=2e-14, atol=0)
    np.testing.assert_allclose(d_i + d_j, overlap, rtol=1e-15)
    peak = 1.02 * overlap
    np.testing.assert_allclose(PAIRS(i, j, peak, overlap), PAIRS(j, i, peak, overlap), rtol=1e-12)


@pytest.mark.parametrize("kind", ["stiff", "large"])
def test_next_to_a_side_that_does_not_give_way_the_pair_is_the_wall(kind):
    """T3: stiffness and modulus of j without bound (recovery goes as the root of C / E, so E must win), or a body
    without curvature, whose recovery does not vanish with its curvature."""
    side = half_contact(law_of(), PARTICLE)
    if kind == "stiff":
        other = half_contact(law_of(C1=16e14, C3=0.0, C5=2.7e3, modulus=1.6e50), PARTICLE)
    else:
        other = half_contact(law_of(modulus=1.6e60), Particle(1e17, 1e17, 1e17))
    overlaps = cycle(20.0) * UM
    alone = driven(on_wall(side), overlaps)
    assert np.max(np.abs(driven(on_pair(side, other), overlaps) - alone)) <= 1e-12 * np.max(alone)


@pytest.mark.extended
def test_small_overlaps_add_stiffness_in_series():
    sides = drawn(1, 40)
    i, j = sides_of(sides, np.arange(10)), sides_of(sides, np.arange(10, 20))
    overlap = jnp.full(10, 1e-12)
    force = PAIRS(i, j, jnp.zeros(10), overlap)
    np.testing.assert_allclose(force / overlap, i.k1 * j.k1 / (i.k1 + j.k1), rtol=1e-9)


@pytest.mark.parametrize("unloading", list(Unloading))
def test_one_history_scalar_is_enough(unloading):
    """T4: the closed form against bisection with the two internal variables of each side."""
    i, j = pair(unloading)
    overlaps = cycle(34.0) * UM
    force = driven(on_pair(i, j), overlaps)
    expected = bisected_path(i, j, overlaps)
    assert np.max(np.abs(force - expected)) <= 1e-12 * np.max(expected)


def test_ellipsoid_along_its_axes_is_the_paper():
    """T6: along e3 radius and shape factor are the paper's, along e1 those of the particle laid on its side."""
    law = law_of()
    for normal, turned in (
        ([0.0, 0.0, 1.0], PARTICLE),
        ([1.0, 0.0, 0.0], Particle(PARTICLE.D2, PARTICLE.D3, PARTICLE.D1)),
        ([0.0, -1.0, 0.0], Particle(PARTICLE.D1, PARTICLE.D3, PARTICLE.D2)),
    ):
        side, expected = half_contact(law, PARTICLE, jnp.asarray(normal)), half_contact(law, turned)
        for found, wanted in zip(jax.tree.leaves(side), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-13)
    sphere = half_contact(law, Particle(80.0, 80.0, 80.0), jnp.asarray([0.6, 0.0, 0.8]))
    np.testing.assert_allclose(sphere.k1, np.pi * 40e-6 * 16e6, rtol=1e-13)


@pytest.mark.extended
def test_ellipsoid_turns_continuously():
    law = law_of()
    angles = jnp.linspace(0.0, np.pi / 2, 181)
    normals = jnp.stack([jnp.sin(angles), jnp.zeros_like(angles), jnp.cos(angles)], axis=1)
    sides = jax.vmap(lambda n: half_contact(law, PARTICLE, n))(normals)
    assert np.max(np.abs(np.diff(np.log(sides.k1)))) < 0.02
    slope = jax.jacfwd(lambda n: half_contact(law, PARTICLE, n).k1)(normals[40])
    assert np.all(np.isfinite(slope))


def pair(unloading=Unloading.PRINTED, effects=False):
    """Two unlike sides, with effects on parameters and modulus or without."""
    other = Particle(60.0, 62.0, 50.0)
    if effects:
        j = law_of(unloading, C1=11.0).with_effects("damage:stress")
        return half_contact(with_all(unloading), PARTICLE), half_contact(j, other)
    softer = law_of(unloading, C1=11.0, C3=3.0, C5=2.6, modulus=0.75 * MODULUS[unloading])
    return half_contact(law_of(unloading), PARTICLE), half_contact(softer, other)


@functools.cache
def compiled(unloading, effects):
    """Force of a pair, and its derivatives, by a vector of both sides' numbers, largest overlap and overlap."""
    _, sides = ravel_pytree(pair(unloading, effects))

    def force(vector):
        return pair_force(*sides(vector[:-2]), vector[-2], vector[-1])

    return jax.jit(force), jax.jit(jax.jacfwd(force)), jax.jit(jax.jacrev(force))


def vector_of(sides, peak, overlap):
    return jnp.concatenate([ravel_pytree(sides)[0], UM * jnp.array([peak, overlap])])


PLAIN = [
    *((1, 1, *at) for at in ((0.0, 8.0), (0.0, 25.0), (25.0, 24.9), (25.0, 24.0), (30.0, 29.5), (0.05, 0.03))),
    *((1e4, 1e4, *at) for at in ((2.0, 1.5), (60.0, 55.0))),
    *((1e4, 1, *at) for at in ((60.0, 58.0), (2.0, 1.8))),
]
WITH_EFFECTS = [(1, 1, *at) for at in ((0.0, 25.0), (25.0, 24.975), (25.0, 24.75), (50.0, 49.25))]


@pytest.mark.extended
@pytest.mark.parametrize(
    ("unloading", "effects", "soft_i", "soft_j", "peak", "overlap"),
    [(Unloading.PRINTED, False, *at) for at in PLAIN]
    + [(u, True, *at) for u in (Unloading.PRINTED, Unloading.PUNCH) for at in WITH_EFFECTS],
)
def test_derivatives_equal_differences(unloading, effects, soft_i, soft_j, peak, overlap):
    """T7: every parameter, on loading and unloading, both modes; sides limited by their peak or by their slope."""
    i, j = pair(unloading, effects)
    at = vector_of((replace(i, c=soft_i * i.c), replace(j, c=soft_j * j.c)), peak, overlap)
    force, by_forward, by_reverse = compiled(unloading, effects)
    value, forward, reverse = float(force(at)), by_forward(at), by_reverse(at)
    assert value > 0
    limited = soft_i > 1 or 0 < peak < 1
    rtol, atol = (1e-10, 1e-12 * value) if effects else (1e-11, 1e-12 * value) if limited else (1e-12, 0)
    np.testing.assert_allclose(forward * at, reverse * at, rtol=rtol, atol=atol)
    if effects:
        assert (np.abs(forward * at) > 0).sum() >= (12 if peak else 6)
    elif peak:  # a side at its limit no longer feels its modulus
        assert (forward[3] == 0) == limited
    for k in np.flatnonzero(at):
        step = 1e-5 * at[k]
        f = [force(at.at[k].add(m * step)) for m in (1, -1, 2, -2)]
        difference = (8 * (f[0] - f[1]) - (f[2] - f[3])) / (12 * step)
        assert abs(forward[k] - difference) * abs(at[k]) <= (2e-6 if effects else 1e-6) * value, k
    assert not forward[np.asarray(at) == 0].any()


@pytest.mark.parametrize("effects", [False, True])
def test_finite_everywhere(effects):
    sides, shares = pair(effects=effects), np.append(np.linspace(-0.5, 1.2, 18), [0.98, 1.0])
    peaks = (0.0, 1e-300, 1e-14, 1e-6, 1.0, 25.0, 60.0)
    at = jnp.stack([vector_of(sides, peak, share * peak) for peak in peaks for share in shares])
    force, _, by_reverse = compiled(Unloading.PRINTED, effects)
    value, gradient = jax.vmap(force)(at), jax.vmap(by_reverse)(at)
    assert np.all(np.isfinite(value))
    assert np.all(value >= 0)
    assert np.all(np.isfinite(gradient))


@pytest.mark.parametrize("unloading", list(Unloading))
def test_onset_and_release_are_finite(unloading):
    """Pitfall: at the onset the arc-function form gives a derivative that is NaN, just behind it a wrong one."""
    side = half_contact(law_of(unloading), PARTICLE)
    peak = jnp.asarray(20e-6)
    slope = jax.jit(jax.grad(lambda overlap: pair_force(side, side, peak, overlap)))
    expected = jax.grad(lambda overlap: pair_force(side, side, jnp.zeros(()), overlap))(peak)
    np.testing.assert_allclose(slope(peak), expected, rtol=1e-12)  # the exact peak: loading
    unloading_slope = float(slope(peak * (1 - 1e-6)))
    assert unloading_slope > 5 * expected
    for below in (1e-9, 1e-11, 1e-13):
        np.testing.assert_allclose(slope(peak * (1 - below)), unloading_slope, rtol=2e-3)
    span = 2 * np.sqrt(float(side.c) * (wall_force(side, peak * 0, peak / 2) / (peak / 2)))
    if unloading is Unloading.PRINTED:
        for overlap in (peak - span, peak - span * (1 + 1e-12), -peak):
            assert pair_force(side, side, peak, jnp.asarray(overlap)) == pytest.approx(0.0, abs=1e-20)
            assert np.isfinite(slope(jnp.asarray(overlap)))


@pytest.mark.extended
@pytest.mark.parametrize("spread_of_sizes", [(40.0, 110.0), (20.0, 150.0)])
def test_compiled_split_converges(spread_of_sizes):
    """Pitfall: compiled code that tests its bounds strictly bisects again after it has converged."""
    low, high = spread_of_sizes
    plastic = law_of().plastic
    radii = jnp.geomspace(low, high, 60)
    sides = jax.vmap(lambda R: half_contact(MccLaw(plastic, 1.43, 16000.0), Particle(2 * R, 2 * R, 2 * R)))(radii)
    i, j = (jax.tree.map(lambda x, k=k: jnp.ravel(jnp.meshgrid(x, x)[k]), sides) for k in (0, 1))
    for share in (1e-6, 0.3, 1.0, 1.6):
        d_i, d_j = SPLITS(i, j, share * (i.tested + j.tested))
        zero = jnp.zeros_like(d_i)
        np.testing.assert_allclose(WALLS(i, zero, d_i), WALLS(j, zero, d_j), rtol=2e-14)


@pytest.mark.parametrize("effects", [False, True])
@pytest.mark.parametrize("unloading", list(Unloading))
def test_energy_is_the_area_under_the_curve(unloading, effects):
    i, j = pair(unloading, effects)
    overlaps = np.concatenate([np.linspace(0, 30e-6, 4001), np.linspace(30e-6, 28e-6, 4001)])
    for force, energy in (
        (on_pair(i, j), pair_energy(i, j, jnp.asarray(30e-6), jnp.asarray(28e-6))),
        (on_wall(i), wall_energy(i, jnp.asarray(30e-6), jnp.asarray(28e-6))),
    ):
        forces = np.asarray(driven(force, overlaps))
        work = np.sum(0.5 * (forces[1:] + forces[:-1]) * np.diff(overlaps))
        np.testing.assert_allclose(energy.recoverable + energy.dissipated, work, rtol=2e-5)
        assert energy.recoverable >= 0


def test_forms_do_not_mix():
    i = half_contact(law_of(Unloading.PRINTED), PARTICLE)
    j = half_contact(law_of(Unloading.PUNCH), PARTICLE)
    with pytest.raises(InputError, match="different forms"):
        pair_force(i, j, jnp.zeros(()), jnp.asarray(1e-6))


def test_nan_shows():
    side = half_contact(law_of(), PARTICLE)
    assert np.isnan(pair_force(side, side, jnp.zeros(()), jnp.asarray(jnp.nan)))
    assert np.isnan(wall_force(side, jnp.zeros(()), jnp.asarray(jnp.nan)))


@pytest.mark.extended
def test_single_precision():
    side = half_contact(law_of(), PARTICLE)
    small = jax.tree.map(lambda x: x.astype(jnp.float32), side)
    overlaps = cycle(40.0) * UM
    double = np.asarray(driven(on_pair(side, side), overlaps))
    before = jnp.asarray(np.maximum.accumulate(np.concatenate([[0.0], overlaps[:-1]])).clip(0), jnp.float32)
    single = on_pair(small, small)(before, jnp.asarray(overlaps, jnp.float32))
    assert single.dtype == jnp.float32
    # Unloading turns a rounding of the overlap, 3e-12 m, into a force through a stiffness of 5e4 N/m.
    assert np.max(np.abs(np.asarray(single) - double)) <= 2e-4 * np.max(double)
