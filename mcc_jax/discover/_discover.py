"""The workflow: fit, is something missing, where, what, how sure, does it close the gap, what next."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.stats import norm

from .._errors import InputError
from ..calibrate import JointModel
from ..campaign import THRESHOLD_MPA, Campaign
from ..effects import LIBRARY, Mechanism, Nuisance, Variant, present
from ..law import PUNCH_AREA
from ._candidates import untestable
from ._closure import Closure, find_closure, pursue
from ._confirm import held_out
from ._experiments import next_experiments
from ._refine import refined
from ._refit import Refit, refit, system_at
from ._result import Discovery, Effect, Verdict
from ._score import DETECTABLE, Projection, family_wise, flips, project
from ._search import Ranking, family_columns, pairs, random_probability, rank
from ._system import GLOBALS, Base, Signals, System, base_fit, build_system, signals_of
from ._where import where
from ._words import summary_of

LEVEL = 0.035
LEVEL_AT_RANDOM = 0.01
LEVEL_OF_NOISE_MODEL = 0.005
"""Family-wise levels of the three tests for a gap: common to all particles, by their scatter; different from test to
test; common, by the noise model, for effects of which few particles carry most of the information. Together 5 %."""

INDEPENDENT = 100
"""So many independent columns are counted where no bootstrap does it."""

LEVEL_OF_MORE = 0.01
"""Level at which something is missing besides the whole family of formulas of what was added."""

LEVEL_OF_UNLISTED = 0.001
"""Level at which something is missing besides every name, for saying that no name is right: no listed formula is
nature's own, so that a little is always left, and this is the stronger claim."""

BETTER, SHARE = 30.0, 0.1
"""A formula of a few free words takes away this much chi2 more than any listed mechanism by chance and because no
listed formula is nature's own, in addition this share of what the mechanism takes away. Beyond, it is not listed."""

LIKE_THE_BEST = 0.1
"""A mechanism whose probability is at least this share of the best one's belongs to the set."""

LARGE = 40.0
"""Drop of chi2 by the best mechanism from which on the serious ones are fitted as they are: below, first order does."""

SERIOUS, MOST_REFITS = 0.5, 8
"""Mechanisms whose log evidence is at least this share of the best one's are serious; so many formulas at most."""

REFINEMENTS = 2
FEWEST = 4
"""Below so many particles their scatter says nothing; the noise model has to do."""


