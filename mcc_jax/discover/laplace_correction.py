r"""What curvature adds to the scores: how the space of a particle's own parameters turns under a column.

Particles' own parameters are integrated out as if the law were linear in them around each particle's fit. That leaves
out that what the data say of them is sharper or wider elsewhere, and a column moves them. With H the curvature of a
particle's own parameters b, X their columns and x any other column, Laplace's integral holds

.. math:: \tfrac12 \log|H(\hat b(\theta), \theta)|, \qquad
    \frac{d}{d\theta} = t_x - t_X^T H^{-1} X^T x, \qquad t_x = \operatorname{tr}(H^{-1} X^T \partial_b x)

which is what the Gram matrix gives where t is added to the columns' products with the residual. Without it a column
that makes particles more alike is asked for by every campaign: a displacement of one size for all takes away a part of
the scatter of stiffness between them, although nothing is missing. (Tierney and Kadane 1986; the term is a Jacobian
where a test tells its parameters exactly.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .legacy.compiling import compiled
from .normal_equations import in_batches, own_rows


@dataclass(frozen=True)
class Turned:
    """How columns change with the particles' latent vectors.

    Attributes:
        own: second derivatives of the residuals, by latent vector and zero, by the latent vectors: (N, 4, points, 5).
        signals: of candidates, map, words and formula, shape (N, 4, columns, points).
    """

    own: np.ndarray
    signals: np.ndarray


STEP = 1e-4
"""Step of a logarithm in the differences by it."""


def by_latent(value_at: Callable[[Array], Array], latent: Float[Array, "particles 4"], value: Array) -> np.ndarray:
    """Derivatives of something by the particles' latent vectors, shape (N, 4, ...): differences, in single precision.

    Differences need no compilation of their own, and their error is that of nothing larger than the correction itself.
    """
    steps = STEP * np.eye(latent.shape[1])
    found = [np.asarray((value_at(latent + jnp.asarray(step)[None]) - value) / STEP, np.float32) for step in steps]
    return np.stack(found, 1)


@compiled
def _weights(jacobian, mask, filters, factor, zero_sd) -> Float[Array, "particles 4 points"]:
    """What a change of residuals along a latent coordinate counts in the trace."""
    k = factor.shape[-1]

    def one(J, used, white, S):
        rows = jnp.where(used[None], own_rows(J, S), 0.0)
        whiten = jax.vmap(white)
        X, back = jax.vjp(whiten, rows)
        inner = X @ X.T + jnp.diag(jnp.concatenate([jnp.ones(k), 1 / zero_sd[None] ** 2]))
        (weights,) = back(jnp.linalg.solve(inner, X))
        return jnp.where(used[None], S @ weights[:k], 0.0)

    return jax.vmap(one)(jacobian, mask, filters, factor)


def turning(jacobian: Array, turned: Turned, mask, filters, factor, by_globals, zero_sd) -> np.ndarray:
    """t of a particle's own columns, residual (0), population's parameters and signals, shape (N, k + 1 + Q).

    Args:
        jacobian: of the residuals by latent vector and zero, shape (N, points, 5).
        turned: how it and the signals change.
        mask, filters, factor, by_globals, zero_sd: as for the Gram matrices.
    """
    weights = np.asarray(in_batches(partial(_weights, zero_sd=zero_sd), (jacobian, mask, filters, factor)))
    own = np.einsum("nlp,nlpm->nm", weights, turned.own[..., :4])
    seen = np.einsum("nlp,nlcp->nc", weights.astype(np.float32), turned.signals, optimize=True)
    none = np.zeros((len(own), 1))
    spread, common = (np.einsum("nm,nmk->nk", own, np.asarray(part)) for part in (factor, by_globals))
    return np.concatenate([spread, none, none, common, seen], 1)
