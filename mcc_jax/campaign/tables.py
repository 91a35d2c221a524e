"""Tables of text with commas, semicolons or tabs, and sheets of Excel workbooks: cells, numbers, columns with units.

Numbers may have a decimal comma, between quotes where commas separate the columns, as long as it cannot be a thousands
separator. A delimiter after the last cell of a row, and rows of delimiters only, hold nothing.
"""

from __future__ import annotations

import csv
import io
import math
import re
import unicodedata
import zipfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import InputError
from .._extras import extra
from .._format import counted, first_few
from ..files import TABLE_BYTES, UNPACKED_BYTES, read_regular

# A larger magnitude (in mN, um or s) is a wrong unit or a damaged cell, and its powers would overflow further on.
LARGEST_MAGNITUDE = 1e15
SPACES = " \u00a0\u2007\u2009\u202f"
"""Blank, no-break, figure, thin and narrow no-break space: nobody sees which of them separates the thousands."""
APOSTROPHES = "'\u2019"
_MAGIC = {
    b"\x1f\x8b": "gzip-compressed",
    b"PK\x03\x04": "a zip archive or an Excel workbook",
    b"PK\x05\x06": "an empty zip archive",
    b"BZh": "bzip2-compressed",
    b"\xfd7zXZ": "xz-compressed",
    b"\x28\xb5\x2f\xfd": "zstd-compressed",
    b"7z\xbc\xaf": "a 7-zip archive",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook",
    b"\x89HDF": "an HDF5 file",
    b"PAR1": "a Parquet file",
    b"%PDF": "a PDF file",
}


def binary_kind(data: bytes) -> str | None:
    """What a file that is not text is, in words."""
    for magic, kind in _MAGIC.items():
        if data.startswith(magic):
            return kind
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "UTF-16 text"
    return "binary (it holds NUL bytes)" if b"\0" in data else None


def read_bytes(file: Path) -> bytes:
    """The bytes of a table or an instrument's export; `InputError` if there are none, or too many."""
    data = read_regular(file, TABLE_BYTES, "Split it into several, or thin its readings")
    if not data.strip(b" \t\r\n\xef\xbb\xbf"):
        raise InputError("the file is empty", file=file, remedy="Export it again")
    return data


