"""The equilibrium of one load step: an Optimistix minimiser made for contacts, and its implicit derivative."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Int

from .._types import Flag, Scalar
from .state import Vectors
from .stiffness import Balance, Problem, Stiffness, balance, net_force

SUFFICIENT = 1e-4
"""Share of the decrease the slope promises that a step must bring (Armijo)."""


class _State(eqx.Module):
    trial: Vectors
    direction: Vectors
    size: Scalar
    energy: Scalar
    slope: Scalar
    first: Flag
    settled: Flag
    stuck: Flag
    at: Balance


class ContactNewton(optx.AbstractMinimiser[Vectors, Balance, _State]):
    """Newton's method on the energy of a packing, with a line search.

    Contacts stiffen thirty times and more where they turn from loading to unloading, so that the net force has kinks.
    It is minus the gradient of an energy, which has none and so judges a step. Where the stiffness is not positive
    definite (forces that turn destabilise) its material part gives the direction.

    Attributes:
        rtol: largest net force over the mean contact force at which a packing counts as settled.
        atol: and what is allowed on top of it [N].
        reach: a particle moves at most so far in one step [m].
    """

    rtol: Scalar | float  # pyright: ignore[reportIncompatibleVariableOverride]
    atol: Scalar  # pyright: ignore[reportIncompatibleVariableOverride]
    reach: Scalar

    def norm(self, y: Any) -> Scalar:
        """The largest absolute entry; an attribute that Optimistix asks for."""
        return jnp.max(jnp.abs(y))

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """Nothing is known yet: the first step evaluates where it stands."""
        zero, no = jnp.zeros((), f_struct.dtype), jnp.array(False)
        at = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux_struct)
        return _State(y, jnp.zeros_like(y), zero + 1, zero, zero, jnp.array(True), no, no, at)

    def step(self, fn, y, args, options, state: _State, tags) -> tuple[Vectors, _State, Balance]:
        """Evaluate the trial; take it and find a new direction, or shorten the step."""
        energy, at = fn(state.trial, args)
        largest = jnp.max(jnp.abs(at.net))
        slope_there = -jnp.sum(at.net * state.direction)
        descends = energy - state.energy <= SUFFICIENT * state.size * state.slope
        # Close to the minimum the energy has no digits left to tell a step by; its slope has.
        level = jnp.abs(energy - state.energy) <= 1e-12 * jnp.abs(state.energy)
        accept = state.first | descends | (level & (jnp.abs(slope_there) <= 0.9 * jnp.abs(state.slope)))
        settled = accept & (largest <= self.rtol * at.scale + self.atol)
        direction = jax.lax.cond(
            accept & ~settled, lambda: _direction(at, self.reach), lambda: jnp.where(settled, 0.0, state.direction)
        )
        secant = state.slope / jnp.minimum(state.slope - slope_there, -jnp.finfo(energy.dtype).tiny)
        size = jnp.where(accept, 1.0, state.size * jnp.clip(secant, 0.1, 0.5))
        y = jnp.where(accept, state.trial, y)
        new = _State(
            y + size * direction,
            direction,
            size,
            jnp.where(accept, energy, state.energy),
            jnp.where(accept, -jnp.sum(at.net * direction), state.slope),
            jnp.array(False),
            settled,
            ~accept & (size < 1e-10) | ~jnp.isfinite(largest),
            jax.tree.map(lambda now, before: jnp.where(accept, now, before), at, state.at),
        )
        return y, new, state.at

    def terminate(self, fn, y, args, options, state: _State, tags) -> tuple[Flag, optx.RESULTS]:
        """Whether the net force is small enough, or no step helps any more."""
        result = optx.RESULTS.where(state.stuck, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        return state.settled | state.stuck, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result) -> tuple[Vectors, Balance, dict[str, Any]]:
        """The balance is that of the centres returned, also where the last trial was not taken."""
        return y, state.at, {}


def _direction(at: Balance, reach: Scalar) -> Vectors:
    newton = at.stiffness.solve(at.net, definite=True)
    downhill = jnp.all(jnp.isfinite(newton)) & (jnp.sum(newton * at.net) > 0)
    step = jax.lax.cond(downhill, lambda: newton, lambda: at.material.solve(at.net, definite=True))
    return step * jnp.minimum(1.0, reach / jnp.maximum(jnp.max(jnp.abs(step)), jnp.finfo(step.dtype).tiny))


class Equilibrium(NamedTuple):
    """The end of one load step.

    Attributes:
        position: centres [m]; their derivative is that of the equilibrium, by the implicit function theorem.
        balance: energy, net force and stiffness there.
        converged: whether the net force is small enough.
        steps: evaluations it took.
    """

    position: Vectors
    balance: Balance
    converged: Flag
    steps: Int[Array, ""]


def find_equilibrium(problem: Problem, guess: Vectors, rtol: Scalar | float, max_steps: int) -> Equilibrium:
    r"""Centres at which the net force vanishes, a minimum of the energy of contacts and proximal springs.

    .. math:: f(x; \theta) - \mu (x - x_{prev}) = 0, \qquad K\, dx = \partial_\theta f\, d\theta + \mu\, dx_{prev}

    Differentiable in `problem` in both modes; a load step that did not converge returns where it got to.

    Args:
        problem: packing, walls, history and springs.
        guess: where to start [m].
        rtol: largest net force over the mean contact force.
        max_steps: evaluations before giving up.
    """
    fixed = jax.lax.stop_gradient(problem)
    sides, radius = fixed.packing.sides, fixed.packing.radius
    atol, reach = 1e-12 * jnp.mean(sides.k1 * radius), 0.3 * jnp.min(radius)
    solver = ContactNewton(rtol, atol, reach)  # pyright: ignore[reportCallIssue]  # `norm` is a method here

    def energy(position: Vectors, problem: Problem) -> tuple[Scalar, Balance]:
        at = balance(problem, position)
        return at.energy, at

    found = optx.minimise(
        energy, solver, jax.lax.stop_gradient(guess), fixed, has_aux=True, max_steps=max_steps, throw=False
    )
    at = found.aux
    position = _implicit(found.value, at.stiffness, net_force(problem, found.value))
    return Equilibrium(position, at, found.result == optx.RESULTS.successful, found.stats["num_steps"])


@eqx.filter_custom_jvp
def _implicit(position: Vectors, stiffness: Stiffness, net: Vectors) -> Vectors:
    """The position itself; it moves as the equilibrium does when the net force changes."""
    return position


@_implicit.def_jvp
def _implicit_jvp(primals, tangents):
    position, stiffness, _ = primals
    change = tangents[2]
    return position, jnp.zeros_like(position) if change is None else stiffness.solve(change, definite=False)
