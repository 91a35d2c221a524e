"""Micro Materials export: text files without a header, columns t[s], h[nm], F[mN]; often many in one zip archive.

Each file is one test, named by the file. The first samples, at time 0 and with a negative depth, are the approach.
"""

from __future__ import annotations

import io
import re
import zipfile
from pathlib import Path

from ..._errors import InputError
from ...files import UNPACKED_BYTES
from ..schema import Curve
from ..tables import filled
from .text import Tests, checked_curve, decode_lines, number_block

_ROW = re.compile(r"-?\d+\.\d{6}\t-?\d+\.\d{6}\t-?\d+\.\d{6}\s*")


def matches(lines: list[str]) -> bool:
    """Whether this is one such test: three columns, six decimals, from the first row on."""
    begin = [line for line in lines[:50] if line.strip()]
    return len(begin) >= 2 and all(_ROW.fullmatch(line) for line in begin[:-1])


def read(lines: list[str], file: Path) -> Tests:
    """One text file. Raises `InputError` if a row is damaged."""
    at = range(filled(lines))
    block = number_block(lines, at, ("t", "h", "F"), file)
    curve = checked_curve(block["t"], block["F"], block["h"] / 1e3, file, at, file.stem)
    return Tests({file.stem: curve}, "Micro Materials text")


def read_zip(data: bytes, file: Path) -> Tests:
    """An archive of such files. Raises `InputError` if it or a file in it is damaged, too large or no such test."""
    curves: dict[str, Curve] = {}
    for path, content in _entries(data, file):
        inside, lines = Path(f"{file}", path), decode_lines(content)
        if not matches(lines):
            problem = "is no Micro Materials text (three columns t, h, F with six decimals)"
            remedy = "Remove it from the archive, or unpack it and write a mapping file"
            raise InputError(problem, file=inside, remedy=remedy)
        if inside.stem in curves:
            raise InputError(f"two tests are called {inside.stem!r}", file=inside, remedy="Rename one of them")
        curves |= read(lines, inside).curves
    if not curves:
        raise InputError("the archive holds no file", file=file, remedy="Export it again")
    return Tests(curves, "Micro Materials archive")


def _entries(data: bytes, file: Path) -> list[tuple[str, bytes]]:
    """Names and contents of an archive's files."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            if sum(entry.file_size for entry in entries) <= UNPACKED_BYTES:
                return [(entry.filename, archive.read(entry)) for entry in entries]
    except Exception:  # zipfile and what unpacks have no common kind of error
        problem, remedy = "the archive is damaged or encrypted", "Unpack it, or export it again"
        raise InputError(problem, file=file, remedy=remedy) from None
    raise InputError("the archive is too large for an instrument's export", file=file, remedy="Split it")
