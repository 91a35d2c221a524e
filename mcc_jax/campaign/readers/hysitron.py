"""The two exports of Hysitron indenters, one test in each file, named by the file. Nothing in them is corrected.

`.hld`: a header of `Key: value unit` lines, then blocks of approach, drift and test data. Load-control text: a date,
`Number of Points = N`, column names, segments separated by empty lines; the approach is part of the curve. What is not
the curve is kept in `Metadata.other`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ..schema import Control
from .text import Tests, checked_curve, cut_off, number_block

_BLOCK = re.compile(r"(Sample Approach|Drift Measurement|Test) Data Points: *(\d{1,9})\s*")
_FORCES = ("Force_µN", "Force_uN", "Force_μN")
_COUNT = re.compile(r"Number of Points *= *(\d{1,9})\s*")
_NUMBER = r"([-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?)"
_COMPLIANCE, _DRIFT = re.compile(f"{_NUMBER}.*nm/[µuμ]N"), re.compile(f"{_NUMBER}.*nm/s")
_TIME, _DEPTH, _LOAD = "Time (s)", "Depth (nm)", "Load (µN)"


def is_hld(lines: list[str]) -> bool:
    """Whether this is a Hysitron `.hld`."""
    return lines[0].startswith("File Version: Hysitron") or any(line.startswith("Test Data Points:") for line in lines)


def read_hld(lines: list[str], file: Path) -> Tests:
    """The test of a `.hld`. Raises `InputError` if a block is missing, cut off or damaged."""
    blocks: dict[str, dict[str, np.ndarray]] = {}
    places: dict[str, range] = {}
    header: list[tuple[str, str]] = []
    i = 0
    while i < len(lines):
        match = _BLOCK.fullmatch(lines[i])
        if match is None:
            key, colon, value = lines[i].partition(":")
            if colon:
                header.append((key.strip(), value.strip()))
            elif lines[i].strip():
                raise cut_off("neither 'Key: value' nor a block of data", file, i + 1)
            i += 1
            continue
        count, names = int(match[2]), lines[i + 1].rstrip().split("\t") if i + 1 < len(lines) else []
        stop = i + 2 + count
        if stop > len(lines) or (count and not lines[stop - 1].strip()):
            raise cut_off(f"{match[1]} announces {count} rows, the file ends before", file, i + 1)
        if match[1] in blocks:
            raise cut_off(f"the block '{match[1]} Data Points' appears twice", file, i + 1)
        places[match[1]] = range(i + 2, stop)
        blocks[match[1]] = number_block(lines, places[match[1]], names, file)
        i = stop
    if "Test" not in blocks:
        raise cut_off("the block 'Test Data Points' is missing", file)
    test, at = blocks.pop("Test"), places["Test"]
    force_name = next((name for name in _FORCES if name in test), _FORCES[0])
    for name in ("Time_s", "Disp_nm", force_name):
        if name not in test:
            problem = f"the test block has no column {name!r}; it has {', '.join(test)}"
            raise cut_off(problem, file, at[0] if at else None)
    time, force, depth = (test.pop(name) for name in ("Time_s", force_name, "Disp_nm"))
    curve = checked_curve(time, force / 1e3, depth / 1e3, file, at, file.stem)
    names = {"Sample Approach": "approach_block", "Drift Measurement": "drift_block"}
    other = _facts(header) | {names[block]: _lists(columns) for block, columns in blocks.items()}
    other["test_block_further_columns"] = _lists(test)
    mode = dict(header).get("FB Mode", "").lower()
    control: Control | None = "load" if "load" in mode else "displacement" if "disp" in mode else None
    return Tests({file.stem: curve}, "Hysitron hld", control, other)


def _lists(columns: dict[str, np.ndarray]) -> dict[str, list[float]]:
    return {name: values.tolist() for name, values in columns.items()}


def _facts(header: list[tuple[str, str]]) -> dict[str, Any]:
    """What the header says: compliance, drift rate, segments, and all other lines as they are."""
    plain: dict[str, str] = {}
    segments: list[dict[str, str]] = []
    for key, value in header:
        if not key.startswith("Segment "):
            plain[key] = value
            continue
        # Each programmed segment begins with its duration.
        if key == "Segment Time" or not segments:
            segments.append({})
        segments[-1][key.removeprefix("Segment ")] = value
    other: dict[str, Any] = {}
    if compliance := _COMPLIANCE.fullmatch(plain.get("Machine Comp", "")):
        other["machine_compliance_um_per_mN"] = float(compliance[1])  # nm/uN is um/mN
    if drift := _DRIFT.fullmatch(plain.get("Drift Rate", "")):
        other["drift_rate_um_per_s"] = float(drift[1]) / 1e3
    return other | {"programmed_segments": segments, "instrument_header": plain}


def is_text(lines: list[str]) -> bool:
    """Whether this is load-control text."""
    head = lines[:20]
    return any(_COUNT.fullmatch(line) for line in head) and any(line.startswith(_DEPTH) for line in head)


def read_text(lines: list[str], file: Path) -> Tests:
    """The test of load-control text. Raises `InputError` if samples or columns are missing or damaged."""
    head = next(i for i, line in enumerate(lines) if line.startswith(_DEPTH))
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
    other = {"date": lines[0].strip(), "block_lengths": lengths, "further_columns": _lists(columns)}
    return Tests({file.stem: curve}, "Hysitron load-control text", "load", other)
