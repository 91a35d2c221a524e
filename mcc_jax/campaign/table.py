"""Tables of a campaign: reading them strictly, and saying where they are wrong as an editor counts rows.

Columns are parted by commas, or, as spreadsheets of many countries write, by semicolons or tabs. Numbers may have a
decimal comma, between quotes where commas part the columns, as long as it cannot be a mark between thousands. A
delimiter behind the last cell of a row, and rows of delimiters only, hold nothing.
"""

from __future__ import annotations

import csv
import io
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from .._errors import InputError
from ..files import LIMITS, FileLimits, read_table_bytes
from .columns import LARGEST_MAGNITUDE

SPACES = " \u00a0\u2007\u2009\u202f"
"""Blank, no-break, figure, thin and narrow no-break space: nobody sees which of them parts the thousands."""
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
    """What a file that is not text is, in words; None for text."""
    for magic, kind in _MAGIC.items():
        if data.startswith(magic):
            return kind
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "UTF-16 text"
    return "binary (it holds NUL bytes)" if b"\0" in data else None


def read_bytes(file: Path, limits: FileLimits = LIMITS) -> bytes:
    """The bytes of a table or a tester's export.

    Raises `InputError` if it cannot be read, is empty or too large; see `mcc_jax.files`.
    """
    data = read_table_bytes(file, limits)
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
    """A name in the one form (Unicode NFC) in which names are compared: an accent may be a character of its own."""
    return unicodedata.normalize("NFC", text)


@dataclass(frozen=True)
class Table:
    """A table as text: names of columns, records, the row at which each record starts, and what parts the columns."""

    file: Path
    header: tuple[str, ...]
    records: list[list[str]]
    rows: list[int]
    delimiter: str = ","

    def text(self, column: int) -> list[str]:
        """The cells of a column, as they stand."""
        return [record[column] for record in self.records]

    def decimal_mark(self, columns: Sequence[int]) -> str:
        """The decimal mark of some columns: a comma if one stands in them and is no mark between thousands.

        Spreadsheets part columns by semicolons where the comma is the decimal mark, so there it always is. With tabs,
        or commas and quotes, 1,500 is either: then a comma counts if no point stands in the columns and some cell,
        such as 1,5, has other than three digits behind it.
        """
        cells = [cell for record in self.records for cell in (record[i].strip() for i in columns)]
        commas = [cell for cell in cells if "," in cell]
        if not commas or self.delimiter == ";":
            return "," if commas else "."
        if any("." in cell for cell in cells) or all(_one_group(",").fullmatch(cell) for cell in commas):
            return "."
        return ","

    def refuse_groups(self, columns: Sequence[int]) -> None:
        """Refuse numbers whose decimal mark looks like one between thousands; columns of a unit are judged together."""
        mark = self.decimal_mark(columns)
        units: dict[str, list[int]] = {}
        for column in columns:
            units.setdefault(self.header[column].rpartition("_")[2], []).append(column)
        for alike in units.values():
            cells = ((k, record[column]) for column in alike for k, record in enumerate(self.records))
            if (found := thousands_for_decimals(cells, mark)) is not None:
                k, problem = found
                column = next(c for c in alike if mark in self.records[k][c])
                remedy = "Write numbers without marks between the thousands, or all with as many decimals"
                raise InputError(problem, file=self.file, row=self.rows[k], column=self.header[column], remedy=remedy)

    def numbers(self, columns: Sequence[int]) -> list[np.ndarray]:
        """The cells of some columns as finite numbers, all with one decimal mark; the first that is none is named."""
        mark, cells = self.decimal_mark(columns), list(zip(self.rows, self.records, strict=True))
        return [np.array([self._number(record[i], mark, row, i) for row, record in cells]) for i in columns]

    def _number(self, cell: str, mark: str, row: int, column: int) -> float:
        try:
            return parse_number(cell, mark)
        except ValueError as error:
            point = "a decimal point" if mark == "." else "a decimal comma, as in the other rows,"
            if thousands_mark(cell, mark):
                point += " and no mark between the thousands"
            remedy = f"Write a number with {point}, or remove the row"
            raise InputError(str(error), file=self.file, row=row, column=self.header[column], remedy=remedy) from None


