"""Text tables: the one tokeniser, the one number parser, and errors that name the row as an editor counts it.

Columns are separated by commas or, as spreadsheets of many countries write, by semicolons or tabs. Numbers may have a
decimal comma, between quotes where commas separate the columns, as long as it cannot be a thousands separator. A
delimiter after the last cell of a row, and rows of delimiters only, hold nothing.
"""

from __future__ import annotations

import csv
import io
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain, islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from .._errors import InputError
from ..files import TABLE_BYTES, read_regular
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


def read_bytes(file: Path) -> bytes:
    """The bytes of a table or an instrument's export.

    Raises `InputError` if it cannot be read, is empty or too large; see `mcc_jax.files`.
    """
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
    """A name in the one form (Unicode NFC) in which names are compared: an accent may be a character of its own."""
    return unicodedata.normalize("NFC", text)


@dataclass(frozen=True)
class Table:
    """A table: names and cells of the columns, the row of the file at which each record starts, and the delimiter.

    Cells are text; columns that were asked for as numbers, and can be nothing else, are numbers already.
    """

    file: Path
    header: tuple[str, ...]
    columns: Sequence[Sequence[str] | np.ndarray]
    rows: Sequence[int]
    delimiter: str = ","

    def text(self, column: int) -> Sequence[str]:
        """The cells of a column, as they are."""
        cells = self.columns[column]
        assert not isinstance(cells, np.ndarray)
        return cells

    def decimal_mark(self, columns: Sequence[int]) -> str:
        """The decimal mark of some columns: a comma if one appears in them and is no thousands separator.

        Spreadsheets separate columns by semicolons where the comma is the decimal mark, so there it always is. With
        tabs, or commas and quotes, 1,500 is either: then a comma counts if no point appears in the columns and some
        cell, such as 1,5, has other than three digits behind it.
        """
        texts = ["\n".join(self.text(i)) for i in columns]
        if not any("," in text for text in texts):
            return "."
        if self.delimiter == ";":
            return ","
        commas = (cell.strip() for i in columns for cell in self.text(i) if "," in cell)
        either = any("." in text for text in texts) or all(_one_group(",").fullmatch(cell) for cell in commas)
        return "." if either else ","

    def refuse_groups(self, columns: Sequence[int]) -> None:
        """Refuse numbers whose decimal mark looks like a thousands separator; columns of a unit are judged together."""
        mark = self.decimal_mark(columns)
        units: dict[str, list[int]] = {}
        for column in columns:
            units.setdefault(self.header[column].rpartition("_")[2], []).append(column)
        for alike in units.values():
            cells = (pair for column in alike for pair in enumerate(self.text(column)))
            if (found := thousands_for_decimals(cells, mark)) is not None:
                k, problem = found
                column = next(c for c in alike if mark in self.text(c)[k])
                remedy = "Write numbers without marks between the thousands, or all with as many decimals"
                raise InputError(problem, file=self.file, row=self.rows[k], column=self.header[column], remedy=remedy)

    def numbers(self, columns: Sequence[int]) -> list[np.ndarray]:
        """The cells of some columns as finite numbers, all with one decimal mark; the first that is none is named."""
        found = [self.columns[i] for i in columns]
        if all(isinstance(each, np.ndarray) for each in found):
            return found  # type: ignore[return-value]
        mark = self.decimal_mark(columns)
        return [_column(self.text(i), mark, self.file, self.rows, self.header[i]) for i in columns]


def _column(cells: Sequence[str], mark: str, file: Path, rows: Sequence[int], name: str) -> np.ndarray:
    try:
        return numbers(cells, mark)
    except NotANumber as error:
        point = "a decimal point" if mark == "." else "a decimal comma, as in the other rows,"
        if thousands_mark(cells[error.index], mark):
            point += " and no mark between the thousands"
        remedy, row = f"Write a number with {point}, or remove the row", rows[error.index]
        raise InputError(str(error), file=file, row=row, column=name, remedy=remedy) from None


