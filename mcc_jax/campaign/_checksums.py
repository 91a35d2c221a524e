"""Checksums of a campaign's files, by which a result knows its data again."""

from __future__ import annotations

import hashlib
from pathlib import Path

from .. import arguments
from .._errors import InputError
from ._csv import CURVES, METADATA
from ._curves import PARTICLES


def file_checksums(folder: str | Path) -> dict[str, str]:
    """SHA-256 of `particles.csv`, `curves.csv` and `campaign.toml`, by name; of those that are there.

    Raises:
        InputError: if a file cannot be read.
    """
    path = arguments.file_path(folder, "folder")
    found = {}
    for name in (PARTICLES, CURVES, METADATA):
        file = path / name
        if not file.is_file():
            continue
        try:
            with file.open("rb") as stream:
                found[name] = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            raise InputError(
                f"cannot be read: {error.strerror or error}", file=file, remedy="Check the permissions"
            ) from None
    return found
