"""The particles of a campaign drawn back given draws of the population: all of them in blocks, or the few restless."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .nuts import PAIR, Length, side_by_side
from .population import Population
from .reweighting import PROBES, correction, evenly
from .sampling import ExactLikelihood, ParticleDraws, draw_particles
from .sharding import Blocks, count_of
from .weights import PARETO_K_MOST, ordered_resample, pareto_k, smoothed_weights, unrest

RESTLESS = 0.3
"""A particle whose weight scatters by more than this share of its mean gets several candidates per draw."""

FEW = 4
"""How many restless particles get most candidates; of many particles one in a hundred."""

GROUP = 64
"""Most restless particles drawn at once."""

MAX_CHECKED = 400_000
"""Up to as many draws of single particles, every one is compared with the exact likelihood and the weights are applied;
of larger campaigns some draws are compared, to know how good each particle's summary is, and the population is
corrected by regression (`reweighting`)."""

CANDIDATES, CANDIDATES_OF_MANY = (16, 64), (2, 16)
"""How many a restless particle gets: first, and the few that scatter most even then."""

RESTLESS_OF_MANY = 0.1
"""`RESTLESS` where the weights of the others are not applied: a mean of one of these is wrong by at most this share of
its standard deviation."""

UNSTEADY = 0.1
"""Most that a particle's log ratio may change over the posterior of many particles, which is narrow for one of them:
what changes more gets more candidates, or does not count."""

LOWEST = -1e3
"""Log ratio that counts where the exact likelihood vanishes: differences of infinities say nothing."""

UNSURE = 0.3
"""Standard error of the correction, in standard deviations of the posterior, from which on a reader is told."""

MAX_PARTICLE_DRAWS = 4_000_000
"""At most as many draws of single particles are kept; of very large campaigns every n-th draw."""


def stride_of(count: int, total: int) -> int:
    """Every how many-th draw is compared with the exact likelihood: all of them for few particles."""
    return max(1, -(-total * count // MAX_CHECKED))


def chunk_of(total: int) -> int | None:
    """Draws of a chunk where all are compared: on a CPU two of them run side by side, on any number of cores."""
    return -(-total // PAIR) if jax.default_backend() == "cpu" else None


def every(population: Population, which: int | np.ndarray) -> Population:
    """Every so-many-th draw, or those at given positions."""
    rows = slice(None, None, which) if isinstance(which, int) else which
    return jax.tree.map(lambda x: np.asarray(x)[rows], population)


class Drawer:
    """Draws of the particles, as arrays of NumPy with the axes (draw, particle), without copies that only fill up.

    Attributes:
        count: number of particles.
    """

    def __init__(self, exact: ExactLikelihood, block: int, chunk: int | None = None) -> None:
        """Cut the tests into blocks.

        Args:
            exact: the tests.
            block: particles of a block; 0 for a single one.
            chunk: draws of the population worked on in one go, so that one compilation serves any number of them; all
                by default. Chunks run side by side where all particles are one block.
        """
        self.count = count_of(exact.tests)
        self._exact, self._blocks, self._chunk = exact, Blocks(len(exact.tests), block), chunk
        self._own = self._blocks.cut(exact)

    def all(self, key: Array, population: Population, candidates: int = 1, *, common: bool = False) -> ParticleDraws:
        """All particles, with `candidates` and `common` of `draw_particles`."""
        blocks = self._blocks

        def draw(key: Array, population: Population) -> list[np.ndarray]:
            keys, same = blocks.keys(key), jnp.asarray(np.asarray(common))
            found = blocks.whole(blocks.each(draw_particles, keys, population, self._own, candidates, same, axis=1))
            return [np.asarray(v)[:, : self.count] for v in found]

        return self._chunked(draw, key, population, common)

    def _chunked(
        self,
        draw: Callable[[Array, Population], list[np.ndarray]],
        key: Array,
        population: Population,
        common: bool,
    ) -> ParticleDraws:
        """Draws under all populations, the last one repeated to fill up chunks."""
        draws = len(np.asarray(population.a))
        chunk = self._chunk or draws

        def one(first: int) -> list[np.ndarray]:
            rows = np.minimum(np.arange(first, first + chunk), draws - 1)
            own = key if common or not first else jax.random.fold_in(key, first)
            return draw(own, jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[rows]), population))

        # Several processes exchange the numbers of their blocks, in one order.
        found = (side_by_side if self._blocks.whole_here else map)(one, range(0, draws, chunk))
        return ParticleDraws(*(cast(Any, np.concatenate(several)[:draws]) for several in zip(*found, strict=True)))

    def some(
        self, key: Array, which: np.ndarray, population: Population, candidates: int, *, common: bool = False
    ) -> ParticleDraws:
        """Some particles. They are few: every process draws all of them."""
        found = []
        for i in range(0, len(which), GROUP):
            group = which[i : i + GROUP]
            # Always of one of a few sizes, the first one repeated: every size would be compiled anew.
            size = min(self.count, GROUP, 4 ** int(np.ceil(np.log(max(len(group), 2)) / np.log(4))))
            padded = jnp.asarray(np.pad(group, (0, size - len(group)), constant_values=group[0]))
            exact, count = self._exact.some(padded), len(group)

            def draw(
                key: Array, population: Population, exact: ExactLikelihood = exact, count: int = count
            ) -> list[np.ndarray]:
                same = jnp.asarray(np.asarray(common))
                drawn = draw_particles(key[None], population, exact, candidates, same)
                return [np.asarray(v)[:, :count] for v in drawn]

            found.append(self._chunked(draw, jax.random.fold_in(key, 1000 * i + candidates), population, common))
        return ParticleDraws(*(cast(Any, np.concatenate(several, 1)) for several in zip(*found, strict=True)))

    def settle(
        self,
        key: Array,
        drawn: ParticleDraws,
        population: Population,
        k: np.ndarray,
        restless: np.ndarray,
        candidates: Iterable[int],
    ) -> None:
        """Draw restless particles anew from many candidates, in place, and their Pareto k, until none is left.

        Args:
            key: random key.
            drawn: of all particles under `population`.
            population: draws.
            k: of every particle.
            restless: positions of the restless ones.
            candidates: how many per draw: first, and for the few that scatter most even then.
        """
        latent, theta, zero, _, ratio = (cast(np.ndarray, v) for v in drawn)
        few = max(FEW, self.count // 100)
        for many in candidates:
            if not len(restless):
                return
            better = self.some(key, restless, population, many)
            latent[:, restless], zero[:, restless] = better.latent, better.zero
            theta[:, restless] = better.theta
            ratio[:, restless] = better.log_ratio
            k[restless] = pareto_k(ratio[:, restless])
            restless = restless[np.argsort(-unrest(ratio[:, restless]))][:few]
            restless = restless[unrest(ratio[:, restless]) > RESTLESS]


class Drawn(NamedTuple):
    """Particles drawn back.

    Attributes:
        chosen: which draws of the population stand for the weighted ones.
        particles: under every `keep`-th of these.
        k: Pareto k of every particle's weights.
        k_joint: of the population's.
        keep: see `particles`.
        log_ratio: logarithm of the mean ratio of exact to quadratic likelihood of all tests, and its standard error.
        notes: what a reader must know.
    """

    chosen: np.ndarray
    particles: ParticleDraws
    k: np.ndarray
    k_joint: float
    log_ratio: tuple[float, float]
    keep: int = 1
    notes: tuple[str, ...] = ()


def weighted(drawer: Drawer, population: Population, length: Length, check_key: Array, pick_key: Array) -> Drawn:
    """Few particles: the weight of a draw is the product of all particles' ratios of exact to quadratic likelihood."""
    particles = drawer.all(check_key, population)
    ratio = np.asarray(particles.log_ratio)
    k = pareto_k(ratio)
    restless = np.flatnonzero((unrest(ratio) > RESTLESS) | (k > PARETO_K_MOST))
    drawer.settle(pick_key, particles, population, k, restless, CANDIDATES)
    total = ratio.sum(1)
    chosen, k_joint = _resampled(total, length)
    return Drawn(chosen, jax.tree.map(lambda x: x[chosen], particles), k, k_joint, mean_ratio(total))


