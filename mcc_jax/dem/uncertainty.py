"""Sensitivities of a compaction curve to the particles, a band around it, parameters from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .. import arguments
from .._errors import InputError
from .._format import described
from ..calibrate import Posterior
from ..calibrate.population import Scatter, flattened, particles_at
from ..calibrate.predict import laws_with
from ..law import MccLaw
from .neighbours import stacked_lists
from .quasistatic import TOP, Compaction, LoadStep, Replayed, Solver, compact, replay_stacked
from .state import MCC_DENSITY, Packing, State, not_monotone, spheres

REDRAWS = 100  # of a particle's law, until it is monotone
ROUNDS = 5  # compactions of a fit made again
TOLERANCE = 1e-7  # of fitted parameters, relative and absolute

STRESSES = ("K1", "K3", "K5", "Ebar", "springs")
"""What has the dimension of a stress: K1 = C1, K3 = C3^3, K5 = C5^5, the effective modulus, the proximal springs."""

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
        residual, proximal_share: as of `Compaction`, the largest of the row's load steps.
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
    """The packing with K1 = C1, K3 = C3^3, K5 = C5^5 and Ebar of all particles times :math:`e^{s}`."""
    sides, (k1, k3, k5, modulus) = packing.sides, jnp.exp(log_scale)
    scaled = sides.k1 * k1, sides.k3 * k3, sides.k5 * k5, sides.c / modulus**sides.power
    # Not by `replace`: the constructor takes one half contact and not a batch.
    return eqx.tree_at(lambda p: (p.sides.k1, p.sides.k3, p.sides.k5, p.sides.c), packing, scaled)


def punch_sensitivity(
    packing_of: PackingOf, values: Any, state: State, tape: Sequence[LoadStep], solver: Solver | None = None
) -> Sensitivity:
    r"""Derivatives of the punch force with respect to any parameters of the packing, through all load steps.

    .. math:: K_n\, dx_n = \partial_\theta f\, d\theta + \partial_{\delta_P} f\, d\delta_{P,n-1} + \mu\, dx_{n-1},

    .. math:: d\delta_{P,n} = [\delta > \delta_P]\; d\delta(x_n) + [\delta \le \delta_P]\; d\delta_{P,n-1}

    in forward mode: one factorisation of the stiffness K a load step. The derivative is that of the branch the
    compaction took. Where contacts snap (`Compaction.largest_move`) a finite change of a parameter may move the snap to
    another load step, which no derivative shows. `packing_of` is the packing as a function of parameters, at `values`
    the one that made the tape; state, tape and solver are those of `compact`.
    """
    values = jnp.asarray(values, float)
    last = np.array([step.last for step in tape])
    # Outside the compiled function: that one then is the same for all parametrisations.
    direction = jax.jacfwd(packing_of)(values)
    packing = packing_of(values)
    jacobian, replayed = _jacobian(packing, direction, state, stacked_lists(tape), solver or Solver())
    jacobian, force = np.asarray(jacobian), np.asarray(replayed.on_wall)[:, TOP]
    by_stress, pressed = jacobian[last, len(values) :], force > 0
    share = np.where(pressed, np.asarray(replayed.proximal) / np.where(pressed, force, 1.0), np.inf)
    starts = np.concatenate([[0], np.flatnonzero(last)[:-1] + 1])  # of the rows, among the load steps
    return Sensitivity(
        force[last],
        jacobian[last, : len(values)],
        by_stress,
        np.abs(by_stress.sum(axis=1) - force[last]) / np.where(pressed, force, 1.0)[last],
        np.maximum.reduceat(np.asarray(replayed.residual), starts),
        np.maximum.reduceat(share, starts),
        np.logical_and.accumulate(np.asarray(replayed.converged))[last],
    )


@eqx.filter_jit
def _jacobian(
    packing: Packing, direction: Packing, state: State, steps: LoadStep, solver: Solver
) -> tuple[Array, Replayed]:
    count = direction.radius.shape[-1]

    def force(parameters: Array) -> tuple[Array, Replayed]:
        along = jax.tree.map(lambda x, dx: x + dx @ parameters[:count], packing, direction)
        springs = steps._replace(spring=steps.spring * jnp.exp(parameters[-1]))
        replayed = replay_stacked(rescaled(along, parameters[count : count + 4]), state, springs, solver)
        return replayed.on_wall[:, TOP], replayed

    return jax.jacfwd(force, has_aux=True)(jnp.zeros(count + len(STRESSES)))


class PopulationPacking(NamedTuple):
    """A packing as a differentiable function of one row of posterior draws of a population, and the named columns."""

    packing_of: PackingOf
    draws: np.ndarray
    names: tuple[str, ...]

    __repr__ = described()


class Band(NamedTuple):
    """Quantiles of the force on the top punch, one column for each row of the compaction.

    Attributes:
        probability, quantiles: force on the top punch [N], (probabilities, rows).
        standard_deviation: of that force [N].
        converged: rows in which the compaction is in equilibrium, as all before.
        not_monotone: particles whose force falls on loading.
        compaction, sensitivity: those at the mean of the draws.
    """

    height: np.ndarray
    density: np.ndarray
    probability: np.ndarray
    quantiles: np.ndarray
    standard_deviation: np.ndarray
    converged: np.ndarray
    not_monotone: int
    compaction: Compaction
    sensitivity: Sensitivity

    __repr__ = described()


def population_packing(
    calibration: Posterior, diameter: Any, *, seed: int = 0, density: float = MCC_DENSITY
) -> PopulationPacking:
    r"""Spheres whose laws follow the population, :math:`\ln C_i = \mu + \tau z_i`, and alike for the modulus.

    The z of every particle are drawn once and kept, so that a draw of the population moves all particles together: the
    band is about the population, not about which particles one happened to take. Particles not monotone at the
    posterior mean are redrawn. Effects of the model act in the contacts, but for those of the instrument; one that
    contacts cannot have is refused by name. Diameters are in um, the density of a particle in kg/m^3.
    """
    diameter = arguments.path(diameter, "diameter", many="Give one diameter [um] for each sphere.")
    arguments.positive(diameter, "diameter [um]")
    model = calibration.model
    population = eqx.tree_at(lambda p: p.log_noise, flattened(calibration.population), None)
    draws = np.asarray(jax.vmap(lambda one: ravel_pytree(one)[0])(population))
    _, unravelled = ravel_pytree(jax.tree.map(lambda x: x[0], population))
    names = ("a", "ln Ebar", "mu1", "mu3", "mu5", "tau1", "tau3", "tau5", "scatter of ln Ebar", "scatter of a")
    names += (*model.forms.names, *(f"scatter of {name}" for name in model.varying_places))
    size = jnp.asarray(diameter, float)
    own = Scatter(modulus=True, shape=True, power=model.shape_power, varying=model.scatter.varying)

    def laws(values: Array, z: Array) -> MccLaw:
        shared = unravelled(values)
        particles = particles_at(shared, jnp.zeros(len(z)), own, z)
        C, modulus = jnp.exp(particles.latent[:, :3]), jnp.exp(particles.latent[:, 3])
        return laws_with(model, C, jnp.full(len(z), shared.a), modulus, particles.theta).of_particle()

    rng = np.random.default_rng(arguments.seed(seed))
    z = rng.standard_normal((len(size), own.size))
    mean = jnp.asarray(draws.mean(0))
    for _ in range(REDRAWS):
        wrong = ~np.asarray(eqx.filter_vmap(lambda law: law.is_monotone)(laws(mean, jnp.asarray(z))))
        if not wrong.any():
            break
        z[wrong] = rng.standard_normal((int(wrong.sum()), own.size))
    else:
        problem = f"{REDRAWS} draws of a particle's law, none monotone"
        raise InputError(problem, remedy="The calibrated scatter is too large.")
    kept = jnp.asarray(z)

    def packing_of(values: Array) -> Packing:
        return spheres(laws(values, kept), size, density)

    packing_of(mean)  # refuses here, by name, effects that no contact can have
    return PopulationPacking(packing_of, draws, names)


def first_order_band(
    packing_of: PackingOf,
    draws: Float[np.ndarray, "draws parameters"],
    state: State,
    heights: Float[np.ndarray, " rows"],
    *,
    probability: Sequence[float] = (0.05, 0.5, 0.95),
    solver: Solver | None = None,
) -> Band:
    r"""Band from one compaction at the mean of the draws and its sensitivities (delta method).

    .. math:: F_p = F(\bar\theta) + z_p\,\sqrt{J \Sigma J^T}, \qquad J = \partial F / \partial\theta

    `draws` are of the parameters, one row each; state, heights and solver are those of `compact`.
    """
    draws = arguments.floats(draws, "draws", shape="a table with one row for each draw")
    if draws.ndim != 2 or len(draws) < 2 or not np.isfinite(draws).all():
        raise InputError("draws that are not a table of two or more finite rows", remedy="One row for each draw.")
    mean = draws.mean(axis=0)
    packing, tape = packing_of(jnp.asarray(mean)), list[LoadStep]()
    _, rows = compact(packing, state, heights, solver, tape)
    found = punch_sensitivity(packing_of, mean, state, tape, solver)
    variance = np.einsum("ra,ab,rb->r", found.by_parameter, np.atleast_2d(np.cov(draws.T)), found.by_parameter)
    deviation = np.sqrt(np.maximum(variance, 0.0))
    z = np.array([NormalDist().inv_cdf(p) for p in probability])
    return Band(
        rows.height,
        rows.density,
        np.asarray(probability, float),
        rows.top + z[:, None] * deviation,
        deviation,
        found.converged,
        int(not_monotone(packing).sum()),
        rows,
        found,
    )


class CompactionFit(NamedTuple):
    """Parameters fitted to a compaction curve, and the compaction with them.

    Attributes:
        misfit: root mean square of force minus measured force, over the largest measured force [-].
        rounds: compactions made again on the way.
        converged: whether the last round no longer changed the parameters and every row is in equilibrium.
    """

    values: np.ndarray
    compaction: Compaction
    misfit: float
    rounds: int
    converged: bool

    __repr__ = described()


def fit_compaction(
    packing_of: PackingOf, start: Any, state: State, heights: Any, force: Any, *, solver: Solver | None = None
) -> CompactionFit:
    r"""Parameters whose compaction curve comes closest to a measured one, by Levenberg-Marquardt.

    .. math:: \min_\theta \sum_r \left(\frac{F_r(\theta) - F_r}{\max F}\right)^2

    with the sensitivities of the load steps. Within a round the load steps are those of a compaction at the round's
    start (`replay_compaction`); rounds go on until the parameters stay, because contacts may snap elsewhere.
    `packing_of` is the packing as a function of parameters, `start` a first guess of them: take logarithms of positive
    ones; the modulus needs rows of unloading. State, heights and solver are as for `compact`, `force` is that on the
    top punch at the heights [N], of which there must be no fewer than parameters.
    """
    solver = solver or Solver()
    values, heights = arguments.path(start, "start"), arguments.path(heights, "heights")
    measured = arguments.floats(force, "force", shape="the force on the top punch [N] at every height")
    if measured.shape != np.shape(heights) or measured.size < len(values) or not np.isfinite(measured).all():
        problem = f"{measured.size} forces for {len(heights)} heights and {len(values)} parameters"
        raise InputError(problem, remedy="One finite force for each height, and no fewer than parameters.")
    if not measured.max() > 0:
        raise InputError("a compaction curve without a positive force", remedy="Forces are in newtons.")
    target, stays, rounds = jnp.asarray(measured), False, 0
    while not stays and rounds < ROUNDS:
        tape: list[LoadStep] = []
        compact(packing_of(values), state, heights, solver, tape)
        before, rounds = values, rounds + 1
        values = _least_squares(packing_of, values, state, stacked_lists(tape), target, solver)
        stays = bool(jnp.all(jnp.abs(values - before) <= 10 * TOLERANCE * (1 + jnp.abs(values))))
    _, rows = compact(packing_of(values), state, heights, solver)
    misfit = float(np.sqrt(np.mean(((rows.top - measured) / measured.max()) ** 2)))
    return CompactionFit(np.asarray(values), rows, misfit, rounds, stays and bool(rows.converged.all()))


@eqx.filter_jit
def _least_squares(
    packing_of: PackingOf, start: Array, state: State, steps: LoadStep, target: Array, solver: Solver
) -> Array:
    ends = jnp.nonzero(steps.last, size=len(target))[0]

    def residuals(values: Array, _: None) -> Array:
        replayed = replay_stacked(packing_of(values), state, steps, solver)
        return (replayed.on_wall[ends, TOP] - target) / jnp.max(target)

    method = optx.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE)
    return optx.least_squares(residuals, method, start, max_steps=64, throw=False).value
