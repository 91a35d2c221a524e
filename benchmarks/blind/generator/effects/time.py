"""Time: creep and the rate of strain."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .form import Array, Form, Hooks, State


def _memory(state: State, kernel: Callable[[Array], Array]) -> Array:
    """Integral of kernel(t - t') d sigma(t') over the record, sampled as ramps between the points."""
    t = state.t
    middle = 0.5 * (t[:, 1:] + t[:, :-1])
    steps = np.diff(state.sigma, axis=1)
    lag = t[:, :, None] - middle[:, None, :]
    return np.einsum("nij,nj->ni", np.where(lag > 0, kernel(np.maximum(lag, 0.0)), 0.0), steps)


_RATE_0 = 1e-3


def _rate() -> Hooks:
    return {"overstress": lambda k, v, s: v + k * s.C1 * s.x * np.log(np.maximum(s.strain_rate, 1e-7) / _RATE_0)}


def _rate_power() -> Hooks:
    # The whole flow stress as a power of the rate.
    def overstress(k: float, v: Array, s: State) -> Array:
        return v + s.sigma_P * (1.0 - (np.maximum(s.strain_rate, 1e-7) / _RATE_0) ** -k)

    return {"overstress": overstress}


def _rate_cowper() -> Hooks:
    # Overstress as the square root of the rate, nil at rest.
    return {"overstress": lambda k, v, s: v + k * s.C1 * s.x * np.sqrt(s.strain_rate / _RATE_0)}


def _tau(rng: np.random.Generator, count: int) -> dict[str, Any]:
    return {"tau": float(np.exp(rng.uniform(np.log(10.0), np.log(90.0))))}


# fmt: off
FORMS = (
    Form(
        "creep", "exact", "tau de/dt + e = c sigma", 1e-4,
        lambda tau: {"strain": lambda k, e, s: e + k * _memory(s, lambda lag: 1.0 - np.exp(-lag / tau))}, (1e-5, 3e-3),
        draw=_tau,
    ),
    Form(
        "creep", "logarithmic", "c ln(1 + t/tau) as memory kernel", 1e-4,
        lambda tau: {"strain": lambda k, e, s: e + k * _memory(s, lambda lag: np.log1p(lag / tau))}, (1e-6, 1e-3),
        draw=lambda rng, count: {"tau": float(rng.uniform(2.0, 10.0))},
    ),
    Form(
        "creep", "power", "c (t/60 s)^0.3 as memory kernel", 1e-4,
        lambda power: {"strain": lambda k, e, s: e + k * _memory(s, lambda lag: (lag / 60.0) ** power)}, (1e-6, 3e-3),
        draw=lambda rng, count: {"power": 0.3},
    ),
    Form("rate_dependence", "exact", "C1 (1 + m ln(rate/rate0))", 0.02, _rate, (0.003, 0.1)),
    Form("rate_dependence", "power", "sigma (rate/rate0)^m", 0.02, _rate_power, (0.003, 0.1)),
    Form("rate_dependence", "root", "C1 (1 + m sqrt(rate/rate0))", 0.02, _rate_cowper, (0.003, 0.1)),
)
# fmt: on
