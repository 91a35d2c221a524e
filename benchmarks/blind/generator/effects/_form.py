"""A formula of a hidden effect, and an effect: a formula in given circumstances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

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
    build: Callable
    plausible: tuple[float, float] = (0.0, np.inf)
    signs: tuple[int, ...] = (1,)
    needs: tuple[str, ...] = ()
    draw: Callable = lambda rng, count: {}
    largest: float | None = None
    parameter: str = ""


@dataclass(frozen=True)
class Effect:
    """A form in given circumstances; `effect(amplitude)` is what `law.simulate` takes."""

    form: Form
    circumstances: dict = field(default_factory=dict)
    sign: int = 1

    @property
    def unit(self):
        return self.form.unit

    def __call__(self, amplitude):
        return ((self.form.build(**self.circumstances), self.sign * amplitude),)
