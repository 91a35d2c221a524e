"""What the tester makes of the truth: noise, resolution and an arbitrary zero."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import arguments
from .._format import described


@dataclass(frozen=True)
class Instrument:
    """Read-out of a tester; the default is perfect.

    Attributes:
        displacement_noise_um: standard deviation of white noise on displacement [um].
        force_noise_mN: standard deviation of white noise on force [mN].
        displacement_resolution_um: smallest step of displacement [um]; 0 for none.
        force_resolution_mN: smallest step of force [mN]; 0 for none.
        zero_um: standard deviation of each test's zero of displacement [um]: where the tester believed to touch.

    Raises:
        InputError: for a value that is negative or not finite.
    """

    displacement_noise_um: float = 0.0
    force_noise_mN: float = 0.0
    displacement_resolution_um: float = 0.0
    force_resolution_mN: float = 0.0
    zero_um: float = 0.0

    __repr__ = described()

    def __post_init__(self) -> None:
        for name, value in list(vars(self).items()):
            object.__setattr__(self, name, arguments.number(value, name, least=0))

    def read(
        self, rng: np.random.Generator, force_mN: np.ndarray, displacement_um: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Force [mN] and displacement [um] as recorded, from the true ones, shapes (n,)."""
        n = len(force_mN)
        # All draws are made whatever the settings, so that switching one effect on leaves the others' draws alone.
        zero, wobble, hum = rng.standard_normal(), rng.standard_normal(n), rng.standard_normal(n)
        displacement = displacement_um + self.zero_um * zero + self.displacement_noise_um * wobble
        force = force_mN + self.force_noise_mN * hum
        return _rounded(force, self.force_resolution_mN), _rounded(displacement, self.displacement_resolution_um)


def _rounded(values: np.ndarray, step: float) -> np.ndarray:
    return np.round(values / step) * step if step else values
