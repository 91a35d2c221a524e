"""Reading `calibration.json` and `discovery.json`: strict JSON of a known schema, or one line on what is wrong."""

from __future__ import annotations

import json
import math
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NoReturn

from .._errors import InputError
from ..files import LIMITS, check_text, read_regular

SCHEMA = 1
LONGEST = 160
"""So much of a validator's message is shown; it may quote the whole file."""


@cache
def _validator(stem: str) -> Any:
    from jsonschema import Draft202012Validator

    text = files("mcc_jax.calibrate").joinpath("schemas", f"{stem}.json").read_text(encoding="utf-8")
    return Draft202012Validator(json.loads(text))


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number of JSON")


def _finite(text: str) -> float:
    """A number that JSON can hold again: Python also reads 1e400, and would not write it."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:40]} is no number of JSON")
    return number


def read_result(file: Path, again: str) -> dict[str, Any]:
    """The contents of a result.

    Args:
        file: `calibration.json` or `discovery.json`.
        again: the command that writes it, for the remedy.

    Raises:
        InputError: if it cannot be read, is no JSON, of another schema, or lacks something.
    """
    remedy = f"Write it again: {again}"
    try:
        data = read_regular(file, LIMITS.result_bytes, remedy)
        content = json.loads(data.decode("utf-8"), parse_constant=_no_constant, parse_float=_finite)
    except InputError:
        raise
    except json.JSONDecodeError as error:
        raise InputError(f"is no JSON: {error.msg}", file=file, row=error.lineno, remedy=remedy) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"is no JSON: {str(error)[:LONGEST]}", file=file, remedy=remedy) from None
    check_text(content, file, remedy)
    number = content.get("schema") if isinstance(content, dict) else None
    if isinstance(number, int) and number != SCHEMA:
        raise InputError(
            f"is of schema {number}, this mcc-jax knows {SCHEMA}", file=file, remedy=f"Update mcc-jax, or {again}"
        )
    _check(content, file, remedy)
    schema = _validator(file.stem).schema
    return _filled(content, schema, schema["$defs"])


def _check(content: Any, file: Path, remedy: str) -> None:
    from jsonschema.exceptions import best_match

    error = best_match(_validator(file.stem).iter_errors(content))
    if error is None:
        return
    place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in error.absolute_path).lstrip(".")
    message = error.message if len(error.message) <= LONGEST else f"{error.message[:LONGEST]}..."
    raise InputError(f"does not hold what it should: {message}", file=file, column=place or None, remedy=remedy)


def _filled(content: Any, schema: dict[str, Any], definitions: dict[str, Any]) -> Any:
    """The content with the schema's defaults where it leaves something out."""
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    if isinstance(content, dict):
        for branch in schema.get("anyOf", []):
            content = _filled(content, branch, definitions)
        parts = schema.get("properties", {})
        left = schema.get("additionalProperties", {})
        own = {name: _filled(value, parts.get(name, left), definitions) for name, value in content.items()}
        return {name: part["default"] for name, part in parts.items() if "default" in part} | own
    if isinstance(content, list):
        return [_filled(item, schema.get("items", {}), definitions) for item in content]
    return content
