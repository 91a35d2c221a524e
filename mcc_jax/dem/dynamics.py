"""Explicit motion of a packing between walls: one step, many steps, neighbour lists renewed as needed; devices."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from .. import arguments
from .._format import described
from .._numerics import recompute
from .forces import Forces, Motion, bodies_of, contact_forces, pair_loads, wall_loads
from .neighbours import PADDING, Edges, stacked_lists, with_list
from .pair import wall_force, wall_recovery
from .state import Packing, State, WallHistory, check_state, measured, rebuild_list
from .walls import Walls, set_velocity

AXIS = "shares"

Devices: TypeAlias = Sequence[jax.Device]  # pyright: ignore[reportInvalidTypeForm]  # JAX names it by assignment
Contacts: TypeAlias = Callable[..., tuple[Forces, Edges, WallHistory]]
"""What computes all contact forces, with the arguments of `contact_forces`."""


class Segment(NamedTuple):
    """A list of edges and the number of steps on it, for `replay`."""

    key: Int[Array, " edges"]
    i: Int[Array, " edges"]
    j: Int[Array, " edges"]
    steps: Int[Array, ""]

    __repr__ = described()


class Trajectory(NamedTuple):
    """What was measured at the end of every row of steps, with one more axis in front.

    Attributes:
        on_wall: force on each wall [N], mean over the steps of the row.
        contacts: pairs and walls that carry force.
        beyond_tested: contacts compressed further than the paper's tests (eta_p eps > 0.67), on either side.
        kinetic: kinetic energy [J].
        lists, capacity: neighbour lists made so far, and the length of the latest.
    """

    time: np.ndarray
    walls: Walls
    on_wall: np.ndarray
    contacts: np.ndarray
    beyond_tested: np.ndarray
    kinetic: np.ndarray
    lists: np.ndarray
    capacity: np.ndarray

    __repr__ = described(time="s", kinetic="J")


def step(packing: Packing, motion: Motion, state: State, contacts: Contacts = contact_forces) -> tuple[State, Forces]:
    """One step of the symplectic Euler rule (leapfrog): forces by `contacts`, velocities, then positions and walls.

    The list of edges is taken as it is; `advance` renews it in time.
    """
    forces, edges, history = contacts(packing, motion, state)
    dt = motion.time_step
    decay = recompute(1 / (1 + dt * motion.drag))
    per_mass = recompute(1 / packing.mass)[:, None]
    per_inertia = recompute(1 / (0.4 * packing.mass * packing.radius * packing.radius))[:, None]
    velocity = decay * (state.velocity + dt * (forces.force * per_mass + motion.gravity[None]))
    spin = decay * (state.spin + dt * forces.torque * per_inertia)
    moved = replace(
        state,
        position=state.position + (dt * velocity).astype(state.position.dtype),
        velocity=velocity,
        spin=spin,
        edges=edges,
        wall_history=history,
        walls=tuple(wall.moved(dt.astype(state.time.dtype)) for wall in state.walls),
        time=state.time + dt.astype(state.time.dtype),
    )
    return moved, forces


def run(
    packing: Packing,
    motion: Motion,
    state: State,
    steps: int,
    wanted: Int[Array, ""] | int,
    devices: Devices | None = None,
) -> State:
    """Steps on one list of edges, as one compiled loop of so many steps, of which the first `wanted` are taken.

    Differentiable in both modes; contacts are divided over `devices` (`jax.devices()`) if there are any.
    """
    steps = arguments.whole(steps, "steps")

    def loop(contacts: Contacts, packing: Packing, motion: Motion, state: State, wanted: Array) -> tuple[State, tuple]:
        # Reverse mode keeps the state of each step and computes the step again: what is in between costs more to keep.
        @jax.checkpoint
        def one(state: State, k: Array) -> tuple[State, None]:
            return jax.lax.cond(k < wanted, lambda s: step(packing, motion, s, contacts)[0], lambda s: s, state), None

        return jax.lax.scan(one, state, jnp.arange(steps))[0], ()

    return sharded(loop, devices, packing, motion, state, jnp.asarray(wanted))[0]


def _run_while_listed(devices: Devices | None, *given: Any) -> tuple[State, tuple[Array, Array]]:
    """Steps while the list is complete, with values of this process in and out: it makes the next list."""
    if devices is None:
        return _while_listed(None, *given)
    found = _while_listed(tuple(devices), *jax.tree.map(np.asarray, given))
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), found)


@functools.partial(jax.jit, static_argnums=0)
def _while_listed(devices: Devices | None, *given: Any) -> tuple[State, tuple[Array, Array]]:
    """Steps until a particle is further than half the skin from where it was listed."""

    def loop(contacts: Contacts, packing: Packing, motion: Motion, state: State, steps: Int[Array, ""]) -> Any:
        def list_valid(carry):
            state, done, _ = carry
            away = jnp.max(jnp.sum((state.position - state.listed_at) ** 2, axis=1))
            return (done < steps) & (away <= (state.skin / 2) ** 2)

        def one(carry):
            state, done, on_wall = carry
            state, forces = step(packing, motion, state, contacts)
            return state, done + 1, on_wall + forces.on_wall

        walls = jnp.zeros((len(state.walls), 3), state.velocity.dtype)
        state, done, on_wall = jax.lax.while_loop(list_valid, one, (state, jnp.zeros_like(steps), walls))
        return state, (done, on_wall)

    return sharded(loop, devices, *given)


def advance(
    packing: Packing,
    motion: Motion,
    state: State,
    velocity: Any,
    rows: int,
    steps: int,
    skin: float,
    tape: list[Segment] | None = None,
    devices: Devices | None = None,
) -> tuple[State, Trajectory]:
    """Move on for a time, with a new list of edges whenever a particle has moved by half the skin.

    Args:
        packing, motion, state: the spheres, how they move, and where they start.
        velocity: of each wall [m/s].
        rows, steps: how often something is measured, and steps from one row to the next.
        skin: extra distance up to which pairs are listed [m]: as far as a particle moves in a few tens of steps.
        tape: a list to which the lists of edges are appended, for `replay`.
        devices: over which the contacts are divided, for example `jax.devices()`, those of all processes after
            `jax.distributed.initialize`; every process calls this with the same arguments. Not divided if None.

    Returns:
        The state at the end, with the walls still moving, and the rows.

    Raises:
        InputError: if a particle left the walls or a position became NaN.
    """
    rows, steps = arguments.whole(rows, "rows"), arguments.whole(steps, "steps")
    skin = arguments.number(skin, "skin [m]", least=0)
    state = replace(state, walls=set_velocity(state.walls, velocity))
    made = 0
    if skin > float(state.skin):  # the list at hand may not hold all the pairs that the caller relies on
        state, made = rebuild_list(packing, state, skin), 1
    table = []
    for _ in range(rows):
        left, on_wall = steps, 0.0
        while left:
            state, (done, force) = _run_while_listed(devices, packing, motion, state, jnp.asarray(left))
            on_wall = on_wall + force
            left -= int(done)
            if tape is not None and int(done):
                tape.append(Segment(state.edges.key, state.edges.i, state.edges.j, done))
            if left:
                check_state(state)
                state = rebuild_list(packing, state, skin)
                made += 1
        check_state(state)
        capacity = state.edges.capacity
        row: tuple[Any, ...] = (state.time, state.walls, on_wall / steps, *measured(packing, state), made, capacity)
        table.append(Trajectory(*row))
    return state, jax.tree.map(lambda *column: np.stack(column), *table)


def replay(
    packing: Packing, motion: Motion, state: State, tape: Sequence[Segment], devices: Devices | None = None
) -> State:
    """The same motion again over the lists of edges that `advance` recorded, differentiable in both modes.

    The state is the one `advance` started from, with the walls' velocities set (`set_velocity`); packing, motion and
    devices are as there. A gradient through thousands of steps is exact for that trajectory, and of little use for
    compaction, because rearrangements are chaotic (see `compact`).
    """
    segments = stacked_lists(tape)
    longest = max(int(segment.steps) for segment in tape)

    def one(state: State, segment: Segment) -> tuple[State, None]:
        state = replace(state, edges=with_list(state.edges, segment.key, segment.i, segment.j))
        return run(packing, motion, state, longest, segment.steps, devices), None

    first = with_list(state.edges, segments.key[0], segments.i[0], segments.j[0])  # as long as all others
    return jax.lax.scan(one, replace(state, edges=first), segments)[0]


def stable_time_step(packing: Packing, safety: float = 0.3) -> float:
    r"""Time step [s] at which contacts unloading from the end of the tested range are resolved.

    .. math:: \Delta t = s \min_i \sqrt{m_i / k_i}

    with k_i the steepest slope of unloading of particle i against its like from eta_p eps = 0.67; above that range take
    less. The safety s = 0.3 allows for several contacts a particle.
    """
    safety = arguments.number(safety, "safety", above=0)

    def steepest(side):
        return 4 / jnp.pi * wall_force(side, side.tested, side.tested) / (2 * wall_recovery(side, side.tested))

    stiffness = jax.vmap(steepest)(packing.sides)
    return safety * float(jnp.min(jnp.sqrt(packing.mass / stiffness)))


def in_single(packing: Packing, motion: Motion, state: State) -> tuple[Packing, Motion, State]:
    """The same with forces, velocities and history in float32; positions, walls and time stay in double precision.

    An overlap is a small difference of coordinates: in float32 a die of 1 mm knows places to 1e-10 m only. Forces err
    by about 1e-6 of the largest (tested to 1e-5). History takes 16 B an edge instead of 32.
    """

    def single(tree: Any) -> Any:
        return jax.tree.map(lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)

    history = {name: single(getattr(state, name)) for name in ("velocity", "spin", "edges", "wall_history")}
    return single(packing), single(motion), replace(state, **history)


def sharded[Moving: eqx.Module](
    loop: Callable[..., tuple[Moving, Any]],
    devices: Devices | None,
    packing: Packing,
    motion: eqx.Module,
    state: Moving,
    *further: jax.Array,
) -> tuple[Moving, Any]:
    """A loop over time steps with its contacts divided over devices; differentiable like the loop itself.

    Edges, sorted by key, are divided in contiguous shares of equal length, contacts with walls by particle. Every
    device has and moves all particles; a step needs one reduction, of forces, torques and forces on walls. The loop is
    called with what computes the contact forces, packing, motion, state and what is further; it returns the state, and
    anything that is the same on all devices. Without devices nothing is divided.
    """
    if devices is None:
        return loop(contact_forces, packing, motion, state, *further)
    mesh = Mesh(np.asarray(devices), (AXIS,))
    whole, share = PartitionSpec(), PartitionSpec(AXIS)
    padded = _padded(state, len(devices))
    specs = eqx.tree_at(_sharded_leaves, jax.tree.map(lambda _: whole, padded), (share,) * len(_sharded_leaves(padded)))

    def one_share(packing: Packing, motion: eqx.Module, state: Moving, *further: jax.Array) -> tuple[Moving, Any]:
        # Marked once, outside the loop: its derivative is then summed over devices once, not in every step.
        own = jax.lax.pcast(packing, AXIS, to="varying")
        return loop(functools.partial(_share_of_contacts, own), packing, motion, state, *further)

    moved, rest = jax.shard_map(
        one_share, mesh=mesh, in_specs=(whole, whole, specs, *(whole for _ in further)), out_specs=(specs, whole)
    )(packing, motion, padded, *further)
    everywhere = NamedSharding(mesh, whole)
    remembered = zip(_sharded_leaves(moved)[3:], _sharded_leaves(state)[3:], strict=True)
    kept = [jax.lax.with_sharding_constraint(x[: len(before)], everywhere) for x, before in remembered]
    return eqx.tree_at(_sharded_leaves, moved, (*_sharded_leaves(state)[:3], *kept)), rest


def _sharded_leaves(state: Any) -> tuple[jax.Array, ...]:
    """What is dealt out, one row an edge or a particle: three arrays that list the edges, then what they remember."""
    edges, history = state.edges, state.wall_history
    return edges.key, edges.i, edges.j, edges.overlap_max, edges.slip, history.overlap_max, history.slip


def _padded(state: Any, parts: int) -> Any:
    """The state with as many edges, and rows of contacts with walls, as divide among the parts."""

    def longer(x: Array, value: int = 0) -> Array:
        missing = parts * math.ceil(len(x) / parts) - len(x)
        return jnp.pad(x, [(0, missing), *[(0, 0)] * (x.ndim - 1)], constant_values=value)

    key, *others = _sharded_leaves(state)
    return eqx.tree_at(_sharded_leaves, state, (longer(key, PADDING), *map(longer, others)))


def _share_of_contacts(packing: Packing, _: Packing, motion: Motion, state: State) -> tuple[Forces, Edges, WallHistory]:
    """`contact_forces` on one device of several, which holds a share of the edges and of the contacts with walls."""
    moving = jax.lax.pcast((state.position, state.velocity, state.spin), AXIS, to="varying")
    bodies = bodies_of(packing, *moving)
    loads, edges = pair_loads(motion, bodies, state.edges)
    particles, rows = loads.shape[0], state.wall_history.slip.shape[0]
    own = jax.lax.axis_index(AXIS) * rows + jnp.arange(rows)
    index = jnp.minimum(own, particles - 1)
    # The last share may be short: a radius below zero touches nothing.
    some = jax.tree.map(lambda x: x[index], bodies)
    some = eqx.tree_at(lambda b: b.radius, some, jnp.where(own < particles, some.radius, -1.0))
    at_walls, on_wall, history = wall_loads(motion, state.walls, some, state.wall_history)
    loads = loads.at[index].add(at_walls)
    loads = jax.lax.psum(jnp.concatenate([loads, jnp.pad(on_wall, ((0, 0), (0, 3)))]), AXIS)
    forces = Forces(loads[:particles, :3], loads[:particles, 3:], loads[particles:, :3])
    return forces, edges, history
