"""What is missing: one mechanism, several that cannot be told apart, two together, or a formula of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .discrepancy import Closure
from .evidence import Pair, Ranking, family_columns, other_formulas, pairs, rank
from .extensions import Extensions
from .forward_selection import pursue
from .linear_model import Base, System
from .omnibus import p_nothing_left
from .result import Verdict
from .score import Projection, project

LEVEL_OF_MORE = 0.01
"""Level at which something is missing besides the whole family of formulas of what was added."""

LEVEL_OF_UNLISTED = 0.001
"""Level at which something is missing besides every name, for saying that no name is right: no listed formula is
nature's own, so that a little is always left, and this is the stronger claim."""

EACH = 11.0
"""Drop of chi2 that one more name or word takes away by chance, the best of some hundred formulas. What explains the
gap is judged by what it takes away beyond so much for each.

Two names stand only where they do no worse than words: two listed formulas can imitate nearly any one that is not
listed, but seldom better than words; if they are nature's own, they do."""

BETTER, SHARE = 12.0, 0.04
"""Words do so much better than any listed mechanism by chance and because no listed formula is nature's own, in
addition this share of what the mechanism takes away. Beyond, it is not listed."""

MIN_OF_TWO = 30.0
"""Least drop of chi2 by two names where no single one is evident: of so many pairs one takes away half of that by
chance."""

CLOSE, MAX_PAIRS = 4.0, 4
"""Pairs of which the log evidence is so close to the best one's are fitted as they are, so many at most."""

LOST, OTHERS = 0.1, 3
"""Where a pair, fitted as it is, takes away so much less than first order says (a share), other formulas of its
mechanisms are tried, so many of each: strong effects of one mechanism differ more than weak ones."""

LIKE_THE_BEST = 0.05
"""A mechanism whose probability is at least this share of the best one's belongs to the set."""


def name_missing(
    system: System,
    view: Projection,
    ranking: Ranking,
    extensions: Extensions | None,
    seed: int,
    tell: Callable[[str], None],
) -> tuple[Verdict, list[int], list[tuple[str, ...]], list[Ranking]]:
    """Verdict, chosen candidates, their sets, and rankings of each step.

    Args:
        system: the linear system of the campaign.
        view: the candidates in it.
        ranking: theirs.
        extensions: fits of the law with effects; None where first order does.
        seed: of the bootstrap.
        tell: called with the name of each step.
    """
    evident = bool(ranking.log_evidence[0] > 0)  # or the gap is one that no name has anything to do with
    members = tuple(ranking.members(LIKE_THE_BEST))
    words, gain_of_words = pursue(system)
    by_words = gain_of_words - EACH * len(words)
    tolerable, left = _tolerable(system, ranking, extensions, by_words, seed) if evident else ([], 0.0)
    name, k = tolerable[0] if tolerable else (members[0], ranking.best[0])
    single = _verdict(members), [k], [_led_by(name, members)], [ranking]
    if left > LEVEL_OF_MORE:
        return single
    tell("a second effect")
    if ranking.at_random[0]:
        if ranking.gain[0] > gain_of_words:
            return single
    elif chosen := _two_names(system, view, extensions, 0.0 if evident else MIN_OF_TWO, by_words, seed):
        steps = [_beside(system, other) for other in reversed(chosen)]  # each is judged with the other one in the law
        both = [system.candidates[k].mechanism for k in chosen]
        sets = [_led_by(name, step.members(LIKE_THE_BEST)) for name, step in zip(both, steps, strict=True)]
        return _verdict(*sets), chosen, sets, steps
    if words and not tolerable:
        return "UNLISTED", [], [], []
    return single


