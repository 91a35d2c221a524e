"""Files and texts from outside: regular files only, bounded in size before a byte is read.

A path that a user gives, or that a folder of tests holds, may be a pipe that never answers, a device that never ends,
or a file that fills the memory. Every reader of this package opens its files here, and refuses such a one in one line.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING

from ._errors import InputError

if TYPE_CHECKING:
    import numpy as np

_KINDS = (
    (stat.S_ISDIR, "this is a folder where a file is expected", "Give a file"),
    (stat.S_ISFIFO, "this is a pipe (FIFO), not a file", "Save what it delivers in a file and give that"),
    (stat.S_ISCHR, "this is a device, not a file", "Give a file"),
    (stat.S_ISBLK, "this is a device, not a file", "Give a file"),
    (stat.S_ISSOCK, "this is a socket, not a file", "Give a file"),
)
_CHUNK = 2**24
"""Bytes read at once [bytes]; a table with an endless row is refused after one or two of these."""


@dataclass(frozen=True)
class FileLimits:
    """How large a file may be; what is larger is refused before it fills the memory.

    No figure stands in a norm: each is several times what the largest use we can think of needs, and small enough for
    the reader to end in time (measured: reading a table takes 0.05 s and 9 MiB of memory for each MiB, checking JSON
    against its schema 0.3 s for each MiB).

    Attributes:
        table_bytes: of `curves.csv`, `particles.csv` or a tester's export [bytes]. 256 MiB are 7 million readings: 20
            particles, each measured 100 times a second for an hour.
        line_bytes: of one row of a table [bytes]. A spreadsheet holds 16,384 columns; with 64 bytes each that is 1 MiB.
        cell_bytes: of one cell of a table [bytes]; also of one word in a tester's text. Names and numbers have less
            than a hundred characters.
        settings_bytes: of a TOML file (campaign, mapping, priors, programme) [bytes]. 1 MiB holds the diameters of
            20,000 tests.
        settings_depth: of keys with dots, and of lists and tables within each other, in a TOML file. The deepest file
            of ours needs 3.
        result_bytes: of `calibration.json` and `discovery.json` [bytes]. 1000 particles take half a MiB.
        unpacked_bytes: that a zip archive of tests or a workbook may unpack to [bytes].
        archive_files: in a zip archive of tests.
        swelling: how many times its size an archive of tests may unpack to: measured numbers as text deflate to a fifth
            or so; what shrinks to a hundredth is no measurement.
        sheet_cells: of a sheet's rectangle, empty ones included, since the engine makes room for all (32 bytes each): a
            full sheet of 1,048,576 rows has 38 columns then; a cell alone in the last row and column asks for 17e9.
        posterior_bytes: of `posterior.nc` or a saved state of many particles [bytes]. 4000 draws of 1000 particles
            with 100 compared points each are 3 GiB.
    """

    table_bytes: int = 256 * 2**20
    line_bytes: int = 2**20
    cell_bytes: int = 2**16
    settings_bytes: int = 2**20
    settings_depth: int = 32
    result_bytes: int = 16 * 2**20
    unpacked_bytes: int = 512 * 2**20
    archive_files: int = 10_000
    swelling: int = 100
    sheet_cells: int = 40_000_000
    posterior_bytes: int = 4 * 2**30


LIMITS = FileLimits()
"""The limits that every reader uses unless it is given others."""


@contextlib.contextmanager
def open_regular(path: str | os.PathLike[str], most_bytes: int, remedy: str) -> Iterator[BufferedReader]:
    """Open a regular file for reading bytes; anything else is refused by name without being opened.

    Raises `InputError` if there is none, it is no regular file, it is too large, or it cannot be opened.

    Args:
        path: the file; links are followed.
        most_bytes: the largest size allowed [bytes].
        remedy: what to do about a file that is larger.

    Yields:
        The open file.
    """
    file = Path(path)
    handle = -1
    try:
        _refuse_other_kinds(file.stat(), file)
        # It may have been replaced since: a pipe opened this way does not wait for its other end, and is then refused.
        flags = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
        handle = os.open(file, flags)
        found = os.fstat(handle)
        _refuse_other_kinds(found, file)
        _refuse_size(found.st_size, most_bytes, file, remedy)
    except (OSError, ValueError) as error:
        if handle >= 0:
            os.close(handle)
        if isinstance(error, InputError):
            raise
        raise _cannot(error, file) from None
    with os.fdopen(handle, "rb") as stream:
        try:
            yield stream
        except OSError as error:
            raise _cannot(error, file) from None


def read_regular(path: str | os.PathLike[str], most_bytes: int, remedy: str) -> bytes:
    """The bytes of a regular file; see `open_regular` for what is refused."""
    return b"".join(_chunks(path, most_bytes, remedy))


def read_table_bytes(path: str | os.PathLike[str], limits: FileLimits = LIMITS) -> bytes:
    """The bytes of a text table or a tester's export, refused at the first row or cell that is too long.

    What begins as no text does (a zip archive, for instance) is bounded in its size alone. Raises `InputError` if it
    cannot be read, or is too large as a whole or in one row or cell.
    """
    file = Path(path)
    parts: list[bytes] = []
    lines = _Lines(file, limits)
    for chunk in _chunks(file, limits.table_bytes, "Split it into several, or thin its readings"):
        parts.append(chunk)
        if not parts[0].startswith((b"PK", b"\x1f\x8b")) and b"\0" not in parts[0][:4096]:
            lines.check(chunk)
    return b"".join(parts)


def _chunks(path: str | os.PathLike[str], most_bytes: int, remedy: str) -> Iterator[bytes]:
    with open_regular(path, most_bytes, remedy) as stream:
        size = 0
        while chunk := stream.read(_CHUNK):
            size += len(chunk)
            # A file may grow meanwhile, and those of the system say that they hold nothing.
            _refuse_size(size, most_bytes, Path(path), remedy)
            yield chunk


class _Lines:
    """Follows a table through its chunks and refuses the first row or cell that is too long."""

    def __init__(self, file: Path, limits: FileLimits) -> None:
        self.file, self.limits = file, limits
        self.row, self.in_row, self.in_cell = 1, 0, 0  # the row at the end of what was seen, and how long it is so far

    def check(self, chunk: bytes) -> None:
        import numpy as np  # here, since the command opens files before it needs any number

        data = np.frombuffer(chunk, np.uint8)
        ends = np.flatnonzero((data == ord("\n")) | (data == ord("\r")))
        self.in_row = self._longest(ends, len(data), self.in_row, self.limits.line_bytes, "row", ends)
        breaks = np.flatnonzero(np.isin(data, list(BREAKS)))
        self.in_cell = self._longest(breaks, len(data), self.in_cell, self.limits.cell_bytes, "cell", ends)
        self.row += chunk.count(b"\n") or chunk.count(b"\r")

    def _longest(self, at: np.ndarray, length: int, before: int, most: int, what: str, ends: np.ndarray) -> int:
        import numpy as np

        lengths = np.diff(at, prepend=-1 - before, append=length) - 1
        if lengths.max() > most:
            where = int(np.searchsorted(ends, np.append(at, length)[int(np.argmax(lengths > most))]))
            remedy = "The file is damaged, or is no table of measurements; export it again"
            problem = f"a {what} here has more than {most:,} bytes"
            raise InputError(problem, file=self.file, row=self.row + where, remedy=remedy)
        return int(lengths[-1])


BREAKS = b"\n\r,;\t| "
"""What may end a cell."""


def check_toml(text: str, file: str | Path, limits: FileLimits = LIMITS) -> None:
    """Refuse TOML whose keys or lists are nested so deep that parsing them takes gigabytes.

    The work of Python's parser goes with the square of the number of parts of a key. Text and comments are passed over;
    what is no TOML otherwise is left for the parser to refuse. Raises `InputError` naming the line.
    """
    most = limits.settings_depth
    depth = dots = at = 0
    while found := _TOKEN.search(text, at):
        token, at = found[0], found.end()
        if token in _TEXT_ENDS:
            end = _TEXT_ENDS[token].search(text, at)
            if end is None:
                return
            at = end.end()
        elif token == ".":
            dots += 1
        elif token in "[{":
            depth, dots = depth + 1, 0
        elif token in "]}":
            depth, dots = depth - 1, 0
        else:
            dots = 0
        if depth > most or dots >= most:
            remedy, row = "Write flat keys; no setting needs more than three levels", text.count("\n", 0, at) + 1
            raise InputError(f"keys or lists are nested more than {most} deep", file=file, row=row, remedy=remedy)


_TOKEN = re.compile(r'"""|\'\'\'|["\'#.\[\]{}=,\n]')
# Text in double quotes ends where it must, closed or not: a pattern that fails is tried again from every character.
_TEXT_ENDS = {
    '"""': re.compile(r'(?:[^"\\]|\\[\s\S]|"(?!""))*+(?:"""|\\|\Z)'),
    "'''": re.compile(r"'''"),
    '"': re.compile(r'(?:[^"\\\n]|\\.)*+(?:["\n\\]|\Z)'),
    "'": re.compile(r"['\n]"),
    "#": re.compile(r"(?=\n)|\Z"),
}


