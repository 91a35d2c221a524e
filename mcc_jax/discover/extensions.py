"""Extended laws fitted as they are, each once, and which of them are worth it."""

from __future__ import annotations

import numpy as np

from .evidence import Ranking
from .gauss_newton import Refit, refit, system_at
from .linear_model import Base, Signals, System

SERIOUS, MIN_GAIN, MAX_REFITS = 0.1, 9.0, 12
"""Mechanisms whose log evidence is at least this share of the best one's are serious, if their best formula takes away
so much chi2; so many formulas at most. The share is small: where the base law has moved far to take up an effect, or
the effect grows faster than its amplitude, first order may see a tenth of it."""

BEST = 2
"""Formulas of a serious mechanism that are fitted: so many by evidence, and as many by evidence and what is known
beforehand, mostly the same ones."""


class Extensions:
    """The law extended by effects, fitted as it is: once each, and only where first order may not do."""

    def __init__(self, base: Base, system: System, signals: Signals) -> None:
        self.base, self.system, self.signals = base, system, signals
        self.known: dict[tuple[int, ...], Refit] = {}

    def fit(self, chosen: tuple[int, ...]) -> Refit:
        """The base law with some candidates."""
        if chosen not in self.known:
            candidates = tuple(self.system.candidates[k] for k in chosen)
            self.known[chosen] = refit(self.base, candidates, self.system.prior, self.system.curved(chosen))
        return self.known[chosen]

    def drop(self, chosen: tuple[int, ...]) -> float:
        """By how much -2 log likelihood falls; not at all where an amplitude has a sign that it cannot have."""
        found = self.fit(chosen)
        return max(self.fit(()).deviance - found.deviance, 0.0) if found.physical else 0.0

    def system_of(self, chosen: tuple[int, ...]) -> System:
        """The linear system around the law with effects."""
        return system_at(self.base, self.system, self.signals, list(chosen), self.fit(chosen))


def serious(system: System, ranking: Ranking) -> list[int]:
    """Candidates worth a fit of their own: the best few formulas of every mechanism that may be true."""
    chosen: list[int] = []
    best = ranking.log_evidence[0]
    found = zip(ranking.names, ranking.log_evidence, ranking.gain, ranking.at_random, strict=True)
    for name, value, gain, at_random in found:
        if value < SERIOUS * best or len(chosen) >= MAX_REFITS:
            break
        if at_random or gain < MIN_GAIN:
            continue
        members = np.array([k for k, c in enumerate(system.candidates) if c.mechanism == name])
        chosen += dict.fromkeys(
            k for worth in (ranking.favour, ranking.evidence) for k in _best_formulas(system, members, worth)
        )
    return chosen[:MAX_REFITS]


def _best_formulas(system: System, members: np.ndarray, worth: np.ndarray) -> list[int]:
    """The best candidate of each of the best few formulas."""
    formulas: dict[str, int] = {}
    for k in members[np.argsort(-worth[members], kind="stable")].tolist():
        if np.isfinite(worth[k]):
            formulas.setdefault(system.candidates[k].variant.name, k)
    return list(formulas.values())[:BEST]
