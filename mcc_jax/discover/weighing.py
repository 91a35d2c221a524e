"""Prior odds of hypotheses, and with their log evidence the probability of each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .hypothesis import UNLISTED, Hypothesis, Names
from .settings import DECISIONS


def log_posteriors(found: Mapping[Names, Hypothesis], count: int) -> dict[Names, float]:
    """Log evidence and log prior of every hypothesis that may be named, best first: pairs lead by the margin.

    Args:
        found: hypotheses by their names.
        count: mechanisms that are searched for.
    """
    return _that_may_be_named(_log_joints(found, count))


def posterior(found: Mapping[Names, Hypothesis], count: int) -> dict[Names, float]:
    """Probability of every hypothesis, most probable first.

    The margin is for second names, which what a first one misses invites. Two names in place of the one that would be
    named are no such invitation: they count by their prior odds, and make the answer a set.

    Args:
        found: hypotheses by their names.
        count: mechanisms that are searched for.
    """
    joints = _log_joints(found, count)
    logs = _that_may_be_named(joints)
    leader = next(iter(logs))
    if len(leader) == 1 and leader != UNLISTED:
        logs |= {n: v for n, v in joints.items() if len(n) == 2 and leader[0] not in n}
    total = float(np.logaddexp.reduce(list(logs.values())))
    return {names: float(np.exp(v - total)) for names, v in _best_first(logs).items()}


def _log_joints(found: Mapping[Names, Hypothesis], count: int) -> dict[Names, float]:
    """Log evidence and log prior of every hypothesis; of pairs those with a second name of credible size."""
    logs = {}
    for names, one in found.items():
        prior = 0.0
        if names == UNLISTED:
            prior = -DECISIONS.unlisted
        elif len(names) == 1:
            prior = -np.log(count)
        elif len(names) == 2:
            prior = -DECISIONS.pair - np.log(count * (count - 1) / 2)
        logs[names] = one.log_evidence + prior
    for names, one in found.items():
        if len(names) == 1 and np.isfinite(one.beside):
            # Two causes, of which one is on no list: they count for the one that explains more by itself.
            both = one.beside + min(one.other_noise, 0.0) - np.log(2 * count) - DECISIONS.pair - DECISIONS.unlisted
            larger = names if logs[names] >= logs[UNLISTED] else UNLISTED
            logs[larger] = float(np.logaddexp(logs[larger], both))
    return {names: v for names, v in logs.items() if len(names) < 2 or _credible(found, names)}


def _that_may_be_named(logs: Mapping[Names, float]) -> dict[Names, float]:
    fewer = max(v for names, v in logs.items() if len(names) < 2)
    return _best_first({n: v for n, v in logs.items() if len(n) < 2 or v > fewer + DECISIONS.margin})


def _credible(found: Mapping[Names, Hypothesis], names: Names) -> bool:
    """Whether the name of a pair that explains less by itself has an amplitude that one would believe.

    What takes an amplitude beyond its largest plausible one imitates what the first name's formula misses.
    """
    r = found[names].formulas
    if r is None:
        return True
    second = min(names, key=lambda n: found[(n,)].log_evidence)
    sizes = zip(r.variants, r.theta, strict=False)
    return all(abs(size) <= v.plausible[1] for v, size in sizes if v.mechanism == second)


def _best_first(logs: Mapping[Names, float]) -> dict[Names, float]:
    """Hypotheses in the order of their log posteriors."""
    return dict(sorted(logs.items(), key=lambda item: -item[1]))
