"""First-order search: every formula at every value of its grid, singly and in pairs, around the base law."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.special import log_ndtr, logsumexp

from ..calibrate.data import Tests
from ..calibrate.forward import Forms, Point
from ..calibrate.priors import SCALES
from ..calibrate.running import compiled_quickly
from ..effects import AbstractEffect, Mechanism, Need, Nuisance, Variant
from ..law import PUNCH_AREA, signatures
from .base import Base, Library, State
from .design import design_of
from .evidence import LinearModel, log_prior
from .settings import LENGTH_FACTORS, NOISE_FACTORS

SPREAD_FACTORS = 1.0, 0.5  # on the spreads of the base fit, at which all formulas are screened

# Values tried of a number that differs from test to test.
LOCATIONS = 32  # of a place between two that lie far apart, which must be met closely
PHASES = 14  # of a phase

PUNCH = "punch_radius_um"


@dataclass(frozen=True)
class Candidate:
    """One formula with fixed nuisance parameters, of which only the amplitude is unknown."""

    variant: Variant
    nuisance: Mapping[str, float]

    @property
    def mechanism(self) -> str:
        """Name of the mechanism."""
        return self.variant.mechanism


@dataclass(frozen=True)
class Candidates:
    """Formulas of which only the amplitudes are unknown, and what they add to the tests."""

    each: tuple[Candidate, ...]
    columns: np.ndarray  # signatures at the base law, per smallest plausible amplitude

    def of(self, library: Library) -> Candidates:
        """Those of a library."""
        known = [variant for mechanism in library.values() for variant in mechanism.variants]
        rows = np.array([k for k, c in enumerate(self.each) if c.variant in known], int)
        return Candidates(tuple(self.each[k] for k in rows), self.columns[..., rows])

    @cached_property
    def mechanisms(self) -> np.ndarray:
        """Names of their mechanisms."""
        return np.array([c.mechanism for c in self.each], object)

    @cached_property
    def signs(self) -> np.ndarray:
        """Physical signs of the amplitudes."""
        return np.array([c.variant.sign for c in self.each], float)

    @cached_property
    def largest(self) -> np.ndarray:
        """Largest plausible amplitudes over the smallest."""
        return np.array([c.variant.plausible[1] / c.variant.plausible[0] for c in self.each], float)


def candidates_of(library: Library) -> tuple[Candidate, ...]:
    """All formulas of a library in its order, at every value of their grids."""
    found = []
    for variant in (v for mechanism in library.values() for v in mechanism.variants):
        names = [n.name for n in variant.nuisances]
        grid = itertools.product(*map(_values, variant.nuisances))
        found += [Candidate(variant, dict(zip(names, map(float, values), strict=True))) for values in grid]
    return tuple(found)


def _values(number: Nuisance) -> Sequence[float]:
    """Values of a further number: of what differs from test to test finer ones, by ratio over more than a factor 3."""
    low, high = number.plausible
    if not number.random_per_test:
        return number.grid
    return list(np.geomspace(low, high, LOCATIONS) if low > 0 and high > 3 * low else np.linspace(low, high, PHASES))


def located(variant: Variant) -> bool:
    """Whether a further number of the formula differs from test to test, which no `Model` holds."""
    return any(n.random_per_test for n in variant.nuisances)


def untestable(library: Library, present: frozenset[Need]) -> tuple[dict[str, Mechanism], list[dict[str, str]]]:
    """The mechanisms and variants whose needs the data meet; name and needs of each mechanism that has none."""
    testable: dict[str, Mechanism] = {}
    missing = []
    for name, mechanism in library.items():
        possible = tuple(v for v in mechanism.variants if set(v.needs) <= present)
        if possible:
            testable[name] = replace(mechanism, variants=possible)
        else:
            least = min((set(v.needs) - present for v in mechanism.variants), key=len)
            missing.append({"mechanism": name, "needs": " and ".join(sorted(need.value for need in least))})
    return testable, missing


def without_punch(library: Library, base: Base) -> dict[str, Mechanism]:
    """The library without the width of the punch, another name for the frame's compliance unless a contact is wider."""
    diameter, tests = base.campaign.metadata.punch_diameter_um, base.tests
    ends = np.where(np.asarray(tests.mask), np.asarray(tests.displacement), -np.inf).max(1)
    travel = np.maximum(ends - np.asarray(base.state.point.zero), 0.0)
    widest = float(np.max(np.sqrt(PUNCH_AREA * np.asarray(tests.effective_diameter) * travel / 2)))

    def known(variant: Variant) -> Variant | None:
        others = tuple(n for n in variant.nuisances if n.name != PUNCH)
        if len(others) == len(variant.nuisances):
            return variant
        if diameter is None or 2 * widest <= diameter:
            return None
        radius = Nuisance(PUNCH, (diameter / 2,), (diameter / 2, diameter / 2), "radius of the flat punch, as recorded")
        return replace(variant, nuisances=(*others, radius))

    kept = {name: tuple(filter(None, map(known, m.variants))) for name, m in library.items()}
    return {name: replace(library[name], variants=variants) for name, variants in kept.items() if variants}


@compiled_quickly
def candidate_columns(point: Point, tests: Tests, effects: tuple[AbstractEffect, ...], forms: Forms) -> Array:
    """Signatures of all candidates at the base law, shape (N, points, candidates)."""

    def one(latent: Array, tests: Tests) -> Array:
        columns = signatures(forms.law(latent, jnp.zeros(0)), tests.particle, tests.record, effects)
        return jnp.where(tests.mask[None], columns, 0.0).T

    return jax.vmap(one)(point.latent, tests)


