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

import jax
import jax.numpy as jnp
import numpy as np

from .._types import Values
from ..effects import Context
from ..effects._record import HOLD, LOAD, RELOAD, UNLOAD

STRESS = 10.0
"""Unit of stress in formulas [MPa]."""

SECONDS = 100.0
DIAMETER = 200.0

KINDS = {"loading": LOAD, "hold": HOLD, "unloading": UNLOAD, "reloading": RELOAD}
LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


@dataclass(frozen=True)
class Feature:
    """A function over the points of a test.

    Attributes:
        text: the function as it stands in a formula.
        value: its values, strain [-] per unit of coefficient.
        kind: for the map, the kind of segment; empty for words.
        share: for the map, the range of the load share that it covers.
    """

    text: str
    value: Callable[[Context], Values]
    kind: str = ""
    share: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Wave:
    """h sin(2 pi f x), or h (cos(2 pi f x) - 1), with h a number of each particle.

    Attributes:
        of: the coordinate x.
        frequency: f, in 1 / unit of x.
        cosine: which of the two.
        height: h.
    """

    of: Callable[[Context], Values]
    frequency: float
    cosine: bool
    height: Callable[[Context], Values]

    def __call__(self, context: Context) -> Values:
        """Its values."""
        return self.height(context) * _wave(2 * jnp.pi * self.frequency * self.of(context), self.cosine)


def _wave(phase: Values, cosine) -> Values:
    return jnp.where(cosine, jnp.cos(phase) - 1, jnp.sin(phase))


def values_of(features: Sequence[Feature], context: Context) -> Values:
    """Values of features over the points of a test, shape (features, points); all waves in one operation, since each
    operation takes time to compile."""
    rows: dict[int, Values] = {}
    waves: dict[tuple[Callable[[Context], Values], ...], list[tuple[int, Wave]]] = {}
    for i, feature in enumerate(features):
        wave = feature.value
        if isinstance(wave, Wave):
            waves.setdefault((wave.of, wave.height), []).append((i, wave))
        else:
            rows[i] = jnp.broadcast_to(feature.value(context), context.force.shape)
    order, parts = list(rows), [jnp.stack(list(rows.values()))] if rows else []
    for (of, height), members in waves.items():
        x = jnp.broadcast_to(of(context), context.force.shape)
        k = jnp.asarray([2 * np.pi * wave.frequency for _, wave in members], x.dtype)
        cosine = jnp.asarray([wave.cosine for _, wave in members])
        parts.append(height(context) * _wave(k[:, None] * x[None], cosine[:, None]))
        order += [i for i, _ in members]
    if not parts:
        return jnp.zeros((0, *context.force.shape), context.force.dtype)
    return jnp.concatenate(parts)[np.argsort(order)]


def overall_share(context: Context) -> Values:
    """Force over the largest force of the whole test [-]."""
    return context.force / jnp.maximum(jnp.max(context.force), 1e-300)


def _tent(kind: str, code: int, centre: float, width: float) -> Feature:
    def value(context: Context) -> Values:
        share = overall_share(context)
        height = jnp.maximum(1 - jnp.abs(share - centre) / width, 0.0)
        return jnp.where(context.record.kind == code, height, 0.0)

    low, high = max(centre - width / 2, 0.0), min(centre + width / 2, 1.0)
    return Feature(f"{kind} around {centre:.0%} of the largest force", value, kind, (low, high))


@functools.cache
def map_features() -> tuple[Feature, ...]:
    """Tents in load share on every kind of segment; holds have one function that rises over the hold."""
    features = []
    for kind, code in KINDS.items():
        if kind == "hold":

            def rises(context: Context, code: int = code) -> Values:
                time = context.record.time
                there = context.record.kind == code
                begin = jnp.min(jnp.where(there, time, jnp.inf))
                length = jnp.max(jnp.where(there, time, -jnp.inf)) - begin
                return jnp.where(there, (time - begin) / jnp.maximum(length, 1e-9), 0.0)

            features.append(Feature("growth over a hold", rises, kind))
            continue
        features.extend(_tent(kind, code, level, 0.2) for level in LEVELS)
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


def _one(context: Context) -> Values:
    return jnp.ones_like(context.particle.effective_diameter)


def _um(context: Context) -> Values:
    """h = 200 um / D_e: what is as many micrometres for every particle, in units of strain."""
    return DIAMETER / context.particle.effective_diameter


def _since_turn(context: Context) -> Values:
    """Time since the latest reversal of the ramp [s]."""
    time, falls = context.record.time, context.record.branch == UNLOAD
    turned = jnp.concatenate([jnp.ones_like(falls[:1]), falls[1:] != falls[:-1]])
    return time - jax.lax.cummax(jnp.where(turned, time, -jnp.inf))


def _power(of: Callable[[Context], Values], p: float) -> Callable[[Context], Values]:
    return lambda context: jnp.maximum(of(context), 1e-9) ** p


