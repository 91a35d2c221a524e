"""The posterior as ArviZ data; see `Posterior.to_arviz`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import arguments
from ..law import MccLaw
from .compiling import compiled
from .data import Tests
from .draws import named_population
from .model import Model
from .noise import Whitening, forward_substitution
from .population import COEFFICIENTS, Population, flattened
from .predict import laws_with, predicted_at, predicted_by
from .priors import population_sites

if TYPE_CHECKING:
    from xarray import DataTree

    from .posterior import Posterior

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


def data_tree(c: Posterior, prior_count: int, points: bool, seed: int) -> DataTree:
    """What `Posterior.to_arviz` gives."""
    from arviz_base import from_dict

    prior = prior_draws(c, arguments.whole(prior_count, "prior_count", least=1), arguments.seed(seed))
    if points:
        every = -(-c.C.shape[1] // POINTS_DRAWS)
        names = ("population", "C", "modulus_MPa", "zero_um", "shape_factor", "theta", "log_likelihood")
        thinned = {name: jax.tree.map(lambda x: np.asarray(x)[:, ::every], getattr(c, name)) for name in names}
        c = replace(c, **thinned)
    tests, particles, mask = c.selection.tests, list(c.particles), np.asarray(c.selection.tests.mask)
    posterior: dict[str, Any] = _variables(c.population, c.model) | {
        "yield_stress_MPa": c.yield_stress_MPa(),
        "C": c.C,
        "zero_um": c.zero_um,
        "eta_p": c.shape_factor,
    }
    if c.model.modulus_scatter:
        posterior["particle_modulus_MPa"] = c.modulus_MPa
    posterior |= {f"particle_{name}": c.theta[..., k] for name, k in c.model.varying_places.items()}
    sites = population_sites(c.model, np.asarray(c.fit.tests.flatness), flattened(c.population))
    prior_density = {name: values.reshape(len(c.C), -1) for name, values in sites.log_densities().items()}
    shown, predicted, before = _predictive(c, prior, seed, everything=points)
    observed = np.where(mask, np.asarray(tests.displacement), np.nan)
    likelihood: dict[str, Any] = {"test": c.log_likelihood}
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
        likelihood = {"displacement_um": _point_likelihoods(c)[..., mask]}
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
        "sample_stats": {"lp_test": c.log_likelihood.sum(-1)},
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
    c: Posterior, prior: dict[str, np.ndarray], seed: int, *, everything: bool
) -> tuple[int, np.ndarray, np.ndarray]:
    """How many particles are shown, and draws of their displacements by posterior and prior; NaN where masked.

    Of the posterior either draws and particles enough for a picture, or everything.
    """
    mask = np.asarray(c.selection.tests.mask)
    chains, draws = c.C.shape[:2]
    shown, points = mask.shape
    pick = np.arange(chains * draws).reshape(chains, draws)
    if not everything:
        shown = max(1, min(shown, POINTS // (chains * CURVES * points)))
        pick = pick[:, :: -(-draws // CURVES)]
    predicted = np.full((*pick.shape, shown, points), np.nan, np.float32)
    before = np.full((1, CURVES, shown, points), np.nan, np.float32)
    for row in range(shown):
        curves = predicted_at(c, row, pick.ravel(), seed + row).observed_um
        assert curves is not None
        length = curves.shape[1]
        predicted[:, :, row, :length] = np.where(mask[row, :length], curves.reshape(*pick.shape, length), np.nan)
        before[0, :, row] = np.where(mask[row], _prior_curves(c, prior, row, CURVES, seed), np.nan)
    return shown, predicted, before


def _point_likelihoods(c: Posterior) -> np.ndarray:
    """Log density of every reading given those before it and its particle's own numbers, shape (chain, draw, N, n)."""
    a, log_noise = (flattened(np.asarray(x)) for x in (c.population.a, c.population.log_noise))
    found = []
    for row in range(len(c.particles)):
        C, modulus, theta, zero = flattened(tuple(x[:, :, row] for x in (c.C, c.modulus_MPa, c.theta, c.zero_um)))
        laws = laws_with(c.model, C, a, modulus, theta)
        test, noise = jax.tree.map(lambda x, r=row: x[r], (c.fit.tests, c.fit.filters))
        found.append(np.asarray(_one_ahead(laws, jnp.asarray(zero), jnp.asarray(np.exp(log_noise)), test, noise)))
    return np.stack(found, 1).reshape(*c.C.shape[:3], -1)


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
    theta = np.reshape([prior[name][0, pick] for name in c.model.forms.names], (-1, count)).T
    laws = laws_with(c.model, C, prior["a"][0, pick], prior["effective_modulus_MPa"][0, pick], theta)
    test = jax.tree.map(lambda x: x[row], c.fit.tests)
    clean = np.asarray(predicted_by(laws, test.particle, test.record))
    zero = c.model.chosen_priors.zero_um
    return clean + float(test.contact) + zero.mean + zero.sd * rng.standard_normal((count, 1))
