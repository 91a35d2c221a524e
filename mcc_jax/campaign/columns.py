"""Column names that carry their unit: `force_mN`, `displacement_um`, `time_s`, `D1_um`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import get_close_matches
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import InputError
from .._format import first_few

FORCE, LENGTH, TIME = "force", "length", "time"
CANONICAL = {FORCE: "mN", LENGTH: "um", TIME: "s"}
EXAMPLES = {FORCE: "mN, N, uN, kN, gf", LENGTH: "um, nm, mm, m", TIME: "s, ms, min"}
# A larger magnitude (in mN, um or s) is a wrong unit or a damaged cell, and its powers would overflow further on.
LARGEST_MAGNITUDE = 1e15
_UNIT = re.compile(r"[A-Za-zµμ]{1,24}")


@cache
def _registry() -> Any:
    from pint import UnitRegistry  # slow to import, and needed for other than the usual units only

    # Fractions keep nm -> um at exactly 1/1000.
    registry: Any = UnitRegistry
    return registry(non_int_type=Fraction)


@cache
def unit_factor(unit: str, dimension: str) -> Fraction:
    """How many canonical units (mN, um, s) one `unit` is; `ValueError` if it is unknown or measures something else."""
    canonical = CANONICAL[dimension]
    if unit == canonical:
        return Fraction(1)
    if not unit:
        raise ValueError("the unit is missing")
    if _UNIT.fullmatch(unit) is None:
        raise ValueError(f"{unit!r} is not a unit")
    registry = _registry()
    try:
        quantity = registry.Quantity(Fraction(1), registry.Unit(unit))
    # Pint reports an unknown name through many exception types, some of them from Python's tokenizer.
    except Exception:
        raise ValueError(f"the unit {unit!r} is unknown") from None
    if quantity.dimensionality != registry.Unit(canonical).dimensionality:
        raise ValueError(f"{unit!r} is no unit of {dimension}")
    return Fraction(quantity.to(canonical).magnitude)


def convert(values: np.ndarray, factor: Fraction) -> np.ndarray:
    """`values * factor`, rounded once where the factor is a whole number or the inverse of one."""
    if factor == 1:
        return values
    with np.errstate(over="ignore"):  # the caller checks the size and names the row
        return values / float(factor.denominator) if factor.numerator == 1 else values * float(factor)


def find_column(
    header: Sequence[str], quantity: str, dimension: str, file: str | Path, *, what: str = "column"
) -> tuple[int, Fraction]:
    """Where a name such as "force", without its unit, is in a header, and what turns the unit into the canonical one.

    Raises `InputError` if the quantity is missing, appears twice, or has no unit or a wrong one; `what` is what the
    names are called in its message.
    """
    expected = f"{quantity}_{CANONICAL[dimension]}"
    units = f"units, as a suffix: {EXAMPLES[dimension]} (for example {expected})"
    found = [i for i, name in enumerate(header) if name.rpartition("_")[0] == quantity]
    if len(found) == 1:
        named = header[found[0]]
        try:
            return found[0], unit_factor(named.rpartition("_")[2], dimension)
        except ValueError as error:
            problem, remedy = str(error), f"Accepted {units}"
    elif found:
        problem, named = f"{quantity} is given {len(found)} times", " and ".join(header[i] for i in found)
        remedy = "Keep one of them"
    elif quantity in header:
        problem, named, remedy = "the unit is missing", quantity, f"Name it {expected}; accepted {units}"
    else:
        raise missing_column(header, expected, file, what=what, hint=f"; accepted {units}")
    raise InputError(problem, file=file, row=1 if what == "column" else None, column=named, remedy=remedy)


def missing_column(
    header: Sequence[str], expected: str, file: str | Path, *, what: str = "column", hint: str = ""
) -> InputError:
    """The error for a column that is not there, with the nearest name that is."""
    lower = {name.lower(): name for name in reversed(header)}
    close = get_close_matches(expected.lower(), list(lower), n=1, cutoff=0.6)
    remedy = f"Add it; there are: {first_few(header, 12)}"
    if close:
        remedy = f"Did you mean {expected!r} by {lower[close[0]]!r}? Rename it"
    row = 1 if what == "column" else None
    return InputError(f"the {what} {expected!r} is missing", file=file, row=row, remedy=remedy + hint)
