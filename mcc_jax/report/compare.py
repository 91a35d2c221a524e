"""The particles that the page shows: those of the calibration, thinned to what a page can hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from ..calibrate.curves import FittedCurve, measured_curves
from .read import Results


@dataclass(frozen=True)
class PageOptions:
    """How much of the curves stands in the page.

    Attributes:
        points: about so many in all, shared among the particles: 40,000 make a page of 3 MB that still scrolls.
        fewest: of one particle, at least; of more particles than that allows, those that the law misses by most.
    """

    points: int = 40_000
    fewest: int = 40


def compare(results: Results, options: PageOptions | None = None) -> list[FittedCurve]:
    """Every particle, or those that the law misses by most if there are too many; empty without tests."""
    options = options or PageOptions()
    if results.saved is not None:
        curves: Sequence[FittedCurve] = results.saved.curves
    else:
        curves = () if results.campaign is None else measured_curves(results.campaign)
    if not curves:
        return []
    rms = np.array([one.rms_um or 0.0 for one in curves])
    chosen = np.sort(np.argsort(-rms, kind="stable")[: options.points // options.fewest])
    most = max(options.points // len(chosen), options.fewest)
    return [_thinned(curves[i], most) for i in chosen]


def _thinned(one: FittedCurve, most: int) -> FittedCurve:
    """At most about so many points; the ends of segments always."""
    n = len(one.kind)
    stride = -(-n // most)
    if stride <= 1:
        return one
    turns = np.flatnonzero(np.diff(one.kind)) + 1
    rows = np.unique(np.concatenate([np.arange(0, n, stride), turns, turns - 1, [n - 1]]))
    columns = [f.name for f in fields(one) if f.name not in ("name", "why_not")]
    return replace(one, **{name: getattr(one, name)[rows] for name in columns})
