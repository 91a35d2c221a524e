"""What a tester adds to the truth, with its covariance, and the faults it may have. Knows no formula."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .settings import SETTINGS
from .world import World

_T = SETTINGS.testers
_JITTER = 1e-8


@dataclass(frozen=True)
class Noise:
    """Noise of one campaign; standard deviations in um and mN.

    white_um: of every reading. wander_um: of a residual correlated over `length`, in MPa of load path or in s, with the
    kernel "exponential", "matern32" or "matern52". force_mN: of the recorded force. heavy: Student's t with four
    degrees of freedom instead of Gaussian, of the same variance. scale: each particle's own factor on all but force_mN.
    """

    white_um: float
    wander_um: float
    length: float
    along: str
    kernel: str
    force_mN: float
    heavy: bool
    scale: np.ndarray = field(repr=False)

    def record(self) -> dict[str, Any]:
        """As JSON takes it."""
        return {**vars(self), "scale": self.scale.tolist()}


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw(rng: np.random.Generator, kind: str, count: int) -> Noise:
    """Sizes of the noise of a kind (see `settings.Drawing.nulls`)."""
    white, wander = _log_uniform(rng, *_T.white_um), _log_uniform(rng, *_T.wander_um)
    length, along, kernel = _log_uniform(rng, *_T.usual_MPa), "load", "exponential"
    if kind in ("rough", "smooth"):
        wander *= _T.strong_wander
        along = str(rng.choice(["load", "time"]))
        length = _log_uniform(rng, *(_T.length_MPa if along == "load" else _T.length_s))
        kernel = "exponential" if kind == "rough" else str(rng.choice(["matern32", "matern52"]))
    scale = np.exp(_T.scale_sd * rng.standard_normal(count)) if kind == "scale" else np.ones(count)
    return Noise(white, wander, length, along, kernel, float(rng.uniform(*_T.force_mN)), kind == "heavy", scale)


def _correlation(kernel: str, distance: np.ndarray) -> np.ndarray:
    """Correlation at a distance in correlation lengths."""
    if kernel == "exponential":
        return np.exp(-distance)
    if kernel == "matern32":
        x = np.sqrt(3.0) * distance
        return (1.0 + x) * np.exp(-x)
    x = np.sqrt(5.0) * distance
    return (1.0 + x + x * x / 3.0) * np.exp(-x)


def _correlations(noise: Noise, world: World, particle: int) -> np.ndarray:
    at = (world.travelled if noise.along == "load" else world.time)[world.slices[particle]]
    return _correlation(noise.kernel, np.abs(at[:, None] - at[None]) / noise.length)


def slopes(world: World) -> np.ndarray:
    """Change of the displacement with the force at every reading, um/mN; nil where the force stands still."""
    out = np.zeros(len(world.force))
    for s in world.slices:
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.gradient(world.base[s]) / np.gradient(world.force[s])
        out[s] = np.clip(np.where(np.isfinite(slope), slope, 0.0), -_T.steepest_um_per_mN, _T.steepest_um_per_mN)
    return out


def whitening(noise: Noise, world: World) -> list[np.ndarray]:
    """For each particle the matrix that makes its noise white, of unit variance.

    An error of the recorded force acts as one of the displacement, by the slope of the curve.
    """
    slope, out = slopes(world), []
    for i, s in enumerate(world.slices):
        covariance = noise.scale[i] ** 2 * noise.wander_um**2 * _correlations(noise, world, i)
        own = (noise.scale[i] * noise.white_um) ** 2 + (noise.force_mN * slope[s]) ** 2
        covariance[np.diag_indices_from(covariance)] += own
        out.append(np.linalg.inv(np.linalg.cholesky(covariance)))
    return out


def sample(rng: np.random.Generator, noise: Noise, world: World) -> tuple[np.ndarray, np.ndarray]:
    """Noise on displacement (um), zero of each test included, and on the recorded force (mN)."""

    def unit(number: int) -> np.ndarray:
        return rng.standard_t(4, number) / np.sqrt(2.0) if noise.heavy else rng.standard_normal(number)

    displacement = np.empty(len(world.force))
    for i, s in enumerate(world.slices):
        correlations = _correlations(noise, world, i)
        correlations[np.diag_indices_from(correlations)] += _JITTER
        number = len(correlations)
        wander = np.linalg.cholesky(correlations) @ unit(number)
        displacement[s] = noise.scale[i] * (noise.wander_um * wander + noise.white_um * unit(number))
    zero = rng.normal(0.0, _T.zero_um, world.count)
    return displacement + zero[world.owner], noise.force_mN * rng.standard_normal(len(world.force))


@dataclass(frozen=True)
class Readings:
    """What the tester's file holds: one row a reading."""

    owner: np.ndarray
    time: np.ndarray
    force: np.ndarray
    displacement: np.ndarray


def with_fault(rng: np.random.Generator, kind: str, world: World, clean: Readings) -> tuple[Readings, dict[str, Any]]:
    """Readings with a fault of the tester in them, and what it is."""
    if kind == "force_zero":
        peaks = [world.force[s].max() for s in world.slices]
        offset = float(rng.choice([-1, 1]) * rng.uniform(*_T.offset) * np.median(peaks))
        return Readings(clean.owner, clean.time, clean.force + offset, clean.displacement), {"offset_mN": offset}
    if kind == "clipping":
        tops = [clean.displacement[s].max() for s in world.slices]
        limit = float(np.quantile(tops, rng.uniform(*_T.clipped_from)))
        clipped = np.minimum(clean.displacement, limit)
        return Readings(clean.owner, clean.time, clean.force, clipped), {"limit_um": limit}
    if kind == "breakage":
        return _broken(rng, world, clean)
    raise ValueError(f"no fault {kind!r}")


def _broken(rng: np.random.Generator, world: World, clean: Readings) -> tuple[Readings, dict[str, Any]]:
    """Particles that break on the way up: a jump with a dip of the force; half of these records end soon after."""
    force, displacement = clean.force.copy(), clean.displacement.copy()
    kept = np.ones(len(force), bool)
    most = max(1, min(_T.broken[0], world.count // _T.broken[1]))
    broken = np.sort(rng.choice(world.count, int(rng.integers(1, 1 + most)), replace=False))
    for i in broken:
        s = world.slices[i]
        at = s.start + int(np.argmax(world.force[s] >= rng.uniform(*_T.breaks_at) * world.force[s].max()))
        jump = rng.uniform(*_T.jump) * world.diameter[i]
        displacement[at] += 0.5 * jump
        displacement[at + 1 : s.stop] += jump
        force[at : min(at + 3, s.stop)] *= rng.uniform(*_T.dip)
        if rng.random() < 0.5:
            kept[at + int(rng.integers(*_T.rows_after)) : s.stop] = False
    readings = Readings(clean.owner[kept], clean.time[kept], force[kept], displacement[kept])
    return readings, {"particles": [str(i + 1) for i in broken]}
