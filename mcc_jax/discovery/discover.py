"""The workflow: fit, search, is anything missing, what, where, how sure, does it close the gap, what next."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from .. import arguments
from .._errors import InputError
from .._format import listed, plain
from .._types import Progress
from ..calibrate import Model, Posterior, sample
from ..calibrate.compiling import one_blas_thread
from ..calibrate.data import root_mean_squares
from ..calibrate.fitting import checked_settings
from ..calibrate.judgement import LEAST_LEFT, numbers_in_reach, unlike_others
from ..campaign import Campaign, Finding, available_data, campaign_findings, check_plausibility, check_tests
from ..campaign.findings import named
from ..campaign.force_zero import open_zero
from ..effects import LIBRARY, Mechanism
from . import answer
from .base import Base, base_fit
from .bootstrap import p_anything
from .candidates import located, untestable, without_punch
from .closure import closure
from .experiments import next_experiments
from .heldout import held_out
from .hypothesis import UNLISTED, Names
from .locate import difference, places, where
from .plan import without_effects
from .result import Discovery, Effect
from .search import Search
from .sentences import summary_of
from .settings import AT_PEAKS, DECISIONS

_Begun = tuple[Search, list[dict[str, str]], list[Finding]]


@one_blas_thread
def discover(
    campaign: Campaign,
    model: Model | None = None,
    *,
    library: Mapping[str, Mechanism] | None = None,
    exclude: Sequence[str] = (),
    threshold_MPa: float = 0.0,
    confirm: bool = True,
    experiments: bool = True,
    posterior: bool = True,
    seed: int = 0,
    progress: Progress | None = None,
) -> Discovery:
    """Find where law and campaign disagree, name what is missing, and show on held-out particles that it helps.

    Hypotheses are models: nothing is missing; one mechanism, or two, in a formula of the library or one near it; or
    something that no mechanism explains. Their log marginal likelihoods and stated prior odds decide. A verdict other
    than NO_GAP also needs that so much evidence of anything at all would not come about by chance.

    Args:
        campaign: the tests.
        model: form of unloading and priors, without effects; the modulus may always scatter between particles.
        library: mechanisms to look for; the whole `mcc_jax.effects.LIBRARY` if None.
        exclude: names of mechanisms to leave out.
        threshold_MPa: points below this stress do not count [MPa]. All count by default, unlike in a calibration: what
            surface asperities do is an effect of its own, and at low load many effects show most.
        confirm: choose and fit again without each particle, and see how far that particle is then from the law.
        experiments: work out which further test would separate the members of a set.
        posterior: sample the posterior of the law with what was found; without it, amplitudes and parameters come with
            the standard errors of the linear model.
        seed: of the bootstrap and the sampler.
        progress: called with the name of each step.

    Returns:
        The answer; "nothing is missing" and "cannot tell" are answers, too.

    Raises:
        InputError: if no particle can be used, a name to exclude is not known, or no mechanism is left to look for.
    """
    started = time.perf_counter()
    campaign = check_tests(campaign)
    progress, assumed, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    seed = arguments.seed(seed)
    for name, value in (("confirm", confirm), ("experiments", experiments), ("posterior", posterior)):
        arguments.flag(value, name)
    known = _searched(library, exclude)
    findings = campaign_findings(campaign)
    wrong = [one for one in check_plausibility(campaign.raw or campaign) if one.level == "error"]
    if wrong:
        summary = f"These numbers are implausible: {wrong[0]} Nothing is looked for before that is settled."
        found = Discovery("FIT_NOT_CONVERGED", summary, None, None, seed, 0.0)
        return _finished(found, (*wrong, *findings), started)
    begun = partial(_begun, model=without_effects(assumed), known=known, threshold_MPa=threshold_MPa, progress=progress)
    search, missing, left_out = begun(campaign, findings)
    p_any = _run(search, seed, progress)
    if _is_gap(search, p_any):
        explained = _not_tared(campaign, search, begun, seed, progress)
        search, p_any, missing, left_out = explained or (search, p_any, missing, left_out)
    base, findings = search.base, (*findings, *left_out)
    ranking = answer.ranking_of(search)
    found = Discovery(
        "NO_GAP",
        "",
        base,
        base.model,
        seed,
        0.0,
        ranking=ranking,
        untestable=tuple(missing),
        p_any=p_any,
        parameters_before=answer.parameters_alone(base),
        notes=_notes(base),
        likeness=answer.likeness_of(search, (), ranking),
    )
    if not _is_gap(search, p_any):
        return _finished(_of_law_alone(found, search), findings, started)
    winner = answer.leader_of(search).names
    if confirm and base.holds_out:
        progress("held-out particles")
        held = held_out(search, winner)
        found = replace(found, held_out=held)
        assert held.residual_um is not None
        objection = held.objection([root_mean_squares(base.tests, one) for one in held.residual_um], base.range_um)
        if objection is not None:
            return _finished(_taken_back(_of_law_alone(found, search), winner, objection), findings, started)
    found = _named(found, search, known, progress)
    separate = [e.mechanism for e in found.effects if located(e.variant)]
    if separate:
        note = (
            f"{', '.join(separate)} differs from test to test: it is no part of the model found, and amplitudes and "
            "parameters are those of the linear model at its optimum"
        )
        found = replace(found, notes=(*found.notes, note))
    elif posterior and found.effects:
        found = _sampled(found, search, threshold_MPa, seed, progress)
    if experiments and found.candidate_set and len(found.candidate_set) == 1:
        progress("next experiments")
        alone = tuple(n for n in found.candidate_set[0] if n not in found.paired)
        found = replace(found, next_experiments=tuple(next_experiments(search, alone)))
    return _finished(found, findings, started)


def _searched(library: Mapping[str, Mechanism] | None, exclude: Sequence[str]) -> dict[str, Mechanism]:
    """The mechanisms to look for."""
    if isinstance(exclude, str) or not isinstance(exclude, Iterable):
        remedy = f"Write exclude=({exclude!r},)." if isinstance(exclude, str) else None
        raise InputError(f"exclude must be a list of names, got {arguments.kind_of(exclude)}", remedy=remedy)
    known = dict(LIBRARY if library is None else library)
    for name in exclude:
        if name not in known:
            raise InputError(f"there is no mechanism {name!r}", remedy=f"Known: {', '.join(known)}.")
        known.pop(name)
    return known


def _begun(
    campaign: Campaign,
    findings: Sequence[Finding],
    *,
    model: Model,
    known: Mapping[str, Mechanism],
    threshold_MPa: float,
    progress: Progress,
) -> _Begun:
    """The search with the law alone in it, what these tests cannot say, and what was left out."""
    base, left_out = _settled_fit(campaign, findings, model, threshold_MPa, progress)
    known = without_punch(known, base)
    testable, missing = untestable(known, available_data(campaign))
    if not testable:
        raise InputError("no mechanism is left to look for", remedy="Exclude fewer, or measure what the others need.")
    progress("signatures of all effects")
    with numbers_in_reach(base.campaign):
        return Search(base, testable, progress, whole=known), missing, left_out


def _run(search: Search, seed: int, progress: Progress) -> float:
    """Work all hypotheses out; how likely so much evidence of anything is by chance."""
    with numbers_in_reach(search.base.campaign):
        search.run()
        progress("is anything missing")
        return p_anything(search, seed)


def _is_gap(search: Search, p_any: float) -> bool:
    """Whether anything is missing."""
    return p_any < DECISIONS.level and search.posterior()[()] < 0.5


def _not_tared(
    campaign: Campaign, search: Search, begun: Callable[..., _Begun], seed: int, progress: Progress
) -> tuple[Search, float, list[dict[str, str]], list[Finding]] | None:
    """The search with what the tests begin at taken off their force, where the law alone then does; None elsewhere.

    Its evidence must be larger than that of anything named with the zero of the file, and nothing may be missing there.
    """
    zero = open_zero(campaign)
    if zero is None:
        return None
    progress("the same, had the load cell not been tared")
    assert campaign.raw is not None
    tared = check_tests(campaign.raw, zero_mN=zero)
    other, missing, left_out = begun(tared, campaign_findings(tared))
    best = max(one.log_evidence for one in search.found.values())
    # Readings without force are not compared, so evidence counts by the reading.
    if other.null.log_evidence / other.base.readings <= best / search.base.readings:
        return None
    p_any = _run(other, seed, progress)
    if _is_gap(other, p_any):
        return None
    text = (
        f"With the zero of the file, law and tests disagree; with {zero[0]:.3g} mN taken off every force they do not: "
        "a load cell that was not tared is explanation enough, and nothing is named"
    )
    remedy = "Take a record that begins in the air; if the particles were preloaded, something is missing after all"
    return other, p_any, missing, [Finding("zero of force", "warning", text, remedy), *left_out]


def _settled_fit(
    campaign: Campaign, findings: Sequence[Finding], model: Model, threshold_MPa: float, progress: Progress
) -> tuple[Base, list[Finding]]:
    """The base fit of the tests that are of one kind, and what is said of those left out.

    Particles whose turning point cannot be relied on, and those whose residual is unlike all others', would be taken
    for physics. They take no part in the search.
    """
    unsafe = tuple(dict.fromkeys(name for one in findings if one.level == "error" for name in one.particles))
    left_out = []
    if unsafe and len(unsafe) < len(campaign):
        text = f"{named(unsafe, len(campaign))}: cannot be relied on, as said above; no part in the search"
        left_out.append(Finding("left out", "warning", text, "", unsafe))
        campaign = campaign.without(*unsafe)
    base = base_fit(campaign, model, threshold_MPa=threshold_MPa, progress=progress)
    outlying, snapping = unlike_others(base.names, base.rms_um, base.range_um), base.snapping
    without: tuple[str, ...] = ()
    if outlying is not None:
        left_out.append(replace(outlying, sentence=f"{outlying.sentence}; it takes no part in the search"))
        without = outlying.particles
    left = len(base.tests) - len({*snapping, *without})
    if snapping and not base.coarse and left >= LEAST_LEFT:
        text = f"{named(snapping, len(campaign))}: the law snaps through in its loading; it takes no part in the search"
        left_out.append(Finding("snap-through", "info", text, "", snapping))
        without = (*without, *(name for name in snapping if name not in without))
    if without:
        base = base_fit(campaign.without(*without), model, threshold_MPa=threshold_MPa, progress=progress)
    return base, left_out


def _named(found: Discovery, search: Search, known: Mapping[str, Mechanism], progress: Progress) -> Discovery:
    """The answer with the leading hypothesis: effects or a formula, where, and what it did to the parameters."""
    leader = answer.leader_of(search)
    winner: Names = leader.names
    left = answer.residuals_of(search, winner)
    map_ = places(search.base, difference(left.before, left.after, left.used))
    found = replace(
        found,
        residuals=left,
        places=map_,
        where=tuple(where(search.base, map_)),
        parameters_after=answer.parameters_with(search, answer.likely(search)),
        leads=answer.leads_of(search, winner),
    )
    if winner == UNLISTED:
        progress("a formula of its own")
        return replace(found, verdict="UNLISTED", closure=closure(search, found.seed))
    effects = answer.effects_of(search, winner, answer.name_probabilities(search), found.p_any)
    pairs = answer.instead_of(search, winner)
    sets = answer.sets_of(search, winner, effects, pairs)
    model = found.model
    assert model is not None
    model = model.with_effects(*(e.variant for e in effects if not located(e.variant)))
    return replace(
        found,
        verdict="SET" if any(len(names) > 1 for names in sets) else "NAMED",
        model=model,
        effects=effects,
        candidate_set=sets,
        pairs=pairs,
        checks=answer.checks_of(known, sets),
        likeness=answer.likeness_of(search, sets, found.ranking),
    )


def _of_law_alone(found: Discovery, search: Search) -> Discovery:
    """The answer with what the law alone leaves, and where."""
    left = answer.residuals_of(search, None)
    return replace(found, residuals=left, places=places(search.base, difference(left.before, None, left.used)))


def _taken_back(found: Discovery, winner: Names, objection: str) -> Discovery:
    """No answer: the law misses these tests, and what would explain it does not hold on held-out particles."""
    names = "a formula of its own" if winner == UNLISTED else listed(list(map(plain, winner)))
    summary = (
        f"The law does not describe these tests, and nothing was found that does. What explains most is {names}, but "
        f"of particles that took no part {objection}. Look at the tests one by one: records that run on through slips "
        "or breakage, particles of several kinds, or another material than the law was made for would do this; leave "
        "out what is no test of one particle, and discover again."
    )
    return replace(found, verdict="FIT_NOT_CONVERGED", summary=summary)


def _sampled(found: Discovery, search: Search, threshold_MPa: float, seed: int, progress: Progress) -> Discovery:
    """The answer with the posterior of the law with effects, if it may be believed."""
    progress("posterior of the law with effects")
    base, fitted = search.base, answer.leader_of(search).at
    same = fitted is not None and found.model is not None and fitted.variants == found.model.effects
    drawn: Posterior = sample(
        base.campaign,
        found.model,
        threshold_MPa=threshold_MPa,
        seed=seed,
        without_flagged=False,
        start=fitted.start(base) if fitted is not None and same else None,
        progress=progress,
    )
    if drawn.failures():
        note = (
            f"the posterior of the law with effects has not converged ({'; '.join(drawn.failures())}); amplitudes and "
            "parameters are those of the linear model at its optimum"
        )
        return replace(found, posterior=drawn, notes=(*found.notes, note))
    parameters: dict[str, Any] = {k: v for k, v in drawn.answer().items() if k != "converged"}
    linear = found.parameters_after
    same = linear[AT_PEAKS]["value"] == linear["effective_modulus_MPa"]["value"]
    parameters[AT_PEAKS] = parameters["effective_modulus_MPa"] if same else linear[AT_PEAKS]
    effects: tuple[Effect, ...] = tuple(answer.with_draws(effect, drawn) for effect in found.effects)
    if found.verdict == "SET" or any(effect.misfit for effect in effects):
        # The draws take the leading formula for true: their errors would be too small.
        note = (
            "parameters and their errors allow for what else may be missing and for how far the formula is off; the "
            "posterior's draws take the formula unchanged"
        )
        return replace(found, posterior=drawn, effects=effects, notes=(*found.notes, note))
    return replace(found, posterior=drawn, effects=effects, parameters_after=parameters)


def _notes(base: Base) -> tuple[str, ...]:
    notes = list(base.selection.notes)
    for name, reason in zip(base.campaign.particles, base.selection.why_not, strict=True):
        if reason is not None:
            notes.append(f"particle {name!r} {reason}")
    if not base.holds_out:
        notes.append("of fewer than three particles none can be held out: what is found rests on the noise model alone")
    return tuple(notes)


def _finished(found: Discovery, findings: Sequence[Finding], started: float) -> Discovery:
    """The answer with findings, its sentence and the time it took."""
    found = replace(found, findings=tuple(findings), notes=(*map(str, findings), *found.notes))
    summary = found.summary or summary_of(found)
    return replace(found, summary=summary, runtime_s=time.perf_counter() - started)
