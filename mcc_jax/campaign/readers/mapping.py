"""Any other table, as text or in an Excel workbook, described by a TOML mapping file.

A mapping file has these keys; all but `columns` may be left out, and any other key is an error:

    encoding = "utf-8"         # of text: a name that Python knows: "latin-1", "utf-16", "cp1252", "gb18030", ...
    delimiter = "comma"        # of text: "comma", "semicolon", "tab", "space" (any number of blanks), or one character
    sheet = "Data"             # of a workbook: the sheet's name, or its number, 1 for the first
    decimal_mark = "."         # "." or ","; the same as the delimiter where such numbers stand in double quotes
    thousands = "point"        # what parts groups of three digits: "point", "comma", "apostrophe", "space" (no-break,
                               # narrow and thin ones, too), or the character; never guessed. "none": there is none,
                               # though 1.500 stands beside 500, which is refused otherwise
    missing = ["NaN", "", -999]   # cells that mean "no reading"; rows with one are dropped, counted and told
    comment_prefix = "#"       # rows that begin so are passed over
    skip_rows = 0              # rows above the header, whatever they hold
    begin = "Time"             # instead of skip_rows: the header is the first row that begins so
    header_rows = 1            # rows of the header: names in the first, for instance units in the next; 0 for none
    skip_footer = 0            # rows below the samples, at the end of the file
    end = "Maximum"            # the samples end above a row that begins so, in every test
    tests = "file"             # how tests are told apart: "file" (the file is one test), "blank line" (tests are
                               # parted by empty rows and called 1, 2, ...), "header" (a test begins wherever the
                               # header comes again; called 1, 2, ...) or "column" (a column names the test)
    test_name = "A1"           # for tests = "file": the name; otherwise that of the file without its ending
    control = "load"           # "load" or "displacement", as in campaign.toml
    provenance = "..."         # in words; added to what the reader writes itself

    [columns.time]             # and columns.force, columns.displacement: all three are needed
    column = "Time (s)"        # the name in the header, or the number of the column, 1 for the first
    unit = "s"                 # any unit of time (force, length)
    sign = 1                   # -1 turns the sign round, where the tester counts compression as negative

    [columns.time]             # where the file has no column of time, one of these two instead of column
    speed = 0.05               # the displacement moves at this speed, up and down; unit = "mm/s", "um/min", ...
    interval = 0.1             # between one sample and the next; unit = "s", "ms", ...

    [columns.test]             # for tests = "column"
    column = "Sample"

    [diameters_um]             # instead of --diameters: D1, D2, D3 of all tests, or of each by its name
    all = [200.0, 190.0, 180.0]

    [diameters]                # or: every file tells the diameters above its samples
    header = "Gage length"     # the row that begins so holds the diameter of a sphere; three names for D1, D2 and D3
    unit = "mm"                # of the number; where left out, the file tells it behind the number

The header, with up to `skip_rows` rows above it, may come again anywhere and is passed over there; without a header
(`header_rows = 0`) so are up to `skip_rows` rows above each test that is parted by an empty row. Empty cells behind
the last column that has a name, and rows of delimiters only, hold nothing.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from collections.abc import Mapping as MappingABC
from dataclasses import dataclass
from difflib import get_close_matches
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from ..._errors import InputError
from ..columns import EXAMPLES, FORCE, LENGTH, TIME, unit_factor
from ..metadata import load_toml_file
from ..schema import Control
from ..signal import turning_points
from ..table import APOSTROPHES, SPACES, same_text
from .diameters import Diameters, check_triple

DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
DIMENSIONS = {"time": TIME, "force": FORCE, "displacement": LENGTH}
Split = Literal["file", "blank line", "header", "column"]
_THOUSANDS = {"none": "", "point": ".", "comma": ",", "apostrophe": APOSTROPHES, "space": SPACES} | {
    mark: marks for marks in (".", ",", APOSTROPHES, SPACES) for mark in marks
}


@dataclass(frozen=True)
class Pace:
    """How time is told where no column holds it.

    Attributes:
        interval_s: time between one sample and the next [s]; None if the speed tells the time.
        speed_um_per_s: speed of the displacement [um/s]; None if the interval tells the time.
        reversal_share: the displacement turns round where it goes back by more than this share of its range; less is
            noise, in which no time passes. Noise of a displacement is some 1e-4 of its range, elastic recovery on
            unloading some 1e-1: two hundredths lie between.
    """

    interval_s: float | None = None
    speed_um_per_s: float | None = None
    reversal_share: float = 0.02

    def times(self, displacement_um: np.ndarray, order: np.ndarray) -> np.ndarray:
        """Times [s] of the samples, shape (n,), never decreasing; the first row of the test is at 0.

        With a speed v the time is the length of the path gone so far over v. The path runs from one turning point to
        the next; between two of them no time passes until the displacement exceeds what it had reached, so that noise
        adds nothing. A displacement that stands still (a hold at constant displacement) takes no time, which no file
        without times can tell otherwise.

        Args:
            displacement_um: displacement [um], shape (n,).
            order: number of each sample's row in its test, from 0; rows with missing readings count, shape (n,).
        """
        if self.interval_s is not None:
            return self.interval_s * order
        assert self.speed_um_per_s is not None
        path = np.zeros(len(displacement_um))
        gone = 0.0
        for start, stop in pairwise(turning_points(displacement_um, self.reversal_share * np.ptp(displacement_um))):
            leg = displacement_um[start : stop + 1]
            sign = 1.0 if leg[-1] >= leg[0] else -1.0
            path[start : stop + 1] = gone + np.maximum.accumulate(sign * (leg - leg[0]))
            gone = float(path[stop])
        with np.errstate(over="ignore"):  # the caller checks the size
            return path / self.speed_um_per_s


@dataclass(frozen=True)
class InHeader:
    """Rows above the samples that hold the diameters.

    Attributes:
        names: how the rows begin: one for a sphere, or three for D1, D2, D3.
        factor: micrometres in the unit of the numbers; None where the file tells it.
    """

    names: tuple[str, ...]
    factor: Fraction | None = None


@dataclass(frozen=True)
class Column:
    """Where a quantity stands, and what its numbers mean."""

    column: str | int
    factor: Fraction = Fraction(1)
    sign: int = 1


@dataclass(frozen=True)
class MappingFile:
    """A checked mapping file; the module's text says what each entry means."""

    file: Path
    columns: dict[str, Column]
    pace: Pace | None = None
    encoding: str = "utf-8"
    delimiter: str = ","
    sheet: str | int | None = None
    decimal_mark: str = "."
    thousands: str | None = None
    missing: tuple[str | float, ...] = ()
    comment_prefix: str | None = None
    skip_rows: int = 0
    begin: str | None = None
    header_rows: int = 1
    skip_footer: int = 0
    end: str | None = None
    tests: Split = "file"
    test_name: str | None = None
    control: Control | None = None
    provenance: str | None = None
    diameters_um: Diameters | None = None
    diameters: InHeader | None = None