def discover(
    campaign: Campaign,
    *,
    library: Mapping[str, Mechanism] | None = None,
    exclude: tuple[str, ...] = (),
    model: JointModel | None = None,
    threshold_MPa: float = THRESHOLD_MPA,
    confirm: bool = True,
    experiments: bool = True,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Discovery:
    """Find where law and campaign disagree, name what is missing, and show on held-out particles that it helps.

    Args:
        campaign: the tests.
        library: mechanisms to look for; the whole `mcc_jax.effects.LIBRARY` if None.
        exclude: names of mechanisms to leave out.
        model: form of unloading and priors; the modulus may always scatter between particles.
        threshold_MPa: points below this stress on loading do not count [MPa].
        confirm: repeat the search with each particle left out, and see how far that particle is then from the law.
        experiments: work out which further test would tell the members of a set apart.
        seed: of the bootstrap.
        progress: called with the name of each step.

    Returns:
        The answer; "nothing is missing" and "cannot tell" are answers, too.

    Raises:
        InputError: if no particle can be used, a name to exclude is not known, or no mechanism is left to look for.
    """
    started = time.perf_counter()
    tell = progress or (lambda _: None)
    known = dict(LIBRARY if library is None else library)
    for name in exclude:
        if name not in known:
            raise InputError(f"there is no mechanism {name!r}", remedy=f"Known: {', '.join(known)}.")
        known.pop(name)
    assumed = model or JointModel()
    assumed = JointModel(assumed.unloading, assumed.strain_scaling, True, assumed.shape_scatter, assumed.priors)
    base = base_fit(campaign, assumed, threshold_MPa=threshold_MPa, tell=tell)
    testable, missing = untestable(without_punch(known, base), present(campaign))
    if not testable:
        raise InputError("no mechanism is left to look for", remedy="Exclude fewer, or measure what the others need.")
    if not bool(np.all(np.asarray(base.fit.converged)[1:])) or not _mostly_converged(base):
        return _not_converged(base, missing, seed, started)
    tell("signatures of all effects")
    signals = signals_of(base, testable)
    system = build_system(base, signals)
    for _ in range(REFINEMENTS):
        tell("noise without what is systematic")
        base, changed = refined(base, system, signals)
        if not changed:
            break
        system = build_system(base, signals)
    return _judge(base, system, signals, missing, confirm, experiments, seed, started, tell)


def without_punch(library: Mapping[str, Mechanism], base: Base) -> dict[str, Mechanism]:
    """The library without the finite width of the punch, unless a contact grows wider than the punch is known to be.

    A formula that knows neither would be nothing but another name for the compliance of the frame.
    """
    diameter = base.campaign.metadata.punch_diameter_um
    tests = base.tests
    size = np.asarray(tests.particle.D1 * tests.particle.D2 / tests.particle.D3)
    travel = np.where(np.asarray(tests.mask), np.asarray(tests.displacement), -np.inf).max(1) - np.asarray(
        base.fit.zero
    )
    widest = float(np.max(np.sqrt(PUNCH_AREA * size * np.maximum(travel, 0.0))))
    outgrown = diameter is not None and 2 * widest > diameter

    def known(variant: Variant) -> Variant | None:
        if not any(n.name == PUNCH for n in variant.nuisances):
            return variant
        if not outgrown or diameter is None:
            return None
        radius = Nuisance(PUNCH, (diameter / 2,), (diameter / 2, diameter / 2), "radius of the flat punch, as recorded")
        others = tuple(n for n in variant.nuisances if n.name != PUNCH)
        return dataclasses.replace(variant, nuisances=(*others, radius))

    kept = {}
    for name, mechanism in library.items():
        variants = tuple(v for v in map(known, mechanism.variants) if v is not None)
        if variants:
            kept[name] = Mechanism(name, mechanism.explanation, variants, mechanism.equivalences)
    return kept


PUNCH = "punch_radius_um"


def _mostly_converged(base: Base) -> bool:
    return float(np.mean(np.asarray(base.fit.individual.converged))) >= 0.7


def _not_converged(base: Base, missing, seed: int, started: float) -> Discovery:
    reasons = [
        name
        for name, fine in zip(("particles", "noise", "population"), np.asarray(base.fit.converged), strict=True)
        if not fine
    ]
    return Discovery(
        verdict="FIT_NOT_CONVERGED",
        summary=(
            f"The base law could not be fitted well enough to ask what it lacks (not converged: {', '.join(reasons)}). "
            "Nothing is named. Look at the curves and the diameters, leave out damaged tests, and try again."
        ),
        base=base,
        system=None,
        effects=(),
        candidate_set=(),
        ranking=None,
        untestable=tuple(missing),
        where=(),
        closure=None,
        held_out=None,
        labels=(),
        p_any=float("nan"),
        before=_parameters(base, None),
        after={},
        next_experiments=(),
        limits={},
        seed=seed,
        runtime_s=time.perf_counter() - started,
    )


def _signs(system: System) -> np.ndarray:
    return np.array([c.variant.sign for c in system.candidates])


FREEDOM = 0.3
"""How far nature's formula may differ from the best one of its family: by so much of it in every other one."""


def _left(system: System, seed: int, chosen: list[int]) -> float:
    """Family-wise probability that nothing is left beside some candidates, over candidates, map and words.

    The candidates are fitted; the other formulas of their families are let in within `FREEDOM`.
    """
    inside, precision = _family(system, chosen)
    columns = np.concatenate([system.candidate_columns, system.place_columns, system.word_columns])
    sign = np.concatenate([_signs(system), np.zeros(len(columns) - len(system.candidates))])
    view = project(system, columns, inside=inside, precision=precision)
    keep = view.survival > (1e-6 if not len(inside) else 1e-2)
    if not keep.any():
        return 1.0
    scores, total, signs = view.scores[:, keep], view.total[keep], sign[keep]
    found = _probability(scores, total, signs, seed)
    # The scatter of few particles cannot be surer than their number of signs allows, however strong a second effect is.
    return min(found, 2 * _by_noise_model(scores, total, signs)) if chosen else found


def _family(system: System, chosen: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Columns of the families of some candidates, and how tightly each is held to zero."""
    own = np.array([system.column(k) for k in chosen], int)
    if not chosen:
        return own, np.zeros(0)
    theta = system.at[chosen] + project(system, own[:0], inside=own).theta[len(system.globals) :]
    strength = project(system, system.candidate_columns).total
    columns, precision = list(own), [1e-12] * len(own)
    for k, amplitude in zip(chosen, theta, strict=True):
        effect = FREEDOM**2 * amplitude**2 * strength[k]
        for j, candidate in enumerate(system.candidates):
            if candidate.mechanism == system.candidates[k].mechanism and j not in chosen and strength[j] > 0:
                columns.append(system.column(j))
                precision.append(float(strength[j] / max(effect, 1e-300)))
    return np.array(columns, int), np.array(precision)


def _probability(scores: np.ndarray, total: np.ndarray, sign: np.ndarray, seed: int) -> float:
    if len(scores) < FEWEST:
        return _by_noise_model(scores, total, sign)
    return float(family_wise(scores, sign, flips(len(scores), seed))[0].min())


def _by_noise_model(scores: np.ndarray, total: np.ndarray, sign: np.ndarray) -> float:
    """Bonferroni's bound for the largest estimate over its standard error; a sign that is NaN does not count."""
    t = scores.sum(0) / np.sqrt(np.maximum(total, 1e-300))
    sided = np.where(np.isnan(sign), -np.inf, np.where(sign == 0, np.abs(t), t * np.nan_to_num(sign)))
    return float(min(1.0, INDEPENDENT * norm.sf(float(np.max(sided)))))


class _Extensions:
    """The law extended by effects, fitted as it is: once each, and only where first order may not do."""

    def __init__(self, base: Base, system: System, signals: Signals) -> None:
        self.base, self.system, self.signals = base, system, signals
        self.known: dict[tuple[int, ...], Refit] = {}

    def fit(self, chosen: tuple[int, ...]) -> Refit:
        """The base law with some candidates."""
        if chosen not in self.known:
            inside = np.array([self.system.column(k) for k in chosen], int)
            start = project(self.system, inside[:0], inside=inside).theta[len(GLOBALS) :]
            candidates = tuple(self.system.candidates[k] for k in chosen)
            self.known[chosen] = refit(self.base, candidates, start, self.system.prior)
        return self.known[chosen]

    def drop(self, chosen: tuple[int, ...]) -> float:
        """By how much -2 log likelihood falls; not at all where an amplitude has a sign that it cannot have."""
        found = self.fit(chosen)
        return max(self.fit(()).deviance - found.deviance, 0.0) if found.physical else 0.0

    def system_of(self, chosen: tuple[int, ...]) -> System:
        """The linear system around the extended law."""
        return system_at(self.base, self.system, self.signals, list(chosen), self.fit(chosen))


def _serious(system: System, ranking: Ranking) -> list[int]:
    """Candidates worth a fit of their own: of the mechanisms that may be true the best two formulas."""
    chosen: list[int] = []
    best = ranking.log_evidence[0]
    for name, value, at_random in zip(ranking.names, ranking.log_evidence, ranking.at_random, strict=True):
        if value < SERIOUS * best or len(chosen) >= MOST_REFITS:
            break
        if at_random:
            continue
        members = [k for k, c in enumerate(system.candidates) if c.mechanism == name]
        members.sort(key=lambda k: -ranking.evidence[k])
        formulas: dict[str, int] = {}
        for k in members:
            if np.isfinite(ranking.evidence[k]):
                formulas.setdefault(system.candidates[k].variant.name, k)
        chosen.extend(list(formulas.values())[:2])
    return chosen[:MOST_REFITS]


def _judge(
    base: Base, system: System, signals: Signals, missing, confirm: bool, experiments: bool, seed: int, started, tell
) -> Discovery:
    tell("is something missing")
    view = project(system, system.candidate_columns)
    ranking = rank(system, view)
    p_common = _left(system, seed, [])
    p_random = random_probability(system, view, seed)
    p_model = _by_noise_model(view.scores, view.total, np.where(view.survival > 1e-6, _signs(system), np.nan))
    tests = ((p_common, LEVEL), (p_random, LEVEL_AT_RANDOM), (p_model, LEVEL_OF_NOISE_MODEL))
    p_any = min(1.0, *(p * 0.05 / level for p, level in tests))
    gap = p_any <= 0.05
    notes = _notes(base, system)
    verdict: Verdict = "NO_GAP"
    chosen: list[int] = []
    sets: list[tuple[str, ...]] = []
    closure: Closure | None = None
    steps: list[Ranking] = []
    places: list[dict[str, Any]] = []
    extended, last, around = system, None, {}
    if gap:
        tell("where")
        places = where(base, system)
        tell("what")
        extensions = _Extensions(base, system, signals) if ranking.gain[0] >= LARGE else None
        if extensions is not None:
            tell("the serious names, fitted as they are")
            drops = {k: extensions.drop((k,)) for k in _serious(system, ranking)}
            ranking = rank(system, view, refitted=drops)
        verdict, chosen, sets, steps, closure = _name(base, system, view, ranking, extensions, seed, tell)
        if extensions is not None and chosen and not any(step.at_random[0] for step in steps):
            last = extensions.fit(tuple(chosen))
            if last.physical:
                extended = extensions.system_of(tuple(chosen))
                around[frozenset(system.column(k) for k in chosen)] = extended
    effects = _effects(extended, last, chosen, steps, p_any)
    inside = np.array([system.column(k) for k in chosen], int)
    words = closure.words if closure is not None else np.array([], int)
    ladder, labels = None, (None,)
    if confirm and gap and int(system.usable.sum()) > 2:
        tell("held-out particles")
        ladder = held_out(system, _chooser(system, len(chosen), closure is not None), around)
        labels = (None, *(e.mechanism for e in effects), *(("formula",) if closure is not None else ()))
    further: list[dict[str, Any]] = []
    if experiments and gap:
        tell("next experiments")
        further = next_experiments(base, system, chosen, sets)
    with_all = np.concatenate([inside, words]).astype(int)
    found = Discovery(
        verdict=verdict,
        summary="",
        base=base,
        system=system,
        effects=effects,
        candidate_set=tuple(sets),
        ranking=ranking,
        untestable=tuple(missing),
        where=tuple(places),
        closure=closure,
        held_out=ladder,
        labels=labels,
        p_any=p_any,
        before=_parameters(base, project(system, inside[:0])),
        after=_parameters(base, project(extended, inside[:0], inside=with_all), extended.shift) if gap else {},
        next_experiments=tuple(further),
        limits=_limits(system, view, ranking),
        seed=seed,
        runtime_s=0.0,
        notes=tuple(notes),
    )
    return dataclasses.replace(found, summary=summary_of(found), runtime_s=time.perf_counter() - started)


def _name(
    base: Base, system: System, view: Projection, ranking: Ranking, extensions: _Extensions | None, seed: int, tell
):
    """Verdict, chosen candidates, their sets, rankings of each step, and the formula if nothing listed will do."""
    members = tuple(ranking.members(LIKE_THE_BEST))
    gain_of_words = pursue(system)[1]
    # Any member of the set may be the one beside which nothing is left; the most probable is asked first.
    most_left = 0.0
    for name in members:
        position = ranking.names.index(name)
        first, gain = ranking.best[position], float(ranking.gain[position])
        if ranking.at_random[position]:
            around = system.absorbing(family_columns(system, (name,)))
        else:
            around = system if extensions is None else extensions.system_of((first,))
        left = _left(around, seed, [first])
        most_left = max(most_left, left)
        if gain_of_words <= gain + BETTER + SHARE * gain and left > LEVEL_OF_MORE:
            own = (name, *(m for m in members if m != name))
            return ("NAMED" if len(members) == 1 else "SET"), [first], [own], [ranking], None
    first = ranking.best[0]
    tell("a second effect")
    if ranking.at_random[0] and ranking.gain[0] > gain_of_words:
        return ("NAMED" if len(members) == 1 else "SET"), [first], [members], [ranking], None
    best_pairs = pairs(system, view)
    if best_pairs and not ranking.at_random[0]:
        gain, i, j = best_pairs[0]
        both = tuple(system.candidates[k].mechanism for k in (i, j))
        with_both = system
        if extensions is not None:
            with_both, gain = extensions.system_of((i, j)), max(gain, extensions.drop((i, j)))
        p_both = _left(with_both, seed, [i, j])
        if p_both > LEVEL_OF_MORE and gain >= gain_of_words - BETTER:
            one = rank(system, project(system, system.candidate_columns, inside=np.array([system.column(j)])))
            two = rank(system, project(system, system.candidate_columns, inside=np.array([system.column(i)])))
            sets = [_with(both[0], one), _with(both[1], two)]
            verdict: Verdict = "NAMED" if all(len(s) == 1 for s in sets) else "SET"
            return verdict, [i, j], sets, [one, two], None
    tell("a formula of its own")
    closure = find_closure(system, _span(base), seed, tell=tell)
    unexplained = most_left <= LEVEL_OF_UNLISTED or gain_of_words > ranking.gain[0] * (1 + SHARE) + BETTER
    if closure is None or not unexplained:
        return ("NAMED" if len(members) == 1 else "SET"), [first], [members], [ranking], None
    return "UNLISTED", [], [], [], closure


def _with(name: str, ranking: Ranking) -> tuple[str, ...]:
    members = ranking.members(LIKE_THE_BEST)
    return (name, *(m for m in members if m != name))


def _chooser(system: System, count: int, formula: bool) -> Callable[[np.ndarray], list[np.ndarray]]:
    """The search as it is repeated within a fold."""
    empty = np.array([], int)

    def choose(particles: np.ndarray) -> list[np.ndarray]:
        if formula:
            return [empty, np.array(pursue(system, particles=particles)[0], int)]
        view = project(system, system.candidate_columns, particles=particles)
        if count == 1:
            return [empty, np.array([system.column(rank(system, view).best[0])])]
        found = pairs(system, view)
        if not found:
            return [empty] * (count + 1)
        _, i, j = found[0]
        return [empty, np.array([system.column(i)]), np.array([system.column(i), system.column(j)])]

    return choose


def _effects(
    system: System, fit: Refit | None, chosen: list[int], steps: list[Ranking], p_any: float
) -> tuple[Effect, ...]:
    """The chosen effects, in the linear system around the law with them, if they were fitted as they are."""
    if not chosen:
        return ()
    inside = np.array([system.column(k) for k in chosen])
    fitted = project(system, inside[:0], inside=inside)
    start = len(system.globals)
    found = []
    for row, (k, step) in enumerate(zip(chosen, steps, strict=True)):
        candidate = system.candidates[k]
        unit = candidate.unit_amplitude
        position = step.names.index(candidate.mechanism)
        others = inside[inside != inside[row]]
        alone = project(system, inside[row : row + 1], inside=others)
        own = alone.scores[:, 0] / np.maximum(alone.information[:, 0, 0], 1e-300)
        own = own + system.at[k]
        variance = fitted.covariance[start + row, start + row]
        if fit is not None:
            # With the further numbers free, an amplitude is less certain.
            variance = max(variance, fit.spread(row)[0] ** 2)
        found.append(
            Effect(
                candidate.variant,
                dict(candidate.nuisance),
                float((fitted.theta[start + row] + system.at[k]) * unit),
                float(np.sqrt(variance) * unit),
                float(step.probability[position]),
                p_any,
                step.at_random[position],
                own * unit,
            )
        )
    return tuple(found)


def _limits(system: System, view: Projection, ranking: Ranking) -> dict[str, tuple[float, float, float]]:
    """Statistic, estimate and detection limit of every mechanism's best formula, in its unit."""
    found = {}
    for name, k in zip(ranking.names, ranking.best, strict=True):
        unit = system.candidates[k].unit_amplitude
        information = max(float(view.total[k]), 1e-300)
        found[name] = (
            float(view.gaussian[k]),
            float(view.estimate[k] * unit),
            DETECTABLE / np.sqrt(information) * unit,
        )
    return found


def _parameters(base: Base, view: Projection | None, shift: np.ndarray | None = None) -> dict[str, Any]:
    """The population's parameters, moved as a linear system says, which itself may stand a shift away."""
    from ..calibrate.joint._fit import population_at

    population = population_at(base.fit.mode, base.fit.numbers, base.model.scatter)
    values = np.array([float(population.a), float(population.log_modulus), *np.asarray(population.mu)])
    sd = np.full(len(GLOBALS), np.nan)
    if shift is not None:
        values = values + shift
    if view is not None:
        values = values + view.theta[: len(GLOBALS)]
        sd = np.sqrt(np.diagonal(view.covariance)[: len(GLOBALS)])

    def entry(value: float, width: float) -> dict[str, Any]:
        if not np.isfinite(width):
            return {"value": float(value), "sd": None, "interval_95": None}
        return {"value": float(value), "sd": float(width), "interval_95": [value - 1.96 * width, value + 1.96 * width]}

    modulus = float(np.exp(values[1]))
    tau = np.asarray(population.tau)
    return {
        "a": entry(values[0], sd[0]),
        "effective_modulus_MPa": entry(modulus, modulus * sd[1]),
        **{
            f"log_{name}": {"mean": entry(values[2 + j], sd[2 + j]), "sd": entry(float(tau[j]), float("nan"))}
            for j, name in enumerate(("C1", "C3", "C5"))
        },
    }


def _span(base: Base) -> dict[str, tuple[float, float]]:
    tests = base.tests
    force = np.where(np.asarray(tests.mask), np.asarray(tests.force), np.nan)
    diameter = np.asarray(tests.particle.D1 * tests.particle.D2 / tests.particle.D3)
    stress = force / (np.pi * diameter[:, None] ** 2 / 4) * 1e3
    return {
        "stress_MPa": (float(np.nanmin(stress)), float(np.nanmax(stress))),
        "effective_diameter_um": (float(diameter.min()), float(diameter.max())),
        "time_s": (0.0, float(np.asarray(base.records.time).max())),
    }


def _notes(base: Base, system: System) -> list[str]:
    notes = list(base.selection.notes)
    for i in np.flatnonzero(~system.usable):
        name = base.campaign.particles[base.selection.kept[i]]
        notes.append(f"particle {name!r} snaps through in its loading; it is fitted, but takes no part in the search")
    for name, reason in zip(base.campaign.particles, base.selection.why_not, strict=True):
        if reason is not None:
            notes.append(f"particle {name!r} {reason}")
    if int(system.usable.sum()) < FEWEST:
        notes.append(
            f"{int(system.usable.sum())} usable particles: their scatter says nothing, so significance rests on the "
            "noise model"
        )
    return notes
