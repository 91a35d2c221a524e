"""The search over hypotheses: nothing, one name, two names, or what is on no list, each by its log evidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.special import logsumexp

from mcc_jax.calibrate.forward import Forms
from mcc_jax.discover.candidates import candidates_of
from mcc_jax.effects import Mechanism

from .design import Base, design_of
from .evidence import eliminate_first, left_by_particle, optimise
from .misfit import COORDINATES, coordinates, functions, padded
from .own import drift, pop_in
from .refine import Refined, refined
from .screen import Screen, Setting, candidate_columns, pair_integrals, screen, single_integrals

ONE, TWO = 64, 128
PAIR, UNLISTED, GENERAL = -5.0, -5.0, -5.0
OPPOSITE = {frozenset(("damage", "densification_stiffening"))}


@dataclass
class Named:
    """A hypothesis with its log evidence in its several forms."""

    names: tuple[str, ...]
    alone: float = -np.inf
    misfit: float = -np.inf
    best: Refined | None = None
    formulas: dict[tuple[str, ...], float] = field(default_factory=dict)
    rho: tuple[float, ...] = ()
    own: Any = None

    @property
    def value(self) -> float:
        return float(np.logaddexp(self.alone, self.misfit) - np.log(2))


@dataclass
class Search:
    null: Refined
    screen: Screen
    found: dict[tuple[str, ...], Named]
    unlisted: float
    log: list[str] = field(default_factory=list)

    def posterior(self, count: int) -> dict[tuple[str, ...], float]:
        logs = {(): self.null.log_evidence, ("UNLISTED",): self.unlisted + UNLISTED}
        for names, one in self.found.items():
            prior = -np.log(count) if len(names) == 1 else PAIR - np.log(count * (count - 1) / 2)
            logs[names] = one.value + prior
        total = logsumexp(list(logs.values()))
        return {k: float(np.exp(v - total)) for k, v in sorted(logs.items(), key=lambda kv: -kv[1])}


class Searcher:
    """One search: what all hypotheses share."""

    def __init__(
        self, base: Base, library: Mapping[str, Mechanism], tell: Callable[[str], None] = lambda _: None
    ) -> None:
        self.full = library
        library = {k: m for k, m in library.items() if k not in ("thermal_drift", "pop_in")}
        self.base, self.library, self.tell = base, library, tell
        self.forms = Forms(base.model.unloading)
        s0 = base.start_state()
        start = optimise(design_of(base, s0, ()), base.start_free(), curvature=False)
        self.null = refined(base, s0, (), np.zeros(0), start.free)
        self.at = coordinates(self.null.state, base.tests, self.forms)
        self.screen = screen(base, self.null.state, self.null.optimum.free, library)
        self.small = self.null.optimum.free.copy()
        self.small[2] += np.log(0.1)
        self.cache: dict[tuple[str, ...], Refined] = {}

    # ---- one name ----------------------------------------------------------------------------------------------------

    def first_order(self) -> dict[str, dict[str, tuple[float, int]]]:
        """Log evidence to first order of every formula of every mechanism, and its best candidate."""
        value, _ = self.screen.singles()
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

    def refine(self, ks: tuple[int, ...]) -> Refined:
        """Some candidates together at their own optimum, by their formulas."""
        cs = [self.screen.candidates[k] for k in ks]
        key = tuple(f"{c.mechanism}:{c.variant.name}" for c in cs)
        if key not in self.cache:
            numbers = [0.0] * len(cs) + [c.nuisance[n.name] for c in cs for n in c.variant.nuisances]
            variants = tuple(c.variant for c in cs)
            self.cache[key] = refined(self.base, self.null.state, variants, np.array(numbers), self.small)
        return self.cache[key]

    def misfit_columns(self, r: Refined, which: int) -> Array:
        """Columns by which one of the formulas may be wrong, at its amplitude."""
        own = r.design.amplitude[..., which] * float(r.theta[which] / r.variants[which].plausible[0])
        return own[..., None] * functions(COORDINATES[r.variants[which].mechanism], self.at)

    def with_misfit(self, r: Refined) -> tuple[float, tuple[float, ...]]:
        """Log evidence with every name's misfit."""
        K = len(r.variants)
        size = ONE if K == 1 else TWO // 2
        basis, group, priors, start = [], [], [], []
        for i in range(K):
            basis.append(padded(self.misfit_columns(r, i), size))
            group += [i + 1] * size
            priors.append([np.log(0.1), 0.8])
            start.append(np.log(0.1))
        d = design_of(self.base, r.state, r.variants, jnp.concatenate(basis, -1), np.array(priors), group)
        o = optimise(d, np.append(r.optimum.free, start))
        return o.log_evidence, tuple(float(x) for x in np.exp(o.free[-K:]).round(3))

    def single(self, mechanism: str, formulas: dict[str, tuple[float, int]], most: int) -> Named:
        """One mechanism: its best formulas refitted, the others as to first order."""
        ordered = sorted(formulas.items(), key=lambda kv: -kv[1][0])
        values, best, gain = {}, None, 0.0
        for f, (first, k) in ordered[:most]:
            r = self.refine((k,))
            values[f] = r.log_evidence
            if best is None or r.log_evidence > best.log_evidence:
                best, gain = r, r.log_evidence - first
        for f, (first, _) in ordered[most:]:
            values[f] = min(first + min(gain, 0.0), best.log_evidence)
        named = Named((mechanism,), float(logsumexp(list(values.values())) - np.log(len(values))), best=best)
        named.formulas = {(f,): v for f, v in values.items()}
        return named

    # ---- two names ---------------------------------------------------------------------------------------------------

    def random_columns(self) -> tuple[Any, Any]:
        """Signatures of the drifts of each test."""
        candidates = candidates_of({"thermal_drift": self.full["thermal_drift"]})
        columns = candidate_columns(self.null.state, self.base.tests, tuple(c.effect for c in candidates), self.forms)
        return columns * jnp.asarray(np.array([c.variant.plausible[0] for c in candidates])), candidates

    def seconds(self, r: Refined) -> list[tuple[float, int]]:
        """Candidates beside a name, to first order around its optimum, best first."""
        design = r.design
        every = jnp.concatenate([design.amplitude, self.screen.columns], -1)
        left, integral = left_by_particle(jnp.asarray(r.optimum.free), replace(design, amplitude=every))
        each = jnp.sum(left, 0)
        c = design.common.shape[-1]
        total, log_pop = eliminate_first(each, c)
        total = np.asarray(total)
        null = float(jnp.sum(integral)) + float(log_pop) - 0.5 * total[-1, -1]
        s = Setting(r.optimum.free, null, total[:-1, :-1], total[:-1, -1])
        cs = self.screen.candidates
        signs = np.array([r.variants[0].sign, *(c.variant.sign for c in cs)])
        largest = np.array(
            [
                r.variants[0].plausible[1] / r.variants[0].plausible[0],
                *(c.variant.plausible[1] / c.variant.plausible[0] for c in cs),
            ]
        )
        b = np.arange(1, len(signs))
        value = pair_integrals(s, np.zeros(len(b), int), b, signs, largest) + null
        alone, _ = single_integrals(s.score[:1], np.diagonal(s.gram)[:1], signs[:1], largest[:1])
        value = value - (null + alone[0])
        name = r.variants[0].mechanism
        order = [
            k
            for k in np.argsort(-value)
            if cs[k].mechanism != name and frozenset((name, cs[k].mechanism)) not in OPPOSITE
        ]
        return [(float(value[k]), int(k)) for k in order]

    def general(self, r: Refined, start: float) -> float:
        """Log evidence with a smooth discrepancy common to all particles, in coordinates of its own."""
        at, tests = self.at, self.base.tests
        size = np.asarray(tests.effective_diameter)
        alone = [(name, k) for name in ("strain", "travel", "load", "clock") for k in range(1, 6)]
        columns = [jnp.cos(np.pi * k * at[name]) for name, k in alone]
        both = [(i, j) for i in range(1, 3) for j in range(1, 3)]
        columns += [jnp.cos(np.pi * i * at["peak"]) * jnp.cos(np.pi * j * at["load"]) for i, j in both]
        smooth = jnp.stack(columns, -1) / np.sqrt(len(columns))
        waves = []
        for name in ("travel", "clock"):
            for k in range(2, 12):
                waves += [jnp.cos(2 * np.pi * k * at[name]), jnp.sin(2 * np.pi * k * at[name])]
        periodic = jnp.stack(waves, -1) / np.sqrt(len(waves))
        basis = jnp.concatenate([smooth, periodic], -1) * jnp.asarray(size / size.mean())[:, None, None]
        basis = padded(jnp.where(tests.mask[..., None], basis, 0.0), ONE)
        group = [1] * len(columns) + [2] * (ONE - len(columns))
        unit = np.log(3 * np.exp(self.null.optimum.free[0]))
        d = design_of(self.base, r.state, r.variants, basis, np.array([[unit, 1.5], [unit, 1.5]]), group)
        o = optimise(d, np.append(r.optimum.free, [unit, unit - start]))
        return o.log_evidence

    def run(self) -> Search:
        """All hypotheses."""
        order = self.first_order()
        rank = {m: float(logsumexp([v for v, _ in f.values()]) - np.log(len(f))) for m, f in order.items()}
        names = sorted(rank, key=lambda m: -rank[m])
        found: dict[tuple[str, ...], Named] = {}
        lead = rank[names[0]]
        strong = lead - self.screen.null > 10
        # Mechanisms that are far behind to first order stay as they are.
        for m in names[:5]:
            found[(m,)] = self.single(m, order[m], 2 if strong else 1)
        for one in sorted(found.values(), key=lambda x: -x.alone)[:2]:
            if strong:
                best = self.single(one.names[0], order[one.names[0]], 8)
                found[one.names] = best
        for m in names[5:]:
            found[(m,)] = Named((m,), rank[m] - self.screen.null + self.null.log_evidence)
        for m in names[:5]:
            one = found[(m,)]
            one.misfit, one.rho = self.with_misfit(one.best)
        if "thermal_drift" in self.full:
            value, own = drift(self.base, self.null.state, self.null.optimum.free, *self.random_columns())
            found[("thermal_drift",)] = Named(("thermal_drift",), value + np.log(2), own=own)
        if "pop_in" in self.full:
            own = pop_in(
                self.base,
                self.null.state,
                self.null.optimum.free,
                self.null.log_evidence,
                self.full["pop_in"].variants[0].plausible,
            )
            found[("pop_in",)] = Named(("pop_in",), own.log_evidence + np.log(2), own=own)
        unlisted = self.general(self.null, 1.0)
        search = Search(self.null, self.screen, found, unlisted)
        leaders = sorted((x for x in found.values() if x.best is not None), key=lambda x: -x.value)
        if leaders[0].value - self.null.log_evidence > 5:
            for leader in leaders[:2]:
                tried = 0
                for gain, k in self.seconds(leader.best):
                    other = self.screen.candidates[k].mechanism
                    names2 = tuple(sorted((leader.names[0], other)))
                    if names2 in found:
                        continue
                    if tried >= 2 or gain < 0:
                        break
                    tried += 1
                    first = next(
                        j for j, c in enumerate(self.screen.candidates) if c.variant is leader.best.variants[0]
                    )
                    r = self.refine((first, k))
                    pair = Named(names2, r.log_evidence, best=r)
                    pair.misfit, pair.rho = self.with_misfit(r)
                    found[names2] = pair
        return search
