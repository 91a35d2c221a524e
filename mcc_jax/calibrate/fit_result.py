"""A fit: particles, noise and population in agreement, and the samplers that start from it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Bool, Float
from numpyro.infer.util import constrain_fn, potential_energy

from .. import arguments
from .._format import table, with_sd
from ..arguments import is_traced
from .compiling import compiled
from .data import Tests
from .forward import Point
from .marginal import Marginal
from .mode import LogPosterior, handlers
from .model import Model
from .noise import NoiseFit, Whitening
from .particle_fit import ParticleFits
from .population import Population

# Acceptance that NUTS aims at. Where spreads are small what all particles share is narrow (a funnel), and with fewer
# than some ten particles the usual 0.8 lets trajectories diverge there.
ACCEPT = 0.99


class Fit(eqx.Module):
    """Particles, noise and population of a campaign in agreement.

    Attributes:
        model: what was assumed.
        tests: the measurements.
        individual: every particle on its own.
        noise: the campaign's noise.
        filters: its filters at the point.
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
        return LogPosterior(self.model, self.marginal)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return self.target.names

    @property
    def population(self) -> Population:
        """The most probable population."""
        return population_of(self.mode, self.target)

    def nuts(self, *, explicit: bool = False, **settings: Any) -> Any:
        """NumPyro's NUTS for the model, from the mode on, in coordinates in which the covariance there is the identity.

        Run it with `MCMC(fit.nuts(), ...).run(key, tests, fit.marginal)`: every particle is integrated out. Explicit,
        every particle's own numbers are sampled under the exact likelihood, in the coordinates of this fit, in which
        they mix; run it with `MCMC(fit.nuts(explicit=True), ...).run(key, tests)`.

        Args:
            explicit: sample every particle's own numbers.
            settings: of `numpyro.infer.NUTS`.
        """
        from numpyro.infer import NUTS, init_to_value

        arguments.flag(explicit, "explicit")
        size = len(self.names) + explicit * len(self.tests) * (self.marginal.scatter.size + 1)
        start = init_to_value(values={"coordinates": jnp.zeros(size)})
        return NUTS(FitCoordinates(self, size), **{"target_accept_prob": ACCEPT, **settings}, init_strategy=start)

    def first(self, count: int) -> Fit:
        """The same of the first `count` particles: without padding."""

        def some(tree: Any) -> Any:
            return jax.tree.map(lambda x: x[:count], tree)

        marginal = replace(some(replace(self.marginal, weight=None)), scatter=self.marginal.scatter)
        noise = replace(self.noise.noise, scale=self.noise.noise.scale[:count])
        return replace(
            self,
            tests=some(replace(self.tests, weight=None)),
            individual=some(self.individual),
            noise=replace(self.noise, noise=noise),
            filters=some(self.filters),
            point=some(self.point),
            residual=self.residual[:count],
            marginal=marginal,
        )


class FitCoordinates:
    """The model in the coordinates of a fit, as a NumPyro model: its density, written in numbers that are near standard
    normal, every site of the model as a `deterministic`.

    A posterior whose widths span five powers of ten does not mix in its own coordinates.
    """

    def __init__(self, fit: Fit, size: int) -> None:
        self.fit, self.size = fit, size

    def __call__(self, tests: Tests, marginal: Marginal | None = None) -> None:
        """As `Model`: with `marginal` every particle is integrated out, else its own numbers are explicit."""
        fit, improper = self.fit, dist.ImproperUniform(dist.constraints.real, (), (self.size,))
        position: Any = numpyro.sample("coordinates", improper)
        d = len(fit.names)
        free = fit.mode + jnp.linalg.cholesky(fit.covariance) @ position[:d]
        sites = fit.target.sites(free)
        options = {} if marginal is not None else {"filters": fit.filters, "around": fit.marginal}
        if marginal is None:
            sites["own"] = position[d:].reshape(len(tests), -1)
        with handlers.block():  # the model is evaluated here, and adds no sites of its own
            potential: Any = potential_energy(fit.model, (tests, marginal), options, sites)
            model = handlers.seed(fit.model, jax.random.key(0))
            values = constrain_fn(model, (tests, marginal), options, sites, return_deterministic=True)
        numpyro.factor("density", -potential)
        for name, value in values.items():
            numpyro.deterministic(name, value)


@compiled
def population_of(free: Float[Array, " d"], target: LogPosterior) -> Population:
    """The population at unbounded coordinates."""
    return target.population(free)
