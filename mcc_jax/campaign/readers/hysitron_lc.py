"""Hysitron load-control text export: a date, `Number of Points = N`, column names, segments separated by empty lines.

The approach is part of the curve, as in the file. The columns in volts and the lengths of the segments are kept
in `Metadata.other`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .text import Tests, checked_curve, cut_off, number_block

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
    at = [i for i in range(head + 1, len(lines)) if lines[i].strip()]
    if len(at) != announced:
        raise cut_off(f"{announced} points are announced, the file holds {len(at)}", file, count_row)
    columns = number_block(lines, at, names, file)
    time, depth, load = (columns.pop(name) for name in (_TIME, _DEPTH, _LOAD))
    curve = checked_curve(time, load / 1e3, depth / 1e3, file, at, file.stem)
    lengths = [len(part) for part in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(part)]
    further = {name: values.tolist() for name, values in columns.items()}
    other = {"date": lines[0].strip(), "block_lengths": lengths, "further_columns": further}
    return Tests({file.stem: curve}, "Hysitron load-control text", "load", other)
