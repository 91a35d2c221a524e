"""Files appear whole or not at all: one of them, or all results in a folder, where one run writes at a time."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ._errors import InputError

WORK, READY, LOCK = ".mcc-jax-work", ".mcc-jax-ready", ".mcc-jax.lock"
"""Within the folder of the results: those being written, those that are complete and only have to be moved into place,
and the file that a run locks."""
STALE = ".stale.json"  # among those that are ready: the list of files to drop
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_CANNOT_WRITE = (
    *_FULL, errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG
)  # fmt: skip
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)


@dataclass
class Stage:
    """Where a run writes its results before they are moved into place."""

    directory: Path  # of the results
    folder: Path  # to write into; its files are moved to `directory` at the end, subfolders included
    stale: list[str] = field(default_factory=list)  # names of files of an earlier run that this one replaces or drops


@contextlib.contextmanager
def results(directory: Path) -> Iterator[Stage]:
    """A stage for results, which are moved into the folder if the body ends well; else the folder stays as it was.

    The folder, made with its parents if need be, is locked meanwhile. The stage is renamed when it is complete: a
    process killed before leaves the old results, and after one that is killed later the next run in this folder moves
    what is left of the new ones. Raises `InputError` if the folder cannot be written, or another run is writing there.
    """
    made = [folder for folder in (directory, *directory.parents) if not folder.exists()]
    try:
        if directory.exists() and not directory.is_dir():
            raise InputError("is a file, not a folder", file=directory, remedy="Give another folder")  # noqa: TRY301
        directory.mkdir(parents=True, exist_ok=True)
        with _locked(directory):
            _finish(directory)
            # Inside the folder itself: the same file system for certain, even where the folder is a mount point.
            stage = Stage(directory, directory / WORK)
            stage.folder.mkdir()
            try:
                yield stage
                _complete(stage)
                _finish(directory)
            finally:
                shutil.rmtree(stage.folder, ignore_errors=True)
    except BaseException as error:
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()
        reported = _as_input_error(directory, error)
        if reported is error:
            raise
        raise reported from error


def _complete(stage: Stage) -> None:
    """Make the stage ready to be moved, at once, when all of it is on the disk."""
    stale = [name for name in stage.stale if not (stage.folder / name).exists()]
    (stage.folder / STALE).write_text(json.dumps(stale), encoding="utf-8")
    for file in stage.folder.rglob("*"):
        target = stage.directory / file.relative_to(stage.folder)
        if target.exists() and target.is_dir() != file.is_dir():
            number = errno.EISDIR if target.is_dir() else errno.ENOTDIR
            raise OSError(number, os.strerror(number), str(target))
        if file.is_file():
            with file.open("rb") as stream:
                os.fsync(stream.fileno())  # a full disk shows here at the latest
    stage.folder.replace(stage.directory / READY)


def _finish(directory: Path) -> None:
    """Move results that are ready into place, and remove what killed runs left behind; the folder is locked."""
    ready = directory / READY
    if (ready / STALE).is_file():
        for file in sorted(ready.rglob("*")):
            target = directory / file.relative_to(ready)
            if file.is_dir():
                target.mkdir(exist_ok=True)
            elif file.name != STALE:
                file.replace(target)
        for name in json.loads((ready / STALE).read_text(encoding="utf-8")):
            (directory / name).unlink(missing_ok=True)
    for left_over in (ready, directory / WORK):
        shutil.rmtree(left_over, ignore_errors=True)


@contextlib.contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Keep other runs out of a folder; the system drops the lock when the process ends, however it ends."""
    from filelock import FileLock, Timeout

    # It waits for a moment only, in which a run that ends removes its file.
    lock = FileLock(directory / LOCK, timeout=0.1, thread_local=False, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        remedy = "Wait for it to end, or give another folder"
        raise InputError("another mcc-jax run is writing there", file=directory, remedy=remedy) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:  # without locks files are still replaced one by one, each whole
            raise
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows removes no open file
            (directory / LOCK).unlink()
        lock.release()


def _as_input_error(directory: Path, error: BaseException) -> BaseException:
    """The error in terms of the folder that the user gave."""
    if isinstance(error, InputError):
        return error.changed(file=directory) if WORK in str(error.file) else error
    if not isinstance(error, OSError):
        return error
    if error.errno not in _CANNOT_WRITE and Path(str(error.filename)) not in (directory, *directory.parents):
        return error
    why = error.strerror or str(error)
    if error.errno == errno.EISDIR:
        why = f"{Path(str(error.filename)).name} there is a folder, where a file is to be written"
    remedy = "Free some disk space and run again" if error.errno in _FULL else "Give a folder you may write to"
    return InputError(f"results cannot be written there: {why}", file=directory, remedy=remedy)


def write_file(file: Path, content: bytes) -> None:
    """Write one file, in a folder that exists; it replaces an older one when it is complete and on the disk."""
    handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
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
