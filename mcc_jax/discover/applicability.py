"""Whether the finite width of the punch can be told from other things at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from ..effects import Mechanism, Nuisance, Variant
from ..law import PUNCH_AREA
from .base import Base

PUNCH = "punch_radius_um"


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
        return dataclasses.replace(variant, nuisances=(*others, radius))

    kept = {}
    for name, mechanism in library.items():
        variants = tuple(v for v in map(known, mechanism.variants) if v is not None)
        if variants:
            kept[name] = dataclasses.replace(mechanism, variants=variants)
    return kept
