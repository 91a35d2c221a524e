"""Files appear whole or not at all: one of them, or all results in a folder, where one run writes at a time."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from ._errors import InputError
from .files import LIMITS, read_regular

WORK, LOCK = ".mcc-jax-work-", ".mcc-jax.lock"
MOVES = "moves.json"
"""In the work folder, while its results are moved into place: which files, so that the next run can finish the job."""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_CANNOT_WRITE = (*_FULL, errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO, errno.ENOTDIR, errno.ENAMETOOLONG)
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)


@dataclass
class Stage:
    """Where a run writes its results before they are moved into place.

    Attributes:
        directory: the folder of the results.
        folder: the folder to write into; what lies there at the end is moved to `directory`, subfolders included.
        stale: names, relative to `directory`, of files of an earlier run that this one replaces or drops.
    """

    directory: Path
    folder: Path
    stale: list[str] = field(default_factory=list)


@contextlib.contextmanager
def results(directory: Path) -> Iterator[Stage]:
    """A stage for results; they are moved into the folder if the body ends well.

    If it does not, or they cannot be moved, the folder is as it was, and folders made for it are gone. Only files that
    the run wrote, or named as stale, are touched. The folder is locked meanwhile. A process killed before the results
    are complete leaves the folder as it was; one killed while they are moved leaves the rest to the next run. Raises
    `InputError` if the folder cannot be written, or another run is writing there.

    Args:
        directory: the folder, made with its parents if need be.
    """
    made: list[Path] = []
    try:
        _make(directory, made)
        with _locked(directory):
            work = _work_folder(directory)
            try:
                stage = Stage(directory, work / "new")
                stage.folder.mkdir()
                yield stage
                _place(stage, work, made)
            finally:
                with _undisturbed():  # by the second Ctrl-C of somebody impatient
                    shutil.rmtree(work, ignore_errors=True)
    except BaseException as error:
        for folder in reversed(made):
            with contextlib.suppress(OSError):
                folder.rmdir()
        told = _told(directory, error)
        if told is error:
            raise
        raise told from error


def write_file(file: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write one file, in a folder that exists; it replaces an older one when it is complete and on the disk."""
    handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        Path(name).replace(file)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def json_text(content: Any) -> str:
    """Strict JSON with a newline at its end; numbers that are not finite become null."""
    return json.dumps(_strict(content), allow_nan=False, indent=2, ensure_ascii=False) + "\n"


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _told(directory: Path, error: BaseException) -> BaseException:
    """The error as the user is told it, who knows the folder but not the stage."""
    if isinstance(error, InputError) and error.file is not None and WORK in str(error.file):
        return InputError(error.problem, file=directory, row=error.row, column=error.column, remedy=error.remedy)
    if not isinstance(error, OSError) or isinstance(error, InputError):
        return error
    # Making the folder can fail at a parent of it, writing at anything inside.
    place = "" if error.filename is None else str(error.filename)
    ours = bool(place) and (place.startswith(str(directory)) or str(directory).startswith(place))
    if not ours and error.errno not in _CANNOT_WRITE:
        return error
    why = error.strerror or str(error)
    if error.errno == errno.EISDIR and place:
        why = f"{Path(place).name} there is a folder, where a file is to be written"
    remedy = "Make room and run again" if error.errno in _FULL else "Give a folder you may write to"
    return InputError(f"results cannot be written there: {why}", file=directory, remedy=remedy)


def _make(directory: Path, made: list[Path]) -> None:
    """Make a folder and its parents; those that were missing are appended to the list."""
    if directory.exists() and not directory.is_dir():
        raise InputError("is a file, not a folder", file=directory, remedy="Give another folder")
    for folder in (*reversed(directory.parents), directory):
        if not folder.exists():
            folder.mkdir(exist_ok=True)
            made.append(folder)


@contextlib.contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Keep other runs out of a folder; the system drops the lock when the process ends, however it ends."""
    from filelock import FileLock, Timeout

    file = directory / LOCK
    if file.is_symlink() or (file.exists() and not file.is_file()):
        raise InputError("is no regular file, and cannot lock the folder", file=file, remedy="Remove it")
    # It waits for a moment only, in which a run that ends removes its file.
    lock = FileLock(file, timeout=0.1, thread_local=False, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        owner = next((f.name[len(WORK) :].partition("-")[0] for f in directory.glob(WORK + "*")), "")
        who = f"another mcc-jax run (process {owner})" if owner.isdigit() else "another mcc-jax run"
        remedy = "Wait for it to end, or give another folder"
        raise InputError(f"{who} is writing there", file=directory, remedy=remedy) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:  # without locks files are still replaced one by one, each whole
            raise
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows removes no open file
            file.unlink()
        lock.release()


def _work_folder(directory: Path) -> Path:
    for left_over in directory.glob(WORK + "*"):  # of runs that were killed: we hold the lock
        new, stale = [], []
        # All results were complete where this file is; one that cannot be read is not of us, who make it whole.
        with contextlib.suppress(ValueError, KeyError, TypeError):
            moves = json.loads(read_regular(left_over / MOVES, LIMITS.result_bytes, ""))
            new, stale = ([str(name) for name in moves[key]] for key in ("new", "stale"))
        if not any(Path(name).is_absolute() or ".." in Path(name).parts for name in (*new, *stale)):
            _move(directory, left_over, new, stale)
        shutil.rmtree(left_over, ignore_errors=True)
    # Inside the folder itself: the same file system for certain, even where the folder is a mount point.
    return Path(tempfile.mkdtemp(prefix=f"{WORK}{os.getpid()}-", dir=directory))


def _move(directory: Path, work: Path, new: list[str], stale: list[str]) -> None:
    for name in new:
        if (work / "new" / name).is_file():
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            (work / "new" / name).replace(directory / name)
    for name in stale:
        (directory / name).unlink(missing_ok=True)


def _place(stage: Stage, work: Path, made: list[Path]) -> None:
    """Move the files into the folder; if one cannot be moved, put all back as it was."""
    new = [str(file.relative_to(stage.folder)) for file in sorted(stage.folder.rglob("*")) if file.is_file()]
    stale = [name for name in stage.stale if name not in new and (stage.directory / name).is_file()]
    for name in new:
        with (stage.folder / name).open("rb") as stream:
            os.fsync(stream.fileno())  # onto the disk, where a full one shows at the latest
        _make((stage.directory / name).parent, made)
    for name in (*new, *stale):
        target, copy = stage.directory / name, work / "old" / name
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target))
        if target.exists():
            copy.parent.mkdir(parents=True, exist_ok=True)
            try:
                copy.hardlink_to(target)
            except OSError:  # not every file system has hard links
                shutil.copy2(target, copy)
    with _undisturbed():
        try:
            write_file(work / MOVES, lambda stream: stream.write(json.dumps({"new": new, "stale": stale}).encode()))
            _move(stage.directory, work, new, stale)
        except BaseException:
            (work / MOVES).unlink(missing_ok=True)  # first: from here on nobody may finish this
            for name in (*new, *stale):
                if (work / "old" / name).exists():
                    (work / "old" / name).replace(stage.directory / name)
                else:
                    (stage.directory / name).unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Without interruption by Ctrl-C; for moments only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
