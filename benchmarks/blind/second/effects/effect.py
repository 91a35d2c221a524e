"""What an effect is: a formula, its drawn numbers, and the steps of the law it changes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from ..campaign import Campaign as Campaign

Array = np.ndarray
State = SimpleNamespace


class Effect:
    """One formula with its own numbers; a hidden effect is a pair (effect, amplitude).

    mechanism: listed name, or "unlisted". text: the formula with the amplitude th. start: a usual amplitude, in `unit`.
    protocols: those that can show it. reloads: further cycles it asks for. largest: bound of the amplitude. signed:
    whether both signs occur. humidity, wide, low_turn: what particles and path must have.

    Every method is without effect unless a subclass replaces it. theta is the amplitude, c the campaign, s the state of
    `law.simulate`.
    """

    mechanism = ""
    text = ""
    start = 1.0
    unit = ""
    protocols = ("P0", "P1")
    reloads = 0
    largest = np.inf
    signed = False
    humidity = False
    wide = False
    low_turn = False

    def __init__(self, rng: np.random.Generator) -> None:
        self.sign = rng.choice([-1, 1]) if self.signed else 1
        self.drawn = SimpleNamespace(**self.draw(rng))

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        """The formula's numbers."""
        return {}

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        """Change C1, C3, C5, modulus and eta of the particles in place."""

    def loading(self, theta: float, terms: State) -> None:
        """Change the terms of the loading curve in place."""

    def stress(self, theta: float, c: Campaign, peak: Array, stress: Array) -> tuple[Array, Array]:
        """Largest stress so far and stress that the particle feels."""
        return peak, stress

    def modulus(self, theta: float, c: Campaign, s: State) -> Array | float:
        """Factor of the modulus."""
        return 1.0

    def unloading(self, theta: float, c: Campaign, s: State, recovered: Array, ratio: Array) -> Array:
        """Stress over sigma_P at the recovered fraction."""
        return ratio

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        """Displacement in um beside the law's."""
        return 0.0

    def changes(self, step: str) -> bool:
        """Whether this effect replaces the method of that name."""
        return getattr(type(self), step) is not getattr(Effect, step)

    def describe(self) -> str:
        """The formula with its numbers."""
        numbers = {name: f"{v:.4g}" if isinstance(v, float) else v for name, v in vars(self.drawn).items()}
        return self.text.format(sg="+" if self.sign > 0 else "-", **numbers)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between the two, even in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def power(x: Array, exponent: float) -> Array:
    """x to the exponent, safe at zero."""
    return np.maximum(x, 1e-12) ** exponent
