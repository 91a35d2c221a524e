"""One load step of a quasi-static compaction, and all of them again, differentiable."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .. import arguments
from .._errors import InputError
from .._format import described
from .._types import Scalar
from .edges import Edges, relisted, stacked_lists
from .equilibrium import settle
from .forces import Packing, Vectors, WallHistory
from .state import State
from .stiffness import Held, force_on_walls, net_force, remembered
from .walls import Cylinder, Plane, Walls

BOTTOM, TOP = 0, 1


class Solver(eqx.Module):
    """How a load step is solved. The defaults suit from ten to a few thousand spheres.

    Attributes:
        springs: stiffnesses of the proximal springs, in turn, as shares of the mean initial stiffness; each
            equilibrium is where the search for the next begins. Without the last, small one, particles that touch
            nothing would have no place.
        rtol: largest net force over the mean contact force.
        max_steps: evaluations before an equilibrium is given up.
        halvings: how often a load step that did not converge is halved.
        skin: extra distance up to which pairs are listed, as a share of the mean radius. Ample: a load step that ends
            with unlisted particles touching is solved again from there, and may so end elsewhere.
    """

    springs: tuple[float, ...] = eqx.field(static=True, default=(1e-1, 1e-2, 1e-3, 1e-4))
    rtol: float = eqx.field(static=True, default=1e-10)
    max_steps: int = eqx.field(static=True, default=150)
    halvings: int = eqx.field(static=True, default=4)
    skin: float = eqx.field(static=True, default=0.5)

    __repr__ = described()

    def __check_init__(self) -> None:
        for spring in self.springs:
            arguments.number(spring, "every one of springs", above=0)
        arguments.number(self.rtol, "rtol", above=0)
        arguments.whole(self.max_steps, "max_steps", least=1)
        arguments.whole(self.halvings, "halvings")
        arguments.number(self.skin, "skin", above=0)
        if not self.springs:
            raise InputError("a solver without springs", remedy="Give at least one.")


class LoadStep(NamedTuple):
    """What `replay_compaction` needs of a load step.

    Attributes:
        key, i, j: the list of edges.
        height: of the top punch [m].
        spring: stiffness of the proximal springs [N/m].
        position: centres at its end [m].
        last: whether a row of the table ends with it.
    """

    key: Int[Array, " edges"]
    i: Int[Array, " edges"]
    j: Int[Array, " edges"]
    height: Scalar
    spring: Scalar
    position: Vectors
    last: bool | Bool[Array, " steps"]

    __repr__ = described()


class Replayed(NamedTuple):
    """The load steps again, all of it differentiable but `converged`.

    Attributes:
        on_wall: force on bottom, top and barrel along their normals, summed over particles [N].
        position: centres at the end of every load step [m].
        edges: the pairs at the very end, with their largest overlaps.
        wall_history: the same of the walls.
        residual: largest net force over the mean contact force [-].
        proximal: sum of the proximal springs' axial forces, without sign [N].
        converged: whether the step ended in equilibrium.
    """

    on_wall: Float[Array, "steps walls"]
    position: Float[Array, "steps particles 3"]
    edges: Edges
    wall_history: WallHistory
    residual: Float[Array, " steps"]
    proximal: Float[Array, " steps"]
    converged: Bool[Array, " steps"]

    __repr__ = described()


def replay_compaction(
    packing: Packing, state: State, tape: Sequence[LoadStep], solver: Solver | None = None
) -> Replayed:
    """The load steps that `compact` recorded, for this packing or one like it, differentiable in both modes.

    Lists of edges, heights and springs are those of the tape; the equilibria are found anew, each from where the tape
    has it, and differentiated by the implicit function theorem, history included: the derivatives of positions, largest
    overlaps and forces go on from load step to load step. With the packing of the tape this is the same compaction.
    With one so different that particles meet that the tape does not list, contacts are missing: compact anew.

    Args:
        packing: the spheres, for example as a function of the law's parameters under `jax.jvp`.
        state: where `compact` started.
        tape: its load steps.
        solver: as given to `compact`.

    Raises:
        InputError: if the tape is empty.
    """
    return eqx.filter_jit(replay_stacked)(packing, state, stacked(tape), solver or Solver())


def stacked(tape: Sequence[LoadStep]) -> LoadStep:
    """All load steps as one, every field with a leading axis.

    Raises:
        InputError: if there are none.
    """
    if not tape:
        raise InputError("a compaction without load steps", remedy="Give `compact` a list as its `tape`.")
    return stacked_lists(tape)


def replay_stacked(packing: Packing, state: State, steps: LoadStep, solver: Solver) -> Replayed:
    """`replay_compaction` of load steps that are `stacked`, to be traced."""

    def one(carry, step):
        previous, recorded, edges, wall_history = carry
        edges = relisted(edges, step.key, step.i, step.j)
        held = Held(packing, lowered(state.walls, step.height), edges, wall_history, previous, step.spring)
        settled = settle(held, previous + (step.position - recorded), solver.rtol, solver.max_steps)
        edges, wall_history = remembered(held, settled.position)
        springs = step.spring * jnp.sum(jnp.abs(settled.position[:, 2] - previous[:, 2]))
        net = jnp.max(jnp.abs(net_force(held, settled.position)))
        row = (force_on_walls(held, settled.position), settled.position, net / settled.balance.scale, springs)
        return (settled.position, step.position, edges, wall_history), (*row, settled.converged)

    before = relisted(state.edges, steps.key[0], steps.i[0], steps.j[0])
    carry = (state.position, state.position, before, state.wall_history)
    (_, _, edges, wall_history), (on_wall, position, residual, proximal, converged) = jax.lax.scan(one, carry, steps)
    return Replayed(on_wall, position, edges, wall_history, residual, proximal, converged)


def lowered(walls: Walls, height: Scalar) -> Walls:
    """The walls with the top punch at a height over the bottom one."""
    bottom, top, barrel = cast(tuple[Plane, Plane, Cylinder], walls)
    return bottom, eqx.tree_at(lambda w: w.point, top, bottom.point + height * bottom.normal), barrel


def die_walls(walls: Walls) -> tuple[Plane, Plane, Cylinder]:
    """Bottom punch, top punch and barrel.

    Raises:
        InputError: if that is not what the walls are.
    """
    kinds = tuple(type(wall) for wall in walls)
    if kinds == (Plane, Plane, Cylinder):
        bottom, top, barrel = cast(tuple[Plane, Plane, Cylinder], walls)
        up = jnp.asarray([0.0, 0.0, 1.0], bottom.normal.dtype)
        if bool(jnp.all((bottom.normal == up) & (top.normal == -up))):
            return bottom, top, barrel
    raise InputError("walls that are not bottom punch, top punch and barrel", remedy="Make them with `die`.")
