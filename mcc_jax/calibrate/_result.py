"""`calibration.json`: the same for every method."""

from __future__ import annotations

import math
from typing import Any


def finite(value: float) -> float | None:
    """The number, or None if it is not finite: JSON knows neither NaN nor infinity."""
    return float(value) if math.isfinite(value) else None


def estimate(
    value: float | None, sd: float | None = None, interval_95: tuple[float, float] | None = None
) -> dict[str, Any]:
    """One estimate; what a method does not give, or what is not finite, is None."""
    return {
        "value": None if value is None else finite(value),
        "sd": None if sd is None else float(sd),
        "interval_95": None if interval_95 is None else [float(interval_95[0]), float(interval_95[1])],
    }
