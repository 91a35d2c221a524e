"""Comparing models: the fit of one, its log marginal likelihood, and several side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .._errors import InputError
from .._format import described
from .._types import Progress
from ..campaign import THRESHOLD_MPA, Campaign, check_tests
from .compiling import one_blas_thread
from .fitting import checked_settings, prepare
from .importance import smoothed
from .judgement import numbers_in_reach
from .mode import Fit
from .model import Model
from .posterior import Posterior, sample

if TYPE_CHECKING:
    import pandas as pd


@one_blas_thread
def fit(
    campaign: Campaign,
    model: Model | None = None,
    *,
    threshold_MPa: float = THRESHOLD_MPA,
    progress: Progress | None = None,
) -> Fit:
    """Fit particles, noise and population of a campaign: where samplers start, and in what coordinates.

    For the arguments see `sample`.

    Raises:
        InputError: if no particle can be used; for an argument of the wrong kind or out of its range.
    """
    campaign = check_tests(campaign)
    progress, model, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    with numbers_in_reach(campaign):
        selection, found, _ = prepare(campaign, model, threshold_MPa, progress=progress)
    return found.first(len(selection.kept))


@dataclass(frozen=True)
class Evidence:
    """The log marginal likelihood of a model: how probable the tests are under it, all its numbers integrated out.

    Attributes:
        value: natural logarithm.
        error: its standard error; infinite where it is Laplace's approximation alone.
        pareto_k: of the importance weights behind it; above 0.7 they are not to be relied on.
    """

    value: float
    error: float
    pareto_k: float

    __repr__ = described()


def log_evidence(campaign: Campaign | Posterior, model: Model | None = None, *, seed: int = 0) -> Evidence:
    """The log marginal likelihood of a model, by importance sampling around its fit.

    Population and effects are integrated by importance sampling, particles by Laplace's approximation corrected with
    the exact likelihood, the four numbers of the noise by Laplace's method around their mode.

    Args:
        campaign: the tests, or a posterior that was sampled.
        model: what is assumed; of a posterior its own.
        seed: random seed.

    Raises:
        InputError: for a model with robust noise.
    """
    _refuse_robust(campaign.model if isinstance(campaign, Posterior) else model)
    posterior = campaign if isinstance(campaign, Posterior) else sample(campaign, model, seed=seed)
    k = np.inf if posterior.pareto_k_joint is None else posterior.pareto_k_joint
    return Evidence(*posterior.log_evidence, float(k))


def compare(campaign: Campaign, models: Sequence[Model | Posterior], *, seed: int = 0) -> pd.DataFrame:
    """Models of one campaign side by side, one row each.

    Columns: `log_evidence` and its error, `elpd` (expected log predictive density of a particle left out, by
    Pareto-smoothed importance sampling) and its standard error, `elpd_difference` to the best and its error,
    `chi2_per_point` (measured less predicted in standard deviations of the noise of the first model), `rms_um`,
    `noise_share`, `converged`.

    Args:
        campaign: the tests.
        models: models, or posteriors of this campaign that were sampled.
        seed: random seed.

    Raises:
        InputError: for no model, one with robust noise, or posteriors whose tests are not the same.
    """
    import pandas as pd
    from scipy.special import logsumexp

    if not models:
        raise InputError("there is no model to compare")
    for one in models:
        _refuse_robust(one.model if isinstance(one, Posterior) else one)
    found = [one if isinstance(one, Posterior) else sample(campaign, one, seed=seed) for one in models]
    counted = [np.asarray(one.selection.tests.mask).sum(1) for one in found]
    if any(
        one.particles != found[0].particles or not np.array_equal(n, counted[0])
        for one, n in zip(found, counted, strict=True)
    ):
        raise InputError("the posteriors rest on different tests", remedy="Sample them from the same campaign.")
    rows, elpds = [], []
    for one in found:
        lookup = np.moveaxis(one.log_likelihood.reshape(-1, len(one.particles)), 0, -1)
        # Draws of the posterior without a particle are those of all, weighted by one over its likelihood.
        elpds.append(np.array([logsumexp(smoothed(-each)[0] + each) for each in lookup]))
        rows.append(
            {
                "model": ", ".join(one.model.variants) or "no effects",
                "log_evidence": one.log_evidence[0],
                "log_evidence_error": one.log_evidence[1],
                "elpd": float(elpds[-1].sum()),
                "elpd_error": float(np.std(elpds[-1]) * np.sqrt(len(elpds[-1]))),
                "chi2_per_point": _chi2(one, found[0]),
                "rms_um": float(np.sqrt(np.mean(one.rms_um() ** 2))),
                "noise_share": one.noise_share,
                "converged": one.converged,
            }
        )
    best = int(np.argmax([row["elpd"] for row in rows]))
    for row, elpd in zip(rows, elpds, strict=True):
        away = elpd - elpds[best]
        row["elpd_difference"] = float(away.sum())
        row["elpd_difference_error"] = float(np.std(away) * np.sqrt(len(away)))
    return pd.DataFrame(rows)


def _refuse_robust(model: Model | None) -> None:
    if model is not None and model.robust:
        raise InputError(
            "readings are weighed again in every robust fit, so its likelihood cannot be compared with another's",
            remedy="Compare models with robust=False.",
        )


def _chi2(one: Posterior, base: Posterior) -> float:
    """Mean square of residuals in standard deviations of the white noise of a base model."""
    variance: Any = np.asarray(base.fit.filters.solver.matrix.diag.d)
    noise = base.fit.noise.noise
    white = variance - (np.asarray(noise.scale) * float(noise.correlated))[:, None] ** 2
    mask = np.asarray(base.selection.tests.mask)
    squares = np.asarray(one.fit.residual) ** 2 / np.where(mask, np.maximum(white, 1e-300), 1.0)
    return float(np.where(mask, squares, 0.0).sum() / mask.sum())
