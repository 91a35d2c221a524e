"""How fast are contacts, their gradient, new lists of them, and a compaction in the die?

Run `uv run --group bench python benchmarks/bench_dem.py`; `--write` keeps the tables in `benchmarks/results/`.

- pair: the force of every contact with its own two sides, size and history, loading and unloading, and its gradient by
  everything. One compiled call, `jax.vmap(pair_force)`.
- lists: what every contact remembers, carried over to a new list.
- compaction: spheres pressed in a die with damping and friction, particle-steps per second with lists made on the way;
  and the gradient through a recorded motion.

Compilation is not counted. The best of the rounds is shown: the machine may be busy with other things.
"""

from __future__ import annotations

import time

import _report
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mcc_jax import MccLaw, Particle, paper_law
from mcc_jax.dem import (
    HalfContact,
    Interaction,
    Motion,
    Packing,
    advance,
    carry_history,
    die,
    half_contact,
    list_edges,
    pair_force,
    rebuild_list,
    relative_density,
    replay,
    scattered,
    set_velocity,
    sides_of,
    spheres,
    stable_time_step,
    start,
)
from mcc_jax.simulate import paper_population

SKIN = 2e-5
SPEED = 1.0  # of the punch [m/s]


def seconds(call, *arguments, rounds=15):
    """Best time of a compiled call."""
    jax.block_until_ready(call(*arguments))
    best = float("inf")
    for _ in range(rounds):
        begin = time.perf_counter()
        jax.block_until_ready(call(*arguments))
        best = min(best, time.perf_counter() - begin)
    return best


def contacts(count):
    """Pairs of particles drawn from the paper's population, those that are monotone, half of them unloading."""
    keys = jax.random.split(jax.random.key(0), 6)
    plastic = paper_population().sample(keys[0], 3 * count)
    monotone = np.flatnonzero(jax.vmap(lambda p: p.is_monotone)(plastic))[: 2 * count]
    plastic = jax.tree.map(lambda x: x[monotone], plastic)
    size = jax.random.uniform(keys[1], (2 * count,), minval=80.0, maxval=220.0)
    modulus = jax.random.uniform(keys[2], (2 * count,), minval=12e3, maxval=20e3)

    def one(plastic, size, modulus):
        return half_contact(MccLaw(plastic, 1.43, modulus), Particle(size, size, size))

    sides = jax.jit(jax.vmap(one))(plastic, size, modulus)
    i, j = sides_of(sides, np.arange(count)), sides_of(sides, np.arange(count, 2 * count))
    overlap = (i.tested + j.tested) * jax.random.uniform(keys[3], (count,), maxval=1.0)
    drop = jnp.where(jax.random.uniform(keys[4], (count,)) < 0.5, 1.0, 1.02)
    return i, j, overlap * drop, overlap


def pairs(count):
    """Contacts per second, gradient over value, memory of the gradient."""
    i, j, peak, overlap = contacts(count)
    arguments = [(side.k1, side.k3, side.k5, side.c) for side in (i, j)] + [peak, overlap]

    def force(i, j, peak, overlap):
        """By the numbers that the force depends on; `tested` is none of them."""
        return pair_force(HalfContact(*i, jnp.ones(())), HalfContact(*j, jnp.ones(())), peak, overlap)

    forward = jax.jit(jax.vmap(force)).lower(*arguments).compile()

    def total(*arguments):
        return jnp.sum(jax.vmap(force)(*arguments))

    both = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2, 3))).lower(*arguments).compile()
    value, gradient = seconds(forward, *arguments), seconds(both, *arguments)
    memory = both.memory_analysis().temp_size_in_bytes / count
    rate = count / value / 1e6
    row = {
        "contacts": count,
        "million contacts/s": rate,
        "value and gradient / value": gradient / value,
        "temporaries [B/contact]": memory,
    }
    return row, [
        _report.verdict(f"million contacts/s at {count:g}", rate, 8 if count <= 1e5 else 4, at_least=True),
        _report.verdict(f"value and gradient / value at {count:g}", gradient / value, 2.5),
        _report.verdict(f"temporaries of the gradient at {count:g} [B/contact]", memory, 256),
    ]


