"""The workflow: fit, is something missing, where, what, how sure, does it close the gap, what next."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from .. import arguments
from .._errors import InputError
from ..calibrate import Model
from ..calibrate.judgement import unlike_others
from ..campaign import Campaign, Finding, available_data, campaign_findings, check_plausibility, check_tests
from ..campaign.quality import named
from ..effects import LIBRARY, Mechanism
from ..effects.library import checked_library
from .applicability import without_punch
from .candidates import untestable
from .cross_validation import held_out
from .discrepancy import Closure, find_closure
from .estimates import detection_limits, estimated_effects, population_parameters, with_draws
from .evidence import Ranking, random_probability, rank
from .experiments import next_experiments
from .extensions import Extensions, serious
from .legacy.data import ranges_um, root_mean_squares
from .legacy.settings import checked_settings
from .linear_model import Base, Signals, System, base_fit, build_system, signals_of
from .model_selection import chooser, name_missing, span_of
from .noise_estimation import refined
from .omnibus import MIN_PARTICLES, p_nothing_left
from .posterior import extended_posterior
from .remaining import likeness, residuals
from .residual_map import places, where
from .result import Discovery, Verdict
from .score import project
from .sentences import summary_of

LEVEL = 0.045
LEVEL_AT_RANDOM = 0.005
"""Family-wise levels of the two tests for a gap: common to all particles, or different from test to test. Together
5 %."""

LARGE = 20.0
"""Drop of chi2 by the best mechanism from which on the serious ones are fitted as they are: below, first order does."""

REFINEMENTS = 2


def discover(
    campaign: Campaign,
    *,
    library: Mapping[str, Mechanism] | None = None,
    exclude: Sequence[str] = (),
    model: Model | None = None,
    threshold_MPa: float = 0.0,
    confirm: bool = True,
    experiments: bool = True,
    posterior: bool = True,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Discovery:
    """Find where law and campaign disagree, name what is missing, and show on held-out particles that it helps.

    Args:
        campaign: the tests.
        library: mechanisms to look for; the whole `mcc_jax.effects.LIBRARY` if None.
        exclude: names of mechanisms to leave out.
        model: form of unloading and priors; the modulus may always scatter between particles.
        threshold_MPa: points below this stress do not count [MPa]. All count by default, unlike in a calibration: what
            surface asperities do is an effect of its own, and at low load many effects show most.
        confirm: repeat the search with each particle left out, and see how far that particle is then from the law.
        experiments: work out which further test would tell the members of a set apart.
        posterior: sample the posterior of the law with what was found; without it, amplitudes and parameters come with
            the standard errors of the fit.
        seed: of the bootstrap and the sampler.
        progress: called with the name of each step.

    Returns:
        The answer; "nothing is missing" and "cannot tell" are answers, too.

    Raises:
        InputError: if no particle can be used, a name to exclude is not known, or no mechanism is left to look for.
    """
    started = time.perf_counter()
    campaign = check_tests(campaign)
    tell, assumed, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    seed = arguments.seed(seed)
    for name, value in (("confirm", confirm), ("experiments", experiments), ("posterior", posterior)):
        arguments.flag(value, name)
    if library is not None:
        checked_library(library)
    if isinstance(exclude, str) or not isinstance(exclude, Iterable):
        remedy = f"Write exclude=({exclude!r},)." if isinstance(exclude, str) else None
        raise InputError(f"exclude must be a list of names, got {arguments.kind_of(exclude)}", remedy=remedy)
    known = dict(LIBRARY if library is None else library)
    for name in exclude:
        if name not in known:
            raise InputError(f"there is no mechanism {name!r}", remedy=f"Known: {', '.join(known)}.")
        known.pop(name)
    assumed = Model(assumed.unloading, assumed.strain_scaling, True, assumed.shape_scatter, assumed.priors)
    findings = campaign_findings(campaign)
    wrong = [one for one in check_plausibility(campaign.raw or campaign) if one.level == "bad"]
    if wrong:
        return _not_settled((*wrong, *findings), seed, started)
    base, left_out = _settled_fit(campaign, findings, assumed, threshold_MPa, tell)
    findings = (*findings, *left_out)
    testable, missing = untestable(without_punch(known, base), available_data(campaign))
    if not testable:
        raise InputError("no mechanism is left to look for", remedy="Exclude fewer, or measure what the others need.")
    if not bool(np.all(np.asarray(base.fit.converged)[1:])) or not _mostly_converged(base):
        return _not_converged(base, findings, missing, seed, started)
    tell("signatures of all effects")
    signals = signals_of(base, testable, turned=True)
    system = build_system(base, signals)
    for _ in range(REFINEMENTS):
        tell("noise without what is systematic")
        base, changed = refined(base, system, signals)
        if not changed:
            break
        system = build_system(base, signals)
    found = _judge(base, system, signals, missing, confirm, experiments, posterior, seed, tell)
    found = dataclasses.replace(found, checks=_checks(known, found.candidate_set))
    found = dataclasses.replace(found, findings=findings, notes=(*map(str, findings), *found.notes))
    return dataclasses.replace(found, summary=summary_of(found), runtime_s=time.perf_counter() - started)


def _settled_fit(
    campaign: Campaign,
    findings: Sequence[Finding],
    model: Model,
    threshold_MPa: float,
    tell: Callable[[str], None],
) -> tuple[Base, list[Finding]]:
    """The base fit of the tests that are of one kind, and what is said of those left out.

    Particles whose turning point cannot be relied on, and those whose residual is unlike all others', would be taken
    for physics. They take no part in the search.
    """
    unsafe = tuple(dict.fromkeys(name for one in findings if one.level == "bad" for name in one.particles))
    told = []
    if unsafe and len(unsafe) < len(campaign):
        told.append(_left_out(unsafe, len(campaign), "cannot be relied on, as said above"))
        campaign = campaign.without(*unsafe)
    base = base_fit(campaign, model, threshold_MPa=threshold_MPa, tell=tell)
    rms = root_mean_squares(base.tests, base.fit.residual)
    names = [base.name_of(row) for row in range(len(base.tests))]
    outlying = unlike_others(names, rms, ranges_um(base.tests))
    if outlying is not None:
        told.append(dataclasses.replace(outlying, sentence=f"{outlying.sentence}; it takes no part in the search"))
        base = base_fit(campaign.without(*outlying.particles), model, threshold_MPa=threshold_MPa, tell=tell)
    return base, told


def _left_out(names: tuple[str, ...], of: int, why: str) -> Finding:
    return Finding("left out", "look", f"{named(names, of)}: {why}; no part in the search", "", names)


def _checks(known: Mapping[str, Mechanism], sets: Sequence[tuple[str, ...]]) -> tuple[dict[str, str], ...]:
    """For every mechanism that has rivals, what would show it by itself."""
    rivals = dict.fromkeys(name for names in sets if len(names) > 1 for name in names)
    return tuple({"mechanism": name, "check": known[name].check} for name in rivals if known[name].check)


def _mostly_converged(base: Base) -> bool:
    return float(np.mean(np.asarray(base.fit.individual.converged))) >= 0.7


def _not_converged(base: Base, findings: Sequence[Finding], missing, seed: int, started: float) -> Discovery:
    reasons = [
        name
        for name, fine in zip(("particles", "noise", "population"), np.asarray(base.fit.converged), strict=True)
        if not fine
    ]
    summary = (
        f"The base law could not be fitted well enough to ask what it lacks (not converged: {', '.join(reasons)}). "
        "Nothing is named. Look at the curves and the diameters, leave out damaged tests, and try again."
    )
    before = population_parameters(base, None)
    return _nothing_asked(summary, base, before, findings, missing, seed, started)


def _not_settled(findings: Sequence[Finding], seed: int, started: float) -> Discovery:
    """The answer for tests whose numbers cannot be true: no physics is looked for before that is settled."""
    summary = f"These numbers cannot be true as they stand: {findings[0]} Nothing is looked for before that is settled."
    return _nothing_asked(summary, None, {}, findings, (), seed, started)


def _nothing_asked(
    summary: str,
    base: Base | None,
    before: dict[str, Any],
    findings: Sequence[Finding],
    missing,
    seed: int,
    started: float,
) -> Discovery:
    return Discovery(
        verdict="FIT_NOT_CONVERGED",
        summary=summary,
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
        before=before,
        after={},
        next_experiments=(),
        limits={},
        seed=seed,
        runtime_s=time.perf_counter() - started,
        findings=tuple(findings),
        notes=tuple(map(str, findings)),
    )


def _judge(
    base: Base,
    system: System,
    signals: Signals,
    missing,
    confirm: bool,
    experiments: bool,
    posterior: bool,
    seed: int,
    tell,
) -> Discovery:
    tell("is something missing")
    view = project(system, system.candidate_columns)
    ranking = rank(system, view)
    p_common = p_nothing_left(system, seed, [])
    p_random = random_probability(system, view, seed)
    tests = ((p_common, LEVEL), (p_random, LEVEL_AT_RANDOM))
    p_any = min(1.0, *(p * 0.05 / level for p, level in tests))
    gap = p_any <= 0.05
    notes = _notes(base, system)
    verdict: Verdict = "NO_GAP"
    chosen: list[int] = []
    sets: list[tuple[str, ...]] = []
    closure: Closure | None = None
    steps: list[Ranking] = []
    disagree: list[dict[str, Any]] = []
    extensions = Extensions(base, system, signals)
    extended, last, around = system, None, {}
    drops: dict[int, float] = {}
    if gap:
        tell("where")
        disagree = where(base, system)
        tell("what")
        large = ranking.gain[0] >= LARGE
        if large:
            tell("the serious names, fitted as they are")
            drops = {k: extensions.drop((k,)) for k in serious(system, ranking)}
            ranking = rank(system, view, refitted=drops)
        verdict, chosen, sets, steps = name_missing(system, view, ranking, extensions if large else None, seed, tell)
        if verdict == "UNLISTED":
            tell("a formula of its own")
            closure, system = find_closure(base, signals, system, span_of(base), seed, tell=tell)
            extended = system
        if large and chosen and not any(step.at_random[0] for step in steps):
            last = extensions.fit(tuple(chosen))
            if last.physical:
                extended = extensions.system_of(tuple(chosen))
                around[frozenset(system.column(k) for k in chosen)] = extended
    fits = None if last is None or extended is system else (extensions.fit(()), last)
    effects = estimated_effects(extended, last, chosen, steps, p_any)
    inside = np.array([system.column(k) for k in chosen], int)
    words = closure.words if closure is not None else np.array([], int)
    after = {}
    if gap:
        with_all = np.concatenate([inside, words]).astype(int)
        after = population_parameters(base, project(extended, inside[:0], inside=with_all), extended.shift)
    sampled = None
    if posterior and chosen and not any(effect.at_random for effect in effects):
        tell("posterior of the law with effects")
        last = extensions.fit(tuple(chosen))
        sampled = extended_posterior(base, last, seed=seed) if last.physical else None
        if sampled is None:
            notes.append(
                "the posterior of the law with effects is not sampled: fitted as it is, an amplitude has a sign that "
                "it cannot have; amplitudes and parameters are those of the linear system"
            )
        elif failures := sampled.failures():
            notes.append(
                f"the posterior of the law with effects has not converged ({'; '.join(failures)}); amplitudes and "
                "parameters are those of its fit"
            )
        else:
            effects = tuple(with_draws(effect, sampled.effect_draws(i)) for i, effect in enumerate(effects))
            after = sampled.parameters()
    ladder, labels = None, (None,)
    if confirm and gap and int(system.usable.sum()) > 2:
        tell("held-out particles")
        ladder = held_out(system, chooser(system, len(chosen), closure), around)
        labels = (None, *(e.mechanism for e in effects), *(("formula",) if closure is not None else ()))
    further: list[dict[str, Any]] = []
    if experiments and gap:
        tell("next experiments")
        # Two names were judged in the linear system.
        refitted = drops if len(chosen) == 1 else {}
        further = next_experiments(base, system, chosen, steps, refitted=refitted, seed=seed)
    return Discovery(
        verdict=verdict,
        summary="",
        base=base,
        system=system,
        effects=effects,
        candidate_set=tuple(sets),
        ranking=ranking,
        untestable=tuple(missing),
        where=tuple(disagree),
        closure=closure,
        held_out=ladder,
        labels=labels,
        p_any=p_any,
        before=population_parameters(base, project(system, inside[:0])),
        after=after,
        next_experiments=tuple(further),
        limits=detection_limits(system, view, ranking),
        posterior=sampled,
        seed=seed,
        runtime_s=0.0,
        notes=tuple(notes),
        residuals=residuals(base, system, signals, inside, words, fits),
        places=places(system),
        likeness=likeness(system, ranking, sets, chosen),
    )


def _notes(base: Base, system: System) -> list[str]:
    notes = list(base.selection.notes)
    notes.extend(
        f"particle {base.name_of(i)!r} snaps through in its loading; it is fitted, but takes no part in the search"
        for i in np.flatnonzero(~system.usable).tolist()
    )
    for name, reason in zip(base.campaign.particles, base.selection.why_not, strict=True):
        if reason is not None:
            notes.append(f"particle {name!r} {reason}")
    if int(system.usable.sum()) < MIN_PARTICLES:
        notes.append(
            f"{int(system.usable.sum())} usable particles: their scatter says nothing, so significance rests on the "
            "noise model"
        )
    return notes
