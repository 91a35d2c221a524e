"""What is missing where no listed mechanism explains it: a curve with its band, and a short formula near it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from .._format import described
from .columns import with_amplitudes, without_misfits
from .evidence import LinearModel
from .hypothesis import UNLISTED
from .search import Search
from .settings import HYPERPARAMETERS, WAVES

POINTS = 60  # of the curve
ONE_TERM = 0.9  # share of what two terms of a formula explain from which on one term will do

LETTERS = {
    "strain": ("e", "reduced peak strain (1 + a H) epsilon_P"),
    "peak": ("s", "square root of the peak stress [MPa]"),
    "travel": ("g", "displacement / D_e"),
    "load": ("u", "F / F_peak"),
    "clock": ("t", "time [s]"),
    "force": ("F", "force [mN]"),
}
"""Coordinates of a formula: letter and meaning."""


@dataclass(frozen=True)
class Term:
    """A term of a formula: a function of one coordinate."""

    coordinate: str
    text: str  # as it is printed
    function: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Closure:
    """An addition to displacement found from the data, in units of strain (times D_e).

    Attributes:
        formula: as text, of at most two terms with rounded numbers.
        coordinate: which coordinate explains most of it.
        x, added, sd: the curve along it, in units of strain, and its standard error.
        selection_frequency: share of resamples of the particles in which the same coordinate explains most.
        resembles: mechanisms whose projected signatures it resembles, with the cosine, best first.
        span: range of the coordinates over which it was found.
        correction_um, held_out_um: displacement that it adds at every point, shape (N, points): by all tests, and by
            the tests without the one it is for.
    """

    formula: str
    coordinate: str
    x: np.ndarray
    added: np.ndarray
    sd: np.ndarray
    selection_frequency: float
    resembles: tuple[tuple[str, float], ...]
    span: dict[str, tuple[float, float]]
    correction_um: np.ndarray
    held_out_um: np.ndarray

    __repr__ = described()

    def to_json(self) -> dict[str, Any]:
        """As in `discovery.json`."""
        return {
            "formula": self.formula,
            "range": {name: list(pair) for name, pair in self.span.items()},
            "selection_frequency": self.selection_frequency,
            "resembles": [[name, round(value, 3)] for name, value in self.resembles],
            "curve": {
                "coordinate": LETTERS[self.coordinate][1],
                "x": self.x.tolist(),
                "added_over_D": self.added.tolist(),
                "sd": self.sd.tolist(),
            },
        }


def terms_of(name: str, low: float, high: float) -> list[Term]:
    """Readable functions of a coordinate over its range."""
    letter, reach = LETTERS[name][0], max(high - low, 1e-300)
    found = [
        Term(name, letter, lambda x: x),
        Term(name, f"{letter}^2", lambda x: x**2),
        Term(name, f"{letter}^3", lambda x: x**3),
        Term(name, f"sqrt({letter})", lambda x: np.sqrt(np.maximum(x, 0.0))),
    ]
    for share in (0.03, 0.1, 0.3):
        s = _rounded(share * reach)
        found.append(Term(name, f"(1 - exp(-{letter}/{s:g}))", lambda x, s=s: 1 - np.exp(-np.maximum(x, 0.0) / s)))
        found.append(Term(name, f"ln(1 + {letter}/{s:g})", lambda x, s=s: np.log1p(np.maximum(x, 0.0) / s)))
    for k in range(2, 2 * WAVES):
        p = _rounded(2 * reach / k, 3)
        found.append(Term(name, f"sin(2 pi {letter}/{p:g})", lambda x, p=p: np.sin(2 * np.pi * x / p)))
        found.append(Term(name, f"cos(2 pi {letter}/{p:g})", lambda x, p=p: np.cos(2 * np.pi * x / p)))
    for share in (0.2, 0.4, 0.6, 0.8):
        c, w = _rounded(low + share * reach), _rounded(0.15 * reach)
        text = f"exp(-(({letter} - {c:g})/{w:g})^2)"
        found.append(Term(name, text, lambda x, c=c, w=w: np.exp(-(((x - c) / w) ** 2))))
    return found


def _rounded(x: float, digits: int = 2) -> float:
    return float(f"{x:.{digits}g}")


def closure(search: Search, seed: int) -> Closure:
    """Curve and formula of the smooth discrepancy that was found; `seed` is that of the resamples of particles."""
    smooth = search.found[UNLISTED].at
    assert smooth is not None
    tests = search.base.tests
    mask, size = np.asarray(tests.mask), np.asarray(tests.effective_diameter)
    natural = {name: np.asarray(search.natural[name]) for name in LETTERS if name in search.natural}
    span = {name: (float(x[mask].min()), float(x[mask].max())) for name, x in natural.items()}
    terms = [t for name, (low, high) in span.items() if high > low for t in terms_of(name, low, high)]
    values = np.stack([t.function(natural[t.coordinate]) * size[:, None] for t in terms], -1)
    values = np.where(mask[..., None], values, 0.0)
    scale = np.maximum(np.sqrt((values**2).mean((0, 1))), 1e-300)
    law, hyper = without_misfits(smooth.design), smooth.optimum.hyper[:HYPERPARAMETERS]
    curve = search.discrepancy.curve_um(smooth)[..., None]
    known = np.zeros((*curve.shape[:2], 0)) if search.screen is None else search.screen.columns
    every = np.concatenate([values / scale, curve, known], -1)
    model, T = LinearModel(hyper, with_amplitudes(law, every)), len(terms)
    everyone = np.arange(len(size))
    chosen, weights = _best_terms(model, T, everyone)
    rng = np.random.default_rng([seed, 47])
    again = [terms[_best_terms(model, T, rng.choice(everyone, len(everyone)), one=True)[0][0]] for _ in range(20)]
    name = terms[chosen[0]].coordinate
    x = np.linspace(*span[name], POINTS)
    texts = [f"{_rounded(w / scale[k]):+g} {terms[k].text}" for k, w in zip(chosen, weights, strict=True)]
    letters = dict.fromkeys(terms[k].coordinate for k in chosen)
    meaning = ", ".join(f"{LETTERS[n][0]} = {LETTERS[n][1]}" for n in letters)
    added, sd = _along(search, name, x, span[name])
    return Closure(
        f"added displacement / D_e = {' '.join(texts)}; {meaning}",
        name,
        x,
        added,
        sd,
        float(np.mean([t.coordinate == name for t in again])),
        _resembling(search, model, T),
        span,
        curve[..., 0],
        _held_out(LinearModel(smooth.optimum.hyper, smooth.design), search.discrepancy.basis),
    )


def _best_terms(
    model: LinearModel, count: int, rows: np.ndarray, *, one: bool = False
) -> tuple[tuple[int, ...], np.ndarray]:
    """The term, or the two, that explain most in some particles, and their weights."""
    shared = model.shared(rows)
    G, s = shared.information[:count, :count], shared.score[:count]
    power = np.maximum(np.diagonal(G), 1e-300)
    single = s**2 / power
    first = int(np.argmax(single))
    if one:
        return (first,), np.array([s[first] / power[first]])
    best = [int(k) for k in np.argsort(-single)[:24]]
    pairs = []
    for i, j in combinations(best, 2):
        inner = G[np.ix_([i, j], [i, j])]
        if np.linalg.cond(inner) < 1e6:
            w = np.linalg.solve(inner, s[[i, j]])
            pairs.append((float(w @ s[[i, j]]), (i, j), w))
    if not pairs or single[first] > ONE_TERM * max(p[0] for p in pairs):
        return (first,), np.array([s[first] / power[first]])
    _, two, w = max(pairs, key=lambda p: p[0])
    return two, w


def _resembling(search: Search, model: LinearModel, place: int) -> tuple[tuple[str, float], ...]:
    """Mechanisms whose projected signatures are like the curve's, with the cosine, best first."""
    if search.screen is None:
        return ()
    G = model.shared().information
    own = max(G[place, place], 1e-300)
    cosine = G[place, place + 1 :] / np.sqrt(own * np.maximum(np.diagonal(G)[place + 1 :], 1e-300))
    signs = search.screen.signs
    cosine = np.where(signs == 0, np.abs(cosine), cosine * signs)
    best: dict[str, float] = {}
    for c, value in zip(search.screen.candidates, cosine, strict=True):
        best[c.mechanism] = max(best.get(c.mechanism, -1.0), float(value))
    return tuple(sorted(((n, v) for n, v in best.items() if v > 0.3), key=lambda pair: -pair[1])[:5])


