r"""Naming: how well each mechanism explains what the base law leaves, alone or together with others.

With scores U and information I of a formula's amplitude (in units of the largest believable one), and a prior that
spreads the amplitude over its plausible range, a mixture of normal distributions of scale s cut at the physical sign,

.. math:: E = \frac{2}{\sqrt{1 + I s^2}} \exp\!\left(\frac{U^2 s^2}{2 (1 + I s^2)}\right)
    \Phi\!\left(\frac{U s}{\sqrt{1 + I s^2}}\right)

is the formula's evidence against nothing. A mechanism's evidence is the mean over its formulas: nature may use any of
them, or one that resembles them.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from .candidates import located
from .linear_model import System
from .pop_in import (
    ODD,
    ODD_STEP,
    SCALES,
    SHARES,
    Jump,
    Steps,
    evidence_by_scale,
    is_step,
    over_tests,
    root_of,
    tamed,
)
from .score import Projection, Statistic

LOOSENESS = 0.005
"""No family of formulas contains nature's own: of the explained chi2 so much may be missed by the true mechanism.

Measured on 73 blind campaigns of the second generator, in formulas that need not be in the library: 0.92 of the names
are right; 0.94 is stated without it, 0.88 with 0.012. In 278 of the first generator stated probabilities are nearer to
shares right below 0.006 than above."""


def log_evidence(U: np.ndarray, information: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Log evidence of amplitudes against zero, element by element."""
    return logsumexp(evidence_by_scale(U, information, sign), axis=-1) - np.log(len(SCALES))


def log_evidence_at_random(
    scores: np.ndarray,
    information: np.ndarray,
    sign: np.ndarray,
    groups: list[np.ndarray],
    placed: np.ndarray | None = None,
) -> np.ndarray:
    """Log evidence of amplitudes that differ from test to test: a normal distribution around zero, cut at the sign.

    Args:
        scores, information: shapes (..., N, K).
        sign: physical signs, shape (K,).
        groups: columns of which every test has one of its own, equally probable beforehand.
        placed: which columns are of effects that some tests may not have, those with a place of their own; none if
            None.

    Returns:
        One number per group, shape (..., G).
    """
    each = evidence_by_scale(scores, information, sign)
    found = []
    for members in groups:
        one = logsumexp(each[..., members, :], axis=-2) - np.log(len(members))
        some = placed is not None and placed[members].all()
        found.append(over_tests(one, SHARES, ODD_STEP) if some else over_tests(one, (1.0,), ODD))
    return np.stack(found, -1)


COMMON = 1.0
"""Probability of all other formulas of a mechanism together, that of its first, the common one, being 1."""


def formula_weights(system: System) -> np.ndarray:
    """Probability of every candidate's formula among those of its mechanism, whatever its further numbers: the common
    formula counts as much as all the others together."""
    found = np.zeros(len(system.candidates))
    for name in {c.mechanism for c in system.candidates}:
        members = [k for k, c in enumerate(system.candidates) if c.mechanism == name]
        variants = list(dict.fromkeys(system.candidates[k].variant.name for k in members))
        share = {v: COMMON / (len(variants) - 1) for v in variants[1:]} | {variants[0]: 1.0}
        found[members] = [share[system.candidates[k].variant.name] / sum(share.values()) for k in members]
    return found


def weights(system: System, formulas: np.ndarray) -> np.ndarray:
    """Probability of every candidate among those of its mechanism, from that of its formula: shared by its points."""
    names = [(c.mechanism, c.variant.name) for c in system.candidates]
    count = Counter(names)
    return formulas / np.array([count[name] for name in names])


