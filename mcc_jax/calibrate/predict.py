"""What follows from the draws of a posterior: curves of measured and of new particles, laws, and ArviZ data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import arguments
from .._errors import InputError
from .._format import described
from ..campaign import PAPER_EFFECTIVE_MODULUS_MPA, PAPER_LOG_C, PAPER_SHAPE_PARAMETER
from ..effects import Record
from ..geometry import Particle
from ..law import MccLaw, Plastic
from .draws import coordinates_of, named_population
from .estimates import summary
from .noise import Whitening
from .numpyro_model import Model
from .population import COEFFICIENTS, Population, flattened
from .priors import population_sites
from .results import PosteriorDraws
from .running import compiled

if TYPE_CHECKING:
    from xarray import DataTree

VARIABLES: dict[str, tuple[str, list[str]]] = {
    "effective_modulus_MPa": ("MPa", []),
    "mu": ("1", ["coefficient"]),
    "tau": ("1", ["coefficient"]),
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
"""Unit and dimensions of the variables; of all others "1" and none."""

CURVES = 50  # per chain and particle that are predicted
POINTS = 2_000_000  # most points of all curves together: of large campaigns the first particles only
PRIOR_DRAWS = 500


@dataclass(frozen=True)
class PredictedCurves:
    """Draws of one particle's displacement along a path of forces.

    Attributes:
        force_mN: the path [mN], shape (n,).
        displacement_um: draws without read-out noise [um], shape (draws, n).
        observed_um: the same with noise, None where noise was not asked for.
        laws: the law of each draw, every array field with a leading axis.
    """

    force_mN: np.ndarray
    displacement_um: np.ndarray
    observed_um: np.ndarray | None
    laws: MccLaw

    __repr__ = described()

    def band(self, share: float = 0.95, *, observed: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper end of the central interval that holds `share` of the draws at each force [um]."""
        share = arguments.number(share, "the share", above=0, below=1)
        draws = self.observed_um if observed else self.displacement_um
        if draws is None:
            raise InputError("these curves were drawn without noise")
        low, high = np.quantile(draws, [(1 - share) / 2, (1 + share) / 2], axis=0)
        return low, high


@compiled
def _paths(laws: MccLaw, particle: Particle, force: Array, time: Array) -> Array:
    """Displacement [um] of one particle along a clean path, by each of many laws."""
    return jax.lax.map(lambda law: law.path_load(particle, law.init(particle), force, time)[1], laws)


@compiled
def predicted_by(laws: MccLaw, particle: Particle, record: Record) -> Array:
    """Displacement [um] of one particle along its measured test, by each of many laws."""
    return jax.lax.map(lambda law: law.respond(particle, record), laws)


@compiled
def _noise(filters: Whitening, key: Array, count: int) -> Array:
    """Draws of a test's noise [um]; of points that do not count as large as usual."""

    def one(key: Array) -> Array:
        keys = jax.random.split(key, 3)
        white, of_branches, of_zero = (jax.random.normal(k, filters.peak.shape) for k in keys)
        return jnp.where(filters.mask, filters.colour(white, of_branches, of_zero[0]), usual * white)

    variance = jnp.where(filters.mask, filters.solver.matrix.diag.d, jnp.nan)
    usual = jnp.sqrt(jnp.nanmedian(variance))
    return jax.lax.map(one, jax.random.split(key, count))


def laws_with(model: Model, C: Any, a: Any, modulus: Any, theta: Any) -> MccLaw:
    """Laws with these numbers, every array field with a leading axis."""

    def one(C: Any, a: Any, E: Any, theta: Any) -> MccLaw:
        plastic = Plastic(C[0], C[1], C[2])
        return MccLaw(plastic, a, E, model.unloading, model.strain_scaling, effects=model.forms.build(theta))

    return eqx.filter_vmap(one)(*(jnp.asarray(x) for x in (C, a, modulus, theta)))


def sample_laws(calibration: PosteriorDraws, count: int, *, seed: int = 0) -> MccLaw:
    """Laws of `count` particles never measured: one posterior draw of the population each.

    They carry both the scatter of the particles and the uncertainty of the population, in one law whose array fields
    have a leading axis. Laws that are not monotone are kept, as the population has them (see `MccLaw.is_monotone`).
    """
    count = arguments.whole(count, "count", least=1)
    rng = np.random.default_rng(arguments.seed(seed))
    p = flattened(calibration.population)
    pick = rng.integers(len(p.a), size=count)
    C = np.exp(p.mu[pick] + p.tau[pick] * rng.standard_normal((count, 3)))
    a = p.a[pick] + p.shape_scatter[pick] * rng.standard_normal(count)
    modulus = np.exp(p.log_modulus[pick] + p.modulus_scatter[pick] * rng.standard_normal(count))
    theta = np.array(p.theta[pick])
    for j, (k, signed) in enumerate(calibration.model.scatter.varying):
        own = p.theta_scatter[pick, j] * rng.standard_normal(count)
        theta[:, k] = theta[:, k] + own if signed else theta[:, k] * np.exp(own)
    return laws_with(calibration.model, C, a, modulus, theta)


