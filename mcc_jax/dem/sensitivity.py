"""Derivative of the punch force along a compaction, with what tells whether to believe it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import arguments
from .._errors import InputError
from .._format import described
from .forces import Packing
from .load_steps import TOP, LoadStep, Replayed, Solver, replay_stacked, stacked
from .state import State

STRESSES = ("K1", "K3", "K5", "Ebar", "springs")
"""What has the dimension of a stress: K1 = C1, K3 = C3^3, K5 = C5^5, the effective modulus, the proximal springs."""

Parameters = Float[Array | np.ndarray, " parameters"]
PackingOf = Callable[[Float[Array, " parameters"]], Packing]


class Sensitivity(NamedTuple):
    r"""Force on the top punch and its derivatives, one row for each row of the compaction.

    Attributes:
        force: F on the top punch [N].
        by_parameter: dF/dtheta, (rows, parameters) [N per unit of the parameter].
        by_stress: p dF/dp for p in `STRESSES`, each scaled in all particles alike, (rows, 5) [N]. So dF/dln C1 is the
            first column, dF/dln C3 three times the second, dF/dln C5 five times the third.
        euler_defect: :math:`|\sum_p p\,\partial F/\partial p - F| / F`, zero in exact arithmetic: F is homogeneous of
            degree one in all stresses (Euler's identity). In newtons where F = 0.
        residual: largest net force over the mean contact force, the worst of the row's load steps.
        proximal_share: the springs' axial forces, without sign, over F, the largest of the row's load steps.
        converged: whether this row and all before it, whose history it carries, are in equilibrium.
    """

    force: np.ndarray
    by_parameter: np.ndarray
    by_stress: np.ndarray
    euler_defect: np.ndarray
    residual: np.ndarray
    proximal_share: np.ndarray
    converged: np.ndarray

    __repr__ = described()


def rescaled(packing: Packing, log_scale: Float[Array, " 4"]) -> Packing:
    r"""The packing with K1, K3, K5 and Ebar of all particles times :math:`e^{s}`.

    Args:
        packing: the spheres.
        log_scale: s of K1 = C1, K3 = C3^3, K5 = C5^5 and Ebar.
    """
    sides = packing.sides
    k1, k3, k5, modulus = (jnp.exp(s) for s in log_scale)
    scaled = (sides.k1 * k1, sides.k3 * k3, sides.k5 * k5, sides.c / modulus**sides.power)
    return eqx.tree_at(lambda p: (p.sides.k1, p.sides.k3, p.sides.k5, p.sides.c), packing, scaled)


def punch_sensitivity(
    packing_of: PackingOf, values: Parameters, state: State, tape: Sequence[LoadStep], solver: Solver | None = None
) -> Sensitivity:
    r"""Derivatives of the punch force with respect to any parameters of the packing, through all load steps.

    .. math:: K_n\, dx_n = \partial_\theta f\, d\theta + \partial_{\delta_P} f\, d\delta_{P,n-1} + \mu\, dx_{n-1},

    .. math:: d\delta_{P,n} = [\delta > \delta_P]\; d\delta(x_n) + [\delta \le \delta_P]\; d\delta_{P,n-1}

    in forward mode: one factorisation of the stiffness K a load step, whatever the number of parameters. The derivative
    is that of the branch the compaction took. Where contacts snap from one equilibrium to another
    (`Compaction.largest_move`) a finite change of a parameter may move the snap to another load step, which no
    derivative tells.

    Args:
        packing_of: the packing as a function of parameters; at `values` the one that made the tape.
        values: parameters [any units].
        state: where the compaction started.
        tape: its load steps.
        solver: as given to `compact`.

    Raises:
        InputError: if the tape is empty.
    """
    if not callable(packing_of):
        raise InputError(f"packing_of must be a function of the values, got {arguments.kind_of(packing_of)}")
    values = jnp.asarray(values, float)
    last = np.array([step.last for step in tape])
    # Outside the compiled function: that one then is the same for all parametrisations.
    direction = jax.jacfwd(packing_of)(values)
    packing = packing_of(values)
    jacobian, (force, replayed) = _jacobian(packing, direction, state, stacked(tape), solver or Solver())
    force, jacobian, worst = np.asarray(force), np.asarray(jacobian), np.asarray(replayed.residual)
    row = np.concatenate([[0], np.cumsum(last)[:-1]])
    by_stress = jacobian[last, len(values) :]
    pressed = force > 0
    share = np.where(pressed, np.asarray(replayed.proximal) / np.where(pressed, force, 1.0), np.inf)
    reached = np.logical_and.accumulate(np.asarray(replayed.converged))
    rows = range(int(last.sum()))
    return Sensitivity(
        force[last],
        jacobian[last, : len(values)],
        by_stress,
        np.abs(by_stress.sum(axis=1) - force[last]) / np.where(pressed, force, 1.0)[last],
        np.array([worst[row == r].max() for r in rows]),
        np.array([share[row == r].max() for r in rows]),
        reached[last],
    )


@eqx.filter_jit
def _jacobian(
    packing: Packing, direction: Packing, state: State, steps: LoadStep, solver: Solver
) -> tuple[Array, tuple[Array, Replayed]]:
    count = direction.radius.shape[-1]

    def force(parameters: Array) -> tuple[Array, tuple[Array, Replayed]]:
        along = jax.tree.map(lambda x, dx: x + dx @ parameters[:count], packing, direction)
        springs = steps._replace(spring=steps.spring * jnp.exp(parameters[-1]))
        replayed = replay_stacked(rescaled(along, parameters[count : count + 4]), state, springs, solver)
        return replayed.on_wall[:, TOP], (replayed.on_wall[:, TOP], replayed)

    return jax.jacfwd(force, has_aux=True)(jnp.zeros(count + len(STRESSES)))
