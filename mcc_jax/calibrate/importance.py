r"""Independent draws of the population, by adaptive importance sampling.

With the particles integrated out the population's posterior has seven to eleven coordinates, in which it is nearly
normal. Independent draws :math:`\theta_s` of a Student distribution around the mode are weighted by
:math:`w_s \propto p(\theta_s \mid \text{tests}) / q(\theta_s)`, and one distribution more is fitted to all weighted
draws, q the mixture of all so far, until the weights' Pareto k and effective size are good enough (adaptive multiple
importance sampling, Cornuet et al. 2012; Vehtari et al. 2024). Else NUTS has to run, four times as long to compile.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from itertools import product
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .mode import DIFFERENCE, LogPosterior, expanded, log_densities, populations
from .population import Population

# A posterior counts as converged with an R-hat of at most, a bulk ESS of at least and a Pareto k of at most this
# (Vehtari et al. 2021, 2024).
MOST_RHAT, LEAST_ESS, MOST_PARETO_K = 1.01, 400.0, 0.7

# Found by trial on simulated campaigns (`benchmarks/study_modes.py`, `study_posterior.py`).
FREEDOM = 10  # degrees of freedom of the Student proposal: its tails are wider than the posterior's
ROUNDS = 6  # most distributions that are proposed from
TRIAL = 4000  # draws that a proposal is tried on, and fitted to; of large campaigns a quarter
ENOUGH = 5  # effective draws per coordinate that a distribution may be fitted to; weights are tempered if need be
GOOD_SHARE = 0.5  # effective share of the proposed draws from which on no further distribution is fitted
# Where the first is not good enough: distributions around the most probable population at so many values on either side
# of each spread, one standard deviation from each other, found in so many steps; each gets one such part of a trial.
NODES, NEWTON, PARTS = 3, 4, 4
LEAST = 800.0  # least effective number of proposed draws with which they are used; fewer, and NUTS runs
# So many times as many effective draws as are kept are proposed, at most as many as all rounds would.
PROPOSED = 1.5


class Weighted(NamedTuple):
    """Draws of the population in unbounded coordinates and as populations, chains in a row; whether their weights are
    good enough; the logarithm of the density's integral and its standard error."""

    free: np.ndarray
    population: Population
    good: bool
    log_evidence: float = np.nan
    error: float = np.inf


