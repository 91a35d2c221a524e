"""Reading a text table as a mapping file describes it."""

from __future__ import annotations

import csv
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from ..._errors import InputError
from .._columns import convert
from .._schema import Curve
from .._table import binary_kind, number_of_cells, parse_number
from .._validate import check_magnitudes
from ._mapping import DIMENSIONS, MappingFile
from ._text import Tests, checked_curve, cut_off, decode_lines


def read_mapped(data: bytes, file: Path, mapping: MappingFile) -> Tests:
    """The tests of a file that a mapping describes.

    Args:
        data: the file's bytes.
        file: its path, for names and messages.
        mapping: what `read_mapping` gave.

    Raises:
        InputError: if the file does not hold what the mapping says, or a cell is damaged.
    """
    kind = binary_kind(data)
    if kind is not None and not mapping.encoding.lower().replace("_", "-").startswith(("utf-16", "utf-32")):
        raise InputError(f"the file is {kind}", file=file, remedy="Unpack it, or name its encoding in the mapping file")
    lines = decode_lines(data, mapping.encoding, file)
    if lines and lines[0].startswith("\ufeff"):
        lines[0] = lines[0][1:]
    head = mapping.skip_rows
    body = head + mapping.header_rows
    header = _split(lines[head], mapping, file, head) if mapping.header_rows and head < len(lines) else None
    where = {name: _index(column.column, header, file, head + 1) for name, column in mapping.columns.items()}
    width = len(header) if header is not None else None
    samples: dict[str, list[tuple[int, list[str]]]] = {}
    block, parted = 1, True
    for i in range(body, len(lines)):
        line = lines[i]
        if not line.strip() or (mapping.delimiter != " " and not line.strip(mapping.delimiter + " ")):
            parted = True
            continue
        if mapping.comment_prefix is not None and line.lstrip().startswith(mapping.comment_prefix):
            continue
        cells = _split(line, mapping, file, i)
        width = len(cells) if width is None else width
        if len(cells) != width or max(where.values()) >= width:
            expected = max(width, max(where.values()) + 1)
            raise cut_off(f"{number_of_cells(len(cells))} where {expected} are expected", file, i + 1)
        if mapping.tests == "blank line":
            block += parted and bool(samples)
            name = str(block)
        elif mapping.tests == "column":
            name = cells[where["test"]].strip()
            if not name:
                raise cut_off("the test's name is empty", file, i + 1)
        else:
            name = mapping.test_name or file.stem
        parted = False
        samples.setdefault(name, []).append((i + 1, cells))
    if not samples:
        raise InputError(
            "there are no rows of data", file=file, remedy=f"Check skip_rows and header_rows in {mapping.file.name}"
        )
    curves = {name: _curve(name, rows, where, mapping, file) for name, rows in samples.items()}
    other = {"mapping_provenance": mapping.provenance} if mapping.provenance else {}
    return Tests(curves, f"mapped by {mapping.file.name}", mapping.control, other)


def _split(line: str, mapping: MappingFile, file: Path, i: int) -> list[str]:
    if mapping.delimiter == " ":
        return line.split()
    try:
        return next(csv.reader([line], delimiter=mapping.delimiter, strict=True))
    except (csv.Error, StopIteration) as error:
        raise cut_off(f"quotes are damaged ({error})", file, i + 1) from None


def _index(column: str | int, header: list[str] | None, file: Path, row: int) -> int:
    if isinstance(column, int):
        if header is not None and column > len(header):
            raise InputError(
                f"there is no column {column}, only {len(header)}", file=file, row=row, remedy="Count again"
            )
        return column - 1
    names = [name.strip() for name in header or []]
    found = [i for i, name in enumerate(names) if name == column]
    if len(found) == 1:
        return found[0]
    problem = f"there are {len(found)} columns called {column!r}" if found else f"there is no column {column!r}"
    close = get_close_matches(column, names, n=1)
    remedy = (
        "Give its number" if found else f"Did you mean {close[0]!r}?" if close else f"There are: {', '.join(names)}"
    )
    raise InputError(problem, file=file, row=row, remedy=remedy)


def _curve(
    name: str, rows: list[tuple[int, list[str]]], where: dict[str, int], mapping: MappingFile, file: Path
) -> Curve:
    columns: dict[str, np.ndarray] = {}
    for quantity in DIMENSIONS:
        column = mapping.columns[quantity]
        raw = np.empty(len(rows))
        for k, (row, cells) in enumerate(rows):
            try:
                raw[k] = parse_number(cells[where[quantity]], mapping.decimal_mark)
            except ValueError as error:
                remedy = f"Mend the cell, or decimal_mark and unit in {mapping.file.name}"
                raise InputError(str(error), file=file, row=row, column=str(column.column), remedy=remedy) from None
        columns[quantity] = column.sign * convert(raw, column.factor)
        check_magnitudes(columns[quantity], file, [row for row, _ in rows], str(column.column))
    time = columns["time"]
    back = np.flatnonzero(np.diff(time) < 0)
    # Rows of one test need not follow each other, so the row of the first sample is no guide.
    first = rows[int(back[0]) + 1][0] - int(back[0]) - 1 if len(back) else rows[0][0]
    return checked_curve(time, columns["force"], columns["displacement"], file, first, name)
