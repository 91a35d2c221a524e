"""A campaign in memory: which particles were tested, what was measured, and how."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from .._errors import InputError
from .findings import Level

Control = Literal["load", "displacement"]


@dataclass(frozen=True)
class Note:
    """What the check of one test found.

    Attributes:
        check: what was checked, as in `Finding`.
        level: how serious it is, as in `Finding`.
        sentence: in words, with `{}` where the numbers stand.
        numbers: one for each `{}`.
        remedy: what a person can do, as in `Finding`.
    """

    check: str
    level: Level
    sentence: str
    numbers: tuple[float | int, ...] = ()
    remedy: str = ""


@dataclass(frozen=True)
class Checked:
    """What `check_tests` did to a test; all arrays have one entry for each reading that is left.

    Attributes:
        rows: the readings of the raw record that are left, shape (n,).
        compared: whether a reading may be compared with a law; a turning point that the force channel did not see may
            not, since its force was worked out from the displacement.
        force_zero_mN: the zero of force that was taken off [mN].
        force_zero_sd_mN: its standard deviation [mN]: an error that all readings share.
        force_sd_mN: standard deviation of a force that was worked out, 0 of one that was read [mN].
        notes: what was found.
    """

    rows: np.ndarray
    compared: np.ndarray
    force_zero_mN: float
    force_zero_sd_mN: float
    force_sd_mN: np.ndarray
    notes: tuple[Note, ...]


@dataclass(frozen=True)
class Curve:
    """One particle's test, raw as the tester recorded it: nothing shifted, smoothed or sorted.

    Attributes:
        time_s: time [s], never decreasing, shape (n,), n >= 2.
        force_mN: force on the particle [mN], shape (n,).
        displacement_um: relative displacement of the two platens [um], shape (n,).
        checked: what `check_tests` changed, of a curve that it made; None of a raw one.
    """

    time_s: np.ndarray
    force_mN: np.ndarray
    displacement_um: np.ndarray
    checked: Checked | None = None

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
        raw: of a campaign that `check_tests` made, the one it was made from; None otherwise.
    """

    particles: tuple[str, ...]
    diameters_um: np.ndarray
    curves: tuple[Curve, ...]
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    metadata: Metadata = field(default_factory=Metadata)
    source: str = ""
    raw: Campaign | None = None

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
            None if self.raw is None else self.raw.select(keep),
        )

    def without(self, *particles: str) -> Campaign:
        """The campaign without the named particles.

        Raises:
            KeyError: if there is no such particle.
            InputError: if none would be left.
        """
        gone = {self.index(name) for name in particles}
        if len(gone) == len(self):
            raise InputError(
                "no particle would be left", file=self.source or None, remedy="Leave at least one particle in"
            )
        return self.select(np.array([i not in gone for i in range(len(self))]))
