"""The formulas a campaign is searched for, one for every point of every variant's grid."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..effects import AbstractEffect, Mechanism, Need, Variant

# Values tried of a number that differs from test to test.
LOCATIONS = 32  # of a place between two that lie far apart, which must be met closely
PHASES = 14  # of a phase


@dataclass(frozen=True)
class Candidate:
    """One formula with fixed nuisance parameters, of which only the amplitude is unknown.

    Attributes:
        variant: the formula.
        nuisance: its further parameters.
    """

    variant: Variant
    nuisance: Mapping[str, float]

    @property
    def mechanism(self) -> str:
        """Name of the mechanism."""
        return self.variant.mechanism

    @property
    def between_particles(self) -> bool:
        """Whether the effect shows by how particles differ, and in none of them alone."""
        return bool({Need.SEVERAL_SIZES, Need.SEVERAL_SHAPES, Need.HUMIDITY_COLUMN} & set(self.variant.needs))

    @property
    def effect(self) -> AbstractEffect:
        """The effect at amplitude zero."""
        return self.variant.build(0.0, **self.nuisance)

    @property
    def unit_amplitude(self) -> float:
        """The largest amplitude one would believe: the natural unit of the search."""
        return self.variant.plausible[1]


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
    """What is left of a library where the data hold less than some formulas need, and what the others wait for.

    Returns:
        The library with those mechanisms and variants whose needs are met; for each mechanism of which nothing is left,
        its name and what it needs.
    """
    testable: dict[str, Mechanism] = {}
    missing = []
    for name, mechanism in library.items():
        possible = tuple(v for v in mechanism.variants if set(v.needs) <= present)
        if possible:
            testable[name] = replace(mechanism, variants=possible)
        else:
            missing.append({"mechanism": name, "needs": _words(mechanism.variants, present)})
    return testable, missing


def _words(variants: Sequence[Variant], present: frozenset[Need]) -> str:
    """What the variant that lacks least is waiting for."""
    lacking = min((set(v.needs) - present for v in variants), key=len)
    return " and ".join(sorted(need.value for need in lacking))


def _spaced(low: float, high: float) -> np.ndarray:
    """Values over a range, by ratio where it spans more than a factor of three."""
    return np.geomspace(low, high, LOCATIONS) if low > 0 and high > 3 * low else np.linspace(low, high, PHASES)
