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

import contextlib
import math
from itertools import product
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .compiling import compiled, even_batch, side_by_side
from .mode import LogPosterior, gradients, populations
from .population import Population
from .settings import FIT, NUMERICS, SAMPLING


@compiled
def log_densities(free: Float[Array, "many d"], target: LogPosterior) -> Float[Array, " many"]:
    """Log density of the population at many coordinates."""
    return jax.lax.map(
        target.log_density, free, batch_size=even_batch(len(free), NUMERICS.densities // len(target.marginal.flatness))
    )


class Weighted(NamedTuple):
    """Draws of the population by importance resampling.

    Attributes:
        population: the draws, all chains in a row.
        log_evidence: logarithm of the integral of the density: of the mean weight.
        error: its standard error.
    """

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
    """Draws of the population by importance resampling; None if the weights are not good enough.

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
        standard = np.asarray(unit.rvs(size=int(count + -count % FIT.gradients), random_state=rng))
        free = folded(centre + standard @ factor.T)
        every_sign = (free[:, None] * signs - centre).reshape(-1, len(mode))
        density = unit.logpdf(solve_triangular(factor, every_sign.T, lower=True).T).reshape(len(free), -1)
        log_density = np.concatenate(side_by_side(densities, np.split(free, len(free) // FIT.gradients)))
        # The density is even in every spread's coordinate: folded, as much again for each; and the proposal's volume.
        log_weight = log_density - logsumexp(density, axis=1) + len(spreads) * math.log(2)
        log_weight = log_weight + np.sum(np.log(np.diagonal(factor)))
        return free[:count], log_weight[:count]

    # Standard deviations of coordinates differ by many powers of ten, for which SciPy takes a matrix to be singular.
    shape = cast(Any, np.eye(len(mode)) * (1 - 2 / SAMPLING.freedom))  # its stub takes a number
    unit = multivariate_t(np.zeros(len(mode)), shape, SAMPLING.freedom)
    kept = chains * draws
    trial = min(SAMPLING.trial // 4, kept) if many else SAMPLING.trial
    least = SAMPLING.good_share if many else SAMPLING.least_share
    centre, width = folded(np.array(mode)), np.asarray(covariance)
    for turn in range(SAMPLING.rounds):
        free, log_weight = proposed(trial)
        if however_bad:
            finite = np.where(np.isfinite(log_weight), log_weight, -np.inf)
            weight = np.exp(finite - finite.max()) if np.isfinite(finite).any() else np.ones(len(finite))
            return Weighted(_resampled(free, weight / weight.sum(), target, chains, draws), np.nan, np.inf)
        weight, k = smoothed_weights(log_weight)
        share = effective_share(weight)
        if k <= SAMPLING.pareto_k and share >= (SAMPLING.good_share if turn < SAMPLING.rounds - 1 else least):
            total = kept if many else chains * math.ceil(SAMPLING.proposed * draws / share)
            if total > trial:
                further, more = proposed(total - trial)
                free, log_weight = np.concatenate([free, further]), np.concatenate([log_weight, more])
            free, log_weight = free[:total], log_weight[:total]
            weight, k = smoothed_weights(log_weight)
            share = effective_share(weight)
            if k <= SAMPLING.pareto_k and share >= least:
                value = float(cast(Any, logsumexp(log_weight))) - math.log(len(log_weight))
                error = math.sqrt(max(1 / share - 1, 0.0) / len(weight))
                return Weighted(_resampled(free, weight, target, chains, draws), value, error)
        if share * len(weight) < SAMPLING.enough * len(mode):
            return None
        centre = weight @ free
        width = (free - centre).T @ (weight[:, None] * (free - centre))
    return None


def _resampled(free: np.ndarray, weight: np.ndarray, target: LogPosterior, chains: int, draws: int) -> Population:
    """Weighted draws as equally weighted ones, each chain from draws of its own."""
    several = zip(np.split(free, chains), np.split(weight, chains), strict=True)
    chosen = np.concatenate([part[ordered_resample(own, draws)] for part, own in several])
    return jax.tree.map(np.asarray, populations(jnp.asarray(chosen), target))


def diagnostics(names: list[str], draws: np.ndarray) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """R-hat, bulk and tail ESS by name, of draws with the axes (chain, draw, name)."""
    from arviz_stats.base.array import array_stats

    axes: dict[str, Any] = {"chain_axis": 0, "draw_axis": 1}
    # Chains that never moved have no variance to divide by; their R-hat then is infinite, as it should be.
    with np.errstate(all="ignore"):
        rhat = array_stats.rhat(draws, **axes)
        bulk = array_stats.ess(draws, method="bulk", **axes)
        tail = array_stats.ess(draws, method="tail", prob=(0.05, 0.95), **axes)

    def named(values: Any) -> dict[str, float]:
        return {n: float(v) for n, v in zip(names, np.atleast_1d(values), strict=True)}

    return named(rhat), named(bulk), named(tail)


def unrest(log_weight: np.ndarray) -> np.ndarray:
    """Standard deviation of each particle's weights over their mean, draws along the first axis."""
    relative = np.exp(np.maximum(log_weight - np.maximum(log_weight.max(0), -1e300), -700.0))
    return relative.std(0) / np.maximum(relative.mean(0), 1e-300)


def pareto_k(log_weight: np.ndarray) -> np.ndarray:
    """Pareto k of importance weights, draws along the first axis."""
    from arviz_stats.base.array import array_stats

    columns = np.where(np.isfinite(log_weight), log_weight, -1e10).T
    result = np.zeros(len(columns))
    # Weights that are all equal have no tail to fit.
    varied = np.std(columns, axis=1) > 1e-9
    if varied.any():
        with np.errstate(all="ignore"):
            result[varied] = array_stats.psislw(-columns[varied], axis=-1)[1]
    return np.where(np.isnan(result), np.inf, result)


def smoothed_weights(log_weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Pareto-smoothed importance weights, normalised, and their k."""
    from arviz_stats.base.array import array_stats

    finite_weight = np.where(np.isfinite(log_weight), log_weight, -1e10)
    if np.std(finite_weight) <= 1e-9:
        return np.full(len(finite_weight), 1 / len(finite_weight)), 0.0
    smooth, k = finite_weight, np.inf
    with np.errstate(all="ignore"), contextlib.suppress(ValueError):  # of a tail whose weights are all the same
        smooth, k = array_stats.psislw(-finite_weight, axis=-1)
    if not np.isfinite(smooth).all():  # one weight holds all: nothing to smooth
        smooth, k = finite_weight, np.inf
    weight = np.exp(np.maximum(np.asarray(smooth) - np.max(smooth), -700.0))
    return weight / weight.sum(), float(k) if np.isfinite(k) else float("inf")


def effective_share(weight: np.ndarray) -> float:
    """Effective number of draws with normalised weights, as a share of their number."""
    return float(1 / (len(weight) * np.sum(weight**2)))


def ordered_resample(weight: np.ndarray, count: int) -> np.ndarray:
    """Systematic resampling that keeps the order of the draws, so that autocorrelation still shows."""
    share = weight / weight.sum() if weight.sum() > 0 else np.full(len(weight), 1 / len(weight))
    return np.minimum(np.searchsorted(np.cumsum(share), (np.arange(count) + 0.5) / count), len(weight) - 1)
