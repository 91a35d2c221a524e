"""What readers share: decoding, rows of texts and workbooks, and blocks of numbers checked cell by cell."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..._errors import InputError
from ..schema import Control, Curve
from ..table import NotANumber, binary_kind, number_of_cells, numbers, same_text, split
from ..workbook import is_workbook, read_sheet
from .mapping import MappingFile

_NUMBER = re.compile(r"[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?")


@dataclass(frozen=True)
class Tests:
    """What a reader finds in a file: named curves, and what the file says about them.

    Attributes:
        curves: the tests by their names.
        format: what kind of file it is, in words.
        control: the controlled quantity, where the file or a mapping says so.
        other: what else the file says, kept as it is.
        diameters_um: D1, D2, D3 [um] of tests whose file should hold them, or why it does not.
        missing: how many rows with a missing reading were dropped, by test.
    """

    curves: dict[str, Curve]
    format: str
    control: Control | None = None
    other: dict[str, Any] = field(default_factory=dict)
    diameters_um: dict[str, list[float] | InputError] = field(default_factory=dict)
    missing: dict[str, int] = field(default_factory=dict)


def decode_lines(data: bytes, encoding: str | None = None, file: Path | None = None) -> list[str]:
    """The lines of an instrument file; by default UTF-8 or, as most instruments write, Latin-1.

    Raises `InputError` if the file is not in the encoding given.
    """
    if encoding is None:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    else:
        try:
            text = data.decode(encoding)
        except (UnicodeDecodeError, LookupError, ValueError) as error:
            problem = f"cannot be decoded as {encoding!r}: {error}"
            remedy = 'Name the file\'s encoding in the mapping file: encoding = "cp1252" for Windows in western Europe'
            raise InputError(problem, file=file, remedy=remedy) from None
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def number_block(
    lines: Sequence[str], at: Sequence[int], names: Sequence[str], file: Path, decimal_mark: str = "."
) -> dict[str, np.ndarray]:
    """The columns, by name, of tab-separated numbers in the lines at some indices, each of shape (rows,).

    Raises `InputError` if two columns have one name, or a row or cell is damaged.
    """
    name, count = Counter(names).most_common(1)[0] if names else ("", 0)
    if count > 1:
        problem, remedy = f"column appears {count} times", "Export the file again"
        raise InputError(problem, file=file, row=at[0] if at else None, column=name, remedy=remedy)
    rows = [lines[i].rstrip("\t ").split("\t") for i in at]
    for i, cells in zip(at, rows, strict=True):
        if len(cells) != len(names):
            problem = f"{number_of_cells(len(cells))} where {len(names)} are expected ({', '.join(names)})"
            raise cut_off(problem, file, i + 1)
    columns = zip(*rows, strict=True) if rows else [()] * len(names)
    block: dict[str, np.ndarray] = {}
    for name, cells in zip(names, columns, strict=True):
        try:
            block[name] = numbers(cells, decimal_mark)
        except NotANumber as error:
            row, remedy = at[error.index] + 1, "Export the file again"
            raise InputError(str(error), file=file, row=row, column=name, remedy=remedy) from None
    return block


def checked_curve(
    time: np.ndarray, force: np.ndarray, displacement: np.ndarray, file: Path, at: Sequence[int], name: str
) -> Curve:
    """A curve whose time never goes back and that has at least two samples, in the lines at these indices."""
    if len(time) < 2:
        problem = f"the test {name!r} has fewer than two samples"
        raise InputError(problem, file=file, row=at[0] + 1 if at else 1, remedy="Export the file again")
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        problem, row = f"the time of test {name!r} goes back", at[int(back[0]) + 1] + 1
        raise InputError(problem, file=file, row=row, remedy="Each test needs a file or a name of its own")
    return Curve(time, force, displacement)


def cut_off(problem: str, file: Path, row: int | None = None) -> InputError:
    """The error for a file that ends too early or lacks a part."""
    return InputError(problem, file=file, row=row, remedy="The file is cut off or damaged; export it again")


def leading_number(text: str) -> float | None:
    """The number a text such as `0.0066 nm/uN` begins with."""
    match = _NUMBER.match(text.strip())
    return float(match[0]) if match else None


class Rows:
    """Rows of a table, lines of text or the cells of a workbook's sheet; text is split when it is asked for."""

    def __init__(self, rows: Sequence[str] | Sequence[list[str]], file: Path, mapping: MappingFile) -> None:
        self.rows, self.file, self.delimiter, self.mapping = rows, file, mapping.delimiter, mapping.file.name
        self.nothing = '" \t' if mapping.delimiter == " " else mapping.delimiter + '" \t'

    def __len__(self) -> int:
        return len(self.rows)

    def line(self, i: int) -> str:
        """A row as one text."""
        row = self.rows[i]
        return row if isinstance(row, str) else "\t".join(row)

    def blank(self, i: int) -> bool:
        """Whether a row holds nothing but delimiters."""
        return not self.line(i).strip(self.nothing)

    def begins(self, i: int, text: str) -> bool:
        """Whether a row, or the first thing that it holds, begins with a text."""
        line, text = same_text(self.line(i).lstrip()), same_text(text)
        return line.startswith(text) or line.lstrip(self.nothing).startswith(text)

    def cells(self, i: int) -> list[str]:
        """The cells of a row."""
        row = self.rows[i]
        if not isinstance(row, str):
            return row
        if self.delimiter == " ":
            return row.split()
        if '"' not in row:
            return row.split(self.delimiter)
        try:
            return next(split(row, self.file, self.delimiter))[1][0]
        except InputError as error:
            remedy = f"Close every double quote, or correct delimiter in {self.mapping}"
            raise error.changed(row=i + 1, remedy=remedy) from None


def read_rows(data: bytes, file: Path, mapping: MappingFile) -> Rows:
    """The rows of a file, a table of text or a sheet of a workbook. Raises `InputError` if it is neither."""
    if is_workbook(data):
        how = f'Write sheet = "..." in {mapping.file.name}'
        rows = read_sheet(data, file, mapping.sheet, decimal_mark=mapping.decimal_mark, how=how)
        return Rows(rows[1], file, mapping)
    if mapping.sheet is not None:
        problem = f"is no Excel workbook (xlsx), though {mapping.file.name} names a sheet"
        raise InputError(problem, file=file, remedy="Remove the key sheet, or save the file as xlsx")
    kind = binary_kind(data)
    if kind is not None and not mapping.encoding.lower().replace("_", "-").startswith(("utf-16", "utf-32")):
        remedy = "Unpack it, save it as xlsx or text, or name its encoding"
        raise InputError(f"the file is {kind}", file=file, remedy=remedy)
    first, *others = decode_lines(data, mapping.encoding, file)
    return Rows([first.removeprefix("\ufeff"), *others], file, mapping)
