"""What is known about an effect before any data: its formula, its unit, its sign, what it takes to see it."""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import jax.numpy as jnp

from .. import arguments
from .._errors import InputError
from .._format import described, in_words, number, table
from .._types import ScalarLike, scalar
from .effect import AbstractEffect


class Need(enum.Enum):
    """What a campaign must contain to show an effect; the value says it in words."""

    LOW_LOAD = "points at low load"
    UNLOADING = "an unloading segment"
    HOLD = "a hold under load"
    RELOAD = "a reload segment"
    SECOND_RELOAD = "a second reload segment"
    LONG_TIME = "tests of several minutes"
    TWO_RATES = "two loading rates or more"
    SEVERAL_SIZES = "particles of several sizes"
    SEVERAL_SHAPES = "particles of several shapes"
    SEVERAL_PEAKS = "several peak loads, of particles or of cycles"
    HUMIDITY_COLUMN = "a column relative_humidity_percent with more than one value"


@dataclass(frozen=True)
class Nuisance:
    """A further number of a formula, without meaning while the amplitude is zero.

    It is absolute (seconds, MPa, mN, a share of the particle's own peak), never relative to a whole test.

    Attributes:
        name: with the unit.
        grid: the few values at which to look for the effect.
        plausible: smallest and largest sensible value.
        random_per_test: whether every test has a value of its own.
    """

    name: str
    grid: tuple[float, ...]
    plausible: tuple[float, float]
    explanation: str
    random_per_test: bool = False

    __repr__ = described()

    @property
    def middle(self) -> float:
        """The value taken where none is given: the middle one of the grid."""
        return self.grid[len(self.grid) // 2]


@dataclass(frozen=True)
class Variant:
    """One formula of a mechanism.

    Attributes:
        make: the class of the effect; called with the amplitude and the nuisance parameters by name.
        parameter: name of the amplitude, with its unit.
        unit: the amplitude's unit as it is printed; "-" if it has none.
        sign: +1 if only positive amplitudes are physical, -1 if only negative ones, 0 if both are.
        plausible: smallest and largest magnitude one would believe.
        explanation: what happens physically.
        needs: what the data must contain, all of it.
        helps: what would make the effect easier to distinguish from others.
        random_per_test: whether the amplitude differs at random from test to test, with either sign.
        fixed: settings of the class that make this formula.
    """

    mechanism: str
    name: str
    make: Callable[..., AbstractEffect]
    parameter: str
    unit: str
    sign: int
    plausible: tuple[float, float]
    equation: str
    explanation: str
    source: str
    nuisances: tuple[Nuisance, ...] = ()
    needs: tuple[Need, ...] = ()
    helps: tuple[Need, ...] = ()
    random_per_test: bool = False
    fixed: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        low, high = self.plausible
        if not 0 < low < high < math.inf:
            raise InputError(f"{self.label}: plausible must be two magnitudes, the smaller first")
        arguments.choice(self.sign, (-1, 0, 1), f"sign of {self.label}")
        for nuisance in self.nuisances:
            least, most = nuisance.plausible
            if not (nuisance.grid and all(least <= value <= most for value in nuisance.grid)):
                raise InputError(f"{self.label}: the grid of {nuisance.name} leaves its plausible range")

    def __repr__(self) -> str:
        sign = {1: "above zero", -1: "below zero", 0: "of either sign"}[self.sign]
        low, high = map(number, self.plausible)
        unit = "" if self.unit == "-" else f" {self.unit}"
        rows = [("formula", self.equation), (self.parameter, f"{sign}, plausible from {low} to {high}{unit}")]
        for n in self.nuisances:
            low, high = map(in_words, n.plausible)
            rows.append((n.name, f"{low} to {high}: {n.explanation}"))
        needs = ", ".join(need.value for need in self.needs) or "nothing special"
        return table(self.label, [*rows, ("what happens", self.explanation), ("needs", needs), ("source", self.source)])

    @property
    def label(self) -> str:
        """Mechanism and formula as `find_variant` and `with_effects` take them: "creep:logarithmic"."""
        return f"{self.mechanism}:{self.name}"

    @property
    def typical(self) -> float:
        """Geometric middle of the plausible range, with the physical sign (positive if both are)."""
        return (self.sign or 1) * math.sqrt(self.plausible[0] * self.plausible[1])

    def build(self, amplitude: ScalarLike, **nuisance: ScalarLike) -> AbstractEffect:
        """The effect with this amplitude; nuisance parameters not given take the middle value of their grid.

        Raises:
            ValueError: for a parameter that the formula does not have.
        """
        self.check_names(nuisance)
        strength = scalar(amplitude)
        others: dict[str, Any] = {n.name: n.middle for n in self.nuisances} | nuisance
        for name, value in others.items():
            plain = isinstance(value, int | float)
            others[name] = jnp.asarray(value, strength.dtype) if plain else scalar(value)
        return replace(self.make(strength, **others, **self.fixed), label=self.label)

    def check_names(self, nuisance: Mapping[str, Any]) -> None:
        """Refuse a further number that the formula does not have."""
        known = [n.name for n in self.nuisances]
        for name in sorted(set(nuisance) - set(known)):
            raise InputError(f"{self.label} has no parameter {name!r}; it has: {', '.join([self.parameter, *known])}")

    def grid(self) -> list[dict[str, float]]:
        """All combinations of the nuisance parameters' values; one empty dictionary if there are none."""
        names, grids = [n.name for n in self.nuisances], [n.grid for n in self.nuisances]
        return [dict(zip(names, values, strict=True)) for values in itertools.product(*grids)]


@dataclass(frozen=True)
class Mechanism:
    """A physical cause: a family of formulas, of which nature may use one, or a similar one.

    Attributes:
        variants: its formulas, the most common first.
        check: what would show it by itself, in addition to what more tests of the same kind would show.
        coordinates: names of what its formulas depend on, and may be wrong in (`mcc_jax.discovery.misfit`).
        opposite: the mechanism that is this one with the other sign: the two are no pair.
        sudden: whether it is a step that may be at any point of a test, to be looked for at each.
    """

    name: str
    explanation: str
    variants: tuple[Variant, ...]
    check: str = ""
    coordinates: tuple[str, ...] = ("peak", "load", "since")
    opposite: str = ""
    sudden: bool = False

    def __post_init__(self) -> None:
        if len({variant.name for variant in self.variants}) < len(self.variants):
            raise InputError(f"{self.name} has two variants of one name")
        for variant in self.variants:
            if variant.mechanism != self.name:
                raise InputError(f"the variant {variant.name!r} is not one of {self.name}")

    def __repr__(self) -> str:
        return table(f"{self.name}: {self.explanation}", [(v.name, v.equation) for v in self.variants])

    def __iter__(self) -> Iterator[Variant]:
        return iter(self.variants)

    def __getitem__(self, name: str) -> Variant:
        """The variant of that name."""
        variants = {variant.name: variant for variant in self.variants}
        if name not in variants:
            raise InputError(f"{self.name} has no variant {name!r}; it has: {', '.join(variants)}")
        return variants[name]


OWN = "this work"  # source of a formula that no publication gives


def row(name: str, equation: str, explanation: str, *nuisances: Nuisance, **own: Any) -> dict[str, Any]:
    """One formula of a `family`, with what differs from the others: fields of `Variant`, settings of the class.

    Where the class has several `formulas`, this is the one of the row's name unless `formula` is given.
    """
    further = {"nuisances": nuisances} if nuisances else {}
    return {"name": name, "equation": equation, "explanation": explanation, **further, **own}


def family(
    make: type[AbstractEffect], name: str, explanation: str, *rows: Mapping[str, Any], **common: Any
) -> Mechanism:
    """A mechanism from its rows.

    `make` is the class of the effects unless a row names another. `common` has further fields of the mechanism and
    those of `Variant` that rows do not give; without a unit, of positive sign and of this work unless stated.
    """
    of_mechanism = {f.name: common.pop(f.name) for f in fields(Mechanism) if f.name in common}
    known, variants = {f.name for f in fields(Variant)}, []
    defaults = {"mechanism": name, "make": make, "unit": "-", "sign": 1, "source": OWN}
    for own in rows:
        given = {**defaults, **common, **own}
        fixed = {key: given.pop(key) for key in list(given) if key not in known}
        if given["make"].formulas:
            fixed.setdefault("formula", given["name"])
        variants.append(Variant(**given, fixed=fixed))
    return Mechanism(name, explanation, tuple(variants), **of_mechanism)


@dataclass(frozen=True)
class Equivalence:
    """Two or more descriptions that fit every possible measurement equally well, and what would distinguish them."""

    names: tuple[str, ...]
    explanation: str
    broken_by: str
    need: Need | None = None  # the data that distinguish two mechanisms; without it an answer has both in its set

    __repr__ = described()


EQUIVALENCES = (
    Equivalence(("load-cell gain", "C1, C3^3, C5^5 and the effective modulus scaled alike"),
        "A force read too high by a constant factor scales every stress; the law scales with it.",
        "a calibration weight on the load cell"),
    Equivalence(("zero of force", "zero of displacement"),
        "A small shift of force at first contact moves the curve along itself, as a shift of displacement does.",
        "a record of the approach before contact"),
    Equivalence(("shape parameter a or shape_second_order", "mean of C1, C3 and C5"),
        "If all particles have the same flatness, each multiplies all coefficients by one number.",
        "particles of several shapes"),
    Equivalence(("thermal_drift linear", "frame_compliance linear, on loading at one rate"),
        "While force grows in proportion to time, both add displacement in proportion to force.",
        "unloading, a hold, or a second rate"),
    Equivalence(("rate_dependence", "size_effect"),
        "At one force rate the strain rate goes as the inverse square of size.", "two rates in one class of size",
        Need.TWO_RATES),
    Equivalence(("toe_asperity, below all data", "zero of displacement"),
        "Asperities that are flat before the first reading shift the whole curve.", "a record from the first contact"),
    Equivalence(("pop_in", "snap-through of the law"),
        "A law whose loading curve is not monotone steps by itself.", "several sizes: its own step is at one strain"),
    Equivalence(("ratcheting, with one reload and no hold", "creep"),
        "Within one cycle, time and the number of loads grow together.", "a hold, or a second reload"),
)  # fmt: skip
"""What must be declared and can never be discovered."""
