"""A folder of instrument files as one campaign.

Which files are read: all that lie in the folder itself, in the natural order of their names (2 before 10), but for
those that the rule `passed_over` names and those that the user skips. Every other file must be readable: one that is
not is an error that says how to leave it out. A test is called like its file without the ending; where a file holds
several tests, a hyphen and the test's own name follow.
"""

from __future__ import annotations

import hashlib
import re
import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from ..._errors import InputError
from ..findings import Finding
from ..schema import Control, Curve
from ..table import read_bytes, same_text
from .text import Tests

NO_DATA = frozenset(
    f".{ending}"
    for ending in "bmp db doc docx gif ini jpeg jpg lnk md odt pdf png ppt pptx py svg tif tiff toml".split()  # noqa: SIM905
)
"""Endings of pictures, documents and settings, in which no instrument writes samples."""
_READ_ME = re.compile(r"(read[-_ ]?me|licen[cs]e)(\..*)?", re.IGNORECASE)
LONGEST_LIST = 64
"""Longer lists of numbers than this (blocks of approach and drift) are not kept of many files: as TOML they would
outgrow the curves, and are still in the files."""
_SHOWN = 6


def names_of(file: Path) -> tuple[str, ...]:
    """The names under which a table may hold a file: with its ending, in capitals or not, and without."""
    return tuple(
        dict.fromkeys((file.name, file.stem + file.suffix.lower(), file.stem + file.suffix.upper(), file.stem))
    )


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
    """The tests of all files of a folder.

    Raises `InputError` if there is no file, a file cannot be read, two tests have one name, or `skip` fits no file.

    Args:
        read: reads the bytes of one file.
        skip: names of files, with or without ending, or patterns with "*" and "?", that are left out.

    Returns:
        The tests; by the name of each the names under which a table may hold its diameters; and what was left out.
    """
    files, findings = _files(folder, skip)
    found: dict[Path, Tests] = {}
    failed: dict[Path, InputError] = {}
    same: dict[str, list[Path]] = {}
    for file in files:
        try:
            file.name.encode("utf-8")  # a name in another encoding than the system's cannot be written into a file
            data = read_bytes(file)
            found[file] = read(file, data)
            same.setdefault(hashlib.sha256(data).hexdigest(), []).append(file)
        except UnicodeEncodeError:
            failed[file] = InputError("the file's name is no Unicode text", file=file, remedy="Rename it")
        except InputError as error:
            failed[file] = error
    if failed:
        raise _unreadable(failed, len(files))
    findings += [_twice(each) for each in same.values() if len(each) > 1]
    own = Counter(name for tests in found.values() for name in tests.curves)
    curves: dict[str, Curve] = {}
    keys: dict[str, tuple[str, ...]] = {}
    sizes: dict[str, list[float] | InputError] = {}
    missing: dict[str, int] = {}
    origin: dict[str, Path] = {}
    for file, tests in found.items():
        stem = same_text(file.stem)
        for name, curve in tests.curves.items():
            full = stem if len(tests.curves) == 1 else f"{stem}-{name}"
            if full in curves:
                problem = f"this file and {origin[full].name} both give a test the name {full!r}"
                remedy = f"Rename one of them, or leave one out with --leave-out {shlex.quote(file.name)}"
                raise InputError(problem, file=file, remedy=remedy)
            curves[full], origin[full] = curve, file
            keys[full] = (full, *names_of(file), *([name] if own[name] == 1 else []))
            if (size := tests.diameters_um.get(name)) is not None:
                sizes[full] = (
                    size if isinstance(size, list) else _or_skip(size, f"--leave-out {shlex.quote(file.name)}")
                )
            if name in tests.missing:
                missing[full] = tests.missing[name]
    formats = sorted({tests.format for tests in found.values()})
    form = f"{_count(files)}, {' and '.join(formats)}"
    return Tests(curves, form, _control(found), _other(found), sizes, missing), keys, findings


