"""Where law and data disagree: kind of segment, load, strain, particles."""

from __future__ import annotations

from typing import Any

import numpy as np

from .linear_model import Base, System
from .score import project

WORTH_TELLING = 0.05


def where(base: Base, system: System) -> list[dict[str, Any]]:
    """Places of the map by their share of the systematic gap, largest first."""
    view = project(system, system.place_columns)
    energy = np.where(view.survival > 1e-4, view.gaussian**2 - 1, 0.0)
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
