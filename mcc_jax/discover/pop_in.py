r"""Sudden steps: one at any point of a test's first loading.

Once correlated noise is whitened, a step shows in a point or two. Places on a grid, however fine, fall between them; so
every point of first loading is a place of its own. With :math:`d_j` the step at point j, the particle's own parameters
integrated out (M, as in `linear_model`), kept are :math:`d_j^T M x` for every column x of the system, and
:math:`d_j^T M d_l`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, logsumexp

from .candidates import Candidate

SCALES = (0.01, 0.03, 0.1, 0.3, 1.0)
"""Scales of an amplitude's prior in units of the largest believable amplitude."""

SHARES = (0.03, 0.1, 0.3, 1.0)
"""Shares of the tests in which something breaks that are tried."""

ODD = 0.02
"""Share of tests of which something else is odd, whatever effect there is."""

ODD_STEP = 0.002
"""The same where the effect is a step: little else makes one."""

DRAWN_AT_ONCE = 2_000_000
"""Most numbers drawn at once."""


def is_step(candidate: Candidate) -> bool:
    """Whether a formula is a sudden step and nothing else."""
    return (candidate.variant.mechanism, candidate.variant.name) == ("pop_in", "sharp")


@dataclass(frozen=True)
class Jump:
    """A sudden step in a test.

    Attributes:
        particle: in which one, in the order of the tests that took part.
        stress_MPa: at what stress.
        size, sd: how large, in the formula's unit of the search.
        probability: that there is one in this test.
    """

    particle: int
    stress_MPa: float
    size: float
    sd: float
    probability: float


@dataclass(frozen=True)
class Steps:
    """Steps of one unit at every point of first loading.

    Attributes:
        cross: d^T M x of every step with the system's columns, shape (N, points, Q).
        among: d^T M d of the steps of a particle, shape (N, points, points).
        stress: at the points of first loading [MPa], NaN at the others, shape (N, points).
    """

    cross: np.ndarray
    among: np.ndarray
    stress: np.ndarray

    @property
    def information(self) -> np.ndarray:
        """Of every step's size, shape (N, points)."""
        return np.einsum("nll->nl", self.among)

    def scores(self, particles: np.ndarray, nuisance: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Scores of some particles' steps, columns with their coefficients taken off the residual first."""
        # Few of the columns: all of them are tens of megabytes, and folds ask again and again.
        residual, others = self.cross[:, :, 0][particles], self.cross[:, :, nuisance][particles]
        return -(residual + others @ theta)

    def evidence(self, scores: np.ndarray, particles: np.ndarray) -> np.ndarray:
        """Log evidence of steps in some tests against none, shape (...)."""
        return over_tests(self._of_tests(scores, particles), SHARES, ODD_STEP)

    def _of_places(self, scores: np.ndarray, particles: np.ndarray) -> np.ndarray:
        """Log evidence of a step at every point, minus infinity off first loading, shape (..., N, points, scales)."""
        each = evidence_by_scale(scores, self.information[particles], np.array(1))
        return np.where(np.isfinite(self.stress[particles])[..., None], each, -np.inf)

    def _of_tests(self, scores: np.ndarray, particles: np.ndarray) -> np.ndarray:
        """The same of a step somewhere, shape (..., N, scales)."""
        there = np.isfinite(self.stress[particles])
        count = np.maximum(there.sum(-1), 1)[:, None]
        found = logsumexp(self._of_places(scores, particles), axis=-2) - np.log(count)
        return np.where(there.any(-1)[:, None], found, 0.0)

    def jumps(self, scores: np.ndarray, shrunk: np.ndarray, particles: np.ndarray) -> tuple[Jump, ...]:
        """The tests in which a step is more probable than not, and the most probable one of each.

        Args:
            scores: of the steps of some particles.
            shrunk: the same as far as they count, where noise has tails.
            particles: which ones.
        """
        one = self._of_tests(shrunk, particles)
        shares = np.asarray(SHARES)[:, None, None]
        with np.errstate(divide="ignore"):
            some = np.logaddexp(np.log1p(-shares), np.log(shares) + one)
        weight = some.sum(1, keepdims=True)  # of every share and scale
        weight = np.exp(weight - logsumexp(weight))
        probability = (weight * np.exp(np.log(shares) + one - some)).sum((0, 2))
        place = np.argmax(np.asarray(logsumexp(self._of_places(shrunk, particles), axis=-1)), axis=-1)
        information = self.information[particles]
        return tuple(
            Jump(int(i), float(self.stress[i, j]), float(scores[row, j] / h), float(h**-0.5), float(p))
            for row, (i, j, p) in enumerate(zip(particles, place, probability, strict=True))
            if p > 0.5 and (h := information[row, j]) > 0
        )

    def drawn_evidence(self, particles: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
        """The same where there is nothing but noise, shape (draws,)."""
        factor = root_of(self.among[particles])
        step = max(1, DRAWN_AT_ONCE // factor[..., 0].size)
        found = []
        for first in range(0, draws, step):
            normal = rng.standard_normal((min(step, draws - first), *factor.shape[::2]))
            found.append(self.evidence(np.einsum("nlk,bnk->bnl", factor, normal, optimize=True), particles))
        return np.concatenate(found)


def evidence_by_scale(U: np.ndarray, information: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Log evidence of amplitudes against zero for every scale of their prior, cut at the sign, shape (..., scales)."""
    U = (U * np.where(sign == 0, 1, sign))[..., None]
    scale = np.asarray(SCALES)
    spread = 1 + information[..., None] * scale**2
    z = U * scale / np.sqrt(spread)
    cut = np.where((sign == 0)[..., None], 0.0, np.log(2) + log_ndtr(z))
    return -0.5 * np.log(spread) + 0.5 * z**2 + cut


def root_of(information: np.ndarray) -> np.ndarray:
    """Factors R with R R^T the information of every particle: R times normal numbers are scores of noise alone."""
    values, vectors = np.linalg.eigh(information)
    return vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]


def over_tests(log_ratio: np.ndarray, shares: tuple[float, ...], odd: float) -> np.ndarray:
    """Log evidence over all tests, shape (...), each of which has the effect with a probability, and may be odd: the
    mean over these probabilities and over scales.

    Args:
        log_ratio: log evidence of every test that it has the effect, shape (..., N, scales).
        shares: the probabilities.
        odd: share of tests of which something else is odd: one test alone proves nothing of all.
    """
    found = []
    for share in shares:
        some = log_ratio if share == 1 else np.logaddexp(np.log1p(-share), np.log(share) + log_ratio)
        found.append(-np.logaddexp(np.log(odd), np.log1p(-odd) - some).sum(-2))
    return np.asarray(logsumexp(np.stack(found), axis=(0, -1)) - np.log(len(shares) * log_ratio.shape[-1]))


def tamed(z: np.ndarray, tails: float) -> np.ndarray:
    """Normal deviates as improbable as deviates of noise with such tails and the same variance, where smaller.

    Nearer to zero they would be larger, since noise with tails is the more peaked: that is no reason to count them for
    more.
    """
    from scipy.stats import norm
    from scipy.stats import t as student

    if not np.isfinite(tails):
        return z
    far = np.abs(z) * np.sqrt(tails / (tails - 2))
    as_improbable = norm.isf(np.maximum(student.sf(far, tails), 1e-300))
    return np.asarray(np.sign(z) * np.minimum(np.abs(z), as_improbable))
