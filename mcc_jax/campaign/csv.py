"""A campaign on the disk: a folder with `particles.csv`, `curves.csv` and, optionally, `campaign.toml`."""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import first_few
from .._store import results
from ..files import TABLE_BYTES, read_regular
from . import tables
from .metadata import format_metadata, parse_metadata, read_settings
from .schema import CHANNELS, SMALLEST_DIAMETER_UM, Campaign, Curve, check_campaign, fault_of
from .tables import Table

PARTICLES, CURVES, METADATA = "particles.csv", "curves.csv", "campaign.toml"
_DIAMETERS = {"D1": "length", "D2": "length", "D3": "length"}


def read_campaign(folder: str | os.PathLike[str]) -> Campaign:
    """Read a folder with `particles.csv`, `curves.csv` and perhaps `campaign.toml`, and check all of it.

    Lengths become um, forces mN, times s, whatever units the columns are named with. Rows of a particle must be in the
    order of time. `InputError` names file, row and column if anything is missing, damaged or contradictory.
    """
    path = arguments.file_path(folder, "folder")
    _check_folder(path)
    table = tables.read_table(path / PARTICLES)
    names, diameters, columns = parse_particles(table)
    curves = _read_curves(path / CURVES, names, table)
    toml = path / METADATA
    metadata = parse_metadata(read_settings(toml) if os.path.lexists(toml) else "", toml)
    return Campaign(names, diameters, curves, columns, metadata, source=str(path))


def _check_folder(path: Path) -> None:
    """Refuse a folder without the files of a campaign."""
    expected = f"a campaign is a folder with {PARTICLES} and {CURVES}"
    try:
        there = sorted(entry.name for entry in path.iterdir())
    except (OSError, ValueError) as error:
        kinds = {NotADirectoryError: "is a file, not a campaign folder", PermissionError: "cannot be read"}
        problem = kinds.get(type(error), "there is no such folder")
        raise InputError(problem, file=path, remedy=f"Check the path and its permissions; {expected}") from None
    for name in (PARTICLES, CURVES):
        if name not in there:
            found = first_few(there, 8) or "nothing"
            remedy = f"Expected: {expected} (mcc-jax convert makes one of an instrument file); found: {found}"
            raise InputError(f"{name} is missing", file=path, remedy=remedy)
    # Editors add ".txt" and some systems change the case: what it says must not be left out in silence.
    for name in there:
        if name.lower().removesuffix(".txt") == METADATA and METADATA not in there:
            raise InputError(f"{name} would not be read", file=path, remedy=f"Rename it to {METADATA}.")


def read_particles(
    file: str | Path, named: Sequence[str] = ("particle",)
) -> tuple[tuple[str, ...], np.ndarray, dict[str, tuple[str, ...]]]:
    """Read a table of particles alone: `particle,D1_um,D2_um,D3_um` and any further columns.

    It is text, or an Excel workbook whose only sheet, or the one called "particles", is the table. Its column of names
    may have one of the names `named`. Returns names, diameters [um] of shape (N, 3), and the further columns as text;
    `InputError` names file and row.
    """
    path = arguments.file_path(file, "file")
    data = tables.read_bytes(path)
    if tables.is_workbook(data):
        cells = tables.read_sheet(data, path, preferred=Path(PARTICLES).stem)
        return parse_particles(tables.make_table(cells, range(1, len(cells) + 1), path), named)
    return parse_particles(tables.parse_table(tables.decode(data, path), path), named)


def parse_particles(
    table: Table, named: Sequence[str] = ("particle",)
) -> tuple[tuple[str, ...], np.ndarray, dict[str, tuple[str, ...]]]:
    """Names, diameters [um] and further columns of a table of particles; see `read_particles`."""
    where = _name_column(table, named)
    names = tuple(table.columns[where])
    seen: dict[str, int] = {}
    for i, name in enumerate(names):
        if not name.strip():
            raise table.wrong("the name is empty", i, where, "Name the particle")
        if name in seen:
            problem = f"the particle {name!r} is already in row {table.rows[seen[name]]}"
            raise table.wrong(problem, i, where, "Give every particle one row")
        seen[name] = i
    diameters = _measured(table, _DIAMETERS)
    for column, values in diameters.items():
        bad = np.flatnonzero(~((values >= SMALLEST_DIAMETER_UM) & (values <= tables.LARGEST_MAGNITUDE)))
        if bad.size:
            value = values[bad[0]]
            what = "not positive" if value <= 0 else f"too {'small' if value < 1 else 'large'} to be real"
            remedy = "Enter the measured diameter, or correct the column's unit"
            raise table.wrong(f"the diameter {value:.10g} um is {what}", bad[0], column, remedy)
    further = {name: tuple(table.columns[i]) for i, name in enumerate(table.header) if i not in (where, *diameters)}
    return names, np.stack(list(diameters.values()), axis=-1), further


def _name_column(table: Table, allowed: Sequence[str] = ("particle",)) -> int:
    """Which column holds the names; `allowed` are the names that the column itself may have, the usual one first."""
    for name in allowed:
        if name in table.header:
            return table.header.index(name)
    raise tables.missing_column(table.header, allowed[0], table.file)


