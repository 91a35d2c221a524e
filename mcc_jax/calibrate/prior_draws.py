"""Priors of what all particles share, site by site as `Model.population` has them, with NumPy: nothing is compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from .distributions import Amplitude, SpreadCoordinate, nuisance_moments
from .model import Model
from .population import COEFFICIENTS, Population
from .priors import bounds_of_a


class _Spread(SpreadCoordinate):
    logpdf = SpreadCoordinate.log_prob

    def rvs(self, size: int, random_state: np.random.Generator) -> np.ndarray:
        return self.coordinate(self.prior.sd * np.sqrt(2 * random_state.gamma(self.prior.shape, size=size)))


class _Amplitude(Amplitude):
    logpdf = Amplitude.log_prob

    def rvs(self, size: int, random_state: np.random.Generator) -> np.ndarray:
        drawn = random_state.choice(self.scales, size) * random_state.standard_normal(size)
        return drawn if self.both else np.abs(drawn)


def _visited(visit: Callable[[str, Any, Any], Any], model: Model, flatness: np.ndarray) -> Population:
    """The population of the values that `visit` has of every site, its prior, and its value in a population."""
    from scipy.stats import lognorm, norm, truncnorm  # slow to import, so only where it is used

    prior = model.chosen_priors

    def truncated(mean: float, sd: float, low: float, high: float) -> Any:
        return truncnorm((low - mean) / sd, (high - mean) / sd, mean, sd)

    def spread(name: str, prior: Any, of: Callable[[Population], Any]) -> Any:
        one = _Spread(prior)
        return one.spread(visit(f"{name}_coordinate", one, lambda p: one.coordinate(of(p))))

    a = visit("a", truncated(prior.a.mean, prior.a.sd, *bounds_of_a(flatness)), lambda p: p.a)
    modulus, factor, softening = prior.effective_modulus_MPa, prior.noise_factor, prior.softening
    log_modulus = visit("log_modulus", norm(np.log(modulus.median), modulus.log_sd), lambda p: p.log_modulus)
    shift = np.log1p(a[:, None] * flatness).mean(-1)
    b1 = visit("b1", norm(np.log(prior.C1.median) + shift, prior.C1.log_sd), lambda p: p.mu[:, 0] + shift)
    b5 = visit("b5", norm(np.log(prior.C5.median) + shift, prior.C5.log_sd), lambda p: p.mu[:, 2] + shift)
    middle = (np.log(20 / 9 * softening.median) + b1 + 5 * b5) / 6
    b3 = visit("b3", norm(middle, softening.log_sd / 6), lambda p: p.mu[:, 1] + shift)
    scatters = [np.zeros_like(a)] * 2
    tau = [
        spread(f"tau_{n}", getattr(prior, f"tau_{n}"), lambda p, j=j: p.tau[:, j]) for j, n in enumerate(COEFFICIENTS)
    ]
    for j, name in enumerate(("modulus_scatter", "shape_scatter")):
        if getattr(model, name):
            scatters[j] = spread(name, getattr(prior, name), lambda p, n=name: getattr(p, n))
    theta, further, own = [], [], []
    for v in model.effects:
        unit, k = (v.sign or 1) * v.plausible[0], len(theta)
        theta.append(unit * visit(f"{v.mechanism}_size", _Amplitude(v), lambda p, k=k, unit=unit: p.theta[:, k] / unit))
        for n in v.nuisances:
            mean, sd = nuisance_moments(n)
            law = lognorm(sd, scale=np.exp(mean)) if n.plausible[0] > 0 else truncated(mean, sd, *n.plausible)
            place = len(model.effects) + len(further)
            further.append(visit(f"{v.mechanism}.{n.name}", law, lambda p, k=place: p.theta[:, k]))
        if v.mechanism in model.varying:
            j = len(own)
            own.append(spread(f"tau_{v.mechanism}", model.spread_prior(v), lambda p, j=j: p.theta_scatter[:, j]))
    log_noise = visit("log_noise_factor", norm(np.log(factor.median), factor.log_sd), lambda p: p.log_noise)
    mu, tau = np.stack([b1, b3, b5], -1) - shift[:, None], np.stack(tau, -1)
    numbers, spreads = (np.reshape(x, (-1, len(a))).T for x in (theta + further, own))
    fields = (a, log_modulus, mu, tau, *scatters, log_noise, numbers, spreads)
    return jax.vmap(lambda one: Population(*one))(fields)


def prior_populations(rng: np.random.Generator, count: int, model: Model, flatness: np.ndarray) -> Population:
    """Draws of the population from its prior, every field with a leading axis."""
    return _visited(lambda name, prior, of: prior.rvs(size=count, random_state=rng), model, flatness)


def log_priors(population: Population, model: Model, flatness: np.ndarray) -> dict[str, np.ndarray]:
    """Log density of the prior of every sampled site, at draws of the population with a leading axis."""
    found = {}

    def visit(name: str, prior: Any, of: Callable[[Population], Any]) -> np.ndarray:
        value = of(population)
        found[name] = prior.logpdf(value)
        return value

    _visited(visit, model, flatness)
    return found


def site_values(population: Population, model: Model, flatness: np.ndarray) -> dict[str, float]:
    """Values of the sampled sites at one population; of a spread's coordinate the positive one."""
    found, one = {}, jax.tree.map(lambda x: np.asarray(x)[None], population)

    def visit(name: str, prior: Any, of: Callable[[Population], Any]) -> np.ndarray:
        found[name] = float(of(one)[0])
        return of(one)

    _visited(visit, model, flatness)
    return found
