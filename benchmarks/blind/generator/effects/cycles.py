"""Cycles: what a reload adds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .form import RELOAD, Array, Form, Hooks, State


def _lag(s: State, rise: Callable[[Array], Array]) -> Array:
    """Lag of a reload between its start and the largest load; equals 4 u (1 - u) for a reload from zero load."""
    v = np.clip((s.u - s.path.turn) / np.maximum(1.0 - s.path.turn, 1e-9), 0.0, 1.0)
    return np.where(s.path.reload, rise(v), 0.0)


def _hysteresis_skewed() -> Hooks:
    # Slip begins late: the lag peaks in the upper half of the reload.
    return {"strain": lambda k, e, s: e - k * s.delta * _lag(s, lambda v: 6.75 * v**2 * (1.0 - v))}


def _ratchet() -> Hooks:
    # Every finished reload leaves the same permanent strain, gathered while it runs.
    def strain(k: float, e: Array, s: State) -> Array:
        running = _lag(s, lambda v: v)
        begun = s.path.reloads
        return e + k * np.where(s.path.reload, begun - 1.0 + running, begun)

    return {"strain": strain}


def _ratchet_settling() -> Hooks:
    # Shake-down: each further cycle adds less, in proportion to the elastic recovery.
    def strain(k: float, e: Array, s: State) -> Array:
        begun = s.path.reloads
        before = np.sqrt(np.maximum(begun - 1.0, 0.0))
        part = np.where(s.path.reload, _lag(s, lambda v: v**2), 1.0)
        return e + k * np.where(begun > 0, before + (np.sqrt(begun) - before) * part, 0.0)

    return {"strain": strain}


# fmt: off
FORMS = (
    Form(
        "reload_hysteresis", "exact", "h d_el 4 u (1 - u) on reloads", 0.05,
        lambda: {"strain": lambda k, e, s: e - k * s.delta * _lag(s, lambda v: 4.0 * v * (1.0 - v))}, (0.01, 0.4),
        needs=(RELOAD,),
    ),
    Form(
        "reload_hysteresis", "skewed", "h d_el 6.75 v^2 (1 - v) on reloads", 0.05, _hysteresis_skewed, (0.01, 0.4),
        needs=(RELOAD,),
    ),
    Form("ratcheting", "exact", "c per reload", 1e-3, _ratchet, (5e-5, 1e-2), needs=(RELOAD,)),
    Form("ratcheting", "settling", "c sqrt(number of reloads)", 1e-3, _ratchet_settling, (5e-5, 1e-2), needs=(RELOAD,)),
)
# fmt: on
