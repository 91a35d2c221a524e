"""Time of samples whose file has no column of time: from the interval between them, or from the speed of travel."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from .mapping import Pace


def paced(displacement_um: np.ndarray, order: np.ndarray, pace: Pace) -> np.ndarray:
    """Times [s] of the samples, never decreasing; the first row of the test is at 0.

    With a speed v the time is the length of the path gone so far over v. The path runs from one turning point to the
    next; between two of them no time passes until the displacement exceeds what it had reached, so that noise adds
    nothing. A displacement that stands still (a hold at constant displacement) takes no time, which no file without
    times can tell otherwise.

    Args:
        displacement_um: displacement [um], shape (n,).
        order: number of each sample's row in its test, from 0; rows with missing readings count, shape (n,).
        pace: interval, or speed and the least reversal.

    Returns:
        Times [s], shape (n,).
    """
    if pace.interval_s is not None:
        return pace.interval_s * order
    assert pace.speed_um_per_s is not None
    path = np.zeros(len(displacement_um))
    turns = turning_points(displacement_um, pace.reversal_share * float(np.ptp(displacement_um)))
    gone = 0.0
    for start, stop in pairwise(turns):
        leg = displacement_um[start : stop + 1]
        sign = 1.0 if leg[-1] >= leg[0] else -1.0
        path[start : stop + 1] = gone + np.maximum.accumulate(sign * (leg - leg[0]))
        gone = float(path[stop])
    with np.errstate(over="ignore"):  # the caller checks the size
        return path / pace.speed_um_per_s


def turning_points(values: np.ndarray, least: float) -> list[int]:
    """Indices where values turn round by more than `least`, with the first and the last index around them."""
    turns, low, high, direction = [0], 0, 0, 0
    for i, value in enumerate(values.tolist()):
        low = i if value < values[low] else low
        high = i if value > values[high] else high
        if direction >= 0 and value < values[high] - least:
            if direction > 0:
                turns.append(high)
            low, direction = i, -1
        elif direction <= 0 and value > values[low] + least:
            if direction < 0:
                turns.append(low)
            high, direction = i, 1
    return [*turns, len(values) - 1] if turns[-1] != len(values) - 1 else turns
