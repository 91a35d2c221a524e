"""Random load-unload-reload paths, and the energy that a contact takes and returns along them, by quadrature of force.

Nothing here uses the library's own energies: forces only. `single` is a particle between plates, `pair` two half
contacts in series; `study_energy.py` and the tests run them.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mcc_jax.dem import half_contact, pair_force, pair_recovery, pair_split
from mcc_jax.effects import clean_record
from mcc_jax.geometry import Particle
from mcc_jax.law import TESTED_STRAIN, History, MccLaw, Plastic

TURNS = 6
"""Times a path is unloaded; each time it is reloaded, in one case of three not up to its peak."""
BEYOND = 2.0
"""Largest scaled strain of a path over that at which the paper's tests ended."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1), 0.5 * _WEIGHTS


def draw(seed, count, unloading, scaling):
    """Laws and particles, batched: the paper's scatter, any plausible shape, moduli of 0.25 to 20 GPa; monotone."""
    rng = np.random.default_rng(seed)
    C1, C5 = rng.lognormal(1.9027, 0.2985, count), rng.lognormal(0.9784, 0.0797, count)
    softening = np.where(rng.random(count) < 0.5, 0.33, rng.random(count))  # 9 C3^6 / (20 C1 C5^5)
    C3 = (softening * 20 / 9 * C1 * C5**5) ** (1 / 6)
    a, modulus = rng.uniform(-0.5, 2.0, count), 10 ** rng.uniform(np.log10(250), np.log10(20e3), count)
    D = rng.uniform(40, 400, (2, count))
    D3 = np.sqrt(D[0] * D[1]) * rng.uniform(0.55, 1.1, count)
    law = eqx.filter_vmap(lambda *c: MccLaw(Plastic(*c[:3]), c[3], c[4], unloading, scaling))(
        *map(jnp.asarray, (C1, C3, C5, a, modulus))
    )
    return law, eqx.filter_vmap(Particle)(*map(jnp.asarray, (D[0], D[1], D3)))


def choices(seed, count):
    """What a path does at each turn: growth of its peak, depth of its release, how far back up it goes (log or share).

    Peaks start anywhere from 1e-9 of the end of the tests, and end at most at `BEYOND` times it.
    """
    rng = np.random.default_rng(seed + 1)
    first = rng.uniform(-9, np.log10(BEYOND), count)
    growth = np.where(rng.random((count, TURNS)) < 0.5, rng.uniform(0, 0.05, (count, TURNS)), 0.0)
    growth = np.where(rng.random((count, TURNS)) < 0.3, rng.uniform(0, 3, (count, TURNS)), growth)
    peaks = np.minimum(first[:, None] + np.cumsum(growth, axis=1), np.log10(BEYOND))
    partial = np.where(rng.random((count, TURNS)) < 1 / 3, rng.random((count, TURNS)), 1.0)
    depth = np.where(rng.random((count, TURNS)) < 0.3, 1.2, rng.uniform(0, 1.2, (count, TURNS)))
    depth[:, -1] = 1.2  # what can be got back is got back
    return tuple(map(jnp.asarray, (10**peaks, partial, depth)))


RAMP = 24  # points of each ramp of a path of force


def with_effect(variant, law, particle, seed, count):
    """Energy put in and got back along paths of force with a formula, each path with numbers of its own."""
    rng = np.random.default_rng(seed + 2)

    def drawn(low, high):
        return np.exp(rng.uniform(np.log(low), np.log(high), count)) if low > 0 else rng.uniform(low, high, count)

    sign = rng.choice([-1, 1], count) if variant.sign == 0 else variant.sign
    numbers = {n.name: jnp.asarray(drawn(*n.plausible)) for n in variant.nuisances}
    amplitude = jnp.asarray(sign * drawn(*variant.plausible))
    # Stresses of 0.1 to 20 MPa at the peaks; every third ramp back up ends below the peak before.
    stress = 10 ** np.cumsum(np.column_stack([rng.uniform(-1, 1, count), rng.uniform(0, 0.06, (count, TURNS - 1))]), 1)
    tops = stress * np.where(rng.random(stress.shape) < 1 / 3, rng.random(stress.shape), 1.0)
    lows = tops * np.where(rng.random(tops.shape) < 0.3, 0.0, rng.random(tops.shape))
    lows[:, -1] = 0.0
    turns = np.stack([tops, lows], -1).reshape(count, -1)
    ends = np.concatenate([np.zeros((count, 1)), turns], 1)
    share = np.linspace(0, 1, RAMP + 1)[1:]
    path = (ends[:, :-1, None] + np.diff(ends, axis=1)[..., None] * share).reshape(count, -1)
    times = np.cumsum(np.repeat(10 ** rng.uniform(-1, 3, turns.shape) / RAMP, RAMP, axis=1), 1)
    humidity = jnp.asarray(rng.uniform(5, 95, count))

    def one(law, particle, amplitude, numbers, stress, time, humidity):
        effect = variant.build(amplitude, **numbers)
        force = particle.force(jnp.append(0.0, stress))
        record = clean_record(force, jnp.append(0.0, time), relative_humidity=humidity)
        moved = law.with_effects(effect).respond(particle, record)
        work = 0.5 * (force[1:] + force[:-1]) * jnp.diff(moved)
        return jnp.sum(jnp.maximum(work, 0.0)), -jnp.sum(jnp.minimum(work, 0.0))

    found = eqx.filter_jit(eqx.filter_vmap(one))(
        law, particle, amplitude, numbers, *map(jnp.asarray, (path, times)), humidity
    )
    return tuple(map(np.asarray, found))


