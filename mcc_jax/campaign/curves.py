"""`curves.csv`: rows of many particles, checked and grouped."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import InputError
from ..files import LIMITS, FileLimits
from .columns import FORCE, LARGEST_MAGNITUDE, LENGTH, TIME, convert, find_column, missing_column
from .schema import Curve
from .table import decode, parse_table, read_bytes, same_text
from .validate import check_magnitudes

PARTICLES = "particles.csv"
_QUANTITIES = (("time", TIME), ("force", FORCE), ("displacement", LENGTH))


@dataclass(frozen=True)
class CurveRows:
    """The rows of `curves.csv`, grouped by particle; the table itself is parsed for messages only."""

    file: Path
    header: tuple[str, ...]
    columns: tuple[int, ...]  # of time, force and displacement
    values: np.ndarray  # (3, rows of data), canonical units
    groups: dict[str, np.ndarray]  # name -> indices of its records, in the order of the file
    text: str

    def named_as(self, names: Sequence[str]) -> CurveRows:
        """The same with the given names, where a name differs from one of them in its Unicode form only."""
        known = set(names)
        form = {same_text(name): name for name in reversed(names)}
        parts: dict[str, list[np.ndarray]] = {}
        for name, records in self.groups.items():
            parts.setdefault(name if name in known else form.get(same_text(name), name), []).append(records)
        groups = {name: np.sort(np.concatenate(each)) if len(each) > 1 else each[0] for name, each in parts.items()}
        return replace(self, groups=groups)

    def curve(self, name: str) -> Curve:
        """The test of one particle, its rows in the file's order."""
        time, force, displacement = (np.ascontiguousarray(column[self.groups[name]]) for column in self.values)
        return Curve(time, force, displacement)

    def wrong(self, problem: str, record: int | np.integer, remedy: str, column: str = "particle") -> InputError:
        """The error for a record, which names the line of the file that it stands in."""
        row = parse_table(self.text, self.file).rows[record]
        return InputError(problem, file=self.file, row=row, column=column, remedy=remedy)

    def check(self, name: str, curve: Curve) -> None:
        """Refuse a test that cannot be one, naming file, row and column."""
        records = self.groups[name]
        if len(curve) < 2:
            remedy = "A curve needs at least two rows; add them or remove the particle"
            raise self.wrong(f"the particle {name!r} has one row only", records[0], remedy)
        time, force, displacement = (self.header[column] for column in self.columns)
        back = np.flatnonzero(np.diff(curve.time_s) < 0)
        if len(back):
            i = int(back[0])
            problem = f"the time of {name!r} goes back, from {curve.time_s[i]:.10g} s to {curve.time_s[i + 1]:.10g} s"
            remedy = "Keep each particle's rows in the order of time; two tests need two names"
            raise self.wrong(problem, records[i + 1], remedy, time)
        for quantity, column, values in (
            ("force", force, curve.force_mN),
            ("displacement", displacement, curve.displacement_um),
        ):
            if not values.any():
                problem = f"every {quantity} of particle {name!r} is zero, so the test holds no data"
                raise self.wrong(problem, records[0], "Export the test again or remove the particle", column)


def read_curves(file: Path, limits: FileLimits = LIMITS) -> CurveRows:
    """The rows of a file of curves, grouped by particle."""
    data = read_bytes(file, limits)
    text = decode(data, file)
    first = re.split(r"[\r\n]", text, maxsplit=1)[0]
    head = parse_table(f"{first}\n{first}", file) if first.strip(",;\t ") and "sep=" not in first else None
    layout = _curve_layout(head.header, file) if head is not None else None
    fast = _split_fast(text, layout) if head is not None and layout is not None and head.delimiter == "," else None
    if layout is None or fast is None:
        table = parse_table(text, file)
        layout = _curve_layout(table.header, file)
        names = table.text(layout.name)
        raw = table.numbers(layout.columns)
        if table.delimiter != ",":
            table.refuse_groups(layout.columns)
        groups = _group(np.array(names, object))
    else:
        raw, groups = fast
    values = np.stack([convert(column, factor) for column, factor in zip(raw, layout.factors, strict=True)])
    curves = CurveRows(file, layout.header, layout.columns, values, groups, text)
    if np.abs(values).max() > LARGEST_MAGNITUDE:
        rows = parse_table(text, file).rows
        for column, of in zip(values, layout.columns, strict=True):
            check_magnitudes(column, file, rows, layout.header[of])
    for name, records in groups.items():
        if not name.strip():
            raise curves.wrong("the name is empty", records[0], "Name the particle")
    return curves


