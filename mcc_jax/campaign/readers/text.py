"""What the readers of testers' text files share: decoding, and blocks of numbers checked cell by cell."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..._errors import InputError
from ..schema import Control, Curve
from ..table import number_of_cells, parse_number

_NUMBER = re.compile(r"[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?")


@dataclass(frozen=True)
class Tests:
    """What a reader finds in a file: named curves, and what the file says about them.

    Attributes:
        curves: the tests by their names.
        format: what kind of file it is, in words.
        control: the controlled quantity, where the file or a mapping tells it.
        other: what else the file says, kept as it is.
        diameters_um: D1, D2, D3 [um] of tests whose file should tell them, or why it does not.
        missing: how many rows with a missing reading were dropped, by test.
    """

    curves: dict[str, Curve]
    format: str
    control: Control | None = None
    other: dict[str, Any] = field(default_factory=dict)
    diameters_um: dict[str, list[float] | InputError] = field(default_factory=dict)
    missing: dict[str, int] = field(default_factory=dict)


def decode_lines(data: bytes, encoding: str | None = None, file: Path | None = None) -> list[str]:
    """The lines of a tester's file; by default UTF-8 or, as most testers write, Latin-1.

    Raises `InputError` if the file is not in the encoding given.
    """
    if encoding is None:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    else:
        try:
            text = data.decode(encoding)
        except (UnicodeDecodeError, LookupError, ValueError) as error:
            raise InputError(
                f"cannot be decoded as {encoding!r}: {error}", file=file, remedy="Name the file's encoding"
            ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def number_block(
    lines: Sequence[str], first: int, stop: int, names: Sequence[str], file: Path, decimal_mark: str = "."
) -> np.ndarray:
    """Tab-separated numbers, shape (rows, columns). Raises `InputError` at the first row or cell that is damaged.

    Args:
        lines: all lines of the file.
        first: index of the first line of the block.
        stop: index behind the last one.
        names: the columns' names.
        file: for messages.
        decimal_mark: "." or ",".
    """
    block = np.empty((stop - first, len(names)))
    for i in range(first, stop):
        cells = lines[i].rstrip("\t ").split("\t")
        if len(cells) != len(names):
            raise InputError(
                f"{number_of_cells(len(cells))} where {len(names)} are expected ({', '.join(names)})",
                file=file,
                row=i + 1,
                remedy="The file is damaged or cut off; export it again",
            )
        for j, cell in enumerate(cells):
            try:
                block[i - first, j] = parse_number(cell, decimal_mark)
            except ValueError as error:
                raise InputError(
                    str(error), file=file, row=i + 1, column=names[j], remedy="Export the file again"
                ) from None
    return block


def checked_curve(
    time: np.ndarray, force: np.ndarray, displacement: np.ndarray, file: Path, row: int, name: str
) -> Curve:
    """A curve whose time never goes back and that has at least two samples.

    Raises `InputError` naming the row; `row` is that of the first sample.
    """
    if len(time) < 2:
        raise InputError(
            f"the test {name!r} has fewer than two samples", file=file, row=row, remedy="Export the file again"
        )
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        raise InputError(
            f"the time of test {name!r} goes back",
            file=file,
            row=row + int(back[0]) + 1,
            remedy="Each test needs a file or a name of its own",
        )
    return Curve(time, force, displacement)


def cut_off(problem: str, file: Path, row: int | None = None) -> InputError:
    """The error for a file that ends too early or lacks a part."""
    return InputError(problem, file=file, row=row, remedy="The file is cut off or damaged; export it again")


def refuse_twice(names: Sequence[str], file: Path, row: int) -> None:
    """Refuse a header that names two columns alike: one of them would be lost.

    Raises `InputError` naming the column.
    """
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise InputError(f"stands there {count} times", file=file, row=row, column=name, remedy="Export the file again")


def leading_number(text: str) -> float | None:
    """The number a text such as `0.0066 nm/uN` begins with."""
    match = _NUMBER.match(text.strip())
    return float(match[0]) if match else None
