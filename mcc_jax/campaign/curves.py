"""`curves.csv`: rows of many particles, checked and grouped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np

from .._errors import InputError
from .columns import FORCE, LENGTH, TIME, convert, find_column, missing_column
from .schema import Curve
from .table import Table, read_table, same_text
from .validate import check_magnitudes

PARTICLES = "particles.csv"
_QUANTITIES = (("time", TIME), ("force", FORCE), ("displacement", LENGTH))


@dataclass(frozen=True)
class CurveRows:
    """The rows of `curves.csv`, grouped by particle."""

    table: Table
    columns: tuple[int, ...]  # of time, force and displacement
    values: list[np.ndarray]  # of these, in canonical units
    groups: dict[str, np.ndarray]  # name -> indices of its records, in the order of the file

    def named_as(self, names: Sequence[str]) -> CurveRows:
        """The same with the given names, where a name differs from one of them in its Unicode form only."""
        known = set(names)
        form = {same_text(name): name for name in reversed(names)}
        parts: dict[str, list[np.ndarray]] = {}
        for name, records in self.groups.items():
            parts.setdefault(name if name in known else form.get(same_text(name), name), []).append(records)
        groups = {name: np.sort(np.concatenate(each)) for name, each in parts.items()}
        return replace(self, groups=groups)

    def curve(self, name: str) -> Curve:
        """The test of one particle, its rows in the file's order."""
        time, force, displacement = (column[self.groups[name]] for column in self.values)
        return Curve(time, force, displacement)

    def wrong(self, problem: str, record: int | np.integer, remedy: str, column: str = "particle") -> InputError:
        """The error for a record, which names its row in the file."""
        row = self.table.rows[int(record)]
        return InputError(problem, file=self.table.file, row=row, column=column, remedy=remedy)

    def check(self, name: str, curve: Curve) -> None:
        """Refuse a test that cannot be one, naming file, row and column."""
        records = self.groups[name]
        if len(curve) < 2:
            remedy = "A curve needs at least two rows; add them or remove the particle"
            raise self.wrong(f"the particle {name!r} has one row only", records[0], remedy)
        time, force, displacement = (self.table.header[column] for column in self.columns)
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


def read_curves(file: Path) -> CurveRows:
    """The rows of a file of curves, grouped by particle."""
    import pandas as pd

    table = read_table(file, lambda header: [i for i, _ in _measured(header, file)])
    measured = _measured(table.header, file)
    columns = tuple(i for i, _ in measured)
    values = [convert(raw, factor) for raw, (_, factor) in zip(table.numbers(columns), measured, strict=True)]
    if table.delimiter != ",":
        table.refuse_groups(columns)
    for column, each in zip(columns, values, strict=True):
        check_magnitudes(each, file, table.rows, table.header[column])
    codes, names = pd.factorize(np.array(table.text(name_column(table.header, file)), object))
    parts = np.split(np.argsort(codes, kind="stable"), np.cumsum(np.bincount(codes))[:-1])
    curves = CurveRows(table, columns, values, dict(zip(map(str, names), parts, strict=True)))
    for name, records in curves.groups.items():
        if not name.strip():
            raise curves.wrong("the name is empty", records[0], "Name the particle")
    return curves


def _measured(header: tuple[str, ...], file: Path) -> list[tuple[int, Fraction]]:
    """The columns of time, force and displacement, and what turns their units into s, mN and um."""
    where = name_column(header, file)
    found = [find_column(header, quantity, dimension, file) for quantity, dimension in _QUANTITIES]
    for i, other in enumerate(header):
        if i != where and i not in [column for column, _ in found]:
            remedy = f"Keep particle, time, force and displacement; facts about a particle belong in {PARTICLES}"
            raise InputError("is no column of curves", file=file, row=1, column=other, remedy=remedy)
    return found


def name_column(header: Sequence[str], file: Path, allowed: Sequence[str] = ("particle",)) -> int:
    """Which column holds the names; `allowed` are the names that the column itself may have, the usual one first."""
    for name in allowed:
        if name in header:
            return list(header).index(name)
    raise missing_column(header, allowed[0], file)
