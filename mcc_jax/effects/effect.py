"""What an effect can do to a law."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._format import in_words
from .._types import Scalar, Values, scalar
from ..formulas import Formulas
from ..geometry import Particle
from .record import Context, Record

Factors = tuple[Values, Values, Values]
MIN_FACTOR = 0.05  # floor of every factor, so that an amplitude far from null does not turn it negative


class AbstractEffect(eqx.Module):
    """A mechanism that the law does not contain. Every hook does nothing by default; override those it needs.

    They act in this order, and each once for all effects of a law: `modify` (size, shape, humidity), `loading` (rate,
    friction, hardening), `stiffness` (damage, densification), `inside` (creep, pop-in, adhesion; several add up) and
    `observe` (frame, drift, platens). An effect with a memory of its own also gives `driver`, `start` and `evolve`.

    Hooks are plain arithmetic on scalars or arrays over points, finite with finite derivatives at zero force, on full
    release, at repeated points and at amplitude zero, where they must change nothing. A field that switches a part of a
    formula on is a number, 0 or 1: formulas that differ in it alone share what `mcc_jax.law.signatures` compiles.

    Attributes:
        closed: whether all it does is a formula of particle and peak, without time, cycles or humidity: `modify` of the
            particle alone, or an `AbstractModulusAtPeak`. Energy, particle codes and exports take those only. Set it on
            the class.
        formulas: where the hooks of several formulas differ in one expression, these by name: functions of the effect
            and of what its hook gives them. Set it on the class.
        amplitude: strength of the effect, 0 for none; its unit is that of the `Variant`.
        formula: the name of the expression of this effect.
        label: "mechanism:variant" where a `Variant` built it; by it results and messages name the effect.
    """

    closed: ClassVar[bool] = False
    formulas: ClassVar[Mapping[str, Callable[..., Any]]] = {}

    amplitude: Scalar = eqx.field(converter=scalar)
    formula: str = eqx.field(static=True, default="", kw_only=True)
    label: str = eqx.field(static=True, default="", kw_only=True)

    def __repr__(self) -> str:
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "amplitude"}
        further = [f"{name} {in_words(value)}" for name, value in values.items() if hasattr(value, "shape")]
        return ", ".join([f"{self.name} of amplitude {in_words(self.amplitude)}", *further])

    @property
    def name(self) -> str:
        """What messages call it."""
        return self.label or type(self).__name__

    @property
    def of_instrument(self) -> bool:
        """Whether it belongs to what lies between particle and read-out, not to the particle."""
        return self.overrides("observe")

    @classmethod
    def overrides(cls, *hooks: str) -> bool:
        """Whether it has any of these hooks of its own."""
        return any(getattr(cls, hook) is not getattr(AbstractEffect, hook) for hook in hooks)

    def of(self, *given: Any) -> Any:
        """The expression of this effect's formula."""
        return self.formulas[self.formula](self, *given)

    def modify(self, law: Formulas, particle: Particle, record: Record) -> Formulas:
        """The law with other parameters for this particle."""
        return law

    def loading(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Factors:
        """Factors on the linear, cubic and quintic term of loading at a strain [-] >= 0."""
        one = jnp.ones_like(strain)
        return one, one, one

    def stiffness(self, context: Context) -> Values:
        """Factor on the effective modulus of the branch that starts at the peak."""
        return jnp.ones_like(context.peak_strain)

    def inside(self, context: Context) -> Values:
        """Displacement [um] added inside the law."""
        return jnp.zeros_like(context.displacement)

    def observe(self, context: Context) -> Values:
        """Displacement [um] added by what lies between particle and read-out."""
        return jnp.zeros_like(context.displacement)

    def driver(self, context: Context) -> Values:
        """What drives the memory, at every point."""
        return jnp.zeros_like(context.displacement)

    def start(self, like: Scalar) -> Any:
        """Memory of a virgin particle, in the precision of `like`; None for an effect without one."""
        return None

    def evolve(self, memory: Any, before: Scalar, now: Scalar, seconds: Scalar) -> tuple[Any, Any]:
        """Memory after a step during which the driver went from `before` to `now`, and `context.memory` of `inside`."""
        return memory, None


class AbstractModulusAtPeak(AbstractEffect):
    """An effect on the modulus whose factor depends on the largest strain and the stress there, and on nothing else."""

    closed: ClassVar[bool] = True

    def factor(self, strain: Values, stress: Values) -> Values:
        """The factor, > 0, at a peak strain [-] and a peak stress [MPa]: the formula, unless a class says otherwise."""
        return self.of(strain, stress)

    def stiffness(self, context: Context) -> Values:
        """The factor at the peak so far."""
        return self.factor(context.peak_strain, context.peak_stress)


def pick(on: Any, yes: Any, no: Any) -> Any:
    """One of two values by a number, 0 or 1, that switches a part of a formula on."""
    if isinstance(on, float):
        return yes if on else no
    return jnp.where(on != 0, yes, no)


def on_terms(chosen: tuple[Any, Any, Any], factor: Values) -> Factors:
    """A factor on those of three terms that are switched on, 1 on the others."""
    one = jnp.ones_like(factor)
    first, second, third = (pick(on, factor, one) for on in chosen)
    return first, second, third


def at_least(x: Values, least: float | Values = MIN_FACTOR) -> Values:
    """`x`, but not below a floor."""
    return jnp.where(x > least, x, least)
