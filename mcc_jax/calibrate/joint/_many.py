"""Many campaigns, one after another or a few at once, with as few compilations as their sizes allow."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

from ...campaign import THRESHOLD_MPA, Campaign
from ._bayes import BayesCalibration, posterior
from ._data import select_tests
from ._least_squares import LeastSquaresCalibration, least_squares

LEAST_FILLED = 0.6
"""Campaigns share a compilation if the smaller has at least this share of the larger's particles, and of its points:
what they are filled up with costs time in every run, a compilation once."""

Size = tuple[int, int]
Calibration = BayesCalibration | LeastSquaresCalibration


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

    Campaigns of similar size share one compilation: the smaller ones are filled up, with copies of a particle that
    count for nothing and with masked points. Every result is that of `calibrate_bayes` or `calibrate_least_squares`
    with the same settings and seed, to rounding; bit for bit where nothing had to be filled up. The posterior's mode
    "joint" fills up points only.

    Args:
        campaigns: the campaigns.
        method: "bayes" or "least-squares".
        threshold_MPa: points below this stress on loading do not count [MPa].
        workers: how many campaigns to calibrate at once, in threads; the first of each size goes ahead alone, so that
            its compilation serves the others. With several devices there is one: each campaign takes them all.
        progress: called with a campaign's position and the name of its step, "done" or "failed" last; with several
            workers from their threads.
        settings: of `calibrate_bayes` or `calibrate_least_squares`: model, seed, chains, loss, ...

    Returns:
        Results in the order of the campaigns; in place of one that fails, its exception.

    Raises:
        ValueError: if the method is unknown or there is no worker.
        TypeError: for settings that the method does not have.
    """
    methods: dict[str, Callable[..., Calibration]] = {"bayes": posterior, "least-squares": least_squares}
    if method not in methods:
        raise ValueError(f"the method must be one of {', '.join(methods)}, got {method!r}")
    if workers < 1:
        raise ValueError(f"there must be at least one worker, got {workers}")
    names = set(inspect.signature(methods[method]).parameters) - {"campaign", "size", "progress", "threshold_MPa"}
    unknown = sorted(set(settings) - names)
    if unknown:
        raise TypeError(f"{method} has no setting {', '.join(unknown)}; it has: {', '.join(sorted(names))}")
    calibrate = methods[method]
    queue = list(campaigns)
    results: list[Calibration | Exception] = [RuntimeError("was not calibrated") for _ in queue]
    tell = progress or (lambda _, __: None)

    def one(task: tuple[int, Size]) -> None:
        i, size = task
        try:
            results[i] = calibrate(
                queue[i],
                threshold_MPa=threshold_MPa,
                size=size,
                progress=lambda step: tell(i, step),
                **settings,
            )
        except Exception as error:  # whatever it is, it stands in its campaign's place
            results[i] = error
        tell(i, "failed" if isinstance(results[i], Exception) else "done")

    sizes: dict[int, Size] = {}
    for i, campaign in enumerate(queue):
        try:
            particles, points = select_tests(campaign, threshold_MPa=threshold_MPa).tests.force.shape
        except Exception as error:
            results[i] = error
            tell(i, "failed")
        else:
            sizes[i] = (particles, points)
    groups = _groups(sizes, particles=settings.get("mode", "fast") == "fast")
    if workers == 1 or jax.local_device_count() > 1:
        for size, members in groups:
            for i in members:
                one((i, size))
        return results
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, [(members[0], size) for size, members in groups]))
        list(pool.map(one, [(i, size) for size, members in groups for i in members[1:]]))
    return results


def _groups(sizes: dict[int, Size], *, particles: bool) -> Sequence[tuple[Size, list[int]]]:
    """Sizes to fill up to, and the positions of the campaigns that share each; the largest first.

    The number of particles is 0 where all have the same, and nothing has to be filled up.
    """
    groups: list[tuple[Size, list[int]]] = []
    for i, size in sorted(sizes.items(), key=lambda item: (-item[1][0], -item[1][1])):
        for g, (common, members) in enumerate(groups):
            enough = size[0] >= LEAST_FILLED * common[0] if particles else size[0] == common[0]
            low, high = sorted((size[1], common[1]))
            if enough and low >= LEAST_FILLED * high:
                groups[g] = ((common[0], high), [*members, i])
                break
        else:
            groups.append((size, [i]))
    mixed = [len({sizes[i][0] for i in members}) > 1 for _, members in groups]
    return [((n if fill else 0, points), own) for fill, ((n, points), own) in zip(mixed, groups, strict=True)]
