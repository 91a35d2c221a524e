"""From what a calibration knows to a band around the compaction curve."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import arguments
from .._errors import InputError
from .._format import described
from ..calibrate import Posterior
from ..calibrate.population import Population, Scatter, particles_at
from ..law import MccLaw, Plastic
from .forces import Packing
from .load_steps import LoadStep, Solver
from .packings import MCC_DENSITY, spheres
from .quasistatic import Compaction, compact
from .sensitivity import PackingOf, Sensitivity, punch_sensitivity
from .state import State, not_monotone

PROBABILITY = (0.05, 0.5, 0.95)
REDRAWS = 100


class PopulationPacking(NamedTuple):
    """A packing as a function of what a calibration learnt of the population, and the posterior draws of that.

    Attributes:
        packing_of: the packing for one row of `draws`; differentiable.
        draws: (draws, columns), as in `names`.
        names: of the columns.
    """

    packing_of: PackingOf
    draws: np.ndarray
    names: tuple[str, ...]

    __repr__ = described()


class Band(NamedTuple):
    """Quantiles of the force on the top punch, one column for each row of the compaction.

    Attributes:
        height, density: of the rows.
        probability: of the quantiles.
        quantiles: force on the top punch [N], (probabilities, rows).
        standard_deviation: of that force [N]; infinite where a single draw converged.
        used: draws that converged in a row; in the first-order band 1 where the one compaction did, else 0.
        not_monotone: the most particles whose force falls on loading, over all draws used.
        compaction: rows of the compaction at the mean of the draws (first order only).
        sensitivity: of that compaction (first order only).
        forces: of every draw [N], NaN where it did not converge, (draws, rows) (by draws only).
    """

    height: np.ndarray
    density: np.ndarray
    probability: np.ndarray
    quantiles: np.ndarray
    standard_deviation: np.ndarray
    used: np.ndarray
    not_monotone: int
    compaction: Compaction | None = None
    sensitivity: Sensitivity | None = None
    forces: np.ndarray | None = None

    __repr__ = described()


def population_packing(
    calibration: Posterior, diameter: Any, *, seed: int = 0, density: float = MCC_DENSITY
) -> PopulationPacking:
    r"""Spheres whose laws follow the population, :math:`\ln C_i = \mu + \tau z_i`, and alike for the modulus.

    The z of every particle are drawn once and kept, so that a draw of the population moves all particles together:
    the band is about the population, not about which particles one happened to take. Particles not monotone at the
    posterior mean are drawn anew. Effects of the model act in the contacts, but for those of the tester.

    Args:
        calibration: the posterior.
        diameter: [um].
        seed: of the z.
        density: of a particle [kg/m^3].

    Raises:
        InputError: if the population hardly has a monotone law; for effects that contacts cannot have, by name.
    """
    diameter = arguments.path(diameter, "diameter", many="Give one diameter [um] for each sphere.")
    arguments.positive(diameter, "diameter [um]")
    seed = arguments.seed(seed)
    density = arguments.number(density, "density [kg/m^3]", above=0)
    model, p = calibration.model, calibration.population
    forms, varying = model.forms, model.scatter.varying
    last = (p.mu, p.tau, p.theta, p.theta_scatter)
    mu, tau, theta, theta_scatter = (list(np.moveaxis(np.asarray(x, float), -1, 0)) for x in last)
    columns = [p.a, p.log_modulus, *mu, *tau, p.modulus_scatter, p.shape_scatter, *theta, *theta_scatter]
    draws = np.stack([np.asarray(x, float).ravel() for x in columns], axis=1)
    names = ("a", "ln Ebar", "mu1", "mu3", "mu5", "tau1", "tau3", "tau5", "scatter of ln Ebar", "scatter of a")
    names += (*forms.names, *(f"scatter of {name}" for name in model.varying_places))
    size = jnp.asarray(diameter, float)
    own = Scatter(modulus=True, shape=True, power=model.shape_power, varying=varying)

    def laws(values: Array, z: Array) -> MccLaw:
        numbers = jnp.split(values[10:], [len(forms.names)])
        population = Population(
            values[0], values[1], values[2:5], values[5:8], values[8], values[9], jnp.zeros(()), *numbers
        )
        particles = particles_at(population, jnp.zeros(len(z)), own, z)

        def one(latent: Array, theta: Array) -> MccLaw:
            C, modulus = jnp.exp(latent[:3]), jnp.exp(latent[3])
            forms_of = model.unloading, model.strain_scaling, forms.build(theta)
            return MccLaw(Plastic(C[0], C[1], C[2]), values[0], modulus, *forms_of).of_particle()

        return eqx.filter_vmap(one)(particles.latent, particles.theta)

    rng = np.random.default_rng(seed)
    z = rng.standard_normal((len(size), own.size))
    for _ in range(REDRAWS):
        wrong = ~np.asarray(
            eqx.filter_vmap(lambda law: law.is_monotone)(laws(jnp.asarray(draws.mean(0)), jnp.asarray(z)))
        )
        if not wrong.any():
            break
        z[wrong] = rng.standard_normal((int(wrong.sum()), own.size))
    else:
        raise InputError(
            f"{REDRAWS} draws of a particle's law, none monotone", remedy="The calibrated scatter is too large."
        )
    kept = jnp.asarray(z)

    def packing_of(values: Array) -> Packing:
        return spheres(laws(values, kept), size, density)

    packing_of(jnp.asarray(draws.mean(0)))  # refuses here, by name, effects that no contact can have
    return PopulationPacking(packing_of, draws, names)


def first_order_band(
    packing_of: PackingOf,
    draws: Float[np.ndarray, "draws parameters"],
    state: State,
    heights: Float[np.ndarray, " rows"],
    *,
    probability: Sequence[float] = PROBABILITY,
    solver: Solver | None = None,
) -> Band:
    r"""Band from one compaction at the mean of the draws and its sensitivities (delta method).

    .. math:: F_p = F(\bar\theta) + z_p\,\sqrt{J \Sigma J^T}, \qquad J = \partial F / \partial\theta

    Args:
        packing_of: the packing as a function of the parameters.
        draws: of the parameters.
        state: where the compaction starts.
        heights: of the top punch [m].
        probability: of the quantiles.
        solver: as for `compact`.

    Raises:
        InputError: as `compact`; if a probability is not between 0 and 1, or there are fewer than two draws.
    """
    draws = _checked(draws, probability)
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
        found.converged.astype(int),
        int(not_monotone(packing).sum()),
        compaction=rows,
        sensitivity=found,
    )


def band_by_draws(
    packing_of: PackingOf,
    draws: Float[np.ndarray, "draws parameters"],
    state: State,
    heights: Float[np.ndarray, " rows"],
    *,
    probability: Sequence[float] = PROBABILITY,
    solver: Solver | None = None,
) -> Band:
    """Band from one whole compaction for each draw: no linearisation, snaps and all.

    Arguments as for `first_order_band`; give some tens of draws, each costs a compaction.

    Raises:
        InputError: as `first_order_band`, and if no draw converged in a row.
    """
    draws = _checked(draws, probability)
    packings = [packing_of(jnp.asarray(values)) for values in draws]
    every = [compact(packing, state, heights, solver)[1] for packing in packings]
    wrong = max(int(not_monotone(packing).sum()) for packing in packings)
    # A row that did not settle hands its history on.
    forces = np.stack([np.where(np.logical_and.accumulate(rows.converged), rows.top, np.nan) for rows in every])
    rows = every[0]
    used = np.isfinite(forces).sum(axis=0)
    if (used == 0).any():
        raise InputError(
            f"no draw converged at the height {rows.height[np.argmin(used)]:.6g} m",
            remedy="Smaller load steps, or more halvings (`Solver.halvings`).",
        )
    return Band(
        rows.height,
        rows.density,
        np.asarray(probability, float),
        np.nanquantile(forces, np.asarray(probability, float), axis=0),
        _deviation(forces),
        used,
        wrong,
        forces=forces,
    )


def _deviation(forces: np.ndarray) -> np.ndarray:
    """Standard deviation of the draws that converged; nothing is known of it from one."""
    used = np.isfinite(forces).sum(axis=0)
    spread = np.nansum((forces - np.nanmean(forces, axis=0)) ** 2, axis=0)
    return np.where(used > 1, np.sqrt(spread / np.maximum(used - 1, 1)), np.inf)


def _checked(draws: np.ndarray, probability: Sequence[float]) -> np.ndarray:
    draws = arguments.floats(draws, "draws", shape="a table with one row for each draw")
    if draws.ndim != 2 or len(draws) < 2 or not np.isfinite(draws).all():
        raise InputError("draws that are not a table of two or more finite rows", remedy="One row for each draw.")
    if not all(0 < p < 1 for p in probability):
        raise InputError(f"a probability outside 0 to 1 in {tuple(probability)}", remedy="For example 0.05, 0.5, 0.95.")
    return draws
