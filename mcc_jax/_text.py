"""Text from outside."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ._errors import InputError


def check_text(content: Any, file: Path, remedy: str) -> None:
    """Refuse a JSON value that holds lone surrogates, which JSON can write and no file can hold.

    Raises `InputError` naming the file.
    """
    try:
        json.dumps(content, ensure_ascii=False).encode("utf-8")
    except UnicodeEncodeError as error:
        half = error.object[error.start]
        raise InputError(
            f"holds text that is not Unicode: half of a pair, {half!a}", file=file, remedy=remedy
        ) from None
