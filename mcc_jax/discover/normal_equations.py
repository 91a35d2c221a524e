"""Gram matrices of whitened columns, particles' own parameters integrated out; functions over batches of particles."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .legacy.compiling import compiled

BATCH = 20
"""Particles at a time: campaigns of any number share what is compiled."""


def in_batches[T](function: Callable[..., T], rows: tuple[Any, ...]) -> T:
    """A function over the particles of some trees of arrays, `BATCH` at a time; the last batch is filled up with
    copies."""
    count = len(jax.tree.leaves(rows)[0])
    if count == BATCH:
        return function(*rows)
    parts = []
    for start in range(0, count, BATCH):
        index = np.minimum(np.arange(start, start + BATCH), count - 1)
        part = function(*jax.tree.map(lambda leaf, index=index: jnp.asarray(np.asarray(leaf)[index]), rows))
        parts.append(jax.tree.map(lambda leaf, start=start: leaf[: count - start], part))
    return cast(T, jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts))


def gram_matrices(
    turned, residual, jacobian, mask, loaded, filters, added, seen, away, by_globals, factor, zero_sd, zero_away
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gram matrices, particles' deviations and zeros integrated out: of all columns; what curvature adds to their
    products with the residual; of steps of 1 um at the points of first loading with these; of steps among themselves.
    """
    missing = -added.shape[1] % COLUMNS
    wide = jnp.pad(added, ((0, 0), (0, missing), (0, 0)))
    end = 1 + by_globals.shape[-1] + added.shape[1]
    behind = factor.shape[-1] + 1 + end
    turn = jnp.asarray(np.insert(turned, [behind] * missing, 0.0, axis=1))
    rows = (turn, residual, jacobian, mask, loaded, filters, wide, seen, away, by_globals, factor, zero_away)
    gram, curved, cross, among = map(np.asarray, in_batches(partial(_gram, zero_sd=zero_sd), rows))
    kept = np.r_[:end, end + missing : gram.shape[1]]
    return gram[:, kept[:, None], kept], curved[:, kept], cross[:, :, kept], among


def own_rows(jacobian, factor) -> Float[Array, "columns points"]:
    """What a particle's own deviations, in units of the population's spread, and its zero do to its residual."""
    return jnp.concatenate([(jacobian[:, :4] @ factor).T, jacobian[:, 4][None]])


def common_rows(residual, jacobian, offset, zero_away, by_globals) -> Float[Array, "columns points"]:
    """The residual of a particle that is as the population expects, and what the population's parameters do to it."""
    own, zero = jacobian[:, :4], jacobian[:, 4]
    return jnp.concatenate([(residual + own @ offset - zero * zero_away)[None], (own @ by_globals).T])


COLUMNS = 200
"""Columns of candidates are filled up to a multiple of this: libraries of any size share what is compiled."""


@compiled
def _gram(turned, residual, jacobian, mask, loaded, filters, added, seen, away, by_globals, factor, zero_away, zero_sd):
    k, places = factor.shape[-1], jnp.arange(residual.shape[-1])

    def one(turn, r, J, used, first, white, extra, words, offset, slope, S, z):
        after = (places[None] >= places[:, None]) & used[None] & first[:, None]
        columns = jnp.concatenate(
            [
                own_rows(J, S),
                common_rows(r, J, offset, z, slope),
                jnp.where(used[None], extra, 0.0),
                jnp.where(used[None], words, 0.0),
                jnp.where(after, -1.0, 0.0),
            ]
        )
        X = jax.vmap(white)(columns)
        A = X @ X.T
        prior = jnp.concatenate([jnp.ones(k), 1 / zero_sd[None] ** 2])
        inner, border = A[: k + 1, : k + 1] + jnp.diag(prior), A[: k + 1, k + 1 :]
        solved = jnp.linalg.solve(inner, border)
        left = A[k + 1 :, k + 1 :] - border.T @ solved
        # chi2 itself is left as it is: what curvature adds there is the same for all columns.
        added = jnp.pad(turn[k + 1 :], (0, len(places))) - turn[: k + 1] @ solved
        added = added.at[0].set(0.0)
        left = left.at[0].add(added).at[:, 0].add(added)
        end = left.shape[0] - len(places)
        return left[:end, :end], added[:end], left[end:, :end], left[end:, end:]

    rows = (turned, residual, jacobian, mask, loaded, filters, added, seen, away, by_globals, factor, zero_away)
    return jax.vmap(one)(*rows)