def with_signatures(base: Base, state: State, candidates: Sequence[Candidate]) -> Candidates:
    """Candidates with their signatures at the base law."""
    effects = tuple(c.variant.build(0.0, **c.nuisance) for c in candidates)
    columns = base.each(candidate_columns, state.point, effects, base.model.forms)
    return Candidates(tuple(candidates), np.asarray(columns) * [c.variant.plausible[0] for c in candidates])


@dataclass(frozen=True)
class Screen:
    """Candidates against the base law, all else integrated out, in units of their smallest plausible amplitudes; arrays
    have an entry for each of the hyperparameters that were tried, those of the base law first."""

    candidates: Candidates
    log_null: np.ndarray  # log marginal likelihood without any, times the hyperparameters' prior
    gram: np.ndarray  # information among candidates
    score: np.ndarray

    def singles(self) -> np.ndarray:
        """Log marginal likelihood of each candidate at its best setting."""
        information = np.diagonal(self.gram, axis1=1, axis2=2)
        each = single_integrals(self.score, information, self.candidates.signs, self.candidates.largest)
        return np.max(self.log_null[:, None] + each, 0)

    @cached_property
    def pairs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Candidates of every two mechanisms, first and second, and their log marginal likelihood."""
        a, b = np.triu_indices(len(self.candidates.each), 1)
        two = self.candidates.mechanisms[a] != self.candidates.mechanisms[b]
        a, b, signs, largest = a[two], b[two], self.candidates.signs, self.candidates.largest
        each = [pair_integrals(G, s, a, b, signs, largest) for G, s in zip(self.gram, self.score, strict=True)]
        return a, b, np.max(self.log_null[:, None] + each, 0)

    @property
    def information(self) -> np.ndarray:
        """Information on each candidate's amplitude under the base law's hyperparameters."""
        return np.diagonal(self.gram[0])

    @property
    def similarity(self) -> np.ndarray:
        """Correlations of the candidates' projected signatures there."""
        root = np.sqrt(np.maximum(self.information, 1e-300))
        return self.gram[0] / root / root[:, None]


def single_integrals(score: Any, information: Any, signs: Any, largest: Any) -> Any:
    """Log integrals over amplitudes, each alone, of any shape; see `evidence.amplitudes` for their prior."""
    scale = np.exp(np.linspace(0, 1, SCALES).reshape(-1, *[1] * np.ndim(score)) * np.log(largest))
    precision = information + scale**-2.0
    mean = score / precision
    value = 0.5 * score * mean - 0.5 * np.log(precision) - np.log(scale)
    value += np.where(np.equal(signs, 0), 0.0, np.log(2) + log_ndtr(signs * mean * np.sqrt(precision)))
    return logsumexp(value, axis=0) - np.log(SCALES)


def pair_integrals(gram: Any, score: Any, a: np.ndarray, b: np.ndarray, signs: Any, largest: Any) -> np.ndarray:
    """Log integral over two amplitudes, for many pairs of rows `a` and `b`."""
    found = []
    for one, two in itertools.product(np.linspace(0, 1, SCALES), repeat=2):
        sa, sb = largest[a] ** one, largest[b] ** two
        p, q, r = gram[a, a] + sa**-2.0, gram[b, b] + sb**-2.0, gram[a, b]
        det = np.maximum(p * q - r * r, 1e-12 * p * q)
        ma, mb = (q * score[a] - r * score[b]) / det, (p * score[b] - r * score[a]) / det
        value = 0.5 * (score[a] * ma + score[b] * mb) - 0.5 * np.log(det) - np.log(sa * sb)
        for m, sd, sign in ((ma, np.sqrt(q / det), signs[a]), (mb, np.sqrt(p / det), signs[b])):
            value = value + np.where(sign == 0, 0.0, np.log(2) + log_ndtr(sign * m / sd))
        found.append(value)
    return np.asarray(logsumexp(np.stack(found), axis=0)) - 2 * np.log(SCALES)


def screen(base: Base, state: State, hyper: np.ndarray, candidates: Candidates, *, several: bool = True) -> Screen:
    """Scores of candidates around the base law, at its hyperparameters first and at `several` other settings."""
    design = design_of(base, state).with_amplitudes(candidates.columns)
    grid = itertools.product(NOISE_FACTORS, LENGTH_FACTORS, SPREAD_FACTORS)
    log_null, gram, score = [], [], []
    for sd, length, spread in grid if several else [(1.0, 1.0, 1.0)]:
        at = hyper.copy()
        at[2:4] += np.log([sd, length])
        at[4:8] *= spread
        model = LinearModel(at, design)
        shared = model.shared()
        null = float(np.sum(model.log_integral) + shared.log_integral) - 0.5 * shared.schur[-1, -1]
        log_null.append(null + log_prior(at, design)[0])
        gram.append(shared.information)
        score.append(shared.score)
    return Screen(candidates, np.array(log_null), np.array(gram), np.array(score))


def first_order(base: Base, whole: Library, testable: Library) -> Screen:
    """Scores around the base law at its own hyperparameters of what of a whole library the tests can show."""
    candidates = with_signatures(base, base.state, candidates_of(whole)).of(testable)
    return screen(base, base.state, base.hyperparameters, candidates, several=False)
