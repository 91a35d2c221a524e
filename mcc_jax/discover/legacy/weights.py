"""Importance weights of draws, and the sampler's diagnostics."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np

PARETO_K_MOST = 0.7
"""Pareto k of importance weights above which they are not to be relied on (Vehtari et al. 2024)."""


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
