r"""Score tests on Gram matrices: which effects the residuals ask for, and how surely.

For the candidate's column d, made orthogonal to the population's parameters and the effects already in the law,
particle i contributes the score :math:`s_i = d_i^T M_i r_i` and the information :math:`h_i = d_i^T M_i d_i`; then

.. math:: \hat\theta = \sum s_i / \sum h_i, \quad \text{SE} = (\sum h_i)^{-1/2}.

Significance (`family_wise`) comes from the scatter of the particles' scores as far as the noise model may not be
trusted, and counts all candidates: the probability is that of the largest statistic of them all (Westfall and Young
1993).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np
from scipy.special import digamma, polygamma

from .linear_model import System

DETECTABLE = 4.6
"""Estimate over standard error that is found with 95 % probability at the family-wise level."""


@dataclass(frozen=True)
class Projection:
    """Residual and columns with the population and the effects in the law projected off.

    Attributes:
        columns: which columns of the system these are.
        particles: which particles took part.
        scores: shape (N, K).
        information: of every particle, shape (N, K, K) of the columns among themselves.
        residual: chi2 of every particle after projection, shape (N,).
        theta: coefficients of what was projected off, population first.
        covariance: theirs.
        survival: share of every column's information that survives the projection.
        nuisance: which columns were projected off.
    """

    columns: np.ndarray
    particles: np.ndarray
    scores: np.ndarray
    information: np.ndarray
    residual: np.ndarray
    theta: np.ndarray
    covariance: np.ndarray
    survival: np.ndarray
    nuisance: np.ndarray

    def only(self, keep: np.ndarray) -> Projection:
        """Some of the columns."""
        information = self.information[:, keep][:, :, keep]
        return replace(
            self,
            columns=self.columns[keep],
            scores=self.scores[:, keep],
            information=information,
            survival=self.survival[keep],
        )

    @property
    def total(self) -> np.ndarray:
        """Information of every column, all particles together."""
        return np.einsum("nkk->k", self.information)

    @property
    def estimate(self) -> np.ndarray:
        """Amplitude of every column alone."""
        return self.scores.sum(0) / np.maximum(self.total, 1e-300)

    @property
    def gaussian(self) -> np.ndarray:
        """Estimate over its standard error, by the noise model."""
        return self.scores.sum(0) / np.sqrt(np.maximum(self.total, 1e-300))

    @property
    def alive(self) -> np.ndarray:
        """Which columns the base law cannot make itself."""
        return self.survival > MIN_SURVIVAL

    def similarity(self) -> np.ndarray:
        """Correlation of the projected columns, shape (K, K)."""
        both = self.information.sum(0)
        scale = np.sqrt(np.maximum(np.diagonal(both), 1e-300))
        return both / scale / scale[:, None]

    @cached_property
    def spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues of the similarity, the smallest first, and its eigenvectors."""
        values, vectors = np.linalg.eigh(self.similarity())
        return values, vectors

    def directions(self) -> np.ndarray:
        """Sums of columns, each of unit information and none like another, that hold `SHARE` of all information, every
        column taken as unit: shape (K, R)."""
        values, vectors = (v[..., ::-1] for v in self.spectrum)
        count = 1 + int(np.sum(np.cumsum(values) < SHARE * values.sum()))
        scale = np.sqrt(np.maximum(self.total, 1e-300))
        return vectors[:, :count] / np.sqrt(values[:count]) / scale[:, None]


MIN_SURVIVAL = 1e-6
"""A column of whose information less survives is one that the base law can make itself."""

SHARE = 0.9
"""Share of the information of all columns, each taken as unit, in the directions by which they are judged together."""


