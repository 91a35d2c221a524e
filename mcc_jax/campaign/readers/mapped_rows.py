"""The rows of a mapped file, whether it is a table of text or a sheet of a workbook."""

from __future__ import annotations

import csv
from pathlib import Path

from ..._errors import InputError
from ..table import binary_kind, same_text
from ..workbook import is_workbook, read_sheet
from .mapping import MappingFile
from .text import decode_lines


class Rows:
    """Lines of text, split when they are asked for."""

    def __init__(self, lines: list[str], file: Path, mapping: MappingFile) -> None:
        self.lines, self.file, self.delimiter, self.mapping = lines, file, mapping.delimiter, mapping.file.name
        self.nothing = '" \t' if mapping.delimiter == " " else mapping.delimiter + '" \t'

    def __len__(self) -> int:
        return len(self.lines)

    def blank(self, i: int) -> bool:
        """Whether a row holds nothing but delimiters."""
        return not self.lines[i].strip(self.nothing)

    def begins(self, i: int, text: str) -> bool:
        """Whether a row, or the first thing that it holds, begins with a text."""
        line, text = same_text(self.lines[i].lstrip()), same_text(text)
        return line.startswith(text) or line.lstrip(self.nothing).startswith(text)

    def cells(self, i: int) -> list[str]:
        """The cells of a row."""
        line = self.lines[i]
        if self.delimiter == " ":
            return line.split()
        if '"' not in line:
            return line.split(self.delimiter)
        try:
            return next(csv.reader([line], delimiter=self.delimiter, strict=True))
        except (csv.Error, StopIteration) as error:
            raise InputError(
                f"quotes are damaged ({error})",
                file=self.file,
                row=i + 1,
                remedy=f"Close every double quote, or correct delimiter in {self.mapping}",
            ) from None


class Sheet(Rows):
    """Rows of a workbook's sheet, as they are."""

    def __init__(self, rows: list[list[str]], file: Path, mapping: MappingFile) -> None:
        super().__init__([], file, mapping)
        self.rows = rows

    def __len__(self) -> int:
        return len(self.rows)

    def blank(self, i: int) -> bool:
        """Whether a row holds nothing."""
        return not any(cell.strip() for cell in self.rows[i])

    def begins(self, i: int, text: str) -> bool:
        """Whether the first thing that a row holds begins with a text."""
        first = next((cell for cell in self.rows[i] if cell.strip()), "")
        return same_text(first.lstrip()).startswith(same_text(text))

    def cells(self, i: int) -> list[str]:
        """The cells of a row."""
        return self.rows[i]


def read_rows(data: bytes, file: Path, mapping: MappingFile) -> Rows:
    """The rows of a file, a table of text or a sheet of a workbook. Raises `InputError` if it is neither."""
    if is_workbook(data):
        how = f'Write sheet = "..." in {mapping.file.name}'
        rows = read_sheet(data, file, mapping.sheet, decimal_mark=mapping.decimal_mark, how=how)
        return Sheet([cells for _, cells in rows], file, mapping)
    if mapping.sheet is not None:
        raise InputError(
            f"is no Excel workbook (xlsx), though {mapping.file.name} names a sheet",
            file=file,
            remedy="Remove the key sheet, or save the file as xlsx",
        )
    kind = binary_kind(data)
    if kind is not None and not mapping.encoding.lower().replace("_", "-").startswith(("utf-16", "utf-32")):
        raise InputError(
            f"the file is {kind}", file=file, remedy="Unpack it, save it as xlsx or text, or name its encoding"
        )
    lines = decode_lines(data, mapping.encoding, file)
    if lines and lines[0].startswith("\ufeff"):
        lines[0] = lines[0][1:]
    return Rows(lines, file, mapping)
