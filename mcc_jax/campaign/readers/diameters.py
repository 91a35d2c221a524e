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
from ..tables import parse_number, same_text

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
        return arguments.one_particle(values, "--diameters").tolist()
    names, diameters, _ = read_particles(path, ("particle", "file", "test"))
    return dict(zip(names, diameters.tolist(), strict=True))


def diameters_for(
    keys: Mapping[str, Sequence[str]],
    diameters: Diameters | None,
    in_files: Mapping[str, list[float] | InputError],
    file: Path,
) -> tuple[np.ndarray, int]:
    """Diameters [um] of the tests, shape (N, 3), and how many entries of a table no test needed; an error if one lacks.

    `keys` holds, by the name of each test, the names under which a table may hold its diameters, the best first; a
    triple for all tests, or a table, counts before what the files hold.
    """
    if diameters is not None and not isinstance(diameters, Mapping):
        return np.tile(arguments.one_particle(diameters), (len(keys), 1)), 0
    table = {
        same_text(name): arguments.one_particle(triple, f"diameters of {name!r}")
        for name, triple in (diameters or {}).items()
    }
    found: list[Triple] = []
    used: set[str] = set()
    lacking: dict[str, InputError | None] = {}
    for name, others in keys.items():
        key = next((same_text(other) for other in others if same_text(other) in table), None)
        own = in_files.get(name)
        if key is not None:
            used.add(key)
            found.append(table[key])
        elif isinstance(own, list):
            found.append(own)
        else:
            lacking[name] = own
    if not lacking:
        return np.array(found, float), len(table) - len(used)
    names = first_few(map(repr, lacking), 8)
    why = next(iter(lacking.values()))
    if why is not None:
        raise why if len(lacking) == 1 else why.changed(problem=f"{why.problem} (tests without diameters: {names})")
    if not table:
        raise InputError("instrument exports do not contain particle dimensions", file=file, remedy=_HOW)
    problem = f"there are no diameters for {len(lacking)} of {len(keys)} tests: {names}"
    remedy = f"Add rows named like the tests or their files; the table has rows for: {first_few(map(repr, table), 8)}"
    raise InputError(problem, file=file, remedy=remedy)
