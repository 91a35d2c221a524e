"""Sheets of Excel workbooks (xlsx) as rows of text, by pandas and its calamine engine."""

from __future__ import annotations

import functools
import io
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any

from .._errors import InputError
from .._extras import extra
from ..files import LIMITS

_BOOK = "xl/workbook.xml"
_LAST = re.compile(rb'<c\b[^>]*?\br="([A-Z]{1,3})([0-9]{1,7})"')
_REMEDY = "Open it in a spreadsheet program and save it again, or save the sheet as CSV"


def is_workbook(data: bytes) -> bool:
    """Whether a file is an Excel workbook, not another zip archive."""
    if not data.startswith(b"PK\x03\x04"):
        return False
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _BOOK in archive.namelist()
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError, EOFError):
        return False


def read_sheet(
    data: bytes,
    file: Path,
    sheet: str | int | None = None,
    *,
    preferred: str | None = None,
    decimal_mark: str = ".",
    how: str = "",
) -> tuple[range, list[list[str]]]:
    """The rows of a sheet: their numbers and their cells as text, numbers with all their digits.

    Raises `InputError` if it is damaged or too large, the sheet is not there or not told, or calamine is not installed.

    Args:
        sheet: the sheet's name, or its number, 1 for the first; None for the only one that holds anything.
        preferred: the name of the sheet to take, if there is one, where `sheet` is None.
        decimal_mark: how numbers are written; "." or ",".
        how: how a sheet is chosen, for the message where there are several; one sentence.
    """
    import pandas as pd

    _check_size(data, file)
    with extra("excel", file):
        import python_calamine  # noqa: F401
    try:
        frames: dict[Any, Any] = pd.read_excel(
            io.BytesIO(data), sheet_name=None, engine="calamine", header=None, dtype=object, na_filter=False
        )
    # The engine's errors have no common type, and its panics are no Exception.
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | SystemExit | MemoryError):
            raise
        raise InputError("the workbook is damaged", file=file, remedy=_REMEDY) from None
    wanted = _choose([str(name) for name in frames], sheet, preferred, file)
    held = {name: frame for name, frame in frames.items() if frame.size and wanted in (None, name)}
    if not held:
        where = f"the sheet {wanted!r}" if wanted is not None else "every sheet"
        raise InputError(f"{where} is empty", file=file, remedy="Save the workbook again with the table in it")
    if len(held) > 1:
        listed = ", ".join(map(repr, held))
        remedy = how or f"Call the sheet with the table {preferred!r}, or save it alone"
        raise InputError(f"{len(held)} sheets hold something: {listed}", file=file, remedy=remedy)
    (frame,) = held.values()

    def text(value: Any) -> str:
        return repr(value).replace(".", decimal_mark) if isinstance(value, float) else str(value)

    rows = frame.itertuples(index=False, name=None)
    return range(1, len(frame) + 1), [[text(value) for value in row] for row in rows]


def _choose(names: list[str], sheet: str | int | None, preferred: str | None, file: Path) -> str | None:
    if sheet is None:
        return preferred if preferred in names else None
    if isinstance(sheet, int) and sheet <= len(names):
        return names[sheet - 1]
    if sheet in names:
        return str(sheet)
    what = f"sheet {sheet}" if isinstance(sheet, int) else f"sheet called {sheet!r}"
    raise InputError(f"there is no {what}", file=file, remedy=f"The sheets are: {', '.join(map(repr, names))}")


def _check_size(data: bytes, file: Path) -> None:
    """Refuse what would not fit into memory before the engine unpacks it."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > LIMITS.unpacked_bytes:
                raise InputError("the workbook is too large", file=file, remedy="Save the sheet alone, or as CSV")
            for entry in entries:
                if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise zipfile.BadZipFile  # noqa: TRY301
                # The size in the directory may lie; no more than it says is unpacked.
                with archive.open(entry) as stream:
                    content = stream.read(entry.file_size + 1)
                if len(content) != entry.file_size:
                    raise zipfile.BadZipFile  # noqa: TRY301
                if not entry.filename.startswith("xl/worksheets/"):
                    continue
                rows, columns = 0, 0
                for letters, digits in _LAST.findall(content):
                    column = functools.reduce(lambda number, letter: 26 * number + letter - 64, letters, 0)
                    rows, columns = max(rows, int(digits)), max(columns, column)
                if rows * columns > LIMITS.sheet_cells:
                    problem = f"a sheet reaches to row {rows} and column {columns}, which is too large"
                    remedy = "Delete the rows and columns without content behind the table, or save it as CSV"
                    raise InputError(problem, file=file, remedy=remedy)
    except (zipfile.BadZipFile, zlib.error, ValueError, OSError, NotImplementedError, EOFError, RuntimeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError("the workbook is damaged", file=file, remedy=_REMEDY) from None