def corrected(
    drawer: Drawer,
    population: Population,
    parameters: np.ndarray,
    length: Length,
    check_key: Array,
    pick_key: Array,
    particle_key: Array,
) -> Drawn:
    """Many particles: the draws of the population are weighted by regression (`_large.correction`).

    Of each particle some draws are compared with the exact likelihood. Those whose weights scatter are drawn from
    several candidates; of the others the draws are left as they are.
    """
    checks = PROBES * max(2, MAX_CHECKED // (PROBES * drawer.count))
    ratio = np.asarray(drawer.all(check_key, every(population, evenly(length.total, checks))).log_ratio)
    scatter, k = unrest(ratio), pareto_k(ratio)
    wild: set[int] = set()

    def total(which: int, rows: np.ndarray) -> np.ndarray:
        probes, own = every(population, rows), jax.random.fold_in(check_key, which)
        ratio = np.maximum(drawer.all(own, probes, common=True).log_ratio, LOWEST)
        # A single candidate may fall off a cliff of the likelihood as the population moves, which says nothing of all.
        if len(unsteady := np.flatnonzero(np.ptp(ratio, axis=0) > UNSTEADY)):
            better = drawer.some(own, unsteady, probes, CANDIDATES[-1], common=True).log_ratio
            ratio[:, unsteady] = np.maximum(better, LOWEST)
        if len(unsteady := np.flatnonzero(np.ptp(ratio, axis=0) > UNSTEADY)):
            wild.update(unsteady.tolist())
            ratio[:, unsteady] = 0.0
        return ratio.sum(1)

    log_weight, error = correction(total, parameters)
    notes = []
    if error > UNSURE:
        notes.append(f"the means of the population are known to {error:.2f} of their standard deviations only")
    if wild:
        notes.append(f"{len(wild)} particles act on the population through their quadratic summary alone")
    chosen, k_joint = _resampled(log_weight, length)
    keep = max(1, -(-length.total * drawer.count // MAX_PARTICLE_DRAWS))
    some = every(every(population, chosen), keep)
    particles = drawer.all(particle_key, some, 0)
    restless = np.flatnonzero((scatter > RESTLESS_OF_MANY) | (k > PARETO_K_MOST))
    drawer.settle(pick_key, particles, some, k, restless, CANDIDATES_OF_MANY)
    # The regression tells how the correction changes over the posterior; how large it is, every particle tells alone.
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
    """Which draws stand for the weighted ones, in order within each chain, and the Pareto k of the weights."""
    weight, k = smoothed_weights(log_weight)
    rows = (slice(c * length.draws, (c + 1) * length.draws) for c in range(length.chains))
    return np.concatenate([row.start + ordered_resample(weight[row], length.draws) for row in rows]), k