class NotANumber(ValueError):
    """A cell, `index` of its column, that holds no number."""

    def __init__(self, problem: str, index: int) -> None:
        super().__init__(problem)
        self.index = index


_AT_ONCE = 2**14
"""Cells parsed together: more would only need more memory."""
_PLAIN = msgspec.json.Decoder(list[float])


def numbers(cells: Sequence[str], decimal_mark: str = ".") -> np.ndarray:
    """The numbers of a column's cells, shape (n,), each rounded correctly.

    Raises `NotANumber` at the first cell that `parse_number` refuses.
    """
    found = np.empty(len(cells))
    for start in range(0, len(cells), _AT_ONCE):
        some = cells[start : start + _AT_ONCE]
        values = _plain_numbers(some, decimal_mark)
        for i, cell in enumerate(some if values is None else ()):
            try:
                found[start + i] = parse_number(cell, decimal_mark)
            except ValueError as error:
                raise NotANumber(str(error), start + i) from None
        if values is not None:
            found[start : start + len(some)] = values
    return found


def _plain_numbers(cells: Sequence[str], decimal_mark: str) -> np.ndarray | None:
    """The same by a parser of JSON, ten times as fast; None unless every cell is a number as JSON writes them."""
    text = "\n".join(cells)
    if decimal_mark != ".":
        if "." in text:
            return None
        text = text.replace(decimal_mark, ".")
    try:
        values = np.array(_PLAIN.decode(f"[{text.replace('\n', ',')}]"))
    except msgspec.MsgspecError:
        return None
    if len(values) != len(cells) or not (np.abs(values) <= _LARGEST_NUMBER).all():
        return None
    for i in np.flatnonzero(values == 0).tolist():  # JSON knows no negative zero without a decimal point
        values[i] = parse_number(cells[i], decimal_mark)
    return values


_LARGEST_NUMBER = LARGEST_MAGNITUDE * 1e12
"""In any unit."""


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
    if abs(number) > _LARGEST_NUMBER:
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
    return row, f"{cell!r} next to {whole!r} looks like a mark between thousands, not a decimal mark"


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
        raise InputError(f"column appears {count} times", file=file, row=1, column=name, remedy="Rename or delete one")
    return header


def number_of_cells(count: int) -> str:
    """The number of cells of a row, in words."""
    return "1 cell" if count == 1 else f"{count} cells"


Batch = tuple[Sequence[int], list[list[str]]]
"""Numbers of rows, and their cells."""
Numeric = Callable[[tuple[str, ...]], Sequence[int]]
"""Which columns of a header hold numbers."""


def make_table(batches: Iterator[Batch], file: Path, delimiter: str = ",", numeric: Numeric | None = None) -> Table:
    """A table from rows that are already split; rows whose cells are all empty are skipped.

    Empty cells behind the last column that has a name hold nothing and are dropped. Raises `InputError` if a row has
    another number of cells than the header, or there are no rows.

    Args:
        batches: numbers of rows and their cells, the header first.
        delimiter: what separates the columns.
        numeric: columns whose cells are numbers with a decimal point, to be parsed as they come.
    """
    full = (batch for batch in map(_without_empty, batches) if batch[0])
    first, body = next(full, ((), []))
    if not first:
        raise InputError("the file is empty", file=file, remedy="Export it again")
    names = body[0]
    header = _header(names[: filled(names)], file)
    wanted = numeric(header) if numeric else ()
    columns: list[list[Any]] = [[] for _ in header]
    rows: list[int] = []
    for places, records in chain([(first[1:], body[1:])], full):
        if {*map(len, records)} != {len(header)}:
            records = [_fit(cells, row, names, file, delimiter) for row, cells in zip(places, records, strict=True)]
        rows.extend(places)
        for i, cells in enumerate(zip(*records, strict=True)):
            columns[i].append(_column(cells, ".", file, places, header[i]) if i in wanted else cells)
    if not rows:
        raise InputError("there is a header but no row of data", file=file, row=1, remedy="Export it again")
    done = [np.concatenate(parts) if i in wanted else [*chain(*parts)] for i, parts in enumerate(columns)]
    return Table(file, header, done, rows, delimiter)


