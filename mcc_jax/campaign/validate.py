"""What every campaign must satisfy, whether read from files or made in memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from .. import arguments
from .._errors import InputError
from .columns import LARGEST_MAGNITUDE
from .schema import Campaign

SMALLEST_DIAMETER_UM = 1e-6
_TAKEN = ("particle", "D1_um", "D2_um", "D3_um")


def check_magnitudes(
    values: np.ndarray, file: str | Path, rows: Sequence[int], column: str, *, diameter: bool = False
) -> None:
    """Refuse values that are too large to be measured, and diameters that are not positive.

    Args:
        values: in canonical units, shape (n,).
        file: for messages.
        rows: the row each value stands in.
        column: for messages.
        diameter: whether the values are diameters.

    Raises:
        InputError: at the first such value.
    """
    bad = ~(np.abs(values) <= LARGEST_MAGNITUDE)
    if diameter:
        bad |= ~(values >= SMALLEST_DIAMETER_UM)
    if not bad.any():
        return
    i = int(np.argmax(bad))
    value = float(values[i])
    if diameter and value <= 0:
        problem, remedy = f"the diameter {value:.10g} um is not positive", "Enter the measured diameter"
    else:
        problem = f"{value:.4g} (in mN, um or s) is " + ("too small" if abs(value) < 1 else "too large") + " to be real"
        remedy = "Check the number and the column's unit"
    raise InputError(problem, file=file, row=rows[i], column=column, remedy=remedy)


def check_campaign(campaign: Any, name: str = "campaign", *, file: str | Path = "") -> Campaign:
    """The campaign, if it is one that could have come from files: checked as strictly as one that did.

    Args:
        campaign: what a function was given.
        name: what the function calls it, for messages.
        file: what messages name as the place; where the campaign was read, if empty.

    Raises:
        InputError: if names, shapes or values are unfit; for a path, how to read it.
    """
    if isinstance(campaign, str | PurePath):
        raise InputError(
            f"{name} must be a Campaign, got the path {str(campaign)!r}",
            remedy=f"Read it first: mcc_jax.read_campaign({str(campaign)!r}).",
        )
    arguments.instance(campaign, Campaign, name, "Read one with mcc_jax.read_campaign(folder), or make one in memory.")
    place = file or campaign.source or f"the {name}"

    def fail(problem: str, remedy: str = "Mend the campaign before it is used") -> InputError:
        return InputError(problem, file=place, remedy=remedy)

    if not len(campaign):
        raise fail("there is no particle")
    name, times = Counter(campaign.particles).most_common(1)[0]
    if times > 1:
        raise fail(f"the particle {name!r} stands there {times} times")
    for name, triple in zip(campaign.particles, campaign.diameters_um, strict=True):
        _check_text(name, f"the particle's name {name!r}", fail)
        if not name.strip():
            raise fail("a particle's name is empty")
        if not ((triple >= SMALLEST_DIAMETER_UM) & (triple <= LARGEST_MAGNITUDE)).all():
            raise fail(f"the diameters {triple.tolist()} um of particle {name!r} are not all positive and finite")
    for name, curve in zip(campaign.particles, campaign.curves, strict=True):
        _check_curve(name, curve.time_s, curve.force_mN, curve.displacement_um, fail)
    for column, cells in campaign.columns.items():
        if not column or column != column.strip() or "\ufeff" in column or column in _TAKEN or column[:3] in _DIAMETER:
            raise fail(f"{column!r} cannot be the name of a further column")
        for text in (column, *cells):
            _check_text(text, f"the text {text!r} of column {column!r}", fail)
    return campaign


_DIAMETER = ("D1_", "D2_", "D3_")


def _check_text(text: str, what: str, fail: Callable[[str], InputError]) -> None:
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        raise fail(f"{what} is no valid Unicode text") from None
    if "\0" in text:
        raise fail(f"{what} holds a NUL character")


def check_finite(values: np.ndarray, what: str, fail: Callable[..., InputError]) -> None:
    """Refuse readings that are not finite, or too large to be measured; `fail` makes the error."""
    bad = np.flatnonzero(~(np.abs(values) <= LARGEST_MAGNITUDE))
    if bad.size:
        remedy = "Leave that sample out, or check the unit if all are so large"
        raise fail(f"{what} is {values[bad[0]]} at sample {bad[0] + 1}", remedy)


def _check_curve(
    name: str, time: np.ndarray, force: np.ndarray, displacement: np.ndarray, fail: Callable[..., InputError]
) -> None:
    parts = {"time": time, "force": force, "displacement": displacement}
    for what, values in parts.items():
        check_finite(values, f"the {what} of particle {name!r}", fail)
        if what != "time" and not values.any():
            raise fail(f"every {what} of particle {name!r} is zero, so the test holds no data")
    if len(time) < 2:
        raise fail(f"the particle {name!r} has one row only; a curve needs at least two")
    back = np.flatnonzero(np.diff(parts["time"]) < 0)
    if len(back):
        raise fail(f"the time of particle {name!r} goes back at sample {int(back[0]) + 2}")
