"""A mapping file to begin with, for a table that no reader knows."""

from __future__ import annotations

import re
from collections.abc import Sequence

from .mapping import DELIMITERS
from .text import decode_lines

LINES = 500
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
    lines = decode_lines(data)[:LINES]
    rows = {
        name: [i for i, line in enumerate(lines) if _all_numbers(_cells(line, mark))]
        for name, mark in DELIMITERS.items()
    }
    name = max(rows, key=lambda name: len(rows[name]))
    if not rows[name]:
        return EXAMPLE
    first, mark = rows[name][0], DELIMITERS[name]
    samples = [_cells(lines[i], mark) for i in rows[name]]
    keys = [f'delimiter = "{name}"']
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError:
        keys.insert(0, 'encoding = "cp1252"')
    if name != "comma":
        comma = any("," in cell for row in samples for cell in row)
        keys.append(f'decimal_mark = "{"," if comma else "."}"')
    header = _header(lines[:first], mark, len(samples[0]))
    if not header:
        return f"{_HOW} {'; '.join(keys)}; header_rows = 0; [columns] {_COLUMNS.format(1, 2, 3)}"
    names = _cells(lines[header[0]], mark)
    if header[0] > 0:
        keys.append(f'begin = "{names[0]}"')
    if len(header) > 1:
        keys.append("header_rows = 2")
    listed = ", ".join(f'"{one}"' for one in names)
    return f"{_HOW} {'; '.join(keys)}; [columns] {_COLUMNS.format(*['"..."'] * 3)}; its columns are {listed}"


def _cells(line: str, mark: str) -> list[str]:
    """The cells of a line, without quotes and blanks around them; empty ones behind the last are none."""
    cells = [cell.strip().strip('"').strip() for cell in line.split(None if mark == " " else mark)]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _all_numbers(cells: Sequence[str]) -> bool:
    return len(cells) > 1 and all(_NUMBER.fullmatch(cell) for cell in cells)


def _header(above: Sequence[str], mark: str, count: int) -> list[int]:
    """The rows of names, and of units below them, in front of the samples; none if there are none."""
    found: list[int] = []
    for i in range(len(above) - 1, max(len(above) - 3, -1), -1):
        cells = _cells(above[i], mark)
        if len(cells) != count or not all(cells):
            break
        found.insert(0, i)
    return found
