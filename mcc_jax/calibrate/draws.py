"""The fit that samplers start from, and the draws of a posterior by the names of its attributes."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Bool, Float
from numpyro.infer.util import constrain_fn

from .._format import table, with_sd
from ..arguments import is_traced
from .data import Tests
from .forward import Point
from .importance import diagnostics, sample_weighted
from .marginal import Marginal, ParticleDraw
from .mode import LogPosterior, coordinate_names, handlers, log_densities, populations, seeded
from .noise import NoiseFit, Whitening, standard_promotion
from .numpyro_model import Model, coefficients
from .particle_fit import ParticleFits
from .particles import ExactLikelihood, Length, are_many, corrected, some_of, weighted
from .population import COEFFICIENTS, Population
from .running import compiled

# Acceptance that NUTS aims at. Where spreads are small the density of the population parameters is narrow (a funnel),
# and with fewer than some ten particles the usual 0.8 lets trajectories diverge there.
ACCEPT = 0.99
# Of NUTS where importance sampling failed. Around its mode, in coordinates scaled by the curvature there, a density
# that is near normal takes 15 leapfrog steps a draw; one that needs over 31 would take minutes, and shows in R-hat.
FALLBACK_ACCEPT, TREE_DEPTH = 0.95, 5
DEFAULT_DEPTH = 10  # NumPyro's
INDEPENDENT = {"divergences": 0, "leapfrogs": 0.0}  # of draws without a sampler


class Fit(eqx.Module):
    """Particles, noise and population of a campaign in agreement.

    Attributes:
        model: what was assumed.
        tests: the measurements.
        individual: every particle on its own.
        noise: the noise of every particle.
        filters: those that whiten it at the point.
        point: most probable numbers of every particle.
        residual: measured less predicted displacement there [um], 0 where masked.
        marginal: the tests there, with every particle's own numbers integrated out.
        mode, covariance: of the population in unbounded coordinates, in the order of `names`.
        converged: for particles, noise and population in turn.
    """

    model: Model = eqx.field(static=True)
    tests: Tests
    individual: ParticleFits
    noise: NoiseFit
    filters: Whitening
    point: Point
    residual: Float[Array, "particles points"]
    marginal: Marginal
    mode: Float[Array, " d"]
    covariance: Float[Array, "d d"]
    converged: Bool[np.ndarray, " 3"]

    def __repr__(self) -> str:
        if is_traced(self.mode):
            return "Fit while JAX traces it"
        sd = np.sqrt(np.diag(np.asarray(self.covariance)))
        numbers = zip(self.names, np.asarray(self.mode), sd, strict=True)
        rows = [(name, with_sd({"value": float(value), "sd": float(s)})) for name, value, s in numbers]
        state = "converged" if self.converged.all() else "NOT converged"
        effects = ", ".join(variant.label for variant in self.model.effects) or "no effects"
        return table(f"Fit of {len(self.tests)} particles, {effects}, {state}; in unbounded coordinates", rows)

    @property
    def target(self) -> LogPosterior:
        """The density of the population given all tests, in unbounded coordinates."""
        return LogPosterior.of(self.model, self.marginal)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return coordinate_names(self.model)

    @property
    def population(self) -> Population:
        """The most probable population."""
        return self.target.population(self.mode)

    def nuts(self, *, explicit: bool = False, **settings: Any) -> Any:
        """NumPyro's NUTS for the model, from the mode on, in coordinates in which the covariance there is the identity.

        Run it with `MCMC(fit.nuts(), ...).run(key, tests, fit.marginal)`: every particle is integrated out. With
        `explicit`, every particle's own numbers are sampled under the exact likelihood, in coordinates in which they
        mix; run it with `MCMC(fit.nuts(explicit=True), ...).run(key, tests)`. Settings are those of
        `numpyro.infer.NUTS`.
        """
        from numpyro.infer import NUTS, init_to_value

        coordinates = FitCoordinates(self, explicit=explicit)
        start = init_to_value(values={"coordinates": jnp.zeros(coordinates.size)})
        model = partial(FitCoordinates.numpyro_model, coordinates)
        return NUTS(model, **{"target_accept_prob": ACCEPT, **settings}, init_strategy=start)


def exact_likelihood(fit: Fit) -> ExactLikelihood:
    """The tests of a fit with their exact likelihood."""
    mean, sd = fit.model.zero_prior
    return ExactLikelihood(fit.tests, fit.filters, fit.marginal, (mean, sd), fit.model.forms)


def draw_fast(key: Array, fit: Fit, length: Length, block: int, *, fallback: bool) -> dict[str, Any]:
    """The population sampled, the particles drawn back and corrected by exact weights. NUTS takes over from poor
    weights only with `fallback` and of a fit that converged: else it would take minutes."""
    exact, target, many = exact_likelihood(fit), fit.target, are_many(len(fit.tests), length)
    population_key, *keys = jax.random.split(key, 4)
    shape: dict[str, Any] = {"chains": length.chains, "draws": length.draws, "many": many}
    drawn = sample_weighted(population_key, fit.mode, fit.covariance, target, **shape)
    population, good, integral, error, nuts = drawn.population, drawn.good, drawn.log_evidence, drawn.error, INDEPENDENT
    if not good:  # the integral by Laplace's method
        volume = 0.5 * np.linalg.slogdet(2 * np.pi * np.asarray(fit.covariance))[1] + len(target.signed()) * np.log(2)
        integral, error = float(log_densities(np.asarray(fit.mode)[None], target)[0] + volume), np.inf
        if fallback and np.all(fit.converged[1:]):
            coordinates = FitCoordinates(fit, explicit=False)
            position, nuts = _nuts(population_key, coordinates, length, FALLBACK_ACCEPT, TREE_DEPTH)
            population = jax.tree.map(np.asarray, populations(jax.vmap(coordinates.free)(position), target))
            good = True
    given = exact, block, population, length, keys
    if many:
        found = corrected(*given, _stack(population, fit, length)[1].reshape(length.total, -1))
    else:
        found = weighted(*given)
    population = some_of(population, found.chosen)
    value = integral + found.log_ratio[0] + float(fit.noise.log_evidence)
    return _collected(population, found.particles[:4], fit, length, found.keep) | {
        **nuts,
        "pareto_k": found.k,
        "pareto_k_joint": found.k_joint if good else np.inf,
        "weights_applied": not many,
        "log_evidence": (value, float(np.hypot(error, found.log_ratio[1]))),
        "notes": found.notes,
    }


def draw_joint(key: Array, fit: Fit, length: Length) -> dict[str, Any]:
    """Population and particles sampled together by NumPyro's NUTS under the exact likelihood."""
    coordinates = FitCoordinates(fit, explicit=True)
    position, nuts = _nuts(key, coordinates, length, ACCEPT, DEFAULT_DEPTH)
    population, *particles = jax.tree.map(np.asarray, _explicit(position, coordinates))
    unweighted = {"pareto_k": np.zeros(len(fit.tests)), "pareto_k_joint": None, "weights_applied": False}
    return _collected(population, particles, fit, length) | unweighted | nuts


