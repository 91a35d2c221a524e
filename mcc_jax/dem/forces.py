"""All contact forces of a packing at once: pairs over the edges, walls densely, one sum over the particles."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from .. import arguments
from .._format import described
from .._numerics import shared
from .._types import Flag, Scalar, ScalarLike, scalar
from .edges import Edges
from .pair import largest_overlap, pair_force, wall_force
from .side import HalfContact
from .walls import Wall, Walls, dot

Vectors = Float[Array, "particles 3"]
Vector = Float[Array, " 3"]


class Packing(eqx.Module):
    """Spheres, and how each of them pushes back.

    Attributes:
        radius: [m].
        mass: [kg].
        sides: half contacts, one a particle (``jax.vmap(half_contact)``).
    """

    radius: Float[Array, " particles"]
    mass: Float[Array, " particles"]
    sides: HalfContact

    __repr__ = described(radius="m", mass="kg")

    @property
    def volume(self) -> Scalar:
        """Volume of all spheres [m^3], overlaps not taken off."""
        return 4 / 3 * jnp.pi * jnp.sum(self.radius**3)


def _share(value: ScalarLike) -> Scalar:
    arguments.positive(value, "damping or tangential_ratio [-]", zero=True, plain=True)
    return scalar(value)


def _friction(value: ScalarLike | None) -> Scalar | None:
    arguments.positive(0.0 if value is None else value, "friction or wall_friction [-]", zero=True, plain=True)
    return None if value is None else scalar(value)


class Interaction(eqx.Module):
    r"""What a contact does besides the law, all of it off by default.

    .. math::
        F_n = \max(F + 2 \beta \sqrt{m_{ij} k}\, \dot\delta, 0), \qquad
        F_t = k_t \xi + 2 \beta \sqrt{m_{ij} k_t}\, \dot\xi, \quad |F_t| \le \mu F_n, \quad k_t = r_t k

    with k the initial stiffness of the contact, m_ij the reduced mass and xi the slip that the contact remembers. Where
    Coulomb's limit is met, the slip is set back to what the limit can hold (Cundall and Strack, 1979).

    Attributes:
        damping: beta, share of critical damping [-].
        friction: mu between particles [-]; None, not 0, leaves the tangential part out of what is computed.
        wall_friction: mu against walls [-]; None likewise.
        tangential_ratio: r_t, tangential over initial normal stiffness [-].
    """

    damping: Scalar = eqx.field(converter=_share, default=0.0)
    friction: Scalar | None = eqx.field(converter=_friction, default=None)
    wall_friction: Scalar | None = eqx.field(converter=_friction, default=None)
    tangential_ratio: Scalar = eqx.field(converter=_share, default=0.8)

    __repr__ = described()


class WallHistory(eqx.Module):
    """What the contacts with walls remember: dense, one place for each particle and wall.

    Attributes:
        overlap_max: largest overlap so far [m].
        slip: elastic tangential displacement of the wall against the particle's surface [m].
    """

    overlap_max: Float[Array, "particles walls"]
    slip: Float[Array, "particles walls 3"]

    __repr__ = described()

    @classmethod
    def virgin(cls, particles: int, walls: int, dtype: DTypeLike = jnp.float64) -> WallHistory:
        """Nothing has touched yet."""
        return cls(jnp.zeros((particles, walls), dtype), jnp.zeros((particles, walls, 3), dtype))


class Forces(eqx.Module):
    """Forces of all contacts.

    Attributes:
        force: on each particle [N].
        torque: on each particle about its centre [N m].
        on_wall: on each wall [N].
    """

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


class _Contact(eqx.Module):
    """One contact: force on the first body, its couple per radius of either body, and what the contact remembers."""

    force: Vector
    couple: Vector
    overlap_max: Scalar
    slip: Vector


def overlap_and_normal(i: Vector, j: Vector, reach: Scalar, listed: Flag) -> tuple[Scalar, Vector]:
    """Overlap [m] of two spheres and unit vector from i to j.

    Two centres in one place have no normal: they get none, and so no force. A place in the list that no pair uses
    overlaps by -1 m. A position that is NaN shows. The overlap, a small difference of large numbers, is taken in the
    precision of the positions and then rounded to that of the radii.

    Args:
        i, j: centres [m].
        reach: sum of the radii [m].
        listed: whether this is a pair at all.
    """
    between = j - i
    square = dot(between, between)
    apart = listed & (square > 0)
    distance = shared(jnp.sqrt(jnp.where(apart, square, 1.0)))
    separation = reach.astype(distance.dtype) - distance
    overlap = jnp.where(apart, separation, jnp.where(listed & jnp.isnan(square), square, -1.0))
    normal = jnp.where(apart, between * shared(1 / distance), 0.0)
    return overlap.astype(reach.dtype), normal.astype(reach.dtype)


def contact_forces(
    packing: Packing,
    interaction: Interaction,
    walls: Walls,
    position: Vectors,
    velocity: Vectors,
    spin: Vectors,
    edges: Edges,
    history: WallHistory,
    time_step: Scalar,
) -> tuple[Forces, Edges, WallHistory]:
    """Forces of all contacts, and what they remember after them; slip adds up over the time step [s]."""
    bodies = bodies_of(packing, position, velocity, spin)
    load, edges = pair_loads(interaction, bodies, edges, time_step)
    at_walls, on_wall, history = wall_loads(interaction, walls, bodies, history, time_step)
    load = load + at_walls
    return Forces(load[:, :3], load[:, 3:], on_wall), edges, history


def bodies_of(packing: Packing, position: Vectors, velocity: Vectors, spin: Vectors) -> _Body:
    """The spheres as their contacts see them, in a batch."""
    return jax.vmap(_Body)(packing.radius, packing.mass, packing.sides, position, velocity, spin)


def pair_loads(
    interaction: Interaction, bodies: _Body, edges: Edges, time_step: Scalar
) -> tuple[Float[Array, "particles 6"], Edges]:
    """Force and torque of all edges, or any part of them, summed over the particles, and what the edges remember."""
    i, j = (jax.tree.map(lambda x, at=at: x[at], bodies) for at in (edges.i, edges.j))
    between = jax.vmap(_between, (None, 0, 0, 0, 0, 0, None))
    pairs = between(interaction, i, j, edges.active, edges.overlap_max, edges.slip, time_step)
    on_i, on_j = pairs.force, -pairs.force
    if interaction.friction is not None:  # without it there is no torque to add up
        on_i, on_j = _load(on_i, i.radius, pairs.couple), _load(on_j, j.radius, pairs.couple)
    total = jnp.zeros((bodies.radius.shape[0], on_i.shape[1]), bodies.radius.dtype)
    total = total.at[edges.i].add(on_i).at[edges.j].add(on_j)
    total = jnp.pad(total, ((0, 0), (0, 6 - total.shape[1])))
    return total, eqx.tree_at(lambda e: (e.overlap_max, e.slip), edges, (pairs.overlap_max, pairs.slip))


def wall_loads(
    interaction: Interaction, walls: Walls, bodies: _Body, history: WallHistory, time_step: Scalar
) -> tuple[Float[Array, "particles 6"], Float[Array, "walls 3"], WallHistory]:
    """Force and torque of the walls on all particles, or any part of them, forces on the walls, and the memory."""
    load = jnp.zeros((bodies.radius.shape[0], 6), bodies.radius.dtype)
    on_wall, columns = [], []
    for w, wall in enumerate(walls):
        against = jax.vmap(_against, (None, None, 0, 0, 0, None))
        contacts = against(interaction, wall, bodies, history.overlap_max[:, w], history.slip[:, w], time_step)
        load = load + _load(contacts.force, bodies.radius, contacts.couple)
        on_wall.append(-jnp.sum(contacts.force, axis=0))
        columns.append((contacts.overlap_max, contacts.slip))
    if not walls:
        return load, jnp.zeros((0, 3), load.dtype), history
    return load, jnp.stack(on_wall), WallHistory(*(jnp.stack(x, axis=1) for x in zip(*columns, strict=True)))


@jax.vmap
def _load(force: Vector, radius: Scalar, couple: Vector) -> Float[Array, " 6"]:
    return jnp.concatenate([force, radius * couple])


def _between(
    interaction: Interaction, i: _Body, j: _Body, listed: Flag, overlap_max: Scalar, slip: Vector, time_step: Scalar
) -> _Contact:
    overlap, normal = overlap_and_normal(i.position, j.position, i.radius + j.radius, listed)
    relative = j.velocity - i.velocity
    if interaction.friction is not None:
        relative = relative - jnp.cross(i.radius * i.spin + j.radius * j.spin, normal)
    # Without the barriers XLA computes the law again for every use of its force.
    overlap, normal, relative = jax.lax.optimization_barrier((overlap, normal, relative))
    elastic = jax.lax.optimization_barrier(pair_force(i.side, j.side, overlap_max, overlap))
    k = shared(i.side.k1 * j.side.k1 / (i.side.k1 + j.side.k1))
    mass = shared(i.mass * j.mass / (i.mass + j.mass))
    friction = interaction.friction
    return _contact(interaction, friction, elastic, k, mass, normal, relative, overlap_max, overlap, slip, time_step)


def _against(
    interaction: Interaction, wall: Wall, body: _Body, overlap_max: Scalar, slip: Vector, time_step: Scalar
) -> _Contact:
    dtype = body.radius.dtype
    outward = -wall.normal_at(body.position).astype(dtype)
    overlap = (body.radius.astype(body.position.dtype) - wall.distance(body.position)).astype(dtype)
    relative = wall.velocity.astype(dtype) - body.velocity
    if interaction.wall_friction is not None:
        relative = relative - jnp.cross(body.radius * body.spin, outward)
    elastic = jax.lax.optimization_barrier(wall_force(body.side, overlap_max, overlap))
    friction, k, mass = interaction.wall_friction, body.side.k1, body.mass
    return _contact(interaction, friction, elastic, k, mass, outward, relative, overlap_max, overlap, slip, time_step)


def _contact(
    interaction: Interaction,
    friction: Scalar | None,
    elastic: Scalar,
    k: Scalar,
    mass: Scalar,
    normal: Vector,
    relative: Vector,
    overlap_max: Scalar,
    overlap: Scalar,
    slip: Vector,
    time_step: Scalar,
) -> _Contact:
    """Force on the first body; the normal points from it to the second, whose surface moves relative to its own."""
    opening = dot(relative, normal)
    touching = elastic > 0
    damping = 2 * interaction.damping
    push = elastic - damping * shared(jnp.sqrt(mass * k)) * opening
    push = jnp.where(touching & (push > 0), push, jnp.where(jnp.isnan(elastic), elastic, 0.0))
    overlap_max = largest_overlap(overlap_max, overlap)
    if friction is None:
        return _Contact(-push * normal, jnp.zeros_like(normal), overlap_max, slip)

    # The contact plane turned since the last step: keep the slip's length and put it into the new plane.
    sliding = relative - opening * normal
    in_plane = slip - dot(slip, normal) * normal
    sliding, push, in_plane = jax.lax.optimization_barrier((sliding, push, in_plane))
    slip = in_plane * shared(_norm(slip) / (_norm(in_plane) + jnp.finfo(slip.dtype).tiny ** 0.5))
    slip = slip + time_step * sliding
    stiffness = interaction.tangential_ratio * k
    trial = stiffness * slip + damping * shared(jnp.sqrt(mass * stiffness)) * sliding
    slip, trial = jax.lax.optimization_barrier((slip, trial))
    limit = friction * push
    size = _norm(trial)
    slips = size > limit
    tangential = trial * jnp.where(slips, shared(limit / jnp.where(slips, size, 1.0)), 1.0)
    tangential = jax.lax.optimization_barrier(tangential)
    held = jnp.where(slips, tangential * shared(1 / jnp.where(stiffness > 0, stiffness, 1.0)), slip)
    return _Contact(
        tangential - push * normal, jnp.cross(normal, tangential), overlap_max, jnp.where(touching, held, 0.0)
    )


def _norm(vector: Vector) -> Scalar:
    square = dot(vector, vector)
    some = square > 0
    return jnp.where(some, shared(jnp.sqrt(jnp.where(some, square, 1.0))), 0.0)
