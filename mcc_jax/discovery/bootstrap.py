"""Is anything missing at all? A parametric bootstrap of the first-order evidence of all hypotheses together."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from ..calibrate.priors import SCALES
from .columns import with_amplitudes
from .evidence import LinearModel, marginalise
from .screen import single_integrals
from .search import Search
from .settings import DECISIONS, POPULATION

CAMPAIGNS = 400  # drawn for the p value: its standard error at a level of 0.05 is 0.011
PLACES_OF_STEPS = 24  # of a sudden step in each test


class _Statistic:
    """The log evidence of anything against nothing, from scores at the base law's hyperparameters."""

    def __init__(self, search: Search) -> None:
        design, screen = search.null.design, search.screen
        basis, parts = search.discrepancy.basis, search.discrepancy.group
        self.parts = np.array(parts)
        own, of_own = search.formulas_of([name for name in search.not_shared if not search.library[name].sudden])
        self.own_names = [c.mechanism for c in own]
        self.own_ratio = [c.variant.plausible[1] / c.variant.plausible[0] for c in own]
        sudden = next((m.variants[0] for m in search.library.values() if m.sudden), None)
        steps = np.zeros((*basis.shape[:2], 0)) if sudden is None else self._steps(search, sudden.plausible[0])
        formulas = np.zeros((*basis.shape[:2], 0)) if screen is None else screen.columns
        self.counts = [POPULATION, formulas.shape[-1], basis.shape[-1], len(own), steps.shape[-1]]
        every = np.concatenate([design.common[..., :POPULATION], formulas, basis, of_own, steps], -1)
        nothing = with_amplitudes(replace(design, common=every[..., :0], group=design.group[:0]), every)
        particles = LinearModel(search.null.optimum.hyper, nothing).particles
        self.gram, self.score = particles.information, particles.score  # of every particle; the population's come first
        self.library = len(search.library)
        self.unit = float(DECISIONS.general * np.exp(search.null.optimum.hyper[0]))
        self.ratio_of_steps = 1.0 if sudden is None else sudden.plausible[1] / sudden.plausible[0]
        if screen is not None:
            self.signs, self.largest = screen.signs, screen.largest
            names = [(c.mechanism, c.variant.name) for c in screen.candidates]
            mechanisms = {m: len({f for n, f in names if n == m}) for m, _ in names}
            grid = {name: names.count(name) for name in set(names)}
            self.weight = -np.log([mechanisms[n[0]] * grid[n] for n in names])

    @staticmethod
    def _steps(search: Search, height: float) -> np.ndarray:
        """Steps at some points of every test's loading."""
        loading = np.asarray(search.base.tests.loading & search.base.tests.mask)
        mask = np.asarray(search.base.tests.mask)
        columns = np.zeros((*loading.shape, PLACES_OF_STEPS))
        for i, rows in enumerate(map(np.flatnonzero, loading)):
            if len(rows) > 1:
                for k, j in enumerate(rows[np.linspace(1, len(rows) - 1, PLACES_OF_STEPS).astype(int)]):
                    columns[i, j:, k] = np.where(mask[i, j:], height, 0.0)
        return columns

    def __call__(self, score: np.ndarray) -> np.ndarray:
        """Log evidence ratios of campaigns, from scores of shape (campaigns, N, columns)."""
        _, formulas, _, own, steps = np.split(np.arange(score.shape[-1]), np.cumsum(self.counts)[:-1])
        gram, shared, f = self.gram, np.arange(sum(self.counts[:3])), len(formulas)
        whole, total = gram[:, shared[:, None], shared].sum(0), score[..., shared].sum(1)
        inner = np.linalg.inv(np.eye(POPULATION) + whole[:POPULATION, :POPULATION])
        law = marginalise(whole, POPULATION)
        G, s = law.schur, total[:, POPULATION:] - total[:, :POPULATION] @ law.weights.T
        logs: list[Any] = []
        prior = -float(np.log(self.library))
        if f:
            scores, powers = s[:, :f].ravel(), np.tile(np.diagonal(G)[:f], len(s))
            each, _ = single_integrals(scores, powers, np.tile(self.signs, len(s)), np.tile(self.largest, len(s)))
            logs.append(prior + np.asarray(logsumexp(each.reshape(len(s), f) + self.weight, axis=1)))
        smooth = []
        for part in np.unique(self.parts):  # at first order one part of the discrepancy at a time
            at = f + np.flatnonzero(self.parts == part)
            inside, scores = G[np.ix_(at, at)], s[:, at]
            for size in self.unit * np.array([0.1, 0.3, 1.0, 3.0]):
                spread = np.eye(len(at)) + size**2 * inside
                value = 0.5 * size**2 * np.einsum("mk,km->m", scores, np.linalg.solve(spread, scores.T))
                smooth.append(value - 0.5 * np.linalg.slogdet(spread)[1])
        logs.append(-DECISIONS.unlisted + np.asarray(logsumexp(smooth, axis=0)) - np.log(len(smooth)))
        rest = score - np.einsum("ncp,mp->mnc", gram[:, :, :POPULATION], total[:, :POPULATION] @ inner)
        for name in dict.fromkeys(self.own_names):
            values = []
            for k in (k for k, other in enumerate(self.own_names) if other == name):
                power = gram[:, own[k], own[k]]
                for scale in np.geomspace(1.0, self.own_ratio[k], SCALES):
                    spread = 1 + scale**2 * power
                    values.append(np.sum(0.5 * (scale**2 * rest[..., own[k]] ** 2 / spread - np.log(spread)), 1))
            logs.append(prior + np.asarray(logsumexp(values, axis=0)) - np.log(len(values)))
        if len(steps):
            scores, powers = rest[..., steps].ravel(), np.tile(gram[:, steps, steps].ravel(), len(score))
            ones = np.ones(len(scores))
            each, _ = single_integrals(scores, powers, ones, ones * self.ratio_of_steps)
            ratio = logsumexp(each.reshape(*rest.shape[:2], len(steps)), axis=2) - np.log(len(steps))
            any_ = np.logaddexp(np.log1p(-DECISIONS.jump), np.log(DECISIONS.jump) + ratio)
            logs.append(prior + any_.sum(1))
        return np.asarray(logsumexp(logs, axis=0))


def p_anything(search: Search, seed: int) -> float:
    """Probability that the base law alone would give as much evidence of anything missing.

    Scores of campaigns of the base law are drawn at its fitted hyperparameters: they are normal, with the information
    as their covariance.
    """
    statistic = _Statistic(search)
    values, vectors = np.linalg.eigh(statistic.gram)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    normal = np.random.default_rng([seed, 41]).standard_normal((CAMPAIGNS, *statistic.score.shape))
    drawn = statistic(np.einsum("ncd,mnd->mnc", root, normal, optimize=True))
    return (1 + int(np.sum(drawn >= statistic(statistic.score[None])[0]))) / (1 + CAMPAIGNS)
