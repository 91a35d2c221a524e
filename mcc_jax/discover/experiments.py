"""Which further tests would tell the members of a set apart: the ranking, tried on tests that are not made yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..effects import Mechanism
from ..simulate import Programme
from .evidence import Ranking, formula_weights, rank, weights
from .linear_model import Base, System
from .model_selection import LIKE_THE_BEST
from .plan import Plan, planned_system
from .pop_in import root_of
from .score import Projection, project

ENOUGH = 0.9
"""Probability of a verdict of one name from which on an experiment is worth it."""

EVEN = 0.5
"""Least probability of it with which an experiment is proposed: particles are too dear for less than an even chance."""

COPIES = (0.5, 1, 2, 3, 5, 10)
"""Further particles that are tried, over those of the campaign."""

MAX_PARTICLES = 200
"""Further ones that are asked for at most."""

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
    base: Base,
    system: System,
    chosen: list[int],
    steps: list[Ranking],
    *,
    refitted: Mapping[int, float] | None = None,
    seed: int = 0,
) -> list[dict[str, Any]]:
    """For every effect with rivals, further tests by the probability that with them one name is left: the right one.

    Each member of the set is taken for true in turn, in each of its formulas as far as that is probable and as large as
    it would have to be. Further tests of each kind are drawn and judged together with those that were made. `power` is
    the share in which the true one alone is left, the members weighted by their probability.

    Args:
        base: the base fit.
        system: the linear system.
        chosen: the effects.
        steps: the ranking of each beside the others.
        refitted: drop of -2 log likelihood by those candidates that were fitted as they are, as in `rank`.
        seed: of the tests drawn.

    Returns:
        As in `discovery.json`, the most telling experiment first; of those that tell enough, the one with the fewest
        further particles. None that has less than an even chance.
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
            trial = _Trial.of(system, other, step, others, refitted or {})
            if trial is None:
                continue
            particles, power = trial.fewest(seed)
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
class _Truth:
    """A member of the set that may be the true one.

    Attributes:
        share: how probable it is.
        formulas: its candidates, as positions.
        probability: theirs, if it is the true one.
        amplitude: theirs.
        sd: standard deviation of each amplitude.
    """

    share: float
    formulas: np.ndarray
    probability: np.ndarray
    amplitude: np.ndarray
    sd: np.ndarray


