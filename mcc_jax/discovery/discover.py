"""The workflow: fit, search, is anything missing, what, where, how sure, does it close the gap, what next."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import with_sd
from .._types import Progress
from ..calibrate import Model, sample
from ..calibrate.data import ranges_um, root_mean_squares
from ..calibrate.fitting import checked_settings
from ..calibrate.judgement import LEAST_LEFT, is_unknown, numbers_in_reach, unlike_others
from ..calibrate.running import one_blas_thread
from ..campaign import Campaign, Finding, available_data, campaign_findings, check_plausibility, check_tests
from ..campaign.findings import named
from ..campaign.force_zero import open_zero
from ..campaign.plausibility import NO_SOLID
from ..effects import LIBRARY, Mechanism
from ..law import Unloading
from . import answer
from .base import Base, Library, base_fit
from .closure import closure
from .design import design_of
from .fit import fit_hypothesis
from .hypothesis import Names
from .plan import next_experiments, without_effects
from .result import Discovery
from .screen import located, untestable, without_punch
from .search import Search
from .sentences import FORM, summary_of, taken_back
from .settings import AT_PEAKS, STRONG, UNLISTED
from .verify import held_out, p_anything

Fit = Callable[[Campaign], Base]  # of the base law

LEAST = 3  # particles of which one can be held out
LINEAR = "amplitudes and parameters are those of the linear model at its optimum"


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
        library, exclude: mechanisms to look for, the whole `mcc_jax.effects.LIBRARY` if None, and names to leave out.
        threshold_MPa: points below this stress do not count [MPa]. All count by default, unlike in a calibration: what
            surface asperities do is an effect of its own, and at low load many effects show most.
        confirm: choose and fit again without each particle, and see how far that particle is then from the law.
        experiments: work out which further test would separate the members of a set.
        posterior: sample the posterior of the law with what was found, in place of errors of the linear model.
        seed: of the bootstrap and the sampler.
        progress: called with the name of each step.

    Raises:
        InputError: if no particle can be used, a name to exclude is not known, or no mechanism is left to look for.
    """
    started = time.perf_counter()
    campaign = check_tests(campaign)
    progress, assumed, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    seed = arguments.seed(seed)
    for name, value in (("confirm", confirm), ("experiments", experiments), ("posterior", posterior)):
        arguments.flag(value, name)
    known = dict(LIBRARY if library is None else library)
    for name in exclude:
        arguments.choice(name, known, "mechanism")
        known.pop(name)
    findings = campaign_findings(campaign)
    wrong = [one for one in check_plausibility(campaign.raw or campaign) if one.level == "error"]
    if wrong:
        summary = f"These numbers are implausible: {wrong[0]} Nothing is looked for before that is settled."
        found = Discovery("FIT_NOT_CONVERGED", summary, None, None, seed, 0.0)
        return _finished(found, (*wrong, *findings), started)
    fitted = partial(base_fit, model=without_effects(assumed), threshold_MPa=threshold_MPa, progress=progress)
    begun = partial(_begun, fitted=fitted, known=known, progress=progress)
    search = _run(begun(campaign, findings), seed)
    if search.is_gap:
        search = _not_tared(campaign, search, begun, seed) or _other_form(search, assumed, seed) or search
    base, findings = search.base, (*findings, *search.left_out)
    if search.outliers > STRONG:
        text = f"The noise has outliers that fade (log evidence {search.outliers:.0f}): not every jump is a particle's"
        findings = (*findings, Finding("outliers of the noise", "info", text, ""))
    ranking = answer.ranking_of(search)
    # By the law alone, under the model's own noise: those of a calibration.
    alone = answer.population_under(base, None, base.hyperparameters, design_of(base, base.state))
    why_not = zip(base.campaign.particles, base.selection.why_not, strict=True)
    notes = [*base.selection.notes, *(f"particle {name!r} {why}" for name, why in why_not if why is not None)]
    if len(base.tests) < LEAST:
        notes.append("of fewer than three particles none can be held out: what is found rests on the noise model alone")
    found = Discovery(
        verdict="NO_GAP",
        summary="",
        base=base,
        model=base.model,
        seed=seed,
        runtime_s=0.0,
        ranking=ranking,
        untestable=tuple(search.untestable),
        p_any=search.p_any,
        parameters_before=answer.averaged([alone], np.ones(1), len(base.tests)),
        notes=tuple(notes),
        likeness=answer.likeness_of(search, (), ranking),
    )
    if not search.is_gap:
        return _finished(_of_law_alone(found, search), findings, started)
    winner = search.leader
    if confirm and len(base.tests) >= LEAST:
        progress("held-out particles")
        held = held_out(search, winner)
        found = replace(found, held_out=held)
        rms_um = [root_mean_squares(base.tests, one) for one in held.residual_um]
        if objection := held.objection(rms_um, ranges_um(base.tests)):
            summary = taken_back(() if winner == UNLISTED else winner, objection)
            found = replace(_of_law_alone(found, search), verdict="FIT_NOT_CONVERGED", summary=summary)
            return _finished(found, findings, started)
    found = _named(found, search, winner, known)
    separate = [e.mechanism for e in found.effects if located(e.variant)]
    if separate:
        note = f"{', '.join(separate)} differs from test to test: it is no part of the model found, and {LINEAR}"
        found = replace(found, notes=(*found.notes, note))
    elif posterior and found.effects:
        found = _sampled(found, search, winner)
    if experiments and len(found.candidate_set) == 1:
        progress("next experiments")
        paired = {name for pair in found.pairs for name in pair}
        alone = tuple(n for n in found.candidate_set[0] if n not in paired)
        found = replace(found, next_experiments=tuple(next_experiments(search, alone)))
    return _finished(found, findings, started)


