"""The posterior as ArviZ data, and the file it is kept in."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import arguments
from .._extras import extra
from ..law import MccLaw
from .compiling import compiled
from .data import Tests
from .draws import named_population
from .model import Model
from .noise import Whitening, forward_substitution
from .population import COEFFICIENTS, Population, flattened
from .posterior import Posterior
from .predict import laws_with, predicted_at, predicted_by
from .priors import population_sites

if TYPE_CHECKING:
    from xarray import DataTree

VARIABLES: dict[str, tuple[str, list[str]]] = {
    "a": ("1", []),
    "effective_modulus_MPa": ("MPa", []),
    "mu": ("1", ["coefficient"]),
    "tau": ("1", ["coefficient"]),
    "modulus_scatter": ("1", []),
    "shape_scatter": ("1", []),
    "noise_factor": ("1", []),
    "yield_stress_MPa": ("MPa", []),
    "C": ("1 (MPa^(1/k))", ["particle", "coefficient"]),
    "particle_modulus_MPa": ("MPa", ["particle"]),
    "zero_um": ("um", ["particle"]),
    "eta_p": ("1", ["particle"]),
    "displacement_um": ("um", ["particle", "point"]),
    "force_mN": ("mN", ["particle", "point"]),
    "diameters_um": ("um", ["particle", "axis"]),
    "test": ("nat", ["particle"]),
    "mask": ("1", ["particle", "point"]),
    "points": ("1", ["particle"]),
    "pareto_k": ("1", ["particle"]),
    "lp_test": ("nat", []),
}
"""Unit and dimensions of the variables."""


CURVES = 50  # per chain and particle that are predicted
POINTS = 2_000_000  # most points of all curves together: of large campaigns the first particles only
POINTS_DRAWS = 250  # per chain that are kept where every point has a likelihood of its own


def prior_draws(calibration: Posterior, count: int, seed: int) -> dict[str, np.ndarray]:
    """Draws of the population from its prior, by the names of the posterior, shape (1, count, ...)."""
    flatness = np.asarray(calibration.fit.tests.flatness)
    rng = np.random.default_rng(seed)
    drawn = population_sites(calibration.model, flatness, None, rng, count).population
    return _variables(jax.tree.map(lambda x: np.asarray(x)[None], drawn), calibration.model)


def _variables(p: Population, model: Model) -> dict[str, np.ndarray]:
    """The population by the names of the model's sites; of ArviZ's `mu` and `tau` all three in one."""
    mu = np.asarray(p.mu)
    named = {name: values for name, values in named_population(p, model).items() if not name.startswith("mu_")}
    medians = {f"{name}_median": np.exp(mu[..., j]) for j, name in enumerate(COEFFICIENTS)}
    return {"mu": mu, "tau": np.asarray(p.tau)} | medians | named


def to_arviz(calibration: Posterior, *, prior_count: int = 500, points: bool = False, seed: int = 0) -> DataTree:
    """The posterior as an ArviZ `DataTree`.

    Groups: `posterior` (population, effects and every particle), `log_likelihood`, `log_prior` (by site), `prior`,
    `prior_predictive` and `posterior_predictive` (displacement at the measured forces), `sample_stats` (`lp_test`),
    `observed_data`, `constant_data`. Every variable has its unit in its attributes.

    `log_likelihood` holds the variable `test`: each particle's whole test given the population, the particle integrated
    out, so that ArviZ's `loo` leaves one *particle* out. With `points` it holds `displacement_um` instead, the density
    of every reading given those before it and its particle's own numbers, along the dimension `observation`, which
    observed data and predictions then share; draws are thinned.

    Args:
        calibration: the posterior.
        prior_count: draws from the prior.
        points: likelihoods by reading.
        seed: random seed of prior and predictive draws.
    """
    from arviz_base import from_dict

    prior_count = arguments.whole(prior_count, "prior_count", least=1)
    seed = arguments.seed(seed)
    points = arguments.flag(points, "points")
    c, tests = calibration, calibration.selection.tests
    particles, mask = list(c.particles), np.asarray(tests.mask)
    chains, draws = np.asarray(c.population.a).shape
    thin = slice(None, None, -(-draws // POINTS_DRAWS) if points else 1)
    population = jax.tree.map(lambda x: np.asarray(x)[:, thin], c.population)
    posterior: dict[str, Any] = _variables(population, c.model) | {
        "yield_stress_MPa": c.yield_stress_MPa()[:, thin],
        "C": c.C[:, thin],
        "zero_um": c.zero_um[:, thin],
        "eta_p": c.shape_factor[:, thin],
    }
    if c.model.modulus_scatter:
        posterior["particle_modulus_MPa"] = c.modulus_MPa[:, thin]
    for name, place in c.model.varying_places.items():
        posterior[f"particle_{name}"] = c.theta[:, thin, :, place]
    sites = population_sites(c.model, np.asarray(c.fit.tests.flatness), flattened(population))
    prior_density = {name: values.reshape(chains, -1) for name, values in sites.log_densities().items()}
    prior = prior_draws(c, prior_count, seed)
    shown, predicted, before = _predictive(c, prior, seed, thin if points else None)
    observed = np.where(mask, np.asarray(tests.displacement), np.nan)
    likelihood: dict[str, Any] = {"test": c.log_likelihood[:, thin]}
    dims = {name: dimensions for name, (_, dimensions) in VARIABLES.items() if dimensions}
    dims |= {f"particle_{name}": ["particle"] for name in c.model.varying_places}
    coords: dict[str, Any] = {
        "particle": particles,
        "coefficient": list(COEFFICIENTS),
        "point": np.arange(mask.shape[1]),
        "axis": ["D1", "D2", "D3"],
    }
    some = coords | {"particle": particles[:shown]}
    if points:
        likelihood = {"displacement_um": _point_likelihoods(c, thin)[..., mask]}
        observed, dims["displacement_um"] = observed[mask], ["observation"]
        coords["observation"], some["observation"] = np.arange(mask.sum()), np.arange(mask[:shown].sum())
        predicted, before = (x[..., mask[:shown]] for x in (predicted, before))
    constant = {
        "force_mN": np.asarray(tests.force),
        "diameters_um": c.campaign.diameters_um[list(c.selection.kept)],
        "mask": mask,
        "points": mask.sum(1),
        "pareto_k": c.pareto_k,
    }
    groups = {
        "posterior": posterior,
        "log_likelihood": likelihood,
        "log_prior": prior_density,
        "sample_stats": {"lp_test": c.log_likelihood[:, thin].sum(-1)},
        "prior": prior,
        "observed_data": {"displacement_um": observed},
        "constant_data": constant,
    }
    tree = from_dict(groups, coords=coords, dims=dims)
    curves = from_dict(
        {"posterior_predictive": {"displacement_um": predicted}, "prior_predictive": {"displacement_um": before}},
        coords={name: some[name] for name in dims["displacement_um"]},
        dims={"displacement_um": dims["displacement_um"]},
    )
    for group in ("posterior_predictive", "prior_predictive"):
        tree[group] = curves[group]
    units = {name: unit for name, (unit, _) in VARIABLES.items()} | {v.mechanism: v.unit for v in c.model.effects}
    units |= {f"{v.mechanism}.{n.name}": n.name.rpartition("_")[2] for v in c.model.effects for n in v.nuisances}
    for group in tree.children.values():
        for name, variable in group.data_vars.items():
            variable.attrs["units"] = units.get(str(name), "nat" if group.name == "log_prior" else "1")
    tree.attrs.update(
        {
            "method": "bayes",
            "mode": c.mode,
            "seed": c.seed,
            "unloading": c.model.unloading.value,
            "strain_scaling": c.model.strain_scaling.value,
            "effects": ", ".join(c.model.variants),
            "converged": str(c.converged),
            "divergences": c.divergences,
        }
    )
    # The time of day would make two runs of one seed differ.
    for group in tree.subtree:
        group.attrs.pop("created_at", None)
    return tree


def _predictive(
    c: Posterior, prior: dict[str, np.ndarray], seed: int, thin: slice | None
) -> tuple[int, np.ndarray, np.ndarray]:
    """How many particles are shown, and draws of their displacements by posterior and prior; NaN where masked.

    Of the posterior either draws and particles enough for a picture, or, thinned, the draws that likelihoods belong to.
    """
    mask = np.asarray(c.selection.tests.mask)
    chains, draws = np.asarray(c.population.a).shape
    points = mask.shape[1]
    shown = len(mask)
    if thin is None:
        shown = max(1, min(shown, POINTS // (chains * CURVES * points)))
        thin = slice(None, None, -(-draws // CURVES))
    pick = np.arange(chains * draws).reshape(chains, draws)[:, thin]
    predicted = np.full((*pick.shape, shown, points), np.nan, np.float32)
    before = np.full((1, CURVES, shown, points), np.nan, np.float32)
    for row in range(shown):
        curves = predicted_at(c, row, pick.ravel(), seed + row)
        assert curves.observed_um is not None
        length = curves.observed_um.shape[1]
        shaped = curves.observed_um.reshape(*pick.shape, length)
        predicted[:, :, row, :length] = np.where(mask[row, :length], shaped, np.nan)
        before[0, :, row] = np.where(mask[row], _prior_curves(c, prior, row, CURVES, seed), np.nan)
    return shown, predicted, before


def _point_likelihoods(c: Posterior, thin: slice) -> np.ndarray:
    """Log density of every reading given those before it and its particle's own numbers, shape (chain, draw, N, n)."""
    tests, filters = c.fit.tests, c.fit.filters
    C, a = c.C[:, thin], np.asarray(c.population.a)[:, thin]
    modulus, zero, theta = c.modulus_MPa[:, thin], c.zero_um[:, thin], c.theta[:, thin]
    factor = np.exp(np.asarray(c.population.log_noise)[:, thin]).reshape(-1)
    found = []
    for row in range(len(c.particles)):
        own_C, own_modulus, own_theta, own_zero = flattened(tuple(x[:, :, row] for x in (C, modulus, theta, zero)))
        laws = laws_with(c.model, own_C, a.reshape(-1), own_modulus, own_theta)
        test, noise = jax.tree.map(lambda x, r=row: x[r], (tests, filters))
        found.append(np.asarray(_one_ahead(laws, jnp.asarray(own_zero), jnp.asarray(factor), test, noise)))
    return np.stack(found, 1).reshape(*a.shape, len(c.particles), -1)