def predict_new_particle(
    calibration: PosteriorDraws,
    diameters_um: Any,
    force_mN: Any,
    time_s: Any = None,
    *,
    count: int = 500,
    seed: int = 0,
) -> PredictedCurves:
    """Draws of the curve of a particle that was never measured.

    Args:
        calibration: the posterior.
        diameters_um: its D1, D2, D3 [um].
        force_mN: path of forces, loading and unloading [mN], shape (n,).
        time_s: times of the same points [s], for effects that depend on time; none passes if None.
        count, seed: number of draws, and the seed of their random numbers.

    Raises:
        InputError: for diameters that are not positive, or a path that is none.
    """
    sizes = arguments.one_particle(diameters_um)
    force = np.asarray(arguments.path(force_mN, "force_mN"), float)
    arguments.finite(force, "force_mN")
    time = np.zeros(len(force)) if time_s is None else np.asarray(arguments.path(time_s, "time_s"))
    arguments.same_length(force_mN=force, time_s=time)
    laws = sample_laws(calibration, count, seed=seed)
    paths = _paths(laws, Particle(*sizes), jnp.asarray(force), jnp.asarray(time))
    return PredictedCurves(force, np.asarray(paths), None, laws)


def predict_measured(calibration: PosteriorDraws, particle: str, *, count: int = 200, seed: int = 0) -> PredictedCurves:
    """Draws of a measured particle's curve at its measured forces, its zero included, without and with noise. Raises
    `InputError` if the particle did not take part."""
    count = arguments.whole(count, "count", least=1)
    seed = arguments.seed(seed)
    if particle not in calibration.particles:
        known = ", ".join(calibration.particles)
        raise InputError(f"particle {arguments.shown(particle)} did not take part", remedy=f"There are: {known}.")
    row = calibration.particles.index(particle)
    chains, draws = calibration.zero_um.shape[:2]
    pick = np.random.default_rng(seed).choice(chains * draws, size=min(count, chains * draws), replace=False)
    return predicted_at(calibration, row, pick, seed)


def predicted_at(calibration: PosteriorDraws, row: int, pick: np.ndarray, seed: int) -> PredictedCurves:
    """As `predict_measured`, of the row-th particle at chosen draws of all chains in a row."""
    c, length = calibration, len(calibration.selection.rows[row])
    of_particle = (x[:, :, row] for x in (c.C, c.modulus_MPa, c.theta, c.zero_um))
    C, modulus, theta, zero, a, log_noise = (
        flattened(np.asarray(x))[pick] for x in (*of_particle, c.population.a, c.population.log_noise)
    )
    laws = laws_with(c.model, C, a, modulus, theta)
    test, filters = jax.tree.map(lambda x: x[row], (c.selection.tests, c.fit.filters))
    clean = np.asarray(predicted_by(laws, test.particle, test.record)) + zero[:, None]
    noise = np.asarray(_noise(filters, jax.random.key(seed), len(pick)))
    observed = clean + np.exp(log_noise)[:, None] * noise
    return PredictedCurves(np.asarray(test.force)[:length], clean[:, :length], observed[:, :length], laws)


def compare_with_paper(calibration: PosteriorDraws) -> list[dict[str, Any]]:
    """The paper's Table 2, a and modulus next to ours: one row per quantity, with mean, sd and interval of ours."""
    named = calibration.named_population()
    paper: dict[str, float | None] = {"a": PAPER_SHAPE_PARAMETER}
    printed = calibration.model.unloading.value == "printed"
    paper["effective_modulus_MPa"] = PAPER_EFFECTIVE_MODULUS_MPA if printed else None
    for name in COEFFICIENTS:
        paper[f"mu_{name}"], paper[f"tau_{name}"] = PAPER_LOG_C[name]
    return [{"quantity": name, "paper": value, **summary(named[name])} for name, value in paper.items()]


def prior_draws(calibration: PosteriorDraws, count: int, seed: int) -> dict[str, np.ndarray]:
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


