"""Particles of one campaign: sizes, material, and the chance events that effects may use."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

TABLE_1 = np.array(
    [
        *([213.54, 196.07, 186.33], [155.32, 217.51, 136.87], [168.74, 171.64, 125.15], [97.56, 100.98, 69.09]),
        *([238.47, 249.24, 237.81], [93.8, 76.46, 52.85], [160.44, 167.7, 151.3], [114.1, 114.54, 80.98]),
        *([168.31, 144.54, 131.27], [133.8, 117.12, 103.38], [122.69, 131.73, 109.91], [121.04, 205.93, 133.08]),
        *([185.1, 206.98, 146.91], [180.35, 173.88, 139.81], [173.26, 157.3, 147.79], [296.34, 267.76, 219.78]),
        *([219.5, 281.94, 225.55], [194.97, 167.95, 151.23], [105.57, 109.25, 86.46], [154.12, 182.82, 166.13]),
    ]
)
"""The paper's particles: D1, D2, D3 in um."""

LOG_C_MEAN = np.array([1.9027, 1.1015, 0.9784])
LOG_C_SD = np.array([0.2985, 4.8914e-9, 0.0797])
"""Of ln C1, ln C3, ln C5."""

SHAPE_PARAMETER, SHAPE_SPREAD = 1.43, 0.06
MODULUS_MPA, MODULUS_SPREAD = 16000.0, 0.07
"""Effective modulus and the standard deviation of its logarithm between campaigns."""

MIN_SLOPE = 0.2
"""The least slope of a drawn loading curve, over its initial slope."""

MN_PER_MPA_UM2, MPA_UM2_PER_MN = 1e-3, 1e3
MAX_BURSTS = 12


@dataclass(frozen=True)
class Particles:
    """One row per particle.

    D: D1, D2, D3 in um. C: C1, C3, C5. a: shape parameter. mean_modulus, modulus: in MPa. normal, uniform: (particles,
    8) random numbers at the effects' disposal; bursts: of each particle a number, sizes and strengths. humidity: in %.
    """

    D: np.ndarray
    C: np.ndarray
    a: float
    mean_modulus: float
    modulus: np.ndarray
    normal: np.ndarray
    uniform: np.ndarray
    bursts: tuple[tuple[int, np.ndarray, np.ndarray], ...]
    humidity: np.ndarray | None

    def __len__(self) -> int:
        return len(self.D)

    @cached_property
    def De(self) -> np.ndarray:
        return self.D[:, 0] * self.D[:, 1] / self.D[:, 2]

    @cached_property
    def Re(self) -> np.ndarray:
        return self.De / 2

    @cached_property
    def area(self) -> np.ndarray:
        """mN per MPa."""
        return np.pi * self.Re**2 * MN_PER_MPA_UM2

    @cached_property
    def q(self) -> np.ndarray:
        return self.D[:, 2] ** 2 / (self.D[:, 0] * self.D[:, 1])


def least_slope(C1: np.ndarray, C3: np.ndarray, C5: np.ndarray) -> np.ndarray:
    """The least slope of the loading polynomial over its slope at zero."""
    x2 = 0.3 * C3**3 / C5**5
    return (C1 - 3 * C3**3 * x2 + 5 * C5**5 * x2**2) / C1


@cache
def population_means() -> np.ndarray:
    """Means of ln C1, ln C3, ln C5 over what is drawn: steep enough curves only."""
    rng = np.random.default_rng(0)
    logs = LOG_C_MEAN + LOG_C_SD * rng.standard_normal((200_000, 3))
    return logs[least_slope(*np.exp(logs.T)) > MIN_SLOPE].mean(0)


def humidity_levels(rng: np.random.Generator, count: int) -> np.ndarray:
    """Relative humidity in % per particle: four chambers and what a sensor reads there."""
    levels = np.array([11.0, 33.0, 54.0, 75.0])
    return np.round(levels[rng.permutation(count) % 4] + np.round(rng.uniform(-2, 2, count), 1), 1)


def draw(
    rng: np.random.Generator,
    count: int,
    wide: bool = False,
    modulus_scatter: float = 0.0,
    shape_scatter: float = 0.0,
    humidity: np.ndarray | None = None,
) -> Particles:
    """A population like the paper's; `wide` spreads its sizes over a factor of four."""
    a = SHAPE_PARAMETER + SHAPE_SPREAD * rng.standard_normal()
    mean_modulus = MODULUS_MPA * np.exp(MODULUS_SPREAD * rng.standard_normal())
    C, D = np.empty((count, 3)), np.empty((count, 3))
    for i in range(count):
        C[i] = _coefficients(rng)
        D[i] = np.round(_sizes(rng, i, count, wide), 2)
    C *= np.exp(shape_scatter * rng.standard_normal((count, 1)))
    modulus = mean_modulus * np.exp(modulus_scatter * rng.standard_normal(count))
    normal, uniform = rng.standard_normal((count, 8)), rng.random((count, 8))
    bursts = tuple(_bursts(rng) for _ in range(count))
    return Particles(D, C, a, mean_modulus, modulus, normal, uniform, bursts, humidity)


def _coefficients(rng: np.random.Generator) -> np.ndarray:
    while True:
        C = np.exp(LOG_C_MEAN + LOG_C_SD * rng.standard_normal(3))
        if least_slope(*C) > MIN_SLOPE:
            return C


def _sizes(rng: np.random.Generator, i: int, count: int, wide: bool) -> np.ndarray:
    own_row = count == len(TABLE_1) and not wide and rng.random() < 0.5
    row = TABLE_1[i] if own_row else TABLE_1[rng.integers(len(TABLE_1))]
    scale = np.exp(rng.uniform(np.log(0.45), np.log(2.0))) if wide else np.exp(0.10 * rng.standard_normal())
    while True:
        D = row * scale * np.exp(0.05 * rng.standard_normal(3))
        if 0.3 < D[2] ** 2 / (D[0] * D[1]) < 1.0:
            return D


def _bursts(rng: np.random.Generator) -> tuple[int, np.ndarray, np.ndarray]:
    number = 1 + rng.poisson(2.0)
    return number, rng.exponential(1.0, MAX_BURSTS), rng.weibull(4.0, MAX_BURSTS)
