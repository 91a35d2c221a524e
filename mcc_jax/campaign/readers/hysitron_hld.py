"""Hysitron `.hld`: a header of `Key: value unit` lines, then blocks of approach, drift and test data.

The test block is the curve (`Time_s`, `Force_uN`, `Disp_nm`). Everything else is kept in `Metadata.other`: the
header as text, machine compliance and drift rate with their units in the key, the programmed segments, and the
approach and drift blocks and the test block's further columns as lists. Nothing is corrected for any of them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..schema import Control
from .text import Tests, checked_curve, cut_off, leading_number, number_block

_BLOCK = re.compile(r"(Sample Approach|Drift Measurement|Test) Data Points: *(\d{1,9})\s*")
_FORCES = ("Force_µN", "Force_uN", "Force_μN")


def matches(lines: list[str]) -> bool:
    """Whether this is a Hysitron `.hld`."""
    return lines[0].startswith("File Version: Hysitron") or any(line.startswith("Test Data Points:") for line in lines)


def read(lines: list[str], file: Path) -> Tests:
    """The one test of the file, named by the file. Raises `InputError` if a block is missing, cut off or damaged."""
    blocks: dict[str, dict[str, np.ndarray]] = {}
    at: Sequence[int] = ()
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
        blocks[match[1]] = number_block(lines, range(i + 2, stop), names, file)
        if match[1] == "Test":
            at = range(i + 2, stop)
        i = stop
    if "Test" not in blocks:
        raise cut_off("the block 'Test Data Points' is missing", file)
    test = blocks.pop("Test")
    force_name = next((name for name in _FORCES if name in test), "Force_µN")
    for name in ("Time_s", "Disp_nm", force_name):
        if name not in test:
            raise cut_off(
                f"the test block has no column {name!r}; it has {', '.join(test)}", file, at[0] if at else None
            )
    curve = checked_curve(
        test.pop("Time_s"), test.pop(force_name) / 1e3, test.pop("Disp_nm") / 1e3, file, at, file.stem
    )
    names = {"Sample Approach": "approach_block", "Drift Measurement": "drift_block"}
    other: dict[str, Any] = _facts(header)
    for block, columns in blocks.items():
        other[names[block]] = _lists(columns)
    other["test_block_further_columns"] = _lists(test)
    mode = dict(header).get("FB Mode", "").lower()
    control: Control | None = "load" if "load" in mode else "displacement" if "disp" in mode else None
    return Tests({file.stem: curve}, "Hysitron hld", control, other)


def _lists(columns: dict[str, np.ndarray]) -> dict[str, list[float]]:
    return {name: values.tolist() for name, values in columns.items()}


def _facts(header: list[tuple[str, str]]) -> dict[str, Any]:
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
    # nm/uN is um/mN.
    compliance = leading_number(plain.get("Machine Comp", ""))
    if compliance is not None and plain["Machine Comp"].endswith(("nm/µN", "nm/uN", "nm/μN")):
        other["machine_compliance_um_per_mN"] = compliance
    drift = leading_number(plain.get("Drift Rate", ""))
    if drift is not None and plain["Drift Rate"].endswith("nm/s"):
        other["drift_rate_um_per_s"] = drift / 1e3
    return other | {"programmed_segments": segments, "instrument_header": plain}
