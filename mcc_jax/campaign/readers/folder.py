"""A folder of instrument files as one campaign.

All files in the folder itself are read, in the natural order of their names (2 before 10), but for those of
`passed_over` and those that the user leaves out. A test is called like its file without the ending; where a file holds
several tests, a hyphen and the test's own name follow.
"""

from __future__ import annotations

import hashlib
import re
import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from ..._errors import InputError
from ..._format import counted, first_few
from ..findings import Finding
from ..schema import Control
from ..tables import read_bytes, same_text
from .text import Tests

NO_DATA = frozenset(
    f".{ending}"
    for ending in "bmp db doc docx gif ini jpeg jpg lnk md odt pdf png ppt pptx py svg tif tiff toml".split()  # noqa: SIM905
)
"""Endings of pictures, documents and settings, in which no instrument writes samples."""
_READ_ME = re.compile(r"(read[-_ ]?me|licen[cs]e)(\..*)?", re.IGNORECASE)
# Longer lists (blocks of approach and drift) are not kept of many files: they would outgrow the curves.
LONGEST_LIST = 64
_SHOWN = 6


def names_of(file: Path) -> tuple[str, ...]:
    """The names under which a table may hold a file: with its ending, in capitals or not, and without."""
    return file.name, file.stem + file.suffix.lower(), file.stem + file.suffix.upper(), file.stem


def passed_over(name: str) -> bool:
    """Whether a file holds no tests by its name: hidden, a spreadsheet's lock, a README or licence, or of `NO_DATA`."""
    return name.startswith((".", "~$")) or _READ_ME.fullmatch(name) is not None or Path(name).suffix.lower() in NO_DATA