def sample_weighted(
    key: Array, mode: Array, covariance: Array, target: LogPosterior, *, chains: int, draws: int, many: bool = False
) -> Weighted:
    """Draws of the population by importance resampling, each chain from its own proposals; of the first proposal alone
    if no weights are good enough. Of `many` particles, with an expensive density, no more is proposed than is kept."""
    from scipy.special import logsumexp

    kept = chains * draws
    trial = min(TRIAL // 4, kept) if many else TRIAL
    mixture = _Mixture(np.asarray(jax.random.key_data(key)), target)
    centre, width = mixture.folded(np.array(mode)), np.asarray(covariance)
    first: Any = None
    for turn in range(ROUNDS):
        mixture.propose(centre, width, trial)
        first = first or (mixture.free, mixture.log_weight)
        weight, k = smoothed_weights(mixture.log_weight)
        share = effective_share(weight)
        last = turn == ROUNDS - 1
        if k <= MOST_PARETO_K and (share >= GOOD_SHARE or share * len(weight) >= kept or last):
            total = kept if many else min(math.ceil(PROPOSED * kept / share), ROUNDS * trial)
            if total > len(weight):
                mixture.propose(centre, width, total - len(weight))
                weight, k = smoothed_weights(mixture.log_weight)
                share = effective_share(weight)
            if k <= MOST_PARETO_K and share * len(weight) >= LEAST:
                value = float(cast(Any, logsumexp(mixture.log_weight))) - math.log(len(weight))
                error = math.sqrt(max(1 / share - 1, 0.0) / len(weight))
                return Weighted(*_resampled(mixture.free, weight, target, chains, draws), True, value, error)
        if turn == 0:
            # The population parameters are known the better the smaller a spread is: a funnel, into which narrower
            # distributions reach, each around the most probable population at one value of a spread.
            for place in target.signed():
                for centre, width in _along(place, np.array(mode), np.asarray(covariance), target):
                    mixture.propose(mixture.folded(centre), width, trial // PARTS)
        weight = _tempered(mixture.log_weight, ENOUGH * len(mode))
        if weight is None:
            break
        centre = weight @ mixture.free
        width = (mixture.free - centre).T @ (weight[:, None] * (mixture.free - centre))
    free, log_weight = first
    finite = np.where(np.isfinite(log_weight), log_weight, -np.inf)
    weight = np.exp(finite - finite.max()) if np.isfinite(finite).any() else np.ones(len(finite))
    return Weighted(*_resampled(free, weight / weight.sum(), target, chains, draws), False)


def _along(
    place: int, mode: np.ndarray, covariance: np.ndarray, target: LogPosterior
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Mean and covariance of the population at values of one coordinate on both sides of its mode."""
    sd = np.sqrt(np.diagonal(covariance))
    others = np.delete(np.arange(len(mode)), place)
    for side in (-1, 1):
        free, within, curvature = np.array(mode), covariance[np.ix_(others, others)], np.zeros_like(covariance)
        for _ in range(NODES):
            free[place] += side * sd[place]
            if free[place] < -0.5 * sd[place]:
                break
            for _ in range(NEWTON):  # the others follow
                _, slope, curvature = expanded(free, DIFFERENCE * np.minimum(sd, 1.0), target)
                if not (np.isfinite(slope).all() and np.isfinite(curvature).all()):
                    return
                within = _inverse(curvature[np.ix_(others, others)], sd[others])
                step = within @ slope[others]
                free[others] -= step / max(1.0, float(np.max(np.abs(step) / sd[others])))
            tangent = -within @ curvature[others, place]
            width = np.zeros_like(covariance)
            width[np.ix_(others, others)] = within + sd[place] ** 2 * np.outer(tangent, tangent)
            width[others, place] = width[place, others] = sd[place] ** 2 * tangent
            width[place, place] = sd[place] ** 2
            yield free.copy(), width


def _inverse(curvature: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """The inverse, on the scale of each coordinate; what is not convex is taken as wide."""
    values, vectors = np.linalg.eigh(curvature * sd * sd[:, None])
    return (vectors / np.where(values > 0.01, values, 0.1)) @ vectors.T * sd * sd[:, None]


def _factor(covariance: np.ndarray) -> np.ndarray:
    """Lower triangular factor of a covariance whose numbers span many powers of ten, of what rounding left of it."""
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(sd, sd))
    correlation = (vectors * np.maximum(values, 1e-12 * values[-1])) @ vectors.T
    return sd[:, None] * np.linalg.cholesky(correlation + 1e-13 * np.eye(len(sd)))


class _Mixture:
    """Draws of one Student distribution after another, all weighted by the mixture of them, and folded: a spread's
    coordinate may have either sign for the same spread."""

    def __init__(self, seed: np.ndarray, target: LogPosterior) -> None:
        from scipy.stats import multivariate_t

        self._rng, self._target = np.random.default_rng(seed), target
        self._spreads = np.array(target.signed())
        d = len(target.names)
        self._flipped = np.array(list(product((0.0, 1.0), repeat=len(self._spreads))))  # all choices of signs
        # Standard deviations of coordinates differ by many powers of ten, for which SciPy takes a matrix for singular.
        shape = cast(Any, np.eye(d) * (1 - 2 / FREEDOM))  # its stub takes a number
        self._unit = multivariate_t(np.zeros(d), shape, FREEDOM)
        self._constant = float(self._unit.logpdf(np.zeros(d)))
        self._parts: list[tuple[np.ndarray, np.ndarray, int]] = []
        self.free, self._log_density = np.empty((0, d)), np.empty(0)
        self._log_proposals = np.empty((0, 0))

    def folded(self, free: np.ndarray) -> np.ndarray:
        """Spreads' coordinates made positive."""
        free[..., self._spreads] = np.abs(free[..., self._spreads])
        return free

    def propose(self, centre: np.ndarray, width: np.ndarray, count: int) -> None:
        """Add draws of one more distribution, with its mean and covariance."""
        factor = _factor(width)
        new = self.folded(centre + np.asarray(self._unit.rvs(size=count, random_state=self._rng)) @ factor.T)
        self.free = np.concatenate([self.free, new])
        self._log_density = np.concatenate([self._log_density, log_densities(new, self._target)])
        old = [self._proposal(new, *part[:2]) for part in self._parts]
        known = np.concatenate([self._log_proposals, np.stack(old, 1) if old else np.empty((count, 0))])
        inverse = np.tril(np.linalg.inv(factor))
        self._parts.append((centre, inverse, count))
        self._log_proposals = np.column_stack([known, self._proposal(self.free, centre, inverse)])

    @property
    def log_weight(self) -> np.ndarray:
        from scipy.special import logsumexp

        share = np.log([count for *_, count in self._parts]) - np.log(len(self.free))
        # The density is even in every spread's coordinate: folded, as much again for each.
        twice = len(self._spreads) * math.log(2)
        mixture = np.asarray(logsumexp(self._log_proposals + share, axis=1))
        return self._log_density + twice - mixture

    def _proposal(self, free: np.ndarray, centre: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Log density of a distribution, folded, given the inverse of its covariance's factor.

        Changing the sign of x_i adds -2 x_i k_i to the whitened z, k_i the i-th column of the inverse factor, and so
        -4 x_i (z . k_i) to its square, and 4 x_i x_j (k_i . k_j) for each pair.
        """
        columns, own, flipped = inverse[:, self._spreads], free[:, self._spreads], self._flipped
        white = (free - centre) @ inverse.T
        products = (own[:, :, None] * own[:, None, :] * (columns.T @ columns)).reshape(len(free), -1)
        pairs = (flipped[:, :, None] * flipped[:, None, :]).reshape(len(flipped), -1)
        change = 4 * (pairs @ products.T - flipped @ (own * (white @ columns)).T)
        away = 1 + np.maximum(np.einsum("nd,nd->n", white, white) + change, 0.0) / (FREEDOM - 2)
        least, power = away.min(0), 0.5 * (FREEDOM + len(inverse))
        density = np.log(((least / away) ** power).sum(0)) - power * np.log(least)
        return self._constant + density + np.sum(np.log(np.diagonal(inverse)))


def _tempered(log_weight: np.ndarray, enough: int) -> np.ndarray | None:
    """Weights to a power of at most 1 at which they are as many effective draws as a covariance takes, if there is."""
    finite = np.where(np.isfinite(log_weight), log_weight, -np.inf)
    if np.isfinite(finite).sum() < enough:
        return None
    log = finite - finite.max()
    for power in 0.8 ** np.arange(30):
        weight = np.exp(power * log)
        weight /= weight.sum()
        if effective_share(weight) * len(weight) >= enough:
            return weight
    return None


def _resampled(
    free: np.ndarray, weight: np.ndarray, target: LogPosterior, chains: int, draws: int
) -> tuple[np.ndarray, Population]:
    """Weighted draws as equally weighted ones, each chain from draws of its own, in no order."""
    parts = np.split(np.random.default_rng(len(free)).permutation(len(free) - len(free) % chains), chains)
    chosen = np.concatenate([free[part][ordered_resample(weight[part], draws)] for part in parts])
    return chosen, jax.tree.map(np.asarray, populations(jnp.asarray(chosen), target))


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


def relative_scatter(log_weight: np.ndarray) -> np.ndarray:
    """Standard deviation of each particle's weights over their mean, draws along the first axis."""
    relative = np.exp(np.maximum(log_weight - np.maximum(log_weight.max(0), -1e300), -700.0))
    return relative.std(0) / np.maximum(relative.mean(0), 1e-300)


def smoothed(log_weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Pareto-smoothed log weights that add up to 1, and their k: infinite if no tail can be fitted, 0 if all equal."""
    from arviz_stats.base.array import array_stats

    finite = np.where(np.isfinite(log_weight), log_weight, -1e10)
    if np.std(finite) <= 1e-9:
        return np.full(len(finite), -np.log(len(finite))), 0.0
    with np.errstate(all="ignore"), contextlib.suppress(ValueError):
        found, k = array_stats.psislw(-finite, axis=-1)  # of log likelihoods, whose weights are their inverse
        if np.isfinite(found).all():  # else one weight has everything
            return np.asarray(found), float(k) if np.isfinite(k) else np.inf
    return finite - np.logaddexp.reduce(finite), np.inf


def pareto_k(log_weight: np.ndarray) -> np.ndarray:
    """Pareto k of importance weights, draws along the first axis."""
    return np.array([smoothed(one)[1] for one in log_weight.T])


def smoothed_weights(log_weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Pareto-smoothed importance weights that add up to 1, and their k."""
    smooth, k = smoothed(log_weight)
    return np.exp(smooth), k


def effective_share(weight: np.ndarray) -> float:
    """Effective number of draws with normalised weights, as a share of their number."""
    return float(1 / (len(weight) * np.sum(weight**2)))


def ordered_resample(weight: np.ndarray, count: int) -> np.ndarray:
    """Systematic resampling that keeps the order of the draws, so that autocorrelation still shows."""
    share = weight / weight.sum() if weight.sum() > 0 else np.full(len(weight), 1 / len(weight))
    return np.minimum(np.searchsorted(np.cumsum(share), (np.arange(count) + 0.5) / count), len(weight) - 1)
