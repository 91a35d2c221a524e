"""Any other text table, described by a TOML mapping file.

A mapping file has these keys; all but `columns` may be left out, and any other key is an error:

    encoding = "utf-8"         # a name that Python knows: "latin-1", "utf-16", "cp1252", "gb18030", ...
    delimiter = "comma"        # "comma", "semicolon", "tab", "space" (any number of blanks), or one character
    decimal_mark = "."         # "." or ","
    comment_prefix = "#"       # rows that begin so are passed over
    skip_rows = 0              # rows above the header, whatever they hold
    header_rows = 1            # rows of the header: names in the first, for instance units in the next; 0 for none
    tests = "file"             # how tests are told apart: "file" (the file is one test), "blank line" (tests are
                               # parted by empty rows and called 1, 2, ...) or "column" (a column names the test)
    test_name = "A1"           # for tests = "file": the name; otherwise that of the file without its ending
    control = "load"           # "load" or "displacement", as in campaign.toml
    provenance = "..."         # in words; added to what the reader writes itself

    [columns.time]             # and columns.force, columns.displacement: all three are needed
    column = "Time (s)"        # the name in the header, or the number of the column, 1 for the first
    unit = "s"                 # any unit of time (force, length)
    sign = 1                   # -1 turns the sign round, where the tester counts compression as negative

    [columns.test]             # for tests = "column"
    column = "Sample"

    [diameters_um]             # instead of --diameters: D1, D2, D3 of all tests, or of each by its name
    all = [200.0, 190.0, 180.0]
"""

from __future__ import annotations

import os
from collections.abc import Mapping as MappingABC
from dataclasses import dataclass, field
from difflib import get_close_matches
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, get_args

from ..._errors import InputError
from .._columns import EXAMPLES, FORCE, LENGTH, TIME, unit_factor
from .._metadata import load_toml_file
from .._schema import Control
from ._diameters import Diameters, check_triple

_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
DIMENSIONS = {"time": TIME, "force": FORCE, "displacement": LENGTH}
Split = Literal["file", "blank line", "column"]


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
    encoding: str = "utf-8"
    delimiter: str = ","
    decimal_mark: str = "."
    comment_prefix: str | None = None
    skip_rows: int = 0
    header_rows: int = 1
    tests: Split = "file"
    test_name: str | None = None
    control: Control | None = None
    provenance: str | None = None
    diameters_um: Diameters | None = field(default=None)


def read_mapping(path: str | os.PathLike[str]) -> MappingFile:
    """Read and check a mapping file.

    Args:
        path: the TOML file.

    Raises:
        InputError: naming the key that is missing, unknown or wrong.
    """
    file = Path(path)
    entries = load_toml_file(file, "a TOML mapping file")
    known = [name for name in MappingFile.__dataclass_fields__ if name != "file"]
    _only(entries, known, file)
    values: dict[str, Any] = {}
    for key, kind, wanted in (
        ("encoding", str, 'a name such as "latin-1"'),
        ("delimiter", str, '"comma", "semicolon", "tab", "space" or one character'),
        ("decimal_mark", str, '"." or ","'),
        ("comment_prefix", str, 'text such as "#"'),
        ("skip_rows", int, "a whole number, 0 or more"),
        ("header_rows", int, "a whole number, 0 or more"),
        ("tests", str, '"file", "blank line" or "column"'),
        ("test_name", str, "text"),
        ("control", str, '"load" or "displacement"'),
        ("provenance", str, "text"),
    ):
        if key in entries:
            value = entries[key]
            if not isinstance(value, kind) or isinstance(value, bool) or not _allowed(key, value):
                raise InputError(f"{value!r} is not allowed", file=file, column=key, remedy=f"Write {wanted}")
            values[key] = value
    if "delimiter" in values:
        values["delimiter"] = _DELIMITERS.get(values["delimiter"], values["delimiter"])
    if values.get("delimiter", ",") == values.get("decimal_mark", "."):
        raise InputError(
            "the delimiter is also the decimal mark", file=file, column="delimiter", remedy="Give both as in the file"
        )
    if values.get("test_name") is not None and values.get("tests", "file") != "file":
        raise InputError('is for tests = "file" only', file=file, column="test_name", remedy="Remove it")
    values["columns"] = _columns(entries, values, file)
    if "diameters_um" in entries:
        values["diameters_um"] = _diameters(entries["diameters_um"], file)
    return MappingFile(file=file, **values)