def read_mapping(path: str | os.PathLike[str]) -> MappingFile:
    """Read and check a mapping file. Raises `InputError` naming the key that is missing, unknown or wrong."""
    file = Path(path)
    entries = load_toml_file(file, "a TOML mapping file")
    try:
        return MappingFile(file=file, **_values(entries, file))
    except InputError as error:
        raise error.changed(file=file) from None


def _is_encoding(name: str) -> bool:
    try:
        return "".encode(name) is not None
    except (LookupError, ValueError):
        return False


def _are_marks(marks: list[Any]) -> bool:
    return bool(marks) and all(isinstance(mark, str | int | float) and not isinstance(mark, bool) for mark in marks)


_MARKS = '"point", "comma", "apostrophe", "space", "none"'
_TEXT = str, lambda text: bool(text.strip())
_COUNT = int, lambda number: number >= 0, "a whole number, 0 or more"
_PLAIN: dict[str, tuple[type | tuple[type, ...], Callable[[Any], bool], str]] = {
    "encoding": (str, _is_encoding, 'a name such as "latin-1"'),
    "delimiter": (
        str,
        lambda text: text in DELIMITERS or (len(text) == 1 and text not in '"\r\n\0'),
        '"comma", "semicolon", "tab", "space" or one character',
    ),
    "sheet": (
        (str, int),
        lambda sheet: bool(sheet.strip()) if isinstance(sheet, str) else sheet >= 1,
        "the sheet's name, or its number from 1 on",
    ),
    "decimal_mark": (str, (".", ",").__contains__, '"." or ","'),
    "thousands": (str, _THOUSANDS.__contains__, f"{_MARKS} or one of these characters"),
    "missing": (list, _are_marks, 'a list of texts and numbers such as ["NaN", "", -999]'),
    "comment_prefix": (*_TEXT, 'text such as "#"'),
    "skip_rows": _COUNT,
    "begin": (*_TEXT, "the text that the header begins with"),
    "header_rows": _COUNT,
    "skip_footer": _COUNT,
    "end": (*_TEXT, "the text that the first row below the samples begins with"),
    "tests": (str, get_args(Split).__contains__, '"file", "blank line", "header" or "column"'),
    "test_name": (*_TEXT, "text"),
    "control": (str, get_args(Control).__contains__, '"load" or "displacement"'),
    "provenance": (*_TEXT, "text"),
}
"""Kinds of the plain entries, what else must hold of them, and what to write."""


