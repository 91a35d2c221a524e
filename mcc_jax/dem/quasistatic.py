"""Quasi-static compaction in a die: as many load steps as it takes, each in equilibrium."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import described
from .._types import Scalar
from .edges import Edges
from .equilibrium import Settled, settle
from .forces import Packing
from .load_steps import BOTTOM, TOP, LoadStep, Solver, die_walls, lowered
from .measured import measured
from .state import State, check_packing, check_state, listed, start
from .stiffness import Held, pair_geometry, remembered
from .walls import Walls


class Compaction(NamedTuple):
    """Rows of a compaction, one for each height asked for.

    Attributes:
        height: of the top punch over the bottom one [m].
        density: volume of the spheres over that of the die [-].
        top, bottom: force on the punches [N].
        converged: whether every load step of the row ended in equilibrium. Do not use a row that did not.
        residual: largest net force on a particle over the mean contact force [-].
        proximal_share: sum of the proximal springs' axial forces, without sign, over the force on the top punch;
            infinite where there is none [-].
        spring: the proximal springs' stiffness over the mean initial stiffness [-].
        load_steps: into how many steps the row was divided.
        evaluations: of forces and stiffness.
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
    state: State
    settled: Settled
    converged: bool
    complete: bool
    spring: float
    stiffness: Scalar
    evaluations: int
    share: float
    move: float


def relaxed(packing: Packing, walls: Walls, position: Any, solver: Solver | None = None, passes: int = 40) -> State:
    """A state to start a compaction from: overlaps pushed apart, all contacts virgin.

    Steps of steepest descent on the contacts' energy, implicit and so of any length (a proximal spring of 0.3 of the
    mean stiffness), until the contacts carry next to nothing or the passes are used up. Below random close packing
    hardly an overlap is left; above it, what is left is where the compaction begins. What contacts went through here is
    forgotten. Scatter the spheres first (`scattered`) and lower them into the die.

    Args:
        packing: the spheres.
        walls: the walls.
        position: centres [m]; may overlap.
        solver: skin, tolerance and steps.
        passes: how many steps at most.

    Raises:
        InputError: as `start`.
    """
    solver = solver or Solver()
    passes = arguments.whole(passes, "passes")
    check_packing(packing)
    skin = solver.skin * float(jnp.mean(packing.radius))
    k = float(jnp.mean(packing.sides.k1))
    state = start(packing, walls, position, skin)
    for _ in range(passes):
        held = Held(packing, walls, state.edges, state.wall_history, state.position, jnp.asarray(0.3 * k))
        settled = _settle(held, state.position, jnp.asarray(1e-3), solver.max_steps)
        state = eqx.tree_at(lambda s: s.position, state, settled.position)
        if _moved(state) > skin / 2:
            state = listed(packing, state, skin)
        if float(settled.balance.scale) < 1e-4 * k * float(jnp.mean(packing.radius)):
            break
    return start(packing, walls, state.position, skin)


def compact(
    packing: Packing, state: State, heights: Any, solver: Solver | None = None, tape: list[LoadStep] | None = None
) -> tuple[State, Compaction]:
    r"""Move the top punch from height to height, down or up, without friction and without inertia.

    .. math:: f(x; \max(\delta_P, \delta(x))) - \mu (x - x_{prev}) = 0, \qquad
        \delta_P \leftarrow \max(\delta_P, \delta(x))

    In every load step the centres settle where the contact forces f balance but for the proximal springs mu, which are
    made weaker in turn (`Solver.springs`); contacts remember only what they are at the end of the step (backward
    Euler). So each load step is a minimum of the energy of contacts and springs. A step that does not converge is
    halved; one that still does not is taken as far as it got and its row is marked, as are the rows of springs that
    could not be made as weak as asked for (`spring`).

    Args:
        packing: the spheres.
        state: where to start (`relaxed`, `start`, or the end of another compaction or motion); its walls as `die` has
            them.
        heights: of the top punch over the bottom one [m].
        solver: tolerances.
        tape: a list to which the load steps are appended, for `replay_compaction`.

    Returns:
        The state at the end, at rest, and the rows.

    Raises:
        InputError: for walls that are not a die, a height that is not positive, or a particle outside the walls. The
            state passed in is untouched.
    """
    solver = solver or Solver()
    check_packing(packing)
    die_walls(state.walls)
    heights = arguments.floats(heights, "heights", shape="heights of the top punch [m], shape (rows,)")
    if heights.ndim != 1 or not (np.isfinite(heights).all() and (heights > 0).all()):
        raise InputError("a height of the top punch that is not positive", remedy="Give the heights in metres.")
    still = jnp.zeros_like(state.position)
    state = eqx.tree_at(lambda s: (s.velocity, s.spin), state, (still, still))
    rows = []
    for height in heights:
        attempts = _reach(packing, state, float(height), solver, solver.halvings)
        state = attempts[-1].state
        check_state(state)
        rows.append(_row(packing, state, attempts))
        if tape is not None:
            tape.extend(_load_step(a, a is attempts[-1]) for a in attempts)
    return state, Compaction(*(np.asarray(column) for column in zip(*rows, strict=True)))


