"""Many campaigns, one after another or a few at once, and one compilation for all of about the same size."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax

from .. import arguments
from .._errors import InputError
from ..campaign import THRESHOLD_MPA, Campaign, check_campaign
from .compiling import one_blas_thread
from .data import select
from .least_squares import LeastSquares, least_squares
from .posterior import Posterior, sample
from .sharding import block_size

Calibration = Posterior | LeastSquares


@one_blas_thread
def calibrate_many(
    campaigns: Iterable[Campaign],
    *,
    method: str = "bayes",
    threshold_MPa: float = THRESHOLD_MPA,
    workers: int = 1,
    progress: Callable[[int, str], None] | None = None,
    **settings: Any,
) -> list[Calibration | Exception]:
    """Calibrate many campaigns.

    Campaigns of similar size share one compilation: every calibration fills its campaign up to one of few sizes, with
    copies of a particle that count for nothing and with masked points. So every result is that of `sample` or
    `least_squares` with the same settings and seed, bit for bit, whatever else stands in the queue. The
    posterior's mode "joint" fills up points only.

    Args:
        campaigns: the campaigns.
        method: "bayes" or "least-squares".
        threshold_MPa: points below this stress on loading do not count [MPa].
        workers: how many campaigns to calibrate at once, in threads; the first of each size goes ahead alone, so that
            its compilation serves the others. With several devices or processes there is one: each campaign takes
            them all.
        progress: called with a campaign's position and the name of its step, "done" or "failed" last; with several
            workers from their threads.
        settings: of `sample` or `least_squares`: model, seed, chains, loss, ...

    Returns:
        Results in the order of the campaigns; in place of one that fails, its exception.

    Raises:
        InputError: if the method is unknown, there is no worker, or one of the campaigns is none.
        TypeError: for settings that the method does not have.
    """
    methods: dict[str, Callable[..., Calibration]] = {"bayes": sample, "least-squares": least_squares}
    calibrate = methods[arguments.choice(method, methods, "method")]
    workers = arguments.whole(workers, "workers", least=1)
    threshold_MPa = arguments.number(threshold_MPa, "threshold_MPa, a stress,", least=0)
    if isinstance(campaigns, str | Path | Campaign) or not isinstance(campaigns, Iterable):
        raise InputError(f"campaigns must be a list of campaigns, got {arguments.kind_of(campaigns)}")
    names = set(inspect.signature(calibrate).parameters) - {"campaign", "progress", "threshold_MPa"}
    unknown = sorted(set(settings) - names)
    if unknown:
        raise TypeError(f"{method} has no setting {', '.join(unknown)}; it has: {', '.join(sorted(names))}")
    queue = list(campaigns)
    for i, item in enumerate(queue, start=1):
        if not isinstance(item, Campaign):  # one that is damaged stands in its place with its error
            check_campaign(item, f"campaign {i}")
    results: list[Calibration | Exception] = [RuntimeError("was not calibrated") for _ in queue]
    tell = progress or (lambda _, __: None)

    def one(i: int) -> None:
        try:
            results[i] = calibrate(
                queue[i], threshold_MPa=threshold_MPa, progress=lambda step: tell(i, step), **settings
            )
        except Exception as error:  # whatever it is, it stands in its campaign's place
            results[i] = error
        tell(i, "failed" if isinstance(results[i], Exception) else "done")

    if workers == 1 or jax.device_count() > 1:
        for i in range(len(queue)):
            one(i)
        return results
    ahead = _first_of_each_size(queue, threshold_MPa)
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, ahead))
        list(pool.map(one, [i for i in range(len(queue)) if i not in ahead]))
    return results


def _first_of_each_size(campaigns: list[Campaign], threshold_MPa: float) -> list[int]:
    """Positions of the first campaign of every size that is compiled for."""
    first: dict[tuple[int, int], int] = {}
    for i, campaign in enumerate(campaigns):
        try:
            particles, points = select(campaign, threshold_MPa=threshold_MPa).tests.force.shape
        except Exception:  # whatever is wrong with it is told when its turn comes
            continue
        block = block_size(particles)
        first.setdefault((particles + -particles % block, points), i)
    return list(first.values())