def data_tree(c: Any, seed: int) -> DataTree:
    """What `Posterior.to_arviz` gives."""
    from arviz_base import from_dict

    prior = prior_draws(c, PRIOR_DRAWS, arguments.seed(seed))
    tests, mask, varying = c.selection.tests, np.asarray(c.selection.tests.mask), c.model.varying_places
    posterior: dict[str, Any] = _variables(c.population, c.model) | {"yield_stress_MPa": c.yield_stress_MPa()}
    posterior |= {"C": c.C, "zero_um": c.zero_um, "eta_p": c.shape_factor}
    if c.model.modulus_scatter:
        posterior["particle_modulus_MPa"] = c.modulus_MPa
    posterior |= {f"particle_{name}": c.theta[..., k] for name, k in varying.items()}
    known = coordinates_of(flattened(c.population), c.model)
    sites = population_sites(c.model, np.asarray(c.fit.tests.flatness), known)
    groups = {
        "posterior": posterior,
        "log_likelihood": {"test": c.log_likelihood},
        "log_prior": {name: values.reshape(len(c.C), -1) for name, values in sites.log_densities().items()},
        "sample_stats": {"lp_test": c.log_likelihood.sum(-1)},
        "prior": prior,
        "observed_data": {"displacement_um": np.where(mask, np.asarray(tests.displacement), np.nan)},
        "constant_data": {
            "force_mN": np.asarray(tests.force),
            "diameters_um": c.campaign.diameters_um[list(c.selection.kept)],
            "mask": mask,
            "points": mask.sum(1),
            "pareto_k": c.pareto_k,
        },
    }
    dims = {name: dimensions for name, (_, dimensions) in VARIABLES.items() if dimensions}
    dims |= {f"particle_{name}": ["particle"] for name in varying}
    coords: dict[str, Any] = {"particle": list(c.particles), "point": np.arange(mask.shape[1])}
    tree = from_dict(groups, coords=coords | {"coefficient": list(COEFFICIENTS), "axis": ["D1", "D2", "D3"]}, dims=dims)
    predicted, before = _predictive(c, prior, seed)
    curves = from_dict(
        {"posterior_predictive": {"displacement_um": predicted}, "prior_predictive": {"displacement_um": before}},
        coords=coords | {"particle": list(c.particles[: predicted.shape[2]])},
        dims={"displacement_um": dims["displacement_um"]},
    )
    for group in ("posterior_predictive", "prior_predictive"):
        tree[group] = curves[group]
    units = {name: unit for name, (unit, _) in VARIABLES.items()} | {v.mechanism: v.unit for v in c.model.effects}
    units |= {f"{v.mechanism}.{n.name}": n.name.rpartition("_")[2] for v in c.model.effects for n in v.nuisances}
    for group in tree.children.values():
        for name, variable in group.data_vars.items():
            variable.attrs["units"] = units.get(str(name), "nat" if group.name == "log_prior" else "1")
    form = {"unloading": c.model.unloading.value, "strain_scaling": c.model.strain_scaling.value}
    made = {"method": "bayes", "mode": c.mode, "seed": c.seed, "converged": str(c.converged)}
    tree.attrs.update(made | form | {"effects": ", ".join(c.model.variants), "divergences": c.divergences})
    # The time of day would make two runs of one seed differ.
    for group in tree.subtree:
        group.attrs.pop("created_at", None)
    return tree


def _predictive(c: PosteriorDraws, prior: dict[str, np.ndarray], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draws of the first particles' displacements by posterior and prior, enough for a picture; NaN where masked."""
    mask = np.asarray(c.selection.tests.mask)
    chains, draws = c.C.shape[:2]
    shown = max(1, min(len(mask), POINTS // (chains * CURVES * mask.shape[1])))
    pick = np.arange(chains * draws).reshape(chains, draws)[:, :: -(-draws // CURVES)]
    predicted = np.full((*pick.shape, shown, mask.shape[1]), np.nan, np.float32)
    before = np.full((1, CURVES, shown, mask.shape[1]), np.nan, np.float32)
    for row in range(shown):
        curves = predicted_at(c, row, pick.ravel(), seed + row).observed_um
        assert curves is not None
        length = curves.shape[1]
        predicted[:, :, row, :length] = np.where(mask[row, :length], curves.reshape(*pick.shape, length), np.nan)
        before[0, :, row] = np.where(mask[row], _prior_curves(c, prior, row, CURVES, seed), np.nan)
    return predicted, before


def _prior_curves(c: PosteriorDraws, prior: dict[str, np.ndarray], row: int, count: int, seed: int) -> np.ndarray:
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
