"""`campaign.toml`: how the tests were made. Reading it strictly and writing it back."""

from __future__ import annotations

import datetime
import json
import math
import re
import tomllib
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from .. import arguments
from .._errors import InputError
from ..files import SETTINGS_BYTES, read_regular
from .schema import Control, Metadata
from .tables import CANONICAL, convert, decode, find_column

_QUANTITIES = {"force_resolution": "force", "displacement_resolution": "length", "punch_diameter": "length"}
_WRITE = {
    "control": '"load" or "displacement"',
    "provenance": 'it in quotes, provenance = "..."',
    "corrections": 'a list of names, corrections = ["frame_compliance"]',
}


def load_toml(text: str, file: Path) -> dict[str, Any]:
    """Parse TOML; the line with a mistake is named."""
    try:
        entries = tomllib.loads(text)
        _refuse_long_integers(entries, file)
    except RecursionError:
        raise InputError("is nested too deep", file=file, remedy="Write flat keys") from None
    except InputError:
        raise
    except ValueError as error:
        place = re.search(r" \(at line (\d+), column \d+\)", str(error))
        problem = str(error)[: place.start()] if place else str(error).removesuffix(" (at end of document)")
        row = int(place[1]) if place else text.rstrip().count("\n") + 1
        remedy = 'Write key = value lines, text in double quotes, for example control = "load"'
        raise InputError(f"this is not TOML: {problem}", file=file, row=row, remedy=remedy) from None
    return entries


def _refuse_long_integers(value: Any, file: Path, key: str = "") -> None:
    """TOML promises integers of 64 bits only; a float may not hold a longer one."""
    if isinstance(value, dict | list):
        for name, one in value.items() if isinstance(value, dict) else ((key, one) for one in value):
            _refuse_long_integers(one, file, name)
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        problem = "holds an integer of more than 64 bits"
        raise InputError(problem, file=file, column=key, remedy="Write it with a decimal point")


def typed[T](entries: Mapping[str, Any], kind: type[T], file: Path, write: Mapping[str, str]) -> T:
    """Entries of a TOML file as a `msgspec.Struct` that forbids unknown fields; `InputError` names the key that is
    unknown, missing or of another type. `write` holds what to write for a key, by its last part."""
    try:
        return msgspec.convert(entries, kind)
    except msgspec.ValidationError as error:
        if isinstance(error.__cause__, InputError):
            raise error.__cause__.changed(file=file) from None
        problem, _, place = str(error).partition(" - at `$")
    path = [part for part in re.sub(r"\[.*?\]", "", place.strip("`")).split(".") if part]
    field = re.fullmatch(r"Object (contains unknown|missing required) field `(.*)`", problem)
    key = [*path, field[2]] if field else path
    remedy = f"Write {write[key[-1]]}" if key[-1] in write else "Correct it"
    if field and field[1] == "missing required":
        problem, remedy = "is missing", remedy if key[-1] in write else f"Add [{'.'.join(key)}]"
    elif field:
        problem = "is not a known key"
        table: Any = kind
        for name in path:  # to the type of the table that the key is in
            inside = next(one.type for one in msgspec.structs.fields(table) if one.name == name)
            table = next(one for one in (inside, *get_args(inside)) if hasattr(one, "__struct_fields__"))
        known = [one.encode_name for one in msgspec.structs.fields(table) if one.encode_name]
        close = get_close_matches(field[2], known, n=1)
        remedy = f"Did you mean {'.'.join([*path, *close])!r}?" if close else f"Known keys: {', '.join(known)}"
    elif "matching regex" in problem:
        problem = "is not allowed"
    raise InputError(problem, file=file, column=".".join(key), remedy=remedy)


def load_toml_file(path: str | Path) -> dict[str, Any]:
    """The entries of a TOML file; `InputError` if it cannot be read, is no UTF-8 text, or is not TOML."""
    file = arguments.file_path(path, "path")
    return load_toml(read_settings(file), file)


def read_settings(file: Path) -> str:
    """The text of a TOML file, which may be empty."""
    data = read_regular(file, SETTINGS_BYTES, "Keep settings alone in it; readings belong in a table")
    return decode(data, file, "plain text in UTF-8")


class _Known(msgspec.Struct):
    control: Control | None = None
    provenance: str | None = None
    corrections: tuple[str, ...] = ()


def parse_metadata(text: str, file: Path) -> Metadata:
    """The metadata that the text of a `campaign.toml` holds; keys it does not know go to `other`."""
    entries = load_toml(text, file)
    known = typed({key: entries.pop(key) for key in _WRITE if key in entries}, _Known, file, _WRITE)
    sizes = {f"{name}_{CANONICAL[kind]}": _positive(entries, name, kind, file) for name, kind in _QUANTITIES.items()}
    return Metadata(known.control, **sizes, provenance=known.provenance, corrections=known.corrections, other=entries)


def _positive(entries: dict[str, Any], quantity: str, dimension: str, file: Path) -> float | None:
    """The number of a key whose name ends in its unit; None, if there is none."""
    keys = list(entries)
    if not any(quantity in (key, key.rpartition("_")[0]) for key in keys):
        return None
    where, factor = find_column(keys, quantity, dimension, file, what="key")
    try:
        value = arguments.number(entries.pop(keys[where]), "it", above=0)
    except InputError as error:
        remedy = "Write the number alone, without quotes and unit, or remove the key"
        raise error.changed(file=file, column=keys[where], remedy=remedy) from None
    return float(convert(np.array([value]), factor)[0])


def format_metadata(metadata: Metadata, file: Path) -> str:
    """The text of a `campaign.toml`; `InputError` if it would not read back as the same metadata."""
    known = dict(vars(metadata))
    other = known.pop("other")
    for key in other:
        if not isinstance(key, str) or key in known:
            raise InputError(f"{key!r} cannot be a further key", file=file, remedy="Rename it in Metadata.other")
    try:
        text = _table({key: value for key, value in known.items() if value not in (None, ())} | other)
        text.encode("utf-8")
    except (TypeError, ValueError) as error:
        problem = f"cannot be written as TOML: {error}"
        raise InputError(problem, file=file, remedy="Keep text, numbers, dates, lists and tables") from None
    # Texts are compared, since a number may be none (NaN), which equals nothing.
    if _table(parse_metadata(text, file).other) != _table(other):
        raise InputError("would not read back the same", file=file, remedy="Rename the keys of Metadata.other")
    return text


def _table(entries: Mapping[str, Any]) -> str:
    """Entries as TOML: tables behind all others."""
    tables = {key: value for key, value in entries.items() if isinstance(value, Mapping)}
    lines = [f"{_key(key)} = {_value(value)}\n" for key, value in entries.items() if key not in tables]
    for key, table in tables.items():
        lines += [f"\n[{_key(key)}]\n", *(f"{_key(k)} = {_value(v)}\n" for k, v in table.items())]
    return "".join(lines)


def _key(key: Any) -> str:
    if not isinstance(key, str):
        raise TypeError(f"the key {key!r} is not text")
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _string(key)


def _string(text: str) -> str:
    # JSON escapes all that TOML wants escaped, but for DEL.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return _string(value)
        case int():
            return str(value)
        case float():
            return repr(float(value)) if math.isfinite(value) else str(float(value))
        case datetime.datetime() | datetime.date() | datetime.time():
            return value.isoformat()
        case Mapping():
            return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
        case list() | tuple():
            return "[" + ", ".join(_value(v) for v in value) + "]"
    raise TypeError(f"{type(value).__name__} {value!r} has no form in TOML")
