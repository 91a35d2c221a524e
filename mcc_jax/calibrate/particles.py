"""Every particle drawn back given draws of the population, with exact weights.

Given a draw of the population every particle's parameters are nearly normal and independent. The ratio of the exact
likelihood to its quadratic summary (`marginal`) at the drawn parameters is the draw's importance weight. Where it
scatters, one of several candidates is kept in proportion to its ratio, and the mean ratio becomes the weight. Of many
particles the product of all ratios scatters too much; with common random numbers the sum of their logarithms is smooth,
linear over the little that the posterior leaves open, and found by regression (`correction`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from .._blocks import even_size
from .._types import Scalar
from .data import Tests
from .forward import Forms, Point, residuals
from .importance import MOST_PARETO_K, ordered_resample, pareto_k, relative_scatter, smoothed_weights
from .marginal import Marginal, ParticleDraw
from .noise import Whitening
from .population import Population
from .running import Blocks, Turn, compiled

# Found by trial on simulated campaigns (`benchmarks/study_modes.py`, `bench_scale.py`).
# A particle whose weight scatters by more than this share of its mean gets several candidates per draw; of many
# particles, whose weights are not applied, a mean is then wrong by at most this share of its standard deviation.
SCATTERING, SCATTERING_OF_MANY = 0.3, 0.1
CANDIDATES, CANDIDATES_OF_MANY = (16, 32), (2, 16)  # how many it gets: first, and the few that scatter even then
FEW = 4  # how many particles get most candidates; of many particles one in a hundred
REACH = 3.0  # every other candidate is drawn so many times as wide: there lies what a summary is too narrow for
# Up to so many draws of single particles every one is compared with the exact likelihood and the weights are applied;
# of larger campaigns some are, and the population is corrected by regression.
COMPARED = 400_000
PROBES = 25  # draws of the population at which the sum of all particles' log ratios is worked out for that
# Most that a particle's log ratio may change over the posterior of many particles, which is narrow for one of them:
# what changes more gets more candidates, or does not count.
MOST_CHANGE = 0.1
LOWEST = -1e3  # log ratio that counts where the exact likelihood vanishes: differences of infinities say nothing
UNSURE = 0.3  # standard error of the correction, in standard deviations of the posterior, that is reported
KEPT = 4_000_000  # most draws of single particles that are kept; of very large campaigns every n-th draw
# These change the time, and not the answer beyond rounding.
ROWS, ROWS_OF_ACCELERATORS = 640, 40_000  # single draws of single particles at once: no more fit into a CPU's cache
GROUP = 16  # particles that are drawn together from several candidates
SIDE_BY_SIDE = 2  # pieces that draws are cut into on a CPU, on any number of cores


class ParticleDraws(NamedTuple):
    """Particles' parameters for each draw of the population, and the log of exact over quadratic likelihood or 0."""

    latent: Float[Array, "draws particles 4"]
    theta: Float[Array, "draws particles numbers"]
    zero: Float[Array, "draws particles"]
    log_likelihood: Float[Array, "draws particles"]
    log_ratio: Float[Array, "draws particles"]


class ExactLikelihood(eqx.Module):
    """Tests with their noise, their summaries, and mean and standard deviation of the zeros' prior [um]."""

    tests: Tests
    filters: Whitening
    marginal: Marginal
    zero_prior: tuple[Scalar, Scalar]
    forms: Forms

    def some(self, which: np.ndarray) -> ExactLikelihood:
        """Some of the tests."""
        return jax.tree.map(lambda x: jax.device_put(np.asarray(x)[which]) if jnp.ndim(x) else x, self)

    def log_likelihood(self, population: Population, drawn: ParticleDraw) -> Float[Array, " particles"]:
        """Log likelihood of each test at drawn parameters, times the prior density of its zero."""
        tests = self.tests
        residual = residuals(Point(drawn.latent, drawn.zero, drawn.theta), tests, self.forms)
        mean, sd = self.zero_prior
        at_zero = -0.5 * ((drawn.zero - tests.contact - mean) / sd) ** 2 - jnp.log(sd * math.sqrt(2 * math.pi))
        return jax.vmap(lambda f, r: f.log_density(r, population.log_noise))(self.filters, residual) + at_zero


