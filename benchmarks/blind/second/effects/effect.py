"""What an effect is: a formula, its drawn numbers, and the steps of the law it changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np

from ..campaign import Campaign as Campaign

Array = np.ndarray
State = SimpleNamespace
Range = tuple[str, float, float]


@dataclass(frozen=True)
class Formula:
    """One formula; called with random numbers it gives an effect.

    text: the formula with the amplitude th. steps: what of the law it changes, see `Effect`; each is called with the
    amplitude first and the effect's numbers n last. numbers: name and how it is drawn, evenly ("even", also in the
    logarithm, "log", or whole, "whole"). start: a usual amplitude, in `unit`. protocols: those that can show it.
    reloads: further cycles it asks for. largest: bound of the amplitude. signed: whether both signs occur. humidity,
    wide, low_turn: what particles and path must have.
    """

    mechanism: str
    name: str
    text: str
    steps: Mapping[str, Callable]
    numbers: Mapping[str, Range] = field(default_factory=dict)
    start: float = 1.0
    unit: str = "-"
    protocols: tuple[str, ...] = ("P0", "P1")
    reloads: int = 0
    largest: float = np.inf
    signed: bool = False
    humidity: bool = False
    wide: bool = False
    low_turn: bool = False

    def __call__(self, rng: np.random.Generator) -> Effect:
        sign = int(rng.choice([-1, 1])) if self.signed else 1
        return Effect(self, SimpleNamespace(sign=sign, **{k: _draw(rng, *how) for k, how in self.numbers.items()}))


def _draw(rng: np.random.Generator, how: str, low: float, high: float) -> float | int:
    if how == "whole":
        return int(rng.integers(int(low), int(high)))
    return float(np.exp(rng.uniform(np.log(low), np.log(high))) if how == "log" else rng.uniform(low, high))


@dataclass(frozen=True, eq=False)
class Effect:
    """A formula with its numbers; a hidden effect is a pair (effect, amplitude). Steps it lacks change nothing.

    theta is the amplitude, c the campaign, s the state of `law.simulate`.
    """

    formula: Formula
    n: SimpleNamespace

    def changes(self, step: str) -> bool:
        """Whether the formula has that step."""
        return step in self.formula.steps

    def _step(self, step: str, otherwise: Array | float | None, theta: float, *given: object) -> Array | float:
        return self.formula.steps[step](theta, *given, self.n) if self.changes(step) else otherwise

    def coefficients(self, theta: float, c: Campaign, values: State) -> None:
        """Change C1, C3, C5, modulus and eta of the particles in place."""
        self._step("coefficients", None, theta, c, values)

    def loading(self, theta: float, terms: State) -> None:
        """Change the terms of the loading curve in place."""
        self._step("loading", None, theta, terms)

    def stress(self, theta: float, c: Campaign, peak: Array, stress: Array) -> tuple[Array, Array]:
        """Largest stress so far and stress that the particle feels."""
        return self.formula.steps["stress"](theta, c, self.n) if self.changes("stress") else (peak, stress)

    def modulus(self, theta: float, c: Campaign, s: State) -> Array | float:
        """Factor of the modulus."""
        return self._step("modulus", 1.0, theta, c, s)

    def unloading(self, theta: float, c: Campaign, s: State, recovered: Array, ratio: Array) -> Array:
        """Stress over sigma_P at the recovered fraction: what the formula adds to the ratio."""
        return ratio + self._step("unloading", 0.0, theta, c, s, recovered)

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        """Displacement in um beside the law's."""
        return self._step("displacement", 0.0, theta, c, s)

    def describe(self) -> str:
        """The formula with its numbers."""
        numbers = {name: f"{v:.4g}" if isinstance(v, float) else v for name, v in vars(self.n).items()}
        return self.formula.text.format(sg="+" if self.n.sign > 0 else "-", **numbers)
