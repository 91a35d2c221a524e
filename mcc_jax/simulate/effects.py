"""Effects hidden in simulated tests: which one, how strong, and what each test draws."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import number
from ..effects import LIBRARY, AbstractEffect, Mechanism, Variant, find_variant

_STREAM = 0x0EFF_EC75
"""Separates the draws of effects from those of noise, coefficients and peaks."""


@dataclass(frozen=True)
class HiddenEffect:
    """An effect for `simulate_campaign`.

    Attributes:
        variant: its formula.
        amplitude: its strength in the variant's unit; where the variant differs at random from test to test, the
            standard deviation. The middle of the plausible range if None.
        nuisance: nuisance parameters by name, the same in all tests; those not given take the variant's middle value,
            or are drawn for every test where the variant says so.

    Raises:
        ValueError: for an amplitude or a nuisance parameter without sense.
    """

    variant: Variant
    amplitude: float | None = None
    nuisance: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        variant = self.variant

        def wrong(what: str, must: str, value: Any) -> InputError:
            return InputError(f"{variant.label}: {what} must be {must}, got {value}")

        if self.amplitude is not None and not arguments.is_number(self.amplitude):
            raise wrong(variant.parameter, "a number", arguments.shown(self.amplitude))
        if not math.isfinite(self.strength) or abs(self.strength) > 1e9:
            raise wrong(variant.parameter, "a number of sensible size", f"{self.strength:g}")
        if self.strength * variant.sign < 0:
            sign = "positive" if variant.sign > 0 else "negative"
            raise wrong(variant.parameter, f"zero or {sign} to be physical", f"{self.strength:g}")
        variant.check_names(self.nuisance)
        least = {n.name: n.plausible[0] for n in variant.nuisances}
        for key, value in self.nuisance.items():
            if not arguments.is_number(value):
                raise wrong(key, "a number", arguments.shown(value))
            if not math.isfinite(value) or abs(value) > 1e9 or (least[key] > 0 and value <= 0):
                raise wrong(key, "above 0" if least[key] > 0 else "finite", f"{value:g}")

    def __repr__(self) -> str:
        named = ", ".join(f"{name} {number(value)}" for name, value in self.numbers.items())
        drawn = f"; drawn for every test: {', '.join(self.random)}" if self.random else ""
        return f"HiddenEffect {self.variant.label}: {named}{drawn}"

    @property
    def strength(self) -> float:
        """The amplitude, or the middle of the plausible range."""
        return self.variant.typical if self.amplitude is None else self.amplitude

    @property
    def numbers(self) -> dict[str, float]:
        """Amplitude and nuisance parameters by name, as given or the variant's own."""
        middle = {n.name: n.middle for n in self.variant.nuisances}
        return {self.variant.parameter: self.strength, **middle, **self.nuisance}

    def draw(self, seed: int, place: int, count: int) -> tuple[AbstractEffect, dict[str, np.ndarray]]:
        """The effect of every test: one whose every field has a leading axis N, and its parameters by name, shape (N,).

        Each effect of a campaign has a stream of draws of its own, by the campaign's seed and its place among them.
        """
        values = {name: np.full(count, value) for name, value in self.numbers.items()}
        for i, name in enumerate(self.random):
            # A stream for each test: adding one leaves the others as they were.
            sources = np.random.SeedSequence([seed, _STREAM, place, i]).spawn(count)
            streams = [np.random.default_rng(source) for source in sources]
            if name == self.variant.parameter:
                values[name] = self.strength * np.array([rng.standard_normal() for rng in streams])
            else:  # between the ends of the grid where it is positive, as far as is plausible otherwise
                nuisance = next(n for n in self.variant.nuisances if n.name == name)
                low, high = nuisance.plausible
                if low > 0:
                    low, high = min(nuisance.grid), max(nuisance.grid)
                share = np.array([rng.random() for rng in streams])
                values[name] = low * (high / low) ** share if low > 0 else low + (high - low) * share
        arrays = {name: jnp.asarray(drawn, dtype=float) for name, drawn in values.items()}
        amplitude = arrays.pop(self.variant.parameter)
        build: Any = lambda amplitude, further: self.variant.build(amplitude, **further)  # noqa: E731
        return eqx.filter_vmap(build)(amplitude, arrays), values

    @property
    def random(self) -> tuple[str, ...]:
        """Names of the parameters that every test draws for itself."""
        names = [self.variant.parameter] if self.variant.random_per_test else []
        names += [n.name for n in self.variant.nuisances if n.random_per_test and n.name not in self.nuisance]
        return tuple(names)

    def describe(self) -> dict[str, Any]:
        """For the campaign's metadata."""
        drawn = [name for name in self.random if name != self.variant.parameter]
        return {
            "mechanism": self.variant.mechanism,
            "variant": self.variant.name,
            **{name: float(value) for name, value in self.numbers.items() if name not in drawn},
            "random_per_test": list(self.random),
        }


def read_effect(text: str, library: Mapping[str, Mechanism] = LIBRARY) -> HiddenEffect:
    """An effect as text: `mechanism[:variant][=amplitude][,parameter=value...]`.

    Raises:
        ValueError: in words, naming the valid choices.
    """
    head, *rest = text.split(",")
    name, equals, value = head.partition("=")
    variant = find_variant(name.strip(), library)
    given = [(variant.parameter, value)] if equals else []
    for part in rest:
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals:
            raise InputError(f"{part!r} is no parameter=value")
        given.append((key, value))
    numbers: dict[str, float] = {}
    for key, value in given:
        if key in numbers:
            raise InputError(f"{key} is given twice")
        try:
            numbers[key] = float(value)
        except ValueError:
            raise InputError(f"{key} must be a number, got {value!r}") from None
    return HiddenEffect(variant, numbers.pop(variant.parameter, None), numbers)


def hidden_effects(effects: Any) -> tuple[HiddenEffect, ...]:
    """Several hidden effects; one alone is a tuple of one. Raises `InputError` if one of them is none."""
    if isinstance(effects, HiddenEffect):
        return (effects,)
    remedy = 'Make each with mcc_jax.simulate.read_effect("creep").'
    if isinstance(effects, str | Variant) or not isinstance(effects, Iterable):
        raise InputError(f"effects must be a list of HiddenEffect, got {arguments.kind_of(effects)}", remedy=remedy)
    return tuple(effects)


def humidities_of(values: Any, count: int) -> np.ndarray:
    """Relative humidity of every test [%], shape (N,), all from 0 to 100."""
    found = arguments.floats(values, "relative_humidity_percent", shape="one number from 0 to 100 for every test")
    if found.shape != (count,) or not ((found >= 0) & (found <= 100)).all():
        raise InputError(
            f"relative_humidity_percent must be {count} numbers from 0 to 100, one for every test, "
            f"got {arguments.shown(found.tolist())}"
        )
    return found
