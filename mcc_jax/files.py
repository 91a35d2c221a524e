"""Files from outside: regular files only, and none larger than its use can need.

Each limit is several times what the largest use that we can think of needs, and small enough for the memory.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from ._errors import InputError

TABLE_BYTES = 256 * 2**20  # `curves.csv` or an export: 7 million readings, 20 particles at 100 a second for an hour
SETTINGS_BYTES = 2**20  # a TOML file: the diameters of 20,000 tests
RESULT_BYTES = 16 * 2**20  # `calibration.json`, `discovery.json`: 1000 particles take half a MiB
POSTERIOR_BYTES = 4 * 2**30  # 4000 draws of 1000 particles with 100 compared points each are 3 GiB
UNPACKED_BYTES = 512 * 2**20  # what a zip archive of tests or a workbook unpacks to


def read_regular(path: str | os.PathLike[str], most_bytes: int, remedy: str) -> bytes:
    """The bytes of a regular file, to which links may lead.

    Raises `InputError` if there is none, it is no regular file, it cannot be read, or, with `remedy`, it is too large.
    """
    file = Path(path)
    try:
        found = file.stat()
        if stat.S_ISREG(found.st_mode) and found.st_size <= most_bytes:
            return file.read_bytes()
    except FileNotFoundError:
        raise InputError("there is no such file", file=file, remedy="Check the path") from None
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"cannot be read: {why}", file=file, remedy="Check the permissions and the path") from None
    if stat.S_ISDIR(found.st_mode):
        problem, remedy = "this is a folder where a file is expected", "Give a file"
    elif stat.S_ISREG(found.st_mode):
        size, most = found.st_size / 2**20, most_bytes / 2**20
        problem = f"the file is too large: {size:.4g} MiB, where at most {most:.4g} MiB are read"
    else:  # a pipe may never answer, a device never end
        problem, remedy = "this is no regular file", "Save what it delivers in a file and give that"
    raise InputError(problem, file=file, remedy=remedy)