def _along(search: Search, name: str, x: np.ndarray, span: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """The discrepancy as a function of one coordinate, in units of strain, and its standard error."""
    smooth = search.found[UNLISTED].at
    assert smooth is not None
    tests, N = search.base.tests, 2 * WAVES
    size = np.asarray(tests.effective_diameter)
    at = np.asarray(search.at[name])

    def functions(u: np.ndarray) -> np.ndarray:
        return np.stack([np.cos(np.pi * k * u) for k in range(1, N)], -1)

    basis = functions(at) * size[:, None, None] / np.sqrt(N)
    basis = np.where(np.asarray(tests.mask)[..., None], basis, 0.0)
    law, hyper = without_misfits(smooth.design), smooth.optimum.hyper[:HYPERPARAMETERS]
    shared = LinearModel(hyper, with_amplitudes(law, basis)).shared()
    # Weights have the size that the smooth discrepancy was found to have, in units of strain.
    unit = float(np.sqrt(np.mean((search.discrepancy.curve_um(smooth) / size[:, None])[np.asarray(tests.mask)] ** 2)))
    covariance = np.linalg.inv(shared.information + np.eye(N - 1) / max(unit, 1e-12) ** 2)
    there = functions((x - span[0]) / max(span[1] - span[0], 1e-300)) / np.sqrt(N)
    sd = np.sqrt(np.maximum(np.einsum("xk,kl,xl->x", there, covariance, there), 0.0))
    return there @ (covariance @ shared.score), sd


def _held_out(model: LinearModel, basis: np.ndarray) -> np.ndarray:
    """What the discrepancy adds to every test by the weights that the others make [um]."""
    every, misfits = np.arange(len(basis)), model.design.of_misfits
    weights = [model.numbers(np.delete(every, i))[0][misfits] * model.scales[1][misfits] for i in every]
    return np.einsum("npc,nc->np", basis, np.array(weights))
