"""What is missing where no listed mechanism explains it: a curve with its band, and a short formula near it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from .._format import described
from .evidence import LinearModel
from .periods import Periodogram, sinusoids
from .search import Search
from .settings import HYPERPARAMETERS, UNLISTED

POINTS, PER_PERIOD = 60, 12  # of the curve, and of each period at least
WAVES = 12  # periods of a formula over the range of its coordinate
SHORTLIST = 24  # terms that are tried in pairs
ONE_TERM = 0.9  # share of what two terms of a formula explain from which on one term will do

LETTERS = {  # coordinates of a formula: letter and meaning
    "strain": ("e", "reduced peak strain (1 + a H) epsilon_P"),
    "peak": ("s", "square root of the peak stress [MPa]"),
    "travel": ("g", "displacement / D_e"),
    "load": ("u", "F / F_peak"),
    "clock": ("t", "time [s]"),
    "force": ("F", "force [mN]"),
    "drive": ("d", "displacement [um]"),  # in what repeats alone; dF/dd is the test's stiffness
}


@dataclass(frozen=True)
class Closure:
    """An addition to displacement found from the data, in units of strain (times D_e)."""

    formula: str  # of at most two terms with rounded numbers
    coordinate: str  # which coordinate explains most of it
    x: np.ndarray  # the curve along it
    added: np.ndarray  # in units of strain
    sd: np.ndarray  # its standard error
    selection_frequency: float  # share of resamples of the particles in which the same coordinate explains most
    resembles: tuple[tuple[str, float], ...]  # mechanisms with projected signatures like it, and the cosine, best first
    span: dict[str, tuple[float, float]]  # range of the coordinates over which it was found
    correction_um: np.ndarray  # displacement that it adds at every point, shape (N, points)
    held_out_um: np.ndarray  # the same by the tests without the one it is for

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


def terms_of(letter: str, x: np.ndarray, low: float, high: float) -> dict[str, np.ndarray]:
    """Readable functions of a coordinate over its range, as they are printed, and their values."""
    reach, positive = max(high - low, 1e-300), np.maximum(x, 0.0)
    found = {letter: x, f"{letter}^2": x**2, f"{letter}^3": x**3, f"sqrt({letter})": np.sqrt(positive)}
    for share in (0.03, 0.1, 0.3):
        s = _rounded(share * reach)
        found[f"(1 - exp(-{letter}/{s:g}))"] = 1 - np.exp(-positive / s)
        found[f"ln(1 + {letter}/{s:g})"] = np.log1p(positive / s)
    for k in range(2, 2 * WAVES):
        p = _rounded(2 * reach / k, 3)
        found[f"sin(2 pi {letter}/{p:g})"] = np.sin(2 * np.pi * x / p)
        found[f"cos(2 pi {letter}/{p:g})"] = np.cos(2 * np.pi * x / p)
    for share in (0.2, 0.4, 0.6, 0.8):
        c, w = _rounded(low + share * reach), _rounded(0.15 * reach)
        found[f"exp(-(({letter} - {c:g})/{w:g})^2)"] = np.exp(-(((x - c) / w) ** 2))
    return found


def _periodic(letter: str, one: Periodogram, size: np.ndarray) -> dict[str, np.ndarray]:
    """Sinusoids of the likeliest period, as they are printed, and their values: errors of an instrument in its unit."""
    unit = {"force": "mN / (D_e dF/dd) ", "strain": "", "travel": ""}.get(one.coordinate, "um / D_e ")
    values = np.moveaxis(sinusoids(np.array([one.best]), one.errors), -1, 0) / size[:, None]
    period = _rounded(1 / one.best, 4)
    return {f"{unit}{name}(2 pi {letter}/{period:g})": x for name, x in zip(("cos", "sin"), values, strict=True)}


def _rounded(x: float, digits: int = 2) -> float:
    return float(f"{x:.{digits}g}")


def closure(search: Search, seed: int) -> Closure:
    """Curve and formula of the smooth discrepancy that was found; `seed` is that of the resamples of particles."""
    smooth, tests = search.found[UNLISTED].fitted, search.base.tests
    mask, size = np.asarray(tests.mask), np.asarray(tests.effective_diameter)
    natural = {name: search.natural[name] for name in LETTERS if name in search.natural}
    span = {name: (float(x[mask].min()), float(x[mask].max())) for name, x in natural.items()}
    moving = {n: x for n, x in natural.items() if span[n][1] > span[n][0]}
    every = {n: terms_of(LETTERS[n][0], x, *span[n]) for n, x in moving.items() if n != "drive"}
    periods = {one.coordinate: one for one in search.discrepancy.periods}
    periodic = {n: _periodic(LETTERS[n][0], one, size) for n, one in periods.items()}
    every |= {n: every.get(n, {}) | of_one for n, of_one in periodic.items()}
    terms = [(name, text) for name, of_one in every.items() for text in of_one]
    values = np.stack([x * size[:, None] for of_one in every.values() for x in of_one.values()], -1)
    values = np.where(mask[..., None], values, 0.0)
    scale = np.maximum(np.sqrt((values**2).mean((0, 1))), 1e-300)
    whole, hyper = smooth.design, smooth.optimum.hyper[:HYPERPARAMETERS]
    fixed = whole.group == 0
    law = replace(whole, common=whole.common[..., fixed], group=whole.group[fixed], misfits=whole.misfits[:0])
    curve = search.discrepancy.curve_um(smooth)
    columns = np.concatenate([values / scale, curve[..., None], search.screen.candidates.columns], -1)
    model, everyone = LinearModel(hyper, law.with_amplitudes(columns)), np.arange(len(size))
    chosen, weights = _best_terms(model, len(terms), everyone)
    rng = np.random.default_rng([seed, 47])
    again = [_best_terms(model, len(terms), rng.choice(everyone, len(everyone)), one=True)[0][0] for _ in range(20)]
    name = terms[chosen[0]][0]
    texts = [f"{_rounded(w / scale[k]):+g} {terms[k][1]}" for k, w in zip(chosen, weights, strict=True)]
    meanings = dict.fromkeys(" = ".join(LETTERS[terms[k][0]]) for k in chosen)
    # Weights along the coordinate have the size that the smooth discrepancy was found to have, in units of strain.
    unit = float(np.sqrt(np.mean((curve / size[:, None])[mask] ** 2)))
    if terms[chosen[0]][1] in periodic.get(name, {}):
        one = periods[name]
        x = np.linspace(*span[name], max(POINTS, int(PER_PERIOD * one.best * np.ptp(span[name]))))
        basis, there = one.columns(one.errors) * np.mean(size), one.columns([(x, one.unit)])
    else:
        x, there = np.linspace(*span[name], POINTS), _cosines(np.linspace(0.0, 1.0, POINTS))
        basis = _cosines(search.at[name]) * size[:, None, None]
    basis = np.where(mask[..., None], basis, 0.0)
    shared = LinearModel(hyper, law.with_amplitudes(basis)).shared()
    covariance = np.linalg.inv(shared.information + np.eye(basis.shape[-1]) / max(unit, 1e-12) ** 2)
    # What the discrepancy adds to every test by the weights that the others make.
    smoothed = LinearModel(smooth.optimum.hyper, whole)
    others = np.array([smoothed.numbers(np.delete(everyone, i))[0][: len(fixed)][~fixed] for i in everyone])
    held_out = np.einsum("npc,nc->np", whole.common[..., ~fixed], others * smoothed.scales[1][~fixed])
    return Closure(
        formula=f"added displacement / D_e = {' '.join(texts)}; {', '.join(meanings)}",
        coordinate=name,
        x=x,
        added=there @ (covariance @ shared.score),
        sd=np.sqrt(np.maximum(np.einsum("xk,kl,xl->x", there, covariance, there), 0.0)),
        selection_frequency=float(np.mean([terms[k][0] == name for k in again])),
        resembles=_resembling(search, model, len(terms)),
        span=span,
        correction_um=curve,
        held_out_um=held_out,
    )


def _best_terms(model: LinearModel, count: int, rows: Any, *, one: bool = False) -> tuple[tuple[int, ...], np.ndarray]:
    """The term, or the two, that explain most in some particles, and their weights."""
    shared = model.shared(rows)
    G, s = shared.information[:count, :count], shared.score[:count]
    power = np.maximum(np.diagonal(G), 1e-300)
    single = s**2 / power
    first = int(np.argmax(single))
    chosen, weights, most = (first,), np.array([s[first] / power[first]]), single[first] / ONE_TERM
    for i, j in combinations(np.argsort(-single)[: 0 if one else SHORTLIST].tolist(), 2):
        inner = G[np.ix_([i, j], [i, j])]
        if np.linalg.cond(inner) < 1e6:
            w = np.linalg.solve(inner, s[[i, j]])
            if w @ s[[i, j]] > most:
                chosen, weights, most = (i, j), w, w @ s[[i, j]]
    return chosen, weights


def _cosines(x: np.ndarray) -> np.ndarray:
    """Functions of a coordinate between 0 and 1 along which the curve is drawn."""
    count = 2 * WAVES
    return np.cos(np.pi * np.arange(1, count) * x[..., None]) / np.sqrt(count)


def _resembling(search: Search, model: LinearModel, place: int) -> tuple[tuple[str, float], ...]:
    """Mechanisms whose projected signatures are like the curve's, with the cosine, best first."""
    G, candidates = model.shared().information, search.screen.candidates
    own = max(G[place, place], 1e-300)
    cosine = G[place, place + 1 :] / np.sqrt(own * np.maximum(np.diagonal(G)[place + 1 :], 1e-300))
    cosine = np.where(candidates.signs == 0, np.abs(cosine), cosine * candidates.signs)
    alike = sorted(zip((c.mechanism for c in candidates.each), cosine.tolist(), strict=True), key=lambda one: one[1])
    best = dict(alike)  # of each mechanism the formula that is most like it
    return tuple(sorted(((n, v) for n, v in best.items() if v > 0.3), key=lambda pair: -pair[1])[:5])
