"""The gap on particles that took no part in finding and fitting what should close it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from .linear_model import System
from .score import project

Choose = Callable[[np.ndarray], list[np.ndarray]]
"""From the particles of a fold, the columns inside the law at each step, the base law first."""


@dataclass(frozen=True)
class HeldOut:
    """Held-out results of every step.

    Attributes:
        chi2: of every particle at every step, shape (steps, N).
        points: of every particle.
        energy: systematic chi2 that is left, noise taken off, at every step.
        elpd: log predictive density of every particle at every step, up to a constant of its own.
    """

    chi2: np.ndarray
    points: np.ndarray
    energy: np.ndarray
    elpd: np.ndarray

    @property
    def chi2_per_dof(self) -> np.ndarray:
        """Mean chi2 per point of every step."""
        return self.chi2.sum(1) / self.points.sum()


def held_out(system: System, choose: Choose, extended: Mapping[frozenset[int], System] | None = None) -> HeldOut:
    """Leave out one particle after the other; search and fit with the others; see how far it is then from the law.

    Args:
        system: the linear system around the base law.
        choose: the search.
        extended: for some sets of columns, the system around the law with these effects: a fold that chooses one fits
            and is judged there. The other particles alone fit its amplitudes; the system is only where lines are drawn.
    """
    around = extended or {}
    usable = np.flatnonzero(system.usable)
    chosen = choose(usable)
    basis, _ = system.looked_at()
    if not np.isin(np.concatenate(chosen), system.waves).any():
        basis = np.setdiff1d(basis, system.waves)  # as many directions as all others, in which there is only noise
    whole = project(system, basis)
    basis, directions = basis[whole.alive], whole.only(whole.alive).directions()
    nuisance = system.globals
    # The basis with the population projected off, as in the whole campaign.
    shift = _shift(system, basis)
    steps = len(chosen)
    chi2, elpd = np.zeros((steps, len(usable))), np.zeros((steps, len(usable)))
    pattern = np.zeros((steps, len(usable), directions.shape[1]))
    for row, i in enumerate(usable):
        others = usable[usable != i] if len(usable) > 1 else usable
        for step, inside in enumerate(choose(others)):
            there = around.get(frozenset(map(int, inside)), system)
            fitted = project(there, basis[:0], inside=inside, particles=others)
            at = np.concatenate([nuisance, inside]).astype(int)
            gram = there.gram[i]
            left = gram[:, 0] + gram[:, at] @ fitted.theta
            chi2[step, row] = left[0] + fitted.theta @ left[at]
            inner = gram[np.ix_(at, at)]
            # The fitted parameters are uncertain themselves: their covariance widens the prediction.
            widened = np.eye(len(at)) + fitted.covariance @ inner
            explained = left[at] @ np.linalg.solve(widened, fitted.covariance @ left[at])
            elpd[step, row] = -0.5 * (chi2[step, row] - explained + np.linalg.slogdet(widened)[1])
            scores = -(left[basis] + left[nuisance] @ shift)
            pattern[step, row] = scores @ directions
    total = (pattern.sum(1) ** 2).sum(1) - (pattern**2).sum((1, 2))
    return HeldOut(chi2, system.points[usable].astype(float), total, elpd)


def _shift(system: System, basis: np.ndarray) -> np.ndarray:
    total = system.total()
    inner = total[np.ix_(system.globals, system.globals)] + np.diag(system.prior)
    return -np.linalg.solve(inner, total[np.ix_(system.globals, basis)])
