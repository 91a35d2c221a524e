"""Is anything missing at all, and does what was found hold on particles that took no part in finding it?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from ..calibrate.estimates import finite
from ..calibrate.judgement import LARGE_MISFIT
from ..calibrate.priors import SCALES
from .base import Base
from .evidence import LinearModel, marginalise
from .hypothesis import Names
from .screen import single_integrals
from .search import Search
from .settings import CONTENDERS, DECISIONS, HYPERPARAMETERS, POPULATION, UNLISTED

CAMPAIGNS = 400  # drawn for the p value: its standard error at a level of 0.05 is 0.011
PLACES_OF_STEPS = 24  # of a sudden step in each test
SHARES = 60  # points of the common path on which the residuals of two tests are multiplied


class _Statistic:
    """The log evidence of anything against nothing, from scores at the base law's hyperparameters."""

    def __init__(self, search: Search) -> None:
        design, formulas = search.null.design, search.screen.candidates
        self.library, self.signs, self.largest = len(search.library), formulas.signs, formulas.largest
        names = [(c.mechanism, c.variant.name) for c in formulas.each]
        variants = {m: len({f for n, f in names if n == m}) for m, _ in names}
        self.weight = -np.log([variants[name[0]] * names.count(name) for name in names])
        self.sizes, self.periods = search.discrepancy.sizes, search.discrepancy.periods
        parts = search.discrepancy.smooth
        self.parts = np.repeat(np.arange(len(parts)), [part.shape[-1] for part in parts])
        own = search.candidates.of({name: m for name, m in search.not_shared.items() if not m.sudden})
        self.own_names, self.own_ratio = own.mechanisms, own.largest
        sudden = next((m.variants[0] for m in search.library.values() if m.sudden), None)
        low, high = (1.0, 1.0) if sudden is None else sudden.plausible
        steps = _steps(search.base, low, 0 if sudden is None else PLACES_OF_STEPS)
        self.ratio_of_steps = high / low
        every = [design.common[..., :POPULATION], formulas.columns, np.concatenate(parts, -1), own.columns, steps]
        self.counts = [columns.shape[-1] for columns in every]
        nothing = replace(design, common=design.common[..., :0], group=design.group[:0])
        model = LinearModel(search.null.optimum.hyper, nothing.with_amplitudes(np.concatenate(every, -1)))
        # Of every particle; the population's come first.
        self.gram, self.score = model.particles.information, model.particles.score

    def __call__(self, score: np.ndarray, powers: Sequence[np.ndarray]) -> np.ndarray:
        """Log evidence ratios of campaigns, from scores of shape (campaigns, N, columns) and periodograms."""
        _, formulas, _, own, steps = np.split(np.arange(score.shape[-1]), np.cumsum(self.counts)[:-1])
        gram, shared, f = self.gram, np.arange(sum(self.counts[:3])), len(formulas)
        whole, total = gram[:, shared[:, None], shared].sum(0), score[..., shared].sum(1)
        inner = np.linalg.inv(np.eye(POPULATION) + whole[:POPULATION, :POPULATION])
        law = marginalise(whole, POPULATION)
        G, s = law.schur, total[:, POPULATION:] - total[:, :POPULATION] @ law.weights.T
        logs: list[Any] = []
        prior = -float(np.log(self.library))
        if f:
            each = single_integrals(s[:, :f], np.diagonal(G)[:f], self.signs, self.largest)
            logs.append(prior + np.asarray(logsumexp(each + self.weight, axis=1)))
        smooth = [one.log_ratio(self.sizes, power) for one, power in zip(self.periods, powers, strict=True)]
        for part in np.unique(self.parts):  # at first order one part of the discrepancy at a time
            at = f + np.flatnonzero(self.parts == part)
            inside, scores = G[np.ix_(at, at)], s[:, at]
            for size in self.sizes:
                spread = np.eye(len(at)) + size**2 * inside
                value = 0.5 * size**2 * np.einsum("mk,km->m", scores, np.linalg.solve(spread, scores.T))
                smooth.append(value - 0.5 * np.linalg.slogdet(spread)[1])
        logs.append(-DECISIONS.unlisted + np.asarray(logsumexp(smooth, axis=0)) - np.log(len(smooth)))
        rest = score - np.einsum("ncp,mp->mnc", gram[:, :, :POPULATION], total[:, :POPULATION] @ inner)
        for name in dict.fromkeys(self.own_names):
            values = []
            for k in np.flatnonzero(self.own_names == name):
                power = gram[:, own[k], own[k]]
                for scale in np.geomspace(1.0, self.own_ratio[k], SCALES):
                    spread = 1 + scale**2 * power
                    values.append(np.sum(0.5 * (scale**2 * rest[..., own[k]] ** 2 / spread - np.log(spread)), 1))
            logs.append(prior + np.asarray(logsumexp(values, axis=0)) - np.log(len(values)))
        if len(steps):
            each = single_integrals(rest[..., steps], gram[:, steps, steps], 1, self.ratio_of_steps)
            ratio = logsumexp(each, axis=2) - np.log(len(steps))
            any_ = np.logaddexp(np.log1p(-DECISIONS.jump), np.log(DECISIONS.jump) + ratio)
            logs.append(prior + any_.sum(1))
        return np.asarray(logsumexp(logs, axis=0))


