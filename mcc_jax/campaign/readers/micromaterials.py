"""Micro Materials export: text files without a header, columns t[s], h[nm], F[mN]; often many in one zip archive.

Each file is one test, named by the file. The first samples, at time 0 and with a negative depth, are the approach.
Archives are read in memory, and only so far as a tester's export can reach.
"""

from __future__ import annotations

import io
import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from ..._errors import InputError
from ...files import LIMITS
from ..schema import Curve
from ..table import filled
from .text import Tests, checked_curve, decode_lines, number_block

_ROW = re.compile(r"-?\d+\.\d{6}\t-?\d+\.\d{6}\t-?\d+\.\d{6}\s*")
_NAMES = ("t", "h", "F")
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def matches(lines: list[str]) -> bool:
    """Whether this is one such test: three columns, six decimals, from the first row on."""
    begin = [line for line in lines[:50] if line.strip()]
    return len(begin) >= 2 and all(_ROW.fullmatch(line) for line in begin[:-1])


def read(lines: list[str], file: Path) -> Tests:
    """One text file. Raises `InputError` if a row is damaged."""
    return Tests({file.stem: _curve(lines, file, file.stem)}, "Micro Materials text")


def read_zip(data: bytes, file: Path) -> Tests:
    """An archive of text files, one test each.

    Raises `InputError` if the archive or a file in it is damaged, encrypted, nested, too large or no such test.
    """
    curves: dict[str, Curve] = {}
    for path, content in _entries(data, file):
        inside = Path(f"{file}") / path
        name = PurePosixPath(path).stem
        lines = decode_lines(content)
        if not matches(lines):
            problem = "is no Micro Materials text (three columns t, h, F with six decimals)"
            remedy = "Remove it from the archive, or unpack it and write a mapping file"
            raise InputError(problem, file=inside, remedy=remedy)
        if name in curves:
            raise InputError(f"two tests are called {name!r}", file=inside, remedy="Rename one of them")
        curves[name] = _curve(lines, inside, name)
    if not curves:
        raise InputError("the archive holds no file", file=file, remedy="Export it again")
    return Tests(curves, "Micro Materials archive")


def _curve(lines: list[str], file: Path, name: str) -> Curve:
    end = filled(lines)
    numbers = number_block(lines, 0, end, _NAMES, file)
    return checked_curve(numbers[:, 0], numbers[:, 2], numbers[:, 1] / 1e3, file, 1, name)


def _entries(data: bytes, file: Path) -> Iterator[tuple[str, bytes]]:
    broken = InputError("the archive is damaged", file=file, remedy="Export it again")
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError, EOFError):
        raise broken from None
    with archive:
        whole = sum(entry.file_size for entry in entries)
        most = min(LIMITS.unpacked_bytes, LIMITS.swelling * max(len(data), 10_000))
        if len(entries) > LIMITS.archive_files or whole > most:
            raise InputError("the archive is too large for a tester's export", file=file, remedy="Split it")
        total = 0
        for entry in entries:
            if entry.flag_bits & 0x1:
                raise InputError(f"the entry {entry.filename!r} is encrypted", file=file, remedy="Unpack it first")
            if entry.compress_type not in _METHODS:  # others may ask for gigabytes before the first byte
                problem = f"the entry {entry.filename!r} is compressed in an unusual way"
                raise InputError(problem, file=file, remedy="Unpack it first")
            try:
                # The size in the directory may lie; no more than it says is unpacked.
                with archive.open(entry) as stream:
                    content = stream.read(entry.file_size + 1)
            except (zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, RuntimeError):
                raise broken from None
            total += len(content)
            if len(content) > entry.file_size or total > LIMITS.unpacked_bytes:
                raise broken
            if content.startswith((b"PK\x03\x04", b"\x1f\x8b")):
                problem = f"the entry {entry.filename!r} is itself an archive"
                raise InputError(problem, file=file, remedy="Unpack it first")
            yield entry.filename, content
