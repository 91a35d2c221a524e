"""What a generator hands to the bench: a campaign before noise, and the curves that hidden effects make of it.

Nothing here knows a formula. Arrays hold all readings of a campaign one particle after the other; `slices` says which
belong to which particle. Units: um, mN, MPa, s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np

MN_PER_MPA_UM2 = 1e-3
LOADING, HOLD, UNLOADING, RELOADING = range(4)
_STILL = 1e-9


@dataclass(frozen=True)
class Shift:
    """A base law beside the true one: added to ln C of each particle (3, n), to each ln modulus (n,), and to a."""

    log_C: np.ndarray
    log_modulus: np.ndarray
    a: float = 0.0


@dataclass(frozen=True)
class Hidden:
    """One formula with its drawn numbers, as the bench sees it; `effect` means something to its generator only.

    start: a usual amplitude. largest: bound of the amplitude. signed: whether both signs are physical.
    """

    mechanism: str
    formula: str
    equation: str
    unit: str
    start: float
    largest: float
    signed: bool
    effect: Any


Sized = Sequence[tuple[Hidden, float]]
"""Hidden effects with their amplitudes."""


@dataclass(frozen=True)
class World:
    """A campaign before noise.

    columns: of `particles.csv`. diameter: effective, um. spread: standard deviations of ln C1, ln C3, ln C5 between
    particles. deviation: of ln C1, ln C3, ln C5 and ln modulus from the population, (4, n). truth: parameters of the
    population. hidden: what the case asks for. curves: displacement in um at every reading for effects and a shift of
    the base law. moduli: in MPa at every reading, with effects. listed: formulas of all listed mechanisms that this
    campaign can show, for comparison; pop-ins are left out, whose signature is whatever jumps there are.
    """

    columns: dict[str, np.ndarray]
    time: np.ndarray
    force: np.ndarray
    slices: tuple[slice, ...]
    diameter: np.ndarray
    spread: np.ndarray
    deviation: np.ndarray
    truth: dict[str, float]
    hidden: tuple[Hidden, ...]
    curves: Callable[[Sized, Shift | None], np.ndarray]
    moduli: Callable[[Sized], np.ndarray]
    listed: Callable[[], Iterable[Hidden]]

    def modulus_at_peaks(self, sized: Sized) -> float:
        """The population's modulus with what effects make of it at the particles' largest forces, in MPa."""
        tops = [s.start + int(np.argmax(self.force[s])) for s in self.slices]
        change = np.log(self.moduli(sized)[tops] / self.moduli(())[tops])
        return float(self.truth["effective_modulus_MPa"] * np.exp(change.mean()))

    @property
    def count(self) -> int:
        """Number of particles."""
        return len(self.slices)

    @cached_property
    def owner(self) -> np.ndarray:
        """The particle of every reading."""
        return np.repeat(np.arange(self.count), [s.stop - s.start for s in self.slices])

    @cached_property
    def travelled(self) -> np.ndarray:
        """Load path up to every reading, MPa."""
        area = np.pi * self.diameter**2 / 4.0 * MN_PER_MPA_UM2
        return np.concatenate(
            [
                np.cumsum(np.abs(np.diff(self.force[s], prepend=self.force[s][0]))) / area[i]
                for i, s in enumerate(self.slices)
            ]
        )

    @cached_property
    def base(self) -> np.ndarray:
        """Displacement of the base law, um."""
        return self.curves((), None)


def segments(force: np.ndarray) -> np.ndarray:
    """Kind of segment of every reading of one particle's clean force: LOADING, HOLD, UNLOADING or RELOADING."""
    step = np.diff(force, prepend=force[0] - 1.0)
    peak = np.maximum.accumulate(force)
    before = np.concatenate([[-np.inf], peak[:-1]])
    kind = np.where(force > before, LOADING, RELOADING)
    kind = np.where(step < 0, UNLOADING, kind)
    return np.where(np.abs(step) <= _STILL * peak, HOLD, kind)


def generators() -> dict[str, ModuleType]:
    """The two generators by name; they share no formula code.

    Each is a module with `formulas(mechanism)`, `unlisted()` and `protocols(mechanism, formula)`, names only, and
    `draw(rng, case)`, a `World`.
    """
    from benchmarks.blind.generator import interface as first
    from benchmarks.blind.second import interface as second

    return {"first": first, "second": second}