def project(
    system: System,
    columns: np.ndarray,
    *,
    inside: np.ndarray | None = None,
    particles: np.ndarray | None = None,
    precision: np.ndarray | None = None,
) -> Projection:
    """Project population and effects in the law off the residual and off some columns.

    Args:
        system: the system.
        columns: the columns looked at.
        inside: columns of effects that are in the law already.
        particles: which particles take part; all usable ones if None.
        precision: of the amplitudes inside the law around zero; none if None.
    """
    chosen = np.flatnonzero(system.usable) if particles is None else np.asarray(particles)
    extra = np.array([], int) if inside is None else np.asarray(inside, int)
    nuisance = np.concatenate([system.globals, extra])
    # Only what is needed: the whole of it is a hundred megabytes, and folds ask for it again and again.
    gram = system.gram
    among = gram[np.ix_(chosen, nuisance, nuisance)]
    own, alone = gram[np.ix_(chosen, nuisance, RESIDUAL)][:, :, 0], gram[chosen, 0, 0]
    at, own_at = gram[np.ix_(chosen, columns, nuisance)], gram[np.ix_(chosen, columns, RESIDUAL)][:, :, 0]
    theta, covariance, shift = _absorbed(system, among.sum(0), own.sum(0), at.sum(0).T, precision)
    # residual + sum theta * column; a projected column + sum shift * column
    left = own_at + at @ theta
    under = own + among @ theta
    scores = -(left + under @ shift)
    cross = at @ shift
    information = gram[np.ix_(chosen, columns, columns)]
    raw = np.maximum(np.einsum("nkk->k", information), 1e-300)
    information += cross + np.swapaxes(cross, 1, 2) + shift.T @ (among @ shift)
    residual = alone + 2 * own @ theta + (among @ theta) @ theta
    survival = np.einsum("nkk->k", information) / raw
    return Projection(columns, chosen, scores, information, residual, theta, covariance, survival, nuisance)


RESIDUAL = np.array([0])
"""Column of the residual."""