@functools.cache
def words() -> tuple[Feature, ...]:
    """The functions from which formulas are made; q = peak stress / 10 MPa, s = stress / 10 MPa, u = F / F_peak."""
    found = [Feature(f"q^{p:g}", _power(_q, p)) for p in (0.5, 1.0, 1.5, 2.0, 3.0)]
    found += [Feature(f"s^{p:g}", _power(_s, p)) for p in (0.5, 1.0, 2.0)]
    for at in (0.15, 0.3, 0.45, 0.6, 0.8):
        found.append(Feature(f"max(q - {at:g}, 0)", lambda c, at=at: jnp.maximum(_q(c) - at, 0.0)))
        found.append(Feature(f"exp(-((q - {at:g})/0.1)^2)", lambda c, at=at: jnp.exp(-(((_q(c) - at) / 0.1) ** 2))))
        found.append(
            Feature(f"tanh((q - {at:g})/0.05)", lambda c, at=at: jnp.tanh((_q(c) - at) / 0.05) + jnp.tanh(at / 0.05))
        )
    for at in (0.02, 0.06):
        found.append(Feature(f"exp(-q/{at:g})", lambda c, at=at: jnp.exp(-_q(c) / at)))
    found += _waves("q", _q, [1 / period for period in (0.15, 0.25, 0.4)])
    periods = (0.03, 0.04, 0.05, 0.065, 0.08, 0.1, 0.13, 0.16, 0.2)
    found += _waves("eps_P", _eps, [1 / period for period in periods])
    for at in (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4):
        found.append(
            Feature(f"exp(-((eps_P - {at:g})/0.03)^2)", lambda c, at=at: jnp.exp(-(((_eps(c) - at) / 0.03) ** 2)))
        )
        found.append(
            Feature(
                f"tanh((eps_P - {at:g})/0.02)",
                lambda c, at=at: jnp.tanh((_eps(c) - at) / 0.02) + jnp.tanh(at / 0.02),
            )
        )
    released = [Feature(f"(1 - u)^{p:g}", lambda c, p=p: (1 - _u(c)) ** p) for p in (1.0, 2.0, 4.0, 8.0)]
    released += [
        Feature("u (1 - u)", lambda c: _u(c) * (1 - _u(c))),
        Feature("u^2 (1 - u)", lambda c: _u(c) ** 2 * (1 - _u(c))),
        Feature("sin(2 pi u)", lambda c: jnp.sin(2 * jnp.pi * _u(c))),
        Feature("sin(4 pi u)", lambda c: jnp.sin(4 * jnp.pi * _u(c))),
    ]
    for at in (0.25, 0.5, 0.75):
        released.append(Feature(f"max({at:g} - u, 0)", lambda c, at=at: jnp.maximum(at - _u(c), 0.0)))
    found += released
    found += [
        Feature(f"q {one.text}", lambda c, one=one: _q(c) * one.value(c)) for one in released if "sin" not in one.text
    ]
    found += [
        Feature("t/100 s", lambda c: c.record.time / SECONDS),
        Feature("ln(1 + t/10 s)", lambda c: jnp.log1p(c.record.time / 10.0)),
        Feature("s t/100 s", lambda c: _s(c) * c.record.time / SECONDS),
        Feature("q (D_e/200 um - 1)", lambda c: _q(c) * (c.particle.effective_diameter / DIAMETER - 1)),
        Feature("[reload] u (1 - u)", lambda c: c.reloading * _u(c) * (1 - _u(c))),
        Feature("[reload] 1", lambda c: c.cycles),
    ]
    # Of the instrument: the same number of micrometres for every particle.
    for far in (0.02, 0.06):
        found.append(
            Feature(f"(1 - exp(-(1 - u)/{far:g})) h", lambda c, far=far: _um(c) * (1 - jnp.exp(-(1 - _u(c)) / far)))
        )
    for length in (3, 10, 30):
        found.append(
            Feature(f"exp(-r/{length:g} s) h", lambda c, length=length: _um(c) * jnp.exp(-_since_turn(c) / length))
        )
    for period in (5, 7, 10, 14, 20):  # a control loop that rings
        for name, wave in (("sin", jnp.sin), ("cos", jnp.cos)):
            found.append(
                Feature(
                    f"exp(-r/{period:g} s) {name}(2 pi r/{period:g} s) h",
                    lambda c, period=period, wave=wave: _um(c) * _ringing(_since_turn(c) / period, wave),
                )
            )
    return (*found, *waves())


def _ringing(cycles: Values, wave: Callable[[Values], Values]) -> Values:
    return jnp.exp(-cycles) * wave(2 * jnp.pi * cycles)


@functools.cache
def waves() -> tuple[Feature, ...]:
    """Waves in time and in displacement, which come from the room and from the gauge, not from the particle.

    Frequencies are as far apart as a test of ten minutes, or of 100 um, tells them apart. They are a family of their
    own in the test for a gap (`p_nothing_left`): as many as all other words, they would cost these their power.
    """
    return (
        *_waves("t", _t, np.arange(1, 44) * 0.0015, " s", _um),
        *_waves("gamma", _gamma, np.arange(2, 35) * 0.01, " um", _um),
    )


def _waves(
    name: str,
    of: Callable[[Context], Values],
    frequencies: Sequence[float] | np.ndarray,
    unit: str = "",
    height: Callable[[Context], Values] | None = None,
) -> list[Feature]:
    found = []
    for f in frequencies:
        for text, cosine in (
            (f"sin(2 pi {name}/{1 / f:.3g}{unit})", False),
            (f"(cos(2 pi {name}/{1 / f:.3g}{unit}) - 1)", True),
        ):
            wave = Wave(of, float(f), cosine, height or _one)
            found.append(Feature(text if height is None else f"{text} h", wave))
    return found
