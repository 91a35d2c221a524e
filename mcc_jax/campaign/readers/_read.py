"""One entry for all testers' files, alone or in a folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ..._errors import InputError
from ...files import LIMITS, FileLimits
from .._schema import Campaign, Metadata
from .._table import read_bytes
from .._validate import check_campaign
from ..findings import Finding
from ._detect import read_known
from ._diameters import Diameters, diameters_for
from ._mapped import read_mapped
from ._mapping import read_mapping
from ._text import Tests
from .folder import names_of, read_folder


def read_tester_file(
    path: str | os.PathLike[str],
    *,
    diameters_um: Diameters | None = None,
    mapping: str | os.PathLike[str] | None = None,
    skip: Sequence[str] = (),
    limits: FileLimits = LIMITS,
) -> Campaign:
    """A tester's export, or a folder of exports, as a campaign; the format is told by the content, not by the name.

    Only units are converted (to mN, um, s) and, where a mapping says so, signs; nothing is shifted, smoothed,
    cut or corrected. What the file says besides the curves is kept in `Metadata.other`; what was left out on the
    user's word (rows with missing readings, files) stands there under "conversion".

    Args:
        path: the file: Fischer HM, Hysitron hld, Hysitron load-control text, Micro Materials text or zip, or
            anything that a mapping file describes; or a folder of such files, see `readers.folder`.
        diameters_um: D1, D2, D3 [um] for all tests, or a mapping from tests, or names of files, to such triples; see
            `read_diameters`. It counts before what the mapping or the files say.
        mapping: a TOML file that describes the table; see `mcc_jax.campaign.readers._mapping`.
        skip: names of files in the folder that are left out; may hold "*", "?".
        limits: how large a file may be.

    Returns:
        The campaign; particles have the tests' names.

    Raises:
        InputError: if the file is unknown or damaged, or diameters are missing.
    """
    place = Path(path)
    described = None if mapping is None else read_mapping(mapping)

    def read(file: Path, data: bytes) -> Tests:
        return read_known(data, file) if described is None else read_mapped(data, file, described)

    findings: list[Finding] = []
    if place.is_dir():
        if described is not None and described.test_name is not None:
            raise InputError(
                "is for one file, not for a folder", file=described.file, column="test_name", remedy="Remove it"
            )
        tests, keys, findings = read_folder(place, read, skip, limits)
        origin = f"folder {place.resolve().name}, {tests.format}"
    else:
        if skip:
            raise InputError("is a file, so there is nothing to skip", file=place, remedy="Give --skip with a folder")
        tests = read(place, read_bytes(place, limits))
        alone = names_of(place) if len(tests.curves) == 1 else ()
        keys = {name: (name, *alone) for name in tests.curves}
        origin = f"{place.name}, {tests.format}"
    if diameters_um is None and described is not None:
        diameters_um = described.diameters_um
    sizes, unused = diameters_for(keys, diameters_um, tests.diameters_um, place)
    findings += [*_missing(tests.missing), *_unused(unused)]
    other = dict(tests.other)
    if findings:
        other["conversion"] = {"findings": [finding.to_json() for finding in findings]}
    provenance = "; ".join([f"{origin}, read by mcc_jax", *(f.sentence for f in findings if f.check != "diameters")])
    campaign = Campaign(
        particles=tuple(tests.curves),
        diameters_um=sizes,
        curves=tuple(tests.curves.values()),
        metadata=Metadata(control=tests.control, provenance=provenance, other=other),
        source=str(place),
    )
    check_campaign(campaign, file=place)
    return campaign


def _missing(missing: dict[str, int]) -> list[Finding]:
    if not missing:
        return []
    total = sum(missing.values())
    rows = "1 row with a missing reading was" if total == 1 else f"{total} rows with a missing reading were"
    where = "1 test" if len(missing) == 1 else f"{len(missing)} tests"
    return [Finding("missing readings", "told", f"{rows} dropped, in {where}", "", tuple(missing))]


def _unused(unused: int) -> list[Finding]:
    if not unused:
        return []
    rows = "1 row of the diameters is" if unused == 1 else f"{unused} rows of the diameters are"
    return [Finding("diameters", "told", f"{rows} for no test here and not used")]