def _walk(force, recovered, reach, peaks, partial, depth):
    """Work done on the contact in each piece, up and down by turns, (2 TURNS,), and what it was given back below 0."""

    def elastic(peak, low, high):
        """Integral of the force on the branch from `peak`; its root of 3/2 at full release is mapped away."""
        span = recovered(peak)
        end = peak - span
        ends = [jnp.sqrt(jnp.clip((x - end) / span, 0.0, 1.0)) for x in (low, high)]
        t = ends[0] + (ends[1] - ends[0]) * jnp.asarray(_NODES)
        along = jax.vmap(lambda t: force(peak, end + span * t * t))(t)
        return (ends[1] - ends[0]) * 2 * span * jnp.sum(_WEIGHTS * t * along)

    def plastic(low, high):
        x = low + (high - low) * _NODES
        return (high - low) * jnp.sum(_WEIGHTS * jax.vmap(lambda x: force(x, x))(x))

    def turn(state, choice):
        peak, now = state
        target, share, depth = choice
        # Up: past the old peak to a new one, or part of the way back.
        top = jnp.where(share < 1, now + share * (jnp.maximum(peak, now) - now), jnp.maximum(target * reach, now))
        top = jnp.where(peak == 0, target * reach, top)
        new = jnp.maximum(peak, top)
        reload = jnp.where(peak > 0, elastic(jnp.where(peak > 0, peak, reach), now, jnp.minimum(top, peak)), 0.0)
        up = reload + jnp.where(new > peak, plastic(peak, new), 0.0)
        bottom = jnp.minimum(top, new - depth * recovered(new))
        down = -elastic(new, bottom, top)
        return (new, bottom), (jnp.stack([up, down]), force(new, bottom) == 0)

    _, (work, released) = jax.lax.scan(turn, (jnp.zeros_like(reach), jnp.zeros_like(reach)), (peaks, partial, depth))
    return work, released


@eqx.filter_jit
@eqx.filter_vmap
def single(law, particle, peaks, partial, depth):
    """Work (turns, up and down) [nJ] on particles between plates, and whether each turn ended in full release."""
    reach = TESTED_STRAIN * particle.effective_diameter / law.shape_factor(particle)

    def force(peak, now):
        return law.step(particle, History(peak), now)[1]

    def recovered(peak):
        return particle.displacement(law.recoverable_strain(particle, particle.strain(peak)))

    return _walk(force, recovered, reach, peaks, partial, depth)


@eqx.filter_jit
@eqx.filter_vmap
def _pair(i, j, peaks, partial, depth):
    reach = 2 * jnp.minimum(i.tested, j.tested)
    return _walk(
        functools.partial(pair_force, i, j), functools.partial(pair_recovery, i, j), reach, peaks, partial, depth
    )


def pair(law, particle, peaks, partial, depth):
    """The same [J] for each particle against the next one: other coefficients, size, shape and modulus."""
    sides = eqx.filter_jit(eqx.filter_vmap(half_contact))(law, particle)
    others = jax.tree.map(lambda x: jnp.roll(x, 1, axis=0), sides)
    return _pair(sides, others, peaks, partial, depth)


def split(law, particle):
    """Compressions of the two sides of such pairs at the end of the tests, to show how unlike they are."""
    sides = eqx.filter_jit(eqx.filter_vmap(half_contact))(law, particle)
    others = jax.tree.map(lambda x: jnp.roll(x, 1, axis=0), sides)
    return jax.jit(jax.vmap(pair_split))(sides, others, 2 * jnp.minimum(sides.tested, others.tested))


def gains(work, released):
    """Energy gained, as a share of the energy put in: along whole paths, and between any two full releases.

    Returns:
        Two arrays over paths, at most rounding above zero if nothing gains: -(net work) / (work in) at the worst turn,
        and the largest fall of the net work from one full release to a later one, over the work in until then.
    """
    work, released = np.asarray(work), np.asarray(released)
    assert np.isfinite(work).all()
    assert released[:, -1].all()
    net = np.cumsum(work.sum(axis=2), axis=1)
    put_in = np.cumsum(np.maximum(work, 0).sum(axis=2), axis=1)
    whole = (-net / put_in).max(axis=1)
    at_release = np.where(released, net, -np.inf)
    before = np.maximum.accumulate(np.concatenate([np.zeros((len(net), 1)), at_release[:, :-1]], axis=1), axis=1)
    between = np.where(released, (before - net) / put_in, -np.inf).max(axis=1)
    return whole, between
