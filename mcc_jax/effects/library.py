"""All mechanisms by name, and what a campaign must hold to show them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from .. import arguments
from .._errors import InputError
from ..campaign import Campaign, Segment, campaign_segments, check_campaign
from .contact import MISALIGNMENT, POP_IN, TOE
from .creep import CREEP
from .loading import FRICTION, HARDENING, RATE
from .material import DAMAGE, DENSIFICATION, HUMIDITY, SHAPE, SIZE
from .record import humidities, record_of
from .tester import DRIFT, FRAME, SINK_IN
from .unloading import ADHESION, HYSTERESIS, RATCHETING, REVERSAL, SHAPE_OF_UNLOADING
from .variant import Mechanism, Need, Variant

_ALL = (
    FRAME,
    DRIFT,
    CREEP,
    RATE,
    ADHESION,
    DAMAGE,
    DENSIFICATION,
    HYSTERESIS,
    RATCHETING,
    HARDENING,
    SHAPE_OF_UNLOADING,
    SIZE,
    SHAPE,
    POP_IN,
    TOE,
    FRICTION,
    MISALIGNMENT,
    SINK_IN,
    REVERSAL,
    HUMIDITY,
)

LIBRARY: Mapping[str, Mechanism] = MappingProxyType({mechanism.name: mechanism for mechanism in _ALL})
"""The mechanisms known by name, in a fixed order."""


def default_library() -> dict[str, Mechanism]:
    """A copy of `LIBRARY` to add to."""
    return dict(LIBRARY)


def checked_library(library: Any) -> Mapping[str, Mechanism]:
    """A library of mechanisms, if it is one.

    Raises:
        InputError: if it is anything else.
    """
    remedy = "Take mcc_jax.effects.default_library() and add to it."
    arguments.instance(library, Mapping, "library", remedy)
    for name, mechanism in library.items():
        arguments.instance(mechanism, Mechanism, f"the entry {name!r} of library", remedy)
    return library


def find_variant(name: str, library: Mapping[str, Mechanism] = LIBRARY) -> Variant:
    """The variant called `mechanism:variant`, or a mechanism's first variant by the mechanism's name alone.

    Raises:
        ValueError: naming the choices there are.
    """
    arguments.instance(name, str, "the name of a formula", 'Write "mechanism" or "mechanism:variant".')
    checked_library(library)
    mechanism, _, variant = name.partition(":")
    if mechanism not in library:
        raise InputError(f"there is no mechanism {mechanism!r}", remedy=f"Known: {', '.join(library)}.")
    known = library[mechanism]
    if not variant:
        return known.variants[0]
    try:
        return known[variant]
    except KeyError as error:
        raise InputError(error.args[0]) from None


def available_data(campaign: Campaign, segments: tuple[tuple[Segment, ...], ...] | None = None) -> frozenset[Need]:
    """What a campaign holds of what effects need.

    A kind of segment counts as present when at least one test in five has it; sizes and shapes when they differ by a
    tenth; peaks and rates when the largest is 1.3 times the smallest.

    Args:
        campaign: the tests.
        segments: the segments of each; found anew if None.
    """
    check_campaign(campaign)
    found = campaign_segments(campaign) if segments is None else segments
    D1, D2, D3 = campaign.diameters_um.T
    kinds = [[segment.kind for segment in parts] for parts in found]
    least = max(1.0, 0.2 * len(campaign))

    def often(kind: str, times: int = 1) -> bool:
        return sum(parts.count(kind) >= times for parts in kinds) >= least

    rates, peaks, durations, low = [], [], [], 0
    for curve, parts, diameter in zip(campaign.curves, found, D1 * D2 / D3, strict=True):
        record = record_of(curve, parts)
        loading = np.isin(np.asarray(record.kind), (1, 4))
        rates.extend(np.unique(np.asarray(record.loading_rate)[loading]).tolist())
        area = np.pi * diameter**2 / 4 * 1e-3
        peaks.append(float(curve.force_mN.max() / area))
        peaks.extend(
            float(curve.force_mN[: part.start].max() / area) for part in parts if part.kind == "unload" and part.start
        )
        durations.append(float(curve.time_s[-1] - curve.time_s[0]))
        low += int(np.sum(curve.force_mN < 0.1 * curve.force_mN.max()) >= 5)
    humidity = humidities(campaign)
    conditions = {
        Need.LOW_LOAD: low >= least,
        Need.UNLOADING: often("unload"),
        Need.HOLD: often("hold"),
        Need.RELOAD: often("reload"),
        Need.SECOND_RELOAD: often("reload", 2),
        Need.LONG_TIME: float(np.median(durations)) > 200,
        Need.TWO_RATES: _apart(rates, 1.3),
        Need.SEVERAL_SIZES: _apart((D1 * D2 / D3).tolist(), 1.1),
        Need.SEVERAL_SHAPES: bool(np.ptp(1 - D3**2 / (D1 * D2)) > 0.1),
        Need.SEVERAL_PEAKS: _apart(peaks, 1.3),
        Need.HUMIDITY_COLUMN: humidity is not None and bool(np.ptp(humidity) > 1),
    }
    return frozenset(need for need, there in conditions.items() if there)


def _apart(values: list[float], ratio: float) -> bool:
    some = [value for value in values if value > 0]
    return bool(some and max(some) > ratio * min(some))