def natural(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts names as people do: digits by their number, letters without regard to case first."""
    parts = re.findall(r"[0-9]{1,18}|[^0-9]+", name)
    return [(0, int(p), "") if p[0] in "0123456789" else (1, 0, p.lower()) for p in parts] + [(2, 0, name)]


def read_folder(
    folder: Path, read: Callable[[Path, bytes], Tests], skip: Sequence[str]
) -> tuple[Tests, dict[str, tuple[str, ...]], list[Finding]]:
    """The tests of all files but those of `skip`, by name or a pattern with "*" and "?"; `read` reads one file.

    In addition by the name of each test the names under which a table may hold its diameters, and what was left out.
    Raises `InputError` if there is no file, a file cannot be read, two tests have one name, or `skip` fits no file.
    """
    files, findings = _files(folder, skip)
    found: dict[Path, Tests] = {}
    failed: dict[Path, InputError] = {}
    same: defaultdict[str, list[Path]] = defaultdict(list)
    for file in files:
        try:
            file.name.encode("utf-8")  # a name in another encoding than the system's cannot be written into a file
            data = read_bytes(file)
            found[file] = read(file, data)
            same[hashlib.sha256(data).hexdigest()].append(file)
        except UnicodeEncodeError:
            failed[file] = InputError("the file's name is no Unicode text", file=file, remedy="Rename it")
        except InputError as error:
            failed[file] = error
    if failed:
        error = next(iter(failed.values()))
        error = error.changed(problem=f"{error.problem} ({len(failed)} of {len(files)} files cannot be read)")
        raise error if len(failed) == len(files) else _or_leave_out(error, list(failed))
    for alike in same.values():
        if len(alike) > 1:
            sentence = f"{_listed(alike)} hold the same bytes, so one test counts {len(alike)} times"
            remedy = f"If it is one particle, leave it out with {_leave_out(alike[1:])}"
            findings.append(Finding("duplicates", "warning", sentence, remedy, tuple(same_text(f.stem) for f in alike)))
    form = f"{counted(len(files), 'file')}, {' and '.join(sorted({tests.format for tests in found.values()}))}"
    controls: set[Control | None] = {tests.control for tests in found.values()}
    # What the files say besides the curves: once if all say the same, else by file.
    each = {file.name: _short(tests.other) for file, tests in found.items()}
    first, *others = each.values()
    agree = all(said == first for said in others)
    other = first if agree else {"files": {name: said for name, said in each.items() if said}}
    whole = Tests({}, form, controls.pop() if len(controls) == 1 else None, other)
    own = Counter(name for tests in found.values() for name in tests.curves)
    keys: dict[str, tuple[str, ...]] = {}
    origin: dict[str, Path] = {}
    for file, tests in found.items():
        for name, curve in tests.curves.items():
            full = same_text(file.stem) if len(tests.curves) == 1 else f"{same_text(file.stem)}-{name}"
            if full in origin:
                problem = f"this file and {origin[full].name} both give a test the name {full!r}"
                raise _or_leave_out(InputError(problem, file=file, remedy="Rename one of them"), [file])
            whole.curves[full], origin[full] = curve, file
            keys[full] = (full, *names_of(file), *([name] if own[name] == 1 else []))
            if (size := tests.diameters_um.get(name)) is not None:
                whole.diameters_um[full] = size if isinstance(size, list) else _or_leave_out(size, [file])
            if name in tests.missing:
                whole.missing[full] = tests.missing[name]
    return whole, keys, findings


def _files(folder: Path, skip: Sequence[str]) -> tuple[list[Path], list[Finding]]:
    """The files of a folder to read, and what is left out."""
    try:
        entries = sorted(folder.iterdir(), key=lambda entry: natural(entry.name))
        inside = [entry for entry in entries if entry.is_dir()]
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise InputError(problem, file=folder, remedy="Check the permissions") from None
    if {"particles.csv", "curves.csv"} <= {entry.name for entry in entries}:
        raise InputError("is a campaign already", file=folder, remedy="Give the folder with the instrument files")
    files = [entry for entry in entries if entry not in inside]
    for pattern in skip:
        if not any(_fits(entry, pattern) for entry in files):
            problem = f"--leave-out {shlex.quote(pattern)} fits no file"
            raise InputError(problem, file=folder, remedy="Give a name as in the folder, or a pattern")
    quiet = [file for file in files if passed_over(file.name)]
    skipped = [file for file in files if file not in quiet and any(_fits(file, pattern) for pattern in skip)]
    files = [file for file in files if file not in (*quiet, *skipped)]
    if not files:
        below = f"; give one of the folders in it: {_listed(inside)}" if inside else ""
        raise InputError("there is no instrument file in the folder", file=folder, remedy=f"Check the path{below}")
    left_out = {
        f"{counted(len(quiet), 'file')} ignored because of the name: {_listed(quiet)}": quiet,
        f"{counted(len(inside), 'folder')} in it not entered: {_listed(inside)}": inside,
        f"{counted(len(skipped), 'file')} skipped as asked: {_listed(skipped)}": skipped,
    }
    return files, [Finding("files", "info", sentence) for sentence, some in left_out.items() if some]


def _fits(entry: Path, pattern: str) -> bool:
    name, stem, wanted = same_text(entry.name), same_text(entry.stem), same_text(pattern)
    return wanted in (name, stem) or fnmatchcase(name, wanted)


def _listed(files: Iterable[Path]) -> str:
    names = first_few((file.name for file in files), _SHOWN)
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in names)


def _leave_out(files: Iterable[Path]) -> str:
    """The options of the command that leave files out."""
    return " ".join(f"--leave-out {shlex.quote(file.name)}" for file in files)


def _or_leave_out(error: InputError, files: Sequence[Path]) -> InputError:
    """The same error, with the way to leave the files out."""
    options = _leave_out(files[:_SHOWN]) + (" ..." if len(files) > _SHOWN else "")
    return error.changed(remedy=f"{(error.remedy or 'Correct it').rstrip('.')}, or leave it out with {options}")


def _short(value: Any) -> Any:
    """What a file says, without long lists."""
    if not isinstance(value, dict):
        return value
    kept = {key: _short(item) for key, item in value.items()}
    return {k: v for k, v in kept.items() if v != {} and not (isinstance(v, list) and len(v) > LONGEST_LIST)}
