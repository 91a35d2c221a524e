"""Checksums of a campaign's files, by which a result knows its data again."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from .. import arguments
from ..files import LIMITS, open_regular
from .csv import CURVES, METADATA
from .curves import PARTICLES


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
        with open_regular(file, LIMITS.table_bytes, "Split the campaign into several folders") as stream:
            found[name] = hashlib.file_digest(stream, "sha256").hexdigest()
    return found