def lists(count):
    """Milliseconds to carry the history over to a list with a tenth of the pairs new."""
    rng = np.random.default_rng(0)
    particles = count // 4
    old = rng.integers(0, particles, (count, 2))
    old = old[old[:, 0] != old[:, 1]]
    new = np.concatenate([old[len(old) // 10 :], rng.integers(0, particles, (count // 10, 2))])
    new = new[new[:, 0] != new[:, 1]]
    first, second = list_edges(old, particles, count), list_edges(new, particles, count)
    time_ms = 1e3 * seconds(carry_history, first, second)
    edge = sum(x.nbytes for x in (first.key, first.i, first.j, first.overlap_max, first.slip)) / count
    return {"edges": count, "carried over [ms]": time_ms, "held [B/edge]": edge}, [
        _report.verdict(f"history carried over at {count:g} edges [ms]", time_ms, 5 if count <= 1e5 else 100),
        _report.verdict(f"persistent state at {count:g} [B/edge]", edge, 48),
    ]


def pressed(count, density=0.65):
    """A packing in its die: scattered, then squeezed along z until contacts carry."""
    diameter = jax.random.uniform(jax.random.key(0), (count,), minval=80.0, maxval=120.0)
    packing = spheres(paper_law(), diameter)
    radius = 6e-4 * (count / 1000) ** (1 / 3)
    position, height = scattered(jax.random.key(1), packing.radius, radius)
    share = relative_density(packing, radius, 0.0, height) / density
    state = start(packing, die(radius, share * height), position.at[:, 2].multiply(share), SKIN)
    return packing, state


def motion_of(packing):
    return Motion.of(stable_time_step(packing), Interaction(damping=0.1, friction=0.3, wall_friction=0.3))


def compaction(count, target, rows=20, steps=100):
    """Particle-steps per second, with whatever lists it takes."""
    packing, state = pressed(count)
    motion = motion_of(packing)
    velocity = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -SPEED], [0.0, 0.0, 0.0]])
    advance(packing, motion, state, velocity, rows, steps, SKIN)  # compiles for every length of list on the way
    begin = time.perf_counter()
    state, found = advance(packing, motion, state, velocity, rows, steps, SKIN)
    rate = count * rows * steps / (time.perf_counter() - begin)
    row = {
        "particles": count,
        "edges": int(state.edges.active.sum()),
        "steps": rows * steps,
        "lists made": int(found.lists[-1]),
        "million particle-steps/s": rate / 1e6,
    }
    return row, [_report.verdict(f"million particle-steps/s at {count:g}", rate / 1e6, target / 1e6, at_least=True)]


def reverse(count=1000, steps=200):
    """Gradient through a recorded motion over the motion itself; lists as often as when it flows."""
    packing, state = pressed(count)
    motion = motion_of(packing)
    velocity = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -SPEED], [0.0, 0.0, 0.0]])
    tape, state = [], rebuild_list(packing, state, 4e-6)
    advance(packing, motion, state, velocity, 1, steps, 4e-6, tape=tape)
    state = eqx.tree_at(lambda s: s.walls, state, set_velocity(state.walls, jnp.asarray(velocity)))

    def height(scale):
        sides = eqx.tree_at(lambda s: s.k1, packing.sides, scale * packing.sides.k1)
        harder = Packing(packing.radius, packing.mass, sides)
        return jnp.mean(replay(harder, motion, state, tape).position[:, 2]) * 1e6

    forward, backward = jax.jit(height), jax.jit(jax.value_and_grad(height))
    one = jnp.ones(())
    ratio = seconds(backward, one, rounds=5) / seconds(forward, one, rounds=5)
    memory = backward.lower(one).compile().memory_analysis().temp_size_in_bytes / 2**20
    row = {"particles": count, "steps": steps, "lists": len(tape), "reverse / forward": ratio, "MiB": memory}
    return row, [_report.verdict("reverse / forward of a recorded motion", ratio, 5)]


def main():
    parser = _report.parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="leave out a million contacts and 1e5 particles")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    verdicts, tables = [], {}

    def add(name, results):
        tables[name] = [row for row, _ in results]
        verdicts.extend(verdict for _, found in results for verdict in found)

    many = (100_000,) if arguments.quick else (100_000, 1_000_000)
    add("Pair law", [pairs(count) for count in many])
    add("Lists", [lists(count) for count in many])
    runs = [compaction(1000, 5e5)]
    if not arguments.quick:
        runs.append(compaction(100_000, 2e5, rows=3, steps=50))
    add("Compaction", runs)
    add("Recorded motion", [reverse()])
    settings = {"dtype": "float64", "device": jax.devices()[0].device_kind}
    settings |= _report.environment("jax", "jaxlib", "equinox", "numpy", "scipy")
    tables = {"Targets": verdicts, **tables, "Settings": _report.settings(settings)}
    _report.write("dem", "Speed of contacts and compaction", tables, arguments.write)


if __name__ == "__main__":
    main()