def p_anything(search: Search, seed: int) -> float:
    """Probability that the base law alone would give as much evidence of anything missing, from scores drawn at its
    fitted hyperparameters: normal, with the information as covariance; powers of a periodogram are exponential."""
    statistic = _Statistic(search)
    values, vectors = np.linalg.eigh(statistic.gram)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    rng, periods = np.random.default_rng([seed, 41]), statistic.periods
    normal = rng.standard_normal((CAMPAIGNS, *statistic.score.shape))
    powers = [rng.standard_exponential((CAMPAIGNS, len(one.power))) for one in periods]
    drawn = statistic(np.einsum("ncd,mnd->mnc", root, normal, optimize=True), powers)
    seen = statistic(statistic.score[None], [one.power[None] for one in periods])
    return (1 + int(np.sum(drawn >= seen[0]))) / (1 + CAMPAIGNS)


def _steps(base: Base, height: float, count: int) -> np.ndarray:
    """Steps at some points of every test's loading."""
    mask = np.asarray(base.tests.mask)
    loading = np.asarray(base.tests.loading) & mask
    columns = np.zeros((*mask.shape, count))
    for i, rows in enumerate(map(np.flatnonzero, loading)):
        if len(rows) > 1:
            for k, j in enumerate(rows[np.linspace(1, len(rows) - 1, count).astype(int)]):
                columns[i, j:, k] = np.where(mask[i, j:], height, 0.0)
    return columns


@dataclass(frozen=True)
class HeldOut:
    """Held-out results of every step, the base law first."""

    labels: tuple[str | None, ...]  # what was added at each step; None for the base law
    chi2: np.ndarray  # of every particle, shape (steps, N), under the noise of the law with everything added
    points: np.ndarray  # of every particle
    elpd: np.ndarray  # log predictive density of every particle, shape (steps, N)
    repeating_um2: np.ndarray  # mean product of two different particles' residuals at one share of the path [um^2]
    residual_um: np.ndarray  # measured less predicted displacement, shape (steps, N, points)

    def _gain(self, step: int) -> tuple[float, float]:
        """Log predictive density over the base law's, and its standard error (Vehtari, Gelman and Gabry 2017)."""
        gain = self.elpd[step] - self.elpd[0]
        return float(gain.sum()), float(np.std(gain, ddof=1) * np.sqrt(len(gain)))

    def objection(self, rms_um: Sequence[np.ndarray], range_um: np.ndarray) -> str | None:
        """Why what was found cannot be the answer, going by held-out particles; None if nothing speaks against it.

        Not that it helps little, as weak effects do, but that it harms, by the log predictive density or by the sign
        test of root mean square residuals `rms_um` at every step; or that tests are missed by much of their range.
        """
        from scipy.stats import binomtest

        gain, error = self._gain(-1)
        if gain < -DECISIONS.contradicted * error:
            return f"all together are predicted worse with it (log predictive density {gain:.3g} +- {error:.2g})"
        before, after = rms_um[0], rms_um[-1]
        worse = int(np.sum(after > before))
        if binomtest(worse, len(after), alternative="greater").pvalue < DECISIONS.level:
            middle = f"medians {np.median(before):.2g} um without it, {np.median(after):.2g} um with it"
            return f"{worse} of {len(after)} lie further from the law with it than without ({middle})"
        off = float(np.median(after / range_um))
        if off > LARGE_MISFIT:
            return f"the law with it still misses them by {100 * off:.2g} % of their range (median)"
        return None

    def to_json(self) -> dict[str, Any]:
        """The gap as in `discovery.json`; a share is never given without chi2 per point."""
        chi2, steps = (self.chi2.sum(1) / self.points.sum()).tolist(), []
        for k, label in enumerate(self.labels):
            (elpd, error), each = self._gain(k), self.chi2[k] / self.points
            half = 1.96 * float(np.std(each, ddof=1) / np.sqrt(len(each)))
            steps.append(
                {
                    "added": label,
                    "chi2_per_dof": finite(chi2[k]),
                    "chi2_interval_95": [finite(chi2[k] - half), finite(chi2[k] + half)],
                    "systematic_um": finite(float(np.sqrt(max(self.repeating_um2[k], 0.0)))),
                    "elpd": finite(elpd),
                    "elpd_se": finite(error),
                }
            )
        repeating = self.repeating_um2.tolist()
        return {
            "floor": 1.0,
            "heldout": "leave-one-particle-out",
            "steps": steps,
            "closed_fraction": _share(chi2[0] - 1.0, chi2[-1] - 1.0),
            "repeating_closed_fraction": _share(repeating[0], repeating[-1]),
        }


