"""A campaign in memory: which particles were tested, what was measured, and how."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import compress
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import described, number, span, table
from .findings import Finding

if TYPE_CHECKING:
    import pandas as pd

Control = Literal["load", "displacement"]
CHANNELS = ("time_s", "force_mN", "displacement_um")


def remembered[T](of: Curve | Campaign, question: Hashable, find: Callable[[], T]) -> T:
    """What was found of a curve or a campaign, whose arrays cannot change; looked for at the first time only."""
    known: dict[Hashable, Any] = vars(of).setdefault("_found", {})
    if question not in known:
        known[question] = find()
    return known[question]


def _fixed(values: np.ndarray) -> np.ndarray:
    """The same numbers in an array that nobody can write to."""
    if values.flags.writeable:
        values = values.copy()
        values.flags.writeable = False
    return values


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
        findings: what was found.
    """

    rows: np.ndarray
    compared: np.ndarray
    force_zero_mN: float
    force_zero_sd_mN: float
    force_sd_mN: np.ndarray
    findings: tuple[Finding, ...]


@dataclass(frozen=True, repr=False)
class Curve:
    """One particle's test, raw as the instrument recorded it: nothing shifted, smoothed or sorted.

    Attributes:
        time_s: time [s], never decreasing, shape (n,), n >= 2.
        force_mN: force on the particle [mN], shape (n,).
        displacement_um: relative displacement of the two platens [um], shape (n,).
        checked: what `check_tests` changed, of a curve that it made; None of a raw one.

    Lists, Series and arrays of any kind become NumPy arrays that cannot be written to; anything else, or columns of
    different lengths, raises `InputError`.
    """

    time_s: np.ndarray
    force_mN: np.ndarray
    displacement_um: np.ndarray
    checked: Checked | None

    def __init__(self, time_s: Any, force_mN: Any, displacement_um: Any, checked: Checked | None = None) -> None:
        for name, column in zip(CHANNELS, (time_s, force_mN, displacement_um), strict=True):
            values = arguments.floats(column, name, shape="a 1-D array of numbers")
            if values.ndim != 1:
                raise InputError(f"the {name} of a curve has the shape {values.shape} where a 1-D array is expected")
            object.__setattr__(self, name, _fixed(values))
        arguments.same_length(**{name: getattr(self, name) for name in CHANNELS})
        object.__setattr__(self, "checked", checked)

    def __len__(self) -> int:
        return len(self.time_s)

    def __repr__(self) -> str:
        if not len(self):
            return "Curve without readings"
        return f"Curve of {len(self)} readings, {span(self.force_mN, 'mN')}, {span(self.displacement_um, 'um')}"

    @property
    def compared(self) -> np.ndarray:
        """Which readings may be compared with a law, booleans of shape (n,); all of a raw test."""
        return np.ones(len(self), bool) if self.checked is None else self.checked.compared

    @property
    def worked_out(self) -> np.ndarray:
        """Which readings are turning points whose force was worked out, booleans of shape (n,); none of a raw test."""
        return np.zeros(len(self), bool) if self.checked is None else self.checked.force_sd_mN > 0


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

    A control that does not exist, and a resolution or diameter that is not positive, raise `InputError`.
    """

    control: Control | None = None
    force_resolution_mN: float | None = None
    displacement_resolution_um: float | None = None
    punch_diameter_um: float | None = None
    provenance: str | None = None
    corrections: Sequence[str] = ()
    other: Mapping[str, Any] = field(default_factory=dict)

    __repr__ = described()

    def __post_init__(self) -> None:
        if self.control is not None:
            arguments.choice(self.control, get_args(Control), "control")
        for name in ("force_resolution_mN", "displacement_resolution_um", "punch_diameter_um"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, arguments.number(value, name, above=0))
        object.__setattr__(self, "corrections", _texts(self.corrections, "corrections"))


@dataclass(frozen=True, repr=False)
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

    `campaign["P3"]` is the test of that particle, a `Curve`, and a loop over a campaign gives its tests in order. Lists
    and Series are converted; wrong kinds or different lengths raise `InputError`.
    """

    particles: tuple[str, ...]
    diameters_um: np.ndarray
    curves: tuple[Curve, ...]
    columns: Mapping[str, tuple[str, ...]]
    metadata: Metadata
    source: str
    raw: Campaign | None

    def __init__(
        self,
        particles: Iterable[str | int],
        diameters_um: Any,
        curves: Iterable[Curve],
        columns: Mapping[str, Iterable[Any]] | None = None,
        metadata: Metadata | None = None,
        source: str | PurePath = "",
        raw: Campaign | None = None,
    ) -> None:
        names = _texts(particles, "particles")
        sizes = arguments.floats(diameters_um, "diameters_um", shape=_SIZES)
        sizes = sizes if sizes.size else sizes.reshape(0, 3)
        if sizes.shape != (len(names), 3):
            raise InputError(f"diameters_um has the shape {sizes.shape} where ({len(names)}, 3) is expected: {_SIZES}")
        tests = tuple(curves)
        arguments.same_length(particles=names, curves=tests)
        further = {name: _texts(cells, f"the column {name!r}") for name, cells in (columns or {}).items()}
        for name, cells in further.items():
            arguments.same_length(**{"particles": names, f"the column {name!r}": cells})
        values = (names, _fixed(sizes), tests, further, metadata or Metadata(), str(source), raw)
        for entry, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, entry.name, value)

    def __len__(self) -> int:
        return len(self.particles)

    def __iter__(self) -> Iterator[Curve]:
        return iter(self.curves)

    def __contains__(self, particle: object) -> bool:
        return particle in self.particles

    def __getitem__(self, particle: str) -> Curve:
        return self.curves[self.index(particle)]

    def __repr__(self) -> str:
        title = f"Campaign of {len(self)} particles" + (f" from {self.source}" if self.source else "")
        rows = [
            (name, f"{' x '.join(number(d) for d in sizes)} um, {curve!r}"[:100])
            for name, sizes, curve in zip(self.particles, self.diameters_um.tolist(), self.curves, strict=True)
        ]
        return table(title, rows)

    def index(self, particle: str) -> int:
        """Position of a particle by its name; `InputError` if there is none."""
        if particle in self.particles:
            return self.particles.index(particle)
        remedy = f"There are: {', '.join(self.particles)}."
        raise InputError(f"there is no particle {arguments.shown(particle)}", remedy=remedy)

    def to_dataframe(self) -> pd.DataFrame:
        """All readings as a table with the columns of `curves.csv`, one row each.

        They are `particle`, `time_s`, `force_mN` and `displacement_um`.
        """
        import pandas as pd

        lengths = [len(curve) for curve in self.curves]
        columns = {name: np.concatenate([getattr(curve, name) for curve in self.curves]) for name in CHANNELS}
        return pd.DataFrame({"particle": np.repeat(np.array(self.particles, object), lengths), **columns})

    def select(self, keep: np.ndarray) -> Campaign:
        """The campaign of those particles where `keep`, booleans of shape (N,), is true."""
        keep = np.asarray(keep)
        if keep.dtype != bool or keep.shape != (len(self),):
            raise InputError(f"keep must be {len(self)} booleans, one for every particle, got {arguments.shown(keep)}")
        return Campaign(
            compress(self.particles, keep),
            self.diameters_um[keep],
            compress(self.curves, keep),
            {name: list(compress(values, keep)) for name, values in self.columns.items()},
            self.metadata,
            self.source,
            None if self.raw is None else self.raw.select(keep),
        )

    def without(self, *particles: str) -> Campaign:
        """The campaign without the named particles; `InputError` if there is no such particle, or none is left."""
        gone = {self.index(name) for name in particles}
        if len(gone) == len(self):
            remedy = "Leave at least one particle in"
            raise InputError("no particle would be left", file=self.source or None, remedy=remedy)
        return self.select(np.array([i not in gone for i in range(len(self))]))


_SIZES = "D1, D2, D3 [um] of every particle, shape (N, 3)"


def _texts(values: Any, name: str) -> tuple[str, ...]:
    """Several texts; numbers become texts, a single text is none of several."""
    if isinstance(values, str | bytes | Mapping) or not isinstance(values, Iterable):
        raise InputError(f"{name} must be a list of texts, got {arguments.kind_of(values)}")
    found = list(values)
    wrong = [one for one in found if not isinstance(one, str | int | float | np.number) or isinstance(one, bool)]
    if wrong:
        raise InputError(f"{name} must be a list of texts, got {arguments.shown(wrong[0])} among them")
    return tuple(one if isinstance(one, str) else f"{one}" for one in found)
