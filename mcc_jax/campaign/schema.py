"""A campaign in memory: which particles were tested, what was measured, how, and what makes it valid."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import compress
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import described, number, span, table
from .findings import Finding
from .tables import LARGEST_MAGNITUDE

if TYPE_CHECKING:
    import pandas as pd

Control = Literal["load", "displacement"]
CHANNELS = ("time_s", "force_mN", "displacement_um")
SMALLEST_DIAMETER_UM = 1e-6
_ALIKE = ("control", "punch_diameter_um", "corrections")
_RESOLUTIONS = ("force_resolution_mN", "displacement_resolution_um")


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
    """What `check_tests` did to a test; arrays have one entry for each reading that is left."""

    rows: np.ndarray  # the readings of the raw record that are left
    compared: np.ndarray  # whether a reading may be compared with a law
    force_zero_mN: float  # that was taken off
    force_zero_sd_mN: float  # an error that all readings share
    force_sd_mN: np.ndarray  # of a force that was worked out from the displacement, 0 of one that was read
    findings: tuple[Finding, ...]


@dataclass(frozen=True, repr=False)
class Curve:
    """One particle's test, raw as the instrument recorded it: nothing shifted, smoothed or sorted.

    Attributes:
        time_s: time [s], never decreasing, shape (n,), n >= 2.
        force_mN: force on the particle [mN], shape (n,).
        displacement_um: relative displacement of the two platens [um], shape (n,).
        checked: what `check_tests` changed, of a curve that it made; None of a raw one.

    Lists, Series and arrays of any kind become NumPy arrays that cannot be written to.
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
        force_resolution_mN, displacement_resolution_um: smallest steps of the read-outs.
        punch_diameter_um: diameter of the flat punch.
        provenance: where the data come from, in words.
        corrections: names of corrections that were applied before the data got here.
        other: every further entry of the file, kept as it is.
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

    @property
    def simulated(self) -> bool:
        """Whether the data were computed, not measured, as far as the metadata say."""
        return "simulation" in self.other or "not a measurement" in (self.provenance or "")


