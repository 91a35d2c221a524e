"""Equilibrium of a packing whose contacts remember, without friction: energy, force, stiffness, and its minimum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float, Int

from .._numerics import recompute
from .._types import Flag, Scalar
from .neighbours import Edges, pair_geometry
from .pair import HalfContact, largest_overlap, pair_energy, pair_force, sides_of, wall_energy, wall_force
from .state import Packing, Vectors, WallHistory
from .walls import Walls

DENSE = 1200
"""Unknowns up to which stiffness matrices are factorised; above, conjugate gradients."""
SUFFICIENT = 1e-4
"""Share of the decrease the slope promises that a step must bring (Armijo)."""


class Problem(eqx.Module):
    """What stays as it is while the centres find their equilibrium."""

    packing: Packing
    walls: Walls
    edges: Edges  # with the largest overlaps before this load step
    wall_history: WallHistory  # likewise
    previous: Vectors  # the centres then [m]
    proximal: Scalar  # stiffness mu of the springs that tie the centres to them [N/m]


class Stiffness(eqx.Module):
    r"""Minus the derivative of the net force, block by block: :math:`K = \sum_c B_c (e_j - e_i)(e_j - e_i)^T + D`.

    `pairs` are B of the edges, `alone` D of the particles, from walls and the proximal springs [N/m].
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

    def solve(self, load: Vectors, *, definite: bool) -> Vectors:
        """Displacements under a load [N] on every particle; NaN where the matrix cannot be factorised.

        If it is known to be `definite`, the dense factorisation is half the work.
        """
        n = self.alone.shape[0]
        if 3 * n <= DENSE:
            tags = lx.positive_semidefinite_tag if definite else lx.symmetric_tag
            operator = lx.MatrixLinearOperator(self.dense(), tags)
            method = lx.Cholesky() if definite else lx.LU()
            return lx.linear_solve(operator, load.reshape(-1), method, throw=False).value.reshape(n, 3)
        inverse = jnp.linalg.inv(self.alone.at[self.i].add(self.pairs).at[self.j].add(self.pairs))  # of the diagonal
        shape = jax.eval_shape(lambda: load)
        tags = lx.positive_semidefinite_tag
        blocks = lx.FunctionLinearOperator(lambda x: jnp.einsum("nab,nb->na", inverse, x), shape, tags)
        method = lx.CG(rtol=1e-6 if definite else 1e-12, atol=0.0, max_steps=20 * n)
        operator = lx.FunctionLinearOperator(self, shape, tags)
        return lx.linear_solve(operator, load, method, options={"preconditioner": blocks}, throw=False).value


class Balance(eqx.Module):
    """Forces and stiffness at given centres."""

    energy: Scalar  # work done on all contacts and springs [J]; the net force is minus its gradient
    net: Vectors  # force on every particle, proximal spring included [N]
    scale: Scalar  # mean force of the contacts that carry one, 0 if none does [N]
    stiffness: Stiffness  # of the net force
    material: Stiffness  # the same without what the forces do by turning (geometric stiffness)
    on_wall: Float[Array, " walls"]  # force on each wall along its normal [N]


def forces(problem: Problem, position: Vectors) -> tuple[Vectors, Float[Array, " walls"]]:
    r"""Force on every particle [N], :math:`f(x) - \mu (x - x_{prev})`, and on each wall along its normal [N].

    Contacts load where the overlap is above the largest so far and unload below: backward Euler in the history.
    """
    i, j, overlap, normal = _pairs(problem, position)
    inward, wall_overlap = _wall_geometry(problem, position)
    force = jax.lax.optimization_barrier(jax.vmap(pair_force)(i, j, problem.edges.overlap_max, overlap))
    against = _each_wall(wall_force)(problem.packing.sides, problem.wall_history.overlap_max.T, wall_overlap)
    against = jax.lax.optimization_barrier(against)
    return _net(problem, position, force, normal, against, inward), jnp.sum(against, axis=1)


def _net(problem: Problem, position: Vectors, force: Array, normal: Array, against: Array, inward: Array) -> Vectors:
    push = force[:, None] * normal
    total = -problem.proximal * (position - problem.previous) + jnp.sum(against[:, :, None] * inward, axis=0)
    return total.at[problem.edges.j].add(push).at[problem.edges.i].add(-push)


def balance(problem: Problem, position: Vectors) -> Balance:
    """Energy, net force and stiffness; not meant to be differentiated."""
    packing, edges, peak = problem.packing, problem.edges, problem.wall_history.overlap_max.T
    i, j, overlap, normal = _pairs(problem, position)
    force, slope = _with_slope(lambda x: jax.vmap(pair_force)(i, j, edges.overlap_max, x), overlap)
    energy = _work(jax.vmap(pair_energy)(i, j, edges.overlap_max, overlap))
    energy = 0.5 * problem.proximal * jnp.sum((position - problem.previous) ** 2) + energy
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
    return Balance(
        energy,
        _net(problem, position, force, normal, against, inward),
        recompute((jnp.sum(force) + jnp.sum(against)) / jnp.maximum(carrying, 1.0)),
        Stiffness(pairs - geometric, alone - jnp.sum(against[:, :, None, None] * bend, axis=0), edges.i, edges.j),
        Stiffness(soft_pairs, soft_alone, edges.i, edges.j),
        jnp.sum(against, axis=1),
    )