def parse_number(cell: str, decimal_mark: str = ".", thousands: str = "") -> float:
    """A cell's number.

    Args:
        cell: the text.
        decimal_mark: "." or ",".
        thousands: characters each of which may stand between groups of three digits; none if empty.

    Raises `ValueError` if the cell is empty, text, not finite, or too large; the text says which.
    """
    stripped = cell.strip()
    if not stripped:
        raise ValueError("the cell is empty")
    plain = stripped if decimal_mark == "." else stripped.replace(decimal_mark, ".")
    shown = stripped if len(stripped) <= 40 else stripped[:40] + "..."
    foreign = decimal_mark != "." and "." in stripped
    if thousands and any(mark in stripped for mark in thousands):
        grouped = _grouped(thousands, decimal_mark).fullmatch(stripped)
        if grouped is None:
            raise ValueError(f"{shown!r} is not a number with groups of three digits")
        plain = re.sub(f"[{re.escape(thousands)}]", "", stripped).replace(decimal_mark, ".")
        foreign = False
    try:
        # Python also reads 1_000 and digits of other scripts; in a data file both are mistakes.
        number = float(plain) if plain.isascii() and "_" not in plain else None
    except ValueError:
        number = None
    if number is None or foreign:
        hint = " (a decimal comma?)" if decimal_mark == "." and stripped.count(",") == 1 else ""
        if thousands_mark(stripped, decimal_mark):
            hint = " (a mark between the thousands?)" if not hint or "." in stripped else hint
        raise ValueError(f"{shown!r} is not a number{hint}")
    if math.isnan(number) or (math.isinf(number) and "n" in plain.lower()):
        raise ValueError(f"{shown!r} is not a finite number")
    if abs(number) > LARGEST_MAGNITUDE * 1e12:
        raise ValueError(f"{shown!r} is too large to be a measurement")
    return number


def thousands_for_decimals(cells: Iterable[tuple[int, str]], mark: str) -> tuple[int, str] | None:
    """Where a decimal mark may be one between thousands, so that readings would be a thousandth of what they are.

    So it looks where some cells of a quantity hold whole numbers of three digits and more without the mark (500), and
    every other one has one to three digits, the mark, and three digits (1.500). Programs write neither: with a fixed
    number of decimals 500 would be 500.000, and without a fixed one 1.500 would be 1.5.

    Args:
        cells: row and text of each.
        mark: the decimal mark.

    Returns:
        The row of the first such cell and what is wrong with it; None if nothing is.
    """
    grouped: tuple[int, str] | None = None
    whole: str | None = None
    for row, text in cells:
        cell = text.strip()
        if mark in cell:
            if not _one_group(mark).fullmatch(cell):
                return None
            grouped = grouped or (row, cell)
        elif whole is None and _WHOLE.fullmatch(cell):
            whole = cell
    if grouped is None or whole is None:
        return None
    row, cell = grouped
    return row, f"{cell!r} beside {whole!r} looks like a mark between thousands, not a decimal mark"


_WHOLE = re.compile(r"[-+]?[1-9][0-9]{2,}")


@cache
def _one_group(mark: str) -> re.Pattern[str]:
    return re.compile(rf"[-+]?[1-9][0-9]{{0,2}}{re.escape(mark)}[0-9]{{3}}")


@cache
def _grouped(thousands: str, decimal_mark: str) -> re.Pattern[str]:
    mark, point = f"[{re.escape(thousands)}]", re.escape(decimal_mark)
    return re.compile(rf"[-+]?[0-9]{{1,3}}({mark})[0-9]{{3}}(?:\1[0-9]{{3}})*(?:{point}[0-9]*)?(?:[eE][-+]?[0-9]+)?")


def thousands_mark(cell: str, decimal_mark: str = ".") -> str | None:
    """The mark between groups of three digits in a cell that is no number without it; None if there is none."""
    for mark in (".", ",", *APOSTROPHES, *SPACES):
        if mark != decimal_mark and _grouped(mark, decimal_mark).fullmatch(cell.strip()):
            return mark
    return None