def _without_empty(batch: Batch) -> Batch:
    """The rows that hold something."""
    if all(cells and cells[0].strip() for cells in batch[1]):
        return batch
    full = [(row, cells) for row, cells in zip(*batch, strict=True) if filled(cells)]
    return [row for row, _ in full], [cells for _, cells in full]


def _fit(cells: list[str], row: int, names: list[str], file: Path, delimiter: str) -> list[str]:
    """The cells of a row below the names of the header; an error if there are more or fewer of them."""
    width, count = filled(names), filled(cells)
    if len(cells) >= width >= count:
        return cells[:width]
    if len(names) >= len(cells) > width:
        raise InputError(f"the name of column {width + 1} is empty", file=file, row=1, remedy="Name or delete it")
    what = {",": "commas", ";": "semicolons", "\t": "tabs"}[delimiter]
    column, remedy = None, f"{'Use decimal points and quote' if delimiter == ',' else 'Quote'} text that holds {what}"
    if len(cells) < width:
        count, column, remedy = len(cells), names[len(cells)].strip(), "Fill the cell"
    problem = f"{number_of_cells(count)} where the header has {width}"
    raise InputError(problem, file=file, row=row, column=column, remedy=remedy)


_SEPARATOR = re.compile(r'"?sep=([,;\t])"?[,;\t]*(?:\r\n|\r|\n)', re.IGNORECASE)


_FIRST_LINE = re.compile(r"\s*[^\r\n]*")


def filled(cells: list[str]) -> int:
    """The number of cells up to the last one that holds something."""
    return next((i for i in range(len(cells), 0, -1) if cells[i - 1].strip()), 0)


def split(text: str, file: Path, delimiter: str, first: int = 1) -> Iterator[Batch]:
    """The rows of a text, many at once: the number of the line at which each begins, and its cells.

    Quoted cells may hold delimiters and line breaks. Raises `InputError` where quotes do not close.

    Args:
        delimiter: what separates the columns.
        first: the number of the row at which the table begins; nothing above it is read.
    """
    lines = io.StringIO(text, newline="")
    for _ in range(1, first):
        lines.readline()
    reader = csv.reader(lines, strict=True, delimiter=delimiter)
    row = first
    # A quoted cell may go over several lines; then only the line at which the next row begins is known.
    at_once = 1 if '"' in text else _AT_ONCE
    try:
        while records := list(islice(reader, at_once)):
            yield range(row, row + len(records)), records
            row = first + reader.line_num
    except csv.Error as error:
        problem = f"quotes or cells are damaged ({error})"
        raise InputError(problem, file=file, row=row, remedy="Close every double quote") from None


def read_table(file: Path, numeric: Numeric | None = None) -> Table:
    """Read and split a table; see `read_bytes`, `decode` and `parse_table` for what is refused."""
    return parse_table(decode(read_bytes(file), file), file, numeric)


def parse_table(text: str, file: Path, numeric: Numeric | None = None) -> Table:
    """The whole of a table; rows that are wholly empty are skipped.

    Raises `InputError` if quotes do not close, a row has another number of cells than the header, or there are no rows.

    Args:
        numeric: columns that hold numbers; they are parsed at once where nothing but a point can be the decimal mark.
    """
    named = _SEPARATOR.match(text)  # a line by which a spreadsheet program learns the delimiter
    # Else the commonest of those that separate columns, outside of quotes, in the header.
    header = re.sub('"[^"]*"', "", _FIRST_LINE.match(text)[0])  # type: ignore[index]  # it matches every text
    delimiter = named[1] if named is not None else max(",;\t", key=header.count)
    if delimiter != "," or '"' in text:
        numeric = None
    return make_table(split(text, file, delimiter, 1 if named is None else 2), file, delimiter, numeric)