def _wrong(problem: str, key: str, remedy: str) -> InputError:
    return InputError(problem, column=key, remedy=remedy)


def _values(entries: dict[str, Any], file: Path) -> dict[str, Any]:
    _only(entries, [*_PLAIN, "columns", "diameters_um", "diameters"])
    values = {key: entries[key] for key in _PLAIN if key in entries}
    for key, value in values.items():
        kind, allowed, wanted = _PLAIN[key]
        if not isinstance(value, kind) or isinstance(value, bool) or not allowed(value):
            raise _wrong(f"{value!r} is not allowed", key, f"Write {wanted}")
    if "delimiter" in values:
        values["delimiter"] = DELIMITERS.get(values["delimiter"], values["delimiter"])
    if "thousands" in values:
        values["thousands"] = _THOUSANDS[values["thousands"]]
    # TOML has a number nan, which equals nothing, itself included.
    values["missing"] = tuple(
        float(mark) if not isinstance(mark, str) and math.isfinite(mark) else str(mark).strip()
        for mark in values.get("missing", ())
    )
    _refuse_contradictions(values)
    values["columns"], values["pace"] = _columns(entries, values)
    if "diameters" in entries:
        if "diameters_um" in entries:
            raise _wrong("is given beside 'diameters_um'", "diameters", "Keep one of them")
        values["diameters"] = _in_header(entries["diameters"])
    if "diameters_um" in entries:
        values["diameters_um"] = _diameters(entries["diameters_um"], file)
    return values


def _refuse_contradictions(values: dict[str, Any]) -> None:
    thousands = values.get("thousands", "")
    decimals = values.get("decimal_mark", ".") in thousands
    if decimals or (values.get("delimiter") == " " and " " in thousands):
        other = "decimal mark" if decimals else "delimiter"
        raise _wrong(f"the mark between thousands is also the {other}", "thousands", "Correct one of them")
    if "begin" in values and "skip_rows" in values:
        raise _wrong("is given beside 'skip_rows'", "begin", "Keep one of them")
    needing = "begin" if "begin" in values else "tests" if values.get("tests") == "header" else None
    if needing is not None and values.get("header_rows", 1) == 0:
        raise _wrong("needs a header", needing, "Write header_rows of at least 1")
    if "test_name" in values and values.get("tests", "file") != "file":
        raise _wrong('is for tests = "file" only', "test_name", "Remove it")


def _only(entries: MappingABC[str, Any], known: list[str], inside: str = "") -> None:
    for key in entries:
        if key not in known:
            close = get_close_matches(key, known, n=1)
            remedy = f"Did you mean {inside + close[0]!r}?" if close else f"Known keys: {', '.join(known)}"
            raise _wrong("is not a key of a mapping file", inside + key, remedy)


