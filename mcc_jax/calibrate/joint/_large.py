r"""Populations of many particles, whose posterior is sharp and nearly normal: two shortcuts, both checked.

The more particles, the dearer a gradient of the population's density and the closer that density to a normal one.
So instead of many thousand gradients along trajectories, independent draws :math:`\theta_s` of a Student distribution
around the mode are weighted,

.. math:: w_s \propto p(\theta_s \mid \text{tests}) / q(\theta_s)

and the proposal is fitted to its own weighted draws until the weights' Pareto k and effective size say that it is good
enough (Cappe et al. 2004; Vehtari et al. 2024). If they never do, the sampler runs as for few particles.

The exact weight of a draw is the product of all particles' ratios of exact to quadratic likelihood. Of many particles
the product scatters far more than it says: nearly all of its scatter is that of the particles' own draws. With the same
random numbers for every draw of the population that scatter cancels, and what is left of

.. math:: T(\theta) = \sum_i \log r_i(\theta)

is smooth in :math:`\theta`, and linear over the little that the posterior leaves open: some tens of draws tell it.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._compile import compiled
from ._mode import FIRST_SPREAD, Target
from ._nuts import Chains
from ._population import Population
from ._weights import PARETO_K_MOST, effective_share, ordered_resample, smoothed_weights

FREEDOM = 10
"""Degrees of freedom of the Student proposal: its tails are wider than the posterior's."""

ROUNDS = 5
"""How often the proposal may be fitted anew."""

ENOUGH = 5
"""Effective draws per coordinate that a proposal may be fitted to."""

GOOD_SHARE = 0.5
"""Least effective share of the draws with which weighted ones replace the sampler's, beside the gate of Pareto k."""

AT_A_TIME = 250
"""Draws whose densities are asked for in one go."""

TRIAL = 1000
"""Draws that the proposal is tried on, and fitted to, before all are drawn."""

AT_ONCE = 4096
"""Particles times draws worked on at once: so many numbers of each kind stay in a processor's cache."""


