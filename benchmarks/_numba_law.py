"""The contact law written by hand twice, as compiled loops and as plain NumPy: what `bench_law.py` measures against.

Displacement control, printed form with its limit, raw strain scaling, with the library's own polynomial for the elastic
branch. Every loop takes the branch it needs and no other, and holds the running maximum in a register.
"""

import math

import numba
import numpy as np

from mcc_jax.formulas.contact import RATIO_64

_RATIO = np.array(RATIO_64)
_CONSTANT = 4.12
_SHARE = 3 * math.pi / 8


@numba.njit(inline="always")
def _ratio(s):
    """Stress over peak stress at the recovered share s >= 0 of strain."""
    u = 1 - s
    if u <= 0:
        return 0.0
    z = 2 * u - 1
    value = _RATIO[0]
    for i in range(1, _RATIO.size):
        value = value * z + _RATIO[i]
    return u * math.sqrt(u) * value


@numba.njit(inline="always")
def _force(K1, K3, K5, eta, modulus, diameter, displacement, peak):
    x = eta * peak / diameter
    square = x * x
    secant = K1 - square * (K3 - square * K5)
    if x <= 0 or secant <= 0:
        return 0.0
    stress = x * secant
    if displacement < peak:
        tangent, least = K1 - square * (3 * K3 - 5 * square * K5), _SHARE * secant
        limit = peak * least / max(tangent, least)
        recoverable = min(diameter * math.sqrt(eta * secant / (_CONSTANT * modulus)), limit)
        stress *= _ratio((peak - displacement) / recoverable)
    return stress * (math.pi / 4e3) * diameter * diameter


def _step(C1, C3, C5, a, modulus, D1, D2, D3, peak, displacement):
    new = np.empty_like(peak)
    force = np.empty_like(peak)
    for i in numba.prange(peak.size):
        highest = max(displacement[i], peak[i])
        eta = 1 + a[i] * (1 - D3[i] * D3[i] / (D1[i] * D2[i]))
        K3, K5 = C3[i] ** 3, C5[i] ** 5
        new[i] = highest
        force[i] = _force(C1[i], K3, K5, eta, modulus[i], D1[i] * D2[i] / D3[i], displacement[i], highest)
    return new, force


def _path(C1, C3, C5, a, modulus, D1, D2, D3, peak, displacement):
    new = np.empty_like(peak)
    force = np.empty_like(displacement)
    for i in numba.prange(peak.size):
        eta = 1 + a[i] * (1 - D3[i] * D3[i] / (D1[i] * D2[i]))
        diameter = D1[i] * D2[i] / D3[i]
        K3, K5 = C3[i] ** 3, C5[i] ** 5
        highest = peak[i]
        for t in range(displacement.shape[1]):
            highest = max(highest, displacement[i, t])
            force[i, t] = _force(C1[i], K3, K5, eta, modulus[i], diameter, displacement[i, t], highest)
        new[i] = highest
    return new, force


def compile_kernels(fastmath):
    """`step` and `path` as parallel machine code."""
    compiled = numba.njit(parallel=True, fastmath=fastmath, error_model="numpy")
    return compiled(_step), compiled(_path)


def numpy_step(C1, C3, C5, a, modulus, D1, D2, D3, peak, displacement):
    """`step`, and with parameters of shape (particles, 1) `path`, as one expression over arrays."""
    diameter = D1 * D2 / D3
    eta = 1 + a * (1 - D3 * D3 / (D1 * D2))
    highest = np.maximum(np.maximum.accumulate(displacement, axis=-1) if displacement.ndim > 1 else displacement, peak)
    x = eta * highest / diameter
    square = x * x
    K5 = C5 * C5
    K5 = K5 * K5 * C5
    K3 = C3 * C3 * C3
    secant = np.maximum(C1 - square * (K3 - square * K5), 0)
    carries = (x > 0) & (secant > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        least = _SHARE * secant
        limit = highest * least / np.maximum(C1 - square * (3 * K3 - 5 * square * K5), least)
        drop = (highest - displacement) / np.minimum(diameter * np.sqrt(eta * secant / (_CONSTANT * modulus)), limit)
    u = np.clip(1 - np.where(carries, drop, 1.0), 0, 1)  # nothing recovers where no stress was carried: 0 / 0
    z = 2 * u - 1
    ratio = np.full_like(z, RATIO_64[0])
    for c in RATIO_64[1:]:
        ratio *= z
        ratio += c
    ratio *= u * np.sqrt(u)
    ratio = np.where(displacement >= highest, 1.0, ratio)
    return highest, np.where(carries, x * secant * ratio, 0.0) * (np.pi / 4e3) * diameter * diameter
