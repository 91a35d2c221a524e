"""First-order search: every formula at every value of its grid, singly and in pairs, around the base law."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.special import log_ndtr, logsumexp

from ..calibrate.compiling import compiled_quickly
from ..calibrate.data import Tests
from ..calibrate.forward import Forms, Point
from ..calibrate.priors import SCALES
from ..effects import AbstractEffect, Mechanism
from ..law import signatures
from .base import Base, State
from .candidates import Candidate, candidates_of
from .columns import with_amplitudes
from .design import design_of
from .evidence import LinearModel, log_prior
from .settings import LENGTH_FACTORS, NOISE_FACTORS

SPREAD_FACTORS = 1.0, 0.5  # on the spreads of the base fit, at which all formulas are screened


@compiled_quickly
def candidate_columns(point: Point, tests: Tests, effects: tuple[AbstractEffect, ...], forms: Forms) -> Array:
    """Signatures of all candidates at the base law, shape (N, points, candidates)."""

    def one(latent: Array, tests: Tests) -> Array:
        columns = signatures(forms.law(latent, jnp.zeros(0)), tests.particle, tests.record, effects)
        return jnp.where(tests.mask[None], columns, 0.0).T

    return jax.vmap(one)(point.latent, tests)


class Setting(NamedTuple):
    """Candidates at some hyperparameters, all else integrated out, in units of their smallest plausible amplitudes."""

    log_null: float  # log marginal likelihood without any, times the hyperparameters' prior
    gram: np.ndarray  # information among candidates
    score: np.ndarray


@dataclass(frozen=True)
class Screen:
    """All candidates against the base law, at each of the hyperparameters that were tried."""

    candidates: tuple[Candidate, ...]
    settings: tuple[Setting, ...]
    columns: np.ndarray  # signatures of the candidates, per smallest plausible amplitude

    @property
    def null(self) -> float:
        """Log marginal likelihood without any, at its best setting."""
        return max(s.log_null for s in self.settings)

    @property
    def signs(self) -> np.ndarray:
        """Physical signs of the candidates."""
        return np.array([c.variant.sign for c in self.candidates])

    @property
    def largest(self) -> np.ndarray:
        """Largest plausible amplitudes of the candidates over the smallest."""
        return np.array([c.variant.plausible[1] / c.variant.plausible[0] for c in self.candidates])

    def singles(self) -> tuple[np.ndarray, np.ndarray]:
        """Log marginal likelihood of each candidate at its best setting, and its amplitude there in natural units."""
        signs, largest = self.signs, self.largest
        best = np.full(len(signs), -np.inf)
        amplitude = np.zeros(len(signs))
        for s in self.settings:
            value, mean = single_integrals(s.score, np.diagonal(s.gram), signs, largest)
            better = s.log_null + value > best
            best, amplitude = np.where(better, s.log_null + value, best), np.where(better, mean, amplitude)
        return best, amplitude * np.array([c.variant.plausible[0] for c in self.candidates])

    def pairs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Candidates of every two mechanisms, first and second, and log marginal likelihood of both, each at its best
        setting."""
        a, b = np.triu_indices(len(self.candidates), 1)
        names = np.array([c.mechanism for c in self.candidates])
        two = names[a] != names[b]
        a, b = a[two], b[two]
        each = [s.log_null + pair_integrals(s.gram, s.score, a, b, self.signs, self.largest) for s in self.settings]
        return a, b, np.max(each, 0)

    @property
    def information(self) -> np.ndarray:
        """Information on each candidate's amplitude at the first setting, in units of the smallest plausible one."""
        return np.diagonal(self.settings[0].gram)

    @property
    def similarity(self) -> np.ndarray:
        """Correlations of the candidates' projected signatures at the first setting."""
        root = np.sqrt(np.maximum(self.information, 1e-300))
        return self.settings[0].gram / root / root[:, None]


