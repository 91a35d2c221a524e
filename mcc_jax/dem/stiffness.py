"""Energy, force and stiffness of a packing whose contacts remember, without friction: what equilibrium is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float, Int

from .._numerics import recompute
from .._types import Scalar
from .edges import Edges
from .forces import overlap_and_normal
from .pair import largest_overlap, pair_energy, pair_force, wall_energy, wall_force
from .side import HalfContact, sides_of
from .state import Packing, Vectors, WallHistory
from .walls import Walls

DENSE = 1200
"""Unknowns up to which stiffness matrices are factorised; above, conjugate gradients."""


class Problem(eqx.Module):
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

    pairs: Float[Array, "edges 3 3"]
    alone: Float[Array, "particles 3 3"]
    i: Int[Array, " edges"]
    j: Int[Array, " edges"]

    def __call__(self, change: Vectors) -> Vectors:
        """K times a displacement."""
        pull = jnp.einsum("eab,eb->ea", self.pairs, change[self.j] - change[self.i])
        own = jnp.einsum("nab,nb->na", self.alone, change)
        return own.at[self.j].add(pull).at[self.i].add(-pull)

    def dense(self) -> Float[Array, "unknowns unknowns"]:
        """The whole matrix."""
        n, i, j = self.alone.shape[0], self.i, self.j
        each = jnp.arange(n)
        blocks = jnp.zeros((n, n, 3, 3), self.alone.dtype).at[each, each].add(self.alone)
        for a, b, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            blocks = blocks.at[a, b].add(sign * self.pairs)
        return blocks.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)

    def diagonal(self) -> Float[Array, "particles 3 3"]:
        """Its 3 x 3 blocks on the diagonal."""
        return self.alone.at[self.i].add(self.pairs).at[self.j].add(self.pairs)

    def solve(self, load: Vectors, *, definite: bool) -> Vectors:
        """Displacements under a load [N] on every particle; NaN where the matrix cannot be factorised.

        `definite`: whether to take the matrix for positive definite, for the dense factorisation: half the work.
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
        material: the same without what the forces do by turning (geometric stiffness); never has a negative eigenvalue.
        on_wall: force on each wall along its normal [N].
    """

    energy: Scalar
    net: Vectors
    scale: Scalar
    stiffness: Stiffness
    material: Stiffness
    on_wall: Float[Array, " walls"]


def net_force(problem: Problem, position: Vectors) -> Vectors:
    r"""Force on every particle [N], :math:`f(x) - \mu (x - x_{prev})`.

    Contacts load where the overlap is above the largest so far and unload below: backward Euler in the history.
    Differentiable in everything.
    """
    edges = problem.edges
    i, j, overlap, normal = _pairs(problem, position)
    force = jax.lax.optimization_barrier(jax.vmap(pair_force)(i, j, edges.overlap_max, overlap))
    push = force[:, None] * normal
    against, inward = _on_walls(problem, position)
    total = -problem.proximal * (position - problem.previous) + jnp.sum(against[:, :, None] * inward, axis=0)
    return total.at[edges.j].add(push).at[edges.i].add(-push)


def balance(problem: Problem, position: Vectors) -> Balance:
    """Energy, net force and stiffness; not meant to be differentiated."""
    packing, edges, peak = problem.packing, problem.edges, problem.wall_history.overlap_max.T
    i, j, overlap, normal = _pairs(problem, position)
    force, slope = _with_slope(lambda x: jax.vmap(pair_force)(i, j, edges.overlap_max, x), overlap)
    moved = position - problem.previous
    energy = 0.5 * problem.proximal * jnp.sum(moved**2) + _work(jax.vmap(pair_energy)(i, j, edges.overlap_max, overlap))
    push = force[:, None] * normal
    distance = packing.radius[edges.i] + packing.radius[edges.j] - overlap
    along = normal[:, :, None] * normal[:, None, :]

    inward, wall_overlap = _wall_geometry(problem, position)
    against, steepness = _with_slope(lambda x: _each_wall(wall_force)(packing.sides, peak, x), wall_overlap)
    energy = energy + _work(_each_wall(wall_energy)(packing.sides, peak, wall_overlap))
    bend = jnp.stack([jax.vmap(jax.hessian(wall.distance))(position) for wall in problem.walls])
    facing = inward[:, :, :, None] * inward[:, :, None, :]
    identity = jnp.eye(3, dtype=position.dtype)[None]
    springs = problem.proximal * identity
    geometric = recompute(force / distance)[:, None, None] * (identity - along)

    def material(slope: Array, steepness: Array) -> tuple[Array, Array]:
        return slope[:, None, None] * along, springs + jnp.sum(steepness[:, :, None, None] * facing, axis=0)

    carrying = (jnp.sum(force > 0) + jnp.sum(against > 0)).astype(force.dtype)
    pairs, alone = material(slope, steepness)
    soft_pairs, soft_alone = material(jnp.maximum(slope, 0.0), jnp.maximum(steepness, 0.0))
    net = -problem.proximal * moved + jnp.sum(against[:, :, None] * inward, axis=0)
    return Balance(
        energy,
        net.at[edges.j].add(push).at[edges.i].add(-push),
        recompute((jnp.sum(force) + jnp.sum(against)) / jnp.maximum(carrying, 1.0)),
        Stiffness(pairs - geometric, alone - jnp.sum(against[:, :, None, None] * bend, axis=0), edges.i, edges.j),
        Stiffness(soft_pairs, soft_alone, edges.i, edges.j),
        jnp.sum(against, axis=1),
    )


def remembered(problem: Problem, position: Vectors) -> tuple[Edges, WallHistory]:
    """The largest overlaps after a load step that ended at these centres."""
    overlap, _ = pair_geometry(problem.packing.radius, position, problem.edges)
    _, wall_overlap = _wall_geometry(problem, position)
    edges = eqx.tree_at(
        lambda e: e.overlap_max, problem.edges, jax.vmap(largest_overlap)(problem.edges.overlap_max, overlap)
    )
    peak = jax.vmap(jax.vmap(largest_overlap))(problem.wall_history.overlap_max, wall_overlap.T)
    return edges, eqx.tree_at(lambda h: h.overlap_max, problem.wall_history, peak)


def pair_geometry(radius: Float[Array, " particles"], position: Vectors, edges: Edges) -> tuple[Array, Array]:
    """Overlap [m] and unit normal from i to j of every edge."""
    i, j = edges.i, edges.j
    return jax.vmap(overlap_and_normal)(position[i], position[j], radius[i] + radius[j], edges.active)


def force_on_walls(problem: Problem, position: Vectors) -> Float[Array, " walls"]:
    """Force on each wall along its normal [N], all particles added up; differentiable."""
    return jnp.sum(_on_walls(problem, position)[0], axis=1)


def _pairs(problem: Problem, position: Vectors) -> tuple[HalfContact, HalfContact, Array, Array]:
    """Both sides, overlap and normal of every edge."""
    sides = (sides_of(problem.packing.sides, k) for k in (problem.edges.i, problem.edges.j))
    return jax.lax.optimization_barrier((*sides, *pair_geometry(problem.packing.radius, position, problem.edges)))


def _on_walls(
    problem: Problem, position: Vectors
) -> tuple[Float[Array, "walls particles"], Float[Array, "walls particles 3"]]:
    inward, overlap = _wall_geometry(problem, position)
    force = _each_wall(wall_force)(problem.packing.sides, problem.wall_history.overlap_max.T, overlap)
    return jax.lax.optimization_barrier(force), inward


def _wall_geometry(problem: Problem, position: Vectors) -> tuple[Array, Array]:
    """Inward normals (walls, particles, 3) and overlaps (walls, particles)."""
    found = [jax.vmap(jax.value_and_grad(wall.distance))(position) for wall in problem.walls]
    distance, inward = (jnp.stack(x) for x in zip(*found, strict=True))
    return jax.lax.optimization_barrier((inward, problem.packing.radius[None] - distance))


def _each_wall(function: Callable[..., Any]) -> Callable[..., Any]:
    return jax.vmap(jax.vmap(function), (None, 0, 0))


def _with_slope(force, overlap: Array) -> tuple[Array, Array]:
    return jax.lax.optimization_barrier(jax.jvp(force, (overlap,), (jnp.ones_like(overlap),)))


def _work(stored) -> Scalar:
    stored = jax.lax.optimization_barrier(stored)
    return jnp.sum(stored.recoverable) + jnp.sum(stored.dissipated)