def _share(before: float, after: float) -> float | None:
    """The share of a gap that is closed, at most all of it; None where there is none to close."""
    return None if before <= 0 else finite(min(1.0 - max(after, 0.0) / before, 1.0))


NOT_ASKED: dict[str, Any] = {
    "floor": 1.0, "heldout": None, "steps": [], "closed_fraction": None, "repeating_closed_fraction": None,
}  # fmt: skip


def held_out(search: Search, winner: Names) -> HeldOut:
    """Leave out one particle after the other; choose and fit with the others; see how far it is then from the law.
    Every hypothesis stays linear where all particles have put it, at their hyperparameters."""
    null, everyone = search.null.design, np.arange(len(search.base.tests))
    logs = search.log_posteriors()
    contestants: dict[Names, LinearModel] = {}
    for names in dict.fromkeys([*list(logs)[:CONTENDERS], winner]):
        if names and search.found[names].at is not None:
            contestants[names] = LinearModel(*search.found[names].likely_form(misfit=False))
    # The base law under the winner's noise and spreads: gaps are measured by the noise of what closes them.
    found = contestants[winner]
    null = replace(null, correlation=found.design.correlation, along=found.design.along)
    every = {(): LinearModel(found.hyper[:HYPERPARAMETERS], null), **contestants}
    whole = {names: model.log_evidence() for names, model in every.items()}
    # Prior odds, hyperparameters and misfit weigh as they do for all particles.
    weight = {names: logs.get(names, search.found[names].log_evidence) - whole[names] for names in contestants}
    labels: tuple[str | None, ...] = (None, *(("formula",) if winner == UNLISTED else winner))
    chi2, elpd = np.zeros((2, len(labels), len(everyone)))
    residual = np.zeros((len(labels), *null.data.shape))
    for i in range(len(everyone)):
        others = np.delete(everyone, i)
        without = {names: model.log_evidence(others) for names, model in every.items()}
        best = max(contestants, key=lambda names: without[names] + weight[names])
        first = winner[:1] if winner[:1] in contestants else best
        for k, names in enumerate([(), *([first] if len(winner) == 2 else []), best]):
            model = every[names]
            numbers, _ = model.numbers(others)
            form = np.append(numbers, -1.0)
            chi2[k, i] = form @ model.particles.schur[i] @ form
            elpd[k, i] = whole[names] - without[names]
            residual[k, i] = _residual(model, i, numbers)
    points = np.asarray(search.base.tests.mask).sum(1).astype(float)
    return HeldOut(labels, chi2, points, elpd, _repeating(search.base, residual), residual)


def _residual(model: LinearModel, row: int, numbers: np.ndarray) -> np.ndarray:
    """What common numbers and amplitudes leave of a particle [um], its own numbers fitted to it."""
    d, (own, common) = model.design, model.scales
    c = d.common.shape[-1]
    y = d.data[row] - d.common[row] @ (numbers[:c] * common) - d.amplitude[row] @ numbers[c:]
    X, mask = d.own[row] * own, np.asarray(d.tests.mask[row])
    sd = float(np.exp(model.hyper[0]))
    v = np.linalg.solve(X[mask].T @ X[mask] / sd**2 + np.eye(X.shape[1]), X[mask].T @ y[mask] / sd**2)
    return np.where(mask, y - X @ v, 0.0)


def _repeating(base: Base, residual: np.ndarray) -> np.ndarray:
    """Mean product of the residuals of two different particles at the same share of the path, at every step."""
    mask, path = np.asarray(base.tests.mask), np.asarray(base.tests.path)
    size = np.asarray(base.tests.effective_diameter)
    shares = (np.arange(SHARES) + 0.5) / SHARES
    common = np.zeros((len(residual), len(size), SHARES))
    for i in range(len(size)):
        at = path[i, mask[i]]
        at = (at - at[0]) / max(at[-1] - at[0], 1e-300)
        common[:, i] = [np.interp(shares, at, one[i, mask[i]]) / size[i] for one in residual]
    count = max(len(size), 2)
    product = (common.sum(1) ** 2 - (common**2).sum(1)) / (count * (count - 1))
    return product.mean(1) * float(np.median(size)) ** 2
