"""One entry for all instrument files, alone or in a folder, and the diameters of their particles."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ... import arguments
from ..._errors import InputError
from ..._format import counted, first_few
from ..csv import read_particles
from ..findings import Finding
from ..schema import CHANNELS, Campaign, Metadata, check_campaign
from ..tables import binary_kind, is_workbook, parse_number, read_bytes, same_text
from . import fischer, hysitron, micromaterials
from .folder import names_of, read_folder
from .mapped import read_mapped
from .mapping import MappingFile, read_mapping
from .text import Tests, decode_lines

Triple = Sequence[float | int] | np.ndarray
Diameters = Mapping[str, Triple] | Triple
FORMATS = {
    "Fischer HM export": (fischer.matches, fischer.read),
    "Hysitron hld": (hysitron.is_hld, hysitron.read_hld),
    "Hysitron load-control text": (hysitron.is_text, hysitron.read_text),
    "Micro Materials text (also many in one zip)": (micromaterials.matches, micromaterials.read),
}
"""Of each known format how it is recognised by its lines, and how they are read."""
_HOW = "Describe it in a mapping file and give that with --mapping; mcc-jax convert --help shows one"


def read_instrument_file(
    path: str | os.PathLike[str],
    *,
    diameters_um: Diameters | None = None,
    mapping: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | None = None,
    skip: Sequence[str] = (),
) -> Campaign:
    """An instrument's export, or a folder of exports, as a campaign; recognised by the content.

    Only units are converted (to mN, um, s) and, where a mapping says so, signs. What the file says besides the curves
    is kept in `Metadata.other`; what was left out (rows with missing readings, files) is there under "conversion".

    Args:
        path: an export of Fischer HM, Hysitron or Micro Materials, anything that a mapping describes, or a folder.
        diameters_um: D1, D2, D3 [um] for all tests, or a mapping from tests, or names of files, to such triples; see
            `read_diameters`. It counts before what the mapping or the files say.
        mapping: a TOML file that describes the table; or several, of which each file is read by the one that fits it.
        skip: names of files in the folder that are left out; may hold "*", "?".

    `InputError` if a file is unknown or damaged, or diameters are missing.
    """
    place = arguments.file_path(path, "path")
    given = () if mapping is None else (mapping,) if isinstance(mapping, str | os.PathLike) else tuple(mapping)
    described = [read_mapping(one) for one in given]
    for one in described:
        if len(described) > 1 and one.diameters_um is not None:
            problem = "cannot differ between mapping files"
            raise InputError(problem, file=one.file, column="diameters_um", remedy="Give --diameters")
        if place.is_dir() and one.test_name is not None:
            raise InputError("is for one file, not for a folder", file=one.file, column="test_name", remedy="Remove it")
        if diameters_um is None and (sizes := one.diameters_um) is not None:
            diameters_um = sizes["all"] if list(sizes) == ["all"] else sizes

    def read(file: Path, data: bytes) -> Tests:
        return _read_by_one(data, file, described) if described else _read_known(data, file)

    findings: list[Finding] = []
    if place.is_dir():
        tests, keys, findings = read_folder(place, read, skip)
        origin = f"folder {place.resolve().name}, {tests.format}"
    else:
        if skip:
            problem = "is a file, so there is nothing to skip"
            raise InputError(problem, file=place, remedy="Give --leave-out with a folder")
        tests = read(place, read_bytes(place))
        alone = names_of(place) if len(tests.curves) == 1 else ()
        keys = {name: (name, *alone) for name in tests.curves}
        origin = f"{place.name}, {tests.format}"
    sizes, unused = diameters_for(keys, diameters_um, tests.diameters_um, place)
    if dropped := sum(tests.missing.values()):
        rows = f"{counted(dropped, 'row')} with a missing reading {'was' if dropped == 1 else 'were'} dropped"
        sentence = f"{rows}, in {counted(len(tests.missing), 'test')}"
        findings.append(Finding("missing readings", "info", sentence, "", tuple(tests.missing)))
    provenance = "; ".join([f"{origin}, read by mcc_jax", *(finding.sentence for finding in findings)])
    if unused:
        rows = f"{counted(unused, 'row')} of the diameters {'is' if unused == 1 else 'are'}"
        findings.append(Finding("diameters", "info", f"{rows} for no test here and not used"))
    other = dict(tests.other)
    if findings:
        other["conversion"] = {"findings": [finding.to_json() for finding in findings]}
    metadata = Metadata(control=tests.control, provenance=provenance, other=other)
    campaign = Campaign(tuple(tests.curves), sizes, tests.curves.values(), metadata=metadata, source=place)
    return check_campaign(campaign, file=place)


def _read_known(data: bytes, file: Path) -> Tests:
    if is_workbook(data):
        raise InputError("an Excel workbook has no known format", file=file, remedy=_HOW)
    if data.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return micromaterials.read_zip(data, file)
    kind = binary_kind(data)
    if kind is not None:
        problem = f"the file is {kind}; no reader knows it"
        raise InputError(problem, file=file, remedy="Export it from the instrument as text")
    lines = decode_lines(data)
    for matches, read in FORMATS.values():
        if matches(lines):
            return read(lines, file)
    raise InputError(f"the format is not known (known: {', '.join(FORMATS)})", file=file, remedy=_HOW)


def _read_by_one(data: bytes, file: Path, mappings: Sequence[MappingFile]) -> Tests:
    """The tests of a file by the one mapping that fits it; an error if two fit and read it differently."""
    fitting: list[tuple[MappingFile, Tests]] = []
    failed: list[InputError] = []
    for one in mappings:
        try:
            fitting.append((one, read_mapped(data, file, one)))
        except InputError as error:
            failed.append(error)
    if not fitting:
        more = "" if len(failed) == 1 else f" by {mappings[0].file.name}, and no other mapping file fits"
        raise failed[0].changed(problem=failed[0].problem + more)
    (chosen, tests), *others = fitting
    for other, again in others:
        if _content(again) != _content(tests):
            problem = f"{chosen.file.name} and {other.file.name} both fit this file and read it differently"
            raise InputError(problem, file=file, remedy="Give files of the two kinds in separate commands")
    return tests


def _content(tests: Tests) -> tuple[Any, ...]:
    """What two readings of a file must have in common."""
    readings = [(name, *(getattr(curve, c).tobytes() for c in CHANNELS)) for name, curve in tests.curves.items()]
    sizes = {name: size if isinstance(size, list) else None for name, size in tests.diameters_um.items()}
    return readings, sizes, tests.control


_SIZES = (
    "Give --diameters D1,D2,D3 in um for all, or --diameters FILE, a CSV or xlsx table with particle,D1_um,D2_um,D3_um"
)


def read_diameters(text: str | os.PathLike[str]) -> Diameters:
    """Diameters from the command line: three numbers for all particles, or a mapping from names to three numbers [um].

    `text` is `D1,D2,D3` in um, or the path of a table (CSV, with semicolons or tabs, or xlsx) with the columns
    `particle` (or `file`, `test`), `D1_um`, `D2_um`, `D3_um` (or other units of length). `InputError` if it is neither,
    or a diameter is not positive.
    """
    if not str(text).strip():
        raise InputError("--diameters is empty", remedy=_SIZES)
    path = arguments.file_path(text, "diameters")
    parts = str(text).split(",")
    if len(parts) == 3 and not os.path.isfile(path):  # noqa: PTH113  # Path's raises where a name is too long
        try:
            values = [parse_number(part) for part in parts]
        except ValueError as error:
            raise InputError(f"--diameters: {error}", remedy=_SIZES) from None
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
    `keys` holds, by the name of each test, the names under which a table may hold its diameters, the best first."""
    if diameters is not None and not isinstance(diameters, Mapping):
        return np.tile(arguments.one_particle(diameters), (len(keys), 1)), 0
    given = (diameters or {}).items()
    table = {same_text(name): arguments.one_particle(triple, f"diameters of {name!r}") for name, triple in given}
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
        raise InputError("instrument exports do not contain particle dimensions", file=file, remedy=_SIZES)
    problem = f"there are no diameters for {len(lacking)} of {len(keys)} tests: {names}"
    remedy = f"Add rows named like the tests or their files; the table has rows for: {first_few(map(repr, table), 8)}"
    raise InputError(problem, file=file, remedy=remedy)