def _begun(campaign: Campaign, findings: Sequence[Finding], fitted: Fit, known: Library, progress: Progress) -> Search:
    """The search with the law alone in it."""
    base, left_out = _settled_fit(campaign, findings, fitted)
    known = without_punch(known, base)
    testable, missing = untestable(known, available_data(campaign))
    if not testable:
        raise InputError("no mechanism is left to look for", remedy="Exclude fewer, or measure what the others need.")
    progress("signatures of all effects")
    with numbers_in_reach(base.campaign):
        search = Search(base, testable, known, progress)
    search.untestable, search.left_out = missing, left_out
    return search


def _settled_fit(campaign: Campaign, findings: Sequence[Finding], fitted: Fit) -> tuple[Base, list[Finding]]:
    """The base fit without tests that cannot be relied on or are unlike all others, and what is said of these."""
    unsafe = tuple(dict.fromkeys(name for one in findings if one.level == "error" for name in one.particles))
    left_out = []
    if unsafe and len(unsafe) < len(campaign):
        text = f"{named(unsafe, len(campaign))}: cannot be relied on, as said above; no part in the search"
        left_out.append(Finding("left out", "warning", text, "", unsafe))
        campaign = campaign.without(*unsafe)
    base = fitted(campaign)
    outlying, without = unlike_others(base.names, base.rms_um, ranges_um(base.tests)), ()
    snapping = tuple(name for name, low in zip(base.names, base.snaps, strict=True) if low)
    if outlying is not None:
        left_out.append(replace(outlying, sentence=f"{outlying.sentence}; it takes no part in the search"))
        without = outlying.particles
    left = len(base.tests) - len({*snapping, *without})
    if snapping and not base.coarse and left >= LEAST_LEFT:
        text = f"{named(snapping, len(campaign))}: the law snaps through in its loading; it takes no part in the search"
        left_out.append(Finding("snap-through", "info", text, "", snapping))
        without = tuple(dict.fromkeys((*without, *snapping)))
    if without:
        base = fitted(campaign.without(*without))
    return base, left_out


def _run(search: Search, seed: int) -> Search:
    """The search with all hypotheses worked out, and how likely so much evidence of anything is by chance."""
    with numbers_in_reach(search.base.campaign):
        search = search.run()
        search.progress("is anything missing")
        search.p_any = p_anything(search, seed)
    return search


def _not_tared(campaign: Campaign, search: Search, begun: Callable[..., Search], seed: int) -> Search | None:
    """The search with another zero of force, if with it nothing is missing and the evidence is larger; else None."""
    zero = open_zero(campaign)
    if zero is None:
        return None
    search.progress("the same, had the load cell not been tared")
    assert campaign.raw is not None
    tared = check_tests(campaign.raw, zero_mN=zero)
    other = begun(tared, campaign_findings(tared))
    best = max(one.log_evidence for one in search.found.values())
    # Readings without force are not compared, so evidence counts by the reading.
    readings, as_read = (int(one.base.tests.mask.sum()) for one in (other, search))
    if other.null.log_evidence / readings <= best / as_read:
        return None
    other = _run(other, seed)
    if other.is_gap:
        return None
    text = (
        f"With the zero of the file, law and tests disagree; with {zero[0]:.3g} mN taken off every force they do not: "
        "a load cell that was not tared is explanation enough, and nothing is named"
    )
    remedy = "Take a record that begins in the air; if the particles were preloaded, something is missing after all"
    other.left_out.insert(0, Finding("zero of force", "warning", text, remedy))
    return other


