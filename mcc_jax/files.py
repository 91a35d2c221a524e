"""Files from outside: regular files only, and none larger than its use can need.

Each limit is several times what the largest use that we can think of needs, and small enough for the reader to end in
time: what is larger is refused before it fills the memory.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

from ._errors import InputError

TABLE_BYTES = 256 * 2**20  # `curves.csv` or an export: 7 million readings, 20 particles at 100 a second for an hour
SETTINGS_BYTES = 2**20  # a TOML file: the diameters of 20,000 tests
RESULT_BYTES = 16 * 2**20  # `calibration.json`, `discovery.json`: 1000 particles take half a MiB
POSTERIOR_BYTES = 4 * 2**30  # 4000 draws of 1000 particles with 100 compared points each are 3 GiB
CHUNK = 2**20
UNPACKED_BYTES = 512 * 2**20  # what a zip archive of tests or a workbook unpacks to


@contextlib.contextmanager
def open_regular(path: str | os.PathLike[str], most_bytes: int, remedy: str) -> Iterator[BufferedReader]:
    """Open a regular file for reading bytes.

    Raises `InputError` if there is none, it is no regular file, it is too large, or it cannot be read.

    Args:
        path: the file; links are followed.
        most_bytes: the largest size allowed [bytes].
        remedy: what to do about a file that is larger.

    Yields:
        The open file.
    """
    file = Path(path)
    try:
        found = file.stat()
        if stat.S_ISREG(found.st_mode):
            _refuse_size(found.st_size, most_bytes, file, remedy)
            stream = file.open("rb")
        elif stat.S_ISDIR(found.st_mode):
            raise InputError("this is a folder where a file is expected", file=file, remedy="Give a file")
        else:  # a pipe may never answer, a device never end
            way = "Save what it delivers in a file and give that"
            raise InputError("this is no regular file", file=file, remedy=way)
    except (OSError, ValueError) as error:
        raise _cannot(error, file) from None
    with stream:
        try:
            yield stream
        except OSError as error:
            raise _cannot(error, file) from None


def read_regular(path: str | os.PathLike[str], most_bytes: int, remedy: str) -> bytes:
    """The bytes of a regular file; see `open_regular` for what is refused."""
    chunks, size = [], 0
    with open_regular(path, most_bytes, remedy) as stream:
        while chunk := stream.read(CHUNK):  # all at once, the limit itself would be allocated
            size += len(chunk)
            _refuse_size(size, most_bytes, Path(path), remedy)  # it may grow meanwhile
            chunks.append(chunk)
    return b"".join(chunks)


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
    if isinstance(error, InputError):
        return error
    if isinstance(error, OSError) and error.errno == errno.ENOENT:
        return InputError("there is no such file", file=file, remedy="Check the path")
    why = (isinstance(error, OSError) and error.strerror) or str(error)
    return InputError(f"cannot be read: {why}", file=file, remedy="Check the permissions and the path")
