"""Fischer HM export (FischerScope, `FS1.txt`): many tests in one Latin-1 file, tabs, decimal comma.

A header (parameters, statistics) is followed by one section per test: a line `Block : b   Value : v`, results, the
line `F<tab>h<tab>t`, then the samples. The header names no units; the instrument writes mN, um and s.
"""

from __future__ import annotations

import re
from pathlib import Path

from ..schema import Curve
from .text import Tests, checked_curve, cut_off, number_block

_TEST = re.compile(r"Block\s*:\s*(\d+)\s+Value\s*:\s*(\d+)")
_COUNT = re.compile(r"(\d{1,9})\tn\tStatistics of block")
# Greatest force [N], time at which it is reached [s], then hardness.
_PEAK = re.compile(r"HM\s+(\d+\.?\d*)/\s*(\d+\.?\d*)/")
_COLUMNS = "F\th\tt"


def matches(lines: list[str]) -> bool:
    """Whether this is a Fischer export."""
    return _COLUMNS in (line.strip() for line in lines) and any(_TEST.match(line) for line in lines)


def read(lines: list[str], file: Path) -> Tests:
    """All tests, named by their value number (`block-value` if there are several blocks); an error if one is cut off,
    damaged or missing."""
    found = {i: match.groups() for i, line in enumerate(lines) if (match := _TEST.match(line))}
    starts, labels = list(found), list(found.values())
    single = len({block for block, _ in labels}) == 1
    curves: dict[str, Curve] = {}
    results: dict[str, list[str]] = {}
    for start, stop, (block, value) in zip(starts, [*starts[1:], len(lines)], labels, strict=True):
        name = value if single else f"{block}-{value}"
        if name in curves:
            raise cut_off(f"the test {name!r} appears twice", file, start + 1)
        head = next((i for i in range(start, stop) if lines[i].strip() == _COLUMNS), None)
        if head is None:
            raise cut_off(f"the test {name!r} has no samples (the line F h t is missing)", file, start + 1)
        end = next((i for i in range(head + 1, stop) if not lines[i].strip() or ".hap" in lines[i]), stop)
        if start == starts[-1] and any(line.strip() for line in lines[end:stop]):
            raise cut_off("there is text behind the last test's samples", file, end + 1)
        at = range(head + 1, end)
        columns = number_block(lines, at, _COLUMNS.split("\t"), file, decimal_mark=",")
        curve = checked_curve(columns["t"], columns["F"], columns["h"], file, at, name)
        before = [line for line in lines[max(start - 3, 0) : start] if _PEAK.match(line)]
        peak = _PEAK.match(before[-1]) if before else None
        # A file cut in the middle of a test has not got its greatest force yet.
        if peak and (curve.time_s[-1] < float(peak[2]) - 1.0 or curve.force_mN.max() < 900 * float(peak[1])):
            raise cut_off(f"the test {name!r} ends before its greatest force of {peak[1]} N", file, end)
        curves[name] = curve
        results[name] = [line.strip() for line in lines[start + 1 : head] if line.strip()]
    counts = [int(match[1]) for line in lines[: starts[0]] if (match := _COUNT.match(line))]
    if counts and sum(counts) != len(curves):
        raise cut_off(f"the header announces {sum(counts)} tests, the file holds {len(curves)}", file)
    parameters = [line.strip() for line in lines[: starts[0]] if re.match(r"[FCR] = ", line)]
    other = {"test_parameters": parameters, "instrument_results": results}
    return Tests(curves, "Fischer HM export", "load", other)
