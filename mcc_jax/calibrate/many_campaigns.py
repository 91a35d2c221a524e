"""Many campaigns, one after another, and one compilation for all of about the same size."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from .. import arguments
from .._errors import InputError
from ..campaign import THRESHOLD_MPA, Campaign, check_campaign
from .compiling import one_blas_thread
from .least_squares import LeastSquares, least_squares
from .posterior import Posterior, sample

Calibration = Posterior | LeastSquares


@one_blas_thread
def calibrate_many(
    campaigns: Iterable[Campaign],
    *,
    method: str = "bayes",
    threshold_MPa: float = THRESHOLD_MPA,
    progress: Callable[[int, str], None] | None = None,
    **settings: Any,
) -> list[Calibration | Exception]:
    """Calibrate many campaigns.

    Campaigns of similar size share one compilation: every calibration pads its campaign to one of few sizes, with
    copies of a particle that count for nothing and with masked points. So every result is that of `sample` or
    `least_squares` with the same settings and seed, bit for bit, whatever else is in the queue. The
    posterior's mode "joint" pads points only.

    Args:
        campaigns: the campaigns.
        method: "bayes" or "least-squares".
        threshold_MPa: points below this stress on loading do not count [MPa].
        progress: called with a campaign's position and the name of its step, "done" or "failed" last.
        settings: of `sample` or `least_squares`: model, seed, chains, loss, ...

    Returns:
        Results in the order of the campaigns; in place of one that fails, its exception.

    Raises:
        InputError: if the method is unknown, or one of the campaigns is none.
        TypeError: for settings that the method does not have.
    """
    methods: dict[str, Callable[..., Calibration]] = {"bayes": sample, "least-squares": least_squares}
    calibrate = methods[arguments.choice(method, methods, "method")]
    threshold_MPa = arguments.number(threshold_MPa, "threshold_MPa, a stress,", least=0)
    if isinstance(campaigns, str | Path | Campaign) or not isinstance(campaigns, Iterable):
        raise InputError(f"campaigns must be a list of campaigns, got {arguments.kind_of(campaigns)}")
    names = set(inspect.signature(calibrate).parameters) - {"campaign", "progress", "threshold_MPa"}
    unknown = sorted(set(settings) - names)
    if unknown:
        raise TypeError(f"{method} has no setting {', '.join(unknown)}; it has: {', '.join(sorted(names))}")
    queue = list(campaigns)
    for i, item in enumerate(queue, start=1):
        if not isinstance(item, Campaign):  # the error of a damaged one takes its place
            check_campaign(item, f"campaign {i}")
    results: list[Calibration | Exception] = []
    progress = progress or (lambda _, __: None)

    for i, campaign in enumerate(queue):
        try:
            step = partial(progress, i)
            results.append(calibrate(campaign, threshold_MPa=threshold_MPa, progress=step, **settings))
        except Exception as error:  # whatever it is, it takes its campaign's place
            results.append(error)
        progress(i, "failed" if isinstance(results[i], Exception) else "done")
    return results
