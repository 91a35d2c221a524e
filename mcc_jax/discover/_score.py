r"""Score tests on Gram matrices: which effects the residuals ask for, and how surely.

For the candidate's column d, made orthogonal to the population's parameters and the effects already in the law,
particle i contributes the score :math:`s_i = d_i^T M_i r_i` and the information :math:`h_i = d_i^T M_i d_i`; then

.. math:: \hat\theta = \sum s_i / \sum h_i, \quad \text{SE} = (\sum h_i)^{-1/2}, \quad
    t = \sum s_i / (\sum s_i^2)^{1/2}.

The last is the statistic for significance: it needs no model of the noise within a test. Under the null each
particle's scores may change their sign together, which gives the distribution of the largest t of all candidates and
so a family-wise probability (wild bootstrap: Liu 1988; largest statistic: Westfall and Young 1993).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ._system import System

FLIPS = 4000

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
    """

    columns: np.ndarray
    particles: np.ndarray
    scores: np.ndarray
    information: np.ndarray
    residual: np.ndarray
    theta: np.ndarray
    covariance: np.ndarray
    survival: np.ndarray

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
    def clustered(self) -> np.ndarray:
        """The statistic t, whose scale comes from the scatter between particles."""
        return self.scores.sum(0) / np.sqrt(np.maximum((self.scores**2).sum(0), 1e-300))

    def similarity(self) -> np.ndarray:
        """Correlation of the projected columns, shape (K, K)."""
        both = self.information.sum(0)
        scale = np.sqrt(np.maximum(np.diagonal(both), 1e-300))
        return both / scale / scale[:, None]


LEAST_SURVIVAL = 1e-6
"""A column of whose information less survives is one that the base law can make itself."""


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
    gram = system.gram[chosen]
    total = gram.sum(0)
    prior = np.concatenate([system.prior, np.full(len(extra), 1e-12) if precision is None else precision])
    inner = total[np.ix_(nuisance, nuisance)] + np.diag(prior)
    covariance = np.linalg.pinv(inner, rcond=1e-13, hermitian=True)
    theta = -covariance @ total[nuisance, 0]
    shift = -covariance @ total[np.ix_(nuisance, columns)]
    some, at = gram[:, nuisance], gram[:, columns]
    # residual + sum theta * column; a projected column + sum shift * column
    left = at[:, :, 0] + np.einsum("nkp,p->nk", at[:, :, nuisance], theta)
    under = some[:, :, 0] + np.einsum("npq,q->np", some[:, :, nuisance], theta)
    scores = -(left + np.einsum("np,pk->nk", under, shift))
    cross = np.einsum("nkp,pl->nkl", at[:, :, nuisance], shift)
    square = np.einsum("pk,npq,ql->nkl", shift, some[:, :, nuisance], shift)
    information = at[:, :, columns] + cross + np.swapaxes(cross, 1, 2) + square
    residual = gram[:, 0, 0] + 2 * some[:, :, 0] @ theta + np.einsum("p,npq,q->n", theta, some[:, :, nuisance], theta)
    raw = np.maximum(np.diagonal(total)[columns], 1e-300)
    survival = np.einsum("nkk->k", information) / raw
    return Projection(columns, chosen, scores, information, residual, theta, covariance, survival)


def flips(count: int, seed: int) -> np.ndarray:
    """Signs for the bootstrap, shape (B, N): all of them if there are few particles."""
    if count <= 11:
        bits = np.arange(2**count)[:, None] >> np.arange(count)
        return 1.0 - 2.0 * (bits & 1)
    return np.random.default_rng([seed, 41]).choice([-1.0, 1.0], size=(FLIPS, count))


def family_wise(scores: np.ndarray, sign: np.ndarray, signs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Family-wise probability of every column's statistic, and the statistics, one-sided where a sign is physical.

    Args:
        scores: shape (N, K).
        sign: +1, -1 or 0 for both, shape (K,).
        signs: of `flips`.
    """
    scale = np.sqrt(np.maximum((scores**2).sum(0), 1e-300))
    observed = _sided(scores.sum(0) / scale, sign)
    largest = _sided((signs @ scores) / scale, sign).max(1)
    exceed = (largest[None] >= observed[:, None] - 1e-12).sum(1)
    return (exceed + 1) / (len(signs) + 1), observed


def _sided(t: np.ndarray, sign: np.ndarray) -> np.ndarray:
    return np.where(sign == 0, np.abs(t), t * sign)
