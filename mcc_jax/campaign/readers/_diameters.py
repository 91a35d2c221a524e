"""Diameters of the particles, which testers' files do not hold."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ... import arguments
from ..._errors import InputError
from .._csv import read_particles
from .._table import parse_number
from .._validate import SMALLEST_DIAMETER_UM

Triple = Sequence[float | int] | np.ndarray
Diameters = Mapping[str, Triple] | Triple
_HOW = "Give --diameters D1,D2,D3 in um for all, or --diameters FILE, a CSV table with particle,D1_um,D2_um,D3_um"


def read_diameters(text: str | os.PathLike[str]) -> Diameters:
    """Diameters from the command line: three numbers for all particles, or a table with one row for each.

    Args:
        text: `D1,D2,D3` in um, or the path of a CSV table with the columns `particle`, `D1_um`, `D2_um`, `D3_um`
            (or other units of length).

    Returns:
        Three numbers [um], or a mapping from names to three numbers [um].

    Raises:
        InputError: if it is neither, or a diameter is not positive.
    """
    if not isinstance(text, str):
        text = arguments.file_path(text, "diameters")
    parts = str(text).split(",")
    if len(parts) == 3 and not _is_file(Path(text)):
        try:
            values = [parse_number(part) for part in parts]
        except ValueError as error:
            raise InputError(f"--diameters: {error}", remedy=_HOW) from None
        check_triple(values, "all particles", "--diameters")
        return values
    names, diameters, _ = read_particles(Path(text))
    return dict(zip(names, diameters.tolist(), strict=True))


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # three long numbers are no name of a file
        return False


def check_triple(triple: Triple, what: str, file: str | Path) -> None:
    """Refuse anything but three positive, finite lengths [um].

    Raises:
        InputError: saying which.
    """
    try:
        values = np.asarray(triple, float)
    except (OverflowError, TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (3,) or not ((values >= SMALLEST_DIAMETER_UM) & (values < 1e15)).all():
        shown = list(triple) if isinstance(triple, Sequence | np.ndarray) else triple
        raise InputError(
            f"the diameters of {what} are {shown}, where three positive lengths in um are expected",
            file=file,
            remedy="Give D1, D2 and D3",
        )


def diameters_for(names: Sequence[str], diameters: Diameters | None, file: Path) -> np.ndarray:
    """Diameters in the order of the names, shape (N, 3) [um].

    Raises:
        InputError: if they are missing, or the mapping has another set of names.
    """
    if diameters is None:
        raise InputError("a tester's file knows no particle diameters", file=file, remedy=_HOW)
    if not isinstance(diameters, Mapping):
        check_triple(diameters, "all particles", file)
        return np.tile(np.asarray(diameters, float), (len(names), 1))
    shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    for name in names:
        if name not in diameters:
            raise InputError(
                f"the test {name!r} has no diameters", file=file, remedy=f"Add a row for it; the tests are: {shown}"
            )
        check_triple(diameters[name], f"particle {name!r}", file)
    for name in diameters:
        if name not in names:
            raise InputError(
                f"diameters are given for {name!r}, which is no test of the file",
                file=file,
                remedy=f"Rename or remove it; the tests are: {shown}",
            )
    return np.array([np.asarray(diameters[name], float) for name in names])
