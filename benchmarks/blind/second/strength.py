"""Amplitudes that give an effect its lambda."""

from __future__ import annotations

import numpy as np

from .law import simulate
from .projection import MODES

_CLOSE = 0.006
_ROUNDS = 14


def amplitude_for(projection, effect, target, mode, cap_share=1.0):
    """Amplitude at which lambda first reaches `target`, and the lambda reached; never above the formula's bound.

    cap_share: part of that bound to keep to.
    """
    campaign = projection.campaign
    cap = (effect.largest or np.inf) * cap_share
    small = min(effect.start, cap) * 1e-2
    left = projection.project(simulate(campaign, [(effect, small)]) - projection.base, mode)
    theta = min(cap, 0.7 * small * target / max(1e-9, np.linalg.norm(left)))
    low, high, reached = (0.0, 0.0), None, 0
    for _ in range(_ROUNDS):
        hidden = [(effect, theta)]
        reached = projection.distance(simulate(campaign, hidden), mode, hidden)
        if abs(reached / target - 1) < _CLOSE or (theta >= cap and reached < target):
            break
        if reached < target:
            low = (theta, reached)
        else:
            high = (theta, reached)
        if high is None:
            theta = min(cap, theta * float(np.clip(target / max(reached, 1e-6), 1.02, 1.6)))
        else:
            width = high[0] - low[0]
            theta = low[0] + width * (target - low[1]) / (high[1] - low[1])
            theta = float(np.clip(theta, low[0] + 0.1 * width, high[0] - 0.02 * width))
    return float(theta), float(reached)


def in_all_modes(projection, curves, hidden):
    """Lambda by mode of the projection."""
    return {mode: round(float(projection.distance(curves, mode, hidden)), 2) for mode in MODES}
