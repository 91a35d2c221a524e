"""A formula for a gap that no listed mechanism explains: few words, their numbers fitted, tried on resamples."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from .forward_selection import pursue
from .linear_model import Base, Signals, System, build_system
from .score import project
from .variable_projection import Tuner, Words

RESAMPLES = 10
"""Random two thirds of the particles for which the formula is looked for once more."""

FOLDS = 5
"""Parts of the campaign that are left out in turn to find the formula by which these particles are judged."""

ALIKE = 0.9
"""Cosine from which on two words, projected, are taken to be the same."""

LETTERS = {
    "q": "peak stress/10 MPa",
    "s": "stress/10 MPa",
    "u": "F/F_peak",
    "eps_P": "peak strain",
    "gamma": "displacement",
    "t": "time",
    "r": "time since the latest reversal",
    "h": "200 um/D_e",
}
"""What stands for what in a formula."""


@dataclass(frozen=True)
class Closure:
    """An addition to displacement found from the data, in units of strain (times D_e).

    Attributes:
        words: columns of its words.
        coefficients, sd: theirs.
        formula: as text.
        gain: drop of chi2.
        selection_frequency: mean share of resamples of the particles in which its words, or near copies, are chosen.
        resembles: the mechanisms whose projected signatures it resembles, with the cosine, best first.
        span: range of the variables over which it was found.
        folds: particles that were left out, and the columns of the formula that the others make.
    """

    words: np.ndarray
    coefficients: np.ndarray
    sd: np.ndarray
    formula: str
    gain: float
    selection_frequency: float
    resembles: tuple[tuple[str, float], ...]
    span: dict[str, tuple[float, float]]
    folds: tuple[tuple[np.ndarray, np.ndarray], ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As in `discovery.json`."""
        return {
            "formula": self.formula,
            "range": {name: list(map(float, pair)) for name, pair in self.span.items()},
            "selection_frequency": float(self.selection_frequency),
            "resembles": [[name, round(float(value), 3)] for name, value in self.resembles],
            "chi2_explained": float(self.gain),
        }


def find_closure(
    base: Base,
    signals: Signals,
    system: System,
    span: dict[str, tuple[float, float]],
    seed: int,
    *,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Closure | None, System]:
    """The formula, or None if no word is worth its place, and the system with it and those of the folds.

    Args:
        base: the fitted campaign.
        signals: what effects and features add in it.
        system: its linear system.
        span: range of the variables over which the formula is found.
        seed: of the resamples.
        tell: called with the name of each step.
    """
    tuner = Tuner(base, signals, system)
    usable = np.flatnonzero(system.usable)
    # A gap just large enough to be called one may have no word that is worth its numbers: then the listed ones.
    whole = tuner.search(usable).words or tuple(system.word(column) for column in pursue(system)[0])
    if not whole:
        return None, system
    tell("trying the formula on resamples")
    rng = np.random.default_rng([seed, 47])
    halves = [rng.choice(usable, max(len(usable) * 2 // 3, 3), replace=False) for _ in range(RESAMPLES)]
    again = [tuner.search(np.sort(half)).words for half in halves] if len(usable) > 3 else []
    groups = [usable[k::FOLDS] for k in range(min(FOLDS, len(usable)))]
    others = [tuner.search(np.setdiff1d(usable, group)).words for group in groups] if len(usable) > 2 else []
    formula = (*whole, *(word for words in others for word in words))
    system = build_system(base, signals.with_formula(base, formula, tuner.values(formula)))
    starts = system.formula_columns[0] + np.cumsum([0, len(whole), *map(len, others)])
    parts = [np.arange(first, end) for first, end in pairwise(starts)]
    chosen = parts[0]
    fitted = project(system, chosen[:0], inside=chosen)
    coefficients = fitted.theta[len(system.globals) :]
    sd = np.sqrt(np.maximum(np.diagonal(fitted.covariance)[len(system.globals) :], 0))
    gain = float(project(system, chosen[:0]).residual.sum() - fitted.residual.sum())
    terms = [f"{c:+.3g} {word.text}" for c, word in zip(coefficients, whole, strict=True)]
    text = "added displacement / D_e = " + " ".join(terms)
    letters = ", ".join(meanings([word.text for word in whole]))
    closure = Closure(
        chosen,
        coefficients,
        sd,
        f"{text}; {letters}" if letters else text,
        gain,
        _frequency(tuner, whole, again, usable),
        _resembling(system, chosen, coefficients),
        span,
        tuple(zip(groups, parts[1:], strict=False)),
    )
    return closure, system


def _resembling(system: System, chosen: np.ndarray, coefficients: np.ndarray) -> tuple[tuple[str, float], ...]:
    """Mechanisms whose projected signatures the formula resembles, with the cosine, best first."""
    view = project(system, np.concatenate([chosen, system.candidate_columns]))
    own, start = np.arange(len(chosen)), len(chosen)
    both = view.information.sum(0)
    length = np.sqrt(max(coefficients @ both[np.ix_(own, own)] @ coefficients, 1e-300))
    scale = np.sqrt(np.maximum(np.diagonal(both)[start:], 1e-300))
    cosine = coefficients @ both[own][:, start:] / scale / length
    cosine = np.where(view.alive[start:], cosine, 0.0)
    signs = system.signs
    cosine = np.where(signs == 0, np.abs(cosine), cosine * signs)
    best: dict[str, float] = {}
    for candidate, value in zip(system.candidates, cosine, strict=True):
        best[candidate.mechanism] = max(best.get(candidate.mechanism, -1.0), float(value))
    return tuple(sorted(((n, v) for n, v in best.items() if v > 0.3), key=lambda pair: -pair[1])[:5])


def meanings(texts: Sequence[str]) -> list[str]:
    """What the letters in the words of a formula stand for."""
    # The s of "41 s" is no stress.
    used = [letter for letter in LETTERS if any(re.search(rf"(?<!\d )\b{letter}\b", text) for text in texts)]
    return [f"{letter} = {LETTERS[letter]}" for letter in used]


def _frequency(tuner: Tuner, chosen: Words, again: Sequence[Words], particles: np.ndarray) -> float:
    """Mean share of other formulas in which the words of one, or words like them, stand."""
    shares = []
    for other in again:
        alike = np.abs(tuner.cosines((*chosen, *other), particles))[: len(chosen), len(chosen) :]
        shares.append(np.mean(np.max(alike, axis=1, initial=0.0) > ALIKE))
    return float(np.mean(shares)) if shares else 0.0
