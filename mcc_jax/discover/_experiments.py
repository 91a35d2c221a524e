"""Which further test would tell the members of a set apart, and how surely."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import norm

from ..effects import Mechanism
from ..simulate import Programme
from ._plan import Plan, planned_system
from ._score import Projection, project
from ._system import Base, System

ENOUGH = 0.9
MOST_PARTICLES = 200

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
    base: Base, system: System, chosen: list[int], sets: list[tuple[str, ...]]
) -> list[dict[str, Any]]:
    """For every effect with rivals, the tests by the probability that they separate it from the closest one.

    The separation of the added effect from a rival is the chi2 that the rival cannot explain if the effect is as large
    as estimated; a rival falls out of the set when it is less probable by the factor that defines the set.
    """
    needed = [
        (k, [n for n in names if n != system.candidates[k].mechanism]) for k, names in zip(chosen, sets, strict=True)
    ]
    if not any(rivals for _, rivals in needed):
        return []
    # The same formulas and the same number of points as in the campaign itself: everything is compiled already.
    library: dict[str, Mechanism] = {}
    for name in dict.fromkeys(c.mechanism for c in system.candidates):
        variants = {c.variant.name: c.variant for c in system.candidates if c.mechanism == name}
        library[name] = Mechanism(name, "", tuple(variants.values()))
    points = max(base.tests.force.shape[1] - TURNS, 32)
    theta = project(system, system.candidate_columns[:0], inside=np.array([system.column(k) for k in chosen])).theta
    found = []
    views: dict[str, Projection] = {}
    options: list[tuple[str, System]] = [("more particles, tested in the same way", system)]
    options += [(plan.name, planned_system(base, plan, library)) for plan in menu(points)]
    for (k, rivals), amplitude in zip(needed, theta[len(system.globals) :], strict=True):
        for name, other in options:
            same = [
                j
                for j, c in enumerate(other.candidates)
                if (c.variant, dict(c.nuisance)) == (system.candidates[k].variant, dict(system.candidates[k].nuisance))
            ]
            if not rivals or not same:
                continue
            if name not in views:
                views[name] = project(other, other.candidate_columns)
            view = views[name]
            least = min(_separation(other, view, same[0], rival) for rival in rivals)
            per_particle = least * amplitude**2 / other.usable.sum()
            count = int(system.usable.sum())
            first = 2 * count if other is system else count
            particles = next((n for n in range(first, MOST_PARTICLES, 2) if _power(n * per_particle) >= ENOUGH), None)
            tried = particles or first
            found.append(
                {
                    "experiment": name,
                    "separates": [system.candidates[k].mechanism, *rivals],
                    "particles": int(tried),
                    "power": float(_power(tried * per_particle)),
                }
            )
    found.sort(key=lambda one: (-min(one["power"], ENOUGH), one["particles"]))
    return found


def _separation(system: System, view: Projection, k: int, rival: str) -> float:
    """chi2 per squared amplitude of a candidate that no formula of the rival explains."""
    both = view.information.sum(0)
    least = both[k, k]
    for j, candidate in enumerate(system.candidates):
        if candidate.mechanism == rival and view.alive[j]:
            least = min(least, both[k, k] - both[k, j] ** 2 / both[j, j])
    return max(float(least), 0.0)


def _power(separation: float) -> float:
    """Probability that half of the chi2 between two names exceeds what keeps both in the set."""
    if separation <= 0:
        return 0.0
    return float(norm.cdf((separation / 2 - np.log(10)) / np.sqrt(separation)))
