"""A formula of a hidden effect, and an effect: a formula in given circumstances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

Array = np.ndarray
State = SimpleNamespace
Hooks = dict[str, Callable[..., Array]]

RELOAD, HUMIDITY = "a reload segment", "humidity column"


@dataclass(frozen=True)
class Form:
    """One formula.

    mechanism: listed name, or the formula's own for an unlisted one. form: "exact" or the variant's name. unit: size of
    a usual amplitude. plausible: amplitudes the literature knows. signs: the physically possible ones. needs: what a
    campaign must have. draw: random circumstances (rng, count) -> dictionary. build: hooks for these circumstances.
    """

    mechanism: str
    form: str
    equation: str
    unit: float
    build: Callable[..., Hooks]
    plausible: tuple[float, float] = (0.0, np.inf)
    signs: tuple[int, ...] = (1,)
    needs: tuple[str, ...] = ()
    draw: Callable[[np.random.Generator, int], dict[str, Any]] = lambda rng, count: {}
    largest: float = np.inf
    parameter: str = ""


@dataclass(frozen=True)
class Effect:
    """A form in given circumstances; `effect(amplitude)` is what `law.simulate` takes."""

    form: Form
    circumstances: dict[str, Any] = field(default_factory=dict)
    sign: int = 1

    @property
    def unit(self) -> float:
        return self.form.unit

    def __call__(self, amplitude: float) -> tuple[tuple[Hooks, float], ...]:
        return ((self.form.build(**self.circumstances), self.sign * amplitude),)