def evidence_of_any(system: System, projection: Projection) -> Statistic:
    """Log evidence that one of the mechanisms is there, each as probable beforehand as any other: of estimates over
    standard errors of the projection's columns, among them formulas."""
    at = np.flatnonzero(np.isin(projection.columns, system.candidate_columns))
    k = projection.columns[at] - system.candidate_columns[0]
    information, sign = projection.total[at], system.signs[k]
    weight = weights(system, formula_weights(system))[k]

    def statistic(t: np.ndarray) -> np.ndarray:
        scores = np.atleast_2d(t)[:, at] * np.sqrt(information)
        parts = (log_evidence(some, information, sign) for some in np.array_split(scores, max(t.size // 10**6, 1)))
        return np.concatenate([np.asarray(logsumexp(part, b=weight, axis=-1)) for part in parts]).reshape(t.shape[:-1])

    return statistic


def random_groups(system: System) -> list[np.ndarray]:
    """Candidates whose amplitude or location differs from test to test: each test has one member of its group."""
    groups: dict[tuple, list[int]] = {}
    for k, candidate in enumerate(system.candidates):
        variant = candidate.variant
        free = {n.name for n in variant.nuisances if n.random_per_test}
        if variant.random_per_test or free:
            fixed = tuple(sorted((n, v) for n, v in candidate.nuisance.items() if n not in free))
            groups.setdefault((variant.mechanism, variant.name, fixed), []).append(k)
    return [np.array(members) for members in groups.values()]


def _placed(system: System, columns: np.ndarray) -> np.ndarray:
    """Which candidates have a place of their own in every test."""
    return np.array([located(system.candidates[k].variant) for k in columns], bool)


def _tamed(system: System, scores: np.ndarray, information: np.ndarray, placed: np.ndarray) -> np.ndarray:
    """Scores of what has a place of its own shrunk: it shows in a few points, which have the tails of the noise."""
    if not np.isfinite(system.tails) or not placed.any():
        return scores
    scale = np.sqrt(np.maximum(information, 1e-300))
    return np.where(placed, scale * tamed(scores / scale, system.tails), scores)


def evidence_of_steps(system: System, projection: Projection, inflation: np.ndarray | float = 1.0) -> float:
    """Log evidence of sudden steps at any points beside what was projected off; minus infinity without any to look
    for.

    Args:
        system: the system.
        projection: of which particles, and what was projected off.
        inflation: by which the noise of every particle is larger than modelled.
    """
    if system.steps is None:
        return -np.inf
    _, shrunk = _scores_of_steps(system, system.steps, projection, inflation)
    return float(system.steps.evidence(shrunk, projection.particles))


def jumps(system: System, projection: Projection) -> tuple[Jump, ...]:
    """The sudden steps that are more probable than not beside what was projected off."""
    if system.steps is None:
        return ()
    return system.steps.jumps(*_scores_of_steps(system, system.steps, projection, 1.0), projection.particles)


def _scores_of_steps(
    system: System, steps: Steps, projection: Projection, inflation: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Scores of steps, and as far as they count."""
    particles = projection.particles
    scores = steps.scores(particles, projection.nuisance, projection.theta)
    scores = scores / np.broadcast_to(inflation, len(particles))[:, None]
    return scores, _tamed(system, scores, steps.information[particles], np.ones(scores.shape[1:], bool))


def random_probability(system: System, projection: Projection, seed: int, *, draws: int = 800) -> float:
    """Probability under the noise model that effects which differ from test to test seem as evident as they do."""
    groups = random_groups(system)
    if not groups:
        return 1.0
    # A test whose noise is larger than modelled must not look like an effect.
    inflation = np.sqrt(np.maximum(projection.residual / np.maximum(system.points[projection.particles], 1), 1.0))
    observed = evidence_of_steps(system, projection, inflation)
    rng = np.random.default_rng([seed, 43])
    drawn = np.full(draws, -np.inf)
    if system.steps is not None:
        drawn = system.steps.drawn_evidence(projection.particles, draws, rng)
        groups = [members for members in groups if not is_step(system.candidates[members[0]])]
    if groups:
        index = np.concatenate(groups)
        sign, placed = system.signs[index], _placed(system, index)
        bounds = np.cumsum([0, *map(len, groups)])
        local = [np.arange(a, b) for a, b in itertools.pairwise(bounds)]
        information = projection.information[:, index][:, :, index]
        each = np.einsum("nkk->nk", information)
        scores = _tamed(system, projection.scores[:, index] / inflation[:, None], each, placed)
        observed = max(observed, float(log_evidence_at_random(scores, each, sign, local, placed).max()))
        factor = root_of(information)
        for some in np.array_split(np.arange(draws), 8):
            normal = rng.standard_normal((len(some), *each.shape))
            scores = np.einsum("nkl,bnl->bnk", factor, normal)
            own = log_evidence_at_random(scores, each, sign, local, placed).max(-1)
            drawn[some] = np.maximum(drawn[some], own)
    return (int((drawn >= observed).sum()) + 1) / (draws + 1)


@dataclass(frozen=True)
class Ranking:
    """Mechanisms against what is left.

    Attributes:
        names: mechanisms, best first.
        log_evidence: theirs, the mean over formulas.
        probability: share of each among them all, tempered by `LOOSENESS`.
        best: each one's best candidate, the common formula preferred as far as it is the more probable one beforehand.
        gain: drop of -2 log likelihood by it.
        at_random: whether amplitudes that differ from test to test explain more than a common one.
        evidence: log evidence of every candidate, minus infinity for those the base law can imitate.
        favour: the same with the probability of its formula beforehand.
        temperature: by which logarithms were divided.
    """

    names: tuple[str, ...]
    log_evidence: np.ndarray
    probability: np.ndarray
    best: tuple[int, ...]
    gain: np.ndarray
    at_random: tuple[bool, ...]
    evidence: np.ndarray
    favour: np.ndarray
    temperature: float

    def members(self, least: float) -> list[str]:
        """Mechanisms whose probability is at least this share of the best one's."""
        return [n for n, p in zip(self.names, self.probability, strict=True) if p >= least * self.probability[0]]


def rank(system: System, projection: Projection, *, refitted: Mapping[int, float] | None = None) -> Ranking:
    """Rank all mechanisms by what they explain beyond what was projected off.

    Args:
        system: the system.
        projection: scores and information of all candidates.
        refitted: drop of -2 log likelihood by those candidates that were fitted as they are (`gauss_newton`). It
            replaces the linear one, and no formula of the same mechanism counts for more than the best of these.
    """
    sign = system.signs
    U, total = projection.scores.sum(0), projection.total
    alive = projection.alive
    common = np.where(alive, log_evidence(U, total, sign), -np.inf)
    each = np.einsum("nkk->nk", projection.information)
    differing = np.full(len(sign), -np.inf)
    groups = random_groups(system)
    if groups:
        placed = _placed(system, np.arange(len(sign)))
        scores = _tamed(system, projection.scores, each, placed)
        values = log_evidence_at_random(scores, each, sign, groups, placed)
        anywhere = evidence_of_steps(system, projection)
        for members, value in zip(groups, values, strict=True):
            some = np.isfinite(anywhere) and is_step(system.candidates[members[0]])
            differing[members] = anywhere if some else value
    random = np.isfinite(differing)
    evidence = np.logaddexp(common, differing) - np.where(random, np.log(2), 0.0)
    linear = np.where(alive, U**2 / np.maximum(total, 1e-300), 0.0)
    exact = dict(refitted or {})
    for k, drop in exact.items():
        evidence[k] += (drop - linear[k]) / 2
        linear[k] = drop
    for name in {system.candidates[k].mechanism for k in exact}:
        most = max(evidence[k] for k in exact if system.candidates[k].mechanism == name)
        for k, candidate in enumerate(system.candidates):
            if candidate.mechanism == name and k not in exact:
                evidence[k] = min(evidence[k], most)
    names = list(dict.fromkeys(c.mechanism for c in system.candidates))
    formulas = formula_weights(system)
    weight, favour = weights(system, formulas), evidence + np.log(formulas)
    found = []
    for name in names:
        members = [k for k, c in enumerate(system.candidates) if c.mechanism == name]
        value = logsumexp(evidence[members], b=weight[members])
        best = max(exact.keys() & set(members) or members, key=lambda k: favour[k])
        gain = linear[best] if np.isfinite(evidence[best]) else 0.0
        if differing[best] > common[best]:
            gain = max(gain, 2 * differing[best])
        found.append((value, best, gain, bool(differing[best] > common[best])))
    order = np.argsort([-f[0] for f in found], kind="stable")
    values = np.array([found[i][0] for i in order])
    gains = np.array([found[i][2] for i in order])
    temperature = 1 + LOOSENESS * max(2 * values[0], 0.0) if np.isfinite(values[0]) else 1.0
    share = np.exp((values - values[0]) / temperature)
    return Ranking(
        tuple(names[i] for i in order),
        values,
        share / share.sum(),
        tuple(found[i][1] for i in order),
        gains,
        tuple(found[i][3] for i in order),
        evidence,
        favour,
        float(temperature),
    )


def family_columns(system: System, names: tuple[str, ...]) -> np.ndarray:
    """Columns of all formulas of some mechanisms."""
    return np.array([system.column(k) for k, c in enumerate(system.candidates) if c.mechanism in names], int)


@dataclass(frozen=True)
class Pair:
    """Two formulas of different mechanisms together.

    Attributes:
        log_evidence: of their mechanisms together, the mean over both families of formulas.
        gain: drop of -2 log likelihood by the two formulas.
        stronger, weaker: the two most evident formulas; the one that takes away more alone comes first.
    """

    log_evidence: float
    gain: float
    stronger: int
    weaker: int

    @property
    def both(self) -> tuple[int, int]:
        """The two formulas."""
        return self.stronger, self.weaker

    def fitted(self, drop: float) -> Pair:
        """The same where the two formulas, fitted as they are, take away so much."""
        return replace(self, log_evidence=self.log_evidence + (drop - self.gain) / 2, gain=drop)


def other_formulas(system: System, projection: Projection, pair: Pair, most: int) -> list[Pair]:
    """The pair with another formula of one of its mechanisms: of each, those that take away most beside the other, one
    for every variant and `most` at most."""
    U, both, sign = projection.scores.sum(0), projection.information.sum(0), system.signs
    d = np.maximum(np.diagonal(both), 1e-300)
    found: list[Pair] = []
    for own, other in (pair.both, pair.both[::-1]):
        left = d - both[:, other] ** 2 / d[other]
        beside = U - both[:, other] * U[other] / d[other]
        gain = np.where(_physical(beside, sign) & (left > 1e-4 * d), beside**2 / np.maximum(left, 1e-300), 0.0)
        now = system.candidates[own]
        best: dict[str, int] = {}
        for k in np.argsort(-gain, kind="stable").tolist():
            c = system.candidates[k]
            if c.mechanism == now.mechanism and c.variant.name != now.variant.name and gain[k] > 0:
                best.setdefault(c.variant.name, k)
        place = "stronger" if own == pair.stronger else "weaker"
        found.extend(replace(pair, **{place: k}) for k in list(best.values())[:most])
    return found


def pairs(system: System, projection: Projection) -> list[Pair]:
    r"""Pairs of mechanisms by their evidence together, the best first.

    .. math:: E_{ij} = E(U_j, I_j) \, E(U_{i|j}, I_{i|j}), \qquad U_{i|j} = U_i - I_{ij} U_j / I_j, \quad
        I_{i|j} = I_i - I_{ij}^2 / I_j

    with j the formula of more evidence alone; none where one of both amplitudes together has an impossible sign.
    """
    sign = system.signs
    U, both = projection.scores.sum(0), projection.information.sum(0)
    d = np.diagonal(both)
    names = np.array([c.mechanism for c in system.candidates])
    alive = projection.alive & (d > 0)
    left = d[:, None] - both**2 / np.where(alive, d, 1.0)[None]  # information of i beside j
    fine = alive[:, None] & alive[None] & (left > 1e-4 * d[:, None]) & (names[:, None] != names[None])
    left = np.where(fine, left, 1.0)
    beside = np.where(fine, U[:, None] - both * (U / np.where(alive, d, 1.0))[None], 0.0)
    theta = beside / left
    right = fine & _physical(theta, sign[:, None]) & _physical(theta.T, sign[None])
    alone = np.where(alive, log_evidence(U, d, sign), -np.inf)
    stronger = (alone[None] > alone[:, None]) | ((alone[None] == alone[:, None]) & np.tri(len(U), k=-1, dtype=bool))
    formulas = formula_weights(system)
    weight, formula = np.log(weights(system, formulas)), np.log(formulas)
    own = np.where(right & stronger, alone[None] + log_evidence(beside, left, sign[:, None]), -np.inf)
    evidence = np.maximum(own, own.T)
    families = {name: np.flatnonzero(names == name) for name in dict.fromkeys(names)}
    found = []
    for one, other in itertools.combinations(families.values(), 2):
        block = evidence[np.ix_(one, other)]
        if np.isfinite(block).any():
            row, column = np.unravel_index(np.argmax(block + formula[one][:, None] + formula[other]), block.shape)
            i, j = int(one[row]), int(other[column])
            if not stronger[j, i]:
                i, j = j, i
            value = np.asarray(logsumexp(block + weight[one][:, None] + weight[other][None]))
            gain = U[i] ** 2 / d[i] + beside[j, i] ** 2 / left[j, i]
            found.append(Pair(float(value), float(gain), i, j))
    return sorted(found, key=lambda p: -p.log_evidence)


def _physical(theta: np.ndarray, sign: np.ndarray) -> np.ndarray:
    return (sign == 0) | (theta * sign > 0)
