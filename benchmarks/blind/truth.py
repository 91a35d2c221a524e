"""What only the truth tells: where the difference lies, and how near a found curve is to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from . import make
from . import seal as sealing
from .outcome import Outcome
from .plan import from_record
from .settings import SETTINGS
from .strength import Projection
from .world import HOLD, LOADING, RELOADING, UNLOADING, World, segments

SEGMENTS = {"load": LOADING, "hold": HOLD, "unload": UNLOADING, "reload": RELOADING}
"""Beginnings of a segment's name in `where` of `discovery.json`; any other name means all segments."""


class Truths:
    """The noiseless differences of one run; campaigns are drawn again from the answers, without their noise."""

    def __init__(self, name: str, work: Path = sealing.WORK) -> None:
        self._name, self._work = name, work

    def held_by_places(self, outcome: Outcome) -> tuple[float, float]:
        """Shares of the true squared difference, and of the readings, that the named places hold."""
        places = outcome.found.get("where") or []
        left, _ = sealing.truth_of(self._name, outcome.key, outcome.answer, self._work)
        world = _world(outcome.answer)[0]
        inside = inside_places(world, places)
        return float(np.sum(left[inside] ** 2) / max(np.sum(left**2), 1e-300)), float(inside.mean())

    def curve_error(self, outcome: Outcome) -> float | None:
        """Root mean square error of a closure on held-out particles over the range of the hidden curve.

        Of both curves only what no base law takes up is compared.
        """
        closure = outcome.found.get("closure") or {}
        corrections = closure.get("held_out_correction_um")
        if not corrections:
            return None
        left, _ = sealing.truth_of(self._name, outcome.key, outcome.answer, self._work)
        world, projection = _world(outcome.answer)
        found = np.zeros(len(world.force))
        for i, s in enumerate(world.slices):
            values = corrections.get(str(i + 1))
            if values:
                rows = np.arange(len(values)) * SETTINGS.running.closure_stride
                found[s] = np.interp(np.arange(s.stop - s.start), rows, values)
        error = projection.unexplained(found) - left
        return float(np.sqrt(np.mean(error**2)) / np.ptp(left))

    def modulus_at_peaks(self, outcome: Outcome) -> float:
        """The modulus that acts at the particles' largest forces, in MPa."""
        world = _world(outcome.answer)[0]
        sizes = [effect["amplitude"] for effect in outcome.answer["effects"]]
        return world.modulus_at_peaks(list(zip(world.hidden, sizes, strict=True)))


def _world(answer: dict[str, Any]) -> tuple[World, Projection]:
    case = from_record(answer["case"])
    _, world, noise = make.drawn(case, answer["master"], answer["attempt"])
    return world, Projection(world, noise, case.noise)


def inside_places(world: World, places: list[dict[str, Any]]) -> np.ndarray:
    """Which readings lie in one of the places: its segment, and its share of the particle's largest load."""
    inside = np.zeros(len(world.force), bool)
    for s in world.slices:
        force = world.force[s]
        kind, share = segments(force), force / force.max()
        for place in places:
            low, high = place.get("load_fraction") or (0.0, 1.0)
            wanted = [k for name, k in SEGMENTS.items() if str(place.get("segment", "")).startswith(name)]
            inside[s] |= (np.isin(kind, wanted) if wanted else True) & (share >= low) & (share <= high)
    return inside
