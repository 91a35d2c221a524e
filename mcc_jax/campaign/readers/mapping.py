"""Any other table, as text or in an Excel workbook, described by a TOML mapping file.

A mapping file has these keys; all but `columns` may be left out, and any other key is an error:

    encoding = "utf-8"         # of text: a name that Python knows: "latin-1", "utf-16", "cp1252", "gb18030", ...
    delimiter = "comma"        # of text: "comma", "semicolon", "tab", "space" (any number of blanks), or one character
    sheet = "Data"             # of a workbook: the sheet's name, or its number, 1 for the first
    decimal_mark = "."         # "." or ","; the same as the delimiter where such numbers are in double quotes
    thousands = "point"        # what separates groups of three digits: "point", "comma", "apostrophe", "space" (also
                               # no-break, narrow and thin), or the character; never guessed. "none": there is none,
                               # though 1.500 is next to 500, which is refused otherwise
    missing = ["NaN", "", -999]   # cells that mean "no reading"; rows with one are dropped, counted and reported
    comment_prefix = "#"       # rows that begin so are skipped
    skip_rows = 0              # rows above the header, whatever they hold
    begin = "Time"             # instead of skip_rows: the header is the first row that begins so
    header_rows = 1            # rows of the header: names in the first, for instance units in the next; 0 for none
    skip_footer = 0            # rows below the samples, at the end of the file
    end = "Maximum"            # the samples end above a row that begins so, in every test
    tests = "file"             # how tests are distinguished: "file" (the file is one test), "blank line" (tests are
                               # separated by empty rows and called 1, 2, ...), "header" (a test begins wherever the
                               # header comes again; called 1, 2, ...) or "column" (a column names the test)
    test_name = "A1"           # for tests = "file": the name; otherwise that of the file without its ending
    control = "load"           # "load" or "displacement", as in campaign.toml
    provenance = "..."         # in words; added to what the reader writes itself

    [columns.time]             # and columns.force, columns.displacement: all three are needed
    column = "Time (s)"        # the name in the header, or the number of the column, 1 for the first
    unit = "s"                 # any unit of time (force, length)
    sign = 1                   # -1 turns the sign round, where the instrument counts compression as negative

    [columns.time]             # where the file has no column of time, one of these two instead of column
    speed = 0.05               # the displacement moves at this speed, up and down; unit = "mm/s", "um/min", ...
    interval = 0.1             # between one sample and the next; unit = "s", "ms", ...

    [columns.test]             # for tests = "column"
    column = "Sample"

    [diameters_um]             # instead of --diameters: D1, D2, D3 of all tests, or of each by its name
    all = [200.0, 190.0, 180.0]

    [diameters]                # or: every file holds the diameters above its samples
    header = "Gage length"     # the row that begins so holds the diameter of a sphere; three names for D1, D2 and D3
    unit = "mm"                # of the number; where left out, it is in the file, behind the number

The header, with up to `skip_rows` rows above it, may come again anywhere and is skipped there; without a header
(`header_rows = 0`) so are up to `skip_rows` rows above each test that is separated by an empty row. Empty cells behind
the last column that has a name, and rows of delimiters only, hold nothing.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta, Struct, field

from ..._errors import InputError
from ..columns import EXAMPLES, FORCE, LENGTH, TIME, unit_factor
from ..metadata import load_toml_file, typed
from ..schema import Control
from ..signal import turning_points
from ..table import APOSTROPHES, SPACES, filled, same_text
from .diameters import Diameters, check_triple
from .text import decode_lines

DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
DIMENSIONS = {"time": TIME, "force": FORCE, "displacement": LENGTH}
_THOUSANDS = {"none": "", "point": ".", "comma": ",", "apostrophe": APOSTROPHES, "space": SPACES} | {
    mark: marks for marks in (".", ",", APOSTROPHES, SPACES) for mark in marks
}
_REVERSAL_SHARE = 0.02
"""The displacement turns round where it goes back by more than this share of its range; less is noise, in which no time
passes. Noise of a displacement is some 1e-4 of its range, elastic recovery on unloading some 1e-1."""


class Pace(NamedTuple):
    """How time is found where no column holds it: from the interval between samples, or the speed of displacement."""

    interval_s: float | None = None
    speed_um_per_s: float | None = None

    def times(self, displacement_um: np.ndarray, order: np.ndarray) -> np.ndarray:
        """Times [s] of the samples, shape (n,), never decreasing; the first row of the test is at 0.

        `order` holds the number of each sample's row in its test; rows with missing readings count. With a speed the
        time is the length of the path so far over the speed. The path runs from one turning point to the next; between
        them no time passes until the displacement exceeds what it had reached, so that noise adds nothing. A hold at
        constant displacement takes no time: nothing in the file shows how long it was.
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
    """A checked mapping file; the module's text says what each entry means."""

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
        header, keep = "Write header_rows of at least 1", "Keep one of them"
        for wrong, key, problem, remedy in (
            (not _is_encoding(self.encoding), "encoding", f"{self.encoding!r} is no encoding", ""),
            (self.thousands not in (None, *_THOUSANDS), "thousands", f"{self.thousands!r} is not allowed", ""),
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
        self.delimiter = DELIMITERS.get(self.delimiter, self.delimiter)
        self.thousands = None if self.thousands is None else _THOUSANDS[self.thousands]
        for name, mark in (("decimal mark", self.decimal_mark), ("delimiter", self.delimiter)):
            if self.thousands and mark in self.thousands and (name == "decimal mark" or mark == " "):
                raise _wrong(f"the mark between thousands is also the {name}", "thousands", "Correct one of them")
        for name, triple in (self.diameters_um or {}).items():
            check_triple(triple, f"{name!r}", self.file)
        _ = self.pace, self.sources, self.diameter_factor

    @cached_property
    def pace(self) -> Pace | None:
        """How time is found where no column holds it."""
        time = self.columns.time
        given = [name for name in ("column", "speed", "interval") if getattr(time, name) is not None]
        if len(given) != 1:
            problem = f"is given in addition to {given[1]!r}" if given else "is missing"
            raise _wrong(problem, "columns.time.column", "Keep one of column, speed and interval")
        if time.interval is not None:
            return Pace(interval_s=float(time.interval * _factor(time.unit, TIME, "columns.time")))
        if time.speed is None:
            return None
        length, slash, per = time.unit.partition("/")
        if not slash:
            problem = f"{time.unit!r} is no unit of speed" if time.unit else "the unit is missing"
            raise _wrong(problem, "columns.time.unit", "Write one of mm/s, um/s, mm/min")
        factor = _factor(length.strip(), LENGTH, "columns.time") / _factor(per.strip(), TIME, "columns.time")
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
            found[name] = Source(entry.column)
            if name in DIMENSIONS:
                factor = _factor(entry.unit, DIMENSIONS[name], f"columns.{name}")
                found[name] = Source(entry.column, factor, entry.sign)
        return found

    @cached_property
    def diameter_factor(self) -> Fraction | None:
        """Micrometres in the unit of diameters in the header; None where the file holds the unit."""
        unit = None if self.diameters is None else self.diameters.unit
        return None if unit is None else _factor(unit, LENGTH, "diameters")

    @property
    def sizes_um(self) -> Diameters | None:
        """D1, D2, D3 [um] of all tests, or of each by its name."""
        given = self.diameters_um
        return given["all"] if given is not None and list(given) == ["all"] else given


WRITE = {
    "columns": '[columns.force] with column = "..." and unit = "mN"',
    "column": 'a name in the header or a number from 1 on, for example column = "Load" or column = 2',
    "sign": "1 or -1",
    "encoding": 'a name such as "latin-1"',
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


def _is_encoding(name: str) -> bool:
    try:
        return "".encode(name) is not None
    except (LookupError, ValueError):
        return False


def _wrong(problem: str, key: str, remedy: str = "") -> InputError:
    return InputError(problem, column=key, remedy=remedy or f"Write {WRITE[key.rpartition('.')[2]]}")


def _factor(unit: str, dimension: str, place: str) -> Fraction:
    try:
        return unit_factor(unit, dimension)
    except ValueError as error:
        raise _wrong(str(error), f"{place}.unit", f"Write one of {EXAMPLES[dimension]}") from None


# ---- a mapping file to begin with, for a table that no reader knows --------------------------------------------------

_LINES = 500
"""So many lines of a file are looked at."""
_NUMBER = re.compile(r"[-+]?[0-9]+(?:[.,][0-9]*)?(?:[eE][-+]?[0-9]+)?")
_COLUMNS = (
    'time = {{ column = {}, unit = "s" }}, force = {{ column = {}, unit = "mN" }}, '
    'displacement = {{ column = {}, unit = "um" }}'
)
_HOW = "Write a TOML mapping file and give it with --mapping; for example"
EXAMPLE = f'{_HOW} decimal_mark = "."; [columns] ' + _COLUMNS.format('"Time"', '"Load"', '"Depth"')
"""What to do about a file that shows nothing of itself."""


def suggested_mapping(data: bytes) -> str:
    """What to do about a file of an unknown format: a mapping file after what the file itself shows, in one line.

    Which column is which, and its unit, is not guessed: the names of the columns are given in their order.
    """
    lines = decode_lines(data)[:_LINES]
    tables = {name: [_cells(line, mark) for line in lines] for name, mark in DELIMITERS.items()}
    samples = {name: [i for i, cells in enumerate(rows) if _all_numbers(cells)] for name, rows in tables.items()}
    name = max(samples, key=lambda name: len(samples[name]))
    if not samples[name]:
        return EXAMPLE
    rows, first = tables[name], samples[name][0]
    keys = [f'delimiter = "{name}"']
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError:
        keys.insert(0, 'encoding = "cp1252"')
    if name != "comma":
        comma = any("," in cell for i in samples[name] for cell in rows[i])
        keys.append(f'decimal_mark = "{"," if comma else "."}"')
    head = first  # of the rows of names, and of units below them, in front of the samples
    while first - head < 2 and head > 0 and len(rows[head - 1]) == len(rows[first]) and all(rows[head - 1]):
        head -= 1
    if head == first:
        return f"{_HOW} {'; '.join(keys)}; header_rows = 0; [columns] {_COLUMNS.format(1, 2, 3)}"
    if head > 0:
        keys.append(f'begin = "{rows[head][0]}"')
    if first - head > 1:
        keys.append("header_rows = 2")
    listed = ", ".join(f'"{one}"' for one in rows[head])
    return f"{_HOW} {'; '.join(keys)}; [columns] {_COLUMNS.format(*['"..."'] * 3)}; its columns are {listed}"


def _cells(line: str, mark: str) -> list[str]:
    """The cells of a line, without quotes and blanks around them; empty ones behind the last are none."""
    cells = [cell.strip().strip('"').strip() for cell in line.split(None if mark == " " else mark)]
    return cells[: filled(cells)]


def _all_numbers(cells: Sequence[str]) -> bool:
    return len(cells) > 1 and all(_NUMBER.fullmatch(cell) for cell in cells)
