"""The search through all hypotheses: nothing, one name, two names, or what is on no list."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from operator import call
from typing import Any

import numpy as np
from scipy.special import logsumexp

from .._types import Progress
from ..calibrate.compiling import side_by_side
from ..calibrate.model import Model
from ..effects import Mechanism, Variant
from .base import Base
from .candidates import Candidate
from .columns import with_amplitudes
from .design import at_priors
from .evidence import LinearModel, log_joint, with_little_noise
from .fit import Fitted, fit_hypothesis
from .hypothesis import UNLISTED, Hypothesis, Names, log_posteriors, posterior
from .likely_noise import noise_models, with_likely_noise, with_other_noise
from .misfit import coordinates, general, informative, scaled
from .misfit_form import Discrepancy, fit_with_misfit
from .random_effects import RandomEffects, random_amplitude, sudden_steps
from .screen import Screen, pair_integrals, screen, single_integrals, testable_columns
from .settings import CONTENDERS, DECISIONS, STRONG, VERY_STRONG

FORMULAS, ALL_FORMULAS = 2, 8  # of each contender that are fitted where one is `VERY_STRONG`, and of the leading two
SECONDS = 3  # second names tried next to each of the two leading ones, and pairs that lead to first order


class Search:
    """One search: what all hypotheses share, and what was found."""

    def __init__(
        self,
        base: Base,
        library: Mapping[str, Mechanism],
        progress: Progress = lambda _: None,
        *,
        whole: Mapping[str, Mechanism] | None = None,
    ) -> None:
        """Fit the law alone.

        Args:
            base: the tests.
            library: mechanisms that are searched for, with the formulas that the tests can distinguish.
            progress: called with the name of each step.
            whole: the library with the formulas that the tests cannot distinguish.
        """
        self.library, self.progress = library, progress
        base, start = with_likely_noise(base)
        self.base = base
        places = [base.state]
        if base.coarse:
            places += [at_priors(base, rows) for rows in (base.snaps, np.ones(len(base.tests), bool)) if rows.any()]
        self.null = max(
            (fit_hypothesis(base, at, (), np.zeros(0), start.hyper) for at in places), key=lambda r: r.log_evidence
        )
        # Hypotheses look for their optimum from the null's state; of a material that the law was not made for from the
        # priors' middle, too, since such tests have several optima.
        self.starts = [self.null.state, *places[1:][-1:]]
        each = base.each(coordinates, self.null.state.point, base.forms, self.null.state.population[0])
        natural = {k: np.asarray(x) for k, x in each.items()}
        self.natural = informative(natural, np.asarray(base.tests.mask))  # coordinates of all points
        self.at = scaled(self.natural, np.asarray(base.tests.mask))  # the same between 0 and 1
        self.shared = {
            name: m for name, m in library.items() if not m.sudden and not any(v.random_per_test for v in m.variants)
        }
        self.candidates, self.columns = testable_columns(base, self.null.state, whole or library, library)
        self.screen = self.screened(self.shared) if self.shared else None
        self.small = with_little_noise(self.null.optimum.hyper)
        self.fits: dict[tuple[int, ...], Fitted] = {}  # by the rows of the candidates in `screen`
        self.found: dict[Names, Hypothesis] = {(): Hypothesis((), self.null.log_evidence, at=self.null)}

    def formulas_of(self, mechanisms: Collection[str]) -> tuple[tuple[Candidate, ...], np.ndarray]:
        """The formulas of some mechanisms, and their signatures."""
        rows = [k for k, c in enumerate(self.candidates) if c.mechanism in mechanisms]
        return tuple(self.candidates[k] for k in rows), self.columns[..., np.array(rows, int)]

    def screened(self, mechanisms: Collection[str], *, several: bool = True) -> Screen:
        """Some mechanisms to first order, around the base law."""
        return screen(
            self.base, self.null.state, self.null.optimum.hyper, *self.formulas_of(mechanisms), several=several
        )

    # ---- posterior ---------------------------------------------------------------------------------------------------

    def log_posteriors(self) -> dict[Names, float]:
        """Log evidence and log prior of every hypothesis that may be named, best first."""
        return log_posteriors(self.found, len(self.library))

    def posterior(self) -> dict[Names, float]:
        """Probability of every hypothesis, most probable first."""
        return posterior(self.found, len(self.library))

    # ---- one name ----------------------------------------------------------------------------------------------------

    @cached_property
    def first_order(self) -> dict[str, dict[str, tuple[float, int]]]:
        """Log evidence to first order of every formula of every mechanism, and its best candidate."""
        if self.screen is None:
            return {}
        value, _ = self.screen.singles()
        value = value - self.screen.null + self.null.log_evidence
        found: dict[str, dict[str, list[int]]] = {}
        for k, c in enumerate(self.screen.candidates):
            found.setdefault(c.mechanism, {}).setdefault(c.variant.name, []).append(k)
        return {
            m: {
                f: (float(logsumexp(value[ks]) - np.log(len(ks))), ks[int(np.argmax(value[ks]))])
                for f, ks in formulas.items()
            }
            for m, formulas in found.items()
        }

    def fit(self, ks: tuple[int, ...]) -> Fitted:
        """Some candidates together at their own optimum, by their formulas."""
        if ks not in self.fits:
            starts = self.starts
            if self.base.coarse and len(ks) > 1:  # from where the names alone have been found
                starts = [self.fits[(k,)].state for k in ks if (k,) in self.fits][:1] or starts[:1]
            fits = (fit_hypothesis(self.base, at, *self.start_of(ks), self.small) for at in starts)
            self.fits[ks] = max(fits, key=lambda r: r.log_evidence)
        return self.fits[ks]

    def fitted_as(self, r: Fitted) -> tuple[int, ...]:
        """The candidates that were fitted together."""
        return next(ks for ks, one in self.fits.items() if one is r)

    def start_of(self, ks: tuple[int, ...]) -> tuple[tuple[Variant, ...], np.ndarray]:
        """The formulas of some candidates, and where their numbers are linearised first."""
        assert self.screen is not None
        cs = [self.screen.candidates[k] for k in ks]
        numbers = [0.0] * len(cs) + [c.nuisance[n.name] for c in cs for n in c.variant.nuisances]
        return tuple(c.variant for c in cs), np.array(numbers)

    def best_first(self, mechanism: str) -> list[tuple[str, tuple[float, int]]]:
        """The formulas of a mechanism as in `first_order`, best first."""
        return sorted(self.first_order[mechanism].items(), key=lambda item: -item[1][0])

    def fit_singles(self, mechanisms: Sequence[str], most: int) -> None:
        """Some mechanisms: the best formulas of each at their own optimum, the others as they are to first order."""
        side_by_side(self.fit, [(k,) for m in mechanisms for _, (_, k) in self.best_first(m)[:most]])
        for mechanism in mechanisms:
            ordered = self.best_first(mechanism)
            fits = [self.fit((k,)) for _, (_, k) in ordered[:most]]
            values = [r.log_evidence for r in fits]
            row = int(np.argmax(values))
            gain = min(values[row] - ordered[row][1][0], 0.0)
            values += [min(first + gain, values[row]) for _, (first, _) in ordered[most:]]
            total = float(logsumexp(values) - np.log(len(values)))
            self.found[(mechanism,)] = Hypothesis((mechanism,), total, at=fits[row])

    def signatures_of(self, mechanism: str) -> dict[str, np.ndarray]:
        """The best signature of every formula of a mechanism that all tests share."""
        if self.screen is None:
            return {}
        return {f: self.screen.columns[..., k] for f, (_, k) in self.first_order.get(mechanism, {}).items()}

    def fit_misfit(self, one: Hypothesis) -> None:
        """Log evidence where every name's formula may be wrong."""
        one.misfit, one.with_misfit = fit_with_misfit(self.base, one, self.at, self.signatures_of, self.library)

    @cached_property
    def discrepancy(self) -> Discrepancy:
        """Functions of what no mechanism explains."""
        functions, group = general(self.at, self.base.tests, self.null.design.linear)
        return Discrepancy(functions, group, float(self.null.optimum.hyper[0]))

    def fit_discrepancy(self, leader: Hypothesis, at_least: float) -> None:
        """Log evidence of a name with a smooth discrepancy in addition, where it comes near that of another."""
        assert leader.at is not None
        found = self.discrepancy.added_to(self.base, leader.at, at_least)
        if found is not None:
            leader.with_discrepancy = found.log_evidence

    # ---- two names ---------------------------------------------------------------------------------------------------

    def seconds(self, at: Fitted, first: Variant) -> list[tuple[float, int]]:
        """Gain in log evidence and row of candidates next to a fitted name, to first order around it, best first."""
        assert self.screen is not None
        cs = self.screen.candidates
        # The first name's amplitude; sudden steps have none that all tests share.
        column = np.concatenate([at.design.amplitude, np.zeros((*at.design.data.shape, 1))], -1)[..., :1]
        every = np.concatenate([column, self.screen.columns], -1)
        shared = LinearModel(at.optimum.hyper, with_amplitudes(at.design, every)).shared()
        signs = np.append(first.sign, self.screen.signs)
        largest = np.append(first.plausible[1] / first.plausible[0], self.screen.largest)
        alone, _ = single_integrals(shared.score[:1], np.diagonal(shared.information)[:1], signs[:1], largest[:1])
        b = np.arange(1, len(signs))
        both = pair_integrals(shared.information, shared.score, np.zeros(len(b), int), b, signs, largest)
        value = both - alone[0]
        return [
            (float(value[k]), int(k))
            for k in np.argsort(-value)
            if cs[k].mechanism not in (first.mechanism, self.library[first.mechanism].opposite)
        ]

    def pairs_with(self, leader: Hypothesis) -> None:
        """The best second names next to a leader, each fitted together with it."""
        (name,), own, at = leader.names, leader.own, leader.at
        assert self.screen is not None
        assert at is not None
        seconds: dict[Names, int] = {}
        for gain, k in self.seconds(at, at.variants[0] if own is None else own.variant):
            if gain < 0 or len(seconds) >= SECONDS:
                break
            seconds.setdefault(pair_of(name, self.screen.candidates[k].mechanism), k)
        if own is None:
            (first,) = self.fitted_as(at)
            pairs = self.fit_pairs({names: (first, k) for names, k in seconds.items()})
            further = [pair_of(m, name) for m in self.not_shared]
            ones = side_by_side(lambda m: self.of_their_own(m, at), self.not_shared)
        else:
            pairs, further = [], list(seconds)
            ones = side_by_side(
                lambda k: own.next_to(self.base, self.null.state, *self.start_of((k,)), self.small), seconds.values()
            )
        for names, one in zip(further, ones, strict=True):
            self.keep(names, one)
        self.fit_misfits(pairs + further, leader)

    def leading_pairs(self) -> dict[Names, tuple[int, ...]]:
        """The leading pairs of names to first order around the base law, each by its best candidates.

        Of two strong effects neither need lead by itself: what imitates part of both may. A pair that does not lead
        every single name by the margin there is left out.
        """
        assert self.screen is not None
        a, b, value = self.screen.pairs()
        least = self.screen.singles()[0].max() + DECISIONS.margin
        found: dict[Names, tuple[int, ...]] = {}
        for k in np.argsort(-value):
            if value[k] < least or len(found) >= SECONDS:
                break
            names = pair_of(*(self.screen.candidates[j[k]].mechanism for j in (a, b)))
            if self.library[names[0]].opposite != names[1]:
                found.setdefault(names, (int(a[k]), int(b[k])))
        return found

    def fit_pairs(self, tried: Mapping[Names, tuple[int, ...]]) -> list[Names]:
        """Pairs of candidates at their own optimum, but for those that are known already; which ones these are."""
        new = [names for names in tried if names not in self.found]
        for names, at in zip(new, side_by_side(self.fit, [tried[names] for names in new]), strict=True):
            self.found[names] = Hypothesis(names, at.log_evidence - self.log_combinations(names), at=at)
        return new

    def fit_misfits(self, pairs: Sequence[Names], leader: Hypothesis) -> None:
        """The formulas of a pair may be wrong, too, where it explains more than the leader alone."""
        better = [self.found[names] for names in pairs if self.found[names].alone > leader.alone]
        side_by_side(self.fit_misfit, [pair for pair in better if not np.isfinite(pair.with_misfit)])

    def other_formulas(self, pair: Hypothesis) -> None:
        """A pair by the other formulas of either name, each next to the best of the other, at their own optimum."""
        assert pair.at is not None
        assert self.screen is not None
        fitted = self.fitted_as(pair.at)
        wanted = []
        for k, other in (fitted, fitted[::-1]):
            mechanism = self.screen.candidates[other].mechanism
            single = self.fit((k,))
            tried = {self.screen.candidates[other].variant.name}
            for _, j in self.seconds(single, single.variants[0]):
                c = self.screen.candidates[j]
                if c.mechanism == mechanism and c.variant.name not in tried and len(tried) < ALL_FORMULAS:
                    tried.add(c.variant.name)
                    wanted.append((k, j))
        every = [pair.at, *side_by_side(self.fit, wanted)]
        pair.at = max(every, key=lambda r: r.log_evidence)
        pair.alone = float(np.logaddexp.reduce([r.log_evidence for r in every])) - self.log_combinations(pair.names)
        if pair.at is not every[0]:
            self.fit_misfit(pair)

    def log_combinations(self, names: Names) -> float:
        """Log number of ways in which formulas of some mechanisms go together: each is as probable, a priori."""
        return float(np.sum(np.log([len(self.first_order[m]) for m in names])))

    def keep(self, names: Names, own: RandomEffects | None) -> None:
        """A hypothesis with numbers of every test's own, if it is the best of its names."""
        value = -np.inf
        if own is not None:  # next to them one formula of several, each as probable a priori
            value = own.log_evidence - self.log_combinations(tuple(m for m in names if m in self.first_order))
            own = replace(own, log_evidence=value)
        if names not in self.found or value > self.found[names].alone:
            self.found[names] = Hypothesis(names, value, at=None if own is None else own.at, own=own)

    # ---- all of it ---------------------------------------------------------------------------------------------------

    def run(self) -> Search:
        """Work all hypotheses out."""
        nothing = self.null.log_evidence
        order = self.first_order
        rank = {m: float(logsumexp([v for v, _ in f.values()]) - np.log(len(f))) for m, f in order.items()}
        names = sorted(rank, key=lambda m: -rank[m])
        strong = bool(names) and rank[names[0]] - nothing > STRONG
        self.progress("the serious names, fitted as they are")
        serious = names[:CONTENDERS]
        each = FORMULAS if names and rank[names[0]] - nothing > VERY_STRONG else 1
        self.fit_singles(serious, each)
        if strong:
            best = sorted(self.found.values(), key=lambda x: -x.log_evidence)[:2]
            self.fit_singles([one.names[0] for one in best if one.names], ALL_FORMULAS)
        side_by_side(self.fit_misfit, [self.found[(m,)] for m in serious])
        for m in names[CONTENDERS:]:
            self.found[(m,)] = Hypothesis((m,), rank[m])
        self.progress("what differs from test to test, and a discrepancy on no list")
        tasks: list[Callable[[], Any]] = [partial(self.discrepancy.added_to, self.base, self.null)]
        tasks += [partial(self.of_their_own, m, self.null) for m in self.not_shared]
        smooth, *ones = side_by_side(call, tasks)
        for m, one in zip(self.not_shared, ones, strict=True):
            self.keep((m,), one)
        alone = [self.found[m,] for m in self.not_shared]
        side_by_side(self.fit_misfit, [x for x in alone if x.own is not None and not x.own.jumps])
        leaders = [x for x in self.found.values() if x.names and x.own is None and x.at is not None]
        self.found[UNLISTED] = Hypothesis(UNLISTED, smooth.log_evidence, at=smooth)
        most = max(x.log_evidence for x in self.found.values())
        if leaders and most - nothing > STRONG:
            self.progress("two names")
            leading = sorted(leaders, key=lambda x: -x.alone)[:2]
            tasks = [partial(self.pairs_of, leading), *(partial(self.fit_discrepancy, x, most) for x in leading)]
            side_by_side(call, tasks)
            first = max((x for x in self.found.values() if len(x.names) == 1), key=lambda x: x.log_evidence)
            if first.own is not None:
                self.pairs_with(first)
            pairs = [x for x in self.found.values() if len(x.names) == 2 and x.at is not None and x.own is None]
            pairs = [pair for pair in pairs if pair.log_evidence > first.log_evidence]
            for pair in sorted(pairs, key=lambda x: -x.log_evidence)[:2]:
                self.other_formulas(pair)
        self.progress("other kinds of noise")
        self.other_noise()
        return self

    def pairs_of(self, leaders: Sequence[Hypothesis]) -> None:
        """The best second names next to each of some leaders, and what leads of all pairs to first order."""
        for leader in leaders:
            self.pairs_with(leader)
        self.fit_misfits(self.fit_pairs(self.leading_pairs()), leaders[0])

    @property
    def not_shared(self) -> list[str]:
        """The mechanisms whose numbers differ from test to test."""
        return [m for m in self.library if m not in self.shared]

    def of_their_own(self, name: str, start: Fitted) -> RandomEffects | None:
        """A mechanism whose numbers differ from test to test, in addition to what is there at the start."""
        if self.library[name].sudden:
            return sudden_steps(self.base, start, self.library[name].variants[0])
        candidates, columns = self.formulas_of({name})
        return random_amplitude(self.base, start, columns, candidates)

    def other_noise(self) -> None:
        """Average the leading hypotheses over kinds of noise, if another kind may explain the gap or a second name."""
        logs = self.log_posteriors()
        leader = next(iter(logs))
        if not leader:
            return
        kinds = noise_models(self.base)
        gains: dict[Names, list[float]] = {(): self.gains_by_noise(self.found[()], kinds)}
        wanted = list(logs)[:SECONDS]
        if len(leader) == 2:
            wanted += [names for names in logs if len(names) == 1][:SECONDS]
        elif logs[()] + max(gains[()]) < logs[leader] - STRONG:
            return
        for names in wanted:
            if names not in gains and self.found[names].at is not None:
                gains[names] = self.gains_by_noise(self.found[names], kinds)
        for names, one in self.found.items():
            # What was not worked out counts as if no other kind explained it better.
            one.other_noise = float(logsumexp([0.0, *gains.get(names, ())]) - np.log(1 + len(kinds)))

    def gains_by_noise(self, one: Hypothesis, models: tuple[Model, ...]) -> list[float]:
        """What a hypothesis in its likelier form gains under other kinds of noise; the best is kept, if it gains.

        The law alone keeps the noise of the search.
        """
        hyper, design = one.likely_form()
        own = log_joint(hyper, design)
        found = [with_other_noise(design, hyper, model) for model in models]
        best, model = max(zip(found, models, strict=True), key=lambda pair: pair[0].log_joint)
        if one.names and best.log_joint > own:
            one.under_other_noise = model, best.hyper
        return [other.log_joint - own for other in found]


def pair_of(one: str, other: str) -> Names:
    """Two names in their order."""
    first, second = sorted((one, other))
    return first, second
