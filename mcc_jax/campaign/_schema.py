"""A campaign in memory: which particles were tested, what was measured, and how."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

Control = Literal["load", "displacement"]


@dataclass(frozen=True)
class Curve:
    """One particle's test, raw as the tester recorded it: nothing shifted, smoothed or sorted.

    Attributes:
        time_s: time [s], never decreasing, shape (n,), n >= 2.
        force_mN: force on the particle [mN], shape (n,).
        displacement_um: relative displacement of the two platens [um], shape (n,).
    """

    time_s: np.ndarray
    force_mN: np.ndarray
    displacement_um: np.ndarray

    def __len__(self) -> int:
        return len(self.time_s)


@dataclass(frozen=True)
class Metadata:
    """What is known about the test besides the numbers (`campaign.toml`); every entry is optional.

    Attributes:
        control: the controlled quantity, "load" or "displacement".
        force_resolution_mN: smallest step of the force read-out [mN].
        displacement_resolution_um: smallest step of the displacement read-out [um].
        punch_diameter_um: diameter of the flat punch [um].
        provenance: where the data come from, in words.
        corrections: names of corrections that were applied before the data got here.
        other: every further entry of the file, kept as it is.
    """

    control: Control | None = None
    force_resolution_mN: float | None = None
    displacement_resolution_um: float | None = None
    punch_diameter_um: float | None = None
    provenance: str | None = None
    corrections: tuple[str, ...] = ()
    other: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Campaign:
    """Measured (or simulated) tests on single particles.

    Attributes:
        particles: the particles' names, N of them, unique.
        diameters_um: D1, D2, D3 [um] of every particle, shape (N, 3).
        curves: one test per particle, in the same order.
        columns: further columns of `particles.csv`, each N values, as text.
        metadata: what is known about the test.
        source: the folder or file it was read from, for messages; empty when made in memory.
    """

    particles: tuple[str, ...]
    diameters_um: np.ndarray
    curves: tuple[Curve, ...]
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    metadata: Metadata = field(default_factory=Metadata)
    source: str = ""

    def __len__(self) -> int:
        return len(self.particles)

    def index(self, particle: str) -> int:
        """Position of a particle by its name.

        Raises:
            KeyError: if there is no such particle.
        """
        try:
            return self.particles.index(particle)
        except ValueError:
            raise KeyError(f"no particle {particle!r}; there are: {', '.join(self.particles)}") from None

    def select(self, keep: np.ndarray) -> Campaign:
        """The campaign of those particles where `keep`, booleans of shape (N,), is true."""
        chosen = np.flatnonzero(keep)
        return Campaign(
            tuple(self.particles[i] for i in chosen),
            self.diameters_um[chosen],
            tuple(self.curves[i] for i in chosen),
            {name: tuple(values[i] for i in chosen) for name, values in self.columns.items()},
            self.metadata,
            self.source,
        )
