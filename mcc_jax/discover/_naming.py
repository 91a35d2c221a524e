"""What is missing: one mechanism, several that cannot be told apart, two together, or a formula of its own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ._closure import Closure
from ._extensions import Extensions
from ._pursuit import pursue
from ._result import Verdict
from ._score import Projection, project
from ._search import Ranking, family_columns, pairs, rank
from ._significance import p_nothing_left
from ._system import Base, System

LEVEL_OF_MORE = 0.01
"""Level at which something is missing besides the whole family of formulas of what was added."""

LEVEL_OF_UNLISTED = 0.001
"""Level at which something is missing besides every name, for saying that no name is right: no listed formula is
nature's own, so that a little is always left, and this is the stronger claim."""

BETTER, SHARE = 30.0, 0.1
"""A formula of a few free words takes away this much chi2 more than any listed mechanism by chance and because no
listed formula is nature's own, in addition this share of what the mechanism takes away. Beyond, it is not listed."""

LIKE_THE_BEST = 0.1
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
        extensions: fits of the extended law; None where first order does.
        seed: of the bootstrap.
        tell: called with the name of each step.
    """
    evident = bool(ranking.log_evidence[0] > 0)  # or the gap is one that no name has anything to do with
    members = tuple(ranking.members(LIKE_THE_BEST))
    gain_of_words = pursue(system)[1]
    # Any member of the set may be the one beside which nothing is left; the most probable is asked first.
    most_left = 0.0
    for name in members if evident else ():
        position = ranking.names.index(name)
        first, gain = ranking.best[position], float(ranking.gain[position])
        if ranking.at_random[position]:
            around = system.absorbing(family_columns(system, (name,)))
        else:
            around = system if extensions is None else extensions.system_of((first,))
        left = p_nothing_left(around, seed, [first])
        most_left = max(most_left, left)
        if gain_of_words <= gain + BETTER + SHARE * gain and left > LEVEL_OF_MORE:
            own = (name, *(m for m in members if m != name))
            return _verdict(members), [first], [own], [ranking]
    first = ranking.best[0]
    tell("a second effect")
    if ranking.at_random[0] and ranking.gain[0] > gain_of_words:
        return _verdict(members), [first], [members], [ranking]
    best_pairs = pairs(system, view)
    if best_pairs and not ranking.at_random[0]:
        gain, i, j = best_pairs[0]
        both = tuple(system.candidates[k].mechanism for k in (i, j))
        with_both = system
        if extensions is not None:
            with_both, gain = extensions.system_of((i, j)), max(gain, extensions.drop((i, j)))
        p_both = p_nothing_left(with_both, seed, [i, j])
        enough = evident or gain > BETTER  # of so many pairs one takes away half of that by chance
        if enough and p_both > LEVEL_OF_MORE and gain >= gain_of_words - BETTER:
            steps = [_beside(system, other) for other in (j, i)]  # each is judged with the other one in the law
            sets = [_with(name, step) for name, step in zip(both, steps, strict=True)]
            return _verdict(*sets), [i, j], sets, steps
    far_better = gain_of_words > ranking.gain[0] * (1 + SHARE) + BETTER
    unexplained = not evident or most_left <= LEVEL_OF_UNLISTED or far_better
    if gain_of_words == 0 or not unexplained:
        return _verdict(members), [first], [members], [ranking]
    return "UNLISTED", [], [], []


def _verdict(*sets: tuple[str, ...]) -> Verdict:
    """The verdict for some sets of names."""
    return "NAMED" if all(len(names) == 1 for names in sets) else "SET"


def _beside(system: System, other: int) -> Ranking:
    """The ranking beside a candidate that is in the law already."""
    return rank(system, project(system, system.candidate_columns, inside=np.array([system.column(other)])))


def _with(name: str, ranking: Ranking) -> tuple[str, ...]:
    members = ranking.members(LIKE_THE_BEST)
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
        _, i, j = found[0]
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
