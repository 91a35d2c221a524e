"""The one exception that bad input raises."""

from __future__ import annotations

from pathlib import Path
from typing import Any


class InputError(ValueError):
    """Input that a person can correct, reported in one line.

    The message names the file, the row and the column where they are known, what is wrong there, and what to do.
    The command line prints it on standard error and exits with status 2; nothing is written.

    Args:
        problem, remedy: what is wrong, and what to do about it.
        file, row, column: the file or folder, the row as an editor counts it, the header being row 1, and the column.
    """

    def __init__(
        self,
        problem: str,
        *,
        file: str | Path | None = None,
        row: int | None = None,
        column: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.problem, self.file, self.row, self.column, self.remedy = problem, file, row, column, remedy
        place = [] if file is None else [str(file)]
        if row is not None:
            place.append(f"row {row}")
        if column is not None:
            place.append(f"column {column!r}")
        message = ", ".join(place) + (": " if place else "") + problem
        if remedy is not None:
            message = f"{message.rstrip('.')}. {remedy}"
        # A cell's text may hold line breaks or control characters; the promise is one line.
        super().__init__("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in message))

    def changed(self, **parts: Any) -> InputError:
        """The same error with some of its parts, named as above, in place of its own."""
        own = {name: getattr(self, name) for name in ("problem", "file", "row", "column", "remedy")}
        return InputError(**own | parts)
