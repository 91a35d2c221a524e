"""Models of one campaign compared by evidence and held-out particles, and many campaigns in a queue."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import arguments
from .._errors import InputError
from ..campaign import THRESHOLD_MPA, Campaign
from .importance import smoothed
from .least_squares import LeastSquares, least_squares
from .numpyro_model import Model
from .posterior import Posterior, sample
from .running import one_blas_thread

if TYPE_CHECKING:
    import pandas as pd


def compare(campaign: Campaign, models: Sequence[Model | Posterior], *, seed: int = 0) -> pd.DataFrame:
    """Models of one campaign, or posteriors that were sampled of it, side by side, one row each.

    Columns: `log_evidence` and its error, `elpd` (expected log predictive density of a particle left out, by
    Pareto-smoothed importance sampling) and its standard error, `elpd_difference` to the best and its error,
    `chi2_per_point` (measured less predicted in standard deviations of the noise of the first model), `rms_um`,
    `noise_share`, `converged`.

    Raises:
        InputError: for no model, one with robust noise, or posteriors whose tests are not the same.
    """
    import pandas as pd
    from scipy.special import logsumexp

    if not models:
        raise InputError("there is no model to compare")
    if any((one.model if isinstance(one, Posterior) else one).robust for one in models):
        problem = "readings are weighed again in every robust fit, so its likelihood cannot be compared with another's"
        raise InputError(problem, remedy="Compare models with robust=False.")
    found = [one if isinstance(one, Posterior) else sample(campaign, one, seed=seed) for one in models]
    tests = [(one.particles, np.asarray(one.selection.tests.mask).sum(1).tolist()) for one in found]
    if any(one != tests[0] for one in tests):
        raise InputError("the posteriors rest on different tests", remedy="Sample them from the same campaign.")
    # Draws of the posterior without a particle are those of all, weighted by one over its likelihood.
    of_particles = [one.log_likelihood.reshape(-1, len(one.particles)).T for one in found]
    elpd = np.array([[logsumexp(smoothed(-each)[0] + each) for each in log] for log in of_particles])
    difference = elpd - elpd[np.argmax(elpd.sum(1))]
    columns = {
        "model": [", ".join(one.model.variants) or "no effects" for one in found],
        "log_evidence": [one.log_evidence[0] for one in found],
        "log_evidence_error": [one.log_evidence[1] for one in found],
        "elpd": elpd.sum(1),
        "elpd_error": elpd.std(1) * np.sqrt(elpd.shape[1]),
        "chi2_per_point": [_chi2(one, found[0]) for one in found],
        "rms_um": [float(np.sqrt(np.mean(one.rms_um() ** 2))) for one in found],
        "noise_share": [one.noise_share for one in found],
        "converged": [one.converged for one in found],
        "elpd_difference": difference.sum(1),
        "elpd_difference_error": difference.std(1) * np.sqrt(elpd.shape[1]),
    }
    return pd.DataFrame(columns)


def _chi2(one: Posterior, base: Posterior) -> float:
    """Mean square of residuals in standard deviations of the white noise of a base model."""
    variance: Any = np.asarray(base.fit.filters.solver.matrix.diag.d)
    noise = base.fit.noise.noise
    white = variance - (np.asarray(noise.scale) * float(noise.correlated))[:, None] ** 2
    mask = np.asarray(base.selection.tests.mask)
    squares = np.asarray(one.fit.residual) ** 2 / np.where(mask, np.maximum(white, 1e-300), 1.0)
    return float(np.where(mask, squares, 0.0).sum() / mask.sum())


@one_blas_thread
def calibrate_many(
    campaigns: Iterable[Campaign],
    *,
    method: str = "bayes",
    threshold_MPa: float = THRESHOLD_MPA,
    progress: Callable[[int, str], None] | None = None,
    **settings: Any,
) -> list[Posterior | LeastSquares | Exception]:
    """Calibrate many campaigns, one after another; for one that fails the list holds its exception.

    Campaigns of similar size share one compilation: every calibration pads its campaign to one of few sizes, with
    copies of a particle that count for nothing and with masked points. So every result is that of `sample` or
    `least_squares` with the same settings and seed, bit for bit. The posterior's mode "joint" pads points only.

    Args:
        campaigns, threshold_MPa: the tests, and from which stress on they count, as in `sample`.
        method: "bayes" or "least-squares".
        progress: called with a campaign's position and the name of its step, "done" or "failed" last.
        settings: of `sample` or `least_squares`: model, seed, chains, loss, ...; others raise a `TypeError`.
    """
    methods: dict[str, Callable[..., Posterior | LeastSquares]] = {"bayes": sample, "least-squares": least_squares}
    calibrate = methods[arguments.choice(method, methods, "method")]
    inspect.signature(calibrate).bind(None, threshold_MPa=threshold_MPa, progress=None, **settings)
    found: list[Posterior | LeastSquares | Exception] = []
    progress = progress or (lambda _, __: None)
    for i, campaign in enumerate(campaigns):
        step = partial(progress, i)
        try:
            found.append(calibrate(campaign, threshold_MPa=threshold_MPa, progress=step, **settings))
        except Exception as error:  # whatever it is, it takes its campaign's place
            found.append(error)
        step("failed" if isinstance(found[i], Exception) else "done")
    return found