def _reach(packing: Packing, state: State, height: float, solver: Solver, halvings: int) -> list[_Attempt]:
    """Load steps to a height, as few as converge."""
    attempt = _attempt(packing, state, height, solver)
    if attempt.complete or halvings == 0:
        return [attempt]
    middle = 0.5 * (_height(state.walls) + height)
    if middle in (height, _height(state.walls)):
        return [attempt]
    first = _reach(packing, state, middle, solver, halvings - 1)
    return first + _reach(packing, first[-1].state, height, solver, halvings - 1)


def _attempt(packing: Packing, state: State, height: float, solver: Solver) -> _Attempt:
    """One load step, with weaker and weaker springs, on a list of edges that is complete at its end."""
    skin = solver.skin * float(jnp.mean(packing.radius))
    if _moved(state) > skin / 2:
        state = listed(packing, state, skin)
    walls = lowered(state.walls, jnp.asarray(height, state.position.dtype))
    squeeze = min(height / _height(state.walls), 1.0)
    guess = state.position.at[:, 2].multiply(squeeze)
    k = float(jnp.mean(packing.sides.k1))
    evaluations, reached = 0, 0.0
    best: tuple[Held, Settled] | None = None
    for spring in solver.springs:
        held = Held(packing, walls, state.edges, state.wall_history, state.position, jnp.asarray(spring * k))
        settled = _settle(held, guess, jnp.asarray(solver.rtol), solver.max_steps)
        evaluations += int(settled.steps)
        end = eqx.tree_at(lambda s: s.position, state, settled.position)
        if _moved(end) > skin / 2 and np.isfinite(settled.position).all():
            fresh = listed(packing, end, skin)
            if _unlisted(packing, state.edges, fresh):
                state = eqx.tree_at(lambda s: (s.edges, s.listed_at), state, (fresh.edges, fresh.listed_at))
                held = eqx.tree_at(lambda h: h.edges, held, fresh.edges)
                settled = _settle(held, settled.position, jnp.asarray(solver.rtol), solver.max_steps)
                evaluations += int(settled.steps)
        if not bool(settled.converged):
            best = best or (held, settled)
            break
        guess, reached, best = settled.position, spring, (held, settled)
    assert best is not None  # there is at least one spring
    held, settled = best
    edges, wall_history = _remembered(held, settled.position)
    end = eqx.tree_at(
        lambda s: (s.position, s.edges, s.wall_history, s.walls), state, (settled.position, edges, wall_history, walls)
    )
    moved = np.asarray(settled.position - state.position)
    springs, top = float(held.proximal) * np.abs(moved[:, 2]).sum(), float(settled.balance.on_wall[TOP])
    share = float(springs / top) if top > 0 else math.inf
    stroke = max(abs(height - _height(state.walls)), 1e-300)
    move = float(np.linalg.norm(moved, axis=1).max()) / stroke
    complete = reached == solver.springs[-1]
    spring = float(held.proximal) / k
    return _Attempt(end, settled, bool(settled.converged), complete, spring, held.proximal, evaluations, share, move)


_settle = eqx.filter_jit(settle)
_remembered = eqx.filter_jit(remembered)


def _unlisted(packing: Packing, old: Edges, fresh: State) -> bool:
    """Whether particles touch that the old list does not know."""
    overlap, _ = pair_geometry(packing.radius, fresh.position, fresh.edges)
    touching = np.asarray(fresh.edges.key)[np.asarray(overlap) > 0]
    return not np.isin(touching, np.asarray(old.key)).all()


def _row(packing: Packing, state: State, attempts: list[_Attempt]) -> tuple:
    balance = attempts[-1].settled.balance
    sample = measured(packing, state, jnp.zeros((len(state.walls), 3), state.position.dtype))
    height = _height(state.walls)
    _, _, barrel = die_walls(state.walls)
    top, bottom = float(balance.on_wall[TOP]), float(balance.on_wall[BOTTOM])
    return (
        height,
        float(packing.volume) / (math.pi * float(barrel.radius) ** 2 * height),
        top,
        bottom,
        all(a.converged for a in attempts),
        float(jnp.max(jnp.abs(balance.net))) / max(float(balance.scale), 1e-300),
        max(a.share for a in attempts),
        max(a.spring for a in attempts),
        len(attempts),
        sum(a.evaluations for a in attempts),
        max(a.move for a in attempts),
        int(sample.contacts),
        int(sample.beyond_tested),
    )


def _load_step(attempt: _Attempt, last: bool) -> LoadStep:
    state, edges = attempt.state, attempt.state.edges
    height = jnp.asarray(_height(state.walls), state.position.dtype)
    return LoadStep(edges.key, edges.i, edges.j, height, attempt.stiffness, state.position, last)


def _height(walls: Walls) -> float:
    bottom, top, _ = die_walls(walls)
    return float(top.point[2] - bottom.point[2])


def _moved(state: State) -> float:
    """Furthest that a particle is from where it was when the edges were listed [m]."""
    return float(jnp.sqrt(jnp.max(jnp.sum((state.position - state.listed_at) ** 2, axis=1))))
