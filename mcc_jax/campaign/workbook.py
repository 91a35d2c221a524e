"""Sheets of Excel workbooks (xlsx) as rows of text, by pandas and its calamine engine."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

from .._errors import InputError
from .._extras import extra
from ..files import UNPACKED_BYTES

_BOOK = "xl/workbook.xml"
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
) -> list[list[str]]:
    """The cells of all rows of a sheet as text, numbers with all their digits and this decimal mark.

    The sheet has this name or number, 1 for the first; without one it is the `preferred` one, or the only one that
    holds anything. Raises `InputError` if the workbook is damaged or too large, or the sheet is not clear; `how` is how
    to choose one.
    """
    import pandas as pd

    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > UNPACKED_BYTES:
            raise InputError("the workbook is too large", file=file, remedy="Save the sheet alone, or as CSV")
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
    names = list(frames)
    wanted = preferred if sheet is None and preferred in names else sheet
    if isinstance(sheet, int) and sheet <= len(names):
        wanted = names[sheet - 1]
    if wanted is not None and wanted not in names:
        what = f"sheet {sheet}" if isinstance(sheet, int) else f"sheet called {sheet!r}"
        remedy = f"The sheets are: {', '.join(map(repr, names))}"
        raise InputError(f"there is no {what}", file=file, remedy=remedy)
    held = [name for name, frame in frames.items() if frame.size and wanted in (None, name)]
    if not held:
        where = f"the sheet {wanted!r}" if wanted is not None else "every sheet"
        raise InputError(f"{where} is empty", file=file, remedy="Save the workbook again with the table in it")
    if len(held) > 1:
        remedy = how or f"Call the sheet with the table {preferred!r}, or save it alone"
        problem = f"{len(held)} sheets hold something: {', '.join(map(repr, held))}"
        raise InputError(problem, file=file, remedy=remedy)

    def text(value: Any) -> str:
        return repr(value).replace(".", decimal_mark) if isinstance(value, float) else str(value)

    rows = frames[held[0]].itertuples(index=False, name=None)
    return [[text(value) for value in row] for row in rows]
