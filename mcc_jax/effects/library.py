"""All mechanisms by name."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping

from .._errors import InputError
from . import creep_and_cycles, instrument, loading, material, unloading
from .variant import Mechanism, Variant


class _Library(Mapping[str, Mechanism]):
    """Mechanisms by name, which nobody can change."""

    def __init__(self, *mechanisms: Mechanism) -> None:
        self._by_name = {mechanism.name: mechanism for mechanism in mechanisms}

    def __getitem__(self, name: str) -> Mechanism:
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)

    def __repr__(self) -> str:
        formulas = sum(len(mechanism.variants) for mechanism in self.values())
        return f"{len(self)} mechanisms, {formulas} formulas:\n" + textwrap.fill(", ".join(self), 100)


LIBRARY: Mapping[str, Mechanism] = _Library(
    instrument.FRAME, instrument.DRIFT, creep_and_cycles.CREEP, loading.RATE, unloading.ADHESION, material.DAMAGE,
    material.DENSIFICATION, creep_and_cycles.HYSTERESIS, creep_and_cycles.RATCHETING, loading.HARDENING,
    unloading.SHAPE_OF_UNLOADING, material.SIZE, material.SHAPE, loading.POP_IN, loading.TOE, loading.FRICTION,
    loading.MISALIGNMENT, instrument.SINK_IN, unloading.REVERSAL, material.HUMIDITY,
)  # fmt: skip
"""The mechanisms known by name, in a fixed order; `dict(LIBRARY)` is a copy to add to."""


def find_variant(name: str, library: Mapping[str, Mechanism] = LIBRARY) -> Variant:
    """The variant called `mechanism:variant`, or a mechanism's first variant by the mechanism's name alone.

    Raises:
        ValueError: naming the choices there are.
    """
    mechanism, _, variant = name.partition(":")
    if mechanism not in library:
        raise InputError(f"there is no mechanism {mechanism!r}", remedy=f"Known: {', '.join(library)}.")
    return library[mechanism][variant] if variant else library[mechanism].variants[0]