class FitCoordinates(eqx.Module):
    """The model's density in the coordinates of a fit, near standard normal: widths over five powers of ten do not mix.
    With `exact`, every particle has its random effects, under the exact likelihood; else they are integrated out."""

    target: LogPosterior
    mode: Array
    covariance: Array
    exact: ExactLikelihood | None

    def __init__(self, fit: Fit, *, explicit: bool) -> None:
        self.target, self.mode, self.covariance = fit.target, fit.mode, fit.covariance
        self.exact = exact_likelihood(fit) if explicit else None

    @property
    def size(self) -> int:
        """Number of the coordinates."""
        own = 0 if self.exact is None else len(self.exact.tests) * (self.target.marginal.scatter.size + 1)
        return len(self.mode) + own

    def free(self, position: Array) -> Array:
        """Unbounded coordinates of the population."""
        return self.mode + jnp.linalg.cholesky(self.covariance) @ position[: len(self.mode)]

    def particles(self, position: Array) -> tuple[Population, ParticleDraw]:
        """Population, and particles under it."""
        assert self.exact is not None
        population = self.target.population(self.free(position))
        own = position[len(self.mode) :].reshape(len(self.exact.tests), -1)
        return population, self.exact.marginal.draw(population, own[:, :-1], own[:, -1])

    def log_density(self, position: Array) -> Array:
        """Log density, up to a constant."""
        if self.exact is None:
            return self.target.log_density(self.free(position))
        population, drawn = self.particles(position)
        each = self.exact.log_likelihood(population, drawn) + drawn.log_volume
        return self.target.log_prior(self.free(position)) + jnp.sum(each) - 0.5 * jnp.sum(drawn.deviations**2)

    def numpyro_model(self, tests: Tests, marginal: Marginal | None = None) -> None:
        """The same as a NumPyro model, called as `Model`: every site of the model is a `deterministic`."""
        target, improper = self.target, dist.ImproperUniform(dist.constraints.real, (), (self.size,))
        position: Any = numpyro.sample("coordinates", improper)
        with handlers.block():  # the population is evaluated here, and adds no sites of its own
            prior: Any = (seeded(target.model.population), (target.marginal,), {}, target.sites(self.free(position)))
            values = constrain_fn(*prior, return_deterministic=True)
            density = self.log_density(position)
            if self.exact is not None:
                population, drawn = self.particles(position)
                values |= {"C": coefficients(drawn.latent, population, tests.flatness), "zero_um": drawn.zero}
        numpyro.factor("density", density)
        for name, value in values.items():
            numpyro.deterministic(name, value)


@compiled
def _explicit(positions: Array, coordinates: FitCoordinates) -> tuple[Any, ...]:
    """Populations and particles at draws of the coordinates."""

    def one(position: Array) -> tuple[Any, ...]:
        population, drawn = coordinates.particles(position)
        return population, drawn.latent, drawn.theta, drawn.zero, drawn.log_likelihood

    return jax.lax.map(one, positions)