def _allowed(key: str, value: Any) -> bool:
    match key:
        case "encoding":
            try:
                return "".encode(value) is not None
            except (LookupError, ValueError):
                return False
        case "delimiter":
            return value in _DELIMITERS or (len(value) == 1 and value not in '"\r\n\0')
        case "decimal_mark":
            return value in (".", ",")
        case "skip_rows" | "header_rows":
            return value >= 0
        case "tests":
            return value in get_args(Split)
        case "control":
            return value in get_args(Control)
        case _:
            return bool(value.strip())


def _only(entries: MappingABC[str, Any], known: list[str], file: Path, inside: str = "") -> None:
    for key in entries:
        if key not in known:
            close = get_close_matches(key, known, n=1)
            remedy = f"Did you mean {inside + close[0]!r}?" if close else f"Known keys: {', '.join(known)}"
            raise InputError("is not a key of a mapping file", file=file, column=inside + key, remedy=remedy)


def _columns(entries: dict[str, Any], values: dict[str, Any], file: Path) -> dict[str, Column]:
    tables = entries.get("columns")
    if not isinstance(tables, dict):
        raise InputError(
            "the table 'columns' is missing",
            file=file,
            remedy='Add [columns.force] with column = "..." and unit = "mN"',
        )
    by_column = values.get("tests") == "column"
    needed = [*DIMENSIONS, *(["test"] if by_column else [])]
    for name in ("test", "particle", "sample", "specimen"):
        if name in tables and name not in needed:
            raise InputError(
                "is not a key of a mapping file",
                file=file,
                column=f"columns.{name}",
                remedy='If a column names the test, write tests = "column" above [columns] and call it test there',
            )
    _only(tables, needed, file, "columns.")
    found: dict[str, Column] = {}
    for name in needed:
        place = f"columns.{name}"
        table = tables.get(name)
        if not isinstance(table, dict):
            raise InputError(f"the table {place!r} is missing", file=file, remedy=f"Add [{place}]")
        _only(table, ["column", "unit", "sign"] if name in DIMENSIONS else ["column"], file, place + ".")
        column = table.get("column")
        if isinstance(column, bool) or not isinstance(column, str | int) or column in ("",) or column == 0:
            raise InputError(
                "must be a name in the header or a number from 1 on",
                file=file,
                column=f"{place}.column",
                remedy='Write column = "Load" or column = 2',
            )
        if (isinstance(column, int) and column < 1) or (isinstance(column, str) and values.get("header_rows", 1) == 0):
            raise InputError(
                f"{column!r} cannot be found",
                file=file,
                column=f"{place}.column",
                remedy="Count columns from 1; names need header_rows of at least 1",
            )
        found[name] = Column(column, *_meaning(table, name, file)) if name in DIMENSIONS else Column(column)
    return found


def _meaning(table: dict[str, Any], name: str, file: Path) -> tuple[Fraction, int]:
    dimension, place = DIMENSIONS[name], f"columns.{name}"
    unit, sign = table.get("unit"), table.get("sign", 1)
    remedy = f"Write one of {EXAMPLES[dimension]}"
    if not isinstance(unit, str):
        problem = "the unit is missing" if unit is None else f"{unit!r} is not a unit"
        raise InputError(problem, file=file, column=f"{place}.unit", remedy=remedy)
    try:
        factor = unit_factor(unit, dimension)
    except ValueError as error:
        raise InputError(str(error), file=file, column=f"{place}.unit", remedy=remedy) from None
    if isinstance(sign, bool) or sign not in (1, -1):
        raise InputError(f"{sign!r} is not a sign", file=file, column=f"{place}.sign", remedy="Write 1 or -1")
    return factor, int(sign)


def _diameters(table: Any, file: Path) -> Diameters:
    if not isinstance(table, dict) or not table:
        raise InputError("must be a table", file=file, column="diameters_um", remedy="Write all = [D1, D2, D3]")
    for name, triple in table.items():
        numbers = isinstance(triple, list) and all(isinstance(v, int | float) and v is not True for v in triple)
        if not numbers:
            raise InputError(
                "must be three numbers", file=file, column=f"diameters_um.{name}", remedy="Write [D1, D2, D3] in um"
            )
        check_triple(triple, f"{name!r}", file)
    if "all" in table and len(table) == 1:
        return [float(value) for value in table["all"]]
    return {name: [float(value) for value in triple] for name, triple in table.items()}
