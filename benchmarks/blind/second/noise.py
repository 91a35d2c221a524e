"""Noise of the displacement: white, and one that wanders along the load path (Ornstein-Uhlenbeck)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Noise:
    """white, wander: standard deviations in um; length: of the wander, MPa of load path; scale: per particle.

    whitening: for each particle the matrix that makes its noise white, of unit variance.
    """

    heavy: bool
    white: float
    wander: float
    length: float
    scale: np.ndarray
    whitening: tuple[np.ndarray, ...]


def draw(rng, path, kind="clean"):
    """kind: "t4" has tails of Student's t with four degrees and twice the white noise, "scale" a size per particle."""
    count = len(path.slices)
    white, wander, length = rng.uniform(0.025, 0.035), rng.uniform(0.10, 0.15), rng.uniform(0.8, 1.3)
    if kind == "t4":
        white *= 2
    scale = np.exp(0.5 * rng.standard_normal(count)) if kind == "scale" else np.ones(count)
    whitening = []
    for size, samples in zip(scale, path.slices, strict=True):
        at = path.travelled[samples]
        wandering = size**2 * (wander**2 * np.exp(-np.abs(at[:, None] - at[None]) / length))
        covariance = wandering + (size * white) ** 2 * np.eye(len(at))
        whitening.append(np.linalg.inv(np.linalg.cholesky(covariance)))
    return Noise(kind == "t4", white, wander, length, scale, tuple(whitening))


def sample(rng, noise, path):
    """Noise at every sample of the campaign, um."""

    def unit(number):
        return rng.standard_t(4, number) / np.sqrt(2) if noise.heavy else rng.standard_normal(number)

    out = np.empty(len(path))
    for size, samples in zip(noise.scale, path.slices, strict=True):
        at = path.travelled[samples]
        innovation = unit(len(at))
        wander = np.empty(len(at))
        wander[0] = innovation[0]
        kept = np.exp(-np.diff(at) / noise.length)
        for j in range(1, len(at)):
            fresh = np.sqrt(max(0, 1 - kept[j - 1] ** 2))
            wander[j] = kept[j - 1] * wander[j - 1] + fresh * innovation[j]
        out[samples] = size * (noise.wander * wander + noise.white * unit(len(at)))
    return out
