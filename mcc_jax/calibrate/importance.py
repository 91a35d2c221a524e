r"""Independent draws of the population, by adaptive importance sampling.

With the particles integrated out the population's posterior has seven to eleven coordinates, in which it is nearly
normal. So instead of following gradients along trajectories, independent draws :math:`\theta_s` of a Student
distribution around the mode are weighted,

.. math:: w_s \propto p(\theta_s \mid \text{tests}) / q(\theta_s)

and the proposal is fitted to its own weighted draws until the weights' Pareto k and effective size say that it is good
enough (Cappe et al. 2004; Vehtari et al. 2024). If they never do, the sampler has to run (`nuts`). The density by
itself takes a quarter of the sampler's time to compile, and all draws are worked on side by side.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .compiling import compiled, even_batch
from .mode import ROWS, LogPosterior, gradients, populations
from .nuts import Chains, side_by_side
from .population import Population
from .weights import PARETO_K_MOST, effective_share, ordered_resample, smoothed_weights

FREEDOM = 10
"""Degrees of freedom of the Student proposal: its tails are wider than the posterior's."""

ROUNDS = 6
"""How often the proposal may be fitted anew."""

ENOUGH = 5
"""Effective draws per coordinate that a proposal may be fitted to."""

GOOD_SHARE = 0.5
"""Effective share of the proposed draws from which on the proposal need not be fitted any better, beside the gate of
Pareto k."""

MIN_SHARE = 0.1
"""Least effective share with which the proposed draws are used: less, and the sampler is the safer choice."""

EFFECTIVE = 2.0
"""So many times as many effective draws as are kept are proposed. Of large campaigns, whose densities are dear, as many
as are kept are proposed, and `GOOD_SHARE` is asked of them."""

TRIAL = 4000
"""Draws that a proposal is tried on, and fitted to. Of large campaigns as many as are kept, at most a quarter of it."""

AT_ONCE = 4096
"""Particles times draws worked on at once: so many numbers of each kind stay in a processor's cache."""


@compiled
def log_densities(free: Float[Array, "many d"], target: LogPosterior) -> Float[Array, " many"]:
    """Log density of the population at many coordinates."""
    return jax.lax.map(
        target.log_density, free, batch_size=even_batch(len(free), AT_ONCE // len(target.marginal.flatness))
    )


class Weighted(NamedTuple):
    """Draws of the population by importance resampling.

    Attributes:
        run: the draws, in the sampler's form.
        population: the same as populations.
        log_evidence: logarithm of the integral of the density: of the mean weight.
        error: its standard error.
    """

    run: Chains
    population: Population
    log_evidence: float
    error: float


def sample_weighted(
    key: Array,
    mode: Array,
    covariance: Array,
    target: LogPosterior,
    *,
    chains: int,
    draws: int,
    many: bool = False,
    however_bad: bool = False,
) -> Weighted | None:
    """Draws of the population by importance resampling, in the sampler's form; None if the weights are not good enough.

    A spread's coordinate may have either sign for the same spread: proposal and draws are folded to positive ones.

    Args:
        key: random key.
        mode, covariance: of the population in unbounded coordinates.
        target: its density.
        chains, draws: shape of what is returned; each chain is resampled from proposals of its own.
        many: propose no more than is kept: a density is dear.
        however_bad: give the draws of the first round whatever their weights.
    """
    from scipy.linalg import solve_triangular
    from scipy.special import logsumexp
    from scipy.stats import multivariate_t

    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    spreads = np.array(target.signed())
    signs = np.ones((2 ** len(spreads), len(mode)))
    signs[:, spreads] = list(product((1.0, -1.0), repeat=len(spreads)))

    def folded(free: np.ndarray) -> np.ndarray:
        free[..., spreads] = np.abs(free[..., spreads])
        return free

    def densities(part: np.ndarray) -> np.ndarray:
        # Of few particles a gradient takes no time to speak of, and what the mode was found by is compiled already.
        return np.asarray(log_densities(jnp.asarray(part), target)) if many else -gradients(part, target)[0]

    def proposed(count: int) -> tuple[np.ndarray, np.ndarray]:
        """Draws of the proposal and their log weights."""
        factor = np.linalg.cholesky(width)
        standard = np.asarray(unit.rvs(size=int(count + -count % ROWS), random_state=rng))
        free = folded(centre + standard @ factor.T)
        every_sign = (free[:, None] * signs - centre).reshape(-1, len(mode))
        density = unit.logpdf(solve_triangular(factor, every_sign.T, lower=True).T).reshape(len(free), -1)
        log_density = np.concatenate(side_by_side(densities, np.split(free, len(free) // ROWS)))
        # The density is even in every spread's coordinate: folded, as much again for each; and the proposal's volume.
        log_weight = log_density - logsumexp(density, axis=1) + len(spreads) * math.log(2)
        log_weight = log_weight + np.sum(np.log(np.diagonal(factor)))
        return free[:count], log_weight[:count]

    # Standard deviations of coordinates differ by many powers of ten, for which SciPy takes a matrix to be singular.
    shape = cast(Any, np.eye(len(mode)) * (1 - 2 / FREEDOM))  # its stub takes a number
    unit = multivariate_t(np.zeros(len(mode)), shape, FREEDOM)
    kept = chains * draws
    trial = min(TRIAL // 4, kept) if many else TRIAL
    least = GOOD_SHARE if many else MIN_SHARE
    centre, width = folded(np.array(mode)), np.asarray(covariance)
    for turn in range(ROUNDS):
        free, log_weight = proposed(trial)
        if however_bad:
            finite = np.where(np.isfinite(log_weight), log_weight, -np.inf)
            weight = np.exp(finite - finite.max()) if np.isfinite(finite).any() else np.ones(len(finite))
            return Weighted(*_resampled(free, weight / weight.sum(), target, chains, draws), np.nan, np.inf)
        weight, k = smoothed_weights(log_weight)
        share = effective_share(weight)
        if k <= PARETO_K_MOST and share >= (GOOD_SHARE if turn < ROUNDS - 1 else least):
            total = kept if many else chains * math.ceil(EFFECTIVE * draws / share)
            if total > trial:
                further, more = proposed(total - trial)
                free, log_weight = np.concatenate([free, further]), np.concatenate([log_weight, more])
            free, log_weight = free[:total], log_weight[:total]
            weight, k = smoothed_weights(log_weight)
            share = effective_share(weight)
            if k <= PARETO_K_MOST and share >= least:
                value = float(cast(Any, logsumexp(log_weight))) - math.log(len(log_weight))
                error = math.sqrt(max(1 / share - 1, 0.0) / len(weight))
                return Weighted(*_resampled(free, weight, target, chains, draws), value, error)
        if share * len(weight) < ENOUGH * len(mode):
            return None
        centre = weight @ free
        width = (free - centre).T @ (weight[:, None] * (free - centre))
    return None


def _resampled(
    free: np.ndarray, weight: np.ndarray, target: LogPosterior, chains: int, draws: int
) -> tuple[Chains, Population]:
    """Weighted draws as equally weighted ones, each chain from draws of its own."""
    several = zip(np.split(free, chains), np.split(weight, chains), strict=True)
    chosen = np.stack([part[ordered_resample(own, draws)] for part, own in several])
    still = np.zeros(chosen.shape[:2], int)
    run = Chains(cast(Any, chosen), cast(Any, still > 0), cast(Any, still), cast(Any, np.zeros(chains)))
    population = populations(jnp.asarray(chosen.reshape(-1, len(free[0]))), target)
    return run, jax.tree.map(np.asarray, population)
