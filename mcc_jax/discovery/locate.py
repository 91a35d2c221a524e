"""Where law and tests disagree: kind of segment, load, particles."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..effects.record import HOLD, LOAD, RELOAD, UNLOAD
from .base import Base

KINDS = {LOAD: "loading", HOLD: "hold", UNLOAD: "unloading", RELOAD: "reloading"}
BINS = 5  # of load in which disagreement is looked for
REPORTED = 0.85  # places are reported until they hold this share of the disagreement


@dataclass(frozen=True)
class Place:
    """A place of the map of disagreement.

    Attributes:
        segment: kind of segment.
        load_fraction: range of force over the test's largest force [-].
        share: of the squared difference [-]; NaN where there are no points.
        sign: +1 where more displacement is measured than the law says, -1 where less.
        particles: rows of the tests in which most of it lies.
    """

    segment: str
    load_fraction: tuple[float, float]
    share: float
    sign: int
    particles: tuple[int, ...]


def difference(before: np.ndarray, after: np.ndarray | None, mask: np.ndarray) -> np.ndarray:
    """What the base law leaves and the extended one does not [um]; the former alone where nothing was added."""
    return np.where(mask, before if after is None else before - after, 0.0)


def places(base: Base, left: np.ndarray) -> tuple[Place, ...]:
    """The map of disagreement: squared differences by kind of segment and load; a hold is one place."""
    mask, kind = np.asarray(base.tests.mask), np.asarray(base.tests.record.kind)
    force = np.asarray(base.tests.force)
    load = force / np.max(np.where(mask, force, 0.0), axis=1, keepdims=True)
    total = max(float(np.sum(left[mask] ** 2)), 1e-300)
    edges = np.linspace(0, 1, BINS + 1)
    found = []
    for code, name in KINDS.items():
        if not (mask & (kind == code)).any():
            continue
        for low, high in [(0.0, 1.0)] if code == HOLD else list(itertools.pairwise(edges)):
            inside = mask & (kind == code) & (load >= low) & ((load < high) | (high >= 1))
            if not inside.any():
                found.append(Place(name, (float(low), float(high)), float("nan"), 0, ()))
                continue
            each = np.sum(np.where(inside, left, 0.0) ** 2, 1)
            particles = tuple(np.flatnonzero(each > 0.5 * each.mean()).tolist())
            sign = int(np.sign(np.sum(left[inside])))
            found.append(Place(name, (float(low), float(high)), float(each.sum() / total), sign, particles))
    return tuple(found)


def where(base: Base, places: tuple[Place, ...]) -> list[dict[str, Any]]:
    """The places that together hold most of the disagreement, largest first."""
    known = sorted((p for p in places if p.share > 0), key=lambda p: -p.share)
    strain, held, found = _strains(base), 0.0, []
    for place in known:
        if held >= REPORTED:
            break
        held += place.share
        rows = list(place.particles)
        found.append(
            {
                "segment": place.segment,
                "load_fraction": list(place.load_fraction),
                "strain": [float(strain[rows, 0].min()), float(strain[rows, 1].max())],
                "share": place.share,
                "particles": [base.name_of(i) for i in rows],
                "direction": f"{'more' if place.sign > 0 else 'less'} displacement than the law",
            }
        )
    return found


def _strains(base: Base) -> np.ndarray:
    """Strain at the first compared point and the largest, by particle."""
    tests = base.tests
    mask = np.asarray(tests.mask)
    away = np.asarray(tests.displacement) - np.asarray(base.state.point.zero)[:, None]
    diameter = np.asarray(tests.effective_diameter)
    return np.stack([np.where(mask, away, np.inf).min(1), np.where(mask, away, -np.inf).max(1)], 1) / diameter[:, None]
