r"""Smooth functions of what a test did: where law and data disagree, and the words of a formula for it.

Two families, both additions to displacement in units of strain (times :math:`D_e`):

- a map, tent functions of load share on every kind of branch: they say where, whatever the cause;
- words, from which a sparse formula is put together when no listed mechanism explains the gap: powers, hinges, bumps,
  steps and ripples in peak stress and strain, the same in load share on the elastic branch, what follows a reversal,
  time, and size; and waves in time and in displacement, as a room or a gauge makes them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._types import Values
from ..effects import Context
from ..effects.record import HOLD, LOAD, RELOAD, UNLOAD

STRESS = 10.0
"""Unit of stress in formulas [MPa]."""

SECONDS = 100.0
DIAMETER = 200.0

KINDS = {"loading": LOAD, "hold": HOLD, "unloading": UNLOAD, "reloading": RELOAD}
LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


@dataclass(frozen=True, eq=False)
class Form:
    """A function of what a test did, with further numbers: the place of a bump, the period of a wave.

    Attributes:
        text: the function as it stands in a formula, given the numbers.
        value: its values, strain [-] per unit of coefficient, given the numbers as an array.
        low, high: ranges of the numbers.
    """

    text: Callable[..., str]
    value: Callable[[Context, Any], Values]
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    def at(self, *numbers: float | int) -> Feature:
        """The function with given numbers."""
        return Feature(self, tuple(map(float, numbers)))


@dataclass(frozen=True)
class Feature:
    """A function over the points of a test.

    Attributes:
        form: the function, but for its numbers.
        numbers: its numbers.
        kind: for the map, the kind of segment; empty for words.
        share: for the map, the range of the load share that it covers.
    """

    form: Form
    numbers: tuple[float, ...] = ()
    kind: str = ""
    share: tuple[float, float] = (0.0, 1.0)

    @property
    def text(self) -> str:
        """The function as it stands in a formula."""
        return self.form.text(*self.numbers)


def values_of(features: Sequence[Feature], context: Context) -> Values:
    """Values of features over the points of a test, shape (features, points); all of one form in one operation, since
    each operation takes time to compile."""
    if not features:
        return jnp.zeros((0, *context.force.shape), context.force.dtype)
    forms: dict[Form, list[int]] = {}
    for i, feature in enumerate(features):
        forms.setdefault(feature.form, []).append(i)
    parts = []
    for form, members in forms.items():
        numbers = jnp.asarray(np.array([features[i].numbers for i in members]), context.force.dtype)

        def one(own: Values, form: Form = form) -> Values:
            return jnp.broadcast_to(form.value(context, own), context.force.shape)

        parts.append(jax.vmap(one)(numbers))
    return jnp.concatenate(parts)[np.argsort(np.concatenate(list(forms.values())))]


def overall_share(context: Context) -> Values:
    """Force over the largest force of the whole test [-]."""
    return context.force / jnp.maximum(jnp.max(context.force), 1e-300)


def _tent(kind: str, code: int) -> Form:
    def value(context: Context, numbers: Any) -> Values:
        centre, width = numbers
        height = jnp.maximum(1 - jnp.abs(overall_share(context) - centre) / width, 0.0)
        return jnp.where(context.record.kind == code, height, 0.0)

    return Form(lambda centre, _: f"{kind} around {centre:.0%} of the largest force", value)


def _growth(context: Context, _: Any) -> Values:
    time, there = context.record.time, context.record.kind == HOLD
    begin = jnp.min(jnp.where(there, time, jnp.inf))
    length = jnp.max(jnp.where(there, time, -jnp.inf)) - begin
    return jnp.where(there, (time - begin) / jnp.maximum(length, 1e-9), 0.0)


@functools.cache
def map_features() -> tuple[Feature, ...]:
    """Tents in load share on every kind of segment; holds have one function that rises over the hold."""
    features = []
    for kind, code in KINDS.items():
        if kind == "hold":
            features.append(Feature(Form(lambda: "growth over a hold", _growth), (), kind))
            continue
        tent, width = _tent(kind, code), 0.2
        for level in LEVELS:
            share = max(level - width / 2, 0.0), min(level + width / 2, 1.0)
            features.append(Feature(tent, (level, width), kind, share))
    return tuple(features)


def _q(context: Context) -> Values:
    return context.peak_stress / STRESS


def _s(context: Context) -> Values:
    return context.stress / STRESS


def _u(context: Context) -> Values:
    return context.load_share


def _eps(context: Context) -> Values:
    return context.peak_strain


def _t(context: Context) -> Values:
    return context.record.time


def _gamma(context: Context) -> Values:
    return context.displacement


def _um(context: Context) -> Values:
    """h = 200 um / D_e: what is as many micrometres for every particle, in units of strain."""
    return DIAMETER / context.particle.effective_diameter


def _since_turn(context: Context) -> Values:
    """Time since the latest reversal of the ramp [s]."""
    time, falls = context.record.time, context.record.branch == UNLOAD
    turned = jnp.concatenate([jnp.ones_like(falls[:1]), falls[1:] != falls[:-1]])
    return time - jax.lax.cummax(jnp.where(turned, time, -jnp.inf))


NONE = 1e-9
"""What is below is as good as nothing: powers have finite derivatives from there on."""


def _power(name: str, of: Callable[[Context], Values]) -> Form:
    return Form(lambda p: f"{name}^{p:.3g}", lambda c, n: jnp.maximum(of(c), NONE) ** n[0], (0.2,), (6.0,))


def _bump(name: str, of: Callable[[Context], Values], far: float) -> Form:
    return Form(
        lambda at, width: f"exp(-(({name} - {at:.3g})/{width:.3g})^2)",
        lambda c, n: jnp.exp(-(((of(c) - n[0]) / n[1]) ** 2)),
        (0.0, 0.01),
        (far, far),
    )


def _step(name: str, of: Callable[[Context], Values], far: float) -> Form:
    """From 0 at the start of the test."""
    return Form(
        lambda at, width: f"(tanh(({name} - {at:.3g})/{width:.3g}) + tanh({at:.3g}/{width:.3g}))",
        lambda c, n: jnp.tanh((of(c) - n[0]) / n[1]) + jnp.tanh(n[0] / n[1]),
        (0.0, 0.01),
        (far, far),
    )


SMALL = 5e-4
"""A phase or offset below is not written."""


def _signed(x: float) -> str:
    return f"{'+' if x >= 0 else '-'} {abs(x):.3g}"


def _sine(x: str, phase: float) -> str:
    if abs(phase) < SMALL:
        return f"sin({x})"
    return f"cos({x})" if abs(phase - np.pi / 2) < SMALL else f"sin({x} {_signed(phase)})"


def _wave(
    name: str,
    of: Callable[[Context], Values],
    highest: float,
    unit: str = "",
    height: Callable[[Context], Values] | None = None,
    start: float = 0.0,
) -> Form:
    """A wave of a frequency and a phase, 0 where its coordinate is at `start`."""
    after = "" if height is None else " h"

    def text(frequency: float, phase: float) -> str:
        x = f"2 pi {name}" if frequency == 1 and not unit else f"2 pi {name}/{1 / frequency:.3g}{unit}"
        offset = np.sin(2 * np.pi * frequency * start + phase)
        if abs(offset) < SMALL:
            return f"{_sine(x, phase)}{after}"
        return f"({_sine(x, phase)} {_signed(-offset)}){after}"

    def value(context: Context, n: Any) -> Values:
        turn = 2 * jnp.pi * n[0]
        shape = jnp.sin(turn * of(context) + n[1]) - jnp.sin(turn * start + n[1])
        return shape if height is None else height(context) * shape

    return Form(text, value, (highest / 1000, -2 * np.pi), (highest, 2 * np.pi))


def _raised(base: str, p: float) -> str:
    return base if abs(p - 1) < SMALL else f"{base}^{p:.3g}"


def _released_text(k: float, m: float, n: float) -> str:
    factors = [("q", k), ("u", m), ("(1 - u)", n)]
    return " ".join(_raised(base, p) for base, p in factors if p >= SMALL)


def _released(c: Context, n: Any) -> Values:
    u = _u(c)
    loaded, gone = jnp.maximum(u, NONE), jnp.where(u < 1, jnp.maximum(1 - u, NONE), 0.5)
    return jnp.where(u < 1, jnp.maximum(_q(c), NONE) ** n[0] * loaded ** n[1] * gone ** n[2], 0.0)


def _fixed(text: str, value: Callable[[Context], Values]) -> Form:
    return Form(lambda: text, lambda c, _: value(c))


def _scaled(text: str, value: Callable[[Context, Any], Values], low: float, high: float) -> Form:
    """Of one number, which stands in the text as {0}."""
    return Form(lambda x: text.format(f"{x:.3g}"), lambda c, n: value(c, n[0]), (low,), (high,))


PEAK_POWER, POWER = _power("q", _q), _power("s", _s)
KINK = _scaled("max(q - {0}, 0)", lambda c, at: jnp.maximum(_q(c) - at, 0.0), 0.0, 2.0)
BUMP, STEP = _bump("q", _q, 2.0), _step("q", _q, 2.0)
DECAY = _scaled("exp(-q/{0})", lambda c, at: jnp.exp(-_q(c) / at), 0.003, 1.0)
RIPPLE, STRAIN_RIPPLE = _wave("q", _q, 20.0), _wave("eps_P", _eps, 60.0)
STRAIN_BUMP, STRAIN_STEP = _bump("eps_P", _eps, 0.6), _step("eps_P", _eps, 0.6)
RELEASED = Form(_released_text, _released, (0.0, 0.0, 0.3), (4.0, 8.0, 30.0))
# Nothing before release begins, at u = 1.
RELEASED_RIPPLE = _wave("u", _u, 5.0, start=1.0)
RELEASED_KINK = Form(
    lambda k, at: f"{_released_text(k, 0.0, 0.0)} max({at:.3g} - u, 0)".strip(),
    lambda c, n: jnp.maximum(_q(c), NONE) ** n[0] * jnp.maximum(n[1] - _u(c), 0.0),
    (0.0, 0.02),
    (4.0, 1.0),
)


def _kink(name: str, of: Callable[[Context], Values], far: float) -> Form:
    def value(c: Context, n: Any) -> Values:
        above = of(c) > n[0] + NONE
        return jnp.where(above, jnp.where(above, of(c) - n[0], 1.0) ** n[1], 0.0)

    return Form(lambda at, p: _raised(f"max({name} - {at:.3g}, 0)", p), value, (0.0, 0.3), (far, 4.0))


def _while_released(text: Callable[[float, float], str], value: Callable[[Values, Any, Any], Values]) -> Form:
    """Of load share, from 0 where release begins, times a power of q."""

    def whole(k: float, at: float, width: float) -> str:
        offset = float(value(jnp.ones(()), at, width))
        shape = text(at, width) if abs(offset) < SMALL else f"({text(at, width)} {_signed(-offset)})"
        return f"{_released_text(k, 0.0, 0.0)} {shape}".strip()

    def values(c: Context, n: Any) -> Values:
        return jnp.maximum(_q(c), NONE) ** n[0] * (value(_u(c), n[1], n[2]) - value(jnp.ones(()), n[1], n[2]))

    return Form(whole, values, (0.0, 0.0, 0.02), (4.0, 1.0, 1.0))


STRAIN_KINK = _kink("eps_P", _eps, 0.6)
RELEASED_BUMP = _while_released(
    lambda at, width: f"exp(-((u - {at:.3g})/{width:.3g})^2)", lambda u, at, width: jnp.exp(-(((u - at) / width) ** 2))
)
RELEASED_STEP = _while_released(
    lambda at, width: f"tanh((u - {at:.3g})/{width:.3g})", lambda u, at, width: jnp.tanh((u - at) / width)
)
TIME = _fixed("t/100 s", lambda c: c.record.time / SECONDS)
LOG_TIME = _scaled("ln(1 + t/{0} s)", lambda c, tau: jnp.log1p(c.record.time / tau), 0.3, 1000.0)
STRESS_TIME = _fixed("s t/100 s", lambda c: _s(c) * c.record.time / SECONDS)
SIZE = _fixed("q (D_e/200 um - 1)", lambda c: _q(c) * (c.particle.effective_diameter / DIAMETER - 1))
RELOADING = Form(
    lambda m, n: f"[reload] {_released_text(0.0, m, n)}",
    lambda c, n: c.reloading * _released(c, jnp.stack([jnp.zeros_like(n[0]), n[0], n[1]])),
    (0.0, 0.3),
    (8.0, 30.0),
)
CYCLES = _fixed("[reload] 1", lambda c: c.cycles)
# Of the instrument: the same number of micrometres for every particle.
SLACK = _scaled("(1 - exp(-(1 - u)/{0})) h", lambda c, far: _um(c) * (1 - jnp.exp(-(1 - _u(c)) / far)), 0.003, 1.0)
SETTLING = _scaled("exp(-r/{0} s) h", lambda c, tau: _um(c) * jnp.exp(-_since_turn(c) / tau), 0.5, 300.0)
RINGING = Form(
    lambda tau, period, phase: f"exp(-r/{tau:.3g} s) sin(2 pi r/{period:.3g} s {_signed(phase)}) h",
    lambda c, n: _um(c) * jnp.exp(-_since_turn(c) / n[0]) * jnp.sin(2 * jnp.pi * _since_turn(c) / n[1] + n[2]),
    (0.5, 0.5, -2 * np.pi),
    (300.0, 300.0, 2 * np.pi),
)
ROOM, GAUGE = _wave("t", _t, 0.2, " s", _um), _wave("gamma", _gamma, 1.0, " um", _um)


@functools.cache
def words() -> tuple[Feature, ...]:
    """The functions from which formulas are made; q = peak stress / 10 MPa, s = stress / 10 MPa, u = F / F_peak."""
    found = [PEAK_POWER.at(p) for p in (0.5, 1.0, 1.5, 2.0, 3.0)]
    found += [POWER.at(p) for p in (0.5, 1.0, 2.0)]
    for at in (0.15, 0.3, 0.45, 0.6, 0.8):
        found += [KINK.at(at), BUMP.at(at, 0.1), STEP.at(at, 0.05)]
    found += [DECAY.at(at) for at in (0.02, 0.06)]
    found += _waves(RIPPLE, [1 / period for period in (0.15, 0.25, 0.4)])
    periods = (0.03, 0.04, 0.05, 0.065, 0.08, 0.1, 0.13, 0.16, 0.2)
    found += _waves(STRAIN_RIPPLE, [1 / period for period in periods])
    for at in (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4):
        found += [STRAIN_BUMP.at(at, 0.03), STRAIN_STEP.at(at, 0.02)]
    powers = ((0, 1), (0, 2), (0, 4), (0, 8), (1, 1), (2, 1))
    found += [RELEASED.at(k, *p) for k in (0, 1) for p in powers]
    found += [RELEASED_RIPPLE.at(f, 0.0) for f in (1.0, 2.0)]
    found += [RELEASED_KINK.at(k, at) for k in (0, 1) for at in (0.25, 0.5, 0.75)]
    found += [TIME.at(), LOG_TIME.at(10.0), STRESS_TIME.at(), SIZE.at(), RELOADING.at(1, 1), CYCLES.at()]
    found += [SLACK.at(far) for far in (0.02, 0.06)]
    found += [SETTLING.at(length) for length in (3, 10, 30)]
    # A control loop that rings.
    found += [RINGING.at(period, period, phase) for period in (5, 7, 10, 14, 20) for phase in (0.0, np.pi / 2)]
    return (*found, *waves())


@functools.cache
def waves() -> tuple[Feature, ...]:
    """Waves in time and in displacement, which come from the room and from the gauge, not from the particle.

    Frequencies are as far apart as a test of ten minutes, or of 100 um, tells them apart. They are a family of their
    own in the test for a gap (`p_nothing_left`): as many as all other words, they would cost these their power.
    """
    return (*_waves(ROOM, np.arange(1, 44) * 0.0015), *_waves(GAUGE, np.arange(2, 35) * 0.01))


def further_words() -> tuple[Feature, ...]:
    """Words that a formula may also be made of once it is known to be needed, where numbers are fitted anyway."""
    found = [STRAIN_KINK.at(at, 1.0) for at in (0.03, 0.08, 0.13, 0.18, 0.25)]
    found += [form.at(0.0, at, 0.15) for form in (RELEASED_BUMP, RELEASED_STEP) for at in (0.25, 0.5, 0.75)]
    return tuple(found)


def _waves(form: Form, frequencies: Sequence[float] | np.ndarray) -> list[Feature]:
    return [form.at(f, phase) for f in frequencies for phase in (0.0, np.pi / 2)]
