"""The pair of half contacts, by bisection: slow and plain, the reference of what other engines get."""

from __future__ import annotations

import math

import numpy as np

from ..geometry import Particle
from ..law import MccLaw
from ._card import stress_power

Numbers = np.ndarray | float
HALVINGS = 1100  # down to the smallest floating-point number


class _Half:
    """One side: F = F_plates(2 d), in mN and um, with Python floats."""

    def __init__(self, law: MccLaw, particle: Particle) -> None:
        self.eta = float(law.shape_factor(particle))
        self.diameter = float(particle.effective_diameter)
        self.area = 1e-3 * float(particle.effective_area)
        self.K = [float(K) for K in law.plastic.polynomial]
        self.modulus = float(law.effective_modulus)
        self.k, self.n, self.p = law.unloading.constant, stress_power(law), law.strain_scaling.power

    def stress(self, d: float) -> float:
        x = 2 * self.eta * d / self.diameter
        K1, K3, K5 = self.K
        return max(K1 * x - K3 * x**3 + K5 * x**5, 0.0)

    def force(self, d: float) -> float:
        return self.area * self.stress(d)

    def slope(self, d: float) -> float:
        x = 2 * self.eta * d / self.diameter
        K1, K3, K5 = self.K
        return self.area * (K1 - 3 * K3 * x**2 + 5 * K5 * x**4) * 2 * self.eta / self.diameter

    def recovered(self, d: float) -> float:
        strain = 2 * d / self.diameter
        if not strain > 0:
            return 0.0
        square = (self.stress(d) / self.modulus) ** self.n / (self.k * self.eta**self.p * strain)
        return self.diameter * math.sqrt(square) / 2


def pair_force(
    law_i: MccLaw,
    particle_i: Particle,
    law_j: MccLaw,
    particle_j: Particle | None,
    overlap: Numbers,
    overlap_max: Numbers,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r"""Force, tangent and recoverable overlap of two half contacts in series.

    Each side is half a platen test, :math:`F_s(d) = F_{plates}(2d)`. On loading the overlap is shared so that both
    carry one force, :math:`d_i + d_j = \delta, F_i(d_i) = F_j(d_j)`. Both unload along one curve of
    :math:`\sigma/\sigma_P`, so that

    .. math:: F = F_P g(q), \quad q = (\delta_P - \delta)/W, \quad W = W_i + W_j

    Args:
        law_i: law of one particle; monotone, or the share is not unique.
        particle_i: its size; D3 along the contact's normal.
        law_j: law of the other.
        particle_j: its size; None for a rigid wall.
        overlap: overlap now [um], one or many.
        overlap_max: the largest so far [um], not below `overlap`.

    Returns:
        Force [mN], dF/d overlap [mN/um] (that of loading at the peak), and W [um].
    """
    i = _Half(law_i, particle_i)
    j = None if particle_j is None else _Half(law_j, particle_j)
    x, peak = np.broadcast_arrays(np.asarray(overlap, float), np.asarray(overlap_max, float))
    rows = [_respond(i, j, one, most) for one, most in zip(x.ravel().tolist(), peak.ravel().tolist(), strict=True)]
    force, tangent, width = np.array(rows).reshape(-1, 3).T
    return force.reshape(x.shape), tangent.reshape(x.shape), width.reshape(x.shape)


def _respond(i: _Half, j: _Half | None, overlap: float, overlap_max: float) -> tuple[float, float, float]:
    d = overlap_max if j is None else _share(i, j, overlap_max)
    peak, width = i.force(d), i.recovered(d)
    slope = i.slope(d)
    if j is not None:
        rest = overlap_max - d
        slope_j = j.slope(rest)
        # A stiff side alone would carry the rounding of its share.
        peak = (peak * slope_j + j.force(rest) * slope) / (slope + slope_j)
        slope = slope * slope_j / (slope + slope_j)
        width += j.recovered(rest)
    if overlap >= overlap_max:
        return peak, slope, width
    q = (overlap_max - overlap) / width if width > 0 else 1.0
    if q >= 1:
        return 0.0, 0.0, width
    root = math.sqrt((1 - q) * (1 + q))
    return peak * 2 / math.pi * (math.acos(q) - q * root), 4 / math.pi * peak * root / width, width


def _share(i: _Half, j: _Half, overlap: float) -> float:
    low, high = 0.0, overlap
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        if i.force(middle) > j.force(overlap - middle):
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)
