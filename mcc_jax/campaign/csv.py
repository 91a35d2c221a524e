"""A campaign on the disk: a folder with `particles.csv`, `curves.csv` and, optionally, `campaign.toml`."""

from __future__ import annotations

import hashlib
import os
import unicodedata
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from .. import arguments
from .._errors import InputError
from .._store import results
from ..files import TABLE_BYTES, open_regular
from .columns import LENGTH, convert, find_column
from .curves import PARTICLES, CurveRows, name_column, read_curves
from .metadata import format_metadata, parse_metadata, read_settings
from .schema import Campaign
from .table import Table, decode, make_table, parse_table, read_bytes, read_table
from .validate import check_campaign, check_magnitudes
from .workbook import is_workbook, read_sheet

CURVES, METADATA = "curves.csv", "campaign.toml"


def read_campaign(folder: str | os.PathLike[str]) -> Campaign:
    """Read a campaign folder and check all of it.

    Lengths become um, forces mN, times s, whatever units the columns are named with. Rows of different particles
    may be mixed; within a particle they must be in the order of time. Particles keep the order of `particles.csv`.

    Args:
        folder: the folder that holds `particles.csv`, `curves.csv` and perhaps `campaign.toml`.

    Returns:
        The campaign, with every value finite, every diameter positive and every curve at least two rows long.

    Raises:
        InputError: if anything is missing, damaged or contradictory; it names file, row and column.
    """
    path = arguments.file_path(folder, "folder")
    check_folder(path)
    table = read_table(path / PARTICLES)
    names, diameters, columns = parse_particles(table)
    curves = read_curves(path / CURVES).named_as(names)
    _check_match(table, names, curves)
    metadata_file = path / METADATA
    campaign = Campaign(
        particles=names,
        diameters_um=diameters,
        curves=tuple(curves.curve(name) for name in names),
        columns=columns,
        metadata=parse_metadata(_metadata_text(metadata_file), metadata_file),
        source=str(path),
    )
    for name, curve in zip(names, campaign.curves, strict=True):
        curves.check(name, curve)
    return campaign


def check_folder(path: str | Path) -> None:
    """Whether a folder has the files of a campaign.

    Raises:
        InputError: saying what was expected and what is there.
    """
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
            found = ", ".join(there[:8]) + (", ..." if len(there) > 8 else "") if there else "nothing"
            remedy = f"Expected: {expected} (mcc-jax convert makes one of an instrument file); found: {found}"
            if close:
                remedy = f"Rename {lower[close[0]]!r} to it"
            elif (inside := next((d for d in there if (path / d / PARTICLES).exists()), None)) is not None:
                remedy = f"Did you mean {path / inside}?"
            raise InputError(f"{name} is missing", file=path, remedy=remedy)


