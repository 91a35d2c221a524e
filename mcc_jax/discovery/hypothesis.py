"""What may be missing: hypotheses with their log evidence, prior odds, and the probability of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..calibrate.model import Model
from .columns import Design, with_noise
from .fit import Fitted
from .random_effects import RandomEffects
from .settings import DECISIONS

Names = tuple[str, ...]
UNLISTED: Names = ("UNLISTED",)


@dataclass
class Hypothesis:
    """What may be missing: a law with it at its optimum, and the log evidence of its several forms."""

    names: Names  # of the mechanisms; none for nothing, `UNLISTED` for a discrepancy that none explains
    alone: float = -np.inf  # log evidence by formulas of the library alone
    with_misfit: float = -np.inf  # where the formulas may be wrong
    with_discrepancy: float = -np.inf  # with a smooth discrepancy in addition
    at: Fitted | None = None  # the best formulas at their optimum; None where they are known to first order alone
    own: RandomEffects | None = None  # numbers of every test's own, which are part of `at`
    misfit: tuple[np.ndarray, Design] | None = None  # hyperparameters at their mode, and design, with the misfit
    other_noise: float = 0.0  # what averaging over other kinds of noise adds to the log evidence
    under_other_noise: tuple[Model, np.ndarray] | None = None  # a kind that the tests prefer, hyperparameters there

    @property
    def log_evidence(self) -> float:
        """Log marginal likelihood, averaged over its formulas alone and with their misfit."""
        if not self.names or self.names == UNLISTED or (self.own is not None and not np.isfinite(self.with_misfit)):
            return self.alone + self.other_noise
        return float(np.logaddexp(self.alone, self.with_misfit) - np.log(2)) + self.other_noise

    @property
    def is_off(self) -> bool:
        """Whether the tests prefer its formulas with a misfit."""
        return self.with_misfit > self.alone

    @property
    def sizes(self) -> tuple[float, ...]:
        """How far the formulas are off, as shares of the effects: scales that follow the other hyperparameters."""
        if self.misfit is None or self.at is None:
            return ()
        hyper, design = self.misfit
        logs = hyper[len(self.at.optimum.hyper) + len(self.at.variants) :] - design.misfits[:, 0]
        return tuple(float(x) for x in DECISIONS.misfit * np.exp(logs))

    def likely_form(self, *, misfit: bool = True) -> tuple[np.ndarray, Design]:
        """Hyperparameters at their mode, and design, under the kind of noise that the tests prefer.

        They are those with its `misfit`, if the tests prefer that, too; without, noise is that of the likelier form.
        """
        assert self.at is not None
        hyper, design = self.at.optimum.hyper, self.at.design
        if misfit and self.is_off and self.misfit is not None:
            hyper, design = self.misfit
        if self.under_other_noise is not None:
            model, other = self.under_other_noise
            hyper, design = other[: len(hyper)], with_noise(design, model)
        return hyper, design


def log_posteriors(found: Mapping[Names, Hypothesis], count: int) -> dict[Names, float]:
    """Log evidence and log prior of every hypothesis that may be named, best first: pairs lead by the margin.

    `count` is the number of mechanisms that are searched for.
    """
    return _that_may_be_named(_log_joints(found, count))


def posterior(found: Mapping[Names, Hypothesis], count: int) -> dict[Names, float]:
    """Probability of every hypothesis, most probable first, of `count` mechanisms.

    The margin is for second names, which what a first one misses invites. Two names in place of the one that would be
    named are no such invitation: they count by their prior odds, and make the answer a set.
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
    priors = {0: 0.0, 1: -np.log(count), 2: -DECISIONS.pair - np.log(max(count * (count - 1) / 2, 1))}
    logs = {
        n: one.log_evidence + (-DECISIONS.unlisted if n == UNLISTED else priors[len(n)]) for n, one in found.items()
    }
    for names, one in found.items():
        if len(names) == 1 and np.isfinite(one.with_discrepancy):
            # Two causes, of which one is on no list: they count for the one that explains more by itself.
            both = one.with_discrepancy + min(one.other_noise, 0.0) - np.log(2 * count)
            larger = names if logs[names] >= logs[UNLISTED] else UNLISTED
            logs[larger] = float(np.logaddexp(logs[larger], both - DECISIONS.pair - DECISIONS.unlisted))
    return {names: v for names, v in logs.items() if len(names) < 2 or _credible(found, names)}


def _that_may_be_named(logs: Mapping[Names, float]) -> dict[Names, float]:
    fewer = max(v for names, v in logs.items() if len(names) < 2)
    return _best_first({n: v for n, v in logs.items() if len(n) < 2 or v > fewer + DECISIONS.margin})


def _credible(found: Mapping[Names, Hypothesis], names: Names) -> bool:
    """Whether the name of a pair that explains less by itself has an amplitude that one would believe.

    What takes an amplitude beyond its largest plausible one imitates what the first name's formula misses.
    """
    r = found[names].at
    if r is None:
        return True
    second = min(names, key=lambda n: found[(n,)].log_evidence)
    sizes = zip(r.variants, r.theta, strict=False)
    return all(abs(size) <= v.plausible[1] for v, size in sizes if v.mechanism == second)


def _best_first(logs: Mapping[Names, float]) -> dict[Names, float]:
    return dict(sorted(logs.items(), key=lambda item: -item[1]))
