"""The mapping file, which describes any other table, as text or in an Excel workbook, in TOML.

The page "Read files from my instrument" of the documentation explains every key.
"""

from __future__ import annotations

import os
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta, Struct, field

from ... import arguments
from ..._errors import InputError
from ..metadata import load_toml_file, typed
from ..schema import Control
from ..signal import turning_points
from ..tables import APOSTROPHES, DIMENSIONS, EXAMPLES, SPACES, same_text, unit_factor

DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
_THOUSANDS = {"none": "", "point": ".", "comma": ",", "apostrophe": APOSTROPHES, "space": SPACES} | {
    mark: marks for marks in (".", ",", APOSTROPHES, SPACES) for mark in marks
}
# The displacement turns round where it goes back by more than this share of its range; less is noise, in which no time
# passes. Noise of a displacement is some 1e-4 of its range, elastic recovery on unloading some 1e-1.
_REVERSAL_SHARE = 0.02


class Pace(NamedTuple):
    """How time is found where no column holds it: from the interval between samples, or the speed of displacement."""

    interval_s: float | None = None
    speed_um_per_s: float | None = None

    def times(self, displacement_um: np.ndarray, order: np.ndarray) -> np.ndarray:
        """Times [s] of the samples, shape (n,), never decreasing; `order` is the number of each one's row in its test.

        With a speed the time is the length of the path so far over the speed. The path runs from one turning point to
        the next; between them no time passes until the displacement exceeds what it had reached, so that noise adds
        nothing. A hold at constant displacement takes no time: nothing in the file shows how long it was.
        """
        if self.interval_s is not None:
            return self.interval_s * order
        assert self.speed_um_per_s is not None
        path = np.zeros(len(displacement_um))
        gone = 0.0
        for start, stop in pairwise(turning_points(displacement_um, _REVERSAL_SHARE * np.ptp(displacement_um))):
            leg = displacement_um[start : stop + 1]
            sign = 1.0 if leg[-1] >= leg[0] else -1.0
            path[start : stop + 1] = gone + np.maximum.accumulate(sign * (leg - leg[0]))
            gone = float(path[stop])
        with np.errstate(over="ignore"):  # the caller checks the size
            return path / self.speed_um_per_s


Text = Annotated[str, Meta(pattern=r"\S")]
Count = Annotated[int, Meta(ge=0)]
Place = Text | Annotated[int, Meta(ge=1)]
Rate = Annotated[float, Meta(ge=1e-15, le=1e15)]


class Column(Struct, forbid_unknown_fields=True):
    """Which column holds a quantity, and what its numbers mean."""

    column: Place
    unit: str = ""
    sign: Literal[1, -1] = 1


class Time(Struct, forbid_unknown_fields=True):
    """Which column holds the time, or how it is found without one."""

    column: Place | None = None
    unit: str = ""
    sign: Literal[1, -1] = 1
    speed: Rate | None = None
    interval: Rate | None = None


class TestColumn(Struct, forbid_unknown_fields=True):
    """Which column names the test."""

    column: Place


class Columns(Struct, forbid_unknown_fields=True):
    """Where the quantities are."""

    time: Time
    force: Column
    displacement: Column
    test: TestColumn | None = None


class InHeader(Struct, forbid_unknown_fields=True):
    """Rows above the samples that hold the diameters; the unit is in the file if it is not given here."""

    header: Text | Annotated[list[Text], Meta(min_length=1, max_length=3)]
    unit: str | None = None

    @property
    def names(self) -> list[str]:
        """How the rows begin: one for a sphere, or three for D1, D2, D3."""
        return [same_text(name).strip() for name in ([self.header] if isinstance(self.header, str) else self.header)]


class Source(NamedTuple):
    """A column by its name or number, and what turns its numbers into mN, um or s."""

    column: str | int
    factor: Fraction = Fraction(1)
    sign: int = 1