def _absorbed(
    system: System, inner: np.ndarray, own: np.ndarray, columns: np.ndarray, precision: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients of what is projected off the residual, their covariance, and those of some columns."""
    extra = len(inner) - len(system.prior)
    prior = np.concatenate([system.prior, np.full(extra, 1e-12) if precision is None else precision])
    covariance = np.linalg.pinv(inner + np.diag(prior), rcond=1e-13, hermitian=True)
    return -covariance @ own, covariance, -covariance @ columns


@dataclass(frozen=True)
class Summed:
    """What all particles together say about some columns: the sums of a `Projection`, without their parts.

    Attributes:
        drop: of chi2 by each column alone; zero where the rest can make it.
        residual: chi2 of all particles.
        of_both: drop by both columns of a pair, zero where either can be made by the rest or by the other.
    """

    drop: np.ndarray
    residual: float
    of_both: np.ndarray


NO_PAIRS = np.zeros((0, 2), int)

MIN_APART = 1e-3
"""Least 1 - rho^2 of two columns that are judged together."""


def project_summed(
    total: np.ndarray,
    system: System,
    columns: np.ndarray,
    inside: np.ndarray,
    least: float,
    pairs: np.ndarray = NO_PAIRS,
) -> Summed:
    """The same as `project`, from the sum of the particles' Gram matrices (`System.total`).

    Args:
        total: the sum, shape (Q, Q).
        system: the system.
        columns: the columns looked at.
        inside: columns of effects that are in the law already.
        least: share of a column's information that must survive.
        pairs: which of the columns are judged two by two, too, as positions, shape (P, 2).
    """
    nuisance = np.concatenate([system.globals, inside]).astype(int)
    inner, at = total[np.ix_(nuisance, nuisance)], total[np.ix_(nuisance, columns)]
    theta, _, shift = _absorbed(system, inner, total[nuisance, 0], at, None)
    scores = -(total[columns, 0] + at.T @ theta + (total[nuisance, 0] + inner @ theta) @ shift)
    raw = np.maximum(np.diagonal(total)[columns], 1e-300)
    information = raw + ((2 * at + inner @ shift) * shift).sum(0)
    survives = information > least * raw
    drop = np.where(survives, scores**2 / np.maximum(information, 1e-300), 0.0)
    residual = total[0, 0] + 2 * total[nuisance, 0] @ theta + theta @ inner @ theta
    i, j = pairs.T
    among = total[columns[i], columns[j]] + (at[:, i] * shift[:, j] + shift[:, i] * (at + inner @ shift)[:, j]).sum(0)
    scale, there = np.sqrt(np.where(survives, information, 1.0)), survives[i] & survives[j]
    of_both = _of_both(scores / scale, pairs, np.where(there, among / scale[i] / scale[j], 1.0)) ** 2
    return Summed(drop, float(residual), of_both)


def _of_both(t: np.ndarray, pairs: np.ndarray, rho: np.ndarray) -> np.ndarray:
    r"""The statistic of two columns together, zero where they are hardly two.

    .. math:: t_{ij} = \sqrt{\frac{t_i^2 - 2 \rho_{ij} t_i t_j + t_j^2}{1 - \rho_{ij}^2}}
    """
    apart = 1 - rho**2
    one, other = t[..., pairs[:, 0]], t[..., pairs[:, 1]]
    squared = (one**2 - 2 * rho * one * other + other**2) / np.maximum(apart, MIN_APART)
    return np.where(apart > MIN_APART, np.sqrt(np.maximum(squared, 0.0)), 0.0)


DRAWS = 4000
"""Draws of the largest statistic."""


def family_wise(
    projection: Projection, sign: np.ndarray, seed: int, *, few: bool = False, draws: int = DRAWS
) -> tuple[np.ndarray, np.ndarray]:
    r"""Family-wise probability of every column's statistic, and the statistics, one-sided where a sign is physical.

    .. math:: t_k = \frac{\sum_i s_{ik}}{\sqrt{h_k \tilde v_k}}, \qquad
        \tilde v_k = \frac{d_0 v_0 + d_k v_k}{d_0 + d_k}, \qquad
        v_k = \frac{\sum_i (s_{ik} - h_{ik} \hat\theta_k)^2}{h_k - \sum_i h_{ik}^2 / h_k}

    v is the scatter of the particles' scores over what the noise model says of it, with
    :math:`d_k = h_k^2 / \sum_i h_{ik}^2 - 1` degrees of freedom. Twenty particles hardly tell it for one column; all
    columns together tell its size :math:`v_0` and, by how much it differs among them, how far it may be trusted, in
    degrees of freedom :math:`d_0` (Smyth 2004, equations 2 to 7). Where the noise model holds, t is an estimate over
    its standard error; the worse it holds, the more t is that of the scatter alone.

    The largest t of all columns is judged by drawing from what it would be if nothing were missing: normal scores with
    the columns' correlations, over scatters with their degrees of freedom.

    Args:
        projection: scores and information.
        sign: +1, -1 or 0 for both, shape (K,).
        seed: of the draws.
        few: take the noise model's word, because there are too few particles to scatter.
        draws: how many; no probability below one over them can be told.
    """
    t, drawn = _estimates(projection, seed, few, draws)
    observed, largest = _sided(t, sign), np.sort(_sided(drawn, sign).max(1))
    return _exceeding(observed, largest), observed


Statistic = Callable[[np.ndarray], np.ndarray]
"""Of estimates over standard errors, shape (..., K): one number, shape (...), the larger the less by chance."""


def smallest_of_families(
    projection: Projection,
    sign: np.ndarray,
    seed: int,
    families: Sequence[np.ndarray | Statistic],
    *,
    shares: Sequence[float] | None = None,
    pairs: np.ndarray = NO_PAIRS,
    few: bool = False,
    draws: int = DRAWS,
) -> float:
    """Probability that the most improbable statistic of several families of columns is so improbable.

    A family counts for its share, however many columns it has: in a small one a column needs less to be significant.
    What is compared is every family's own p over its share; the families' correlations are those of the columns.

    Args:
        projection, sign, seed, few, draws: as in `family_wise`.
        families: which columns each has, shape (K,), not all of them empty: their largest statistic counts; or another
            statistic of all columns.
        shares: how much each family counts; all the same if None.
        pairs: columns that are judged two by two, as positions, shape (P, 2): for each the statistic is that of both.
    """
    t, null = _estimates(projection, seed, few, draws)
    rho = projection.similarity()[pairs[:, 0], pairs[:, 1]]
    fine = 1 - rho**2 > MIN_APART
    one, drawn = (_by_pairs(x, _sided(x, sign), pairs[fine], rho[fine]) for x in (t, null))
    found, other = np.inf, np.full(draws, np.inf)
    for family, share in zip(families, shares or [1.0] * len(families), strict=True):
        if not callable(family):
            if not family.any():
                continue
            observed, chance = one[family].max(), drawn[:, family].max(1)
        else:
            observed, chance = family(t), family(null)
        in_order = np.sort(chance)
        found = min(found, float(_exceeding(np.atleast_1d(observed), in_order)[0]) / share)
        other = np.minimum(other, (draws - np.searchsorted(in_order, chance)) / draws / share)
    return float((np.sum(other <= found) + 1) / (draws + 1))


def _by_pairs(t: np.ndarray, one: np.ndarray, pairs: np.ndarray, rho: np.ndarray) -> np.ndarray:
    """Statistics of columns, those of a pair replaced by that of both."""
    both = _of_both(t, pairs, rho)
    one[..., pairs[:, 0]], one[..., pairs[:, 1]] = both, both
    return one


def _exceeding(observed: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Share of draws, in order, that reach what was observed."""
    draws = len(largest)
    return (draws - np.searchsorted(largest, observed - 1e-12) + 1) / (draws + 1)


def _estimates(projection: Projection, seed: int, few: bool, draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Every column's estimate over its standard error, and draws of it if nothing is missing, shape (draws, K)."""
    scores, each = projection.scores, np.einsum("nkk->nk", projection.information)
    total = np.maximum(projection.total, 1e-300)
    prior, freedom = (1.0, MAX_FREEDOM) if few else common_scatter(projection)
    scatter, own = _scatter(scores, each)
    if few:
        own = np.zeros_like(own)
    width = np.sqrt((freedom * prior + own * scatter) / (freedom + own))
    rng = np.random.default_rng([seed, 41])
    values, vectors = projection.spectrum
    kept = values > 1e-8 * values[-1]
    factor = vectors[:, kept] * np.sqrt(values[kept])
    drawn = rng.standard_normal((draws, int(kept.sum()))) @ factor.T
    # Wilson and Hilferty's cube for chi2 over its degrees of freedom.
    ninth = 2 / (9 * (freedom + own))
    chi = np.maximum(1 - ninth + rng.standard_normal((draws, 1)) * np.sqrt(ninth), 0.1) ** 1.5
    return scores.sum(0) / np.sqrt(total) / width, drawn / chi


MAX_FREEDOM = 100.0
"""Degrees of freedom beyond which the noise model's word is not taken."""


def common_scatter(projection: Projection) -> tuple[float, float]:
    """Scatter of the particles' scores over what the noise model says, and its degrees of freedom: v_0 and d_0."""
    from scipy.optimize import brentq

    turn = projection.directions()
    each = np.einsum("kr,nkl,lr->nr", turn, projection.information, turn, optimize=True)
    scatter, own = _scatter(projection.scores @ turn, each)
    fine = (own > 0.5) & (scatter > 0)
    if fine.sum() < 3:
        return 1.0, MAX_FREEDOM
    own = own[fine]
    logs = np.log(scatter[fine]) - digamma(own / 2) + np.log(own / 2)
    excess = float(np.var(logs, ddof=1) - np.mean(polygamma(1, own / 2)))
    freedom = MAX_FREEDOM
    if excess > polygamma(1, MAX_FREEDOM / 2):
        freedom = 2 * cast(float, brentq(lambda x: polygamma(1, x) - excess, 1e-3, MAX_FREEDOM / 2))
    return float(np.exp(np.mean(logs) + digamma(freedom / 2) - np.log(freedom / 2))), freedom


def _scatter(scores: np.ndarray, each: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """v and d of every column."""
    total = np.maximum(each.sum(0), 1e-300)
    shares = (each**2).sum(0) / total
    left = np.maximum(total - shares, 1e-9 * total)
    scatter = ((scores - each * (scores.sum(0) / total)) ** 2).sum(0) / left
    return scatter, np.maximum(total / np.maximum(shares, 1e-300) - 1, 0.0)


def _sided(t: np.ndarray, sign: np.ndarray) -> np.ndarray:
    return np.where(sign == 0, np.abs(t), t * sign)