def remembered(problem: Problem, position: Vectors) -> tuple[Edges, WallHistory]:
    """The largest overlaps after a load step that ended at these centres."""
    overlap, _ = pair_geometry(problem.packing.radius, position, problem.edges)
    _, wall_overlap = _wall_geometry(problem, position)
    edges, history = problem.edges, problem.wall_history
    edges = replace(edges, overlap_max=largest_overlap(edges.overlap_max, overlap))
    return edges, replace(history, overlap_max=largest_overlap(history.overlap_max, wall_overlap.T))


def _pairs(problem: Problem, position: Vectors) -> tuple[HalfContact, HalfContact, Array, Array]:
    """Both sides, overlap and normal of every edge."""
    sides = (sides_of(problem.packing.sides, k) for k in (problem.edges.i, problem.edges.j))
    return jax.lax.optimization_barrier((*sides, *pair_geometry(problem.packing.radius, position, problem.edges)))


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


# ---- the minimum -----------------------------------------------------------------------------------------------------


class _Search(NamedTuple):
    """Centres to try next, centres taken last, the balance there, and the step from the one to the other."""

    trial: Vectors
    position: Vectors
    at: Balance
    direction: Vectors
    size: Scalar
    steps: Int[Array, ""]
    converged: Flag
    stuck: Flag


def _minimum(problem: Problem, guess: Vectors, rtol: Scalar | float, max_steps: int) -> _Search:
    """Newton's method on the energy of a packing, with a line search.

    Contacts stiffen thirty times and more where they turn from loading to unloading, so that the net force has kinks.
    It is minus the gradient of an energy, which has none and so judges a step. Where the stiffness is not positive
    definite (forces that turn destabilise) its material part, which always is, gives the direction.
    """
    sides, radius = problem.packing.sides, problem.packing.radius
    atol, reach = 1e-12 * jnp.mean(sides.k1 * radius), 0.3 * jnp.min(radius)  # [N], most a particle moves in a step [m]

    def step(search: _Search) -> _Search:
        """Evaluate the trial; take it and find a new direction, or shorten the step."""
        at = balance(problem, search.trial)
        largest = jnp.max(jnp.abs(at.net))
        slope, slope_there = (-jnp.sum(that.net * search.direction) for that in (search.at, at))
        change = at.energy - search.at.energy
        descends = change <= SUFFICIENT * search.size * slope
        # Close to the minimum the energy has no digits left to judge a step by; its slope has.
        level = jnp.abs(change) <= 1e-12 * jnp.abs(search.at.energy)
        accept = (search.steps == 0) | descends | (level & (jnp.abs(slope_there) <= 0.9 * jnp.abs(slope)))
        converged = accept & (largest <= rtol * at.scale + atol)
        direction = jax.lax.cond(
            accept & ~converged, lambda: _direction(at, reach), lambda: jnp.where(converged, 0.0, search.direction)
        )
        secant = slope / jnp.minimum(slope - slope_there, -jnp.finfo(at.energy.dtype).tiny)
        size = jnp.where(accept, 1.0, search.size * jnp.clip(secant, 0.1, 0.5))
        position = jnp.where(accept, search.trial, search.position)
        stuck = ~accept & (size < 1e-10) | ~jnp.isfinite(largest)
        at = jax.tree.map(lambda now, before: jnp.where(accept, now, before), at, search.at)
        return _Search(position + size * direction, position, at, direction, size, search.steps + 1, converged, stuck)

    def goes_on(search: _Search) -> Flag:
        return ~(search.converged | search.stuck) & (search.steps < max_steps)

    unknown = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(balance, problem, guess))
    one, no = jnp.ones((), guess.dtype), jnp.array(False)
    start = _Search(guess, guess, unknown, jnp.zeros_like(guess), one, jnp.array(0), no, no)
    return jax.lax.while_loop(goes_on, step, start)


def _direction(at: Balance, reach: Scalar) -> Vectors:
    newton = at.stiffness.solve(at.net, definite=True)
    downhill = jnp.all(jnp.isfinite(newton)) & (jnp.sum(newton * at.net) > 0)
    step = jax.lax.cond(downhill, lambda: newton, lambda: at.material.solve(at.net, definite=True))
    return step * jnp.minimum(1.0, reach / jnp.maximum(jnp.max(jnp.abs(step)), jnp.finfo(step.dtype).tiny))


class Equilibrium(NamedTuple):
    """The end of one load step: centres [m], forces there, whether the net force is small enough, and evaluations."""

    position: Vectors
    balance: Balance
    converged: Flag
    steps: Int[Array, ""]


def find_equilibrium(problem: Problem, guess: Vectors, rtol: Scalar | float, max_steps: int) -> Equilibrium:
    r"""Centres at which the net force vanishes, a minimum of the energy of contacts and proximal springs.

    .. math:: f(x; \theta) - \mu (x - x_{prev}) = 0, \qquad K\, dx = \partial_\theta f\, d\theta + \mu\, dx_{prev}

    Differentiable in `problem` in both modes; a load step that did not converge returns where it got to. `rtol` is the
    largest net force over the mean contact force, `max_steps` are evaluations.
    """
    found = _minimum(*jax.lax.stop_gradient((problem, guess)), rtol, max_steps)
    position = _implicit(found.position, found.at.stiffness, forces(problem, found.position)[0])
    return Equilibrium(position, found.at, found.converged, found.steps)


@eqx.filter_custom_jvp
def _implicit(position: Vectors, stiffness: Stiffness, net: Vectors) -> Vectors:
    """The position itself; it moves as the equilibrium does when the net force changes."""
    return position


@_implicit.def_jvp
def _implicit_jvp(primals, tangents):
    position, stiffness, _ = primals
    change = tangents[2]
    return position, jnp.zeros_like(position) if change is None else stiffness.solve(change, definite=False)
