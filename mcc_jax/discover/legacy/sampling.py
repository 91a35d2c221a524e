"""The posterior: the population sampled with all particles integrated out, the particles drawn back, and exact weights.

1. Given the summaries (`population`), nothing but the population is left to sample: seven to eleven numbers.
2. Given a draw of the population, every particle's parameters are normal and independent: drawn directly.
3. A summary is a quadratic; the true likelihood of a test is not. Their ratio at the drawn parameters is the draw's
   importance weight, which makes the result exact whatever the summary's quality, and shows that quality (Pareto k).
   Particles whose ratio scatters (a curve that snaps through, say) get several candidates per draw of the population,
   of which one is kept in proportion to its ratio, and the mean ratio becomes the weight: the same exact posterior,
   with less scatter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..._types import Scalar
from ...law import Unloading
from .compiling import compiled, even_batch
from .data import Tests
from .forward import displacement
from .noise import Whitening
from .nuts import Chains, sample
from .population import Draw, Population, Scatter, Summary, draw_latent
from .transforms import LogPosterior, PriorNumbers, constrain


class ParticleDraws(NamedTuple):
    """Draws of the particles' parameters, one for each draw of the population.

    Attributes:
        latent: b1, b3, b5, e.
        zero: zero of displacement [um].
        log_likelihood: of every test given the population, the particle integrated out.
        log_ratio: log of exact over quadratic likelihood; 0 where the exact one was not looked at.
    """

    latent: Float[Array, "draws particles 4"]
    zero: Float[Array, "draws particles"]
    log_likelihood: Float[Array, "draws particles"]
    log_ratio: Float[Array, "draws particles"]


@compiled
def sample_population(
    keys: Key[Array, " chains"],
    mode: Float[Array, " d"],
    covariance: Float[Array, "d d"],
    target: LogPosterior,
    accept: Scalar,
    *,
    warmup: int,
    draws: int,
) -> tuple[Chains, Population]:
    """NUTS over the population, all particles integrated out, a chain for each key; populations of all in one row."""
    factor = jnp.linalg.cholesky(covariance)
    together = jax.default_backend() != "cpu"
    run = sample(
        keys,
        target.log_density,
        mode,
        factor,
        warmup=warmup,
        draws=draws,
        accept=accept,
        together=together,
    )
    return run, jax.vmap(target.population)(run.position.reshape(-1, mode.shape[0]))


class ExactLikelihood(eqx.Module):
    """Tests with their exact likelihood, and what particles are drawn by.

    Attributes:
        tests: the measurements.
        filters: their noise.
        summary: quadratic summaries of the same tests.
        scatter: what scatters.
        zero_sd: standard deviation of the zeros [um].
        unloading: form of unloading.
    """

    tests: Tests
    filters: Whitening
    summary: Summary
    scatter: Scatter
    zero_sd: Float[Array, ""]
    unloading: Unloading = eqx.field(static=True)

    def draw(
        self, population: Population, normal: Float[Array, "particles k"], normal_zero: Float[Array, " particles"]
    ) -> Draw:
        """Particles given the population, under the summaries, from standard normal numbers."""
        summary = self.summary_at(population)
        return draw_latent(population, summary, self.tests.flatness, self.scatter, normal, normal_zero)

    def some(self, which: Int[Array, " chosen"]) -> ExactLikelihood:
        """Some of the tests."""
        chosen = [jax.tree.map(lambda x: x[which], part) for part in self.by_test()]
        return eqx.tree_at(lambda exact: exact.by_test(), self, tuple(chosen))

    def by_test(self) -> tuple[PyTree, ...]:
        """The fields with one row per test."""
        return self.tests, self.filters, self.summary

    def summary_at(self, population: Population) -> Summary:
        """The summaries, which may depend on what all particles share."""
        return self.summary

    def predicted(
        self, population: Population, latent: Float[Array, "particles 4"]
    ) -> Float[Array, "particles points"]:
        """Displacement [um] of every particle from its own zero."""
        return jax.vmap(lambda w, particle, force: displacement(w, particle, force, self.unloading))(
            latent, self.tests.particle, self.tests.force
        )

    def log_likelihood(
        self, population: Population, latent: Float[Array, "particles 4"], zero: Float[Array, " particles"]
    ) -> Float[Array, " particles"]:
        """Log likelihood of each test at given parameters, and log prior of its zero, up to a constant."""
        tests = self.tests
        residual = tests.displacement - self.predicted(population, latent) - zero[:, None]

        def squares(r, mask, filtered):
            return jnp.sum(filtered(jnp.where(mask, r, 0.0)) ** 2) + filtered.least_squares

        total = jax.vmap(squares)(residual, tests.mask, self.filters)
        at_zero = ((zero - tests.contact) / self.zero_sd) ** 2
        points = jnp.sum(tests.mask, 1).astype(total.dtype)
        return -0.5 * (jnp.exp(-2 * population.log_noise) * total + at_zero) - points * population.log_noise


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

    def one(arguments):
        key, at = arguments
        deviate, zeros, pick = jax.random.split(key, 3)

        def candidate(normal, normal_zero, reach):
            normal, normal_zero = reach * normal, reach * normal_zero
            drawn = exact.draw(at, normal, normal_zero)
            ratio = jnp.zeros(count)
            if candidates:
                truth = exact.log_likelihood(at, drawn.latent, drawn.zero)
                prior = -0.5 * jnp.sum(drawn.deviations**2, -1)
                square = 0.5 * (jnp.sum(normal**2, -1) + normal_zero**2)
                proposal = -square - drawn.log_volume
                if candidates > 1:
                    far = -square / REACH**2 - (exact.scatter.size + 1) * math.log(REACH)
                    proposal = jnp.logaddexp(-square, far) - math.log(2) - drawn.log_volume
                ratio = truth + prior - proposal - drawn.log_likelihood - jnp.log(exact.summary.zero_sd)
                ratio = jnp.where(jnp.isfinite(ratio), ratio, -jnp.inf)
            return drawn.latent, drawn.zero, drawn.log_likelihood, ratio

        shape = (max(candidates, 1), count)
        latent, zero, likelihood, ratio = jax.vmap(candidate)(
            jax.random.normal(deviate, (*shape, exact.scatter.size)),
            jax.random.normal(zeros, shape),
            jnp.where(jnp.arange(shape[0]) % 2 == 0, 1.0, REACH),
        )
        if candidates <= 1:
            return ParticleDraws(latent[0], zero[0], likelihood[0], ratio[0])
        chosen: Int[Array, " particles"] = jax.random.categorical(pick, jnp.maximum(ratio, -1e30), axis=0)
        mean = jax.scipy.special.logsumexp(ratio, axis=0) - jnp.log(candidates)

        def take(values):
            return jnp.take_along_axis(values, chosen.reshape(1, count, *[1] * (values.ndim - 2)), axis=0)[0]

        return ParticleDraws(take(latent), take(zero), likelihood[0], mean)

    rows = ROWS if jax.default_backend() == "cpu" else ROWS_OF_ACCELERATORS
    batch = even_batch(draws, rows // (count * max(candidates, 1)))
    each = jnp.where(common, keys, jax.random.split(keys[0], draws))
    return jax.lax.map(one, (each, population), batch_size=batch)


@compiled
def sample_joint(
    keys: Key[Array, " chains"],
    mode: Float[Array, " d"],
    covariance: Float[Array, "d d"],
    numbers: PriorNumbers,
    exact: ExactLikelihood,
    accept: Scalar,
    *,
    warmup: int,
    draws: int,
) -> tuple[
    Chains,
    Float[Array, "chains draws d"],
    Float[Array, "chains draws n 4"],
    Float[Array, "chains draws n"],
    Float[Array, "chains draws n"],
]:
    r"""NUTS over population and all particles at once, under the exact likelihood: the plain joint model.

    .. math:: p(\text{population}) \prod_i N(\xi_i; 0, 1)\, N(z_i; z_{i0}, s_z^2)\, p(y_i | w_i, z_i)

    The sampler's coordinates of a particle are standard normal numbers that `draw_latent` maps to its deviations and
    zero; the volume of that map is part of the density, which is therefore the plain one, whatever the summaries are.
    """
    d, count, k = mode.shape[0], len(exact.tests), exact.scatter.size

    def place(position):
        free, rest = position[:d], position[d:].reshape(count, k + 1)
        population, prior = constrain(free, numbers, exact.scatter)
        return population, prior, exact.draw(population, rest[:, :k], rest[:, k])

    def log_density(position):
        population, prior, drawn = place(position)
        likelihood = jnp.sum(exact.log_likelihood(population, drawn.latent, drawn.zero))
        return prior + likelihood - 0.5 * jnp.sum(drawn.deviations**2) + jnp.sum(drawn.log_volume)

    size = d + count * (k + 1)
    factor = jnp.eye(size).at[:d, :d].set(jnp.linalg.cholesky(covariance))
    centre = jnp.zeros(size).at[:d].set(mode)
    run = sample(keys, log_density, centre, factor, warmup=warmup, draws=draws, accept=accept)

    def latents(position):
        _, _, drawn = place(position)
        return drawn.latent, drawn.zero, drawn.log_likelihood

    particles = jax.lax.map(lambda chain: jax.vmap(latents)(chain), run.position)
    return run, run.position[..., :d], *particles
