"""The posterior as ArviZ data, and the file it is kept in."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from .. import arguments
from .population import COEFFICIENTS
from .posterior import BayesCalibration
from .predict import A_CALIBRATION, predict_measured
from .priors import LogNormalPrior, NakagamiPrior, NormalPrior, Priors

if TYPE_CHECKING:
    from xarray import DataTree

UNITS = {
    "a": "1",
    "effective_modulus_MPa": "MPa",
    "mu": "1",
    "tau": "1",
    "modulus_scatter": "1",
    "shape_scatter": "1",
    "noise_factor": "1",
    "yield_stress_MPa": "MPa",
    "C": "1 (MPa^(1/k))",
    "particle_modulus_MPa": "MPa",
    "zero_um": "um",
    "eta_p": "1",
    "displacement_um": "um",
    "force_mN": "mN",
    "diameters_um": "um",
    "test": "nat",
    "mask": "1",
    "pareto_k": "1",
    "lp_test": "nat",
}
PREDICTIVE_DRAWS = 50
"""Curves per chain and particle kept in the predictive groups."""

MAX_PREDICTIVE = 2_000_000
"""At most as many predicted points are kept: of large campaigns the first particles only."""


def prior_draws(priors: Priors, low: float, high: float, shape: tuple[int, int], seed: int) -> dict[str, Any]:
    """Draws of the population from its prior, by the names of the posterior."""
    rng = np.random.default_rng(seed)

    def normal(prior: NormalPrior | LogNormalPrior) -> np.ndarray:
        if isinstance(prior, NormalPrior):
            return prior.mean + prior.sd * rng.standard_normal(shape)
        return np.log(prior.median) + prior.log_sd * rng.standard_normal(shape)

    def spread(prior: NakagamiPrior) -> np.ndarray:
        return prior.sd * np.sqrt(2 * rng.gamma(prior.shape, size=shape))

    from scipy.stats import truncnorm

    bounds = ((low - priors.a.mean) / priors.a.sd, (high - priors.a.mean) / priors.a.sd)
    a = truncnorm.rvs(*bounds, loc=priors.a.mean, scale=priors.a.sd, size=shape, random_state=rng)
    mu_1, mu_5, softening = normal(priors.C1), normal(priors.C5), normal(priors.softening)
    mu_3 = (np.log(20 / 9) + mu_1 + 5 * mu_5 + softening) / 6
    spreads = (priors.tau_C1, priors.tau_C3, priors.tau_C5)
    return {
        "a": a,
        "effective_modulus_MPa": np.exp(normal(priors.effective_modulus_MPa)),
        "mu": np.stack([mu_1, mu_3, mu_5], -1),
        "tau": np.stack([spread(p) for p in spreads], -1),
        "modulus_scatter": spread(priors.modulus_scatter),
        "shape_scatter": spread(priors.shape_scatter),
        "noise_factor": np.exp(normal(priors.noise_factor)),
    }


def to_arviz(calibration: BayesCalibration, *, prior_count: int = 500, seed: int = 0) -> DataTree:
    """The posterior as an ArviZ `DataTree`.

    Groups: `posterior` (population and every particle), `log_likelihood` (variable `test`: each particle's whole test
    given the population, the particle integrated out, so that ArviZ's `loo` leaves one *particle* out),
    `sample_stats` (`lp_test`: their sum), `prior`, `prior_predictive` and `posterior_predictive` (displacement at the
    measured forces),
    `observed_data`, `constant_data`. Every variable has its unit in its attributes. Padded points are NaN.

    Args:
        calibration: the posterior.
        prior_count: draws from the prior.
        seed: random seed of prior and predictive draws.
    """
    from arviz_base import from_dict

    arguments.instance(calibration, BayesCalibration, "calibration", A_CALIBRATION)
    prior_count = arguments.whole(prior_count, "prior_count", least=1)
    seed = arguments.seed(seed)
    c = calibration
    named = c.named_population()
    chains, draws = named["a"].shape
    particles = list(c.particles)
    posterior: dict[str, Any] = {
        "a": named["a"],
        "effective_modulus_MPa": named["effective_modulus_MPa"],
        "mu": np.asarray(c.population.mu),
        "tau": np.asarray(c.population.tau),
        "yield_stress_MPa": c.yield_stress_MPa(),
        "noise_factor": named["noise_factor"],
        "C": c.C,
        "zero_um": c.zero_um,
        "eta_p": c.shape_factor,
    }
    for name in ("modulus_scatter", "shape_scatter"):
        if name in named:
            posterior[name] = named[name]
    if c.model.modulus_scatter:
        posterior["particle_modulus_MPa"] = c.modulus_MPa
    low, high = np.asarray(c.fit.numbers.a)[2:]
    prior = prior_draws(c.model.chosen_priors, float(low), float(high), (1, prior_count), seed)
    prior = {name: values for name, values in prior.items() if name in posterior}

    tests = c.selection.tests
    points = tests.force.shape[1]
    mask = np.asarray(tests.mask)
    shown = max(1, min(len(particles), MAX_PREDICTIVE // (chains * PREDICTIVE_DRAWS * points)))
    some = min(PREDICTIVE_DRAWS, draws)
    predicted = np.full((chains, some, shown, points), np.nan, np.float32)
    before = np.full((1, some, shown, points), np.nan, np.float32)
    for row in range(shown):
        curves = predict_measured(c, particles[row], count=chains * some, seed=seed + row)
        assert curves.observed_um is not None
        length = len(curves.force_mN)
        shaped = curves.observed_um[: chains * some].reshape(chains, some, length)
        predicted[:, :, row, :length] = np.where(mask[row, :length], shaped, np.nan)
        before[0, :, row, :length] = np.where(
            mask[row, :length], _prior_curves(c, prior, row, some, seed)[:, :length], np.nan
        )
    observed = np.where(mask, np.asarray(tests.displacement), np.nan)
    coords = {
        "particle": particles,
        "coefficient": list(COEFFICIENTS),
        "point": np.arange(points),
        "axis": ["D1", "D2", "D3"],
    }
    coords["particle_shown"] = particles[:shown]
    dims = {
        "mu": ["coefficient"],
        "tau": ["coefficient"],
        "C": ["particle", "coefficient"],
        "zero_um": ["particle"],
        "eta_p": ["particle"],
        "particle_modulus_MPa": ["particle"],
        "test": ["particle"],
        "displacement_um": ["particle", "point"],
        "force_mN": ["particle", "point"],
        "diameters_um": ["particle", "axis"],
        "mask": ["particle", "point"],
        "pareto_k": ["particle"],
    }
    tree = from_dict(
        {
            "posterior": posterior,
            "log_likelihood": {"test": c.log_likelihood},
            "sample_stats": {"lp_test": c.log_likelihood.sum(-1)},
            "prior": prior,
            "observed_data": {"displacement_um": observed},
            "constant_data": {
                "force_mN": np.asarray(tests.force),
                "diameters_um": c.campaign.diameters_um[list(c.selection.kept)],
                "mask": mask,
                "pareto_k": c.pareto_k,
            },
        },
        coords=coords,
        dims=dims,
    )
    curves = from_dict(
        {
            "posterior_predictive": {"displacement_um": predicted},
            "prior_predictive": {"displacement_um": before},
        },
        coords={"particle": particles[:shown], "point": np.arange(points)},
        dims={"displacement_um": ["particle", "point"]},
    )
    for group in ("posterior_predictive", "prior_predictive"):
        tree[group] = curves[group]
    for group in tree.children.values():
        for name, variable in group.data_vars.items():
            if str(name) in UNITS:
                variable.attrs["units"] = UNITS[str(name)]
    tree.attrs.update(
        {
            "method": "bayes",
            "mode": c.mode,
            "seed": c.seed,
            "unloading": c.model.unloading.value,
            "strain_scaling": c.model.strain_scaling.value,
            "converged": str(c.converged),
            "divergences": c.divergences,
        }
    )
    # The time of day would make two runs of one seed differ.
    for group in tree.subtree:
        group.attrs.pop("created_at", None)
    return tree


def _prior_curves(c: BayesCalibration, prior: dict[str, np.ndarray], row: int, count: int, seed: int) -> np.ndarray:
    """Curves of the row-th particle from the prior, around its recorded contact."""
    import jax.numpy as jnp

    from ..campaign import particle_batch
    from .predict import _laws, _paths

    rng = np.random.default_rng([seed, row])
    pick = rng.integers(prior["a"].shape[1], size=count)
    C = np.exp(prior["mu"][0, pick] + prior["tau"][0, pick] * rng.standard_normal((count, 3)))
    laws = _laws(c, C, prior["a"][0, pick], prior["effective_modulus_MPa"][0, pick])
    tests = c.selection.tests
    sizes = particle_batch(np.broadcast_to(c.campaign.diameters_um[c.selection.kept[row]], (count, 3)))
    force = np.asarray(tests.force[row])
    clean = np.asarray(_paths(laws, sizes, jnp.asarray(np.broadcast_to(force, (count, len(force))))))
    zero = float(tests.contact[row]) + c.model.chosen_priors.zero_um.sd * rng.standard_normal((count, 1))
    return clean + zero


def write_posterior(calibration: BayesCalibration, file: str | Path) -> None:
    """Write `posterior.nc` (NetCDF 4), readable by `arviz.from_netcdf` and `xarray.open_datatree`.

    Of several processes, which all have the same posterior, only the first one writes.
    """
    arguments.instance(calibration, BayesCalibration, "calibration", A_CALIBRATION)
    file = arguments.file_path(file, "file")
    if jax.process_index() == 0:
        to_arviz(calibration, seed=calibration.seed).to_netcdf(file, engine="h5netcdf")
