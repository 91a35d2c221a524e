"""The pair of half contacts, by bisection: slow and plain, the reference of what other engines get."""

import numpy as np
from numpy.polynomial import Polynomial

from mcc_jax import MccLaw, Particle

HALVINGS = 1100  # down to the smallest floating-point number


class _Half:
    """One side: F = F_plates(2 d), in mN and um; `force` and `slope` of a compression d on loading."""

    def __init__(self, law: MccLaw, particle: Particle) -> None:
        self.law, self.eta, self.diameter = law, float(law.shape_factor(particle)), float(particle.effective_diameter)
        self.area, x = 1e-3 * float(particle.effective_area), 2 * self.eta / self.diameter
        K1, K3, K5 = (float(K) for K in law.plastic.polynomial)
        self.force = Polynomial(self.area * np.array([0, K1 * x, 0, -K3 * x**3, 0, K5 * x**5]))
        self.slope = self.force.deriv()

    def recovered(self, d: np.ndarray) -> np.ndarray:
        k, n, p = self.law.unloading.constant, self.law.unloading.stress_power, self.law.strain_scaling.power
        d, peak, slope = np.where(d > 0, d, 1.0), self.force(d), self.slope(d)
        square = (peak / self.area / float(self.law.effective_modulus)) ** n / (k * self.eta**p * 2 * d / self.diameter)
        # No more than the peak itself, and no softer at the start of unloading than 32/(3 pi^2) times loading's end.
        limit = np.where(slope > 0, np.minimum(d, 3 * np.pi / 8 * peak / np.where(slope > 0, slope, 1.0)), d)
        return np.where(peak > 0, np.minimum(self.diameter * np.sqrt(square) / 2, limit), 0.0)


def pair_force(law_i, particle_i, law_j, particle_j, overlap, overlap_max):
    """Force [mN], its derivative [mN/um] (that of loading at the peak) and recoverable overlap [um] of a pair.

    Each side is half a platen test; on loading the overlap is shared so that both carry one force, and both unload
    along one curve of stress over peak stress. Laws are monotone; no `particle_j` is a rigid wall.
    """
    i = _Half(law_i, particle_i)
    j = None if particle_j is None else _Half(law_j, particle_j)
    shape = np.broadcast_shapes(np.shape(overlap), np.shape(overlap_max))
    x, x_max = (np.broadcast_to(np.asarray(v, float), shape).ravel() for v in (overlap, overlap_max))
    d = x_max if j is None else _share(i, j, x_max)
    peak, width, slope = i.force(d), i.recovered(d), i.slope(d)
    if j is not None:
        rest = x_max - d
        slope_j = j.slope(rest)
        # A stiff side alone would carry the rounding of its share.
        peak = (peak * slope_j + j.force(rest) * slope) / (slope + slope_j)
        slope = slope * slope_j / (slope + slope_j)
        width = width + j.recovered(rest)
    q = np.where(width > 0, (x_max - x) / np.where(width > 0, width, 1.0), 1.0).clip(0.0, 1.0)
    root = np.sqrt((1 - q) * (1 + q))
    loading = x >= x_max
    force = np.where(loading, peak, peak * 2 / np.pi * (np.arccos(q) - q * root))
    tangent = np.where(loading, slope, 4 / np.pi * peak * root / np.where(width > 0, width, 1.0))
    return force.reshape(shape), tangent.reshape(shape), width.reshape(shape)


def _share(i: _Half, j: _Half, overlap: np.ndarray) -> np.ndarray:
    low, high = np.zeros_like(overlap), overlap
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if not ((low < middle) & (middle < high)).any():
            break
        too_far = i.force(middle) > j.force(overlap - middle)
        low, high = np.where(too_far, low, middle), np.where(too_far, middle, high)
    return 0.5 * (low + high)
