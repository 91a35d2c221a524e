"""The pair law the long way: two internal variables for each side, the split by bisection, in NumPy."""

import numpy as np
from scipy.optimize import brentq


def _numbers(side):
    return tuple(float(x) for x in (side.k1, side.k3, side.k5, side.c)), side.power


def _load(numbers, d):
    k1, k3, k5, _ = numbers
    return k1 * d - k3 * d**3 + k5 * d**5


def _force(numbers, power, d, d_max):
    """Force of one side at its own compression d, from its own peak."""
    if d >= d_max:
        return _load(numbers, max(d, 0.0))
    peak = _load(numbers, d_max)
    if peak <= 0:
        return 0.0
    span = np.sqrt(numbers[3] * (peak / d_max) ** power * d_max ** (power - 1))
    s = (d_max - d) / span
    if s >= 1:
        return 0.0
    # arccos loses digits near both ends; arctan2 of the same triangle does not.
    chord = np.sqrt((1 - s) * (1 + s))
    return peak * 2 / np.pi * (np.arctan2(chord, s) - s * chord)


def bisected_path(i, j, overlaps):
    """Forces along a path of overlaps [m] of one pair; each side remembers its own largest compression."""
    (ni, power), (nj, _) = _numbers(i), _numbers(j)
    max_i = max_j = 0.0
    forces = []
    for overlap in overlaps:

        def excess(d, overlap=overlap, max_i=max_i, max_j=max_j):
            return _force(ni, power, d, max_i) - _force(nj, power, overlap - d, max_j)

        low, high = min(0.0, overlap) - 1e-6, max(overlap, 0.0) + 1e-6
        if excess(low) >= 0 or excess(high) <= 0:
            forces.append(0.0)  # released: no compression of either side makes a force
            continue
        d = brentq(excess, low, high, xtol=1e-30, rtol=8.9e-16, maxiter=500)
        forces.append(_force(ni, power, d, max_i))
        max_i, max_j = max(max_i, d), max(max_j, overlap - d)
    return np.array(forces)
