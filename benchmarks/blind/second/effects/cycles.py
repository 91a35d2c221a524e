"""Cycles: a reload that lags behind, and one that does not come back to where it left."""

from __future__ import annotations

from collections import Counter

import numpy as np

from ..path import RELOAD
from .effect import Array, Campaign, Effect, State


class _Lag(Effect):
    """The displacement lags on reloading, so that a loop dissipates."""

    mechanism = "reload_hysteresis"
    start, unit = 0.03, "-"
    protocols, reloads = ("P1", "P2"), 1

    def lag(self, v: Array) -> Array:
        """Lag along the reload, 0 at both ends."""
        raise NotImplementedError

    def depth(self, c: Campaign) -> Array | float:
        """How the lag grows with the unloading before."""
        return 1.0

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        lag = -theta * s.delta * s.De * self.lag(c.path.reload_share) * self.depth(c)
        return np.where(c.path.branch == RELOAD, lag, 0.0)


class LagParabola(_Lag):
    text = "reload: gamma -= th*delta*D_e*4v(1-v), v=(F-F_turn)/(F_P-F_turn)"

    def lag(self, v: Array) -> Array:
        return 4 * v * (1 - v)


class LagSticking(_Lag):
    text = "reload: gamma -= th*delta*D_e*(1-exp(-v/{k}))*(1-v^{m}) (sticking contact slips early)"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"k": float(rng.uniform(0.08, 0.2)), "m": int(rng.integers(2, 5))}

    def lag(self, v: Array) -> Array:
        return -np.expm1(-v / self.drawn.k) * (1 - v**self.drawn.m)


class LagMasing(_Lag):
    text = "reload: gamma -= th*delta*D_e*(1-F_turn/F_P)*6.75*v^2*(1-v) (Masing-like, late closure)"

    def lag(self, v: Array) -> Array:
        return 6.75 * v * v * (1 - v)

    def depth(self, c: Campaign) -> Array | float:
        return 1 - c.path.turn_stress / c.path.peak


class _Ratchet(Effect):
    """Every reload adds strain that stays."""

    mechanism = "ratcheting"
    start, unit = 0.05, "-"
    protocols, reloads = ("P1", "P2"), 3
    exponent = 2.0

    def step(self, c: Campaign, s: State, number: int, at: int) -> float:
        """Strain per amplitude that the reload of this number, beginning at sample `at`, adds."""
        raise NotImplementedError

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        out = np.zeros(len(c.path))
        numbers = Counter()
        for i, begin, end, stop in c.path.reloads:
            numbers[i] += 1
            added = theta * self.step(c, s, numbers[i], begin) * c.particles.De[i]
            out[begin:end] += added * np.clip(c.path.reload_share[begin:end], 0, 1) ** self.exponent
            out[end:stop] += added
        return out


class RatchetDepth(_Ratchet):
    text = "every reload adds eps += th*delta_k*(1-sigma_turn/sigma_P), kept for good, grown as v^2 along the reload"

    def step(self, c: Campaign, s: State, number: int, at: int) -> float:
        return s.delta[at] * (1 - c.path.turn_stress[at] / s.peak[at])


class RatchetShakedown(_Ratchet):
    text = "k-th reload adds eps += th*delta_k*k^(-{q}) grown as v^4 (shakedown)"
    exponent = 4.0

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"q": float(rng.uniform(0.4, 0.9))}

    def step(self, c: Campaign, s: State, number: int, at: int) -> float:
        return s.delta[at] * number ** (-self.drawn.q)


class RatchetChaboche(_Ratchet):
    text = "k-th reload adds eps += th*eps_P*exp(-{q}(k-1)), grown as v^3 (Chaboche-type, in plastic strain)"
    start = 1e-3
    exponent = 3.0

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"q": float(rng.uniform(0.2, 0.5))}

    def step(self, c: Campaign, s: State, number: int, at: int) -> float:
        return s.eps_P[at] * np.exp(-self.drawn.q * (number - 1))


FORMULAS = (LagParabola, LagSticking, LagMasing, RatchetDepth, RatchetShakedown, RatchetChaboche)
