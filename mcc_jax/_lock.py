"""One run at a time in one folder."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import sys
from collections.abc import Iterator
from pathlib import Path

from ._errors import InputError

LOCK = ".mcc-jax.lock"


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Keep other runs out of a folder.

    The lock belongs to the open file, not to its existence: the system drops it when the process ends, however it
    ends, so a file that a killed run left behind locks nobody out.

    Args:
        directory: an existing folder.

    Raises:
        InputError: if another run holds the lock.
        OSError: if the folder cannot be written.
    """
    path = directory / LOCK
    handle = _acquire(path)
    try:
        os.truncate(handle, 0)
        os.write(handle, f"{os.getpid()}\n".encode())
        yield
    finally:
        if sys.platform == "win32":  # an open file cannot be removed there
            os.close(handle)
            with contextlib.suppress(OSError):
                path.unlink()
        else:
            with contextlib.suppress(OSError):
                path.unlink()
            os.close(handle)


def _acquire(path: Path) -> int:
    while True:
        # Whoever may write into the folder may have put a link there, or a pipe, for us to write through.
        handle = os.open(
            path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0), 0o666
        )
        with contextlib.ExitStack() as failing:
            failing.callback(os.close, handle)
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise InputError("is no regular file, and cannot lock the folder", file=path, remedy="Remove it")
            if not _try_lock(handle):
                raise _busy(handle, path.parent)
            # The run before may have removed the file between our opening and locking it.
            if path.exists() and os.path.samestat(os.fstat(handle), path.stat()):
                failing.pop_all()
                return handle


def _busy(handle: int, directory: Path) -> InputError:
    owner = os.pread(handle, 32, 0).decode("ascii", "replace").strip() if hasattr(os, "pread") else ""
    who = f"another mcc-jax run (process {owner})" if owner.isdigit() else "another mcc-jax run"
    return InputError(
        f"{who} is writing there", file=directory, remedy="Wait for it to end, or give --out another folder"
    )


def _try_lock(handle: int) -> bool:
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK):
            return False
        if error.errno in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
            return True  # a file system without locks: files are still replaced one by one, each whole
        raise
    return True
