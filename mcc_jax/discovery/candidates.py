"""The formulas a campaign is searched for, one for every point of every variant's grid."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..effects import AbstractEffect, Mechanism, Need, Nuisance, Variant
from ..law import PUNCH_AREA
from .base import Base

# Values tried of a number that differs from test to test.
LOCATIONS = 32  # of a place between two that lie far apart, which must be met closely
PHASES = 14  # of a phase

PUNCH = "punch_radius_um"


@dataclass(frozen=True)
class Candidate:
    """One formula with fixed nuisance parameters, of which only the amplitude is unknown."""

    variant: Variant
    nuisance: Mapping[str, float]

    @property
    def mechanism(self) -> str:
        """Name of the mechanism."""
        return self.variant.mechanism

    @property
    def effect(self) -> AbstractEffect:
        """The effect at amplitude zero."""
        return self.variant.build(0.0, **self.nuisance)


def candidates_of(library: Mapping[str, Mechanism]) -> tuple[Candidate, ...]:
    """All formulas of a library in its order."""
    return tuple(
        Candidate(variant, nuisance)
        for mechanism in library.values()
        for variant in mechanism.variants
        for nuisance in _grid(variant)
    )


def located(variant: Variant) -> bool:
    """Whether a further number of the formula differs from test to test, which no `Model` holds."""
    return any(n.random_per_test for n in variant.nuisances)


def _grid(variant: Variant) -> list[dict[str, float]]:
    """Values of the further numbers: the variant's own grid, a finer one for what differs from test to test."""
    grids = [tuple(_spaced(*n.plausible)) if n.random_per_test else n.grid for n in variant.nuisances]
    names = [n.name for n in variant.nuisances]
    return [dict(zip(names, map(float, values), strict=True)) for values in itertools.product(*grids)]


def untestable(
    library: Mapping[str, Mechanism], present: frozenset[Need]
) -> tuple[dict[str, Mechanism], list[dict[str, str]]]:
    """The mechanisms and variants whose needs the data meet; name and needs of each mechanism that has none."""
    testable: dict[str, Mechanism] = {}
    missing = []
    for name, mechanism in library.items():
        possible = tuple(v for v in mechanism.variants if set(v.needs) <= present)
        if possible:
            testable[name] = replace(mechanism, variants=possible)
        else:
            missing.append({"mechanism": name, "needs": _words(mechanism.variants, present)})
    return testable, missing


def without_punch(library: Mapping[str, Mechanism], base: Base) -> dict[str, Mechanism]:
    """The library without the finite width of the punch, unless a contact grows wider than the punch is known to be.

    A formula that knows neither would be nothing but another name for the compliance of the frame.
    """
    diameter = base.campaign.metadata.punch_diameter_um
    tests = base.tests
    size = np.asarray(tests.effective_diameter)
    travel = np.where(np.asarray(tests.mask), np.asarray(tests.displacement), -np.inf).max(1) - np.asarray(
        base.state.point.zero
    )
    widest = float(np.max(np.sqrt(PUNCH_AREA * size * np.maximum(travel, 0.0))))
    outgrown = diameter is not None and 2 * widest > diameter

    def known(variant: Variant) -> Variant | None:
        if not any(n.name == PUNCH for n in variant.nuisances):
            return variant
        if not outgrown or diameter is None:
            return None
        radius = Nuisance(PUNCH, (diameter / 2,), (diameter / 2, diameter / 2), "radius of the flat punch, as recorded")
        others = tuple(n for n in variant.nuisances if n.name != PUNCH)
        return replace(variant, nuisances=(*others, radius))

    kept = {}
    for name, mechanism in library.items():
        variants = tuple(v for v in map(known, mechanism.variants) if v is not None)
        if variants:
            kept[name] = replace(mechanism, variants=variants)
    return kept


def _words(variants: Sequence[Variant], present: frozenset[Need]) -> str:
    """What the variant that lacks least needs."""
    lacking = min((set(v.needs) - present for v in variants), key=len)
    return " and ".join(sorted(need.value for need in lacking))


def _spaced(low: float, high: float) -> np.ndarray:
    """Values over a range, by ratio where it spans more than a factor of three."""
    return np.geomspace(low, high, LOCATIONS) if low > 0 and high > 3 * low else np.linspace(low, high, PHASES)
