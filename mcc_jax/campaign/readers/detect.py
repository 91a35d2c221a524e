"""Telling testers' files apart by what is in them."""

from __future__ import annotations

from pathlib import Path

from ..._errors import InputError
from ..table import binary_kind
from ..workbook import is_workbook
from . import fischer, hysitron_hld, hysitron_lc, micromaterials
from .text import Tests, decode_lines

FORMATS = (
    "Fischer HM export",
    "Hysitron hld",
    "Hysitron load-control text",
    "Micro Materials text (also many in one zip)",
)
_EXAMPLE = (
    'decimal_mark = "."; [columns] time = { column = "Time", unit = "s" }, '
    'force = { column = "Load", unit = "mN" }, displacement = { column = "Depth", unit = "um" }'
)


def read_known(data: bytes, file: Path) -> Tests:
    """Read a file of a known format.

    Args:
        data: the file's bytes.
        file: its path, for names and messages.

    Raises:
        InputError: if the format is unknown or the file is damaged.
    """
    if is_workbook(data):
        raise InputError(
            "an Excel workbook has no format of its own",
            file=file,
            remedy=f"Write a TOML mapping file and give it with --mapping; for example {_EXAMPLE}",
        )
    if data.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return micromaterials.read_zip(data, file)
    kind = binary_kind(data)
    if kind is not None:
        raise InputError(
            f"the file is {kind}; no reader knows it", file=file, remedy="Export it from the tester as text"
        )
    lines = decode_lines(data)
    for reader in (hysitron_hld, hysitron_lc, fischer, micromaterials):
        if reader.matches(lines):
            return reader.read(lines, file)
    raise InputError(
        f"the format is not known (known: {', '.join(FORMATS)})",
        file=file,
        remedy=f"Write a TOML mapping file and give it with --mapping; for example {_EXAMPLE}",
    )
