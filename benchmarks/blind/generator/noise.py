"""What a tester adds to the truth, and its covariance.

Displacement: white read-out noise and an Ornstein-Uhlenbeck residual along the load path (correlation exp(-l / length),
l the path travelled in MPa). Force: white noise on the recorded column. Heavy tails are Student's t with four degrees
of freedom scaled to the same variance; a scale per particle multiplies everything on the displacement.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from .law import MN_PER_MPA_UM2


@dataclass(frozen=True)
class Noise:
    white_um: float = 0.03
    ou_um: float = 0.10
    ou_length_mpa: float = 1.0
    force_mN: float = 0.02
    heavy_tails: bool = False
    scale_sd: float = 0.0  # sd of the logarithm of a particle's scale
    modulus_spread: float = 0.0  # sd of the logarithm of the effective modulus between particles
    snap_through: bool = False

    def record(self):
        return asdict(self)


CLEAN = Noise()
ROUGH = Noise(heavy_tails=True, scale_sd=0.5, modulus_spread=0.10)

# The nulls that tempt a careless analysis into seeing an effect (section 6 of the bars).
NUISANCES = {
    "noise_taken_as_white": (Noise(ou_um=0.15), {"noise": "white"}),
    "long_correlation": (Noise(ou_length_mpa=3.0), {}),
    "heavy_tails": (Noise(heavy_tails=True), {}),
    "particle_scale": (Noise(scale_sd=0.5), {}),
    "modulus_spread": (Noise(modulus_spread=0.10), {}),
    "snap_through": (Noise(snap_through=True), {}),
}


def path_length(particles, path):
    """Load path travelled, MPa."""
    area = np.pi * particles.De[:, None] ** 2 / 4.0 * MN_PER_MPA_UM2
    steps = np.abs(np.diff(path.force / area, axis=1))
    return np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)], axis=1)


def scales(rng, noise, count):
    """Scale of each particle's noise, median one."""
    return np.exp(noise.scale_sd * rng.standard_normal(count))


def draw(rng, noise, length, scale):
    """Noise on the displacement (um) and on the recorded force (mN)."""

    def unit(shape):
        if noise.heavy_tails:
            return rng.standard_t(4, shape) / np.sqrt(2.0)
        return rng.standard_normal(shape)

    keep = np.exp(-np.diff(length, axis=1) / noise.ou_length_mpa)
    fresh = np.sqrt(np.maximum(0.0, 1.0 - keep**2))
    wander = np.empty_like(length)
    # The first value is Gaussian: it stands for everything before the record.
    wander[:, 0] = rng.standard_normal(len(length))
    shocks = unit(keep.shape)
    for j in range(keep.shape[1]):
        wander[:, j + 1] = keep[:, j] * wander[:, j] + fresh[:, j] * shocks[:, j]
    displacement = noise.white_um * unit(length.shape) + noise.ou_um * wander
    return scale[:, None] * displacement, noise.force_mN * rng.standard_normal(length.shape)


def covariance(noise, length, scale, displacement_per_force):
    """Covariance of the displacement read at the recorded force, um^2; (particles, samples, samples).

    An error of the recorded force acts as one of the displacement, by the slope of the curve.
    """
    gap = np.abs(length[:, :, None] - length[:, None, :])
    total = (scale**2)[:, None, None] * noise.ou_um**2 * np.exp(-gap / noise.ou_length_mpa)
    diagonal = (scale[:, None] * noise.white_um) ** 2 + (noise.force_mN * displacement_per_force) ** 2
    index = np.arange(length.shape[1])
    total[:, index, index] += diagonal
    return total
