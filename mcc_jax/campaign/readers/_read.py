"""One entry for all testers' files."""

from __future__ import annotations

import os

from ... import arguments
from .._schema import Campaign, Metadata
from .._table import read_bytes
from .._validate import check_campaign
from ._detect import read_known
from ._diameters import Diameters, diameters_for
from ._mapped import read_mapped
from ._mapping import read_mapping


def read_tester_file(
    path: str | os.PathLike[str],
    *,
    diameters_um: Diameters | None = None,
    mapping: str | os.PathLike[str] | None = None,
) -> Campaign:
    """A tester's export as a campaign; the format is told by the content, not by the file's name.

    Only units are converted (to mN, um, s) and, where a mapping says so, signs; nothing is shifted, smoothed,
    cut or corrected. What the file says besides the curves is kept in `Metadata.other`.

    Args:
        path: the file: Fischer HM, Hysitron hld, Hysitron load-control text, Micro Materials text or zip, or
            anything that a mapping file describes.
        diameters_um: D1, D2, D3 [um] for all tests, or a mapping from tests to such triples; see `read_diameters`.
        mapping: a TOML file that describes the table; see `mcc_jax.campaign.readers._mapping`.

    Returns:
        The campaign; particles have the tests' names.

    Raises:
        InputError: if the file is unknown or damaged, or diameters are missing.
    """
    file = arguments.file_path(path, "path")
    data = read_bytes(file)
    if mapping is None:
        tests = read_known(data, file)
    else:
        described = read_mapping(mapping)
        tests = read_mapped(data, file, described)
        diameters_um = described.diameters_um if diameters_um is None else diameters_um
    names = tuple(tests.curves)
    campaign = Campaign(
        particles=names,
        diameters_um=diameters_for(names, diameters_um, file),
        curves=tuple(tests.curves.values()),
        metadata=Metadata(
            control=tests.control, provenance=f"{file.name}, {tests.format}, read by mcc_jax", other=tests.other
        ),
        source=str(file),
    )
    check_campaign(campaign, file=file)
    return campaign
