"""The search through all hypotheses: nothing, one name, two names, or what is on no list."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from operator import call
from typing import Any, NamedTuple

import numpy as np
from scipy.special import logsumexp

from ..calibrate.compiling import side_by_side
from ..calibrate.model import Model
from ..effects import Mechanism, Variant
from .base import Base, State
from .candidates import Candidate
from .columns import with_amplitudes
from .design import at_priors
from .evidence import left_by_particle, log_joint, with_little_noise, without_first
from .hypothesis import UNLISTED, Hypothesis, Names
from .likely_noise import noise_models, with_likely_noise, with_other_noise
from .misfit import coordinates, general, scaled, telling
from .misfit_form import Discrepancy, fit_with_misfit
from .own_numbers import OwnNumbers, differing, sudden_steps
from .refine import Refined, refined
from .screen import Screen, Setting, pair_integrals, screen, single_integrals, testable_columns
from .settings import CONTENDERS, DECISIONS, STRONG, VERY_STRONG
from .weighing import log_posteriors, posterior

FORMULAS, ALL_FORMULAS = 2, 8  # of each contender that are fitted where one is `VERY_STRONG`, and of the leading two
SECONDS = 3  # second names tried next to each of the two leading ones, and pairs that lead to first order


class Search:
    """One search: what all hypotheses share, and what was found.

    Attributes:
        base: the tests.
        library: mechanisms that are searched for, with the formulas that the tests can tell.
        null: the base law at its optimum.
        starts: states from which hypotheses look for their optimum: the null's, and of a material that the law was not
            made for the priors' middle, too, since such tests have several optima.
        natural, at: coordinates of all points, in natural units and between 0 and 1.
        candidates, columns: all formulas and their signatures, in units of their smallest plausible amplitudes.
        screen: those that all tests share, to first order.
        found: hypotheses by their names.
    """

    def __init__(
        self,
        base: Base,
        library: Mapping[str, Mechanism],
        tell: Callable[[str], None] = lambda _: None,
        *,
        whole: Mapping[str, Mechanism] | None = None,
    ) -> None:
        """Fit the law alone; `whole` has the formulas, too, that the tests cannot tell."""
        self.library, self.tell = library, tell
        base, start = with_likely_noise(base)
        self.base = base
        places = [base.state]
        if base.coarse:
            places += [at_priors(base, rows) for rows in (base.snaps, np.ones(len(base.tests), bool)) if rows.any()]
        self.null = max((refined(base, at, (), np.zeros(0), start.free) for at in places), key=lambda r: r.log_evidence)
        self.starts = [self.null.state, *places[1:][-1:]]
        each = base.each(coordinates, self.state.point, base.forms, self.state.population[0])
        natural = {k: np.asarray(x) for k, x in each.items()}
        self.natural = telling(natural, np.asarray(base.tests.mask))
        self.at = scaled(self.natural, np.asarray(base.tests.mask))
        self.shared = {
            name: m for name, m in library.items() if not m.sudden and not any(v.random_per_test for v in m.variants)
        }
        self.candidates, self.columns = testable_columns(base, self.state, whole or library, library)
        self.screen = self.screened(self.shared) if self.shared else None
        self.small = with_little_noise(self.null.optimum.free)
        self.fits: dict[tuple[int, ...], Refined] = {}
        self.found: dict[Names, Hypothesis] = {(): Hypothesis((), self.null.log_evidence, best=self.null)}

    @property
    def state(self) -> State:
        """Where the base law fits."""
        return self.null.state

    def formulas_of(self, mechanisms: Collection[str]) -> tuple[tuple[Candidate, ...], np.ndarray]:
        """The formulas of some mechanisms, and their signatures."""
        rows = [k for k, c in enumerate(self.candidates) if c.mechanism in mechanisms]
        return tuple(self.candidates[k] for k in rows), self.columns[..., np.array(rows)]

    def screened(self, mechanisms: Collection[str], *, several: bool = True) -> Screen:
        """Some mechanisms to first order, around the base law."""
        return screen(self.base, self.state, self.null.optimum.free, *self.formulas_of(mechanisms), several=several)

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

    def fit(self, ks: tuple[int, ...]) -> Refined:
        """Some candidates together at their own optimum, by their formulas."""
        if ks not in self.fits:
            starts = self.starts
            if self.base.coarse and len(ks) > 1:  # from where the names alone have been found
                starts = [self.fits[(k,)].state for k in ks if (k,) in self.fits][:1] or starts[:1]
            fits = (refined(self.base, at, *self.start_of(ks), self.small) for at in starts)
            self.fits[ks] = max(fits, key=lambda r: r.log_evidence)
        return self.fits[ks]

    def fitted_as(self, r: Refined) -> tuple[int, ...]:
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

    def fit_ahead(self, mechanisms: Sequence[str], most: int) -> None:
        """Fit the best formulas of some mechanisms, as many at once as there are cores."""
        side_by_side(self.fit, [(k,) for m in mechanisms for _, (_, k) in self.best_first(m)[:most]])

    def single(self, mechanism: str, most: int) -> None:
        """One mechanism: its best formulas fitted at their own optimum, the others as they are to first order."""
        ordered = self.best_first(mechanism)
        values: dict[str, float] = {}
        best, gain = None, 0.0
        for f, (first, k) in ordered[:most]:
            r = self.fit((k,))
            values[f] = r.log_evidence
            if best is None or r.log_evidence > best.log_evidence:
                best, gain = r, r.log_evidence - first
        assert best is not None
        for f, (first, _) in ordered[most:]:
            values[f] = min(first + min(gain, 0.0), best.log_evidence)
        total = float(logsumexp(list(values.values())) - np.log(len(values)))
        self.found[(mechanism,)] = Hypothesis((mechanism,), total, best=best)

    def signatures_of(self, mechanism: str) -> dict[str, np.ndarray]:
        """The best signature of every formula of a mechanism that all tests share."""
        if self.screen is None:
            return {}
        return {f: self.screen.columns[..., k] for f, (_, k) in self.first_order.get(mechanism, {}).items()}

    def with_misfit(self, one: Hypothesis) -> None:
        """Log evidence where every name's formula may be wrong."""
        one.misfit_form, one.with_misfit = fit_with_misfit(self.base, one, self.at, self.signatures_of, self.library)

    @cached_property
    def discrepancy(self) -> Discrepancy:
        """Functions of what no mechanism explains."""
        functions, group = general(self.at, self.base.tests, self.null.design.linear)
        return Discrepancy(functions, group, float(self.null.optimum.free[0]))

    def with_discrepancy(self, leader: Hypothesis, at_least: float) -> None:
        """Log evidence of a name with a smooth discrepancy beside it, where it comes near that of another."""
        assert leader.best is not None
        found = self.discrepancy.beside(self.base, leader.best, at_least)
        if found is not None:
            leader.beside = found.at.log_evidence

    # ---- two names ---------------------------------------------------------------------------------------------------

    def seconds(self, at: Refined, first: Variant, column: np.ndarray) -> list[tuple[float, int]]:
        """Candidates beside a name, to first order around its optimum, best first.

        Args:
            at: the name at its optimum.
            first: its formula.
            column: of its amplitude.
        """
        assert self.screen is not None
        cs = self.screen.candidates
        every = np.concatenate([column, self.screen.columns], -1)
        left, _ = left_by_particle(at.optimum.free, with_amplitudes(at.design, every))
        total, _ = without_first(left.sum(0), at.design.common.shape[-1])
        s = Setting(at.optimum.free, 0.0, total[:-1, :-1], total[:-1, -1])
        signs = np.append(first.sign, self.screen.signs)
        largest = np.append(first.plausible[1] / first.plausible[0], self.screen.largest)
        b = np.arange(1, len(signs))
        alone, _ = single_integrals(s.score[:1], np.diagonal(s.gram)[:1], signs[:1], largest[:1])
        value = pair_integrals(s, np.zeros(len(b), int), b, signs, largest) - alone[0]
        return [
            (float(value[k]), int(k))
            for k in np.argsort(-value)
            if cs[k].mechanism not in (first.mechanism, self.library[first.mechanism].opposite)
        ]

    def best_seconds(self, ordered: Sequence[tuple[float, int]], first: str) -> dict[Names, int]:
        """The best candidate of each of the best second names, and the two names together."""
        assert self.screen is not None
        tried: dict[Names, int] = {}
        for gain, k in ordered:
            if gain < 0 or len(tried) >= SECONDS:
                break
            tried.setdefault(pair_of(first, self.screen.candidates[k].mechanism), k)
        return tried

    def pairs_of(self, leader: Hypothesis) -> None:
        """The best second names beside a leader, each fitted together with it."""
        r = leader.best
        assert r is not None
        (first,) = self.fitted_as(r)
        seconds = self.seconds(r, r.variants[0], r.design.amplitude[..., :1])
        tried = {n: (first, k) for n, k in self.best_seconds(seconds, leader.names[0]).items() if n not in self.found}
        self.fit_pairs(tried)
        further = [pair_of(m, leader.names[0]) for m in self.not_shared]
        ones = side_by_side(lambda m: self.of_their_own(m, r), self.not_shared)
        for names, one in zip(further, ones, strict=True):
            self.keep(names, one)
        pairs = [self.found[names] for names in (*tried, *further)]
        side_by_side(lambda pair: self.with_misfit_if_better(pair, leader), pairs)

    def pairs_of_each(self, leaders: Sequence[Hypothesis]) -> None:
        """The best second names beside each of some leaders, and what leads of all pairs to first order."""
        for leader in leaders:
            self.pairs_of(leader)
        tried = {names: ks for names, ks in self.first_order_pairs().items() if names not in self.found}
        self.fit_pairs(tried)
        side_by_side(lambda names: self.with_misfit_if_better(self.found[names], leaders[0]), list(tried))

    def first_order_pairs(self) -> dict[Names, tuple[int, int]]:
        """The leading pairs of names to first order around the base law, each by its best candidates.

        Of two strong effects neither need lead by itself: what imitates part of both may. A pair that does not lead
        every single name by the margin there is left out.
        """
        assert self.screen is not None
        a, b, value = self.screen.pairs()
        least = self.screen.singles()[0].max() + DECISIONS.margin
        found: dict[Names, tuple[int, int]] = {}
        for k in np.argsort(-value):
            if value[k] < least:
                break
            names = pair_of(*(self.screen.candidates[j[k]].mechanism for j in (a, b)))
            if self.library[names[0]].opposite != names[1]:
                found.setdefault(names, (int(a[k]), int(b[k])))
            if len(found) >= SECONDS:
                break
        return found

    def fit_pairs(self, tried: Mapping[Names, tuple[int, int]]) -> None:
        """Pairs of candidates at their own optimum, as hypotheses."""
        side_by_side(self.fit, list(tried.values()))
        for names, ks in tried.items():
            alone = self.fit(ks).log_evidence - self.log_combinations(names)
            self.found[names] = Hypothesis(names, alone, best=self.fit(ks))

    def other_formulas(self, pair: Hypothesis) -> None:
        """A pair by the other formulas of either name, each beside the best of the other, at their own optimum."""
        assert pair.best is not None
        assert self.screen is not None
        held = self.fitted_as(pair.best)
        wanted = []
        for k, other in (held, held[::-1]):
            mechanism = self.screen.candidates[other].mechanism
            beside = self.fit((k,))
            tried = {self.screen.candidates[other].variant.name}
            for _, j in self.seconds(beside, beside.variants[0], beside.design.amplitude[..., :1]):
                c = self.screen.candidates[j]
                if c.mechanism == mechanism and c.variant.name not in tried and len(tried) < ALL_FORMULAS:
                    tried.add(c.variant.name)
                    wanted.append((k, j))
        every = [pair.best, *side_by_side(self.fit, wanted)]
        pair.best = max(every, key=lambda r: r.log_evidence)
        pair.alone = float(np.logaddexp.reduce([r.log_evidence for r in every])) - self.log_combinations(pair.names)
        if pair.best is not every[0]:
            self.with_misfit(pair)

    def log_combinations(self, names: Names) -> float:
        """Log number of ways in which formulas of some mechanisms go together: each is as probable, a priori."""
        return float(np.sum(np.log([len(self.first_order[m]) for m in names])))

    def pairs_of_their_own(self, leader: Hypothesis) -> None:
        """The best second names beside numbers that differ from test to test."""
        own = leader.own
        assert own is not None
        assert self.screen is not None
        # Sudden steps have no amplitude that all tests share.
        column = np.concatenate([own.at.design.amplitude, np.zeros((*own.at.design.data.shape, 1))], -1)[..., :1]
        seconds = self.best_seconds(self.seconds(own.at, own.variant, column), leader.names[0])

        def fit(k: int) -> OwnNumbers:
            return own.beside(self.base, self.state, *self.start_of((k,)), self.small)

        for names, one in zip(seconds, side_by_side(fit, seconds.values()), strict=True):
            self.keep(names, one)
            self.with_misfit_if_better(self.found[names], leader)

    def with_misfit_if_better(self, pair: Hypothesis, leader: Hypothesis) -> None:
        """The formulas of a pair may be wrong, too, where it explains more than the leader alone."""
        if pair.alone > leader.alone and not np.isfinite(pair.with_misfit):
            self.with_misfit(pair)

    def keep(self, names: Names, own: OwnNumbers | None) -> None:
        """A hypothesis with numbers of every test's own, if it is the best of its names."""
        value = -np.inf
        if own is not None:  # beside them one formula of several, each as probable a priori
            value = own.log_evidence - self.log_combinations(tuple(m for m in names if m in self.first_order))
            own = replace(own, log_evidence=value)
        if names not in self.found or value > self.found[names].alone:
            self.found[names] = Hypothesis(names, value, own=own)

    # ---- all of it ---------------------------------------------------------------------------------------------------

    def run(self) -> Search:
        """Work all hypotheses out."""
        nothing = self.null.log_evidence
        order = self.first_order
        rank = {m: float(logsumexp([v for v, _ in f.values()]) - np.log(len(f))) for m, f in order.items()}
        names = sorted(rank, key=lambda m: -rank[m])
        strong = bool(names) and rank[names[0]] - nothing > STRONG
        self.tell("the serious names, fitted as they are")
        serious = names[:CONTENDERS]
        each = FORMULAS if names and rank[names[0]] - nothing > VERY_STRONG else 1
        self.fit_ahead(serious, each)
        for m in serious:
            self.single(m, each)
        if strong:
            leading = [
                one.names[0] for one in sorted(self.found.values(), key=lambda x: -x.log_evidence)[:2] if one.names
            ]
            self.fit_ahead(leading, ALL_FORMULAS)
            for m in leading:
                self.single(m, ALL_FORMULAS)
        side_by_side(self.with_misfit, [self.found[(m,)] for m in serious])
        for m in names[CONTENDERS:]:
            self.found[(m,)] = Hypothesis((m,), rank[m])
        self.tell("what differs from test to test, and a discrepancy on no list")
        tasks: list[Callable[[], Any]] = [partial(self.discrepancy.beside, self.base, self.null)]
        tasks += [partial(self.of_their_own, m, self.null) for m in self.not_shared]
        smooth, *ones = side_by_side(call, tasks)
        for m, one in zip(self.not_shared, ones, strict=True):
            self.keep((m,), one)
        alone = [self.found[m,] for m in self.not_shared]
        side_by_side(self.with_misfit, [x for x in alone if x.own is not None and not x.own.jumps])
        self.found[UNLISTED] = Hypothesis(UNLISTED, smooth.at.log_evidence, smooth=smooth)
        leaders = sorted((x for x in self.found.values() if x.names and x.best is not None), key=lambda x: -x.alone)
        most = max(x.log_evidence for x in self.found.values())
        if leaders and most - nothing > STRONG:
            self.tell("two names")
            leading = leaders[:2]
            tasks = [partial(self.pairs_of_each, leading), *(partial(self.with_discrepancy, x, most) for x in leading)]
            side_by_side(call, tasks)
            first = max((x for x in self.found.values() if len(x.names) == 1), key=lambda x: x.log_evidence)
            if first.own is not None and self.screen is not None:
                self.pairs_of_their_own(first)
            pairs = [
                x for x in self.found.values() if len(x.names) == 2 and x.best and x.log_evidence > first.log_evidence
            ]
            for pair in sorted(pairs, key=lambda x: -x.log_evidence)[:2]:
                self.other_formulas(pair)
        self.tell("other kinds of noise")
        self.other_noise()
        return self

    @property
    def not_shared(self) -> list[str]:
        """The mechanisms whose numbers differ from test to test."""
        return [m for m in self.library if m not in self.shared]

    def of_their_own(self, name: str, start: Refined) -> OwnNumbers | None:
        """A mechanism whose numbers differ from test to test, beside what is there at the start."""
        if self.library[name].sudden:
            return sudden_steps(self.base, start, self.library[name].variants[0])
        candidates, columns = self.formulas_of({name})
        return differing(self.base, start, columns, candidates)

    def other_noise(self) -> None:
        """Average the leading hypotheses over kinds of noise, if another kind may explain the gap or a second name."""
        logs = self.log_posteriors()
        leader = next(iter(logs))
        if not leader:
            return
        kinds = noise_models(self.base)
        values: dict[Names, OtherNoise] = {(): self.by_noise((), kinds)}
        wanted = list(logs)[:SECONDS]
        if len(leader) == 2:
            wanted += [names for names in logs if len(names) == 1][:SECONDS]
        elif logs[()] + max(values[()].gains) < logs[leader] - STRONG:
            return
        for names in wanted:
            if names not in values and self.found[names].fitted is not None:
                values[names] = self.by_noise(names, kinds)
        for names, one in self.found.items():
            # What was not worked out counts as if no other kind explained it better.
            gains = values[names].gains if names in values else []
            one.other_noise = float(logsumexp([0.0, *gains]) - np.log(1 + len(kinds)))
            if names and names in values:  # the law alone keeps the noise of the search
                one.under_other_noise = values[names].best

    def by_noise(self, names: Names, models: tuple[Model, ...]) -> OtherNoise:
        """A hypothesis in its likelier form under other kinds of noise, of the same curvature."""
        design, free = self.found[names].likely_form()
        own = log_joint(free, design)
        found = [(with_other_noise(design, free, model), model) for model in models]
        best, model = max(found, key=lambda pair: pair[0].log_joint)
        return OtherNoise(
            [other.log_joint - own for other, _ in found], (model, best.free) if best.log_joint > own else None
        )


class OtherNoise(NamedTuple):
    """What other kinds of noise add to a log evidence; the best and the hyperparameters there, if it is better."""

    gains: list[float]
    best: tuple[Model, np.ndarray] | None


def pair_of(one: str, other: str) -> Names:
    """Two names in their order."""
    first, second = sorted((one, other))
    return first, second
