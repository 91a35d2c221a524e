"""The library's pair law, which other engines are checked against, next to a bisection of the paper's own formulas."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bisecting import pair_force as bisected
from compiling import MODULUS_MPA, PARTICLE

from mcc_jax import MccLaw, Particle, Plastic, Unloading
from mcc_jax.dem import half_contact, pair_force, pair_recovery, wall_force, wall_recovery
from mcc_jax.export import golden_pair_table
from mcc_jax.law import StrainScaling

ONE = PARTICLE
OTHER = Particle(90.0, 120.0, 100.0)


def law_of(C1, C3, C5, a, unloading):
    return MccLaw(Plastic(C1, C3, C5), a, MODULUS_MPA[unloading], unloading, StrainScaling.CONTACT)


@eqx.filter_jit
def response(i, j, peaks, overlaps):
    """Force, tangent and recovered overlap, SI."""

    def one(peak, overlap):
        def force(x):
            return wall_force(i, peak, x) if j is None else pair_force(i, j, peak, x)

        width = wall_recovery(i, peak) if j is None else pair_recovery(i, j, peak)
        return (*jax.value_and_grad(force)(overlap), width)

    return jax.vmap(one)(peaks, overlaps)


@pytest.mark.parametrize("unloading", Unloading)
@pytest.mark.parametrize("ratio", [None, 1e-5, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e5])
def test_library_equals_bisection_whatever_the_sizes(unloading, ratio):
    """Down to dust and up to what is a wall; `None` is a wall."""
    one, two = law_of(6.7, 3.0, 2.66, 1.43, unloading), law_of(9.0, 2.5, 2.4, 0.5, unloading)
    other = None if ratio is None else jax.tree.map(lambda d: ratio * d, OTHER)
    i, j = half_contact(one, ONE), None if ratio is None else half_contact(two, other)
    reach = 1e6 * (float(i.tested) if j is None else 2 * min(float(i.tested), float(j.tested)))
    rng = np.random.default_rng(0)
    peaks = reach * np.concatenate([rng.uniform(0.01, 1, 40), [1e-9]])
    width = bisected(one, ONE, two, other, peaks, peaks)[2]
    overlaps = peaks - width * np.where(rng.uniform(size=peaks.size) < 0.4, 0.0, rng.uniform(0, 0.99, peaks.size))
    want = bisected(one, ONE, two, other, overlaps, peaks)
    got = [np.asarray(v) for v in response(i, j, jnp.asarray(1e-6 * peaks), jnp.asarray(1e-6 * overlaps))]
    at_peak = bisected(one, ONE, two, other, peaks, peaks)[0]  # close to release the overlap's own rounding shows
    np.testing.assert_array_less(np.abs(1e3 * got[0] - want[0]), 1e-11 * at_peak)
    np.testing.assert_allclose(1e-3 * got[1], want[1], rtol=1e-9)
    np.testing.assert_allclose(1e6 * got[2], want[2], rtol=1e-11)


def test_table_equals_bisection():
    law = law_of(6.7, 3.0, 2.66, 1.43, Unloading.PRINTED)
    table = golden_pair_table(law, ONE)
    for partner, other in (("equal", ONE), ("smaller", jax.tree.map(lambda d: 0.6 * d, ONE)), ("wall", None)):
        rows = table[table["partner"] == partner]
        x, peak = rows["displacement_um"].to_numpy(), rows["displacement_max_um"].to_numpy()
        force, tangent, _ = bisected(law, ONE, law, other, x, peak)
        np.testing.assert_allclose(rows["force_mN"], force, rtol=0, atol=1e-12 * force.max())
        np.testing.assert_allclose(rows["tangent_mN_per_um"], tangent, rtol=0, atol=1e-9 * tangent.max())
