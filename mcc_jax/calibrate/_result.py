"""`calibration.json`: the same for every method."""

from __future__ import annotations

import math
from typing import Any


def estimate(
    value: float | None, sd: float | None = None, interval_95: tuple[float, float] | None = None
) -> dict[str, Any]:
    """One estimate; what a method does not give, or what is not finite, is None."""
    known = value is not None and math.isfinite(value)
    return {
        "value": float(value) if known and value is not None else None,
        "sd": None if sd is None else float(sd),
        "interval_95": None if interval_95 is None else [float(interval_95[0]), float(interval_95[1])],
    }
