"""Numbers and names as a person writes them, for command, pages, figures and `repr`."""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from .arguments import is_traced


def number(value: float | int | None, digits: int = 4) -> str:
    """So many significant digits, or "unknown"; very large and small ones as powers of ten."""
    if value is None or not math.isfinite(value):
        return "unknown"
    if value and not 1e-4 <= abs(value) < 1e6:
        mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
        mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
        return f"{mantissa} × 10{_raised(int(exponent))}".replace("-", "−")
    text = f"{value:.{digits}g}"
    if "e" in text:
        text = f"{value:.0f}"
    return text.replace("-", "−")


def plain(name: str) -> str:
    """A mechanism's name, or a formula's, for a sentence: `platen_sink_in` is "platen sink in"."""
    return name.replace("_", " ")


def first_few(names: Iterable[str], most: int = 6) -> str:
    """Names in a row, of many the first ones only."""
    shown = list(names)
    return ", ".join(shown[:most]) + (", ..." if len(shown) > most else "")


def counted(count: int, what: str) -> str:
    """So many things: "1 file", "3 files"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def listed(names: Sequence[str], word: str = "and") -> str:
    """Names in a row, the last after a word."""
    if len(names) < 2:
        return names[0] if names else "nothing"
    return f"{', '.join(names[:-1])} {word} {names[-1]}"


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def decimals(value: float | int, sd: float | int) -> int | None:
    """Decimal places that show two digits of the uncertainty; None where a power of ten is called for."""
    places = max(0, 1 - math.floor(math.log10(sd)))
    return None if places > 6 or abs(value) >= 1e6 else places


def with_sd(estimate: Mapping[str, Any], factor: float = 1.0) -> str:
    """Value ± standard deviation, which decides the digits of both."""
    value, sd = estimate["value"], estimate["sd"]
    if value is None or sd is None or not sd > 0:
        return number(None if value is None else value * factor)
    value, sd = value * factor, sd * factor
    places, power = decimals(value, sd), 0
    if places is None:
        power = math.floor(math.log10(max(abs(value), sd)))
        places = decimals(1.0, sd / 10.0**power)
    if places is None:
        return f"{number(value)} ± {number(sd, 2)}"
    both = f"{value / 10.0**power:.{places}f} ± {sd / 10.0**power:.{places}f}".replace("-", "−")
    return f"({both}) × 10{_raised(power)}" if power else both


def interval(estimate: Mapping[str, Any], factor: float = 1.0) -> str | None:
    """The two ends of the 95 % interval, or None where there is none."""
    ends = estimate["interval_95"]
    if ends is None:
        return None
    low, high = (end * factor for end in ends)
    places = decimals(max(abs(low), abs(high)), (high - low) / 2) if high > low else None
    if places is None:
        return f"{number(low)} to {number(high)}"
    return f"{low:.{places}f} to {high:.{places}f}".replace("-", "−")


def percent(share: float | int | None, digits: int = 2) -> str:
    """A share as per cent."""
    return "unknown" if share is None else f"{number(100 * share, digits)} %"


def probability(value: float | int | None) -> str:
    """A probability to two digits; what is next to 0 or 1 is said so."""
    if value is None:
        return "unknown"
    if value < 0.001:
        return "below 0.001"
    return "above 0.99" if value > 0.995 else number(value, 2)


def with_unit(value: float | None, unit: str, form: str = ".2g") -> str:
    """A value of the library with its unit, which is "-" where there is none; "unknown" without a value."""
    return ("unknown" if value is None else format(value, form)) + ("" if unit == "-" else f" {unit}")


def span(values: Any, unit: str, digits: int = 4) -> str:
    """Smallest and largest, or the one value."""
    low, high = number(float(np.min(values)), digits), number(float(np.max(values)), digits)
    return (low if low == high else f"{low} to {high}") + f" {unit}".rstrip()


def table(title: str, rows: list[tuple[str, str]], most: int = 20) -> str:
    """A title and rows of name and value, at most so many lines."""
    width = max((len(name) for name, _ in rows), default=0)
    lines = [title, *(f"  {name:<{width}}  {text}" for name, text in rows)]
    return "\n".join(lines if len(lines) <= most else [*lines[: most - 1], f"  ... and {len(lines) - most + 1} more"])


WIDE, LONG = 100, 70  # characters of an object in one line, and of one value in a table


def described(**units: str) -> Any:
    """A `__repr__` of every field in a few words, in a line or a table; `units` of fields that do not name them."""

    def __repr__(self: Any) -> str:
        names = getattr(type(self), "_fields", None) or [f.name for f in dataclasses.fields(self) if f.repr]
        rows = [(name, in_words(getattr(self, name, None), units.get(name, ""))) for name in names]
        title = type(self).__name__
        line = f"{title}({', '.join(f'{name}={text}' for name, text in rows)})"
        return line if len(line) <= WIDE else table(title, rows)

    return __repr__


def in_words(value: Any, unit: str = "") -> str:
    """Any value in one line: numbers as they are, arrays by size and range, what holds more by its name."""
    if isinstance(value, bool | np.bool | None):
        return str(value)
    if isinstance(value, enum.Enum):
        return in_words(value.value)
    if isinstance(value, int | np.integer):
        return f"{value} {unit}".rstrip()
    if isinstance(value, float):
        return f"{number(value)} {unit}".rstrip() if math.isfinite(value) else str(value)
    if hasattr(value, "_enumeration"):  # of equinox: its text is the error, which is empty where there is none
        return _cut(str(value._enumeration[value])) or "successful"
    if is_traced(value) or isinstance(value, str):
        return _cut(str(value)) or "none"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return _array_in_words(value, unit)
    if isinstance(value, Mapping):
        named = ", ".join(f"{key} {in_words(item)}" for key, item in value.items())
        return (named or "none") if len(named) <= LONG else _cut(f"{len(value)}: {', '.join(map(str, value))}")
    if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        parts = ", ".join(getattr(item, "label", None) or in_words(item) for item in value)
        if len(parts) <= LONG:
            return parts or "none"
        kinds = {type(item).__name__ for item in value if item is not None}
        return f"{len(value)} of {' and '.join(sorted(kinds))}" if kinds else f"none in {len(value)}"
    if callable(value) and hasattr(value, "__name__"):
        return value.__name__
    first, *more = repr(value).splitlines() or [""]
    return type(value).__name__ if more or len(first) > LONG else first


def _cut(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= LONG else f"{text[: LONG - 3]}..."


def _array_in_words(value: Any, unit: str) -> str:
    size, dtype = " × ".join(map(str, value.shape)), str(value.dtype)
    numeric = dtype.startswith(("float", "int", "uint", "bool", "bfloat"))
    if not numeric or not getattr(value, "is_fully_addressable", True) or not hasattr(value, "__array__"):
        return f"{size} of {dtype}".strip()
    array = np.asarray(value)
    if array.ndim == 0:
        return in_words(array.item(), unit)
    if dtype == "bool":
        return f"{int(array.sum())} of {size} true"
    known = array[np.isfinite(array.astype(float))].astype(float)
    if not known.size:
        return f"{size} values, none finite" if array.size else "no values"
    if array.size <= 4:
        each = [number(float(x)) if math.isfinite(x) else str(x) for x in array.ravel()]
        return f"[{', '.join(each)}] {unit}".rstrip()
    return f"{size} values, {span(known, unit)}"