@dataclass(frozen=True, repr=False)
class Campaign:
    """Measured (or simulated) tests on single particles.

    Attributes:
        particles: the particles' names, N of them, unique.
        diameters_um: D1, D2, D3 [um] of every particle, shape (N, 3).
        curves: one test per particle, in the same order.
        columns: further columns of `particles.csv`, each N values, as text.
        metadata: what is known about the test.
        source: the folder or file it was read from, for messages.
        raw: of a campaign that `check_tests` made, the one it was made from.

    `campaign["P3"]` is the test of that particle, a `Curve`, and a loop over a campaign gives its tests in order.
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
        """All readings as a table with the columns of `curves.csv`, one row each."""
        import pandas as pd

        names = np.repeat(np.array(self.particles, object), [len(curve) for curve in self.curves])
        columns = {name: np.concatenate([getattr(curve, name) for curve in self.curves]) for name in CHANNELS}
        return pd.DataFrame({"particle": names, **columns})

    def select(self, keep: np.ndarray) -> Campaign:
        """The campaign of those particles where `keep`, booleans of shape (N,), is true."""
        keep = np.asarray(keep)
        if keep.dtype != bool or keep.shape != (len(self),):
            raise InputError(f"keep must be {len(self)} booleans, one for every particle, got {arguments.shown(keep)}")
        return replace(
            self,
            particles=compress(self.particles, keep),
            diameters_um=self.diameters_um[keep],
            curves=compress(self.curves, keep),
            columns={name: list(compress(values, keep)) for name, values in self.columns.items()},
            raw=None if self.raw is None else self.raw.select(keep),
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
    if isinstance(values, str | bytes | Mapping):
        raise InputError(f"{name} must be a list of texts, got {arguments.kind_of(values)}")
    found = list(values)
    for one in found:
        if not isinstance(one, str | int | float | np.number) or isinstance(one, bool):
            raise InputError(f"{name} must be a list of texts, got {arguments.shown(one)} among them")
    return tuple(map(str, found))


# ---- what every campaign must satisfy, read from files, made in memory or joined from several ------------------------


class Fault(NamedTuple):
    """Why no test can be as it is, and the first reading and the channel concerned; that is empty for all of them."""

    problem: str
    remedy: str
    reading: int = 0
    channel: str = ""


def fault_of(name: str, curve: Curve) -> Fault | None:
    """What is wrong with a test whatever its particle is: readings that are no numbers, or too few, times, zeros."""
    channels = {"time": curve.time_s, "force": curve.force_mN, "displacement": curve.displacement_um}
    for channel, values in channels.items():
        bad = np.flatnonzero(~(np.abs(values) <= LARGEST_MAGNITUDE))
        if bad.size:
            value, remedy = values[bad[0]], "Leave that sample out, or check the unit if all are so large"
            what = "" if np.isnan(value) else ", too large to be real"
            return Fault(f"the {channel} of test {name!r} is {value:.4g}{what}", remedy, int(bad[0]), channel)
    if len(curve) < 2:
        remedy = "A curve needs at least two rows; add them or remove the particle"
        return Fault(f"the test {name!r} has one row only", remedy)
    back = np.flatnonzero(np.diff(curve.time_s) < 0)
    if back.size:
        i = int(back[0])
        problem = f"the time of test {name!r} goes back, from {curve.time_s[i]:.10g} s to {curve.time_s[i + 1]:.10g} s"
        return Fault(problem, "Keep the rows of a test in the order of time; two tests need two names", i + 1, "time")
    for channel in ("force", "displacement"):
        if not channels[channel].any():
            problem = f"every {channel} of test {name!r} is zero, so it holds no data"
            return Fault(problem, "Export the test again or remove the particle", 0, channel)
    return None


def check_campaign(campaign: Any, name: str = "campaign", *, file: str | Path = "") -> Campaign:
    """The campaign, if it could have come from files: `InputError` if names, shapes or values are unfit, naming `file`
    or the place where it was read; given a path, it shows how to read it."""
    if isinstance(campaign, str | PurePath):
        remedy = f"Read it first: mcc_jax.read_campaign({str(campaign)!r})."
        raise InputError(f"{name} must be a Campaign, got the path {str(campaign)!r}", remedy=remedy)
    found = remembered(campaign, "problem", lambda: next(_problems(campaign), None))
    if found is not None:
        problem, remedy = found
        raise InputError(problem, file=file or campaign.source or f"the {name}", remedy=remedy)
    return campaign


def _problems(campaign: Campaign) -> Iterator[tuple[str, str]]:
    """What is wrong with a campaign, and what to do about it."""
    remedy = "Correct the campaign before it is used"
    if not len(campaign):
        yield "there is no particle", remedy
    for name, times in Counter(campaign.particles).items():
        if times > 1:
            yield f"the particle {name!r} appears {times} times", remedy
    for name, triple, curve in zip(campaign.particles, campaign.diameters_um, campaign.curves, strict=True):
        if not name.strip():
            yield "a particle's name is empty", remedy
        if not ((triple >= SMALLEST_DIAMETER_UM) & (triple <= LARGEST_MAGNITUDE)).all():
            yield f"the diameters {triple.tolist()} um of particle {name!r} are not all positive and finite", remedy
        if (fault := fault_of(name, curve)) is not None:
            yield f"{fault.problem} (sample {fault.reading + 1})", fault.remedy
    for column in campaign.columns:
        taken = column == "particle" or column.startswith(("D1_", "D2_", "D3_"))
        if taken or not column or column != column.strip() or "\ufeff" in column:
            yield f"{column!r} cannot be the name of a further column", remedy
    for texts in (campaign.particles, campaign.columns, *campaign.columns.values()):
        for text in texts:
            if "\0" in text or text.encode("utf-8", "ignore").decode("utf-8") != text:
                yield f"the text {text!r} holds a NUL character or is no valid Unicode text", remedy


def join_campaigns(first: Campaign, *further: Campaign) -> Campaign:
    """The tests of several campaigns as one, for instance those that a discovery proposed in addition to those it had.

    Of resolutions the coarsest counts, provenances are listed, and of further entries with one name the first stays.
    The same particle twice, and different columns, control, punch or corrections raise `InputError`.
    """
    campaigns = tuple(check_campaign(one, f"campaign {i}") for i, one in enumerate((first, *further), start=1))
    for other in further:
        alike = {name: (getattr(first.metadata, name), getattr(other.metadata, name)) for name in _ALIKE}
        for what, (one, another) in {"columns": (sorted(first.columns), sorted(other.columns)), **alike}.items():
            if one != another:
                problem = f"{what} is {another!r} here and {one!r} in the first campaign"
                remedy = "Such tests are not of one kind; evaluate them separately, or correct the entry"
                raise InputError(problem, file=other.source or None, remedy=remedy)
    known = [campaign.metadata for campaign in campaigns]
    resolutions = {name: [value for one in known if (value := getattr(one, name)) is not None] for name in _RESOLUTIONS}
    metadata = replace(
        known[0],
        **{name: max(values, default=None) for name, values in resolutions.items()},
        provenance="; ".join(dict.fromkeys(one.provenance for one in known if one.provenance)) or None,
        other={name: value for one in reversed(known) for name, value in one.other.items()},
    )
    joined = Campaign(
        [name for campaign in campaigns for name in campaign.particles],
        np.concatenate([campaign.diameters_um for campaign in campaigns]),
        [curve for campaign in campaigns for curve in campaign.curves],
        {name: [cell for c in campaigns for cell in c.columns[name]] for name in first.columns},
        metadata,
        ", ".join(dict.fromkeys(campaign.source for campaign in campaigns if campaign.source)),
    )
    return check_campaign(joined)