@compiled
def _one_ahead(laws: MccLaw, zero: Array, factor: Array, test: Tests, noise: Whitening) -> Array:
    assert test.displacement is not None
    measured = test.displacement

    def one(given: Any) -> Array:
        law, z, f = given
        away = jnp.where(test.mask, measured - law.respond(test.particle, test.record) - z, 0.0)
        innovation = forward_substitution(noise.solver, away[:, None])[:, 0]
        sd = noise.solver.factor.diag.d * f
        return -0.5 * (innovation / f) ** 2 - jnp.log(sd) - 0.5 * jnp.log(2 * jnp.pi)

    return jax.lax.map(one, (laws, zero, factor))


def _prior_curves(c: Posterior, prior: dict[str, np.ndarray], row: int, count: int, seed: int) -> np.ndarray:
    """Curves of the row-th particle from the prior, around its recorded contact."""
    rng = np.random.default_rng([seed, row])
    pick = rng.integers(prior["a"].shape[1], size=count)
    C = np.exp(prior["mu"][0, pick] + prior["tau"][0, pick] * rng.standard_normal((count, 3)))
    theta = np.zeros((count, len(c.model.forms.names)))
    for k, name in enumerate(c.model.forms.names):
        theta[:, k] = prior[name][0, pick]
    laws = laws_with(c.model, C, prior["a"][0, pick], prior["effective_modulus_MPa"][0, pick], theta)
    test = jax.tree.map(lambda x: x[row], c.fit.tests)
    clean = np.asarray(predicted_by(laws, test.particle, test.record))
    zero = c.model.chosen_priors.zero_um
    return clean + float(test.contact) + zero.mean + zero.sd * rng.standard_normal((count, 1))


def write_posterior(calibration: Posterior, file: str | Path) -> None:
    """Write `posterior.nc` (NetCDF 4), readable by `arviz.from_netcdf` and `xarray.open_datatree`.

    Of several processes, which all have the same posterior, only the first one writes.
    """
    file = arguments.file_path(file, "file")
    with extra("netcdf"):
        import h5netcdf  # noqa: F401
        import h5py  # noqa: F401
    if jax.process_index() == 0:
        to_arviz(calibration, seed=calibration.seed).to_netcdf(file, engine="h5netcdf")
