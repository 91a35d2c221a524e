"""A formula for a gap that no listed mechanism explains: few words, found by matching pursuit, tried on resamples."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ._score import project, project_summed
from ._system import System

MOST_WORDS = 3
WORTH = 14.0
"""Least drop of chi2 for which another word is taken: about log of the number of words, twice, and one parameter."""

RESAMPLES = 40

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
    """

    words: np.ndarray
    coefficients: np.ndarray
    sd: np.ndarray
    formula: str
    gain: float
    selection_frequency: float
    resembles: tuple[tuple[str, float], ...]
    span: dict[str, tuple[float, float]]

    def to_json(self) -> dict[str, Any]:
        """As in `discovery.json`."""
        return {
            "formula": self.formula,
            "range": {name: list(map(float, pair)) for name, pair in self.span.items()},
            "selection_frequency": float(self.selection_frequency),
            "resembles": [[name, round(float(value), 3)] for name, value in self.resembles],
            "chi2_explained": float(self.gain),
        }


def pursue(system: System, *, particles: np.ndarray | None = None, most: int = MOST_WORDS) -> tuple[list[int], float]:
    """Words one after the other, each time the one that takes away most together with those before.

    Returns:
        Columns, and the drop of chi2 by all of them.
    """
    columns, total = system.word_columns, system.total(particles)
    inside: list[int] = []
    base = float("nan")
    while True:
        found = project_summed(total, system, columns, np.array(inside, int), 1e-4)
        if not inside:
            base = found.residual
        best = int(np.argmax(found.drop))
        if len(inside) == most or found.drop[best] < WORTH:
            return inside, base - found.residual
        inside.append(int(columns[best]))


def find_closure(
    system: System, span: dict[str, tuple[float, float]], seed: int, *, tell: Callable[[str], None] = lambda _: None
) -> Closure | None:
    """The formula, or None if no word is worth its place."""
    chosen, gain = pursue(system)
    if not chosen:
        return None
    tell("trying the formula on resamples")
    nuisance = len(system.globals)
    fitted = project(system, system.candidate_columns[:0], inside=np.array(chosen))
    coefficients = fitted.theta[nuisance:]
    sd = np.sqrt(np.maximum(np.diagonal(fitted.covariance)[nuisance:], 0))
    everything = np.concatenate([system.word_columns, system.candidate_columns])
    view = project(system, everything)
    alike = view.similarity()
    position = {int(c): i for i, c in enumerate(everything)}
    own = [position[c] for c in chosen]
    frequency = _frequency(system, chosen, alike, position, seed)
    both = view.information.sum(0)
    length = np.sqrt(max(coefficients @ both[np.ix_(own, own)] @ coefficients, 1e-300))
    start = len(system.word_columns)
    scale = np.sqrt(np.maximum(np.diagonal(both)[start:], 1e-300))
    cosine = coefficients @ both[own][:, start:] / scale / length
    cosine = np.where(view.alive[start:], cosine, 0.0)
    signs = system.signs
    cosine = np.where(signs == 0, np.abs(cosine), cosine * signs)
    best: dict[str, float] = {}
    for candidate, value in zip(system.candidates, cosine, strict=True):
        best[candidate.mechanism] = max(best.get(candidate.mechanism, -1.0), float(value))
    resembles = tuple(sorted(((n, v) for n, v in best.items() if v > 0.3), key=lambda pair: -pair[1])[:5])
    first = system.word_columns[0]
    terms = [f"{c:+.3g} {system.words[w - first].text}" for c, w in zip(coefficients, chosen, strict=True)]
    formula = "added displacement / D_e = " + " ".join(terms)
    letters = ", ".join(meanings([system.words[w - first].text for w in chosen]))
    formula = f"{formula}; {letters}" if letters else formula
    return Closure(np.array(chosen), coefficients, sd, formula, gain, frequency, resembles, span)


def meanings(texts: Sequence[str]) -> list[str]:
    """What the letters in the words of a formula stand for."""
    # The s of "41 s" is no stress.
    used = [letter for letter in LETTERS if any(re.search(rf"(?<!\d )\b{letter}\b", text) for text in texts)]
    return [f"{letter} = {LETTERS[letter]}" for letter in used]


def _frequency(system: System, chosen: list[int], alike: np.ndarray, position: dict[int, int], seed: int) -> float:
    rng = np.random.default_rng([seed, 47])
    usable = np.flatnonzero(system.usable)
    if len(usable) < 4:
        return 0.0
    hits = 0.0
    for _ in range(RESAMPLES):
        half = rng.choice(usable, size=max(len(usable) * 2 // 3, 3), replace=False)
        again, _ = pursue(system, particles=half, most=len(chosen))
        near = [max((abs(alike[position[c], position[d]]) for d in again), default=0.0) > 0.9 for c in chosen]
        hits += float(np.mean(near))
    return hits / RESAMPLES
