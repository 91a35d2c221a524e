"""Results appear in a folder whole or not at all, and one run at a time."""

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
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ._errors import InputError
from ._lock import locked
from .files import LIMITS, read_regular

WORK = ".mcc-jax-work-"
MOVES = "moves.json"
"""In the work folder, while its results are moved into place: which files, so that the next run can finish the job."""
_CANNOT_WRITE = (
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
    errno.ENOTDIR,
    errno.ENAMETOOLONG,
)


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
    are complete leaves the folder as it was; one killed while they are moved leaves the rest to the next run.

    Args:
        directory: the folder, made with its parents if need be.

    Raises:
        InputError: if the folder cannot be written, or another run is writing there.
    """
    made: list[Path] = []
    try:
        try:
            made = _make(directory)
            with locked(directory):
                work = _work_folder(directory)
                try:
                    stage = Stage(directory, work / "new")
                    stage.folder.mkdir()
                    yield stage
                    _place(stage, work)
                finally:
                    with _undisturbed():  # by the second Ctrl-C of somebody impatient
                        shutil.rmtree(work, ignore_errors=True)
        except OSError as error:
            # Making the folder can fail at a parent of it, writing at anything inside.
            place = "" if error.filename is None else str(error.filename)
            if (
                place and (place.startswith(str(directory)) or str(directory).startswith(place))
            ) or error.errno in _CANNOT_WRITE:
                raise _refusal(directory, error) from error
            raise
        except InputError as error:
            # Whoever wrote into the stage names it; the user knows only the folder.
            if error.file is not None and WORK in str(error.file):
                raise InputError(
                    error.problem, file=directory, row=error.row, column=error.column, remedy=error.remedy
                ) from error
            raise
    except BaseException:
        for folder in reversed(made):
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def _refusal(directory: Path, error: OSError) -> InputError:
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    why = error.strerror or str(error)
    if error.errno == errno.EISDIR and error.filename is not None:
        why = f"{Path(error.filename).name} there is a folder, where a file is to be written"
    remedy = "Make room and run again" if full else "Give --out a folder you may write to"
    return InputError(f"results cannot be written there: {why}", file=directory, remedy=remedy)


def _make(directory: Path) -> list[Path]:
    if directory.exists() and not directory.is_dir():
        raise InputError("is a file, not a folder", file=directory, remedy="Give --out another folder")
    missing = [directory, *directory.parents]
    missing = missing[: next((i for i, folder in enumerate(missing) if folder.exists()), len(missing))]
    made: list[Path] = []
    try:
        for folder in reversed(missing):
            folder.mkdir(exist_ok=True)
            made.append(folder)
    except OSError:
        for folder in reversed(made):
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise
    return made


def _work_folder(directory: Path) -> Path:
    for left_over in directory.glob(WORK + "*"):  # of runs that were killed: we hold the lock
        if (left_over / MOVES).exists():
            _finish(directory, left_over)
        shutil.rmtree(left_over, ignore_errors=True)
    # Inside the folder itself: the same file system for certain, even where the folder is a mount point.
    return Path(tempfile.mkdtemp(prefix=WORK, dir=directory))


def _finish(directory: Path, work: Path) -> None:
    """Move what a run had still to move when it was killed: all its results were complete."""
    try:
        moves = json.loads(read_regular(work / MOVES, LIMITS.result_bytes, ""))
        new, stale = ([str(name) for name in moves[key]] for key in ("new", "stale"))
    except (ValueError, KeyError, TypeError):  # not written by us, who make it whole
        return
    if any(Path(name).is_absolute() or ".." in Path(name).parts for name in new + stale):
        return
    for name in new:
        if (work / "new" / name).is_file():
            _make((directory / name).parent)
            (work / "new" / name).replace(directory / name)
    for name in stale:
        (directory / name).unlink(missing_ok=True)


def _place(stage: Stage, work: Path) -> None:
    """Move the files into the folder; if one cannot be moved, put all back as it was."""
    old = work / "old"
    names = [str(file.relative_to(stage.folder)) for file in sorted(stage.folder.rglob("*")) if file.is_file()]
    for name in names:
        _flush(stage.folder / name)
    stale = [name for name in stage.stale if name not in names and (stage.directory / name).is_file()]
    note = work / "note"
    note.write_text(json.dumps({"new": names, "stale": stale}))
    _flush(note)
    done: list[str] = []
    made: list[Path] = []
    with _undisturbed():
        try:
            note.replace(work / MOVES)
            for name in names:
                target = stage.directory / name
                made += _make(target.parent)
                _keep(target, old / name)
                done.append(name)
                (stage.folder / name).replace(target)
            for name in stale:
                target = stage.directory / name
                _keep(target, old / name)
                done.append(name)
                target.unlink()
        except BaseException:
            (work / MOVES).unlink(missing_ok=True)  # first: from here on nobody may finish this
            for name in reversed(done):
                if (old / name).exists():
                    (old / name).replace(stage.directory / name)
                else:
                    (stage.directory / name).unlink(missing_ok=True)
            for folder in reversed(made):
                with contextlib.suppress(OSError):
                    folder.rmdir()
            raise


def _flush(file: Path) -> None:
    """Onto the disk, where a full one shows at the latest."""
    with file.open("rb") as stream:
        os.fsync(stream.fileno())


def _keep(target: Path, copy: Path) -> None:
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target))
    if not target.exists():
        return
    copy.parent.mkdir(parents=True, exist_ok=True)
    try:
        copy.hardlink_to(target)
    except OSError:  # not every file system has hard links
        shutil.copy2(target, copy)


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


def json_text(content: Any) -> str:
    """Strict JSON with a newline at its end; numbers that are not finite become null."""
    return json.dumps(_strict(content), allow_nan=False, indent=2, ensure_ascii=False) + "\n"


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
