"""All contact forces of a packing at once: pairs over the edges, walls densely, one sum over the particles."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics import shared
from .._types import Scalar, scalar
from ._edges import Edges
from ._pair import largest_overlap, pair_force, wall_force
from ._side import HalfContact, sides_of
from ._walls import Walls

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

    @property
    def volume(self) -> Scalar:
        """Volume of all spheres [m^3], overlaps not taken off."""
        return 4 / 3 * jnp.pi * jnp.sum(self.radius**3)


class Interaction(eqx.Module):
    r"""What a contact does besides the law, all of it off by default.

    .. math::
        F_n = \max(F + 2 \beta \sqrt{m_{ij} k}\, \dot\delta, 0), \qquad
        F_t = k_t \xi + 2 \beta \sqrt{m_{ij} k_t}\, \dot\xi, \quad |F_t| \le \mu F_n, \quad k_t = r_t k

    with k the initial stiffness of the contact, m_ij the reduced mass and xi the slip that the contact remembers. Where
    Coulomb's limit is met, the slip is set back to what the limit can hold (Cundall and Strack, 1979).

    Attributes:
        damping: beta, share of critical damping [-].
        friction: mu between particles [-].
        wall_friction: mu against walls [-].
        tangential_ratio: r_t, tangential over initial normal stiffness [-].
    """

    damping: Scalar = eqx.field(converter=scalar, default=0.0)
    friction: Scalar = eqx.field(converter=scalar, default=0.0)
    wall_friction: Scalar = eqx.field(converter=scalar, default=0.0)
    tangential_ratio: Scalar = eqx.field(converter=scalar, default=0.8)


class WallHistory(eqx.Module):
    """What the contacts with walls remember: dense, one place for each particle and wall.

    Attributes:
        overlap_max: largest overlap so far [m].
        slip: elastic tangential displacement of the wall against the particle's surface [m].
    """

    overlap_max: Float[Array, "particles walls"]
    slip: Float[Array, "particles walls 3"]

    @classmethod
    def virgin(cls, particles: int, walls: int, dtype: jnp.dtype | type = jnp.float64) -> WallHistory:
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


class _Contact(eqx.Module):
    """One contact: what acts on the first body, and what the contact remembers."""

    force: Vector
    tangential: Vector
    overlap_max: Scalar
    slip: Vector


def pair_geometry(radius: Float[Array, " particles"], position: Vectors, edges: Edges) -> tuple[Array, Array]:
    """Overlap [m] and unit normal from i to j of every edge; the overlap is -1 m where the list is padded.

    Two centres in one place have no normal: they get none, and so no force.
    """
    between = position[edges.j] - position[edges.i]
    square = jnp.sum(between * between, axis=1)
    apart = edges.active & (square > 0)
    distance = shared(jnp.sqrt(jnp.where(apart, square, 1.0)))
    overlap = jnp.where(apart, radius[edges.i] + radius[edges.j] - distance, -1.0)
    overlap = jnp.where(edges.active & jnp.isnan(square), square, overlap)
    return overlap, jnp.where(apart[:, None], between * shared(1 / distance)[:, None], 0.0)


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
    """Forces of all contacts, and what the contacts remember after them.

    Args:
        packing: the spheres.
        interaction: damping and friction.
        walls: the walls.
        position: centres [m].
        velocity: of the centres [m/s].
        spin: angular velocities [rad/s].
        edges: the pairs.
        history: of the contacts with walls.
        time_step: over which slip adds up [s].
    """
    i, j = edges.i, edges.j
    side_i, side_j = sides_of(packing.sides, i), sides_of(packing.sides, j)
    overlap, normal = pair_geometry(packing.radius, position, edges)
    k = shared(side_i.k1 * side_j.k1 / (side_i.k1 + side_j.k1))
    mass = shared(packing.mass[i] * packing.mass[j] / (packing.mass[i] + packing.mass[j]))
    arm = packing.radius[i][:, None] * spin[i] + packing.radius[j][:, None] * spin[j]
    relative = velocity[j] - velocity[i] - jnp.cross(arm, normal)
    # Without the barriers XLA computes the law again for every use of its force.
    overlap, normal, relative = jax.lax.optimization_barrier((overlap, normal, relative))
    elastic = jax.lax.optimization_barrier(jax.vmap(pair_force)(side_i, side_j, edges.overlap_max, overlap))
    pairs = jax.vmap(_contact, (None, None, 0, 0, 0, 0, 0, 0, 0, 0, None))(
        interaction,
        interaction.friction,
        elastic,
        k,
        mass,
        normal,
        relative,
        edges.overlap_max,
        overlap,
        edges.slip,
        time_step,
    )
    couple = jnp.cross(normal, pairs.tangential)
    load = jnp.concatenate([pairs.force, packing.radius[i][:, None] * couple], axis=1)
    load_j = jnp.concatenate([-pairs.force, packing.radius[j][:, None] * couple], axis=1)
    total = jnp.zeros((position.shape[0], 6), position.dtype).at[i].add(load).at[j].add(load_j)
    edges = eqx.tree_at(lambda e: (e.overlap_max, e.slip), edges, (pairs.overlap_max, pairs.slip))

    on_wall, columns = [], []
    for w, wall in enumerate(walls):
        inward = jax.vmap(wall.normal_at)(position)
        overlap = packing.radius - jax.vmap(wall.distance)(position)
        relative = wall.velocity - velocity + jnp.cross(packing.radius[:, None] * spin, inward)
        contacts = jax.vmap(_contact, (None, None, 0, 0, 0, 0, 0, 0, 0, 0, None))(
            interaction,
            interaction.wall_friction,
            jax.lax.optimization_barrier(jax.vmap(wall_force)(packing.sides, history.overlap_max[:, w], overlap)),
            packing.sides.k1,
            packing.mass,
            -inward,
            relative,
            history.overlap_max[:, w],
            overlap,
            history.slip[:, w],
            time_step,
        )
        torque = packing.radius[:, None] * jnp.cross(-inward, contacts.tangential)
        total = total + jnp.concatenate([contacts.force, torque], axis=1)
        on_wall.append(-jnp.sum(contacts.force, axis=0))
        columns.append((contacts.overlap_max, contacts.slip))
    if walls:
        history = WallHistory(*(jnp.stack(x, axis=1) for x in zip(*columns, strict=True)))
    forces = Forces(total[:, :3], total[:, 3:], jnp.stack(on_wall) if walls else jnp.zeros((0, 3), position.dtype))
    return forces, edges, history


def _contact(
    interaction: Interaction,
    friction: Scalar,
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
    opening = jnp.sum(relative * normal)
    touching = elastic > 0
    damping = 2 * interaction.damping
    push = elastic - damping * shared(jnp.sqrt(mass * k)) * opening
    push = jnp.where(touching & (push > 0), push, jnp.where(jnp.isnan(elastic), elastic, 0.0))

    # The contact plane turned since the last step: keep the slip's length and put it into the new plane.
    sliding = relative - opening * normal
    in_plane = slip - jnp.sum(slip * normal) * normal
    sliding, push, in_plane = jax.lax.optimization_barrier((sliding, push, in_plane))
    slip = in_plane * shared(_norm(slip) / (_norm(in_plane) + jnp.finfo(slip.dtype).tiny ** 0.5))
    slip = slip + time_step * sliding
    stiffness = interaction.tangential_ratio * k
    trial = stiffness * slip + damping * shared(jnp.sqrt(mass * stiffness)) * sliding
    slip, trial = jax.lax.optimization_barrier((slip, trial))
    limit = friction * push
    size = _norm(trial)
    slips = size > limit
    tangential = trial * jnp.where(slips, shared(limit / jnp.where(slips, size, 1.0)), 1.0)[None]
    tangential = jax.lax.optimization_barrier(tangential)
    held = jnp.where(slips, tangential * shared(1 / jnp.where(stiffness > 0, stiffness, 1.0)), slip)
    return _Contact(
        tangential - push * normal,
        tangential,
        largest_overlap(overlap_max, overlap),
        jnp.where(touching, held, 0.0),
    )


def _norm(vector: Vector) -> Scalar:
    square = jnp.sum(vector * vector)
    some = square > 0
    return jnp.where(some, shared(jnp.sqrt(jnp.where(some, square, 1.0))), 0.0)