def _header(cells: list[str], file: Path) -> tuple[str, ...]:
    """Names of the columns, without blanks around them; none may be empty or stand there twice."""
    if len(cells) == 1 and "|" in cells[0]:
        problem = "the columns are separated by '|'"
        raise InputError(problem, file=file, row=1, remedy="Use commas, semicolons or tabs instead")
    header = tuple(cell.strip().strip("\ufeff").strip() for cell in cells)
    for i, name in enumerate(header):
        if not name:
            raise InputError(f"the name of column {i + 1} is empty", file=file, row=1, remedy="Name or delete it")
    name, count = Counter(header).most_common(1)[0]
    if count > 1:
        raise InputError(f"stands there {count} times", file=file, row=1, column=name, remedy="Rename or delete one")
    return header


def number_of_cells(count: int) -> str:
    """The number of cells of a row, in words."""
    return "1 cell" if count == 1 else f"{count} cells"


def make_table(found: Iterable[tuple[int, list[str]]], file: Path, delimiter: str = ",") -> Table:
    """A table from rows that are already split; rows whose cells are all empty are passed over.

    Empty cells behind the last column that has a name hold nothing and are passed over, too. Raises `InputError` if a
    row has another number of cells than the header, or there are no rows.

    Args:
        found: number of the row and its cells, the header first.
        delimiter: what parts the columns.
    """
    full = [(row, cells) for row, cells in found if any(cell.strip() for cell in cells)]
    if not full:
        raise InputError("the file is empty", file=file, remedy="Export it again")
    names = full[0][1]
    width = filled(names)
    # A column without a name that holds something is a mistake, which the header's check names.
    if any(len(names) >= len(cells) > width and filled(cells) > width for _, cells in full[1:]):
        width = len(names)
    header = _header(names[:width], file)
    if len(full) == 1:
        raise InputError("there is a header but no row of data", file=file, row=1, remedy="Export it again")
    for row, cells in full[1:]:
        if len(cells) < width or filled(cells) > width:
            few = len(cells) < width
            count = len(cells) if few else filled(cells)
            what = {",": "commas", ";": "semicolons", "\t": "tabs"}[delimiter]
            extra = f"{'Use decimal points and quote' if delimiter == ',' else 'Quote'} text that holds {what}"
            problem, where = f"{number_of_cells(count)} where the header has {width}", header[count] if few else None
            raise InputError(problem, file=file, row=row, column=where, remedy="Fill the cell" if few else extra)
    return Table(file, header, [cells[:width] for _, cells in full[1:]], [row for row, _ in full[1:]], delimiter)


_SEPARATOR = re.compile(r'"?sep=([,;\t])"?[,;\t]*(?:\r\n|\r|\n)', re.IGNORECASE)


def filled(cells: list[str]) -> int:
    """The number of cells up to the last one that holds something."""
    return next((i for i in range(len(cells), 0, -1) if cells[i - 1].strip()), 0)


def parse_table(text: str, file: Path) -> Table:
    """The whole of a table; rows that are wholly empty are passed over.

    Raises `InputError` if quotes do not close, a row has another number of cells than the header, or there are no rows.
    """
    row, told = 1, _SEPARATOR.match(text)
    if told is not None:  # a line by which a spreadsheet is told what parts the columns
        text, row = text[told.end() :], 2
    # Else the commonest of those that part columns, outside of quotes, in the header.
    header = re.sub('"[^"]*"', "", text.lstrip().partition("\n")[0].partition("\r")[0])
    delimiter = told[1] if told is not None else max(",;\t", key=header.count)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True, delimiter=delimiter)
    found: list[tuple[int, list[str]]] = []
    above = row
    try:
        for record in reader:
            found.append((row, record))
            row = reader.line_num + above
    except csv.Error as error:
        problem = f"quotes or cells are damaged ({error})"
        raise InputError(problem, file=file, row=row, remedy="Close every double quote") from None
    return make_table(found, file, delimiter)


def read_table(file: Path, limits: FileLimits = LIMITS) -> Table:
    """Read and split a table; see `decode` and `parse_table` for what is refused."""
    return parse_table(decode(read_bytes(file, limits), file), file)