def _tolerable(
    system: System, ranking: Ranking, extensions: Extensions | None, by_words: float, seed: int
) -> tuple[list[tuple[str, int]], float]:
    """Names of the set beside which not much is left and than which words are not much better, with their candidates,
    and the probability that nothing is left beside the last of them.

    Any member may be the one beside which nothing is left: they are asked in turn until it is found. The first of the
    names is that of the largest product of its probability and, up to the level, of that of nothing left beside it.
    """
    found, left = list[tuple[float, str, int]](), 0.0
    for name in ranking.members(LIKE_THE_BEST):
        position = ranking.names.index(name)
        k, gain = ranking.best[position], float(ranking.gain[position])
        if by_words > gain - EACH + BETTER + SHARE * gain:
            continue
        if ranking.at_random[position]:
            around = system.absorbing(family_columns(system, (name,)))
        else:
            around = system if extensions is None else extensions.system_of((k,))
        left = p_nothing_left(around, seed, [k])
        if left > LEVEL_OF_UNLISTED:
            worth = float(ranking.probability[position]) * min(left, LEVEL_OF_MORE)
            found.append((worth, name, k))
        if left > LEVEL_OF_MORE:
            break
    return [(name, k) for _, name, k in sorted(found, key=lambda f: -f[0])], left


def _two_names(
    system: System, view: Projection, extensions: Extensions | None, least: float, by_words: float, seed: int
) -> list[int]:
    """The best pair, if it takes away more than `least`, does no worse than words, and nothing is left beside it."""
    pair = _best_pair(system, view, extensions)
    if pair is None or pair.gain <= least or pair.gain - 2 * EACH < by_words:
        return []
    chosen = list(pair.both)
    around = system if extensions is None else extensions.system_of(pair.both)
    return chosen if p_nothing_left(around, seed, chosen) > LEVEL_OF_MORE else []


def _best_pair(system: System, view: Projection, extensions: Extensions | None) -> Pair | None:
    """The most evident pair, those close to it fitted as they are; None without any."""
    found = pairs(system, view)
    if not found or extensions is None:
        return found[0] if found else None
    fitted = []
    for pair in found[:MAX_PAIRS]:
        if pair.log_evidence <= found[0].log_evidence - CLOSE:
            continue
        fitted.append(pair.fitted(extensions.drop(pair.both)))
        if fitted[-1].gain < (1 - LOST) * pair.gain:
            others = other_formulas(system, view, pair, OTHERS)
            fitted += [other.fitted(extensions.drop(other.both)) for other in others]
    return max(fitted, key=lambda pair: pair.log_evidence)


def _verdict(*sets: tuple[str, ...]) -> Verdict:
    """The verdict for some sets of names."""
    return "NAMED" if all(len(names) == 1 for names in sets) else "SET"


def _beside(system: System, other: int) -> Ranking:
    """The ranking beside a candidate that is in the law already."""
    return rank(system, project(system, system.candidate_columns, inside=np.array([system.column(other)])))


def _led_by(name: str, members: Sequence[str]) -> tuple[str, ...]:
    """A set with this name first."""
    return (name, *(m for m in members if m != name))


def chooser(system: System, count: int, closure: Closure | None) -> Callable[[np.ndarray], list[np.ndarray]]:
    """The search as it is repeated within a fold."""
    empty, usable = np.array([], int), np.flatnonzero(system.usable)

    def choose(particles: np.ndarray) -> list[np.ndarray]:
        if closure is not None:
            out = np.setdiff1d(usable, particles)
            without = [words for group, words in closure.folds if np.isin(out, group).any()]
            return [empty, without[0] if without else closure.words]
        view = project(system, system.candidate_columns, particles=particles)
        if count == 1:
            return [empty, np.array([system.column(rank(system, view).best[0])])]
        found = pairs(system, view)
        if not found:
            return [empty] * (count + 1)
        i, j = found[0].both
        return [empty, np.array([system.column(i)]), np.array([system.column(i), system.column(j)])]

    return choose


def span_of(base: Base) -> dict[str, tuple[float, float]]:
    """Range of stress, size and time in the tests that took part."""
    tests = base.tests
    force = np.where(np.asarray(tests.mask), np.asarray(tests.force), np.nan)
    diameter = np.asarray(tests.effective_diameter)
    stress = force / (np.pi * diameter[:, None] ** 2 / 4) * 1e3
    return {
        "stress_MPa": (float(np.nanmin(stress)), float(np.nanmax(stress))),
        "effective_diameter_um": (float(diameter.min()), float(diameter.max())),
        "time_s": (0.0, float(np.asarray(base.records.time).max())),
    }
