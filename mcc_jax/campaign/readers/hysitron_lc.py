"""Hysitron load-control text export: a date, `Number of Points = N`, column names, segments parted by empty lines.

The approach is part of the curve, as in the file. The columns in volts and the lengths of the segments are kept
in `Metadata.other`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .text import Tests, checked_curve, cut_off, number_block, refuse_twice

_COUNT = re.compile(r"Number of Points *= *(\d{1,9})\s*")
_TIME, _DEPTH, _LOAD = "Time (s)", "Depth (nm)", "Load (µN)"


def _normal(name: str) -> str:
    return name.replace("μ", "µ").replace("uN", "µN").strip()


def matches(lines: list[str]) -> bool:
    """Whether this is such an export."""
    return any(_COUNT.fullmatch(line) for line in lines[:20]) and any(
        line.startswith("Depth (nm)") for line in lines[:20]
    )


def read(lines: list[str], file: Path) -> Tests:
    """The one test of the file, named by the file. Raises `InputError` if samples or columns are missing or damaged."""
    head = next(i for i, line in enumerate(lines) if line.startswith("Depth (nm)"))
    count_row, announced = next((i + 1, int(m[1])) for i, line in enumerate(lines) if (m := _COUNT.fullmatch(line)))
    names = [_normal(name) for name in lines[head].split("\t")]
    for name in (_TIME, _DEPTH, _LOAD):
        if name not in names:
            raise cut_off(f"the column {name!r} is missing", file, head + 1)
    refuse_twice(names, file, head + 1)
    rows = [i for i in range(head + 1, len(lines)) if lines[i].strip()]
    if len(rows) != announced:
        raise cut_off(f"{announced} points are announced, the file holds {len(rows)}", file, count_row)
    columns: dict[str, list[float]] = {name: [] for name in names}
    lengths: list[int] = []
    i = head + 1
    while i < len(lines):
        stop = next((j for j in range(i, len(lines)) if not lines[j].strip()), len(lines))
        if stop > i:
            block = number_block(lines, i, stop, names, file)
            lengths.append(len(block))
            for name, values in zip(names, block.T, strict=True):
                columns[name].extend(values.tolist())
        i = stop + 1
    return _tests(columns, lengths, rows, lines[0].strip(), file)


def _tests(columns: dict[str, list[float]], lengths: list[int], rows: list[int], date: str, file: Path) -> Tests:
    time, depth, load = (np.array(columns.pop(name)) for name in (_TIME, _DEPTH, _LOAD))
    back = np.flatnonzero(np.diff(time) < 0)
    first_row = rows[int(back[0]) + 1] - int(back[0]) if len(back) else rows[0] + 1 if rows else 1
    curve = checked_curve(time, load / 1e3, depth / 1e3, file, first_row, file.stem)
    other = {"date": date, "block_lengths": lengths, "further_columns": columns}
    return Tests({file.stem: curve}, "Hysitron load-control text", "load", other)
