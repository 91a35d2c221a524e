"""The particles of a campaign drawn back given draws of the population: all of them in blocks, or the few restless."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._blocks import Blocks, count_of
from ._population import Population
from ._sampling import Exact, ParticleDraws, draw_particles
from ._weights import pareto_k, unrest

RESTLESS = 0.3
"""A particle whose weight scatters by more than this share of its mean gets several candidates per draw."""

FEW = 4
"""How many restless particles get most candidates; of many particles one in a hundred."""

GROUP = 64
"""Most restless particles drawn at once."""


class Drawer:
    """Draws of the particles, as arrays of NumPy with the axes (draw, particle), without copies that only fill up.

    Attributes:
        count: number of particles.
    """

    def __init__(self, exact: Exact, block: int, chunk: int | None = None) -> None:
        """Cut the tests into blocks.

        Args:
            exact: the tests.
            block: particles of a block; 0 for a single one.
            chunk: draws of the population worked on in one go, so that one compilation serves any number of them; all
                by default.
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
        found = []
        for i in range(0, draws, chunk):
            rows = np.minimum(np.arange(i, i + chunk), draws - 1)
            own = key if common or not i else jax.random.fold_in(key, i)
            found.append(draw(own, jax.tree.map(lambda x, rows=rows: jnp.asarray(np.asarray(x)[rows]), population)))
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

            def draw(key: Array, population: Population, exact: Exact = exact, count: int = count) -> list[np.ndarray]:
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
        latent, zero, _, ratio = (cast(np.ndarray, v) for v in drawn)
        few = max(FEW, self.count // 100)
        for many in candidates:
            if not len(restless):
                return
            better = self.some(key, restless, population, many)
            latent[:, restless], zero[:, restless] = better.latent, better.zero
            ratio[:, restless] = better.log_ratio
            k[restless] = pareto_k(ratio[:, restless])
            restless = restless[np.argsort(-unrest(ratio[:, restless]))][:few]
            restless = restless[unrest(ratio[:, restless]) > RESTLESS]
