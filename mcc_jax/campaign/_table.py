"""Text tables with commas: reading them strictly, and saying where they are wrong as an editor counts rows."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._errors import InputError
from ..files import LIMITS, FileLimits, read_table_bytes
from ._columns import LARGEST_MAGNITUDE

CONVERT = "mcc-jax convert with a mapping file"
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

    Raises:
        InputError: if it cannot be read, is empty or too large; see `mcc_jax.files`.
    """
    data = read_table_bytes(file, limits)
    if not data.strip(b" \t\r\n\xef\xbb\xbf"):
        raise InputError("the file is empty", file=file, remedy="Export it again")
    return data


def decode(data: bytes, file: Path, wanted: str = "plain CSV text in UTF-8") -> str:
    """UTF-8 text, without a byte order mark.

    Raises:
        InputError: if it is compressed, binary or in another encoding.
    """
    kind = binary_kind(data)
    if kind is not None:
        raise InputError(f"the file is {kind}, not text", file=file, remedy=f"Save it as {wanted}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # The decoder may count from behind the byte order mark; the bytes it saw are in the exception.
        before = bytes(error.object[: error.start])
        row = 1 + before.count(b"\n") + before.replace(b"\r\n", b"").count(b"\r")
        raise InputError(
            f"the byte 0x{error.object[error.start]:02x} is not UTF-8", file=file, row=row, remedy="Save it as UTF-8"
        ) from None


@dataclass(frozen=True)
class Table:
    """A table as text: names of columns, records, and the row at which each record starts."""

    file: Path
    header: tuple[str, ...]
    records: list[list[str]]
    rows: list[int]

    def text(self, column: int) -> list[str]:
        """The cells of a column, as they stand."""
        return [record[column] for record in self.records]

    def numbers(self, column: int) -> np.ndarray:
        """The cells of a column as finite numbers.

        Raises:
            InputError: at the first cell that is none.
        """
        values = np.empty(len(self.records))
        for i, record in enumerate(self.records):
            try:
                values[i] = parse_number(record[column])
            except ValueError as error:
                remedy = "Write a number with a decimal point, or remove the row"
                raise InputError(
                    str(error), file=self.file, row=self.rows[i], column=self.header[column], remedy=remedy
                ) from None
        return values


def parse_number(cell: str, decimal_mark: str = ".") -> float:
    """A cell's number.

    Raises:
        ValueError: if the cell is empty, text, not finite, or too large; the text says which.
    """
    stripped = cell.strip()
    if not stripped:
        raise ValueError("the cell is empty")
    plain = stripped if decimal_mark == "." else stripped.replace(decimal_mark, ".")
    shown = stripped if len(stripped) <= 40 else stripped[:40] + "..."
    try:
        # Python also reads 1_000 and digits of other scripts; in a data file both are mistakes.
        number = float(plain) if plain.isascii() and "_" not in plain else None
    except ValueError:
        number = None
    if number is None or (decimal_mark != "." and "." in stripped):
        hint = " (a decimal comma?)" if decimal_mark == "." and stripped.count(",") == 1 else ""
        raise ValueError(f"{shown!r} is not a number{hint}")
    if math.isnan(number) or (math.isinf(number) and "n" in plain.lower()):
        raise ValueError(f"{shown!r} is not a finite number")
    if abs(number) > LARGEST_MAGNITUDE * 1e12:
        raise ValueError(f"{shown!r} is too large to be a measurement")
    return number


def parse_header(cells: list[str], file: Path) -> tuple[str, ...]:
    """Names of the columns, without blanks around them.

    Raises:
        InputError: if the delimiter is not a comma, a name is empty or stands there twice.
    """
    if len(cells) == 1:
        for mark, name in ((";", "';'"), ("\t", "tabs"), ("|", "'|'")):
            if mark in cells[0]:
                raise InputError(
                    f"the columns are separated by {name}, not by commas",
                    file=file,
                    row=1,
                    remedy=f"Use commas and decimal points, or run {CONVERT}",
                )
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


def ragged(count: int, header: tuple[str, ...], file: Path, row: int) -> InputError:
    """The error for a row with too many or too few cells."""
    few = count < len(header)
    where = header[count] if few else None
    hint = "Fill the cell" if few else f"Use decimal points and quote text that holds commas, or run {CONVERT}"
    problem = f"{number_of_cells(count)} where the header has {len(header)}"
    return InputError(problem, file=file, row=row, column=where, remedy=hint)


def parse_table(text: str, file: Path) -> Table:
    """The whole of a comma-separated table; rows that are wholly empty are passed over.

    Raises:
        InputError: if quotes do not close, a row has another number of cells than the header, or there are no rows.
    """
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    header: tuple[str, ...] | None = None
    records: list[list[str]] = []
    rows: list[int] = []
    row = 1
    try:
        for record in reader:
            if record:
                if header is None:
                    header = parse_header(record, file)
                elif len(record) != len(header):
                    raise ragged(len(record), header, file, row)
                else:
                    records.append(record)
                    rows.append(row)
            row = reader.line_num + 1
    except csv.Error as error:
        raise InputError(
            f"quotes or cells are damaged ({error})", file=file, row=row, remedy="Close every double quote"
        ) from None
    if header is None:
        raise InputError("the file is empty", file=file, remedy="Export it again")
    if not records:
        raise InputError("there is a header but no row of data", file=file, row=1, remedy="Export it again")
    return Table(file, header, records, rows)


def read_table(file: Path, limits: FileLimits = LIMITS) -> Table:
    """Read and split a table; see `decode` and `parse_table` for what is refused."""
    return parse_table(decode(read_bytes(file, limits), file), file)
