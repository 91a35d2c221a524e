"""A campaign on the disk: a folder with `particles.csv`, `curves.csv` and, optionally, `campaign.toml`."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import first_few
from .._store import results
from ..files import TABLE_BYTES, read_regular
from .columns import FORCE, LENGTH, TIME, convert, find_column, missing_column
from .metadata import format_metadata, parse_metadata, read_settings
from .schema import CHANNELS, Campaign, Curve
from .table import Table, decode, make_table, parse_table, read_bytes, read_table, same_text
from .validate import check_campaign, check_magnitudes, fault_of
from .workbook import is_workbook, read_sheet

PARTICLES, CURVES, METADATA = "particles.csv", "curves.csv", "campaign.toml"
_CHANNELS = {"time": TIME, "force": FORCE, "displacement": LENGTH}
_DIAMETERS = {"D1": LENGTH, "D2": LENGTH, "D3": LENGTH}


def read_campaign(folder: str | os.PathLike[str]) -> Campaign:
    """Read a folder with `particles.csv`, `curves.csv` and perhaps `campaign.toml`, and check all of it.

    Lengths become um, forces mN, times s, whatever units the columns are named with. Rows of different particles
    may be mixed; within a particle they must be in the order of time. Particles keep the order of `particles.csv`.

    Raises:
        InputError: if anything is missing, damaged or contradictory; it names file, row and column.
    """
    path = arguments.file_path(folder, "folder")
    check_folder(path)
    table = read_table(path / PARTICLES)
    names, diameters, columns = parse_particles(table)
    curves = _read_curves(path / CURVES, names, table)
    metadata_file = path / METADATA
    metadata = parse_metadata(_metadata_text(metadata_file), metadata_file)
    return Campaign(names, diameters, curves, columns, metadata, source=str(path))


def check_folder(path: str | Path) -> None:
    """Whether a folder has the files of a campaign; `InputError` says what was expected and what is there."""
    path = arguments.file_path(path, "path")
    expected = f"a campaign is a folder with {PARTICLES} and {CURVES}"
    try:
        if not path.exists():
            raise InputError("there is no such folder", file=path, remedy=f"Check the path; {expected}")
        if not path.is_dir():
            remedy = f"{expected.capitalize()}; mcc-jax convert makes one of an instrument file"
            if all((path.parent / name).exists() for name in (PARTICLES, CURVES)):
                remedy = f"Did you mean the folder it lies in, {path.parent}?"
            raise InputError("is a file, not a campaign folder", file=path, remedy=remedy)
        there = sorted(entry.name for entry in path.iterdir())
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise InputError(problem, file=path, remedy="Check the permissions") from None
    for name in (PARTICLES, CURVES):
        if name not in there:
            lower = {entry.lower(): entry for entry in there}
            close = get_close_matches(name, list(lower), n=1, cutoff=0.8)
            found = first_few(there, 8) or "nothing"
            remedy = f"Expected: {expected} (mcc-jax convert makes one of an instrument file); found: {found}"
            if close:
                remedy = f"Rename {lower[close[0]]!r} to it"
            elif (inside := next((d for d in there if (path / d / PARTICLES).exists()), None)) is not None:
                remedy = f"Did you mean {path / inside}?"
            raise InputError(f"{name} is missing", file=path, remedy=remedy)


def _metadata_text(file: Path) -> str:
    """The text of `campaign.toml`; empty if there is none. A file of nearly that name is refused, not ignored."""
    if os.path.lexists(file):
        return read_settings(file)
    for entry in file.parent.iterdir():
        plain = unicodedata.normalize("NFKC", entry.name).strip().casefold()
        if plain in (METADATA, f"{METADATA}.txt"):
            problem = f"would be ignored under this name: it is not {METADATA!r}"
            raise InputError(problem, file=entry, remedy="Rename it")
    return ""


def read_particles(
    file: str | Path, named: Sequence[str] = ("particle",)
) -> tuple[tuple[str, ...], np.ndarray, dict[str, tuple[str, ...]]]:
    """Read a table of particles alone: `particle,D1_um,D2_um,D3_um` and any further columns.

    Args:
        file: a text table, or an Excel workbook whose only sheet, or the one called "particles", is the table.
        named: what the column of names may be called.

    Returns names, diameters [um] of shape (N, 3), and the further columns as text; `InputError` names file and row.
    """
    path = arguments.file_path(file, "file")
    data = read_bytes(path)
    if is_workbook(data):
        cells = read_sheet(data, path, preferred=Path(PARTICLES).stem)
        return parse_particles(make_table(cells, range(1, len(cells) + 1), path), named)
    return parse_particles(parse_table(decode(data, path), path), named)


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
    further = {name: tuple(table.columns[i]) for i, name in enumerate(table.header) if i not in (where, *diameters)}
    return names, np.stack(list(diameters.values()), axis=-1), further


def _name_column(table: Table, allowed: Sequence[str] = ("particle",)) -> int:
    """Which column holds the names; `allowed` are the names that the column itself may have, the usual one first."""
    for name in allowed:
        if name in table.header:
            return table.header.index(name)
    raise missing_column(table.header, allowed[0], table.file)


def _measured(table: Table, quantities: Mapping[str, str]) -> dict[int, np.ndarray]:
    """The columns of some quantities in mN, um or s, by their place in the table."""
    factors = dict(find_column(table.header, name, dimension, table.file) for name, dimension in quantities.items())
    columns, sizes = list(factors), quantities is _DIAMETERS
    if sizes or table.delimiter != ",":
        table.refuse_groups(columns)
    values = [convert(raw, factors[i]) for i, raw in zip(columns, table.numbers(columns), strict=True)]
    for i, each in zip(columns, values, strict=True):
        check_magnitudes(each, table.file, table.rows, table.header[i], diameter=sizes)
    return dict(zip(columns, values, strict=True))


def _read_curves(file: Path, particles: Sequence[str], sizes: Table) -> tuple[Curve, ...]:
    """The tests of the particles, in their order, each of its rows in the file's order."""
    table = read_table(file, names="particle")
    where = _name_column(table)
    channels = _measured(table, _CHANNELS)
    for i, name in enumerate(table.header):
        if i != where and i not in channels:
            remedy = f"Keep particle, time, force and displacement; facts about a particle belong in {PARTICLES}"
            raise InputError("is no column of curves", file=file, row=1, column=name, remedy=remedy)
    rows = _rows_of(table, where, particles)
    for i, name in enumerate(particles):
        if name not in rows:
            remedy = _similar(name, rows) or f"Add its rows to {CURVES} or remove it here"
            problem = f"the particle {name!r} has no curve in {CURVES}"
            raise InputError(problem, file=sizes.file, row=sizes.rows[i], column="particle", remedy=remedy)
    for name, records in rows.items():
        if name not in particles:
            remedy = _similar(name, particles) or f"Add its diameters to {PARTICLES} or remove its rows here"
            raise table.wrong(f"the particle {name!r} is not in {PARTICLES}", records[0], where, remedy)
    time, force, displacement = channels.values()
    curves = tuple(Curve(time[at], force[at], displacement[at]) for at in (rows[name] for name in particles))
    for name, curve in zip(particles, curves, strict=True):
        if (fault := fault_of(name, curve)) is not None:
            column = dict(zip(_CHANNELS, channels, strict=True)).get(fault.channel, where)
            raise table.wrong(fault.problem, rows[name][fault.reading], column, fault.remedy)
    return curves


