"""Who is tested, and how."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from . import particles, path


@dataclass(frozen=True)
class Campaign:
    """memory: curves that an effect keeps because they depend on the path alone."""

    particles: particles.Particles
    path: path.Path
    memory: dict[Any, np.ndarray] = field(default_factory=dict)

    @property
    def owner(self) -> np.ndarray:
        """The particle of every sample."""
        return self.path.owner


def draw(
    rng: np.random.Generator,
    count: int = 20,
    protocol: str = "P0",
    *,
    reloads: int = 0,
    wide: bool = False,
    low_turn: bool = False,
    modulus_scatter: float = 0.0,
    shape_scatter: float = 0.0,
    humidity: np.ndarray | None = None,
) -> Campaign:
    """Draw a campaign: particles, then their paths."""
    tested = particles.draw(rng, count, wide, modulus_scatter, shape_scatter, humidity)
    return Campaign(tested, path.draw(rng, tested, protocol, reloads, low_turn))
