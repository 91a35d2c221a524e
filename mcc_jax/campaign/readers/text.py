"""What readers of instrument files share: what they find, decoding, and blocks of numbers checked cell by cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..._errors import InputError
from ..._format import counted
from ..schema import Control, Curve, fault_of
from ..tables import Table, check_header


@dataclass(frozen=True)
class Tests:
    """What a reader finds in a file: named curves, and what the file says about them."""

    curves: dict[str, Curve]
    format: str  # in words
    control: Control | None = None
    other: dict[str, Any] = field(default_factory=dict)  # what else the file says, kept as it is
    diameters_um: dict[str, list[float] | InputError] = field(default_factory=dict)  # or why it does not hold them
    missing: dict[str, int] = field(default_factory=dict)  # how many rows with a missing reading were dropped, by test


def decode_lines(data: bytes, encoding: str | None = None, file: Path | None = None) -> list[str]:
    """The lines of an instrument file; by default UTF-8 or, as most instruments write, Latin-1."""
    try:
        text = data.decode(encoding or "utf-8-sig")
    except (UnicodeDecodeError, LookupError, ValueError) as error:
        if encoding is not None:
            problem = f"cannot be decoded as {encoding!r}: {error}"
            remedy = 'Name the file\'s encoding in the mapping file: encoding = "cp1252" for Windows in western Europe'
            raise InputError(problem, file=file, remedy=remedy) from None
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def number_block(
    lines: Sequence[str], at: Sequence[int], names: Sequence[str], file: Path, decimal_mark: str = "."
) -> dict[str, np.ndarray]:
    """The columns, by name, of tab-separated numbers in the lines at some indices; `InputError` if two columns have one
    name, or a row or cell is damaged."""
    check_header(names, file, at[0] if at else None, "Export the file again")
    records = [lines[i].rstrip("\t ").split("\t") for i in at]
    for i, cells in zip(at, records, strict=True):
        if len(cells) != len(names):
            problem = f"{counted(len(cells), 'cell')} where {len(names)} are expected ({', '.join(names)})"
            raise cut_off(problem, file, i + 1)
    columns = list(zip(*records, strict=True)) or [()] * len(names)
    table = Table(file, tuple(names), columns, [i + 1 for i in at], "\t")
    found = table.numbers(range(len(names)), decimal_mark, "Export the file again")
    return dict(zip(names, found, strict=True))


def checked_curve(
    time: np.ndarray, force: np.ndarray, displacement: np.ndarray, file: Path, at: Sequence[int], name: str
) -> Curve:
    """A test whose readings are in the lines at some indices; `InputError` names the row if none can be like that."""
    curve = Curve(time, force, displacement)
    if (fault := fault_of(name, curve)) is not None:
        row = at[fault.reading] + 1 if len(at) else 1
        raise InputError(fault.problem, file=file, row=row, remedy=fault.remedy)
    return curve


def cut_off(problem: str, file: Path, row: int | None = None) -> InputError:
    """The error for a file that ends too early or lacks a part."""
    return InputError(problem, file=file, row=row, remedy="The file is cut off or damaged; export it again")