def _refuse_other_kinds(found: os.stat_result, file: Path) -> None:
    for is_kind, problem, remedy in _KINDS:
        if is_kind(found.st_mode):
            raise InputError(problem, file=file, remedy=remedy)


def _refuse_size(size: int, most: int, file: Path, remedy: str) -> None:
    if size > most:
        problem = f"the file is too large: {_in_words(size)}, where at most {_in_words(most)} are read"
        raise InputError(problem, file=file, remedy=remedy)


def _in_words(size: int) -> str:
    for unit, name in ((2**30, "GiB"), (2**20, "MiB"), (2**10, "KiB")):
        if size >= unit:
            return f"{size / unit:.4g} {name}"
    return f"{size} bytes"


def _cannot(error: OSError | ValueError, file: Path) -> InputError:
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.ENOENT and file.is_symlink():
        return InputError("this is a link to a file that is not there", file=file, remedy="Give the file itself")
    if number == errno.ENOENT:
        return InputError("there is no such file", file=file, remedy="Check the path")
    if number == errno.ELOOP:
        return InputError("this is a link that leads back to itself", file=file, remedy="Give the file itself")
    why = (isinstance(error, OSError) and error.strerror) or str(error)
    return InputError(f"cannot be read: {why}", file=file, remedy="Check the permissions and the path")