@compiled
def draw_particles(
    keys: UInt[Array, "particles data"],
    exact: ExactLikelihood,
    population: Population,
    candidates: int = 1,
    common: bool | Bool[Array, ""] = False,
) -> ParticleDraws:
    """Draw the particles' parameters given each draw of the population, and compare with the exact likelihood: results
    have the particles first, then the draws.

    One is chosen of so many `candidates`; with 0 of them one is drawn and not compared. `keys` are the data of one
    random key, for every particle; `common` random numbers are the same for every draw of the population.
    """
    draws, count, size = population.a.shape[0], len(exact.tests), exact.marginal.scatter.size

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
                    far = -square / REACH**2 - (size + 1) * math.log(REACH)
                    proposal = jnp.logaddexp(-square, far) - math.log(2) - drawn.log_volume
                ratio = truth + prior - proposal - drawn.log_likelihood
                ratio = jnp.where(jnp.isfinite(ratio), ratio, -jnp.inf)
            # In one array: `map` cannot cut effects' numbers into batches where there are none.
            numbers = jnp.concatenate([drawn.latent, drawn.theta, drawn.zero[:, None]], 1)
            return numbers, drawn.log_likelihood, ratio

        shape = (max(candidates, 1), count)
        numbers, likelihood, ratio = jax.vmap(candidate)(
            jax.random.normal(deviate, (*shape, size)),
            jax.random.normal(zeros, shape),
            jnp.where(jnp.arange(shape[0]) % 2 == 0, 1.0, REACH),
        )
        if candidates <= 1:
            return numbers[0], likelihood[0], ratio[0]
        chosen: Int[Array, " particles"] = jax.random.categorical(pick, jnp.maximum(ratio, -1e30), axis=0)
        mean = jax.scipy.special.logsumexp(ratio, axis=0) - jnp.log(candidates)
        return jnp.take_along_axis(numbers, chosen[None, :, None], axis=0)[0], likelihood[0], mean

    rows = ROWS if jax.default_backend() == "cpu" else ROWS_OF_ACCELERATORS
    batch = even_size(draws, rows // (count * max(candidates, 1)))
    key = jax.random.wrap_key_data(keys[0])
    each = jnp.where(common, key[None], jax.random.split(key, draws))
    found = jax.lax.map(one, (each, jnp.arange(draws)), batch_size=batch)
    numbers, likelihood, ratio = (jnp.swapaxes(x, 0, 1) for x in found)
    return ParticleDraws(numbers[..., :4], numbers[..., 4:-1], numbers[..., -1], likelihood, ratio)


class Length(NamedTuple):
    """Chains, and draws of each during and after warm-up."""

    chains: int
    warmup: int
    draws: int

    @property
    def total(self) -> int:
        """Draws kept of all chains."""
        return self.chains * self.draws


def are_many(count: int, length: Length) -> bool:
    """Whether there are too many draws of single particles to compare each with the exact likelihood."""
    return length.total * count > COMPARED


def some_of(population: Population, rows: slice | np.ndarray) -> Population:
    """Some draws of the population."""
    return jax.tree.map(lambda x: np.asarray(x)[rows], population)


class Drawer:
    """Draws of the particles, in blocks of so many, as arrays of NumPy with the axes (draw, particle); `chunk` draws of
    the population, or all, in one call, so that one compilation serves any number of them."""

    def __init__(self, exact: ExactLikelihood, block: int, chunk: int | None = None) -> None:
        self.count = len(exact.tests)
        self._exact, self._blocks, self._chunk = exact, Blocks(self.count, block), chunk

    def all(self, key: Array, population: Population, candidates: int = 1, *, common: bool = False) -> ParticleDraws:
        """All particles, with `candidates` and `common` of `draw_particles`."""
        blocks, draws = self._blocks, len(np.asarray(population.a))
        chunk, same = self._chunk or draws, jnp.asarray(np.asarray(common))

        def turn(first: int) -> Turn:
            rows = np.minimum(np.arange(first, first + chunk), draws - 1)  # the last one pads the last chunk
            keys = blocks.keys(key if common or not first else jax.random.fold_in(key, first))
            some = jax.tree.map(lambda x: jax.device_put(np.asarray(x)[rows]), population)
            return (keys,), (some, candidates, same)

        found = blocks.turns(draw_particles, (self._exact,), [turn(first) for first in range(0, draws, chunk)])
        several = ([np.asarray(v).swapaxes(0, 1) for v in one] for one in zip(*found, strict=True))
        return ParticleDraws(*(cast(Any, np.concatenate(one)[:draws]) for one in several))

    def some(
        self, key: Array, which: np.ndarray, population: Population, candidates: int, *, common: bool = False
    ) -> ParticleDraws:
        """Some particles, in blocks of one of a few sizes: every size would be compiled again."""
        size = min(self.count, GROUP, 4 ** int(np.ceil(np.log(max(len(which), 2)) / np.log(4))))
        few = Drawer(self._exact.some(which), size, self._chunk)
        return few.all(jax.random.fold_in(key, candidates), population, candidates, common=common)

    def redraw(
        self,
        key: Array,
        drawn: ParticleDraws,
        population: Population,
        k: np.ndarray,
        scattering: np.ndarray,
        candidates: Iterable[int],
    ) -> None:
        """Draw particles with scattering weights again, in place, and their Pareto k; from several candidates per draw
        first, then, for the few that scatter most even so, from more."""
        latent, theta, zero, _, ratio = (cast(np.ndarray, v) for v in drawn)
        few = max(FEW, self.count // 100)
        for many in candidates:
            if not len(scattering):
                return
            better = self.some(key, scattering, population, many)
            latent[:, scattering], zero[:, scattering] = better.latent, better.zero
            theta[:, scattering] = better.theta
            ratio[:, scattering] = better.log_ratio
            k[scattering] = pareto_k(ratio[:, scattering])
            scattering = scattering[np.argsort(-relative_scatter(ratio[:, scattering]))][:few]
            scattering = scattering[relative_scatter(ratio[:, scattering]) > SCATTERING]


class Drawn(NamedTuple):
    """Particles under every `keep`-th of the chosen draws of the population, Pareto k of theirs and of the population's
    weights, log of the mean ratio of exact to quadratic likelihood and its standard error."""

    chosen: np.ndarray
    particles: ParticleDraws
    k: np.ndarray
    k_joint: float
    log_ratio: tuple[float, float]
    keep: int = 1
    notes: tuple[str, ...] = ()


def weighted(
    exact: ExactLikelihood, block: int, population: Population, length: Length, keys: Sequence[Array]
) -> Drawn:
    """Few particles: the weight of a draw is the product of all particles' ratios of exact to quadratic likelihood."""
    _, check_key, pick_key = keys
    drawer = Drawer(exact, block, -(-length.total // SIDE_BY_SIDE) if jax.default_backend() == "cpu" else None)
    particles = drawer.all(check_key, population)
    ratio = np.asarray(particles.log_ratio)
    k = pareto_k(ratio)
    scattering = np.flatnonzero((relative_scatter(ratio) > SCATTERING) | (k > MOST_PARETO_K))
    drawer.redraw(pick_key, particles, population, k, scattering, CANDIDATES)
    total = ratio.sum(1)
    chosen, k_joint = _resampled(total, length)
    return Drawn(chosen, jax.tree.map(lambda x: x[chosen], particles), k, k_joint, mean_ratio(total))


def corrected(
    exact: ExactLikelihood, block: int, population: Population, length: Length, keys: Sequence[Array], parameters: Any
) -> Drawn:
    """Many particles: the draws of the population are weighted by regression (`correction`), and only particles whose
    weights scatter are drawn from several candidates."""
    particle_key, check_key, pick_key = keys
    drawer = Drawer(exact, block, PROBES)
    checks = PROBES * max(2, COMPARED // (PROBES * drawer.count))
    ratio = np.asarray(drawer.all(check_key, some_of(population, evenly(length.total, checks))).log_ratio)
    scatter, k = relative_scatter(ratio), pareto_k(ratio)
    left_out: set[int] = set()

    def total(which: int, rows: np.ndarray) -> np.ndarray:
        probes, own = some_of(population, rows), jax.random.fold_in(check_key, which)
        ratio = np.maximum(drawer.all(own, probes, common=True).log_ratio, LOWEST)
        # A single candidate may fall off a cliff of the likelihood as the population moves, which says nothing of all.
        if len(changing := np.flatnonzero(np.ptp(ratio, axis=0) > MOST_CHANGE)):
            better = drawer.some(own, changing, probes, CANDIDATES[-1], common=True).log_ratio
            ratio[:, changing] = np.maximum(better, LOWEST)
        if len(changing := np.flatnonzero(np.ptp(ratio, axis=0) > MOST_CHANGE)):
            left_out.update(changing.tolist())
            ratio[:, changing] = 0.0
        return ratio.sum(1)

    log_weight, error = correction(total, parameters)
    notes = []
    if error > UNSURE:
        notes.append(f"the means of the population are known to {error:.2f} of their standard deviations only")
    if left_out:
        notes.append(f"{len(left_out)} particles act on the population through their quadratic summary alone")
    chosen, k_joint = _resampled(log_weight, length)
    keep = max(1, -(-length.total * drawer.count // KEPT))
    some = some_of(population, chosen[::keep])
    particles = drawer.all(particle_key, some, 0)
    scattering = np.flatnonzero((scatter > SCATTERING_OF_MANY) | (k > MOST_PARETO_K))
    drawer.redraw(pick_key, particles, some, k, scattering, CANDIDATES_OF_MANY)
    # The regression shows how the correction changes over the posterior; how large it is, every particle shows alone.
    each = [mean_ratio(ratio[:, i]) for i in range(ratio.shape[1])]
    log_ratio = float(sum(v for v, _ in each)), float(np.sqrt(sum(error**2 for _, error in each)))
    return Drawn(chosen, particles, k, k_joint, log_ratio, keep, tuple(notes))


def mean_ratio(log_ratio: np.ndarray) -> tuple[float, float]:
    """Logarithm of the mean of importance ratios, and its standard error."""
    finite = np.where(np.isfinite(log_ratio), log_ratio, -np.inf)
    if not np.isfinite(finite).any():
        return -np.inf, np.inf
    ratio = np.exp(finite - finite.max())
    return float(finite.max() + np.log(ratio.mean())), float(ratio.std() / ratio.mean() / np.sqrt(len(ratio)))


def _resampled(log_weight: np.ndarray, length: Length) -> tuple[np.ndarray, float]:
    """Which draws represent the weighted ones, in order within each chain, and the Pareto k of the weights."""
    weight, k = smoothed_weights(log_weight)
    rows = (slice(c * length.draws, (c + 1) * length.draws) for c in range(length.chains))
    return np.concatenate([row.start + ordered_resample(weight[row], length.draws) for row in rows]), k


def evenly(count: int, some: int) -> np.ndarray:
    """Positions of some of many draws, spread evenly."""
    return np.linspace(0, count - 1, some).astype(int)


def correction(total: Callable[[int, np.ndarray], np.ndarray], draws: np.ndarray) -> tuple[np.ndarray, float]:
    """What the exact likelihood adds to the log density of the population at every draw, up to a constant, by
    regression of a `total` of log ratios (at rows of the draws, with one of two sets of random numbers) on its
    parameters; and the standard error of the slope in standard deviations of the posterior."""
    rows = evenly(len(draws), PROBES)
    unit, values, _ = np.linalg.svd(draws - draws.mean(0), full_matrices=False)
    # Uncorrelated and of standard deviation 1, so that a slope is the shift of a mean in standard deviations.
    white = unit[:, values > 1e-9 * values[0]] * np.sqrt(len(draws))
    design = np.concatenate([np.ones((len(rows), 1)), white[rows]], 1)
    slopes = np.stack([np.linalg.lstsq(design, total(which, rows), rcond=None)[0][1:] for which in (0, 1)])
    # Two estimates from independent random numbers: half their difference is the standard error of their mean.
    return white @ slopes.mean(0), float(np.linalg.norm(slopes[0] - slopes[1]) / 2)
