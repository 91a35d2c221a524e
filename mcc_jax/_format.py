"""Numbers as a person writes them, for command, pages, figures and `repr`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .arguments import is_traced


def number(value: float | int | None, digits: int = 4) -> str:
    """So many significant digits, or "unknown"; very large and small ones as powers of ten."""
    if value is None or not math.isfinite(value):
        return "unknown"
    if value and not 1e-4 <= abs(value) < 1e6:
        mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
        return f"{mantissa} × 10{_raised(int(exponent))}".replace("-", "−")
    text = f"{value:.{digits}g}"
    if "e" in text:
        text = f"{value:.0f}"
    return text.replace("-", "−")


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def decimals(value: float | int, sd: float | int) -> int | None:
    """Decimal places that show two digits of the uncertainty; None where a power of ten is called for."""
    places = max(0, 1 - math.floor(math.log10(sd)))
    return None if places > 6 or abs(value) >= 1e6 else places


def with_sd(estimate: dict[str, Any], factor: float = 1.0) -> str:
    """Value ± standard deviation, which decides the digits of both."""
    value, sd = estimate["value"], estimate["sd"]
    if value is None or sd is None or not sd > 0:
        return number(None if value is None else value * factor)
    value, sd = value * factor, sd * factor
    places = decimals(value, sd)
    if places is None:
        return f"{number(value)} ± {number(sd, 2)}"
    return f"{value:.{places}f} ± {sd:.{places}f}".replace("-", "−")


def interval(estimate: dict[str, Any], factor: float = 1.0) -> str | None:
    """The two ends of the 95 % interval, or None where there is none."""
    ends = estimate["interval_95"]
    if ends is None:
        return None
    low, high = (end * factor for end in ends)
    if not high > low:
        return f"{number(low)} to {number(high)}"
    places = decimals(max(abs(low), abs(high)), (high - low) / 2)
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


def span(values: Any, unit: str, digits: int = 4) -> str:
    """Smallest and largest, or the one value."""
    low, high = number(float(min(values)), digits), number(float(max(values)), digits)
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"


def value_of(value: Any, unit: str = "") -> str:
    """A parameter of a module in words: its value, the range of a batch, or what stands for it while JAX traces."""
    mark = f" {unit}" if unit else ""
    if is_traced(value) or not hasattr(value, "shape"):
        return f"{value}{mark}"
    array = np.asarray(value, float)
    if array.size <= 1:
        return f"{number(float(array.ravel()[0]))}{mark}" if array.size else "none"
    return f"{number(float(array.min()))} to {number(float(array.max()))}{mark} ({array.shape[0]} of them)"


def table(title: str, rows: list[tuple[str, str]], most: int = 20) -> str:
    """A title and rows of name and value, at most so many lines."""
    width = max((len(name) for name, _ in rows), default=0)
    lines = [title, *(f"  {name:<{width}}  {text}" for name, text in rows)]
    return "\n".join(lines if len(lines) <= most else [*lines[: most - 1], f"  ... and {len(lines) - most + 1} more"])
