"""No contact of a particle code gains energy: random paths of unlike pairs, spheres that bounce, energies of pairs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SOME_FORMS

from benchmarks import energy_paths
from mcc_jax import MccLaw, Plastic, Unloading
from mcc_jax.dem import (
    Motion,
    Plane,
    half_contact,
    pair_energy,
    pair_recovery,
    pair_split,
    spheres,
    start,
    step,
    wall_recovery,
)
from mcc_jax.geometry import Particle
from mcc_jax.law import StrainScaling

ROUNDING = 1e-13


@pytest.mark.extended
@SOME_FORMS
def test_random_paths_of_unlike_pairs_gain_nothing(unloading, scaling):
    """Other forms differ in a factor on the recovery, which random moduli and shapes cover."""
    law, particle = energy_paths.draw(5, 1000, unloading, scaling)
    whole, between = energy_paths.gains(*energy_paths.pair(law, particle, *energy_paths.choices(5, 1000)))
    assert whole.max() < 0
    assert between.max() <= ROUNDING
    shares = np.divide(*energy_paths.split(law, particle))
    assert np.quantile(np.maximum(shares, 1 / shares), 0.9) > 1.5  # they are unlike


def law_of(unloading, modulus, C1=9.0):
    return MccLaw(Plastic(C1, 3.0, 2.7), 1.43, modulus, unloading, StrainScaling.RAW)


@pytest.mark.extended
@pytest.mark.parametrize("unloading", Unloading)
def test_each_side_of_a_pair_has_its_own_limit(unloading):
    """A soft modulus beside a stiff one: one side at its limit, the other by its formula."""
    i = half_contact(law_of(unloading, 5.0), Particle(100.0, 100.0, 100.0))
    j = half_contact(law_of(unloading, 16000.0, C1=12.0), Particle(60.0, 66.0, 50.0))
    overlap = jnp.array(4e-6)
    d_i, d_j = pair_split(i, j, overlap)
    each = wall_recovery(i, d_i), wall_recovery(j, d_j)
    np.testing.assert_allclose(pair_recovery(i, j, overlap), sum(each), rtol=1e-13)
    assert abs(float(each[0] / d_i) - 1) < 1e-13
    assert float(each[1] / d_j) < 0.9


@pytest.mark.extended
@pytest.mark.parametrize("unloading", Unloading)
def test_what_a_pair_loses_never_falls(unloading):
    law, particle = energy_paths.draw(6, 200, unloading, StrainScaling.RAW)
    sides = eqx.filter_vmap(half_contact)(law, particle)
    others = jax.tree.map(lambda x: jnp.roll(x, 1, axis=0), sides)
    share = jnp.geomspace(1e-9, 2.0, 100)

    @jax.jit
    @jax.vmap
    def lost(i, j):
        overlap = 2 * jnp.minimum(i.tested, j.tested) * share
        return jax.vmap(lambda o: pair_energy(i, j, o, o).dissipated)(overlap)

    lost = np.asarray(lost(sides, others))
    assert np.all(lost > 0)
    assert np.all(np.diff(lost, axis=1) > 0)


DIAMETER = 100.0


@pytest.mark.extended
@pytest.mark.parametrize("unloading", Unloading)
@pytest.mark.parametrize("softened", [1.0, 0.02])
def test_a_bouncing_sphere_never_gains(unloading, softened):
    """Between two plates, from very slow to fast enough to leave the tested range: each bounce is at most as fast."""
    modulus = softened * (16000.0 if unloading is Unloading.PRINTED else 450.0)
    law = MccLaw(Plastic(7.0094, 27.235 ** (1 / 3), 144.23**0.2), 1.43, modulus, unloading)
    packing = spheres(law, jnp.asarray([DIAMETER]))
    walls = (
        Plane([0.0, 0.0, -0.5e-6 * DIAMETER], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]),
        Plane([0.0, 0.0, 0.5e-6 * DIAMETER], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]),
    )
    state = start(packing, walls, jnp.zeros((1, 3)), 1e-6)
    period = float(np.sqrt(packing.mass[0] / packing.sides.k1[0]))
    time_step = 1e-3 * period
    motion = Motion.of(time_step)
    speeds = np.array([1e-4, 0.03, 1.0, 10.0, 60.0])

    @jax.jit
    @jax.vmap
    def kinetic(speed):
        gap = 0.3 * period * speed
        moving = eqx.tree_at(lambda s: s.velocity, state, jnp.zeros((1, 3)).at[0, 2].set(speed))
        points = [w.point.at[2].add(side * gap) for w, side in zip(walls, (-1.0, 1.0), strict=True)]
        moving = eqx.tree_at(lambda s: [w.point for w in s.walls], moving, points)

        def one(state, _):
            state, forces = step(packing, motion, state)
            kinetic = 0.5 * packing.mass[0] * jnp.sum(state.velocity**2)
            return state, (kinetic, jnp.all(forces.on_wall == 0))

        last, rows = jax.lax.scan(one, moving, None, length=20_000)
        return *rows, jnp.max(last.wall_history.overlap_max)

    energy, free, overlap = (np.asarray(x) for x in kinetic(jnp.asarray(speeds)))
    assert np.isfinite(energy).all()
    tested = float(packing.sides.tested[0])
    assert overlap[0] < 1e-4 * tested
    assert overlap[-1] > tested
    for history, flying, speed in zip(energy, free, speeds, strict=True):
        first = 0.5 * float(packing.mass[0]) * speed**2
        departures = np.flatnonzero(~flying[:-1] & flying[1:]) + 1
        assert len(departures) >= 2
        flights = np.concatenate([[first], history[departures]])
        # Later bounces on the same plate are elastic, and as right as a bounce in finite steps can be.
        assert np.all(np.diff(flights) <= 1e-4 * flights[:-1])
        assert flights[1] < 0.9 * first
        assert history[flying].max() <= first * (1 + 1e-12)
