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


def matches(lines: list[str]) -> bool:
    """Whether this is such an export."""
    return any(_COUNT.fullmatch(line) for line in lines[:20]) and any(
        line.startswith("Depth (nm)") for line in lines[:20]
    )


def read(lines: list[str], file: Path) -> Tests:
    """The one test of the file, named by the file. Raises `InputError` if samples or columns are missing or damaged."""
    head = next(i for i, line in enumerate(lines) if line.startswith("Depth (nm)"))
    count_row, announced = next((i + 1, int(m[1])) for i, line in enumerate(lines) if (m := _COUNT.fullmatch(line)))
    names = [name.replace("μ", "µ").replace("uN", "µN").strip() for name in lines[head].split("\t")]
    for name in (_TIME, _DEPTH, _LOAD):
        if name not in names:
            raise cut_off(f"the column {name!r} is missing", file, head + 1)
    refuse_twice(names, file, head + 1)
    rows = np.array([i for i in range(head + 1, len(lines)) if lines[i].strip()], int)
    if len(rows) != announced:
        raise cut_off(f"{announced} points are announced, the file holds {len(rows)}", file, count_row)
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    blocks = [number_block(lines, int(part[0]), int(part[-1]) + 1, names, file) for part in parts if len(part)]
    columns = dict(zip(names, np.concatenate([np.empty((0, len(names))), *blocks]).T, strict=True))
    time, depth, load = (columns.pop(name) for name in (_TIME, _DEPTH, _LOAD))
    back = np.flatnonzero(np.diff(time) < 0)
    first_row = rows[back[0] + 1] - back[0] if len(back) else rows[0] + 1 if len(rows) else 1
    curve = checked_curve(time, load / 1e3, depth / 1e3, file, int(first_row), file.stem)
    further = {name: values.tolist() for name, values in columns.items()}
    other = {"date": lines[0].strip(), "block_lengths": [len(block) for block in blocks], "further_columns": further}
    return Tests({file.stem: curve}, "Hysitron load-control text", "load", other)
