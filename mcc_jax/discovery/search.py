"""The search through all hypotheses: nothing, one name, two names, or what is on no list."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from operator import call
from typing import Any

import numpy as np
from scipy.special import logsumexp

from .._types import Progress
from ..calibrate.numpyro_model import Model
from ..calibrate.running import side_by_side
from ..campaign import Finding
from ..effects import Variant
from .base import Base, Library
from .evidence import LinearModel, log_joint, optimise, with_little_noise
from .fit import Fitted, at_priors, fit_hypothesis, noise_models, with_likely_noise, with_other_noise
from .hypothesis import Discrepancy, Hypothesis, Names, RandomEffects, fit_with_misfit, random_amplitude, sudden_steps
from .misfit import coordinates, functions, general, informative, misfit_columns, scaled
from .periods import periodograms
from .screen import Candidate, Screen, candidates_of, pair_integrals, screen, single_integrals, with_signatures
from .settings import CONTENDERS, DECISIONS, STRONG, UNLISTED, VERY_STRONG

FORMULAS, ALL_FORMULAS = 2, 8  # of each contender that are fitted where one is `VERY_STRONG`, and of the leading two
SECONDS = 3  # second names tried next to each of the two leading ones, and pairs that lead to first order


class Search:
    """One search: what all hypotheses share, and what was found."""

    def __init__(
        self, base: Base, library: Library, whole: Library, progress: Progress, noise: np.ndarray | None = None
    ) -> None:
        """Fit the law alone; `library` has what is searched for, `whole` also formulas that the tests cannot show, and
        `noise` the hyperparameters under the kind of noise of the base law, where that is settled."""
        start, self.noise = noise, noise
        if start is None:
            base, optimum = with_likely_noise(base)
            start = optimum.hyper
        self.base, self.library, self.whole, self.progress = base, library, whole, progress
        places = [base.state]
        if base.coarse:
            places += [at_priors(base, rows) for rows in (base.snaps, np.ones(len(base.tests), bool)) if rows.any()]
        fits = [fit_hypothesis(base, at, (), (), start) for at in places]
        self.null = max(fits, key=lambda r: r.log_evidence)
        # Hypotheses look for their optimum from the null's state; of a material that the law was not made for from the
        # priors' middle, too, since such tests have several optima.
        self.starts = [self.null.state, *places[1:][-1:]]
        each = base.each(coordinates, self.null.state.point, base.model.forms, self.null.state.population[0])
        mask = np.asarray(base.tests.mask)
        self.natural = informative({k: np.asarray(x) for k, x in each.items()}, mask)  # coordinates of all points
        self.at = scaled(self.natural, mask)  # the same between 0 and 1
        differ = {m for m in library if library[m].sudden or any(v.random_per_test for v in library[m].variants)}
        self.not_shared = {m: library[m] for m in library if m in differ}  # numbers differ from test to test
        self.shared = {m: library[m] for m in library if m not in differ}
        # Those of the whole library are computed: campaigns that can show different ones share what is compiled.
        self.candidates = with_signatures(base, self.null.state, candidates_of(whole)).of(library)
        self.screen = self.screened(self.shared)
        self.small = with_little_noise(self.null.optimum.hyper)
        self.fits: dict[tuple[int, ...], Fitted] = {}  # by the rows of the candidates in `screen`
        self.found: dict[Names, Hypothesis] = {(): Hypothesis((), self.null.log_evidence, at=self.null)}
        self.p_any = 1.0  # probability of so much evidence of anything by chance
        self.outliers = 0.0  # log evidence that outliers of the noise add to every hypothesis, at least
        self.untestable: list[dict[str, str]] = []  # mechanisms that these tests cannot show, and what they need
        self.left_out: list[Finding] = []  # which tests took no part, and why

    def screened(self, library: Library, *, several: bool = True) -> Screen:
        """Some mechanisms to first order, around the base law."""
        candidates = self.candidates.of(library)
        return screen(self.base, self.null.state, self.null.optimum.hyper, candidates, several=several)

    def log_posteriors(self) -> dict[Names, float]:
        """Log evidence and log prior of every hypothesis that may be named, best first: pairs lead by the margin."""
        logs = self._log_joints()
        fewer = max(v for names, v in logs.items() if len(names) < 2)
        return _best_first({n: v for n, v in logs.items() if len(n) < 2 or v > fewer + DECISIONS.margin})

    @property
    def leader(self) -> Names:
        """The most probable hypothesis by which something is missing."""
        return next(names for names in self.log_posteriors() if names)

    @property
    def is_gap(self) -> bool:
        """Whether anything is missing."""
        return self.p_any < DECISIONS.level and self.posterior()[()] < 0.5

    def posterior(self) -> dict[Names, float]:
        """Probability of every hypothesis, most probable first. The margin is for second names, which what a first one
        misses invites; two names in place of the leader count by their prior odds, and make the answer a set."""
        logs = self.log_posteriors()
        leader = next(iter(logs))
        if len(leader) == 1 and leader != UNLISTED:
            logs |= {n: v for n, v in self._log_joints().items() if len(n) == 2 and leader[0] not in n}
        total = float(np.logaddexp.reduce(list(logs.values())))
        return {names: float(np.exp(v - total)) for names, v in _best_first(logs).items()}

    def _log_joints(self) -> dict[Names, float]:
        """Log evidence and log prior of every hypothesis; of pairs those with a second name of credible size."""
        count = len(self.library)
        priors = {0: 0.0, 1: -np.log(count), 2: -DECISIONS.pair - np.log(max(count * (count - 1) / 2, 1))}
        logs = {names: one.log_evidence + priors[len(names)] for names, one in self.found.items()}
        if UNLISTED in logs:
            logs[UNLISTED] = self.found[UNLISTED].log_evidence - DECISIONS.unlisted
        alone = {n: v for n, v in logs.items() if len(n) < 2 or self._credible(n, self.found[n].at)}
        logs = dict(alone)
        for names in alone:
            one = self.found[names]
            if np.isfinite(one.with_discrepancy):
                # The names and a cause on no list: that counts for whichever explains more by itself.
                both = one.with_discrepancy + min(one.other_noise, self.outliers) + priors[len(names)]
                larger = names if alone[names] >= alone[UNLISTED] else UNLISTED
                both -= np.log(1 + len(names)) + DECISIONS.pair + DECISIONS.unlisted
                logs[larger] = float(np.logaddexp(logs[larger], both))
        return logs

    def _credible(self, names: Names, r: Fitted | None) -> bool:
        """Whether the lesser name of a pair has a plausible amplitude; a larger one imitates what the other misses."""
        if r is None:
            return True
        second = min(names, key=lambda n: self.found[(n,)].log_evidence)
        sizes = zip(r.variants, r.theta, strict=False)
        return all(abs(size) <= v.plausible[1] for v, size in sizes if v.mechanism == second)

    @cached_property
    def first_order(self) -> dict[str, dict[str, tuple[float, int]]]:
        """Log evidence to first order of every formula of every mechanism, and its best candidate."""
        value = self.screen.singles() - self.screen.log_null.max() + self.null.log_evidence
        rows: dict[tuple[str, str], list[int]] = {}
        for k, c in enumerate(self.screen.candidates.each):
            rows.setdefault((c.mechanism, c.variant.name), []).append(k)
        found: dict[str, dict[str, tuple[float, int]]] = {}
        for (mechanism, formula), ks in rows.items():
            log_evidence = float(logsumexp(value[ks]) - np.log(len(ks)))
            found.setdefault(mechanism, {})[formula] = log_evidence, ks[int(np.argmax(value[ks]))]
        return found

    def fit(self, ks: tuple[int, ...]) -> Fitted:
        """Some candidates together at their own optimum, by their formulas."""
        if ks not in self.fits:
            starts = self.starts
            if self.base.coarse and len(ks) > 1:  # from where the names alone have been found
                starts = [self.fits[(k,)].state for k in ks if (k,) in self.fits][:1] or starts[:1]
            fits = (fit_hypothesis(self.base, at, *self.start_of(ks), self.small) for at in starts)
            self.fits[ks] = max(fits, key=lambda r: r.log_evidence)
        return self.fits[ks]

    def start_of(self, ks: Sequence[int]) -> tuple[tuple[Variant, ...], list[float]]:
        """The formulas of some candidates, and where their numbers are linearised first."""
        cs = [self.screen.candidates.each[k] for k in ks]
        numbers = [0.0] * len(cs) + [c.nuisance[n.name] for c in cs for n in c.variant.nuisances]
        return tuple(c.variant for c in cs), numbers

    def fit_singles(self, mechanisms: Sequence[str], most: int) -> None:
        """Some mechanisms: the best formulas of each at their own optimum, the others as they are to first order."""
        firsts = {m: sorted(self.first_order[m].values(), key=lambda first: -first[0]) for m in mechanisms}
        side_by_side(self.fit, [(k,) for first in firsts.values() for _, k in first[:most]])
        for mechanism, first in firsts.items():
            fits = [self.fit((k,)) for _, k in first[:most]]
            values = [r.log_evidence for r in fits]
            row = int(np.argmax(values))
            gain = min(values[row] - first[row][0], 0.0)
            values += [min(value + gain, values[row]) for value, _ in first[most:]]
            total = float(logsumexp(values) - np.log(len(values)))
            self.found[(mechanism,)] = Hypothesis((mechanism,), total, at=fits[row])

    def fit_misfit(self, one: Hypothesis) -> None:
        """The form of a hypothesis where every name's formula may be wrong."""
        columns = self.screen.candidates.columns

        def columns_of(variant: Variant, curve: np.ndarray) -> np.ndarray:
            formulas = self.first_order.get(variant.mechanism, {})
            siblings = [columns[..., k] for name, (_, k) in formulas.items() if name != variant.name]
            smooth = functions(self.library[variant.mechanism].coordinates, self.at)
            return misfit_columns(curve, smooth, siblings)

        fit_with_misfit(self.base, one, columns_of)

    @cached_property
    def discrepancy(self) -> Discrepancy:
        """Functions of what no mechanism explains."""
        parts = general(self.at, self.base.tests, self.null.design.linear)
        periods, mask = periodograms(self.natural, self.null), np.asarray(self.base.tests.mask)
        sinusoids = (np.where(mask[..., None], one.columns(one.errors), 0.0) for one in periods)
        return Discrepancy(parts, float(self.null.optimum.hyper[0]), periods, tuple(sinusoids))

    def fit_discrepancy(self, one: Hypothesis, at_least: float) -> None:
        """Log evidence of names with a smooth discrepancy in addition, where it comes near that of another."""
        found = self.discrepancy.added_to(self.base, one.fitted, at_least)
        if found is not None:
            one.with_discrepancy = found.log_evidence

    def of_their_own(self, name: str, start: Fitted) -> RandomEffects | None:
        """A mechanism whose numbers differ from test to test, in addition to what is there at the start."""
        if self.library[name].sudden:
            return sudden_steps(self.base, start, self.library[name].variants[0])
        return random_amplitude(self.base, start, self.candidates.of({name: self.library[name]}))

    def seconds(self, at: Fitted, first: Variant) -> list[tuple[float, int, Candidate]]:
        """Candidates next to a fitted name, best first: gain in log evidence to first order around it, and row."""
        candidates = self.screen.candidates
        # The first name's amplitude; sudden steps have none that all tests share.
        column = np.concatenate([at.design.amplitude, np.zeros((*at.design.data.shape, 1))], -1)[..., :1]
        every = np.concatenate([column, candidates.columns], -1)
        shared = LinearModel(at.optimum.hyper, at.design.with_amplitudes(every)).shared()
        signs = np.append(first.sign, candidates.signs)
        largest = np.append(first.plausible[1] / first.plausible[0], candidates.largest)
        alone = single_integrals(shared.score[0], shared.information[0, 0], signs[0], largest[0])
        b = np.arange(1, len(signs))
        both = pair_integrals(shared.information, shared.score, np.zeros(len(b), int), b, signs, largest)
        ordered = ((float(both[k] - alone), int(k), candidates.each[k]) for k in np.argsort(-both))
        same = first.mechanism, self.library[first.mechanism].opposite
        return [one for one in ordered if one[2].mechanism not in same]

    def pairs_with(self, leader: Hypothesis) -> None:
        """The best second names next to a leader, each fitted together with it."""
        (name,), own, at = leader.names, leader.own, leader.fitted
        seconds: dict[Names, int] = {}
        for gain, k, c in self.seconds(at, at.variants[0] if own is None else own.variant):
            if gain < 0 or len(seconds) >= SECONDS:
                break
            seconds.setdefault(pair_of(name, c.mechanism), k)
        tasks: list[tuple[Names, Callable[[], RandomEffects | None]]] = []
        if own is None:
            first = self.row_of(at)[0]
            pairs = self.fit_pairs({names: (first, k) for names, k in seconds.items()})
            tasks += [(pair_of(m, name), partial(self.of_their_own, m, at)) for m in self.not_shared]
        else:
            pairs, start = [], (self.base, self.null.state)
            side_by_side(self.fit, [(k,) for k in seconds.values()])
            for names, k in seconds.items():
                tasks.append((names, partial(own.next_to, *start, *self.start_of([k]), self.small)))
                # Numbers that were found without the second name have taken up some of its effect.
                tasks.append((names, partial(self.of_their_own, name, self.fit((k,)))))
        for (names, _), one in zip(tasks, side_by_side(call, [task for _, task in tasks]), strict=True):
            self.keep(names, one)
            self.without_name(names, one)
        self.fit_misfits([*pairs, *(names for names, _ in tasks)], leader)

    def without_name(self, pair: Names, own: RandomEffects | None) -> None:
        """Numbers of every test's own that were found next to a name, without it: the search for them may end early."""
        (mechanism,) = (m for m in pair if m in self.not_shared)
        known = self.found[mechanism,]
        if own is not None and own.log_evidence > known.alone and (known.own is None or known.own.more is not own.more):
            self.keep((mechanism,), own.next_to(self.base, self.null.state, (), (), self.small))
            self.fit_misfit(self.found[mechanism,])

    def row_of(self, r: Fitted) -> tuple[int, ...]:
        """The candidates that were fitted together."""
        return next(ks for ks, one in self.fits.items() if one is r)

    def leading_pairs(self) -> dict[Names, tuple[int, ...]]:
        """The best pairs to first order that lead every single name: of two strong effects neither need lead alone."""
        a, b, value = self.screen.pairs
        least = self.screen.singles().max() + DECISIONS.margin
        found: dict[Names, tuple[int, ...]] = {}
        for k in np.argsort(-value):
            if value[k] < least or len(found) >= SECONDS:
                break
            names = pair_of(*self.screen.candidates.mechanisms[[a[k], b[k]]])
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
        fitted, each = self.row_of(pair.fitted), self.screen.candidates.each
        wanted = []
        for k, other in (fitted, fitted[::-1]):
            single = self.fit((k,))
            tried = {each[other].variant.name}
            for _, j, c in self.seconds(single, single.variants[0]):
                if c.mechanism == each[other].mechanism and c.variant.name not in tried and len(tried) < ALL_FORMULAS:
                    tried.add(c.variant.name)
                    wanted.append((k, j))
        first, every = pair.fitted, [pair.fitted, *side_by_side(self.fit, wanted)]
        every = [r for r in every if self._credible(pair.names, r)] or every
        pair.at = max(every, key=lambda r: r.log_evidence)
        pair.alone = float(np.logaddexp.reduce([r.log_evidence for r in every])) - self.log_combinations(pair.names)
        if pair.at is not first:
            self.fit_misfit(pair)

    def log_combinations(self, names: Names) -> float:
        """Log number of ways in which formulas that tests share go together: each is as probable, a priori."""
        return float(np.sum(np.log([len(self.first_order[m]) for m in names if m in self.first_order])))

    def keep(self, names: Names, own: RandomEffects | None) -> None:
        """A hypothesis with numbers of every test's own, if it is the best of its names."""
        value = -np.inf
        if own is not None:  # next to them one formula of several, each as probable a priori
            value = own.log_evidence - self.log_combinations(names)
            own = replace(own, log_evidence=value)
        if names not in self.found or value > self.found[names].alone:
            self.found[names] = Hypothesis(names, value, at=None if own is None else own.at, own=own)

    @cached_property
    def rank(self) -> dict[str, float]:
        """Log evidence of every mechanism to first order, best first."""
        logs = {m: float(logsumexp([v for v, _ in f.values()]) - np.log(len(f))) for m, f in self.first_order.items()}
        return dict(sorted(logs.items(), key=lambda item: -item[1]))

    def fit_serious(self) -> None:
        """The mechanisms that lead to first order, by their formulas."""
        self.progress("the serious names, fitted as they are")
        lead = max(self.rank.values(), default=-np.inf) - self.null.log_evidence
        self.fit_singles(list(self.rank)[:CONTENDERS], FORMULAS if lead > VERY_STRONG else 1)
        if lead > STRONG:
            best = sorted(self.found.values(), key=lambda x: -x.log_evidence)[:2]
            self.fit_singles([one.names[0] for one in best if one.names], ALL_FORMULAS)

    def run(self) -> Search:
        """The search with all hypotheses worked out: this one or, where much is missing, one under the noise that the
        leading name leaves, if that is clearly another. What is missing makes some particles look noisier than others.
        """
        search = self._settled()
        search._run_others()
        return search

    def _settled(self) -> Search:
        """This search or one under other noise, with the serious names in it."""
        self.fit_serious()
        leader = max(self.found.values(), key=lambda x: x.log_evidence)
        if leader.log_evidence < self.null.log_evidence + VERY_STRONG:
            return self
        base, optimum = with_likely_noise(self.base, leader.fitted)
        if base is self.base:
            return self
        again = Search(base, self.library, self.whole, self.progress, optimum.hyper)
        again.untestable, again.left_out = self.untestable, self.left_out
        again.fit_serious()
        return again

    def _run_others(self) -> None:
        """Work all other hypotheses out."""
        nothing, names = self.null.log_evidence, list(self.rank)
        serious = names[:CONTENDERS]
        side_by_side(self.fit_misfit, [self.found[(m,)] for m in serious])
        for m in names[CONTENDERS:]:
            self.found[(m,)] = Hypothesis((m,), self.rank[m])
        self.progress("what differs from test to test, and a discrepancy on no list")
        tasks: list[Callable[[], Any]] = [partial(self.discrepancy.added_to, self.base, self.null)]
        smooth, *ones = side_by_side(call, tasks + [partial(self.of_their_own, m, self.null) for m in self.not_shared])
        for m, one in zip(self.not_shared, ones, strict=True):
            self.keep((m,), one)
        alone = [self.found[m,] for m in self.not_shared]
        side_by_side(self.fit_misfit, [x for x in alone if x.own is not None])
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
            self.replace_names({x.names for x in leading})
            best = max(x.log_evidence for x in self.found.values())
            if max(x.with_discrepancy for x in leading) > best - DECISIONS.margin:
                for pair in self.better_pairs():  # where one name needs a discrepancy, two may need it, too
                    self.fit_discrepancy(pair, best)
        self.progress("other kinds of noise")
        self.other_noise()

    def replace_names(self, seen: set[Names]) -> None:
        """The two best pairs by all formulas; then each name of the best pair is kept in turn and the other replaced by
        its best second names, until no name is new (sequential replacement: Miller, Subset selection in regression,
        2002, chapter 3). The name that leads alone may imitate two others. `seen` are names that have been kept."""
        for _ in range(SECONDS):
            for pair in self.better_pairs():
                if pair.names not in seen:
                    self.other_formulas(pair)
                    seen.add(pair.names)
            new = [m for pair in self.better_pairs()[:1] for m in pair.names if (m,) not in seen]
            if not new:
                break
            for m in new:
                if self.found[m,].at is None:
                    self.fit_singles([m], FORMULAS)
                    self.fit_misfit(self.found[m,])
                self.pairs_with(self.found[m,])
                seen.add((m,))

    def better_pairs(self) -> list[Hypothesis]:
        """The two best pairs of names whose numbers all tests share, if they explain more than any name alone."""
        one = max(x.log_evidence for names, x in self.found.items() if len(names) == 1 and names != UNLISTED)
        pairs = [x for x in self.found.values() if len(x.names) == 2 and x.at is not None and x.own is None]
        return sorted((x for x in pairs if x.log_evidence > one), key=lambda x: -x.log_evidence)[:2]

    def comes_near(self, leader: Names, log_evidence: float) -> bool:
        """Whether nothing, what leads to first order, or another search's leader begins near a log evidence, or may."""
        best = {m: max(each.values()) for m, each in self.first_order.items()}
        if not best or not set(leader) <= set(best):
            return True
        rows = [(best[m][1],) for m in leader] + [(max(best.values())[1],), *list(self.leading_pairs().values())[:1]]
        fits = side_by_side(self.fit, list(dict.fromkeys(rows)))
        return max(one.log_evidence for one in (self.null, *fits)) > log_evidence - VERY_STRONG

    def pairs_of(self, leaders: Sequence[Hypothesis]) -> None:
        """The best second names next to each of some leaders, and what leads of all pairs to first order."""
        for leader in leaders:
            self.pairs_with(leader)
        self.fit_misfits(self.fit_pairs(self.leading_pairs()), leaders[0])

    def other_noise(self) -> None:
        """Average the leading hypotheses over kinds of noise, if another kind may explain the gap or a second name;
        where something steps, the noise may have outliers that steps resemble."""
        logs = self.log_posteriors()
        leader = next(iter(logs))
        if not leader:
            return
        kinds = noise_models(self.base)
        near = [names for names in list(logs)[:SECONDS] if logs[names] > logs[leader] - STRONG]
        steps = any(self.library[m].sudden for names in near for m in names if m in self.library)
        gains: dict[Names, list[float]] = {}

        def work_out(names: Names) -> None:
            one = self.found[names]
            if names not in gains and one.at is not None:
                by_outliers = [self._gain_by_outliers(one)] if steps else []
                gains[names] = [*self._gains_by_noise(one, kinds), *by_outliers]

        work_out(())
        wanted = list(logs)[:SECONDS]
        if len(leader) == 2:
            wanted += [names for names in logs if len(names) == 1][:SECONDS]
        elif logs[()] + max(gains[()]) < logs[leader] - STRONG:
            return
        for names in wanted:
            work_out(names)
        # What was not worked out counts as if no other kind explained it better, and outliers the least they ever do.
        self.outliers = max(min(gain[-1] for gain in gains.values()), 0.0) if steps else 0.0
        others = [self.outliers] if steps else []
        for names, one in self.found.items():
            one.other_noise = float(logsumexp([0.0, *gains.get(names, others)]) - np.log(1 + len(gains[()])))

    def _gain_by_outliers(self, one: Hypothesis) -> float:
        """What a hypothesis in its likelier form gains where the noise of some readings has outliers, which fade."""
        (sudden, *_) = (self.library[m].variants[0] for m in self.not_shared if self.library[m].sudden)
        hyper, design = one.likely_form()
        start = replace(one.fitted, design=design, optimum=optimise(design, hyper))
        found = sudden_steps(self.base, start, sudden, of_noise=True)
        return -np.inf if found is None else found.log_evidence - start.log_evidence

    def _gains_by_noise(self, one: Hypothesis, models: Sequence[Model]) -> list[float]:
        """What a hypothesis in its likelier form gains under other kinds of noise; the best one is kept of a name."""
        hyper, design = one.likely_form()
        own = log_joint(hyper, design)
        found = [with_other_noise(design, hyper, model) for model in models]
        best, model = max(zip(found, models, strict=True), key=lambda pair: pair[0].log_joint)
        if one.names and best.log_joint > own:
            one.under_other_noise = model, best.hyper
        return [other.log_joint - own for other in found]


def pair_of(one: str, other: str) -> Names:
    """Two names in their order."""
    return (one, other) if one < other else (other, one)


def _best_first(logs: Mapping[Names, float]) -> dict[Names, float]:
    return dict(sorted(logs.items(), key=lambda item: -item[1]))