def _metadata_text(file: Path) -> str:
    """The text of `campaign.toml`; empty if there is none. What has nearly that name, which nobody would look for, is
    refused.
    """
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

    Returns:
        Names, diameters [um] of shape (N, 3), and the further columns as text.

    Raises:
        InputError: naming file, row and column.
    """
    path = arguments.file_path(file, "file")
    data = read_bytes(path)
    if is_workbook(data):
        return parse_particles(make_table(iter([read_sheet(data, path, preferred=Path(PARTICLES).stem)]), path), named)
    return parse_particles(parse_table(decode(data, path), path), named)


def parse_particles(
    table: Table, named: Sequence[str] = ("particle",)
) -> tuple[tuple[str, ...], np.ndarray, dict[str, tuple[str, ...]]]:
    """Names, diameters [um] and further columns of a table of particles; see `read_particles`."""
    where = name_column(table.header, table.file, named)
    names = _checked_names(table.text(where), table)
    found = [find_column(table.header, quantity, LENGTH, table.file) for quantity in ("D1", "D2", "D3")]
    used = [column for column, _ in found]
    table.refuse_groups(used)
    diameters = []
    for (column, factor), raw in zip(found, table.numbers(used), strict=True):
        values = convert(raw, factor)
        check_magnitudes(values, table.file, table.rows, table.header[column], diameter=True)
        diameters.append(values)
    columns = {name: tuple(table.text(i)) for i, name in enumerate(table.header) if i not in (where, *used)}
    return names, np.stack(diameters, axis=-1), columns


def _checked_names(names: Sequence[str], table: Table) -> tuple[str, ...]:
    seen: dict[str, int] = {}
    for name, row in zip(names, table.rows, strict=True):
        if not name.strip():
            raise _wrong(table, row, "the name is empty", "Name the particle")
        if name in seen:
            problem = f"the particle {name!r} is already in row {seen[name]}"
            raise _wrong(table, row, problem, "Give every particle one row")
        seen[name] = row
    return tuple(names)


def _wrong(table: Table, row: int, problem: str, remedy: str) -> InputError:
    return InputError(problem, file=table.file, row=row, column="particle", remedy=remedy)


def _check_match(table: Table, names: tuple[str, ...], curves: CurveRows) -> None:
    for name, row in zip(names, table.rows, strict=True):
        if name not in curves.groups:
            remedy = _similar(name, curves.groups) or f"Add its rows to {CURVES} or remove it here"
            raise _wrong(table, row, f"the particle {name!r} has no curve in {CURVES}", remedy)
    known = set(names)
    for name, records in curves.groups.items():
        if name not in known:
            remedy = _similar(name, names) or f"Add its diameters to {PARTICLES} or remove its rows here"
            raise curves.wrong(f"the particle {name!r} is not in {PARTICLES}", records[0], remedy)


def _similar(name: str, others: Iterable[str]) -> str | None:
    found = (f"The other file has {other!r}; mind the blanks" for other in others if other.strip() == name.strip())
    return next(found, None)


def file_checksums(folder: str | Path) -> dict[str, str]:
    """SHA-256 of `particles.csv`, `curves.csv` and `campaign.toml`, by name; of those that are there.

    Raises:
        InputError: if a file cannot be read.
    """
    path = arguments.file_path(folder, "folder")
    found = {}
    for name in (PARTICLES, CURVES, METADATA):
        file = path / name
        if not os.path.lexists(file):
            continue
        with open_regular(file, TABLE_BYTES, "Split the campaign into several folders") as stream:
            found[name] = hashlib.file_digest(stream, "sha256").hexdigest()
    return found


def write_campaign(campaign: Campaign, folder: str | os.PathLike[str]) -> None:
    """Write a campaign so that `read_campaign` gives back exactly the same numbers and texts.

    The three files appear in `folder` together or not at all; other files there are left alone.

    Args:
        campaign: what to write; it is checked first.
        folder: the folder to make or to replace the campaign in.

    Raises:
        InputError: if the campaign could not be read back, or the folder cannot be written.
    """
    path = arguments.file_path(folder, "folder")
    check_campaign(campaign, file=path)
    texts = {
        PARTICLES: _format_particles(campaign),
        CURVES: _format_curves(campaign),
        METADATA: format_metadata(campaign.metadata, path / METADATA),
    }
    with results(path) as stage:
        for name, text in texts.items():
            (stage.folder / name).write_bytes(text.encode("utf-8"))


def _cell(text: str) -> str:
    if any(mark in text for mark in ',"\r\n'):
        return '"' + text.replace('"', '""') + '"'
    return text


def _format_particles(campaign: Campaign) -> str:
    lines = [",".join(["particle", "D1_um", "D2_um", "D3_um", *map(_cell, campaign.columns)])]
    further = list(campaign.columns.values())
    for i, (name, diameters) in enumerate(zip(campaign.particles, campaign.diameters_um.tolist(), strict=True)):
        lines.append(",".join([_cell(name), *map(repr, diameters), *(_cell(values[i]) for values in further)]))
    return "\n".join(lines) + "\n"


def _format_curves(campaign: Campaign) -> str:
    lines = ["particle,time_s,force_mN,displacement_um"]
    for name, curve in zip(campaign.particles, campaign.curves, strict=True):
        cell = _cell(name)
        columns = (np.asarray(c, float).tolist() for c in (curve.time_s, curve.force_mN, curve.displacement_um))
        lines.extend(f"{cell},{t!r},{f!r},{d!r}" for t, f, d in zip(*columns, strict=True))
    return "\n".join(lines) + "\n"
