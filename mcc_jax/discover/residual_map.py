"""Where law and data disagree: kind of segment, load, strain, particles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .linear_model import Base, System
from .score import project

WORTH_TELLING = 0.05
FADED = 1e-4
"""Of a place whose information survives the projection by less, the law takes up everything: nothing can be said."""


@dataclass(frozen=True)
class Place:
    """A place of the map of disagreement.

    Attributes:
        segment: kind of segment.
        load_fraction: range of force over the test's largest force [-].
        statistic: estimate of an addition there over its standard error [-], positive where more displacement is
            measured than the law says; NaN where there are no points, or where the law's own parameters take up
            whatever is added.
    """

    segment: str
    load_fraction: tuple[float, float]
    statistic: float


def places(system: System) -> tuple[Place, ...]:
    """The whole map of disagreement."""
    view = project(system, system.place_columns)
    columns = system.gram[np.ix_(np.flatnonzero(system.usable), system.place_columns, system.place_columns)]
    said = (view.survival > FADED) & (np.einsum("nkk->k", columns) > 0)
    values = np.where(said, view.gaussian, np.nan)
    return tuple(Place(p.kind, p.share, float(t)) for p, t in zip(system.places, values, strict=True))


def where(base: Base, system: System) -> list[dict[str, Any]]:
    """Places of the map by their share of the systematic gap, largest first."""
    view = project(system, system.place_columns)
    energy = np.where(view.survival > FADED, view.gaussian**2 - 1, 0.0)
    energy = np.maximum(energy, 0.0)
    if energy.sum() <= 0:
        return []
    usable = np.flatnonzero(system.usable)
    names = [base.name_of(i) for i in usable.tolist()]
    strain = _strains(base)
    found = []
    for k in np.argsort(-energy):
        share = float(energy[k] / energy.sum())
        if share < WORTH_TELLING or energy[k] < 3:
            break
        place = system.places[k]
        sign = np.sign(view.scores[:, k].sum())
        own = view.scores[:, k] * sign / np.sqrt(np.maximum(view.information[:, k, k], 1e-300))
        affected = [n for n, t in zip(names, own, strict=True) if t > 1.0]
        low, high = place.share
        found.append(
            {
                "segment": place.kind,
                "load_fraction": [float(low), float(high)],
                "strain": [
                    float(np.min(strain[:, 0]) if place.kind == "loading" else np.min(strain[:, 1])),
                    float(np.max(strain[:, 1])),
                ],
                "share": share,
                "particles": affected,
                "direction": "more displacement than the law" if sign > 0 else "less displacement than the law",
            }
        )
    return found


def _strains(base: Base) -> np.ndarray:
    """Strain at the first compared point and the largest, by particle."""
    tests = base.tests
    mask = np.asarray(tests.mask)
    d = np.asarray(tests.displacement) - np.asarray(base.fit.zero)[:, None]
    diameter = np.asarray(tests.effective_diameter)
    low = np.where(mask, d, np.inf).min(1) / diameter
    high = np.where(mask, d, -np.inf).max(1) / diameter
    return np.stack([low, high], 1)