@dataclass(frozen=True)
class _Trial:
    """Further tests, beside those that were made, and what may be found by them.

    Attributes:
        system: of the further tests, with the formulas of the set's members alone.
        made: their scores and information in the tests that were made, the other effects in the law.
        view: the same in the further tests of as many particles.
        truths: the members.
    """

    system: System
    made: Projection
    view: Projection
    truths: tuple[_Truth, ...]

    @classmethod
    def of(
        cls, measured: System, other: System, step: Ranking, others: list[int], refitted: Mapping[int, float]
    ) -> _Trial | None:
        """None where the further tests show nothing of a member."""
        place = {(c.variant, *sorted(c.nuisance.items())): j for j, c in enumerate(other.candidates)}
        at = [place.get((c.variant, *sorted(c.nuisance.items()))) for c in measured.candidates]
        beside = [at[c] for c in others]
        members = step.members(LIKE_THE_BEST)
        if any(j is None for j in (*beside, *(at[k] for k in step.best[: len(members)]))):
            return None
        family = [k for k, c in enumerate(measured.candidates) if c.mechanism in members and at[k] is not None]
        keep = np.array([at[k] for k in family], int)
        inside = np.array([other.column(j) for j in beside if j is not None], int)
        view = project(other, other.candidate_columns, inside=inside).only(keep)
        now = project(measured, measured.candidate_columns, inside=np.array([measured.column(c) for c in others], int))
        made = _as_fitted(now.only(np.array(family)), measured, family, refitted)
        weight = weights(measured, formula_weights(measured))
        names = [measured.candidates[k].mechanism for k in family]
        truths = []
        ranked = zip(members, step.best, step.gain, step.at_random, step.probability, strict=False)
        for name, best, gain, random, share in ranked:
            # A step at random is drawn as it was found.
            own = [family.index(best)] if random else [i for i, mechanism in enumerate(names) if mechanism == name]
            evidence = np.array([step.evidence[family[i]] for i in own])
            likely = weight[[family[i] for i in own]] * np.exp(evidence - evidence.max())
            amplitude, information = made.estimate[own], np.maximum(made.total[own], 1e-300)
            if random:
                amplitude = np.sign(amplitude) * np.sqrt(max(gain, 0.0) / information)
            truths.append(_Truth(float(share), np.array(own), likely / likely.sum(), amplitude, information**-0.5))
        # Steps at any point are not drawn: places on the grid stand for them.
        alone = replace(other, candidates=tuple(other.candidates[j] for j in keep), steps=None)
        return cls(alone, made, view, tuple(truths))

    def fewest(self, seed: int) -> tuple[int, float]:
        """The smallest number of further particles that is enough, or else the largest, and its power."""
        count = len(self.system.points)
        tried = [n for n in (round(c * count) for c in COPIES) if 0 < n <= MAX_PARTICLES] or [count]
        most = self.power(tried[-1], seed)
        if most < ENOUGH:
            return tried[-1], most
        for further in tried[:-1]:
            power = self.power(further, seed)
            if power >= ENOUGH:
                return further, power
        return tried[-1], most

    def power(self, further: int, seed: int) -> float:
        """Probability that the true name alone is left, with so many further particles."""
        view, made = self.view, self.made
        rng = np.random.default_rng([seed, 53])
        tested = rng.permutation(len(view.scores))[np.arange(further) % len(view.scores)]
        factor, new = root_of(view.information)[tested], view.information[tested]
        information = np.concatenate([made.information, new])
        both = replace(view, survival=np.maximum(made.survival, view.survival), information=information)
        weight, power = 0.0, 0.0
        for truth in self.truths:
            name, hits = self.system.candidates[int(truth.formulas[0])].mechanism, 0
            for _ in range(CAMPAIGNS):
                which = rng.choice(len(truth.formulas), p=truth.probability)
                k = truth.formulas[which]
                amplitude = truth.amplitude[which] + truth.sd[which] * rng.standard_normal()
                sign = self.system.signs[k]
                amplitude = sign * abs(amplitude) if sign else amplitude
                noise = np.einsum("nkl,nl->nk", factor, rng.standard_normal((further, factor.shape[-1])))
                scores = np.concatenate([made.scores, new[:, :, k] * amplitude + noise])
                hits += rank(self.system, replace(both, scores=scores)).members(LIKE_THE_BEST) == [name]
            weight += truth.share
            power += truth.share * hits / CAMPAIGNS
        return power / weight


def _as_fitted(view: Projection, system: System, family: list[int], refitted: Mapping[int, float]) -> Projection:
    """Scores that take away as much as the candidates do where they were fitted as they are, and no other formula of
    their mechanisms more than the best of these."""
    scores, total = view.scores.copy(), np.maximum(view.total, 1e-300)
    linear = np.maximum(view.gaussian**2, 1e-300)
    most: dict[str, float] = {}
    for k, drop in refitted.items():
        name = system.candidates[k].mechanism
        most[name] = max(most.get(name, 0.0), drop)
    for i, k in enumerate(family):
        candidate = system.candidates[k]
        if k in refitted:
            sign = candidate.variant.sign or np.sign(view.gaussian[i])
            each = view.information[:, i, i]
            scores[:, i] = each * sign * np.sqrt(refitted[k] / total[i])
        elif candidate.mechanism in most:
            scores[:, i] *= np.sqrt(min(most[candidate.mechanism] / linear[i], 1.0))
    return replace(view, scores=scores)