def _measured(table: Table, quantities: Mapping[str, str]) -> dict[int, np.ndarray]:
    """The columns of some quantities in mN, um or s, by their place in the table."""
    header, file = table.header, table.file
    factors = dict(tables.find_column(header, name, dimension, file) for name, dimension in quantities.items())
    if quantities is _DIAMETERS or table.delimiter != ",":
        table.refuse_groups(list(factors))
    raw = table.numbers(list(factors))
    return {i: tables.convert(values, factor) for (i, factor), values in zip(factors.items(), raw, strict=True)}


def _read_curves(file: Path, particles: Sequence[str], sizes: Table) -> tuple[Curve, ...]:
    """The tests of the particles, in their order, each of its rows in the file's order."""
    table = tables.read_table(file, names="particle")
    where = _name_column(table)
    channels = _measured(table, tables.DIMENSIONS)
    for i, name in enumerate(table.header):
        if i != where and i not in channels:
            remedy = f"Keep particle, time, force and displacement; facts about a particle belong in {PARTICLES}"
            raise InputError("is no column of curves", file=file, row=1, column=name, remedy=remedy)
    rows = _rows_of(table.columns[where], particles)
    for i, name in enumerate(particles):
        if name not in rows:
            problem, remedy = f"the particle {name!r} has no curve in {CURVES}", "Add its rows there or remove it here"
            raise InputError(problem, file=sizes.file, row=sizes.rows[i], column="particle", remedy=remedy)
    if unknown := rows.keys() - set(particles):
        name = min(unknown, key=lambda one: rows[one][0])
        problem = f"the particle {name!r} is not in {PARTICLES}" if name.strip() else "the name is empty"
        raise table.wrong(problem, rows[name][0], where, "Add its diameters there or remove its rows here")
    curves, (time, force, displacement) = [], channels.values()
    for name in particles:
        at = rows[name]
        curve = Curve(time[at], force[at], displacement[at])
        if (fault := fault_of(name, curve)) is not None:
            column = dict(zip(tables.DIMENSIONS, channels, strict=True)).get(fault.channel, where)
            raise table.wrong(fault.problem, at[fault.reading], column, fault.remedy)
        curves.append(curve)
    return tuple(curves)


def _rows_of(names: Sequence[str] | np.ndarray, particles: Sequence[str]) -> Mapping[str, np.ndarray]:
    """The records of each particle, also where a name differs from that of the particle in its Unicode form only."""
    import pandas as pd

    codes, written = pd.factorize(np.array(names, object))
    form = {tables.same_text(name): name for name in reversed(particles)} | {name: name for name in particles}
    known = [form.get(name, form.get(tables.same_text(name), name)) for name in map(str, written)]
    places = {name: place for place, name in enumerate(dict.fromkeys(known))}
    which = np.array([places[name] for name in known])[codes]
    records = np.split(np.argsort(which, kind="stable"), np.cumsum(np.bincount(which))[:-1])
    return dict(zip(places, records, strict=True))


def file_checksums(folder: str | Path) -> dict[str, str]:
    """SHA-256 of `particles.csv`, `curves.csv` and `campaign.toml`, by name; of those that are there."""
    path = arguments.file_path(folder, "folder")
    there = [name for name in (PARTICLES, CURVES, METADATA) if os.path.lexists(path / name)]
    remedy = "Split the campaign into several folders"
    return {name: hashlib.sha256(read_regular(path / name, TABLE_BYTES, remedy)).hexdigest() for name in there}


def write_campaign(campaign: Campaign, folder: str | os.PathLike[str]) -> None:
    """Write a campaign so that `read_campaign` gives back exactly the same numbers and texts.

    The three files appear in `folder`, which is made if need be, together or not at all; other files there are left
    alone. Raises `InputError` if the campaign could not be read back, or the folder cannot be written.
    """
    with results(arguments.file_path(folder, "folder")) as stage:
        write_files(campaign, stage.folder)


def write_files(campaign: Campaign, folder: Path) -> None:
    """The same, one file after the other, for a folder that is itself part of a stage."""
    check_campaign(campaign, file=folder)
    sizes = zip(campaign.particles, *campaign.diameters_um.T.tolist(), *campaign.columns.values(), strict=True)
    header = ["particle", "D1_um", "D2_um", "D3_um", *campaign.columns]
    curves = [f"particle,{','.join(CHANNELS)}"]
    for name, curve in zip(campaign.particles, campaign.curves, strict=True):
        cell = _row([name])
        columns = (np.asarray(getattr(curve, channel), float).tolist() for channel in CHANNELS)
        curves.extend(f"{cell},{t!r},{f!r},{d!r}" for t, f, d in zip(*columns, strict=True))
    metadata = format_metadata(campaign.metadata, folder / METADATA)
    folder.mkdir(exist_ok=True)
    for file, lines in ((PARTICLES, [_row(header), *map(_row, sizes)]), (CURVES, curves)):
        (folder / file).write_bytes("\n".join([*lines, ""]).encode("utf-8"))
    (folder / METADATA).write_bytes(metadata.encode("utf-8"))


def _row(cells: Iterable[object]) -> str:
    """Cells with commas between them, quoted where that is needed, numbers with all their digits."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(cells)
    return text.getvalue()
