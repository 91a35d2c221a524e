"""Which further test would tell the members of a set apart: the ranking, tried on tests that are not made yet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..effects import Mechanism
from ..simulate import Programme
from ._naming import LIKE_THE_BEST
from ._plan import Plan, planned_system
from ._score import Projection, project
from ._search import Ranking, rank
from ._steps import root_of
from ._system import Base, System

ENOUGH = 0.9
"""Probability of a verdict of one name from which on an experiment is worth it."""

EVEN = 0.5
"""Least probability of it with which an experiment is proposed: particles are too dear for less than an even chance."""

COPIES = (1, 2, 3, 5, 10)
"""Times the particles of the campaign that are tried."""

MOST_PARTICLES = 200

CAMPAIGNS = 24
"""Campaigns drawn for every name that may be the true one."""

TURNS = 16
"""Points that turning points may add to a programme's own."""


def menu(points: int) -> tuple[Plan, ...]:
    """Further tests that every tester can do, sampled into about so many points."""
    cycles = {"levels": (0.5, 1.0, 1.0), "unload_to": 0.3, "hold_s": 60.0, "points": points}
    return (
        Plan("a hold of 60 s at the largest load", (Programme.cycles(hold_s=60.0, points=points),)),
        Plan(
            "a cycle at half load, a hold of 60 s at the largest load, and a reload",
            (Programme.cycles(**cycles),),
        ),
        Plan(
            "two loading rates, every second particle ten times faster, with a cycle and a hold",
            (Programme.cycles(**cycles), Programme.cycles(rate=20.0, **cycles)),
        ),
    )


def next_experiments(
    base: Base, system: System, chosen: list[int], steps: list[Ranking], *, seed: int = 0
) -> list[dict[str, Any]]:
    """For every effect with rivals, the tests by the probability that they leave one name: the right one.

    Each member of the set is taken for true in turn, as large as it would have to be, and campaigns of each kind are
    drawn; its names are ranked as those of the campaign itself. `power` is the share in which the true one alone is
    left, the members weighted by their probability.

    Args:
        base: the base fit.
        system: the linear system.
        chosen: the effects.
        steps: the ranking of each beside the others.
        seed: of the campaigns drawn.

    Returns:
        As in `discovery.json`, the most telling experiment first; of those that tell enough, the one with the fewest
        particles. None that has less than an even chance.
    """
    needed = [(k, step) for k, step in zip(chosen, steps, strict=True) if len(step.members(LIKE_THE_BEST)) > 1]
    if not needed:
        return []
    # The same formulas and the same number of points as in the campaign itself: everything is compiled already.
    library: dict[str, Mechanism] = {}
    for name in dict.fromkeys(c.mechanism for c in system.candidates):
        variants = {c.variant.name: c.variant for c in system.candidates if c.mechanism == name}
        library[name] = Mechanism(name, "", tuple(variants.values()))
    points = max(base.tests.force.shape[1] - TURNS, 32)
    options: list[tuple[str, System]] = [("more particles, tested in the same way", system)]
    options += [(plan.name, planned_system(base, plan, library)) for plan in menu(points)]
    found = []
    for k, step in needed:
        others = [c for c in chosen if c != k]
        for name, other in options:
            trial = _Trial.of(system, other, step, others)
            if trial is None:
                continue
            particles, power = trial.fewest(first=2 if other is system else 1, seed=seed)
            if power < EVEN:
                continue
            found.append(
                {
                    "experiment": name,
                    "separates": step.members(LIKE_THE_BEST),
                    "particles": particles,
                    "power": power,
                }
            )
    found.sort(key=lambda one: (-min(one["power"], ENOUGH), one["particles"]))
    return found


@dataclass(frozen=True)
class _Trial:
    """A further test, and what may be found by it.

    Attributes:
        system: the test's system with the formulas of the set's members alone.
        view: their scores and information, the other effects in the law.
        truths: for each member, which formula is the true one, how large it is, and how probable.
    """

    system: System
    view: Projection
    truths: tuple[tuple[int, float, float], ...]

    @classmethod
    def of(cls, measured: System, other: System, step: Ranking, others: list[int]) -> _Trial | None:
        """None where the test shows nothing of a member."""
        place = {(c.variant, *sorted(c.nuisance.items())): j for j, c in enumerate(other.candidates)}
        at = [place.get((c.variant, *sorted(c.nuisance.items()))) for c in measured.candidates]
        beside = [at[c] for c in others]
        members = step.members(LIKE_THE_BEST)
        if any(j is None for j in (*beside, *(at[k] for k in step.best[: len(members)]))):
            return None
        inside = np.array([other.column(j) for j in beside if j is not None], int)
        keep = np.array([j for j, c in enumerate(other.candidates) if c.mechanism in members])
        view = project(other, other.candidate_columns, inside=inside).only(keep)
        now = project(measured, measured.candidate_columns, inside=np.array([measured.column(c) for c in others], int))
        truths = []
        for k, gain, share in zip(step.best, step.gain, step.probability[: len(members)], strict=False):
            # As large as what it takes away says, fitted as it is.
            amplitude = np.sign(now.estimate[k]) * np.sqrt(max(gain, 0.0) / max(now.total[k], 1e-300))
            truths.append((int(np.flatnonzero(keep == at[k])[0]), float(amplitude), float(share)))
        # Steps at any point are not drawn: places on the grid stand for them.
        return cls(replace(other, candidates=tuple(other.candidates[j] for j in keep), steps=None), view, tuple(truths))

    def fewest(self, *, first: int, seed: int) -> tuple[int, float]:
        """The smallest number of particles that is enough, or else the largest, and its power."""
        count = len(self.system.points)
        tried = [c for c in COPIES if c >= first and c * count <= MOST_PARTICLES] or [first]
        most = self.power(tried[-1], seed)
        if most < ENOUGH:
            return tried[-1] * count, most
        for copies in tried[:-1]:
            power = self.power(copies, seed)
            if power >= ENOUGH:
                return copies * count, power
        return tried[-1] * count, most

    def power(self, copies: int, seed: int) -> float:
        """Probability that the true name alone is left, with so many times the particles."""
        view = self.view
        factor = root_of(view.information)
        rng = np.random.default_rng([seed, 53])
        information = np.tile(view.information, (copies, 1, 1))
        weight, power = 0.0, 0.0
        for k, amplitude, share in self.truths:
            mean = np.tile(view.information[:, :, k] * amplitude, (copies, 1))
            name, hits = self.system.candidates[k].mechanism, 0
            for _ in range(CAMPAIGNS):
                normal = rng.standard_normal((copies, *view.scores.shape))
                scores = mean + np.einsum("nkl,cnl->cnk", factor, normal).reshape(mean.shape)
                drawn = replace(view, scores=scores, information=information)
                hits += rank(self.system, drawn).members(LIKE_THE_BEST) == [name]
            weight += share
            power += share * hits / CAMPAIGNS
        return power / weight
