"""Every particle drawn back given draws of the population, with exact weights.

1. Given the summaries (`marginal`), nothing but the population is left to sample.
2. Given a draw of the population, every particle's parameters are nearly normal and independent: drawn directly.
3. A summary is a quadratic; the true likelihood of a test is not. Their ratio at the drawn parameters is the draw's
   importance weight, which makes the result exact whatever the summary's quality, and shows that quality (Pareto k).
   Particles whose ratio scatters (a curve that snaps through, say) get several candidates per draw of the population,
   of which one is kept in proportion to its ratio, and the mean ratio becomes the weight: the same exact posterior,
   with less scatter.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from .compiling import compiled, even_batch
from .data import Tests
from .forward import Forms, Point, residuals
from .marginal import Marginal, ParticleDraw
from .noise import Whitening
from .population import Population


class ParticleDraws(NamedTuple):
    """Draws of the particles' parameters, one for each draw of the population.

    Attributes:
        latent: b1, b3, b5, e.
        theta: numbers of the effects.
        zero: zero of displacement [um].
        log_likelihood: of every test given the population, the particle integrated out.
        log_ratio: log of exact over quadratic likelihood; 0 where the exact one was not looked at.
    """

    latent: Float[Array, "draws particles 4"]
    theta: Float[Array, "draws particles numbers"]
    zero: Float[Array, "draws particles"]
    log_likelihood: Float[Array, "draws particles"]
    log_ratio: Float[Array, "draws particles"]


class ExactLikelihood(eqx.Module):
    """Tests with their exact likelihood, and what particles are drawn by.

    Attributes:
        tests: the measurements.
        filters: their noise.
        marginal: the same tests, summarised.
        zero_prior: mean and standard deviation of the zeros, from the recorded contact [um].
        forms: the law.
    """

    tests: Tests
    filters: Whitening
    marginal: Marginal
    zero_prior: Float[Array, " 2"]
    forms: Forms

    def some(self, which: Int[Array, " chosen"]) -> ExactLikelihood:
        """Some of the tests."""

        def chosen(tree):
            return jax.tree.map(lambda x: x[which] if x.ndim else x, tree)

        return ExactLikelihood(
            chosen(self.tests), chosen(self.filters), chosen(self.marginal), self.zero_prior, self.forms
        )

    def log_likelihood(self, population: Population, drawn: ParticleDraw) -> Float[Array, " particles"]:
        """Log likelihood of each test at drawn parameters, times the prior density of its zero."""
        tests = self.tests
        residual = residuals(Point(drawn.latent, drawn.zero, drawn.theta), tests, self.forms)
        mean, sd = self.zero_prior
        at_zero = -0.5 * ((drawn.zero - tests.contact - mean) / sd) ** 2 - jnp.log(sd * math.sqrt(2 * math.pi))
        return jax.vmap(lambda f, r: f.log_density(r, population.log_noise))(self.filters, residual) + at_zero


REACH = 3.0
"""Every other candidate is drawn from a distribution so many times as wide: there lies what a summary is too narrow
for."""

ROWS, ROWS_OF_ACCELERATORS = 640, 40_000
"""Single draws of single particles worked on at once: a processor keeps no more in its cache."""


@compiled
def draw_particles(
    keys: Key[Array, " 1"],
    population: Population,
    exact: ExactLikelihood,
    candidates: int = 1,
    common: bool | Bool[Array, ""] = False,
) -> ParticleDraws:
    """Draw the particles' parameters given each draw of the population, and compare with the exact likelihood.

    Args:
        keys: a single random key; with an axis, so that blocks of particles on several devices have one each.
        population: draws, every field with a leading axis.
        exact: the tests.
        candidates: how many to draw and choose from; 0 draws one and does not look at the exact likelihood.
        common: use the same random numbers for every draw of the population.
    """
    draws = population.a.shape[0]
    count = len(exact.tests)

    numbers = exact.marginal.point.theta.shape[1]

    def one(arguments):
        key, row = arguments
        at = jax.tree.map(lambda x: x[row], population)
        deviate, zeros, pick = jax.random.split(key, 3)

        def candidate(normal, normal_zero, reach):
            normal, normal_zero = reach * normal, reach * normal_zero
            drawn = exact.marginal.draw(at, normal, normal_zero)
            ratio = jnp.zeros(count)
            if candidates:
                # Of the standard normal densities of deviations and proposal all constants cancel but the zero's.
                truth = exact.log_likelihood(at, drawn) + 0.5 * math.log(2 * math.pi)
                prior = -0.5 * jnp.sum(drawn.deviations**2, -1)
                square = 0.5 * (jnp.sum(normal**2, -1) + normal_zero**2)
                proposal = -square - drawn.log_volume
                if candidates > 1:
                    far = -square / REACH**2 - (exact.marginal.scatter.size + 1) * math.log(REACH)
                    proposal = jnp.logaddexp(-square, far) - math.log(2) - drawn.log_volume
                ratio = truth + prior - proposal - drawn.log_likelihood
                ratio = jnp.where(jnp.isfinite(ratio), ratio, -jnp.inf)
            theta: Any = drawn.theta if numbers else None
            return drawn.latent, theta, drawn.zero, drawn.log_likelihood, ratio

        shape = (max(candidates, 1), count)
        latent, theta, zero, likelihood, ratio = jax.vmap(candidate)(
            jax.random.normal(deviate, (*shape, exact.marginal.scatter.size)),
            jax.random.normal(zeros, shape),
            jnp.where(jnp.arange(shape[0]) % 2 == 0, 1.0, REACH),
        )
        if candidates <= 1:
            return latent[0], theta[0] if numbers else theta, zero[0], likelihood[0], ratio[0]
        chosen: Int[Array, " particles"] = jax.random.categorical(pick, jnp.maximum(ratio, -1e30), axis=0)
        mean = jax.scipy.special.logsumexp(ratio, axis=0) - jnp.log(candidates)

        def take(values):
            return jnp.take_along_axis(values, chosen.reshape(1, count, *[1] * (values.ndim - 2)), axis=0)[0]

        return take(latent), take(theta) if numbers else theta, take(zero), likelihood[0], mean

    rows = ROWS if jax.default_backend() == "cpu" else ROWS_OF_ACCELERATORS
    batch = even_batch(draws, rows // (count * max(candidates, 1)))
    each = jnp.where(common, keys, jax.random.split(keys[0], draws))
    # Arrays without an entry are left out: `map` cannot cut them in batches.
    latent, theta, *rest = jax.lax.map(one, (each, jnp.arange(draws)), batch_size=batch)
    return ParticleDraws(latent, jnp.zeros((draws, count, 0)) if theta is None else theta, *rest)
