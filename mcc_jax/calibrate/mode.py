"""The population in coordinates without bounds, given the tests with every particle integrated out: its density, its
mode, and the particles that it expects."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.handlers
from jaxtyping import Array, Float, Int
from numpyro.infer.util import constrain_fn, potential_energy, unconstrain_fn

from .._types import Scalar
from .marginal import Marginal, straighten
from .noise import standard_promotion
from .numpyro_model import Model
from .population import Population
from .running import compiled, padded, side_by_side

handlers: Any = numpyro.handlers

# Found by trial on simulated campaigns (`benchmarks/study_modes.py`).
SHARP = 0.03  # sd of the log of a polynomial's coefficient below which one Newton step integrates a particle out
DENSITIES, DENSITIES_AT_ONCE = 250, 10  # coordinates in one call, and side by side: a part of the former, no remainder
DIFFERENCE = 0.02  # step of differences, in sd: rounding and the series' next term are below 1e-4 of the curvature
MODE_GAIN = 1e-6  # twice the log probability still to gain, by Newton's method, at which the mode is reached
ATTEMPTS = 4  # how often the search for the mode begins again where it stopped


def seeded(model: Any) -> Any:
    """A NumPyro model that may ask for random numbers, all of whose sites are given."""
    return handlers.seed(model, jax.random.key(0))


class Shapes(eqx.Module):
    """Flatness of the particles: what the priors of the population need where there is no `Marginal`."""

    flatness: Float[Array, " particles"]


@cache
def coordinate_names(model: Model) -> tuple[str, ...]:
    """Names of the sites that are sampled when particles are integrated out; all are numbers."""
    names: list[str] = []

    def collect(shapes: Shapes) -> None:
        trace = handlers.trace(seeded(model.population)).get_trace(shapes)
        names.extend(name for name, site in trace.items() if site["type"] == "sample")

    with standard_promotion():
        jax.eval_shape(collect, Shapes(jnp.zeros(2)))  # nothing is computed, so nothing is compiled
    return tuple(names)


class LogPosterior(eqx.Module):
    """The density of the population given all tests, as a function of unbounded coordinates."""

    model: Model = eqx.field(static=True)
    marginal: Marginal

    @classmethod
    def of(cls, model: Model, marginal: Marginal) -> LogPosterior:
        """That of a fit's tests, padded: campaigns of similar size share their programs."""
        longer, weight = padded(marginal)
        return cls(model, replace(longer, weight=jnp.asarray(weight)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return coordinate_names(self.model)

    def signed(self) -> list[int]:
        """Positions of the coordinates that may have either sign for the same spread."""
        return [i for i, name in enumerate(self.names) if name.endswith("_coordinate")]

    def log_density(self, free: Float[Array, " d"]) -> Scalar:
        """Log density given all tests, with its constant."""
        with standard_promotion():
            potential: Any = potential_energy(self.model, (None, self.marginal), {}, self.sites(free))
            return -potential

    def log_prior(self, free: Float[Array, " d"]) -> Scalar:
        """Log density of the population before the tests."""
        with standard_promotion():
            potential: Any = potential_energy(self.model.population, (self.marginal,), {}, self.sites(free))
            return -potential

    @compiled
    def population(self, free: Float[Array, " d"]) -> Population:
        """The population at unbounded coordinates."""
        prior = self.model.population
        with standard_promotion():
            values = constrain_fn(seeded(prior), (self.marginal,), {}, self.sites(free))
            return seeded(handlers.substitute(prior, data=values))(self.marginal)

    def sites(self, free: Array) -> dict[str, Array]:
        """Unbounded coordinates by the names of their sites."""
        return {name: free[i] for i, name in enumerate(self.names)}

    def unconstrain(self, values: dict[str, Any]) -> Float[Array, " d"]:
        """Unbounded coordinates of the sites' values."""
        return _unconstrained(jnp.asarray(np.array([float(values[name]) for name in self.names])), self)


@compiled
def _unconstrained(values: Float[Array, " d"], target: LogPosterior) -> Float[Array, " d"]:
    with standard_promotion():
        prior = seeded(target.model.population)
        free = unconstrain_fn(prior, (target.marginal,), {}, target.sites(values))
    return jnp.stack([jnp.asarray(free[name]) for name in target.names])


class Expected(eqx.Module):
    """The particles under a population, mean and sd of b1, b3, b5, e and of the amplitudes that vary; their most
    probable parameters given the tests; the rest as in `Laplace`."""

    mean: Float[Array, "particles 4"]
    sd: Float[Array, "particles 4"]
    latent: Float[Array, "particles 4"]
    theta: Float[Array, "particles numbers"]
    theta_mean: Float[Array, "particles varying"]
    theta_sd: Float[Array, "particles varying"]
    zero: Float[Array, " particles"]
    hessian: Float[Array, "particles k k"]
    stretch: Float[Array, " k"]


@compiled
def expect(free: Float[Array, " d"], target: LogPosterior) -> Expected:
    """The particles under the population at unbounded coordinates."""
    marginal, population = target.marginal, target.population(free)
    at = marginal.laplace(population)
    none = marginal.place(population, jnp.zeros_like(at.deviations))
    varying = jnp.asarray([k for k, _ in marginal.scatter.varying], int)
    theta_sd = jnp.sqrt(jnp.sum(at.placed.jacobian**2, -1))[:, 4:][:, varying]
    # Without the curvature of the straightened coordinates, which is that of the point.
    _, slope = straighten(none.latent - marginal.point.latent)
    sd = jnp.sqrt(jnp.sum((none.jacobian[:, :4] / slope[..., None]) ** 2, -1))
    zero = marginal.zero + jnp.einsum("np,np->n", marginal.zero_slope, at.placed.u)
    of_population = none.latent, sd, at.placed.latent, at.placed.theta, none.theta[:, varying], theta_sd
    return Expected(*of_population, zero, at.hessian, at.stretch)


def careful_enough(free: Float[Array, " d"], target: LogPosterior, count: int) -> LogPosterior:
    """The target without Newton steps in the integration over the particles, if every coefficient of the first `count`,
    which are no padding, is known sharply; else as it is."""
    scatter = replace(target.marginal.scatter, newton=0)
    sharp = replace(target, marginal=replace(target.marginal, scatter=scatter))
    at = expect(free, sharp)
    variance = np.diagonal(np.linalg.inv(np.asarray(at.hessian)[:count]), axis1=1, axis2=2)
    widest = float(np.max(np.sqrt(variance) * np.asarray(at.stretch)))
    return sharp if widest < SHARP else target


@compiled
def populations(free: Float[Array, "draws d"], target: LogPosterior) -> Population:
    """Populations of many unbounded coordinates, every field with a leading axis."""
    return jax.vmap(target.population)(free)


@compiled
def _log_densities(free: Float[Array, "rows d"], count: Int[Array, ""], target: LogPosterior) -> Float[Array, " rows"]:
    few = DENSITIES_AT_ONCE

    def add(i, found):
        some = jax.vmap(target.log_density)(jax.lax.dynamic_slice_in_dim(free, i * few, few))
        return jax.lax.dynamic_update_slice_in_dim(found, some, i * few, 0)

    return jax.lax.fori_loop(0, -(-count // few), add, jnp.zeros_like(free[:, 0]))


def log_densities(free: np.ndarray, target: LogPosterior) -> np.ndarray:
    """Log density of the population at many coordinates, shape (many, d), on two threads."""

    def some(rows: np.ndarray) -> np.ndarray:
        # Always of one size, so that few and many of them share their compilation.
        filled = jnp.asarray(np.pad(rows, ((0, DENSITIES - len(rows)), (0, 0)), mode="edge"))
        return np.asarray(_log_densities(filled, jnp.asarray(np.asarray(len(rows))), target))[: len(rows)]

    return np.concatenate(side_by_side(some, np.split(free, range(DENSITIES, len(free), DENSITIES))))


@np.errstate(over="ignore", invalid="ignore")  # steps may lead to where numbers overflow; they are refused
def most_probable(
    start: Float[Array, " d"], target: LogPosterior
) -> tuple[Float[Array, " d"], Float[Array, "d d"], bool]:
    """Mode of the population in unbounded coordinates by Newton's method in a trust region, covariance there (NaN where
    the start has no curvature), and whether the optimiser converged."""
    origin = np.asarray(start)
    width = np.full(len(origin), 1e-5)
    value, slope, curvature = expanded(origin, width, target)
    if not all(np.isfinite(part).all() for part in (value, slope, curvature)):
        return jnp.asarray(origin), jnp.asarray(np.full_like(curvature, np.nan)), False
    success = False
    for _ in range(ATTEMPTS):
        unit = _scales(curvature)
        width = DIFFERENCE * np.minimum(unit, 1.0)
        found = _newton(origin, unit, width, target)
        origin, success = origin + unit * found.x, bool(found.success)
        _, slope, curvature = expanded(origin, width, target)
        if success:
            break  # else scales at the start were far from those at the mode, of very exact data: again from there
    # Curvatures differ by many powers of ten: on the scale of each coordinate, what is not convex is taken as wide.
    scale = _scales(curvature)
    values, vectors = np.linalg.eigh(curvature * scale * scale[:, None])
    convex = bool(np.all(values > 1e-7))
    values = np.where(values > 1e-7, values, 0.01)
    covariance = (vectors / values) @ vectors.T * scale * scale[:, None]
    # Rounding may keep the optimiser from its tolerance at the very mode: what counts is what is left to gain.
    there = convex and float(slope @ covariance @ slope) < MODE_GAIN
    return jnp.asarray(origin), jnp.asarray(covariance), success or there


def _scales(curvature: np.ndarray) -> np.ndarray:
    """Standard deviation of each coordinate by itself."""
    return 1 / np.sqrt(np.maximum(np.abs(np.diagonal(curvature)), 1e-8))


def expanded(free: np.ndarray, width: np.ndarray, target: LogPosterior) -> tuple[float, np.ndarray, np.ndarray]:
    """Minus the log density, its gradient and its curvature, from central differences over these widths: a program of
    gradients would take as long to compile as everything else of a fit."""
    d, steps = len(free), np.diag(width)
    i, j = np.triu_indices(d, 1)
    pairs = steps[i] + steps[j]
    value = -log_densities(free + np.concatenate([np.zeros((1, d)), steps, -steps, pairs, -pairs]), target)
    here, (up, down), both = value[0], value[1 : 2 * d + 1].reshape(2, d), value[2 * d + 1 :].reshape(2, -1).sum(0)
    curvature = np.diag((up + down - 2 * here) / width**2)
    mixed = both - (up + down)[i] - (up + down)[j] + 2 * here
    curvature[i, j] = curvature[j, i] = mixed / (2 * width[i] * width[j])
    return float(here), (up - down) / (2 * width), curvature


def _newton(origin: np.ndarray, unit: np.ndarray, width: np.ndarray, target: LogPosterior) -> Any:
    """SciPy's minimum from the origin on, in steps of these units."""
    from scipy.optimize import minimize

    @lru_cache(maxsize=1)  # value, gradient and curvature are asked for one after the other
    def at(z: bytes) -> tuple[float, np.ndarray, np.ndarray]:
        found = expanded(origin + unit * np.frombuffer(z), width, target)
        # A step may lead to where spreads overflow: then it is refused, for which SciPy wants finite derivatives.
        if not all(np.isfinite(part).all() for part in found):
            return np.inf, np.zeros_like(origin), np.eye(len(origin))
        return found

    return minimize(
        lambda z: at(z.tobytes())[0],
        np.zeros_like(origin),
        jac=lambda z: at(z.tobytes())[1] * unit,
        hess=lambda z: at(z.tobytes())[2] * unit * unit[:, None],
        method="trust-exact",
        options={"gtol": 1e-4, "maxiter": 200},
    )