class MappingFile(Struct, forbid_unknown_fields=True, dict=True, kw_only=True):
    """A checked mapping file."""

    file: Path = field(name="")
    columns: Columns
    encoding: Text = "utf-8"
    delimiter: Annotated[str, Meta(pattern=r"^(comma|semicolon|tab|space|[^\"\r\n\0])\Z")] = ","
    sheet: Place | None = None
    decimal_mark: Literal[".", ","] = "."
    thousands: str | None = None
    missing: Annotated[list[str | float], Meta(min_length=1)] | None = None
    comment_prefix: Text | None = None
    skip_rows: Count | None = None
    begin: Text | None = None
    header_rows: Count = 1
    skip_footer: Count = 0
    end: Text | None = None
    tests: Literal["file", "blank line", "header", "column"] = "file"
    test_name: Text | None = None
    control: Control | None = None
    provenance: Text | None = None
    diameters_um: dict[str, list[float]] | None = None
    diameters: InHeader | None = None

    def __post_init__(self) -> None:
        sizes, many = self.diameters, 'If a column names the test, write tests = "column" and [columns.test]'
        header, keep, correct = "Write header_rows of at least 1", "Keep one of them", "Correct one of them"
        delimiter = DELIMITERS.get(self.delimiter, self.delimiter)
        thousands = _THOUSANDS.get(self.thousands or "none", "?")
        for wrong, key, problem, remedy in (
            (thousands == "?", "thousands", f"{self.thousands!r} is not allowed", ""),
            (self.decimal_mark in thousands, "thousands", "is also the decimal mark", correct),
            (delimiter == " " and " " in thousands, "thousands", "is also the delimiter", correct),
            (self.begin and self.skip_rows is not None, "begin", "is given in addition to 'skip_rows'", keep),
            (self.begin and not self.header_rows, "begin", "needs a header", header),
            (self.tests == "header" and not self.header_rows, "tests", "needs a header", header),
            (self.test_name and self.tests != "file", "test_name", 'is for tests = "file" only', "Remove it"),
            (self.columns.test and self.tests != "column", "columns.test", 'is for tests = "column" only', many),
            (not self.columns.test and self.tests == "column", "columns.test", "is needed", many),
            (sizes and self.diameters_um is not None, "diameters", "is given in addition to 'diameters_um'", keep),
            (sizes and len(sizes.names) == 2, "diameters.header", "must name one row, or three", ""),
        ):
            if wrong:
                raise _wrong(problem, key, remedy)
        self.delimiter, self.thousands = delimiter, None if self.thousands is None else thousands
        for name, triple in (self.diameters_um or {}).items():
            arguments.one_particle(triple, f"diameters_um of {name!r}")
        if sizes and sizes.unit is not None:
            _factor(sizes.unit, "length", "diameters")
        _ = self.pace, self.sources

    @cached_property
    def pace(self) -> Pace | None:
        """How time is found where no column holds it."""
        time = self.columns.time
        given = [name for name in ("column", "speed", "interval") if getattr(time, name) is not None]
        if len(given) != 1:
            problem = f"is given in addition to {given[1]!r}" if given else "is missing"
            raise _wrong(problem, "columns.time.column", "Keep one of column, speed and interval")
        if time.interval is not None:
            return Pace(interval_s=float(time.interval * _factor(time.unit, "time", "columns.time")))
        if time.speed is None:
            return None
        length, slash, per = time.unit.partition("/")
        if not slash:
            problem = f"{time.unit!r} is no unit of speed" if time.unit else "the unit is missing"
            raise _wrong(problem, "columns.time.unit", "Write one of mm/s, um/s, mm/min")
        factor = _factor(length.strip(), "length", "columns.time") / _factor(per.strip(), "time", "columns.time")
        return Pace(speed_um_per_s=float(time.speed * factor))

    @cached_property
    def sources(self) -> dict[str, Source]:
        """The columns to read, by time, force, displacement and test."""
        found: dict[str, Source] = {}
        for name in (*DIMENSIONS, "test"):
            entry = getattr(self.columns, name)
            if entry is None or entry.column is None:
                continue
            if isinstance(entry.column, str) and self.header_rows == 0:
                remedy = "Count columns from 1; names need header_rows of at least 1"
                raise _wrong(f"{entry.column!r} cannot be found", f"columns.{name}.column", remedy)
            if name == "test":
                found[name] = Source(entry.column)
            else:
                factor = _factor(entry.unit, DIMENSIONS[name], f"columns.{name}")
                found[name] = Source(entry.column, factor, entry.sign)
        return found


WRITE = {
    "columns": '[columns.force] with column = "..." and unit = "mN"',
    "column": 'a name in the header or a number from 1 on, for example column = "Load" or column = 2',
    "sign": "1 or -1",
    "delimiter": '"comma", "semicolon", "tab", "space" or one character',
    "sheet": "the sheet's name, or its number from 1 on",
    "decimal_mark": '"." or ","',
    "thousands": '"point", "comma", "apostrophe", "space", "none" or one of these characters',
    "missing": 'a list of texts and numbers such as ["NaN", "", -999]',
    "tests": '"file", "blank line", "header" or "column"',
    "control": '"load" or "displacement"',
    "diameters_um": "all = [D1, D2, D3], or three numbers in um by the name of each test",
    "header": 'header = "Gage length", or header = ["D1", "D2", "D3"]; your own diameters belong in [diameters_um]',
}
"""What to write for an entry that is wrong."""


def read_mapping(path: str | os.PathLike[str]) -> MappingFile:
    """Read and check a mapping file. Raises `InputError` naming the key that is missing, unknown or wrong."""
    file = Path(path)
    return typed(load_toml_file(file) | {"": file}, MappingFile, file, WRITE)


def _wrong(problem: str, key: str, remedy: str = "") -> InputError:
    return InputError(problem, column=key, remedy=remedy or f"Write {WRITE[key.rpartition('.')[2]]}")


def _factor(unit: str, dimension: str, place: str) -> Fraction:
    try:
        return unit_factor(unit, dimension)
    except ValueError as error:
        raise _wrong(str(error), f"{place}.unit", f"Write one of {EXAMPLES[dimension]}") from None