@compiled
def log_densities(free: Float[Array, "many d"], target: Target) -> Float[Array, " many"]:
    """Log density of the population at many coordinates."""
    return jax.lax.map(target.log_density, free, batch_size=max(1, AT_ONCE // len(target.flatness)))


@compiled
def _populations(free: Float[Array, "many d"], target: Target) -> Population:
    return jax.vmap(target.population)(free)


def sample_weighted(
    key: Array, mode: Array, covariance: Array, target: Target, *, chains: int, draws: int
) -> tuple[Chains, Population] | None:
    """Draws of the population by importance resampling, in the sampler's form; None if the weights are not good enough.

    A spread's coordinate may have either sign for the same spread: proposal and draws are folded to positive ones.

    Args:
        key: random key.
        mode, covariance: of the population in unbounded coordinates.
        target: its density.
        chains, draws: shape of what is returned; each chain is resampled from proposals of its own.
    """
    from scipy.linalg import solve_triangular
    from scipy.special import logsumexp
    from scipy.stats import multivariate_t

    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    spreads = np.arange(len(mode))[FIRST_SPREAD : FIRST_SPREAD + target.scatter.size]
    signs = np.ones((2 ** len(spreads), len(mode)))
    signs[:, spreads] = list(product((1.0, -1.0), repeat=len(spreads)))

    def folded(free: np.ndarray) -> np.ndarray:
        free[..., spreads] = np.abs(free[..., spreads])
        return free

    def proposed(count: int) -> tuple[np.ndarray, np.ndarray]:
        """Draws of the proposal and their log weights, up to a constant."""
        factor = np.linalg.cholesky(width)
        standard = np.asarray(unit.rvs(size=int(count + -count % AT_A_TIME), random_state=rng))
        free = folded(centre + standard @ factor.T)
        every_sign = (free[:, None] * signs - centre).reshape(-1, len(mode))
        density = unit.logpdf(solve_triangular(factor, every_sign.T, lower=True).T).reshape(len(free), -1)
        parts = (jnp.asarray(part) for part in np.split(free, len(free) // AT_A_TIME))
        log_density = np.concatenate([np.asarray(log_densities(part, target)) for part in parts])
        log_weight = log_density - logsumexp(density, axis=1)
        return free[:count], log_weight[:count]

    # Standard deviations of coordinates differ by many powers of ten, for which SciPy takes a matrix to be singular.
    shape = cast(Any, np.eye(len(mode)) * (1 - 2 / FREEDOM))  # its stub takes a number
    unit = multivariate_t(np.zeros(len(mode)), shape, FREEDOM)
    total = chains * draws
    centre, width = folded(np.array(mode)), np.asarray(covariance)
    for _ in range(ROUNDS):
        free, log_weight = proposed(min(TRIAL, total))
        if _good(log_weight) and len(free) < total:
            further, more = proposed(total - len(free))
            free, log_weight = np.concatenate([free, further]), np.concatenate([log_weight, more])
        if _good(log_weight) and len(free) == total:
            return _resampled(free, log_weight, target, chains)
        weight, _ = smoothed_weights(log_weight)
        if effective_share(weight) * len(weight) < ENOUGH * len(mode):
            return None
        centre = weight @ free
        width = (free - centre).T @ (weight[:, None] * (free - centre))
    return None


def _good(log_weight: np.ndarray) -> bool:
    weight, k = smoothed_weights(log_weight)
    return k <= PARETO_K_MOST and effective_share(weight) >= GOOD_SHARE


def _resampled(free: np.ndarray, log_weight: np.ndarray, target: Target, chains: int) -> tuple[Chains, Population]:
    """Weighted draws as equally weighted ones, each chain from draws of its own."""
    several = zip(np.split(free, chains), np.split(smoothed_weights(log_weight)[0], chains), strict=True)
    chosen = np.stack([part[ordered_resample(weight, len(part))] for part, weight in several])
    still = np.zeros(chosen.shape[:2], int)
    run = Chains(cast(Any, chosen), cast(Any, still > 0), cast(Any, still), cast(Any, np.zeros(chains)))
    population = _populations(jnp.asarray(chosen.reshape(free.shape)), target)
    return run, jax.tree.map(np.asarray, population)


def evenly(count: int, some: int) -> np.ndarray:
    """Positions of some of many draws, spread evenly."""
    return np.linspace(0, count - 1, some).astype(int)


class Correction(NamedTuple):
    """What the exact likelihood adds to the log density of the population.

    Attributes:
        log_weight: of every draw, up to a constant.
        error: standard error of its slope, in standard deviations of the posterior by which it would move the means.
    """

    log_weight: np.ndarray
    error: float


PROBES = 25
"""Draws of the population at which the sum of all particles' log ratios is worked out."""


def correction(total: Callable[[int, np.ndarray], np.ndarray], draws: np.ndarray) -> Correction:
    """Regression of the sum of log ratios on the population's parameters, and its prediction for every draw.

    Args:
        total: the sums at the given rows of `draws`, all with the same random numbers, which depend on the first
            argument: 0 or 1.
        draws: of the parameters, shape (draws, parameters).
    """
    rows = evenly(len(draws), PROBES)
    unit, values, _ = np.linalg.svd(draws - draws.mean(0), full_matrices=False)
    # Uncorrelated and of standard deviation 1, so that a slope is the shift of a mean in standard deviations.
    white = unit[:, values > 1e-9 * values[0]] * np.sqrt(len(draws))
    design = np.concatenate([np.ones((len(rows), 1)), white[rows]], 1)
    slopes = np.stack([np.linalg.lstsq(design, total(which, rows), rcond=None)[0][1:] for which in (0, 1)])
    # Two estimates from independent random numbers: half their difference is the standard error of their mean.
    return Correction(white @ slopes.mean(0), float(np.linalg.norm(slopes[0] - slopes[1]) / 2))
