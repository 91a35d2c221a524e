"""Energy, force and stiffness of a packing whose contacts remember, without friction: what equilibrium is made of."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float, Int

from .._numerics import shared
from .._types import Scalar
from ._edges import Edges
from ._forces import Packing, Vectors, WallHistory, pair_geometry
from ._pair import largest_overlap, pair_energy, pair_force, wall_energy, wall_force
from ._side import sides_of
from ._walls import Wall, Walls

DENSE = 1200
"""Unknowns up to which stiffness matrices are factorised; above, conjugate gradients."""

Blocks = Float[Array, "some 3 3"]


class Held(eqx.Module):
    """What stays as it is while the centres find their equilibrium.

    Attributes:
        packing: the spheres.
        walls: the walls, where they are in this load step.
        edges: the pairs, and their largest overlaps before this load step.
        wall_history: the same of the walls.
        previous: centres after the load step before [m].
        proximal: stiffness mu of the springs that tie the centres to where they were [N/m].
    """

    packing: Packing
    walls: Walls
    edges: Edges
    wall_history: WallHistory
    previous: Vectors
    proximal: Scalar


class Stiffness(eqx.Module):
    r"""Minus the derivative of the net force, block by block: :math:`K = \sum_c B_c (e_j - e_i)(e_j - e_i)^T + D`.

    Attributes:
        pairs: B of every edge [N/m].
        alone: D of every particle, from walls and the proximal springs [N/m].
        i, j: particles of the edges.
    """

    pairs: Blocks
    alone: Blocks
    i: Int[Array, " edges"]
    j: Int[Array, " edges"]

    def __call__(self, change: Vectors) -> Vectors:
        """K times a displacement."""
        pull = jnp.einsum("eab,eb->ea", self.pairs, change[self.j] - change[self.i])
        own = jnp.einsum("nab,nb->na", self.alone, change)
        return own.at[self.j].add(pull).at[self.i].add(-pull)

    def dense(self) -> Float[Array, "unknowns unknowns"]:
        """The whole matrix."""
        n = self.alone.shape[0]
        each = jnp.arange(n)
        blocks = jnp.zeros((n, n, 3, 3), self.alone.dtype).at[each, each].add(self.alone)
        for a, b, sign in ((self.i, self.i, 1.0), (self.j, self.j, 1.0), (self.i, self.j, -1.0), (self.j, self.i, -1.0)):
            blocks = blocks.at[a, b].add(sign * self.pairs)
        return blocks.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)

    def diagonal(self) -> Blocks:
        """Its 3 x 3 blocks on the diagonal."""
        return self.alone.at[self.i].add(self.pairs).at[self.j].add(self.pairs)

    def solve(self, load: Vectors, *, definite: bool) -> Vectors:
        """Displacements under a load on every particle; NaN where the matrix cannot be factorised.

        Args:
            load: [N].
            definite: whether to take it for positive definite, for the dense factorisation: half the work.
        """
        n = self.alone.shape[0]
        if 3 * n <= DENSE:
            tags = lx.positive_semidefinite_tag if definite else lx.symmetric_tag
            operator = lx.MatrixLinearOperator(self.dense(), tags)
            method = lx.Cholesky() if definite else lx.LU()
            return lx.linear_solve(operator, load.reshape(-1), method, throw=False).value.reshape(n, 3)
        inverse = jnp.linalg.inv(self.diagonal())
        shape = jax.eval_shape(lambda: load)
        tags = lx.positive_semidefinite_tag
        blocks = lx.FunctionLinearOperator(lambda x: jnp.einsum("nab,nb->na", inverse, x), shape, tags)
        method = lx.CG(rtol=1e-6 if definite else 1e-12, atol=0.0, max_steps=20 * n)
        operator = lx.FunctionLinearOperator(self, shape, tags)
        return lx.linear_solve(operator, load, method, options={"preconditioner": blocks}, throw=False).value


class Balance(eqx.Module):
    """Where the packing stands at given centres.

    Attributes:
        energy: work done on all contacts and springs [J]; the net force is minus its gradient.
        net: force on every particle, proximal spring included [N].
        scale: mean force of the contacts that carry one, 0 if none does [N].
        stiffness: of the net force.
        material: the same without what the forces do by turning; never has a negative eigenvalue.
        on_wall: force on each wall along its normal [N].
    """

    energy: Scalar
    net: Vectors
    scale: Scalar
    stiffness: Stiffness
    material: Stiffness
    on_wall: Float[Array, " walls"]


def net_force(held: Held, position: Vectors) -> Vectors:
    r"""Force on every particle [N], :math:`f(x) - \mu (x - x_{prev})`.

    Contacts load where the overlap is above the largest so far and unload below: backward Euler in the history.
    Differentiable in everything.
    """
    edges, packing = held.edges, held.packing
    overlap, normal = pair_geometry(packing.radius, position, edges)
    overlap, normal = jax.lax.optimization_barrier((overlap, normal))
    i, j = sides_of(packing.sides, edges.i), sides_of(packing.sides, edges.j)
    push = jax.vmap(pair_force)(i, j, edges.overlap_max, overlap)[:, None] * normal
    total = -held.proximal * (position - held.previous)
    total = total.at[edges.j].add(push).at[edges.i].add(-push)
    for w, wall in enumerate(held.walls):
        inward, overlap = _wall_geometry(wall, packing.radius, position)
        total = total + jax.vmap(wall_force)(packing.sides, held.wall_history.overlap_max[:, w], overlap)[:, None] * inward
    return total


def balance(held: Held, position: Vectors) -> Balance:
    """Energy, net force and stiffness; not meant to be differentiated."""
    packing, edges = held.packing, held.edges
    i, j = sides_of(packing.sides, edges.i), sides_of(packing.sides, edges.j)
    overlap, normal = jax.lax.optimization_barrier(pair_geometry(packing.radius, position, edges))
    force, slope = jax.lax.optimization_barrier(
        _with_slope(lambda x: jax.vmap(pair_force)(i, j, edges.overlap_max, x), overlap)
    )
    stored = jax.vmap(pair_energy)(i, j, edges.overlap_max, overlap)
    moved = position - held.previous
    energy = 0.5 * held.proximal * jnp.sum(moved**2) + _work(stored)
    push = force[:, None] * normal
    net = (-held.proximal * moved).at[edges.j].add(push).at[edges.i].add(-push)
    distance = packing.radius[edges.i] + packing.radius[edges.j] - overlap
    along = normal[:, :, None] * normal[:, None, :]
    turning = shared(force / distance)[:, None, None] * (jnp.eye(3) - along)
    pairs, soft_pairs = slope[:, None, None] * along - turning, jnp.maximum(slope, 0.0)[:, None, None] * along
    alone = held.proximal * jnp.broadcast_to(jnp.eye(3), (len(position), 3, 3))
    soft = alone
    count, total, on_wall = jnp.sum(force > 0), jnp.sum(force), []
    for w, wall in enumerate(held.walls):
        peak = held.wall_history.overlap_max[:, w]
        inward, overlap = _wall_geometry(wall, packing.radius, position)
        force, slope = _with_slope(lambda x, p=peak: jax.vmap(wall_force)(packing.sides, p, x), overlap)
        energy = energy + _work(jax.vmap(wall_energy)(packing.sides, peak, overlap))
        net = net + force[:, None] * inward
        along = inward[:, :, None] * inward[:, None, :]
        bend = jax.vmap(jax.hessian(wall.distance))(position)
        alone = alone + slope[:, None, None] * along - force[:, None, None] * bend
        soft = soft + jnp.maximum(slope, 0.0)[:, None, None] * along
        count, total = count + jnp.sum(force > 0), total + jnp.sum(force)
        on_wall.append(jnp.sum(force))
    scale = shared(total / jnp.maximum(count, 1))
    return Balance(
        energy,
        net,
        scale,
        Stiffness(pairs, alone, edges.i, edges.j),
        Stiffness(soft_pairs, soft, edges.i, edges.j),
        jnp.stack(on_wall) if on_wall else jnp.zeros(0, position.dtype),
    )


def remembered(held: Held, position: Vectors) -> tuple[Edges, WallHistory]:
    """The largest overlaps after a load step that ended at these centres."""
    overlap, _ = pair_geometry(held.packing.radius, position, held.edges)
    edges = eqx.tree_at(lambda e: e.overlap_max, held.edges, largest_overlap(held.edges.overlap_max, overlap))
    walls = [held.packing.radius - jax.vmap(wall.distance)(position) for wall in held.walls]
    if not walls:
        return edges, held.wall_history
    peak = largest_overlap(held.wall_history.overlap_max, jnp.stack(walls, axis=1))
    return edges, eqx.tree_at(lambda h: h.overlap_max, held.wall_history, peak)


def force_on_walls(held: Held, position: Vectors) -> Float[Array, " walls"]:
    """Force on each wall along its normal [N], all particles added up; differentiable."""
    forces = []
    for w, wall in enumerate(held.walls):
        _, overlap = _wall_geometry(wall, held.packing.radius, position)
        forces.append(jnp.sum(jax.vmap(wall_force)(held.packing.sides, held.wall_history.overlap_max[:, w], overlap)))
    return jnp.stack(forces)


def _wall_geometry(wall: Wall, radius: Array, position: Vectors) -> tuple[Vectors, Array]:
    distance, inward = jax.vmap(jax.value_and_grad(wall.distance))(position)
    return jax.lax.optimization_barrier((inward, radius - distance))


def _with_slope(force, overlap: Array) -> tuple[Array, Array]:
    return jax.jvp(force, (overlap,), (jnp.ones_like(overlap),))


def _work(stored) -> Scalar:
    return jnp.sum(stored.recoverable) + jnp.sum(stored.dissipated)
