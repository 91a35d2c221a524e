"""Which further tests would separate what these cannot: expected log Bayes factors of tests that are not made yet."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import ndtr

from ..simulate import Programme
from .plan import Plan, planned_base
from .screen import Screen, first_order
from .search import Search
from .settings import DECISIONS, ENOUGH

COPIES = 0.5, 1, 2, 3, 5, 10  # further particles that are tried, over those of the campaign
MOST_PARTICLES = 200  # further ones, at most
TURNS = 16  # points that turning points may add to a programme's own
EVEN = 0.5  # the least power with which a test is proposed: particles are too dear for less than an even chance


def menu(points: int) -> tuple[Plan, ...]:
    """Further tests that every instrument can do, sampled into about so many points."""
    cycles: dict[str, Any] = {"levels": (0.5, 1.0, 1.0), "unload_to": 0.3, "hold_s": 60.0, "points": points}
    return (
        Plan("a hold of 60 s at the largest load", (Programme.cycles(hold_s=60.0, points=points),)),
        Plan("a cycle at half load, a hold of 60 s at the largest load, and a reload", (Programme.cycles(**cycles),)),
        Plan(
            "two loading rates, every second particle ten times faster, with a cycle and a hold",
            (Programme.cycles(**cycles), Programme.cycles(rate=20.0, **cycles)),
        ),
    )


def next_experiments(search: Search, names: tuple[str, ...]) -> list[dict[str, Any]]:
    """Further tests by the probability that with them the right one of several names is left alone.

    Each name is taken for true in turn, in the formula and as large as it was fitted. The log Bayes factor of the true
    one over a rival, whose amplitude is fitted again, is normal with mean m/2 and variance m, m the squared signature
    that the rival's leaves; these tests and the further ones add up. `power` is the probability that it exceeds the
    odds which a single name needs, for the rival that is worst.

    Returns:
        As in `discovery.json`, the most powerful first; none that has less than an even chance.
    """
    members = [n for n in names if n in search.shared and search.found[(n,)].at is not None]
    if len(members) < 2:
        return []
    base = search.base
    points = max(base.tests.force.shape[1] - TURNS, 32)
    assert search.screen is not None
    options: list[tuple[str, Screen, int]] = [
        ("more particles, tested in the same way", search.screen, len(base.tests))
    ]
    library = {name: search.library[name] for name in members}
    for plan in menu(points):
        planned = planned_base(base, plan)
        options.append((plan.name, first_order(planned, library), len(planned.tests)))
    found = []
    for text, other, count in options:
        tried = [n for n in (round(c * count) for c in COPIES) if 0 < n <= MOST_PARTICLES] or [count]
        powers = [_power(search, members, other, n / count) for n in tried]
        enough = [k for k, p in enumerate(powers) if p >= ENOUGH]
        k = enough[0] if enough else len(tried) - 1
        if powers[k] >= EVEN:
            found.append({"experiment": text, "separates": members, "particles": tried[k], "power": powers[k]})
    found.sort(key=lambda one: (-min(one["power"], ENOUGH), one["particles"]))
    return found


def _power(search: Search, members: list[str], other: Screen, copies: float) -> float:
    """Least probability over the true names that further tests leave it alone."""
    assert search.screen is not None
    needed = np.log(DECISIONS.set_mass / (1 - DECISIONS.set_mass))
    at: dict[str, int] = {}
    amplitude: dict[str, float] = {}
    information = search.screen.information
    for name in members:
        best = search.found[(name,)].at
        assert best is not None
        variant = best.variants[0]
        family = [(information[k], k) for k, c in enumerate(search.screen.candidates) if c.variant == variant]
        candidate = search.screen.candidates[max(family)[1]]
        if candidate not in other.candidates:
            return 0.0
        at[name] = other.candidates.index(candidate)
        amplitude[name] = float(best.theta[0]) / variant.plausible[0]
    worst = 1.0
    new = other.settings[0].gram
    for name in members:
        for rival in members:
            if rival == name:
                continue
            lead = search.found[(name,)].log_evidence - search.found[(rival,)].log_evidence
            i, j = at[name], at[rival]
            total = copies * new[np.ix_([i, j], [i, j])]
            left = total[0, 0] - total[0, 1] ** 2 / max(total[1, 1], 1e-300)
            squares = float(amplitude[name] ** 2 * max(left, 0.0))
            worst = min(worst, float(ndtr((squares / 2 + lead - needed) / np.sqrt(max(squares, 1e-12)))))
    return worst