def _rows_of(table: Table, where: int, particles: Sequence[str]) -> dict[str, list[int]]:
    """The records of each particle, also where a name differs from that of the particle in its Unicode form only."""
    groups: defaultdict[str, list[int]] = defaultdict(list)
    for record, name in enumerate(table.columns[where]):
        groups[name].append(record)
    form = {same_text(name): name for name in reversed(particles)} | {name: name for name in particles}
    found: defaultdict[str, list[int]] = defaultdict(list)
    for name, records in groups.items():
        if not name.strip():
            raise table.wrong("the name is empty", records[0], where, "Name the particle")
        known = form.get(name, form.get(same_text(name), name))
        found[known] = sorted(found[known] + records)
    return found


def _similar(name: str, others: Iterable[str]) -> str | None:
    found = (f"The other file has {other!r}; mind the blanks" for other in others if other.strip() == name.strip())
    return next(found, None)


def file_checksums(folder: str | Path) -> dict[str, str]:
    """SHA-256 of `particles.csv`, `curves.csv` and `campaign.toml`, by name; of those that are there.

    Raises `InputError` if a file cannot be read.
    """
    path = arguments.file_path(folder, "folder")
    there = [name for name in (PARTICLES, CURVES, METADATA) if os.path.lexists(path / name)]
    remedy = "Split the campaign into several folders"
    return {name: hashlib.sha256(read_regular(path / name, TABLE_BYTES, remedy)).hexdigest() for name in there}


def write_campaign(campaign: Campaign, folder: str | os.PathLike[str]) -> None:
    """Write a campaign so that `read_campaign` gives back exactly the same numbers and texts.

    The three files appear in `folder`, which is made if need be, together or not at all; other files there are left
    alone. Raises `InputError` if the campaign could not be read back, or the folder cannot be written.
    """
    path = arguments.file_path(folder, "folder")
    texts = _texts(campaign, path)
    with results(path) as stage:
        for name, text in texts.items():
            (stage.folder / name).write_bytes(text)


def write_files(campaign: Campaign, folder: Path) -> None:
    """The same, one file after the other, for a folder that is itself part of a stage."""
    texts = _texts(campaign, folder)
    folder.mkdir(exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_bytes(text)


def _texts(campaign: Campaign, folder: Path) -> dict[str, bytes]:
    """The contents of the three files, by name."""
    check_campaign(campaign, file=folder)
    sizes = zip(campaign.particles, *campaign.diameters_um.T.tolist(), *campaign.columns.values(), strict=True)
    header = ["particle", "D1_um", "D2_um", "D3_um", *campaign.columns]
    curves = [f"particle,{','.join(CHANNELS)}"]
    for name, curve in zip(campaign.particles, campaign.curves, strict=True):
        cell = _row([name])
        columns = (np.asarray(getattr(curve, channel), float).tolist() for channel in CHANNELS)
        curves.extend(f"{cell},{t!r},{f!r},{d!r}" for t, f, d in zip(*columns, strict=True))
    texts = {
        PARTICLES: "\n".join([_row(header), *map(_row, sizes)]) + "\n",
        CURVES: "\n".join(curves) + "\n",
        METADATA: format_metadata(campaign.metadata, folder / METADATA),
    }
    return {name: text.encode("utf-8") for name, text in texts.items()}


def _row(cells: Iterable[object]) -> str:
    """Cells with commas between them, quoted where that is needed, numbers with all their digits."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(cells)
    return text.getvalue()