def _files(folder: Path, skip: Sequence[str]) -> tuple[list[Path], list[Finding]]:
    try:
        entries = sorted(folder.iterdir(), key=lambda entry: natural(entry.name))
        inside = [entry for entry in entries if entry.is_dir()]
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise InputError(problem, file=folder, remedy="Check the permissions") from None
    if {"particles.csv", "curves.csv"} <= {entry.name for entry in entries}:
        raise InputError("is a campaign already", file=folder, remedy="Give the folder with the instrument files")
    quiet = [entry for entry in entries if entry not in inside and passed_over(entry.name)]
    rest = [entry for entry in entries if entry not in inside and entry not in quiet]
    skipped: list[Path] = []
    for pattern in skip:
        fitting = [entry for entry in rest if _fits(entry, pattern)]
        if not fitting and not any(_fits(entry, pattern) for entry in quiet):
            problem = f"--leave-out {shlex.quote(pattern)} fits no file"
            raise InputError(problem, file=folder, remedy="Give a name as in the folder, or a pattern")
        skipped += [entry for entry in fitting if entry not in skipped]
    files = [entry for entry in rest if entry not in skipped]
    if not files:
        below = f"; give one of the folders in it: {_listed(inside)}" if inside else ""
        raise InputError("there is no instrument file in the folder", file=folder, remedy=f"Check the path{below}")
    findings = []
    if quiet:
        sentence = f"{_count(quiet)} ignored because of the name: {_listed(quiet)}"
        findings.append(Finding("files", "info", sentence))
    if inside:
        what = "1 folder" if len(inside) == 1 else f"{len(inside)} folders"
        findings.append(Finding("files", "info", f"{what} in it not entered: {_listed(inside)}"))
    if skipped:
        findings.append(Finding("files", "info", f"{_count(skipped)} skipped as asked: {_listed(skipped)}"))
    return files, findings


def _fits(entry: Path, pattern: str) -> bool:
    name, stem, wanted = same_text(entry.name), same_text(entry.stem), same_text(pattern)
    return wanted in (name, stem) or fnmatchcase(name, wanted)


def _count(files: Sequence[Path]) -> str:
    return "1 file" if len(files) == 1 else f"{len(files)} files"


def _listed(files: Sequence[Path]) -> str:
    names = ", ".join(file.name for file in files[:_SHOWN]) + (", ..." if len(files) > _SHOWN else "")
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in names)


def _unreadable(failed: dict[Path, InputError], files: int) -> InputError:
    error = next(iter(failed.values()))
    names = [file.name for file in failed]
    if len(failed) == files:
        more = f". All {files} files fail in the same way" if files > 1 else ""
        remedy = (error.remedy or "").rstrip(".") + more
        return error.changed(remedy=remedy)
    shown = " ".join(f"--leave-out {shlex.quote(name)}" for name in names[:_SHOWN])
    others = f" ({len(names)} of {files} files cannot be read)" if len(names) > 1 else ""
    rest = " ..." if len(names) > _SHOWN else ""
    return _or_skip(error, shown + rest, others)


def _or_skip(error: InputError, how: str, others: str = "") -> InputError:
    """The same error, with the way to leave the file out."""
    remedy = ", ".join([*([error.remedy.rstrip(".")] if error.remedy else []), f"or leave it out{others} with {how}"])
    return error.changed(remedy=remedy)


def _twice(files: Sequence[Path]) -> Finding:
    rest = " ".join(f"--leave-out {shlex.quote(file.name)}" for file in files[1:])
    return Finding(
        "duplicates",
        "warning",
        f"{_listed(files)} hold the same bytes, so one test counts {len(files)} times",
        f"If it is one particle, leave it out with {rest}",
        tuple(same_text(file.stem) for file in files),
    )


def _control(found: dict[Path, Tests]) -> Control | None:
    """The controlled quantity, if it is the same for all; where one file does not say, it is not known."""
    by: dict[Control | None, Path] = {}
    for file, tests in found.items():
        by.setdefault(tests.control, file)
    if "load" in by and "displacement" in by:
        problem = f"the test is controlled by displacement, that of {by['load'].name} by load"
        raise InputError(
            problem, file=by["displacement"], remedy="Convert tests of two kinds separately, with --leave-out"
        )
    return next(iter(by)) if len(by) == 1 else None


def _other(found: dict[Path, Tests]) -> dict[str, Any]:
    """What the files say besides the curves: what all say alike once, the rest by file, without long lists."""
    each = {file.name: _short(tests.other) for file, tests in found.items() if tests.other}
    common = next(iter(each.values()), {})
    common = {k: v for k, v in common.items() if len(each) == len(found) and all(o.get(k) == v for o in each.values())}
    rest = {name: {k: v for k, v in other.items() if k not in common} for name, other in each.items()}
    rest = {name: other for name, other in rest.items() if other}
    return common | ({"files": rest} if rest else {})


def _short(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    kept = {key: _short(item) for key, item in value.items()}
    return {k: v for k, v in kept.items() if v != {} and not (isinstance(v, list) and len(v) > LONGEST_LIST)}
