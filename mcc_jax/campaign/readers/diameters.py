"""Diameters of the particles, which instrument files do not hold."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ... import arguments
from ..._errors import InputError
from ..._format import first_few
from ..csv import read_particles
from ..table import parse_number, same_text
from ..validate import SMALLEST_DIAMETER_UM

Triple = Sequence[float | int] | np.ndarray
Diameters = Mapping[str, Triple] | Triple
_HOW = (
    "Give --diameters D1,D2,D3 in um for all, or --diameters FILE, a CSV or xlsx table with particle,D1_um,D2_um,D3_um"
)


def read_diameters(text: str | os.PathLike[str]) -> Diameters:
    """Diameters from the command line: three numbers for all particles, or a mapping from names to three numbers [um].

    `text` is `D1,D2,D3` in um, or the path of a table (CSV, with semicolons or tabs, or xlsx) with the columns
    `particle` (or `file`, `test`), `D1_um`, `D2_um`, `D3_um` (or other units of length). `InputError` if it is neither,
    or a diameter is not positive.
    """
    path = arguments.file_path(text, "diameters")
    parts = str(text).split(",")
    if len(parts) == 3 and not os.path.isfile(path):  # noqa: PTH113  # Path's raises where a name is too long
        try:
            values = [parse_number(part) for part in parts]
        except ValueError as error:
            raise InputError(f"--diameters: {error}", remedy=_HOW) from None
        check_triple(values, "all particles", "--diameters")
        return values
    names, diameters, _ = read_particles(path, ("particle", "file", "test"))
    return dict(zip(names, diameters.tolist(), strict=True))


def check_triple(triple: Triple, what: str, file: str | Path) -> None:
    """Refuse anything but three positive, finite lengths [um]."""
    try:
        values = np.asarray(triple, float)
    except (OverflowError, TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (3,) or not ((values >= SMALLEST_DIAMETER_UM) & (values < 1e15)).all():
        shown = list(triple) if isinstance(triple, Sequence | np.ndarray) else triple
        problem = f"the diameters of {what} are {shown}, where three positive lengths in um are expected"
        raise InputError(problem, file=file, remedy="Give D1, D2 and D3")


def diameters_for(
    keys: Mapping[str, Sequence[str]],
    diameters: Diameters | None,
    in_files: Mapping[str, list[float] | InputError],
    file: Path,
) -> tuple[np.ndarray, int]:
    """Diameters [um] of the tests, shape (N, 3), and how many entries of a table no test needed.

    Raises `InputError` if a test has none.

    Args:
        keys: by the name of each test the names under which a table may hold its diameters, the best first.
        diameters: one triple for all tests, or a table by name, which counts before what the file holds.
        in_files: what the tests' files hold, or why they do not.
    """
    if diameters is not None and not isinstance(diameters, Mapping):
        check_triple(diameters, "all particles", file)
        return np.tile(np.asarray(diameters, float), (len(keys), 1)), 0
    table = dict(diameters or {})
    form = {same_text(name): name for name in reversed(table)} | {name: name for name in table}
    found: list[Triple] = []
    used: set[str] = set()
    lacking: dict[str, InputError | None] = {}
    for name, others in keys.items():
        key = next((form[one] for other in others for one in (other, same_text(other)) if one in form), None)
        own = in_files.get(name)
        if key is not None:
            check_triple(table[key], f"particle {name!r}", file)
            used.add(key)
            found.append(table[key])
        elif isinstance(own, list):
            found.append(own)
        else:
            lacking[name] = own
    if lacking:
        raise _no_diameters(lacking, list(keys), list(table), file)
    return np.array(found, float), len(table) - len(used)


def _no_diameters(
    lacking: Mapping[str, InputError | None], names: list[str], table: list[str], file: Path
) -> InputError:
    name, why = next(iter(lacking.items()))
    if why is not None:
        others = [repr(other) for other in lacking if other != name]
        more = f" (so it is with {first_few(others, 8)}, too)" if others else ""
        return why.changed(problem=why.problem + more)
    if not table:
        return InputError("instrument exports do not contain particle dimensions", file=file, remedy=_HOW)
    there = first_few(map(repr, table), 8)
    if len(lacking) == len(names):
        tests = first_few(map(repr, names), 8)
        problem = f"none of the diameters is for a test: they are for {there}, the tests are {tests}"
        return InputError(problem, file=file, remedy="Name the particles in the table like the tests or their files")
    more = f" (nor have {len(lacking) - 1} more)" if len(lacking) > 1 else ""
    remedy = f"Add a row for it; the table has rows for: {there}"
    return InputError(f"the test {name!r} has no diameters{more}", file=file, remedy=remedy)