def decode(data: bytes, file: Path, wanted: str = "plain CSV text in UTF-8") -> str:
    """UTF-8 text, without a byte order mark. Raises `InputError` if it is compressed, binary or in another encoding."""
    kind = binary_kind(data)
    if kind is not None:
        raise InputError(f"the file is {kind}, not text", file=file, remedy=f"Save it as {wanted}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # The decoder may count from behind the byte order mark; the bytes it saw are in the exception.
        before = bytes(error.object[: error.start])
        row = 1 + before.count(b"\n") + before.replace(b"\r\n", b"").count(b"\r")
        problem = f"the byte 0x{error.object[error.start]:02x} is not UTF-8"
        raise InputError(problem, file=file, row=row, remedy="Save it as UTF-8") from None


def same_text(text: str) -> str:
    """A name in the one form (Unicode NFC) in which names are compared: an accent may be a separate character."""
    return unicodedata.normalize("NFC", text)


# ---- numbers ---------------------------------------------------------------------------------------------------------

_LARGEST_NUMBER = LARGEST_MAGNITUDE * 1e12  # in any unit


def parse_number(cell: str, decimal_mark: str = ".", thousands: str = "") -> float:
    """A cell's number, or a `ValueError` that says why there is none; each of the characters `thousands` may separate
    groups of three digits."""
    text = plain = cell.strip()
    in_groups = bool(thousands) and any(mark in text for mark in thousands)
    if in_groups and _grouped(thousands, decimal_mark).fullmatch(text):
        plain = re.sub(f"[{re.escape(thousands)}]", "", text)
    # Python also reads 1_000 and digits of other scripts; in a data file both are mistakes.
    odd = not plain.isascii() or "_" in plain or (decimal_mark != "." and "." in plain)
    try:
        number = None if odd else float(plain.replace(decimal_mark, "."))
    except ValueError:
        number = None
    if number is not None and abs(number) <= _LARGEST_NUMBER:
        return number
    if not text:
        raise ValueError("the cell is empty")
    shown = repr(text if len(text) <= 40 else f"{text[:40]}...")
    if number is not None:
        what = "too large to be a measurement" if math.isfinite(number) else "not a finite number"
        raise ValueError(f"{shown} is {what}")
    if in_groups:
        raise ValueError(f"{shown} is not a number with groups of three digits")
    hint = " (a decimal comma?)" if decimal_mark == "." and text.count(",") == 1 else ""
    if thousands_mark(text, decimal_mark) and (not hint or "." in text):
        hint = " (a mark between the thousands?)"
    raise ValueError(f"{shown} is not a number{hint}")


@cache
def _one_group(mark: str) -> re.Pattern[str]:
    return re.compile(rf"[-+]?[1-9][0-9]{{0,2}}{re.escape(mark)}[0-9]{{3}}")


@cache
def _grouped(thousands: str, decimal_mark: str) -> re.Pattern[str]:
    mark, point = f"[{re.escape(thousands)}]", re.escape(decimal_mark)
    return re.compile(rf"[-+]?[0-9]{{1,3}}({mark})[0-9]{{3}}(?:\1[0-9]{{3}})*(?:{point}[0-9]*)?(?:[eE][-+]?[0-9]+)?")


def thousands_mark(cell: str, decimal_mark: str = ".") -> str | None:
    """The mark between groups of three digits in a cell that is no number without it; None if there is none."""
    marks = (".", ",", *APOSTROPHES, *SPACES)
    return next((m for m in marks if m != decimal_mark and _grouped(m, decimal_mark).fullmatch(cell.strip())), None)


def thousands_for_decimals(cells: Sequence[str], mark: str) -> tuple[int, str] | None:
    """The index of a cell whose decimal mark may be one between thousands, and what is wrong with it."""
    # So it looks where some cells of a quantity hold whole numbers of three digits and more without the mark (500), and
    # every other one has one to three digits, the mark, and three digits (1.500). Programs write neither: with a fixed
    # number of decimals 500 would be 500.000, and without a fixed one 1.500 would be 1.5.
    marked = [i for i, cell in enumerate(cells) if mark in cell]
    if not marked or not all(_one_group(mark).fullmatch(cells[i].strip()) for i in marked):
        return None
    whole = next((cell.strip() for cell in cells if re.fullmatch(r"[-+]?[1-9][0-9]{2,}", cell.strip())), None)
    if whole is None:
        return None
    alike = f"{cells[marked[0]].strip()!r} next to {whole!r}"
    return marked[0], f"{alike} looks like a mark between thousands, not a decimal mark"


# ---- tables ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """A table: names of the columns, their cells as text or, where they are plain, numbers, and each record's row."""

    file: Path
    header: tuple[str, ...]
    columns: Sequence[Sequence[str] | np.ndarray]
    rows: Sequence[int]
    delimiter: str = ","

    def wrong(self, problem: str, record: int | np.integer, column: int, remedy: str) -> InputError:
        """The error for a cell."""
        row = self.rows[int(record)]
        return InputError(problem, file=self.file, row=row, column=self.header[column], remedy=remedy)

    def decimal_mark(self, columns: Sequence[int]) -> str:
        """The decimal mark of some columns: a comma if one appears in them and is no thousands separator."""
        # Spreadsheets separate columns by semicolons where the comma is the decimal mark. With tabs, or commas and
        # quotes, 1,500 is either: then a comma counts if there is no point in the columns and some cell, such as 1,5,
        # has other than three digits behind it.
        texts = ["\n".join(self.columns[i]) for i in columns]
        if not any("," in text for text in texts):
            return "."
        if self.delimiter == ";":
            return ","
        commas = (cell.strip() for i in columns for cell in self.columns[i] if "," in cell)
        either = any("." in text for text in texts) or all(_one_group(",").fullmatch(cell) for cell in commas)
        return "." if either else ","

    def refuse_groups(self, columns: Sequence[int]) -> None:
        """Refuse numbers whose decimal mark looks like a thousands separator; columns of a unit are judged together."""
        mark = self.decimal_mark(columns)
        units: dict[str, list[int]] = {}
        for column in columns:
            units.setdefault(self.header[column].rpartition("_")[2], []).append(column)
        for alike in units.values():
            found = thousands_for_decimals([cell for column in alike for cell in self.columns[column]], mark)
            if found is not None:
                place, record = divmod(found[0], len(self.rows))
                remedy = "Write numbers without marks between the thousands, or all with as many decimals"
                raise self.wrong(found[1], record, alike[place], remedy)

    def numbers(self, columns: Sequence[int], mark: str | None = None, remedy: str | None = None) -> list[np.ndarray]:
        """The cells of some columns as finite numbers, all with one decimal mark; the first that is none is named."""
        if all(isinstance(self.columns[i], np.ndarray) for i in columns):
            return [self.columns[i] for i in columns]  # type: ignore[misc]
        mark = self.decimal_mark(columns) if mark is None else mark
        point = "a decimal point" if mark == "." else "a decimal comma, as in the other rows,"
        found = []
        for i in columns:
            values = np.empty(len(self.rows))
            for record, cell in enumerate(self.columns[i]):
                try:
                    values[record] = parse_number(cell, mark)  # type: ignore[arg-type]
                except ValueError as error:
                    remedy = remedy or f"Write a number with {point}, or remove the row"
                    raise self.wrong(str(error), record, i, remedy) from None
            found.append(values)
        return found


def filled(cells: Sequence[str]) -> int:
    """The number of cells up to the last one that holds something."""
    return next((i for i in range(len(cells), 0, -1) if cells[i - 1].strip()), 0)


def make_table(records: Sequence[list[str]], rows: Sequence[int], file: Path, delimiter: str = ",") -> Table:
    """A table from the cells of its records, the header first, and the row in which each begins; empty records, and
    empty cells behind the last column that has a name, are dropped."""
    full = [i for i, cells in enumerate(records) if (cells and cells[0].strip()) or filled(cells)]
    if not full:
        raise InputError("the file is empty", file=file, remedy="Export it again")
    names = records[full[0]]
    header = _header(names[: filled(names)], file)
    body = [records[i] for i in full[1:]]
    rows = [rows[i] for i in full[1:]]
    if not body:
        raise InputError("there is a header but no row of data", file=file, row=1, remedy="Export it again")
    if {*map(len, body)} != {len(header)}:
        body = [_fit(cells, row, names, file) for cells, row in zip(body, rows, strict=True)]
    return Table(file, header, list(zip(*body, strict=True)), rows, delimiter)


def check_header(header: Sequence[str], file: Path, row: int | None, remedy: str) -> None:
    """Refuse a name that appears twice."""
    for name, count in Counter(header).most_common(1):
        if count > 1:
            raise InputError(f"column appears {count} times", file=file, row=row, column=name, remedy=remedy)


def _header(cells: list[str], file: Path) -> tuple[str, ...]:
    """Names of the columns, without blanks around them; none may be empty or appear twice."""
    header = tuple(cell.strip().strip("\ufeff").strip() for cell in cells)
    for i, name in enumerate(header):
        if not name:
            raise InputError(f"the name of column {i + 1} is empty", file=file, row=1, remedy="Name or delete it")
    check_header(header, file, 1, "Rename or delete one")
    return header


def _fit(cells: list[str], row: int, names: list[str], file: Path) -> list[str]:
    """The cells of a row below the names of the header; an error if there are more or fewer of them."""
    width, count = filled(names), filled(cells)
    if len(cells) >= width >= count:
        return cells[:width]
    column, remedy = None, "Use decimal points, and quote text that holds what separates the columns"
    if len(cells) < width:
        count, column, remedy = len(cells), names[len(cells)].strip(), "Fill the cell"
    problem = f"{counted(count, 'cell')} where the header has {width}"
    raise InputError(problem, file=file, row=row, column=column, remedy=remedy)


def split(text: str, file: Path, delimiter: str) -> tuple[list[list[str]], Sequence[int]]:
    """The cells of every record of a text, and the line in which each begins; an error where quotes do not close."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True, delimiter=delimiter)
    records: list[list[str]] = []
    lines = [1]  # in which each record begins, and the next one
    try:
        for record in reader:
            records.append(record)
            lines.append(reader.line_num + 1)
    except csv.Error as error:
        problem = f"quotes or cells are damaged ({error})"
        raise InputError(problem, file=file, row=lines[-1], remedy="Close every double quote") from None
    return records, lines[:-1]


def read_table(file: Path, names: str = "") -> Table:
    """A table of a file; if a column of `names` is given, the others are numbers, parsed at once if all are plain."""
    text = decode(read_bytes(file), file)
    return (plain_table(text, file, names) if names else None) or parse_table(text, file)


def plain_table(text: str, file: Path, names: str) -> Table | None:
    """A table of names and plain numbers, read by pandas, which is several times as fast; None if it is another."""
    import pandas as pd

    head, _, body = text.rstrip("\r\n").partition("\n")
    cells = head.rstrip("\r").split(",")
    if '"' in text or names not in cells or filled(cells) < len(cells):
        return None
    header = _header(cells, file)
    # Columns have numbers, since pandas keeps names as Arrow strings, which would reserve a GiB for a few letters.
    types: Any = {i: object if name == names else float for i, name in enumerate(header)}
    try:  # without the filter of missing values, cells that are empty or too few are errors
        frame = pd.read_csv(io.BytesIO(text.encode()), header=0, names=list(types), dtype=types, na_filter=False)
    except ValueError:
        return None
    columns = [frame[i].to_numpy() if kind is float else frame[i].tolist() for i, kind in types.items()]
    # An index: there were more cells than names. Other lines: some were empty, or lines end otherwise.
    whole = isinstance(frame.index, pd.RangeIndex) and len(frame) == body.count("\n") + 1
    if whole and all((np.abs(column) <= _LARGEST_NUMBER).all() for column in columns if not isinstance(column, list)):
        return Table(file, header, columns, range(2, len(frame) + 2))
    return None


def parse_table(text: str, file: Path) -> Table:
    """A whole table of text; its delimiter is the commonest, outside of quotes, in the first line that is not blank."""
    header = re.sub('"[^"]*"', "", re.match(r"\s*[^\r\n]*", text)[0])  # type: ignore[index]  # it matches every text
    delimiter = max(",;\t", key=header.count)
    return make_table(*split(text, file, delimiter), file, delimiter)


# ---- Excel workbooks -------------------------------------------------------------------------------------------------


def is_workbook(data: bytes) -> bool:
    """Whether a file is an Excel workbook, not another zip archive."""
    if not data.startswith(b"PK\x03\x04"):
        return False
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return "xl/workbook.xml" in archive.namelist()
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError, EOFError):
        return False


def read_sheet(
    data: bytes,
    file: Path,
    sheet: str | int | None = None,
    *,
    preferred: str | None = None,
    decimal_mark: str = ".",
    how: str = "",
) -> list[list[str]]:
    """The cells of all rows of a sheet as text, numbers with all their digits and this decimal mark. It is the sheet of
    this name or number, 1 for the first, else the `preferred` one, or the only one that holds anything; `how` is how to
    choose one."""
    import pandas as pd

    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > UNPACKED_BYTES:
            raise InputError("the workbook is too large", file=file, remedy="Save the sheet alone, or as CSV")
    with extra("excel", file):
        import python_calamine  # noqa: F401
    try:
        frames: dict[Any, Any] = pd.read_excel(
            io.BytesIO(data), sheet_name=None, engine="calamine", header=None, dtype=object, na_filter=False
        )
    # The engine's errors have no common type, and its panics are no Exception.
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | SystemExit | MemoryError):
            raise
        remedy = "Open it in a spreadsheet program and save it again, or save the sheet as CSV"
        raise InputError("the workbook is damaged", file=file, remedy=remedy) from None
    names = list(frames)
    if isinstance(sheet, int) and sheet <= len(names):
        sheet = names[sheet - 1]
    wanted = preferred if sheet is None and preferred in names else sheet
    if wanted is not None and wanted not in names:
        remedy = f"The sheets are: {', '.join(map(repr, names))}"
        raise InputError(f"there is no sheet {wanted!r}", file=file, remedy=remedy)
    held = [name for name, frame in frames.items() if frame.size and wanted in (None, name)]
    if not held:
        where = f"the sheet {wanted!r}" if wanted is not None else "every sheet"
        raise InputError(f"{where} is empty", file=file, remedy="Save the workbook again with the table in it")
    if len(held) > 1:
        remedy = how or f"Call the sheet with the table {preferred!r}, or save it alone"
        problem = f"{len(held)} sheets hold something: {', '.join(map(repr, held))}"
        raise InputError(problem, file=file, remedy=remedy)

    def text(value: Any) -> str:
        return repr(value).replace(".", decimal_mark) if isinstance(value, float) else str(value)

    rows = frames[held[0]].itertuples(index=False, name=None)
    return [[text(value) for value in row] for row in rows]


# ---- columns whose names carry their unit: `force_mN`, `displacement_um`, `time_s`, `D1_um` --------------------------

DIMENSIONS = {"time": "time", "force": "force", "displacement": "length"}
CANONICAL = {"force": "mN", "length": "um", "time": "s"}
EXAMPLES = {"force": "mN, N, uN, kN, gf", "length": "um, nm, mm, m", "time": "s, ms, min"}


@cache
def _registry() -> Any:
    from pint import UnitRegistry  # slow to import, and needed for other than the usual units only

    # Fractions keep nm -> um at exactly 1/1000.
    registry: Any = UnitRegistry
    return registry(non_int_type=Fraction)


@cache
def unit_factor(unit: str, dimension: str) -> Fraction:
    """How many canonical units (mN, um, s) one `unit` is; `ValueError` if it is unknown or measures something else."""
    canonical = CANONICAL[dimension]
    if unit == canonical:
        return Fraction(1)
    if not unit:
        raise ValueError("the unit is missing")
    if re.fullmatch(r"[A-Za-zµμ]{1,24}", unit) is None:
        raise ValueError(f"{unit!r} is not a unit")
    try:
        quantity = _registry().Quantity(Fraction(1), unit)
    # Pint reports an unknown name through many exception types, some of them from Python's tokenizer.
    except Exception:
        raise ValueError(f"the unit {unit!r} is unknown") from None
    if not quantity.is_compatible_with(canonical):
        raise ValueError(f"{unit!r} is no unit of {dimension}")
    return Fraction(quantity.to(canonical).magnitude)


def convert(values: np.ndarray, factor: Fraction) -> np.ndarray:
    """`values * factor`, rounded once where the factor is a whole number or the inverse of one."""
    if factor == 1:
        return values
    with np.errstate(over="ignore"):  # the caller checks the size and names the row
        return values / float(factor.denominator) if factor.numerator == 1 else values * float(factor)


def find_column(
    header: Sequence[str], quantity: str, dimension: str, file: str | Path, *, what: str = "column"
) -> tuple[int, Fraction]:
    """Where a name such as "force", without its unit, is in a header, and what turns the unit into the canonical one.
    The error calls the names `what`."""
    expected = f"{quantity}_{CANONICAL[dimension]}"
    units = f"units, as a suffix: {EXAMPLES[dimension]} (for example {expected})"
    found = [i for i, name in enumerate(header) if name.rpartition("_")[0] == quantity]
    if len(found) == 1:
        named = header[found[0]]
        try:
            return found[0], unit_factor(named.rpartition("_")[2], dimension)
        except ValueError as error:
            problem, remedy = str(error), f"Accepted {units}"
    elif found:
        problem, named = f"{quantity} is given {len(found)} times", " and ".join(header[i] for i in found)
        remedy = "Keep one of them"
    elif quantity in header:
        problem, named, remedy = "the unit is missing", quantity, f"Name it {expected}; accepted {units}"
    else:
        raise missing_column(header, expected, file, what=what, hint=f"; accepted {units}")
    raise InputError(problem, file=file, row=1 if what == "column" else None, column=named, remedy=remedy)


def missing_column(
    header: Sequence[str], expected: str, file: str | Path, *, what: str = "column", hint: str = ""
) -> InputError:
    """The error for a column that is not there, with the nearest name that is."""
    lower = {name.lower(): name for name in reversed(header)}
    remedy = f"Add it; there are: {first_few(header, 12)}"
    if close := get_close_matches(expected.lower(), list(lower), n=1):
        remedy = f"Did you mean {expected!r} by {lower[close[0]]!r}? Rename it"
    row = 1 if what == "column" else None
    return InputError(f"the {what} {expected!r} is missing", file=file, row=row, remedy=remedy + hint)
