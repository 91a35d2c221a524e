"""Explicit motion of a packing between walls: one step, many steps, neighbour lists made anew as needed."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from .._errors import InputError
from .._numerics import shared
from .._types import Scalar
from ._edges import PADDING, Edges, carry_history, list_edges, widened
from ._forces import Forces, Interaction, Packing, Vector, Vectors, WallHistory, contact_forces, overlap_and_normal
from ._neighbours import close_pairs
from ._pair import pair_split
from ._sharded import Contacts, Devices, at_home, divided
from ._side import sides_of
from ._walls import Walls, set_velocity

SPARE = 1.25
"""Room in the list of edges beyond the pairs found when it was made."""


class State(eqx.Module):
    """Everything that moves or remembers. Saved and loaded whole (`save_state`), it goes on bit for bit.

    Attributes:
        position: centres [m].
        velocity: of the centres [m/s].
        spin: angular velocities [rad/s].
        edges: pairs and their history.
        wall_history: history of contacts with walls.
        walls: the walls, where they are now.
        listed_at: positions when the list of edges was made [m].
        time: [s].
    """

    position: Vectors
    velocity: Vectors
    spin: Vectors
    edges: Edges
    wall_history: WallHistory
    walls: Walls
    listed_at: Vectors
    time: Scalar


class Motion(eqx.Module):
    """How the packing moves.

    Attributes:
        time_step: [s]; see `stable_time_step`.
        interaction: damping and friction of contacts.
        drag: rate at which all velocities decay [1/s]; a way to a quasi-static state, not physics.
        gravity: acceleration [m/s^2].
    """

    time_step: Scalar
    interaction: Interaction
    drag: Scalar
    gravity: Float[Array, " 3"]

    @classmethod
    def of(
        cls,
        time_step: float,
        interaction: Interaction | None = None,
        drag: float = 0.0,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        dtype: DTypeLike = jnp.float64,
    ) -> Motion:
        """From plain numbers.

        Raises:
            InputError: if the time step is not positive.
        """
        if not time_step > 0:
            raise InputError(f"a time step of {time_step} s", remedy="Take that of `stable_time_step`.")
        given = jax.tree.map(lambda x: x.astype(dtype), interaction or Interaction())
        return cls(jnp.asarray(time_step, dtype), given, jnp.asarray(drag, dtype), jnp.asarray(gravity, dtype))


class Trajectory(NamedTuple):
    """What was measured at the end of every chunk of steps.

    Attributes:
        time: [s].
        walls: the walls then, with one more axis in front.
        on_wall: force on each wall [N], mean over the chunk's steps.
        contacts: pairs and walls that carry force.
        beyond_tested: contacts compressed further than the paper's tests (eta_p eps > 0.67), on either side.
        kinetic: kinetic energy [J].
        lists: neighbour lists made so far.
        capacity: length of the list of edges.
    """

    time: np.ndarray
    walls: Walls
    on_wall: np.ndarray
    contacts: np.ndarray
    beyond_tested: np.ndarray
    kinetic: np.ndarray
    lists: np.ndarray
    capacity: np.ndarray


class Segment(NamedTuple):
    """A list of edges and for how many steps it was used: what `replay` needs. 16 B an edge."""

    key: Int[Array, " edges"]
    i: Int[Array, " edges"]
    j: Int[Array, " edges"]
    steps: Int[Array, ""]


class Sample(NamedTuple):
    """One row of a `Trajectory`."""

    time: Scalar
    walls: Walls
    on_wall: Float[Array, "walls 3"]
    contacts: Int[Array, ""]
    beyond_tested: Int[Array, ""]
    kinetic: Scalar


def start(packing: Packing, walls: Walls, position: Vectors, skin: float, capacity: int | None = None) -> State:
    """A state at rest: virgin contacts, a fresh list of edges.

    Args:
        packing: the spheres.
        walls: the walls.
        position: centres [m].
        skin: extra distance up to which pairs are listed [m], for example a fifth of a radius.
        capacity: room for edges; a quarter more than there are pairs if None.

    Raises:
        InputError: if a position is not finite, a particle is outside the walls, a half contact resists nothing, or
            the pairs do not fit the capacity.
    """
    check_packing(packing)
    dtype = position.dtype
    state = State(
        position,
        jnp.zeros_like(position),
        jnp.zeros_like(position),
        list_edges(np.zeros((0, 2), np.int64), len(position), 0, dtype),
        WallHistory.virgin(len(position), len(walls), dtype),
        walls,
        position,
        jnp.zeros((), dtype),
    )
    check_state(state)
    return listed(packing, state, skin, capacity)


def listed(packing: Packing, state: State, skin: float, capacity: int | None = None) -> State:
    """The state with a fresh list of edges; contacts keep their history.

    Args:
        packing: the spheres.
        state: any state, also one whose list is stale.
        skin: as in `start`.
        capacity: room for edges; if None that of the present list, or a quarter more than the pairs if they do not fit.

    Raises:
        InputError: as `close_pairs`, and if the pairs do not fit a capacity that was asked for.
    """
    pairs = close_pairs(np.asarray(state.position, float), np.asarray(packing.radius, float), skin)
    room = state.edges.capacity if capacity is None else capacity
    if capacity is None and len(pairs) > room:
        room = 64 * math.ceil(SPARE * len(pairs) / 64 + 1)
    fresh = list_edges(pairs, len(state.position), room, state.edges.overlap_max.dtype)
    fresh.require_room()
    if state.edges.capacity:
        fresh = carry_history(state.edges, fresh)
    return eqx.tree_at(lambda s: (s.edges, s.listed_at), state, (fresh, state.position))


def step(packing: Packing, motion: Motion, state: State, contacts: Contacts = contact_forces) -> tuple[State, Forces]:
    """One step of the symplectic Euler rule (leapfrog): forces, then velocities, then positions and walls.

    The list of edges is taken as it is; `advance` makes it anew in time. `contacts` computes the forces.
    """
    forces, edges, history = contacts(
        packing,
        motion.interaction,
        state.walls,
        state.position,
        state.velocity,
        state.spin,
        state.edges,
        state.wall_history,
        motion.time_step,
    )
    dt = motion.time_step
    velocity, spin = jax.vmap(_kicked, (None, 0, 0, 0, 0, 0, 0))(
        motion, packing.mass, packing.radius, state.velocity, state.spin, forces.force, forces.torque
    )
    moved = State(
        state.position + (dt * velocity).astype(state.position.dtype),
        velocity,
        spin,
        edges,
        history,
        tuple(wall.moved(motion.time_step.astype(state.time.dtype)) for wall in state.walls),
        state.listed_at,
        state.time + dt.astype(state.time.dtype),
    )
    return moved, forces


def _kicked(
    motion: Motion, mass: Scalar, radius: Scalar, velocity: Vector, spin: Vector, force: Vector, torque: Vector
) -> tuple[Vector, Vector]:
    """Velocity and spin of one sphere after a step."""
    dt = motion.time_step
    decay = shared(1 / (1 + dt * motion.drag))
    inertia = 0.4 * mass * radius * radius
    return (
        decay * (velocity + dt * (force * shared(1 / mass) + motion.gravity)),
        decay * (spin + dt * torque * shared(1 / inertia)),
    )


def run(
    packing: Packing,
    motion: Motion,
    state: State,
    steps: int,
    wanted: Int[Array, ""] | int,
    devices: Devices | None = None,
) -> State:
    """Steps on one list of edges, as one compiled loop, differentiable in both modes.

    Args:
        packing: the spheres.
        motion: time step, damping, friction.
        state: where to start.
        steps: length of the loop.
        wanted: how many of these steps are taken.
        devices: over which the contacts are divided (`jax.devices()`); not divided if None.
    """

    def loop(contacts: Contacts, packing: Packing, motion: Motion, state: State, wanted: Array) -> tuple[State, tuple]:
        def one(state: State, k: Array) -> tuple[State, None]:
            return jax.lax.cond(k < wanted, lambda s: step(packing, motion, s, contacts)[0], lambda s: s, state), None

        return jax.lax.scan(one, state, jnp.arange(steps))[0], ()

    return divided(loop, devices, packing, motion, state, jnp.asarray(wanted))[0]


@functools.partial(jax.jit, static_argnums=0)
def _run_while_listed(
    devices: Devices | None, packing: Packing, motion: Motion, state: State, steps: Int[Array, ""], skin: Scalar
) -> tuple[State, tuple[Int[Array, ""], Float[Array, "walls 3"]]]:
    return divided(_while_listed, devices, packing, motion, state, steps, skin)


def _while_listed(
    contacts: Contacts, packing: Packing, motion: Motion, state: State, steps: Int[Array, ""], skin: Scalar
) -> tuple[State, tuple[Int[Array, ""], Float[Array, "walls 3"]]]:
    """Steps for as long as the list is complete: no particle further than half the skin from where it was listed."""

    def goes_on(carry):
        state, done, _ = carry
        away = jnp.max(jnp.sum((state.position - state.listed_at) ** 2, axis=1))
        return (done < steps) & (away <= (skin / 2) ** 2)

    def one(carry):
        state, done, on_wall = carry
        state, forces = step(packing, motion, state, contacts)
        return state, done + 1, on_wall + forces.on_wall

    walls = jnp.zeros((len(state.walls), 3), state.velocity.dtype)
    state, done, on_wall = jax.lax.while_loop(goes_on, one, (state, jnp.zeros_like(steps), walls))
    return state, (done, on_wall)


def advance(
    packing: Packing,
    motion: Motion,
    state: State,
    velocity: Float[Array, "walls 3"] | np.ndarray,
    rows: int,
    steps: int,
    skin: float,
    tape: list[Segment] | None = None,
    devices: Devices | None = None,
) -> tuple[State, Trajectory]:
    """Move on for a time, with a new list of edges whenever a particle has moved by half the skin.

    Args:
        packing: the spheres.
        motion: time step, damping, friction.
        state: where to start.
        velocity: of each wall [m/s].
        rows: how often something is measured.
        steps: steps from one row to the next.
        skin: extra distance up to which pairs are listed [m]; as large as a particle moves in a few tens of steps or
            more, so that lists are made rarely.
        tape: a list to which the lists of edges are appended, for `replay`.
        devices: over which the contacts are divided, for example `jax.devices()`, those of all processes after
            `jax.distributed.initialize`; every process calls this with the same arguments. Not divided if None.

    Returns:
        The state at the end, with the walls still moving, and the rows.

    Raises:
        InputError: if a particle left the walls, a position became NaN. The state passed in is untouched.
    """
    state = eqx.tree_at(lambda s: s.walls, state, set_velocity(state.walls, jnp.asarray(velocity)))
    limit = jnp.asarray(skin, state.position.dtype)
    table, lists, capacity, made = [], [], [], 0
    for _ in range(rows):
        left, on_wall = steps, 0.0
        while left:
            state, (done, force) = at_home(_run_while_listed, devices, packing, motion, state, jnp.asarray(left), limit)
            on_wall = on_wall + force
            left -= int(done)
            if tape is not None and int(done):
                tape.append(Segment(state.edges.key, state.edges.i, state.edges.j, done))
            if left:
                check_state(state)
                state = listed(packing, state, skin)
                made += 1
        check_state(state)
        table.append(_sample(packing, state, on_wall / steps))
        lists.append(made)
        capacity.append(state.edges.capacity)
    columns: Sample = jax.tree.map(lambda *x: np.stack(x), *table)
    return state, Trajectory(**columns._asdict(), lists=np.asarray(lists), capacity=np.asarray(capacity))


def replay(
    packing: Packing, motion: Motion, state: State, tape: Sequence[Segment], devices: Devices | None = None
) -> State:
    """The same motion again over the lists of edges that `advance` recorded, differentiable in both modes.

    Neighbour lists have no derivative and are made on the host; the contacts on them have. In reverse mode each list's
    steps are computed twice and only the states between lists are kept. A gradient through thousands of steps is exact
    for that trajectory and says little about compaction: rearrangements are chaotic (see the quasi-static compaction).

    Args:
        packing: the spheres.
        motion: as in `advance`.
        state: the state `advance` started from, with the walls' velocities set (`set_velocity`).
        tape: of one call of `advance`.
        devices: as in `run`.
    """
    if not tape:
        return state
    room = max(segment.key.shape[0] for segment in tape)
    longest = max(int(segment.steps) for segment in tape)
    segments = jax.tree.map(lambda *x: jnp.stack(x), *(_widened(segment, room) for segment in tape))

    @jax.checkpoint
    def one(state: State, segment: Segment) -> tuple[State, None]:
        empty = jnp.zeros(room, state.edges.overlap_max.dtype)
        fresh = Edges(
            segment.key,
            segment.i,
            segment.j,
            empty,
            jnp.zeros((room, 3), empty.dtype),
            state.edges.wanted,
            state.edges.particles,
        )
        state = eqx.tree_at(lambda s: s.edges, state, carry_history(state.edges, fresh))
        return run(packing, motion, state, longest, segment.steps, devices), None

    state = eqx.tree_at(lambda s: s.edges, state, widened(state.edges, room))
    return jax.lax.scan(one, state, segments)[0]


def _widened(segment: Segment, room: int) -> Segment:
    spare = room - segment.key.shape[0]
    return Segment(
        jnp.pad(segment.key, (0, spare), constant_values=PADDING),
        jnp.pad(segment.i, (0, spare)),
        jnp.pad(segment.j, (0, spare)),
        segment.steps,
    )


def stable_time_step(packing: Packing, safety: float = 0.3) -> float:
    r"""Time step [s] at which contacts unloading from the end of the tested range are resolved.

    .. math:: \Delta t = s \min_i \sqrt{m_i / k_i}

    with k_i the steepest slope of unloading of particle i against its like from eta_p eps = 0.67, some thirty times the
    initial stiffness. Above that range take less.

    Args:
        packing: the spheres.
        safety: s; 0.3 leaves room for several contacts a particle.
    """

    def steepest(side):
        force = side.tested * (side.k1 - side.k3 * side.tested**2 + side.k5 * side.tested**4)
        square = side.c * (force / side.tested) ** side.power * side.tested ** (side.power - 1)
        return 4 / jnp.pi * force / (2 * jnp.sqrt(square))

    stiffness = jax.vmap(steepest)(packing.sides)
    return safety * float(jnp.min(jnp.sqrt(packing.mass / stiffness)))


def check_packing(packing: Packing) -> None:
    """Refuse half contacts that resist nothing.

    Raises:
        InputError: naming the first such particle.
    """
    valid = np.asarray(jax.vmap(lambda side: side.is_valid)(packing.sides))
    valid = valid & np.asarray((packing.radius > 0) & (packing.mass > 0))
    if not valid.all():
        raise InputError(
            f"particle {np.flatnonzero(~valid)[0]} has no positive radius, mass or stiffness, or a shape factor <= 0",
            remedy="Check its coefficients and diameters.",
        )


def not_monotone(packing: Packing) -> Bool[np.ndarray, " particles"]:
    """Which particles soften until their force falls; the split of their contacts is not unique. Draw them anew."""
    return ~np.asarray(jax.vmap(lambda side: side.is_monotone)(packing.sides))


def check_state(state: State) -> None:
    """Refuse a state that has gone astray.

    Raises:
        InputError: if a position is not finite or a particle's centre is behind a wall; it names particle and wall.
    """
    lost, behind = (np.asarray(x) for x in _astray(state))
    if lost.any():
        raise InputError(
            f"the position of particle {np.flatnonzero(lost)[0]} is not finite at {float(state.time):.6g} s",
            remedy="A smaller time step, or look at how the packing was made.",
        )
    for w, wall in enumerate(state.walls):
        if behind[w].any():
            raise InputError(
                f"particle {np.flatnonzero(behind[w])[0]} is outside wall {w} ({type(wall).__name__}) "
                f"at {float(state.time):.6g} s",
                remedy="Place particles inside; if it was pushed through, a smaller time step or a slower punch.",
            )


@jax.jit
def _astray(state: State) -> tuple[Bool[Array, " particles"], Bool[Array, "walls particles"]]:
    """Which particles are nowhere, and which are behind which wall."""
    behind = [jax.vmap(wall.distance)(state.position) < 0 for wall in state.walls]
    lost = ~jnp.all(jnp.isfinite(state.position), axis=1)
    return lost, jnp.stack(behind) if behind else jnp.zeros((0, len(lost)), bool)


@jax.jit
def _sample(packing: Packing, state: State, on_wall: Float[Array, "walls 3"]) -> Sample:
    edges, history = state.edges, state.wall_history
    i, j = sides_of(packing.sides, edges.i), sides_of(packing.sides, edges.j)
    reach = packing.radius[edges.i] + packing.radius[edges.j]
    overlap, _ = jax.vmap(overlap_and_normal)(state.position[edges.i], state.position[edges.j], reach, edges.active)
    d_i, d_j = jax.vmap(pair_split)(i, j, edges.overlap_max)
    beyond = edges.active & ((d_i > i.tested) | (d_j > j.tested))
    beyond_at_walls = history.overlap_max > jnp.broadcast_to(packing.sides.tested[:, None], history.overlap_max.shape)
    extent = packing.radius.astype(state.position.dtype)
    wall_overlap = [extent - jax.vmap(wall.distance)(state.position) for wall in state.walls]
    touching = jnp.sum(overlap > 0) + sum(jnp.sum(x > 0) for x in wall_overlap)
    kinetic = 0.5 * jnp.sum(packing.mass * jnp.sum(state.velocity**2, axis=1)) + 0.2 * jnp.sum(
        packing.mass * packing.radius**2 * jnp.sum(state.spin**2, axis=1)
    )
    return Sample(
        state.time,
        state.walls,
        on_wall,
        touching,
        jnp.sum(beyond) + jnp.sum(beyond_at_walls),
        kinetic,
    )
