r"""Smooth functions of what a test did: where law and data disagree, and the words of a formula for it.

Two families, both additions to displacement in units of strain (times :math:`D_e`):

- a map, tent functions of load share on every kind of branch: they say where, whatever the cause;
- words, from which a sparse formula is put together when no listed mechanism explains the gap: powers, hinges, bumps
  and ripples in peak stress, the same in load share on the elastic branch, time, and size.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp

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
    for period in (0.15, 0.25, 0.4):
        k = 2 * jnp.pi / period
        found.append(Feature(f"sin(2 pi q/{period:g})", lambda c, k=k: jnp.sin(k * _q(c))))
        found.append(Feature(f"cos(2 pi q/{period:g}) - 1", lambda c, k=k: jnp.cos(k * _q(c)) - 1))
    for period in (0.03, 0.04, 0.05, 0.065, 0.08, 0.1, 0.13, 0.16, 0.2):
        k = 2 * jnp.pi / period
        found.append(Feature(f"sin(2 pi eps_P/{period:g})", lambda c, k=k: jnp.sin(k * c.peak_strain)))
        found.append(Feature(f"cos(2 pi eps_P/{period:g}) - 1", lambda c, k=k: jnp.cos(k * c.peak_strain) - 1))
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
    return tuple(found)