def _other_form(search: Search, assumed: Model, seed: int) -> Search | None:
    """The search in the other form of the law's unloading, if the tests follow that one; else None.

    The two punch forms give the same curves with other moduli: they are one hypothesis.
    """
    if assumed.priors is not None:  # those of the modulus belong to the form that was asked for
        return None
    asked = search.base.model.unloading
    form = Unloading.PUNCH if asked is Unloading.PRINTED else Unloading.PRINTED
    base = search.base.in_form(form)
    with numbers_in_reach(base.campaign):
        alone = fit_hypothesis(base, base.state, (), (), search.null.optimum.hyper)
        if alone.log_evidence < search.null.log_evidence + STRONG:
            return None
        search.progress("the same in the law's other form of unloading")
        base = replace(base, state=alone.state, hyperparameters=alone.optimum.hyper)
        noise = None if search.noise is None else alone.optimum.hyper
        other = Search(base, search.library, search.whole, search.progress, noise)
        if not other.comes_near(search.leader, max(one.alone for one in search.found.values())):
            return None
    other = _run(other, seed)
    best, other_best = (max(one.log_posteriors().values()) for one in (search, other))
    if other_best < best + STRONG:
        return None
    text = f"The tests follow the law in its form of unloading {form.value!r}, not {asked.value!r} "
    text += f"(log evidence larger by {other_best - best:.0f}"
    moduli = [answer.parameters_with(one)["effective_modulus_MPa"] for one in (search, other)]
    if not search.base.coarse and not any(map(is_unknown, moduli)):
        here, there = (with_sd(one, 1e-3) for one in moduli)
        text += f"; effective modulus {there} GPa, not {here} GPa"
    text += ")"
    remedy = f"Calibrate in this form, Model(unloading={form.value!r}): the modulus belongs to it"
    found = Finding("form of unloading", "warning", text, remedy, code=FORM)
    other.untestable, other.left_out = search.untestable, [found, *search.left_out]
    return other


def _of_law_alone(found: Discovery, search: Search) -> Discovery:
    """The answer with what the law alone leaves, and where."""
    left = answer.residuals_of(search.base, search.null, search.null)
    return replace(found, residuals=left, places=answer.places(search.base, left.before))


def _named(found: Discovery, search: Search, winner: Names, known: Library) -> Discovery:
    """The answer with the leading hypothesis: effects or a formula, where, and what it did to the parameters."""
    fitted = search.found[winner].fitted
    left = answer.residuals_of(search.base, search.null, fitted)
    map_ = answer.places(search.base, left.before - left.after)
    found = replace(
        found,
        residuals=left,
        places=map_,
        where=tuple(answer.where(search.base, map_)),
        parameters_after=answer.parameters_with(search),
        leads=answer.leads_of(search, winner),
    )
    if winner == UNLISTED:
        search.progress("a formula of its own")
        return replace(found, verdict="UNLISTED", closure=closure(search, found.seed))
    effects = answer.effects_of(search, winner, found.p_any)
    pairs = answer.instead_of(search, winner)
    sets = answer.sets_of(search, winner, effects, pairs)
    rivals = dict.fromkeys(name for names in sets if len(names) > 1 for name in names)
    return replace(
        found,
        verdict="SET" if any(len(names) > 1 for names in sets) else "NAMED",
        model=search.base.model.with_effects(*(e.variant for e in effects if not located(e.variant))),
        effects=effects,
        candidate_set=sets,
        pairs=pairs,
        checks=tuple({"mechanism": name, "check": known[name].check} for name in rivals if known[name].check),
        likeness=answer.likeness_of(search, sets, found.ranking),
    )


def _sampled(found: Discovery, search: Search, winner: Names) -> Discovery:
    """The answer with the posterior of the law with effects, if it may be believed."""
    search.progress("posterior of the law with effects")
    base, fitted, model = search.base, search.found[winner].fitted, found.model
    assert model is not None
    start = fitted.start(base) if fitted.variants == model.effects else None
    given: dict[str, Any] = {"threshold_MPa": base.threshold_MPa, "seed": found.seed, "progress": search.progress}
    drawn = sample(base.campaign, model, without_flagged=False, start=start, **given)
    found = replace(found, posterior=drawn)
    if drawn.failures():
        note = f"the posterior of the law with effects has not converged ({'; '.join(drawn.failures())}); {LINEAR}"
        return replace(found, notes=(*found.notes, note))
    found = replace(found, effects=tuple(answer.with_draws(effect, drawn) for effect in found.effects))
    if found.verdict == "SET" or any(effect.misfit for effect in found.effects):
        # The draws take the leading formula for true: their errors would be too small.
        note = (
            "parameters and their errors allow for what else may be missing and for how far the formula is off; the "
            "posterior's draws take the formula unchanged"
        )
        return replace(found, notes=(*found.notes, note))
    parameters: dict[str, Any] = {k: v for k, v in drawn.answer().items() if k != "converged"}
    linear = found.parameters_after
    same = linear[AT_PEAKS]["value"] == linear["effective_modulus_MPa"]["value"]
    parameters[AT_PEAKS] = parameters["effective_modulus_MPa"] if same else linear[AT_PEAKS]
    return replace(found, parameters_after=parameters)


def _finished(found: Discovery, findings: Sequence[Finding], started: float) -> Discovery:
    """The answer with findings, its sentence and the time it took."""
    modulus = (found.parameters_after or found.parameters_before).get("effective_modulus_MPa")
    if found.base is not None and modulus is not None and not is_unknown(modulus):
        fitted = check_plausibility(found.base.campaign, modulus_MPa=modulus["value"])
        findings = (*findings, *(one for one in fitted if one.check == NO_SOLID))
    found = replace(found, findings=tuple(findings), notes=(*map(str, findings), *found.notes))
    summary = found.summary or summary_of(found)
    return replace(found, summary=summary, runtime_s=time.perf_counter() - started)