@dataclass(frozen=True)
class _Layout:
    header: tuple[str, ...]
    name: int
    columns: tuple[int, ...]
    factors: tuple[Fraction, ...]


def _curve_layout(header: tuple[str, ...], file: Path) -> _Layout:
    name = name_column(header, file)
    found = [find_column(header, quantity, dimension, file) for quantity, dimension in _QUANTITIES]
    columns = tuple(column for column, _ in found)
    for i, other in enumerate(header):
        if i != name and i not in columns:
            remedy = f"Keep particle, time, force and displacement; facts about a particle belong in {PARTICLES}"
            raise InputError("is no column of curves", file=file, row=1, column=other, remedy=remedy)
    return _Layout(header, name, columns, tuple(factor for _, factor in found))


def _split_fast(text: str, layout: _Layout) -> tuple[list[np.ndarray], dict[str, np.ndarray]] | None:
    """The same as the strict parser gives, by pandas' C parser, or None where that one could be lenient."""
    import pandas as pd

    data = text.encode()
    count = _count_records(text, data, len(layout.header))
    if count is None:
        return None
    # From pandas 3.1 on numbers are always rounded correctly, and the option is gone.
    modern = tuple(int(part) for part in pd.__version__.split(".")[:2]) >= (3, 1)
    exact: dict[str, Any] = {} if modern else {"float_precision": "round_trip"}
    names = [str(i) for i in range(len(layout.header))]
    types: dict[Hashable, Any] = {names[column]: "float64" for column in layout.columns}
    types[names[layout.name]] = str  # not "category", which makes numbers of names such as 007
    try:
        frame = pd.read_csv(
            io.BytesIO(data),
            header=None,
            skiprows=1,
            names=names,
            dtype=types,
            index_col=False,
            na_filter=False,
            **exact,
            engine="c",
        )
    except (ValueError, OverflowError):
        return None
    raw = [frame[names[column]].to_numpy() for column in layout.columns]
    if len(frame) != count or not all(np.isfinite(column).all() for column in raw):
        return None
    return raw, _group(frame[names[layout.name]])


def _count_records(text: str, data: bytes, width: int) -> int | None:
    """The number of records behind the header, or None unless every line is one record of `width` cells."""
    if '"' in text:
        try:
            widths = [len(record) for record in csv.reader(io.StringIO(text, newline=""), strict=True) if record]
        except csv.Error:
            return None
        return len(widths) - 1 if set(widths) == {width} else None
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    cells = np.frombuffer(data.strip(b"\n"), np.uint8)
    ends = np.append(np.flatnonzero(cells == ord("\n")), len(cells))
    commas = np.diff(np.searchsorted(np.flatnonzero(cells == ord(",")), ends), prepend=0)
    return len(ends) - 1 if len(ends) > 1 and (commas == width - 1).all() else None


def _group(names: Any) -> dict[str, np.ndarray]:
    """Where each name stands, names in the order in which they appear."""
    import pandas as pd

    codes, different = pd.factorize(names)
    parts = np.split(np.argsort(codes, kind="stable"), np.cumsum(np.bincount(codes))[:-1])
    return {str(name): part for name, part in zip(different, parts, strict=True)}


def name_column(header: Sequence[str], file: Path, allowed: Sequence[str] = ("particle",)) -> int:
    """Which column holds the names; `allowed` are the names that the column itself may have, the usual one first."""
    for name in allowed:
        if name in header:
            return list(header).index(name)
    raise missing_column(header, allowed[0], file)