def single_integrals(
    score: np.ndarray, information: np.ndarray, signs: np.ndarray, largest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log integral over each amplitude alone, and its mean under the best scale."""
    scale = np.exp(np.linspace(0, 1, SCALES)[:, None] * np.log(largest)[None])
    precision = information[None] + scale**-2.0
    mean = score[None] / precision
    value = 0.5 * score[None] * mean - 0.5 * np.log(precision) - np.log(scale)
    value += np.where(signs == 0, 0.0, np.log(2) + log_ndtr(signs * mean * np.sqrt(precision)))
    best = np.argmax(value, 0)
    return logsumexp(value, axis=0) - np.log(SCALES), mean[best, np.arange(len(score))]


def pair_integrals(
    gram: np.ndarray, score: np.ndarray, a: np.ndarray, b: np.ndarray, signs: np.ndarray, largest: np.ndarray
) -> np.ndarray:
    """Log integral over two amplitudes, for many pairs of rows `a` and `b`."""
    found = []
    for one in np.linspace(0, 1, SCALES):
        for two in np.linspace(0, 1, SCALES):
            sa, sb = largest[a] ** one, largest[b] ** two
            p, q, r = gram[a, a] + sa**-2.0, gram[b, b] + sb**-2.0, gram[a, b]
            det = np.maximum(p * q - r * r, 1e-12 * p * q)
            ma, mb = (q * score[a] - r * score[b]) / det, (p * score[b] - r * score[a]) / det
            value = 0.5 * (score[a] * ma + score[b] * mb) - 0.5 * np.log(det) - np.log(sa * sb)
            for m, sd, sign in ((ma, np.sqrt(q / det), signs[a]), (mb, np.sqrt(p / det), signs[b])):
                value = value + np.where(sign == 0, 0.0, np.log(2) + log_ndtr(sign * m / sd))
            found.append(value)
    return np.asarray(logsumexp(np.stack(found), axis=0)) - 2 * np.log(SCALES)


def testable_columns(
    base: Base, state: State, whole: Mapping[str, Mechanism], testable: Mapping[str, Mechanism]
) -> tuple[tuple[Candidate, ...], np.ndarray]:
    """The formulas of a library that tests can distinguish, and their signatures.

    Those of the whole library are worked out: campaigns that distinguish different ones share what is compiled.
    """
    every = candidates_of(whole)
    rows = [k for k, c in enumerate(every) if c.mechanism in testable and c.variant in testable[c.mechanism].variants]
    return tuple(every[k] for k in rows), signature_columns(base, state, every)[..., np.array(rows, int)]


def signature_columns(base: Base, state: State, candidates: Sequence[Candidate]) -> np.ndarray:
    """Signatures of candidates at the base law, in units of their smallest plausible amplitudes."""
    effects = tuple(c.effect for c in candidates)
    columns = base.each(candidate_columns, state.point, effects, base.forms)
    return np.asarray(columns) * np.array([c.variant.plausible[0] for c in candidates])


def screen(
    base: Base,
    state: State,
    hyper: np.ndarray,
    candidates: Sequence[Candidate],
    columns: np.ndarray,
    *,
    several: bool = True,
) -> Screen:
    """Scores of candidates around the base law, at its hyperparameters first and at `several` other settings of them.

    `columns` are the candidates' signatures as `signature_columns` gives them.
    """
    design = with_amplitudes(design_of(base, state), columns)
    settings = []
    grid = itertools.product(NOISE_FACTORS, LENGTH_FACTORS, SPREAD_FACTORS)
    for sd, length, spread in grid if several else [(1.0, 1.0, 1.0)]:
        at = hyper.copy()
        at[2:4] += np.log([sd, length])
        at[4:8] *= spread
        model = LinearModel(at, design)
        shared = model.shared()
        null = float(np.sum(model.log_integral) + shared.log_integral) - 0.5 * shared.schur[-1, -1]
        settings.append(Setting(null + log_prior(at, design)[0], shared.information, shared.score))
    return Screen(tuple(candidates), tuple(settings), columns)


def first_order(base: Base, whole: Mapping[str, Mechanism], testable: Mapping[str, Mechanism] | None = None) -> Screen:
    """Scores of a library around the base law at its own hyperparameters, or of those that tests can distinguish."""
    candidates, columns = testable_columns(base, base.state, whole, whole if testable is None else testable)
    return screen(base, base.state, base.hyperparameters, candidates, columns, several=False)
