"""The gap on particles that took no part in finding and fitting what should close it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..calibrate.estimates import finite
from ..calibrate.judgement import LARGE_MISFIT
from .evidence import LinearModel
from .hypothesis import UNLISTED, Names
from .search import Search
from .settings import CONTENDERS, DECISIONS, HYPERPARAMETERS

SHARES = 60  # points of the common path on which the residuals of two tests are multiplied


@dataclass(frozen=True)
class HeldOut:
    """Held-out results of every step, the base law first.

    Attributes:
        labels: what was added at each step; None for the base law.
        chi2: of every particle, shape (steps, N), under the noise of the law with everything added.
        points: of every particle.
        elpd: log predictive density of every particle, shape (steps, N).
        repeating_um2: mean product of the residuals of two different particles at one share of the path [um^2].
        residual_um: measured less predicted displacement of every particle [um], shape (steps, N, points).
    """

    labels: tuple[str | None, ...]
    chi2: np.ndarray
    points: np.ndarray
    elpd: np.ndarray
    repeating_um2: np.ndarray
    residual_um: np.ndarray | None = None

    @property
    def chi2_per_dof(self) -> np.ndarray:
        """Mean chi2 per point of every step."""
        return self.chi2.sum(1) / self.points.sum()

    def objection(self, rms_um: Sequence[np.ndarray], range_um: np.ndarray) -> str | None:
        """Why what was found cannot be the answer, going by held-out particles; None if nothing speaks against it.

        That it does not help enough is no objection: weak effects hardly do. That it harms is one, by the log
        predictive density against its standard error (Vehtari, Gelman and Gabry 2017) or by the sign test of the
        particles' root mean square residuals; and so is a law that with it still misses tests by far.

        Args:
            rms_um: root mean square residual of every particle at every step [um], shape (N,) each.
            range_um: of every test's displacement [um], shape (N,).
        """
        from scipy.stats import binomtest

        away = self.elpd[-1] - self.elpd[0]
        error = float(np.std(away, ddof=1) * np.sqrt(len(away)))
        if away.sum() < -DECISIONS.contradicted * error:
            return f"all together are predicted worse with it (log predictive density {away.sum():.3g} +- {error:.2g})"
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
        chi2, steps = self.chi2_per_dof, []
        for k, label in enumerate(self.labels):
            away = self.elpd[k] - self.elpd[0]
            each = self.chi2[k] / self.points
            half = 1.96 * float(np.std(each, ddof=1) / np.sqrt(len(each))) if len(each) > 1 else float("nan")
            steps.append(
                {
                    "added": label,
                    "chi2_per_dof": finite(float(chi2[k])),
                    "chi2_interval_95": [finite(float(chi2[k]) - half), finite(float(chi2[k]) + half)],
                    "systematic_um": finite(float(np.sqrt(max(self.repeating_um2[k], 0.0)))),
                    "elpd": finite(float(away.sum())),
                    "elpd_se": finite(float(np.std(away, ddof=1) * np.sqrt(len(away)))) if len(away) > 1 else None,
                }
            )
        return {
            "floor": 1.0,
            "heldout": "leave-one-particle-out",
            "steps": steps,
            "closed_fraction": _share(float(chi2[0]) - 1.0, float(chi2[-1]) - 1.0),
            "repeating_closed_fraction": _share(float(self.repeating_um2[0]), float(self.repeating_um2[-1])),
        }


def _share(before: float, after: float) -> float | None:
    """The share of a gap that is closed, at most all of it; None where there is none to close."""
    return None if before <= 0 else finite(min(1.0 - max(after, 0.0) / before, 1.0))


NOT_ASKED: dict[str, Any] = {
    "floor": 1.0, "heldout": None, "steps": [], "closed_fraction": None, "repeating_closed_fraction": None,
}  # fmt: skip


def _residual(model: LinearModel, row: int, numbers: np.ndarray) -> np.ndarray:
    """What common numbers and amplitudes leave of a particle [um], its own numbers fitted to it."""
    d, (own, common) = model.design, model.scales
    c = d.common.shape[-1]
    y = d.data[row] - d.common[row] @ (numbers[:c] * common) - d.amplitude[row] @ numbers[c:]
    X, mask = d.own[row] * own, np.asarray(d.tests.mask[row])
    sd = float(np.exp(model.hyper[0]))
    v = np.linalg.solve(X[mask].T @ X[mask] / sd**2 + np.eye(X.shape[1]), X[mask].T @ y[mask] / sd**2)
    return np.where(mask, y - X @ v, 0.0)


def held_out(search: Search, winner: Names) -> HeldOut:
    """Leave out one particle after the other; choose and fit with the others; see how far it is then from the law.

    Every hypothesis stays linear where all particles have put it, at the hyperparameters they have; which one is
    chosen, and its numbers, are the others' alone.
    """
    null, everyone = search.null, np.arange(len(search.base.tests))
    logs = search.log_posteriors()
    contestants: dict[Names, LinearModel] = {}
    for names in dict.fromkeys([*list(logs)[:CONTENDERS], winner]):
        if names and search.found[names].at is not None:
            contestants[names] = LinearModel(*search.found[names].likely_form(misfit=False))
    # The base law under the winner's noise and spreads: gaps are measured by the noise of what closes them.
    found = contestants[winner]
    kinds = replace(null.design.kinds, correlation=found.design.kinds.correlation, along=found.design.kinds.along)
    base = LinearModel(found.hyper[:HYPERPARAMETERS], replace(null.design, kinds=kinds))
    every = {(): base, **contestants}
    whole = {names: model.log_evidence() for names, model in every.items()}
    # Prior odds, hyperparameters and misfit weigh as they do for all particles.
    weight = {names: logs.get(names, search.found[names].log_evidence) - whole[names] for names in contestants}
    N = len(everyone)
    points = np.asarray(search.base.tests.mask).sum(1)
    labels: tuple[str | None, ...] = (None, *(("formula",) if winner == UNLISTED else winner))
    chi2, elpd = np.zeros((len(labels), N)), np.zeros((len(labels), N))
    residual = np.zeros((len(labels), *base.design.data.shape))
    for i in range(N):
        others = np.delete(everyone, i) if N > 1 else everyone
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
    return HeldOut(labels, chi2, points.astype(float), elpd, _repeating(search, residual), residual)


def _repeating(search: Search, residual: np.ndarray) -> np.ndarray:
    """Mean product of the residuals of two different particles at the same share of the path, at every step."""
    tests = search.base.tests
    mask, path = np.asarray(tests.mask), np.asarray(tests.path)
    shares = (np.arange(SHARES) + 0.5) / SHARES
    size = np.asarray(tests.effective_diameter)
    found = []
    for one in residual:
        rows = []
        for i, r in enumerate(one):
            at = path[i, mask[i]]
            rows.append(np.interp(shares, (at - at[0]) / max(at[-1] - at[0], 1e-300), r[mask[i]]) / size[i])
        common = np.array(rows)
        count = max(len(common), 2)
        product = (common.sum(0) ** 2 - (common**2).sum(0)) / (count * (count - 1))
        found.append(float(product.mean()) * float(np.median(size)) ** 2)
    return np.array(found)
