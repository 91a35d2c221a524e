"""Quasi-static compaction in a die: as many load steps as it takes, each in equilibrium; and again, differentiable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import arguments
from .._errors import InputError
from .._format import described
from .._types import Scalar
from .equilibrium import Equilibrium, Problem, find_equilibrium, forces, remembered
from .neighbours import Edges, pair_geometry, stacked_lists, with_list
from .state import Packing, State, Vectors, WallHistory, check_packing, check_state, measured, rebuild_list, start
from .walls import Cylinder, Plane, Walls

BOTTOM, TOP = 0, 1


class Solver(eqx.Module):
    """How a load step is solved. The defaults suit from ten to a few thousand spheres.

    Attributes:
        springs: stiffnesses of the proximal springs, in turn, as shares of the mean initial stiffness; each equilibrium
            is where the search for the next begins. The last, small one gives particles that touch nothing a place.
        rtol: largest net force over the mean contact force.
        max_steps: evaluations before an equilibrium is given up.
        halvings: how often a load step that did not converge is halved.
        skin: extra distance up to which pairs are listed, as a share of the mean radius. Load steps that end with
            unlisted particles touching are solved again from there, and may end elsewhere.
    """

    springs: tuple[float, ...] = eqx.field(static=True, default=(1e-1, 1e-2, 1e-3, 1e-4))
    rtol: float = eqx.field(static=True, default=1e-10)
    max_steps: int = eqx.field(static=True, default=150)
    halvings: int = eqx.field(static=True, default=4)
    skin: float = eqx.field(static=True, default=0.5)

    __repr__ = described()

    def __check_init__(self) -> None:
        for value in (*self.springs, self.rtol, self.skin):
            arguments.number(value, "springs, rtol and skin", above=0)
        arguments.whole(self.max_steps, "max_steps", least=1)
        arguments.whole(self.halvings, "halvings")
        if not self.springs:
            raise InputError("a solver without springs", remedy="Give at least one.")


class LoadStep(NamedTuple):
    """A load step for `replay_compaction`: its list of edges, the height of the top punch [m], the stiffness of the
    proximal springs [N/m], centres at its end [m], and whether a row of the table ends with it.
    """

    key: Int[Array, " edges"]
    i: Int[Array, " edges"]
    j: Int[Array, " edges"]
    height: Scalar
    spring: Scalar
    position: Vectors
    last: bool | Bool[Array, " steps"]

    __repr__ = described()


class Compaction(NamedTuple):
    """Rows of a compaction, one for each height of the top punch over the bottom one [m].

    Attributes:
        density: volume of the spheres over that of the die [-].
        top, bottom: force on the punches [N].
        converged: whether every load step of the row ended in equilibrium. Do not use a row that did not.
        residual: largest net force on a particle over the mean contact force [-].
        proximal_share: sum of the proximal springs' axial forces, without sign, over the force on the top punch [-].
        spring: the proximal springs' stiffness over the mean initial stiffness [-].
        load_steps, evaluations: steps of the row; evaluations of forces and stiffness.
        largest_move: of a particle, over the punch's [-]; far above one where contacts snapped.
        contacts: pairs and walls that touch.
        beyond_tested: contacts compressed further than the paper's tests (eta_p eps > 0.67), on either side.
    """

    height: np.ndarray
    density: np.ndarray
    top: np.ndarray
    bottom: np.ndarray
    converged: np.ndarray
    residual: np.ndarray
    proximal_share: np.ndarray
    spring: np.ndarray
    load_steps: np.ndarray
    evaluations: np.ndarray
    largest_move: np.ndarray
    contacts: np.ndarray
    beyond_tested: np.ndarray

    __repr__ = described()


class _Attempt(NamedTuple):
    """A load step; complete if it converged with the weakest springs."""

    state: State
    equilibrium: Equilibrium
    stiffness: Scalar
    complete: bool
    evaluations: int
    share: float
    move: float


def relaxed(packing: Packing, walls: Walls, position: Any, solver: Solver | None = None, passes: int = 40) -> State:
    """A state to start a compaction from: overlaps pushed apart, all contacts virgin.

    The centres [m], scattered (`scattered`) and lowered into the die, may overlap. At most so many `passes`, implicit
    steps of steepest descent on the contacts' energy, until the contacts carry next to nothing. Above random close
    packing the compaction begins with what overlap is left.
    """
    solver = solver or Solver()
    passes = arguments.whole(passes, "passes")
    check_packing(packing)
    skin = solver.skin * float(jnp.mean(packing.radius))
    k = float(jnp.mean(packing.sides.k1))
    state = start(packing, walls, position, skin)
    for _ in range(passes):
        problem = Problem(packing, walls, state.edges, state.wall_history, state.position, jnp.asarray(0.3 * k))
        found = _find_equilibrium(problem, state.position, jnp.asarray(1e-3), solver.max_steps)
        state = replace(state, position=found.position)
        if _moved(state) > skin / 2:
            state = rebuild_list(packing, state, skin)
        if float(found.balance.scale) < 1e-4 * k * float(jnp.mean(packing.radius)):
            break
    return start(packing, walls, state.position, skin)


def compact(
    packing: Packing, state: State, heights: Any, solver: Solver | None = None, tape: list[LoadStep] | None = None
) -> tuple[State, Compaction]:
    r"""Move the top punch from height to height, down or up, without friction and without inertia.

    .. math:: f(x; \max(\delta_P, \delta(x))) - \mu (x - x_{prev}) = 0, \qquad
        \delta_P \leftarrow \max(\delta_P, \delta(x))

    In every load step the centres come to where the contact forces f balance but for the proximal springs mu, which are
    made weaker in turn (`Solver.springs`); contacts remember only what they are at the end of the step (backward
    Euler). So each load step is a minimum of the energy of contacts and springs. A step that does not converge is
    halved; one that still does not is taken as far as it got and its row is marked, as are rows of springs not as weak
    as asked for (`spring`).

    The walls of the state (`relaxed`, `start`, or the end of another compaction or motion) are a `die`; `heights` are
    those of the top punch over the bottom one [m]. Load steps are appended to `tape`, for `replay_compaction`.

    Returns:
        The state at the end, at rest, and the rows.

    Raises:
        InputError: for walls that are not a die, a height that is not positive, or a particle outside the walls.
    """
    solver = solver or Solver()
    check_packing(packing)
    die_walls(state.walls)
    heights = arguments.floats(heights, "heights", shape="heights of the top punch [m], shape (rows,)")
    if heights.ndim != 1 or not (np.isfinite(heights).all() and (heights > 0).all()):
        raise InputError("a height of the top punch that is not positive", remedy="Give the heights in metres.")
    still = jnp.zeros_like(state.position)
    state = replace(state, velocity=still, spin=still)
    rows = []
    for height in heights:
        attempts = _reach(packing, state, float(height), solver, solver.halvings)
        state = attempts[-1].state
        check_state(state)
        rows.append(_row(packing, state, attempts))
        if tape is not None:
            for one in attempts:
                edges, position = one.state.edges, one.state.position
                at = jnp.asarray(_height(one.state.walls), position.dtype)
                tape.append(LoadStep(edges.key, edges.i, edges.j, at, one.stiffness, position, one is attempts[-1]))
    return state, Compaction(*(np.asarray(column) for column in zip(*rows, strict=True)))


def _reach(packing: Packing, state: State, height: float, solver: Solver, halvings: int) -> list[_Attempt]:
    """Load steps to a height, as few as converge."""
    before, attempt = _height(state.walls), _attempt(packing, state, height, solver)
    if attempt.complete or halvings == 0 or height == before:
        return [attempt]
    first = _reach(packing, state, 0.5 * (before + height), solver, halvings - 1)
    return first + _reach(packing, first[-1].state, height, solver, halvings - 1)


def _attempt(packing: Packing, state: State, height: float, solver: Solver) -> _Attempt:
    """One load step, with weaker and weaker springs, on a list of edges that is complete at its end."""
    skin = solver.skin * float(jnp.mean(packing.radius))
    if _moved(state) > skin / 2:
        state = rebuild_list(packing, state, skin)
    before = _height(state.walls)
    walls = lowered(state.walls, jnp.asarray(height, state.position.dtype))
    guess = state.position.at[:, 2].multiply(min(height / before, 1.0))
    k = float(jnp.mean(packing.sides.k1))
    evaluations, solved = 0, list[tuple[Problem, Equilibrium]]()
    for spring in solver.springs:
        problem = Problem(packing, walls, state.edges, state.wall_history, state.position, jnp.asarray(spring * k))
        found = _find_equilibrium(problem, guess, jnp.asarray(solver.rtol), solver.max_steps)
        evaluations += int(found.steps)
        end = replace(state, position=found.position)
        if _moved(end) > skin / 2 and np.isfinite(found.position).all():
            fresh = rebuild_list(packing, end, skin)
            if _unlisted(packing, state.edges, fresh):
                state = replace(state, edges=fresh.edges, listed_at=fresh.listed_at)
                problem = replace(problem, edges=fresh.edges)
                found = _find_equilibrium(problem, found.position, jnp.asarray(solver.rtol), solver.max_steps)
                evaluations += int(found.steps)
        solved.append((problem, found))
        if not found.converged:
            break
        guess = found.position
    problem, found = solved[-1]
    complete = bool(found.converged)
    if not complete and len(solved) > 1:  # the weakest springs with which it did converge
        problem, found = solved[-2]
    edges, wall_history = _remembered(problem, found.position)
    end = replace(state, position=found.position, edges=edges, wall_history=wall_history, walls=walls)
    moved = np.asarray(found.position - state.position)
    springs, top = float(problem.proximal) * np.abs(moved[:, 2]).sum(), float(found.balance.on_wall[TOP])
    share = float(springs / top) if top > 0 else math.inf
    move = float(np.linalg.norm(moved, axis=1).max()) / max(abs(height - before), 1e-300)
    return _Attempt(end, found, problem.proximal, complete, evaluations, share, move)


_find_equilibrium = eqx.filter_jit(find_equilibrium)
_remembered = eqx.filter_jit(remembered)


def _unlisted(packing: Packing, old: Edges, fresh: State) -> bool:
    """Whether particles touch that the old list does not know."""
    overlap, _ = pair_geometry(packing.radius, fresh.position, fresh.edges)
    touching = np.asarray(fresh.edges.key)[np.asarray(overlap) > 0]
    return not np.isin(touching, np.asarray(old.key)).all()


def _row(packing: Packing, state: State, attempts: list[_Attempt]) -> tuple:
    balance, height = attempts[-1].equilibrium.balance, _height(state.walls)
    touching, beyond, _ = measured(packing, state)
    _, _, barrel = die_walls(state.walls)
    return (
        height,
        float(packing.volume) / (math.pi * float(barrel.radius) ** 2 * height),
        float(balance.on_wall[TOP]),
        float(balance.on_wall[BOTTOM]),
        all(bool(a.equilibrium.converged) for a in attempts),
        float(jnp.max(jnp.abs(balance.net))) / max(float(balance.scale), 1e-300),
        max(a.share for a in attempts),
        max(float(a.stiffness) for a in attempts) / float(jnp.mean(packing.sides.k1)),
        len(attempts),
        sum(a.evaluations for a in attempts),
        max(a.move for a in attempts),
        int(touching),
        int(beyond),
    )


def _height(walls: Walls) -> float:
    bottom, top, _ = die_walls(walls)
    return float(top.point[2] - bottom.point[2])


def _moved(state: State) -> float:
    """Furthest that a particle is from where it was when the edges were listed [m]."""
    return float(jnp.sqrt(jnp.max(jnp.sum((state.position - state.listed_at) ** 2, axis=1))))


def lowered(walls: Walls, height: Scalar) -> Walls:
    """The walls with the top punch at a height over the bottom one."""
    bottom, top, barrel = die_walls(walls)
    return bottom, replace(top, point=bottom.point + height * bottom.normal), barrel


def die_walls(walls: Walls) -> tuple[Plane, Plane, Cylinder]:
    """Bottom punch, top punch and barrel; `InputError` if that is not what the walls are."""
    match walls:
        case (Plane() as bottom, Plane() as top, Cylinder() as barrel):
            upwards = bottom.normal[2], top.normal[2]
            if arguments.is_traced(upwards) or upwards == (1, -1):
                return bottom, top, barrel
    raise InputError("walls that are not bottom punch, top punch and barrel", remedy="Make them with `die`.")


class Replayed(NamedTuple):
    """The load steps again, differentiable: forces on bottom, top and barrel along their normals [N], centres [m],
    edges and wall history at the end, residuals, sums of the springs' axial forces without sign [N].
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

    Lists of edges, heights and springs are those of the tape; the equilibria are found again, each from where the tape
    has it, and differentiated by the implicit function theorem, history included. Where other particles meet than the
    tape lists, contacts are missing: compact such a packing instead.
    """
    return eqx.filter_jit(replay_stacked)(packing, state, stacked_lists(tape), solver or Solver())


def replay_stacked(packing: Packing, state: State, steps: LoadStep, solver: Solver) -> Replayed:
    """`replay_compaction` of stacked load steps (`stacked_lists`), to be traced."""

    def one(carry, step):
        previous, recorded, edges, wall_history = carry
        edges = with_list(edges, step.key, step.i, step.j)
        problem = Problem(packing, lowered(state.walls, step.height), edges, wall_history, previous, step.spring)
        found = find_equilibrium(problem, previous + (step.position - recorded), solver.rtol, solver.max_steps)
        position = found.position
        edges, wall_history = remembered(problem, position)
        springs = step.spring * jnp.sum(jnp.abs(position[:, 2] - previous[:, 2]))
        net, on_wall = forces(problem, position)
        residual = jnp.max(jnp.abs(net)) / found.balance.scale
        row = on_wall, position, residual, springs, found.converged
        return (position, step.position, edges, wall_history), row

    before = with_list(state.edges, steps.key[0], steps.i[0], steps.j[0])
    carry = (state.position, state.position, before, state.wall_history)
    (_, _, edges, wall_history), (on_wall, position, residual, proximal, converged) = jax.lax.scan(one, carry, steps)
    return Replayed(on_wall, position, edges, wall_history, residual, proximal, converged)