def _nuts(
    key: Array, coordinates: FitCoordinates, length: Length, accept: float, depth: int
) -> tuple[Array, dict[str, Any]]:
    """Draws of the coordinates by NUTS, all chains in a row; divergences, and leapfrog steps a draw."""
    keys = jax.random.split(key, length.chains)
    z, divergent, steps = _chains(keys, coordinates, length.warmup, length.draws, accept, depth)
    return z.reshape(-1, coordinates.size), {"divergences": int(np.sum(divergent)), "leapfrogs": float(np.mean(steps))}


@compiled
def _chains(
    keys: Array, coordinates: FitCoordinates, warmup: int, draws: int, accept: float, depth: int
) -> tuple[Array, Array, Array]:
    """Draws of all chains, which diverged, and leapfrog steps. NumPyro's `MCMC` compiles for every data set."""
    from numpyro.infer import NUTS

    def potential(z: Array) -> Array:
        value = -coordinates.log_density(z)
        return jnp.where(jnp.isnan(value), jnp.inf, value)

    def chain(key: Array) -> tuple[Array, Array, Array]:
        kernel = NUTS(potential_fn=potential, target_accept_prob=accept, max_tree_depth=depth)
        start_key, key = jax.random.split(key)
        start = jax.random.normal(start_key, (coordinates.size,), coordinates.mode.dtype)
        state = kernel.init(key, warmup, start, (), {})

        def advance(state: Any, _: None) -> tuple[Any, tuple[Array, Array, Array]]:
            state = kernel.sample(state, (), {})
            return state, (state.z, state.diverging, state.num_steps)

        # One loop for warm-up and draws, so that the sampler is compiled once.
        _, found = jax.lax.scan(advance, state, None, length=warmup + draws)
        return jax.tree.map(lambda x: x[warmup:], found)

    with standard_promotion():
        return jax.vmap(chain)(keys)


def _collected(population: Population, particles: Any, fit: Fit, length: Length, keep: int = 1) -> dict[str, Any]:
    """What the draws of both modes have in common; of the population every `keep`-th draw of each chain."""

    def by_chain(x: Any) -> np.ndarray:
        return np.reshape(x, (length.chains, len(x) // length.chains, *x.shape[1:]))

    rhat, bulk, tail = diagnostics(*_stack(population, fit, length))
    kept = jax.tree.map(lambda x: by_chain(x)[:, ::keep], population)
    latent, theta, zero, likelihood = (by_chain(np.asarray(x)) for x in particles)
    eta = 1 + kept.a[..., None] * np.asarray(fit.marginal.flatness)
    log_eta = np.log(eta)
    return {
        "population": kept,
        # What scatter of `a` there is has gone into b alone; a particle's coefficients are those under the common a.
        "C": np.exp(latent[..., :3] - log_eta[..., None]),
        "modulus_MPa": np.exp(latent[..., 3] - fit.model.shape_power * log_eta),
        "zero_um": zero,
        "shape_factor": eta,
        "theta": theta,
        "log_likelihood": likelihood,
        "rhat": rhat,
        "ess_bulk": bulk,
        "ess_tail": tail,
    }


def effect_numbers(population: Population, model: Model) -> dict[str, np.ndarray]:
    """Parameters of the effects by the names of their sites, with the leading axes of the population."""
    theta, spread = np.asarray(population.theta), np.asarray(population.theta_scatter)
    named = {name: theta[..., k] for k, name in enumerate(model.forms.names)}
    return named | {f"tau_{name}": spread[..., j] for j, name in enumerate(model.varying_places)}


def coordinates_of(population: Population, model: Model) -> dict[str, np.ndarray]:
    """Draws of everything that all particles share, in the coordinates that diagnostics are worked out of."""
    p = population
    columns = {"a": p.a, "log_modulus": p.log_modulus}
    columns |= {f"mu_{n}": p.mu[..., j] for j, n in enumerate(COEFFICIENTS)}
    columns |= {f"tau_{n}": p.tau[..., j] for j, n in enumerate(COEFFICIENTS)}
    if model.modulus_scatter:
        columns["modulus_scatter"] = p.modulus_scatter
    if model.shape_scatter:
        columns["shape_scatter"] = p.shape_scatter
    columns |= effect_numbers(p, model)
    columns["noise_factor"] = p.log_noise
    return {name: np.asarray(v) for name, v in columns.items()}


def named_population(population: Population, model: Model) -> dict[str, np.ndarray]:
    """The same by the names used in files: modulus and factor on the noise in place of their logarithms."""
    named = coordinates_of(population, model)
    powers = {"log_modulus": "effective_modulus_MPa", "noise_factor": "noise_factor"}
    return {powers.get(name, name): np.exp(v) if name in powers else v for name, v in named.items()}


def _stack(population: Population, fit: Fit, length: Length) -> tuple[list[str], np.ndarray]:
    columns = coordinates_of(population, fit.model)
    return list(columns), np.stack([v.reshape(length.chains, length.draws) for v in columns.values()], -1)