def _columns(entries: dict[str, Any], values: dict[str, Any]) -> tuple[dict[str, Column], Pace | None]:
    tables = entries.get("columns")
    if not isinstance(tables, dict):
        remedy = 'Add [columns.force] with column = "..." and unit = "mN"'
        raise InputError("the table 'columns' is missing", remedy=remedy)
    needed = [*DIMENSIONS, *(["test"] if values.get("tests") == "column" else [])]
    for name in ("test", "particle", "sample", "specimen"):
        if name in tables and name not in needed:
            remedy = 'If a column names the test, write tests = "column" above [columns] and call it test there'
            raise _wrong("is not a key of a mapping file", f"columns.{name}", remedy)
    _only(tables, needed, "columns.")
    found: dict[str, Column] = {}
    pace: Pace | None = None
    for name in needed:
        place, table = f"columns.{name}", tables.get(name)
        if not isinstance(table, dict):
            raise InputError(f"the table {place!r} is missing", remedy=f"Add [{place}]")
        if name == "time" and ("speed" in table or "interval" in table):
            pace = _pace(table)
            continue
        further = {"time": ["unit", "sign", "speed", "interval"], "test": []}.get(name, ["unit", "sign"])
        _only(table, ["column", *further], place + ".")
        column = table.get("column")
        if isinstance(column, bool) or not isinstance(column, str | int) or column in ("", 0):
            remedy = 'Write column = "Load" or column = 2'
            raise _wrong("must be a name in the header or a number from 1 on", f"{place}.column", remedy)
        if (isinstance(column, int) and column < 1) or (isinstance(column, str) and values.get("header_rows", 1) == 0):
            remedy = "Count columns from 1; names need header_rows of at least 1"
            raise _wrong(f"{column!r} cannot be found", f"{place}.column", remedy)
        found[name] = Column(column)
        if name in DIMENSIONS:
            factor, sign = _factor(table.get("unit"), DIMENSIONS[name], place), table.get("sign", 1)
            if isinstance(sign, bool) or sign not in (1, -1):
                raise _wrong(f"{sign!r} is not a sign", f"{place}.sign", "Write 1 or -1")
            found[name] = Column(column, factor, int(sign))
    return found, pace


def _factor(unit: Any, dimension: str, place: str) -> Fraction:
    try:
        if isinstance(unit, str):
            return unit_factor(unit, dimension)
        problem = "the unit is missing" if unit is None else f"{unit!r} is not a unit"
    except ValueError as error:
        problem = str(error)
    raise _wrong(problem, f"{place}.unit", f"Write one of {EXAMPLES[dimension]}")


def _pace(table: dict[str, Any]) -> Pace:
    """The time from `speed` or `interval`."""
    which = "speed" if "speed" in table else "interval"
    place = "columns.time"
    _only(table, [which, "unit"], f"{place}.")
    value, unit = table[which], table.get("unit")
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1e-15 <= value <= 1e15:
        raise _wrong(f"{value!r} is not a positive number", f"{place}.{which}", "Correct it")
    if which == "interval":
        return Pace(interval_s=float(value * _factor(unit, TIME, place)))
    length, slash, time = str(unit).partition("/")
    if not slash:
        problem = "the unit is missing" if unit is None else f"{unit!r} is no unit of speed"
        raise _wrong(problem, f"{place}.unit", "Write one of mm/s, um/s, mm/min")
    factor = _factor(length.strip(), LENGTH, place) / _factor(time.strip(), TIME, place)
    return Pace(speed_um_per_s=float(value * factor))


def _in_header(table: Any) -> InHeader:
    """The rows above the samples that hold the diameters."""
    names = table.get("header") if isinstance(table, dict) else None
    names = [names] if isinstance(names, str) else names
    names = names if isinstance(names, list) else []
    if len(names) not in (1, 3) or not all(isinstance(name, str) and name.strip() for name in names):
        remedy = 'Write header = "Gage length", or header = ["D1", "D2", "D3"]; diameters of your own belong in '
        raise _wrong("must name one row, or three", "diameters.header", remedy + "[diameters_um]")
    _only(table, ["header", "unit"], "diameters.")
    factor = _factor(table["unit"], LENGTH, "diameters") if "unit" in table else None
    return InHeader(tuple(same_text(name).strip() for name in names), factor)


def _diameters(table: Any, file: Path) -> Diameters:
    if not isinstance(table, dict) or not table:
        raise _wrong("must be a table", "diameters_um", "Write all = [D1, D2, D3]")
    for name, triple in table.items():
        if not isinstance(triple, list) or not all(isinstance(v, int | float) and v is not True for v in triple):
            raise _wrong("must be three numbers", f"diameters_um.{name}", "Write [D1, D2, D3] in um")
        check_triple(triple, f"{name!r}", file)
    if list(table) == ["all"]:
        return [float(value) for value in table["all"]]
    return {name: [float(value) for value in triple] for name, triple in table.items()}
