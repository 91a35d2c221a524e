"""All contact forces of a packing at once: pairs over the edges, walls densely, one sum over the particles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import arguments
from .._errors import InputError
from .._format import described
from .._numerics import recompute
from .._types import Flag, Scalar, ScalarLike, scalar
from .neighbours import Edges, overlap_and_normal
from .pair import HalfContact, largest_overlap, pair_force, wall_force
from .state import Packing, State, Vectors, WallHistory
from .walls import Vector, Wall, Walls, dot, length_of


def _share(value: ScalarLike | None) -> Any:
    arguments.positive(0.0 if value is None else value, "a number of an interaction [-]", zero=True, plain=True)
    return None if value is None else scalar(value)


class Interaction(eqx.Module):
    r"""What a contact does besides the law, all of it off by default.

    .. math::
        F_n = \max(F + 2 \beta \sqrt{m_{ij} k}\, \dot\delta, 0), \qquad
        F_t = k_t \xi + 2 \beta \sqrt{m_{ij} k_t}\, \dot\xi, \quad |F_t| \le \mu F_n, \quad k_t = r_t k

    with k the initial stiffness of the contact, m_ij the reduced mass and xi the slip that the contact remembers. Where
    Coulomb's limit is met, the slip is set back to what the limit can hold (Cundall and Strack, 1979). F_t acts in the
    middle of the overlap, as in LAMMPS, or at the wall, so that pairs conserve angular momentum.

    Attributes:
        damping: beta, share of critical damping [-].
        friction: mu between particles [-]; None, not 0, leaves the tangential part out of what is computed.
        wall_friction: mu against walls [-]; None likewise.
        tangential_ratio: r_t, tangential over initial normal stiffness [-].
    """

    damping: Scalar = eqx.field(converter=_share, default=0.0)
    friction: Scalar | None = eqx.field(converter=_share, default=None)
    wall_friction: Scalar | None = eqx.field(converter=_share, default=None)
    tangential_ratio: Scalar = eqx.field(converter=_share, default=0.8)

    __repr__ = described()


class Motion(eqx.Module):
    """How the packing moves: time step [s] (`stable_time_step`), damping and friction, drag, gravity [m/s^2].

    Drag is the rate at which all velocities decay [1/s]: a way to a quasi-static state, not physics.
    """

    time_step: Scalar
    interaction: Interaction
    drag: Scalar
    gravity: Float[Array, " 3"]

    __repr__ = described(time_step="s", gravity="m/s²")

    @classmethod
    def of(
        cls,
        time_step: float,
        interaction: Interaction | None = None,
        drag: float = 0.0,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> Motion:
        """From plain numbers, in double precision."""
        time_step = arguments.number(time_step, "the time step [s], see `stable_time_step`,", above=0)
        drag = arguments.number(drag, "drag [1/s]", least=0)
        acceleration = arguments.floats(gravity, "gravity", shape="three components [m/s^2]")
        # A single number would act along all three axes.
        if acceleration.shape != (3,) or not np.isfinite(acceleration).all():
            raise InputError(f"gravity must be three finite components [m/s^2], got {arguments.shown(gravity)}")
        step, resistance, weight = (jnp.asarray(x, float) for x in (time_step, drag, acceleration))
        return cls(step, interaction or Interaction(), resistance, weight)


class Forces(eqx.Module):
    """Force [N] and torque [N m] on each particle about its centre, and force on each wall [N]."""

    force: Vectors
    torque: Vectors
    on_wall: Float[Array, "walls 3"]

    __repr__ = described()


class _Body(eqx.Module):
    """One sphere, as its contacts see it."""

    radius: Scalar
    mass: Scalar
    side: HalfContact
    position: Vector
    velocity: Vector
    spin: Vector


Load = tuple[Vector, Vector, Vector]
"""Force on the first body of a contact, its moment per unit arm, and slip after it."""


def contact_forces(packing: Packing, motion: Motion, state: State) -> tuple[Forces, Edges, WallHistory]:
    """Forces of all contacts, and what they remember after them; slip adds up over the time step."""
    bodies = bodies_of(packing, state.position, state.velocity, state.spin)
    load, edges = pair_loads(motion, bodies, state.edges)
    at_walls, on_wall, history = wall_loads(motion, state.walls, bodies, state.wall_history)
    load = load + at_walls
    return Forces(load[:, :3], load[:, 3:], on_wall), edges, history


def bodies_of(packing: Packing, position: Vectors, velocity: Vectors, spin: Vectors) -> _Body:
    """The spheres as their contacts see them, in a batch."""
    return jax.vmap(_Body)(packing.radius, packing.mass, packing.sides, position, velocity, spin)


def pair_loads(motion: Motion, bodies: _Body, edges: Edges) -> tuple[Float[Array, "particles 6"], Edges]:
    """Force and torque of all edges, or any part of them, summed over the particles, and what the edges remember."""
    i, j = (jax.tree.map(lambda x, at=at: x[at], bodies) for at in (edges.i, edges.j))
    between = jax.vmap(_between, (None, 0, 0, 0, 0, 0))
    (force, moment, slip), overlap_max, arms = between(motion, i, j, edges.active, edges.overlap_max, edges.slip)
    on_i, on_j = force, -force
    if motion.interaction.friction is not None:  # without it there is no torque to add up
        on_i, on_j = _load(on_i, arms[0], moment), _load(on_j, arms[1], moment)
    total = jnp.zeros((bodies.radius.shape[0], on_i.shape[1]), bodies.radius.dtype)
    total = total.at[edges.i].add(on_i).at[edges.j].add(on_j)
    total = jnp.pad(total, ((0, 0), (0, 6 - total.shape[1])))
    return total, eqx.tree_at(lambda e: (e.overlap_max, e.slip), edges, (overlap_max, slip))


def wall_loads(
    motion: Motion, walls: Walls, bodies: _Body, history: WallHistory
) -> tuple[Float[Array, "particles 6"], Float[Array, "walls 3"], WallHistory]:
    """Force and torque of the walls on all particles, or any part of them, forces on the walls, and the memory."""
    load = jnp.zeros((bodies.radius.shape[0], 6), bodies.radius.dtype)
    on_wall, columns = [], []
    for w, wall in enumerate(walls):
        against = jax.vmap(_against, (None, None, 0, 0, 0))
        found = against(motion, wall, bodies, history.overlap_max[:, w], history.slip[:, w])
        (force, moment, slip), largest, arm = found
        load = load + _load(force, arm, moment)
        on_wall.append(-jnp.sum(force, axis=0))
        columns.append((largest, slip))
    if not walls:
        return load, jnp.zeros((0, 3), load.dtype), history
    return load, jnp.stack(on_wall), WallHistory(*(jnp.stack(x, axis=1) for x in zip(*columns, strict=True)))


@jax.vmap
def _load(force: Vector, arm: Scalar, moment: Vector) -> Float[Array, " 6"]:
    return jnp.concatenate([force, arm * moment])


def _between(
    motion: Motion, i: _Body, j: _Body, listed: Flag, overlap_max: Scalar, slip: Vector
) -> tuple[Load, Scalar, tuple[Scalar, Scalar]]:
    friction = motion.interaction.friction
    overlap, normal = overlap_and_normal(i.position, j.position, i.radius + j.radius, listed)
    # The two arms add up to the distance of the centres: so angular momentum is conserved.
    arms = i.radius - overlap / 2, j.radius - overlap / 2
    relative = j.velocity - i.velocity
    if friction is not None:
        relative = relative - jnp.cross(arms[0] * i.spin + arms[1] * j.spin, normal)
    # Without the barriers XLA computes the law again for every use of its force.
    overlap, normal, relative = jax.lax.optimization_barrier((overlap, normal, relative))
    elastic = jax.lax.optimization_barrier(pair_force(i.side, j.side, overlap_max, overlap))
    k = recompute(i.side.k1 * j.side.k1 / (i.side.k1 + j.side.k1))
    mass = recompute(i.mass * j.mass / (i.mass + j.mass))
    load = _contact(motion, friction, elastic, k, mass, normal, relative, slip)
    return load, largest_overlap(overlap_max, overlap), arms


def _against(motion: Motion, wall: Wall, body: _Body, overlap_max: Scalar, slip: Vector) -> tuple[Load, Scalar, Scalar]:
    friction, dtype = motion.interaction.wall_friction, body.radius.dtype
    outward = -wall.normal_at(body.position).astype(dtype)
    overlap = (body.radius.astype(body.position.dtype) - wall.distance(body.position)).astype(dtype)
    arm = body.radius - overlap
    relative = wall.velocity.astype(dtype) - body.velocity
    if friction is not None:
        relative = relative - jnp.cross(arm * body.spin, outward)
    elastic = jax.lax.optimization_barrier(wall_force(body.side, overlap_max, overlap))
    load = _contact(motion, friction, elastic, body.side.k1, body.mass, outward, relative, slip)
    return load, largest_overlap(overlap_max, overlap), arm


def _contact(
    motion: Motion,
    friction: Scalar | None,
    elastic: Scalar,
    k: Scalar,
    mass: Scalar,
    normal: Vector,
    relative: Vector,
    slip: Vector,
) -> Load:
    """Load on the first body. The normal points to the second, whose surface moves relative to that of the first."""
    opening = dot(relative, normal)
    touching = elastic > 0
    damping = 2 * motion.interaction.damping
    push = elastic - damping * recompute(jnp.sqrt(mass * k)) * opening
    push = jnp.where(touching & (push > 0), push, jnp.where(jnp.isnan(elastic), elastic, 0.0))
    if friction is None:
        return -push * normal, jnp.zeros_like(normal), slip

    # The contact plane turned since the last step: keep the slip's length and put it into the new plane.
    sliding = relative - opening * normal
    in_plane = slip - dot(slip, normal) * normal
    sliding, push, in_plane = jax.lax.optimization_barrier((sliding, push, in_plane))
    before, after = length_of(dot(slip, slip)), length_of(dot(in_plane, in_plane))
    slip = in_plane * recompute(before / (after + jnp.finfo(slip.dtype).tiny ** 0.5))
    slip = slip + motion.time_step * sliding
    stiffness = motion.interaction.tangential_ratio * k
    trial = stiffness * slip + damping * recompute(jnp.sqrt(mass * stiffness)) * sliding
    slip, trial = jax.lax.optimization_barrier((slip, trial))
    limit = friction * push
    size = length_of(dot(trial, trial))
    slips = size > limit
    tangential = trial * jnp.where(slips, recompute(limit / jnp.where(slips, size, 1.0)), 1.0)
    tangential = jax.lax.optimization_barrier(tangential)
    held = jnp.where(slips, tangential * recompute(1 / jnp.where(stiffness > 0, stiffness, 1.0)), slip)
    return tangential - push * normal, jnp.cross(normal, tangential), jnp.where(touching, held, 0.0)
