"""From a search to its answer: parameters of the law, effects with their numbers, sets, rankings, what remains."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.special import softmax

from ..calibrate import Posterior
from ..calibrate.estimates import estimate, finite, summary
from ..calibrate.forward import Forms
from ..calibrate.population import COEFFICIENTS
from ..campaign import available_data
from ..effects import EQUIVALENCES
from ..effects.record import HOLD, LOAD, RELOAD, UNLOAD, Record
from ..geometry import Particle
from .base import Base
from .design import Design, further_priors
from .evidence import LinearModel, Solution, around, residual_of, whitened
from .fit import Fitted, moved
from .hypothesis import Names, RandomEffects
from .result import Effect, Likeness, Place, Residuals
from .search import Search
from .settings import AT_PEAKS, DECISIONS, DETECTABLE, POPULATION, UNLISTED

Estimates = tuple[np.ndarray, np.ndarray, np.ndarray]  # means, errors, spreads between particles
KINDS = {LOAD: "loading", HOLD: "hold", UNLOAD: "unloading", RELOAD: "reloading"}
BINS = 5  # of load in which disagreement is looked for
REPORTED = 0.85  # places are reported until they hold this share of the disagreement
LEAD = 3.0  # log posterior odds from which on what remains next to a name is reported


def parameters_with(search: Search) -> dict[str, Any]:
    """The population's parameters, averaged over the most probable hypotheses (Hoeting et al. 1999)."""
    each, weights = [], []
    for names, probability in search.posterior().items():
        one = search.found[names]
        if sum(weights) < DECISIONS.set_mass and one.at is not None:
            each.append(population_under(search.base, one.at, *one.likely_form()))
            weights.append(probability)
    return averaged(each, np.array(weights) / sum(weights), len(search.base.tests))


def averaged(each: Sequence[Estimates], weights: np.ndarray, particles: int) -> dict[str, Any]:
    """Parameters by name from weighted estimates: log C as Student's t with one degree of freedom less than there are
    particles, a and the modulus, which no spread of particles limits, as normal."""
    from scipy.optimize import root_scalar
    from scipy.stats import t as student

    mean, sd, tau = (np.array(parts) for parts in zip(*each, strict=True))
    freedom = np.array([np.inf, np.inf, *3 * [max(particles - 1.0, 1.0)], np.inf])
    # Of three degrees of freedom and more Student's t has a standard deviation.
    wider = np.where(freedom > 2, student.std(freedom), 1.0)
    middle = weights @ mean
    wide = np.sqrt(weights @ ((sd * wider) ** 2 + (mean - middle) ** 2))
    far = student.ppf(0.999, freedom) * sd
    least, most = np.min(mean - far, 0), np.max(mean + far, 0)

    def quantile(q: float, j: int) -> float:
        """Of the mixture of Student's t distributions, normal ones of infinite freedom."""

        def below(x: float) -> float:
            return float(weights @ student.cdf((x - mean[:, j]) / sd[:, j], freedom[j])) - q

        return root_scalar(below, bracket=(least[j], most[j])).root

    def modulus(log: float, sd: float, ends: tuple[float, float]) -> dict[str, Any]:
        return estimate(math.exp(log), math.exp(log) * sd, (math.exp(ends[0]), math.exp(ends[1])))

    numbers = zip(middle.tolist(), wide.tolist(), range(len(middle)), strict=True)
    a, log_modulus, *logs, at_peaks = [(m, sd, (quantile(0.025, j), quantile(0.975, j))) for m, sd, j in numbers]
    spreads = map(estimate, (weights @ tau).tolist())
    coefficients = zip(COEFFICIENTS, logs, spreads, strict=True)
    found = {"a": estimate(*a), "effective_modulus_MPa": modulus(*log_modulus), AT_PEAKS: modulus(*at_peaks)}
    return found | {f"log_{name}": {"mean": estimate(*log), "sd": sd} for name, log, sd in coefficients}


def population_under(base: Base, formulas: Fitted | None, hyper: np.ndarray, design: Design) -> Estimates:
    """Means of a, log modulus, log C1, C3, C5 and log modulus at the peaks under a hypothesis, their errors, and the
    spreads of the coefficients.

    A misfit widens the errors (Brynjarsdottir and O'Hagan 2014). They allow for those of the hyperparameters: by the
    law of total variance, to second order around the mode (Kass and Steffey 1989, J. Am. Stat. Assoc. 84, 717).
    """
    model = LinearModel(hyper, design)
    solution, width = model.solve(), design.common.shape[-1]
    mean, factor = base.population_prior
    beta = mean + factor @ np.asarray(solution.common[:POPULATION])
    rows = np.zeros((POPULATION + 1, width + design.amplitude.shape[-1]))
    rows[:POPULATION, :POPULATION] = factor
    rows[-1], change = rows[1], 0.0
    if formulas is not None:
        change, slope = _modulus_at_peaks(base, formulas, solution)
        names = len(formulas.variants)
        rows[-1, width : width + names] += slope[:names]
        rows[-1, POPULATION : POPULATION + len(slope) - names] += slope[names:]

    def given(model: LinearModel) -> tuple[np.ndarray, np.ndarray]:
        """Means, but for what the hyperparameters do not change, and variances at given ones."""
        found = model.solve()
        means = rows @ np.append(found.common, found.amplitude)
        return means, np.diagonal(rows @ model.covariance() @ rows.T)

    _, least = given(model)
    variance = least.copy()
    for two in around(hyper, design):
        (above, more), (below, less) = (given(LinearModel(at, design)) for at in two)
        variance += ((above - below) / 2) ** 2 + (more + less) / 2 - least
    sd = np.sqrt(np.maximum(variance, least))
    # Where an effect on the modulus begins is its formula's: the modulus without it may be off by a share of it.
    sd[1] = np.hypot(sd[1], DECISIONS.misfit_most * change)
    beta[2:] -= np.mean(np.log1p(np.maximum(beta[0] * base.flatness, -0.99)))
    return np.append(beta, beta[1] + change), sd, model.scales[0][:3]


def _modulus_at_peaks(base: Base, formulas: Fitted, solution: Solution) -> tuple[float, np.ndarray]:
    """Mean logarithm of what effects make of the modulus at every test's largest force, where all good formulas agree,
    and its derivatives by amplitudes and then further numbers, in units of their columns."""
    variants, names = formulas.variants, len(formulas.variants)
    forms, state = Forms(base.model.unloading, variants), formulas.state
    at = jnp.asarray(moved(base, state, variants, solution).point.theta[0])
    if not any(effect.overrides("modify", "stiffness") for effect in forms.build(at)):
        return 0.0, np.zeros(len(at))

    def mean(numbers: Array) -> tuple[Array, Array]:
        def one(latent: Array, particle: Particle, record: Record) -> Array:
            law = forms.law(latent, numbers)
            context = law.context(particle, record)
            factors = (effect.stiffness(context)[record.force.argmax()] for effect in law.effects)
            factor = math.prod(factors, start=jnp.ones(()))
            return jnp.log(factor * context.law.effective_modulus / law.effective_modulus)

        found = jax.vmap(one)(state.point.latent, base.tests.particle, base.tests.record).mean()
        return found, found  # the value, too

    _, sd, positive = further_priors(variants)
    units = [*(v.plausible[0] for v in variants), *sd * np.where(positive, at[names:], 1.0)]
    slope, value = jax.jacfwd(mean, has_aux=True)(at)
    return float(value), np.asarray(slope) * np.array(units)


def effects_of(search: Search, names: Names, p_any: float) -> tuple[Effect, ...]:
    """The effects of a hypothesis with their numbers."""
    one, posterior = search.found[names], search.posterior()
    r = one.at
    if r is None:
        return ()
    # Of each mechanism to be missing, if anything is.
    gap = max(1.0 - posterior.get((), 0.0), 1e-300)
    probability = {m: sum(p for names, p in posterior.items() if m in names) / gap for m in search.library}
    # As wide as with the misfit and the scatter that the tests prefer, as the population's parameters are.
    hyper, design = one.likely_form()
    errors = np.sqrt(np.diagonal(LinearModel(hyper, design).covariance()))[design.common.shape[-1] :]
    further, found = iter(r.theta[len(r.variants) :]), []
    for k, variant in enumerate(r.variants):
        nuisance = {n.name: float(next(further)) for n in variant.nuisances}
        amplitude, sd = float(r.theta[k]), float(errors[k]) * variant.plausible[0]
        size = one.sizes[k] if k < len(one.sizes) and one.is_off else 0.0
        found.append(Effect(variant, nuisance, amplitude, sd, probability[variant.mechanism], p_any, misfit=size))
    if one.own is not None:
        found.append(_of_their_own(one.own, probability[one.own.variant.mechanism], p_any))
    return tuple(sorted(found, key=lambda e: -search.found[(e.mechanism,)].log_evidence))


def _of_their_own(own: RandomEffects, probability: float, p_any: float) -> Effect:
    """A mechanism whose amplitude differs from test to test, or sudden steps."""
    unit = own.variant.plausible[0]
    if own.jumps:
        size = np.array([jump.size for jump in own.jumps])
        spread = np.var(size, ddof=1) if len(size) > 1 else 0.0
        sd = float(np.sqrt(max(spread, np.mean([j.sd**2 for j in own.jumps])) / len(size)))
        places = {n.name: float(np.median([j.stress_MPa for j in own.jumps])) for n in own.variant.nuisances}
        return Effect(own.variant, places, float(size.mean()), sd, probability, p_any, True, jumps=own.jumps)
    place, solution = len(own.at.variants), own.at.solution  # its amplitude comes after that of a formula
    amplitude, sd = float(solution.amplitude[place]) * unit, float(solution.sd[place]) * unit
    return Effect(own.variant, own.nuisance, amplitude, sd, probability, p_any, True)


def with_draws(effect: Effect, posterior: Posterior) -> Effect:
    """The effect with its numbers from the posterior."""
    draws = posterior.named_population()
    amplitude = draws[effect.mechanism]
    further = {n.name: draws[f"{effect.mechanism}.{n.name}"] for n in effect.variant.nuisances}
    return replace(
        effect,
        amplitude=float(amplitude.mean()),
        sd=float(amplitude.std()),
        nuisance={name: float(each.mean()) for name, each in further.items()},
        estimates={effect.variant.parameter: summary(amplitude)} | {n: summary(each) for n, each in further.items()},
    )


def instead_of(search: Search, leader: Names) -> tuple[Names, ...]:
    """Two names that together may be in place of the one that is named, most probable first."""
    left_out = 1.0 - DECISIONS.set_mass
    pairs = (n for n, p in search.posterior().items() if len(n) == 2 and p > left_out)
    return tuple(n for n in pairs if len(leader) == 1 and leader[0] not in n)


def sets_of(search: Search, leader: Names, effects: Sequence[Effect], pairs: Sequence[Names]) -> tuple[Names, ...]:
    """For each effect that was added, itself and what may be in its place, most probable first, `pairs` last; with what
    is equivalent by construction in these tests, however one formula compares to another."""
    present = available_data(search.base.campaign)
    equal = [set(e.names) for e in EQUIVALENCES if e.need is not None and e.need not in present]
    alike = {names: one for names, one in search.found.items() if len(names) == len(leader) and names != UNLISTED}
    found = []
    for effect in effects:
        others = {e.mechanism for e in effects if e is not effect}
        rivals = {}
        for names, one in alike.items():
            if others <= set(names):
                rivals |= dict.fromkeys(set(names) - others, one.log_evidence)
        held, members = 0.0, [effect.mechanism]
        for name, share in sorted(_shares(rivals).items(), key=lambda one: -one[1]):
            if held < DECISIONS.set_mass:
                members.append(name)
                held += share
        members += [n for n in search.library if n not in others and any({n, effect.mechanism} <= e for e in equal)]
        found.append(tuple(dict.fromkeys([*members, *(n for pair in pairs for n in pair)])))
    return tuple(found)


def _shares(logs: Mapping[str, float]) -> dict[str, float]:
    """Probabilities of names among each other, from their log evidences."""
    return dict(zip(logs, softmax(list(logs.values())).tolist(), strict=True))


def leads_of(search: Search, winner: Names) -> tuple[dict[str, Any], ...]:
    """Second names that improve on the winner without leading it by the margin."""
    if len(winner) != 1 or winner == UNLISTED:
        return ()
    alone = search.found[winner].log_evidence
    gap = max(alone - search.null.log_evidence, 1e-300)
    found = []
    for names, pair in search.found.items():
        gain = pair.log_evidence - alone
        if len(names) == 2 and winner[0] in names and gain > LEAD:
            (second,) = set(names) - set(winner)
            found.append({"mechanism": second, "share": float(gain / (gap + gain)), "resembles": []})
    return tuple(sorted(found, key=lambda lead: -lead["share"]))


def ranking_of(search: Search) -> tuple[dict[str, Any], ...]:
    """Every mechanism alone against the base law, most probable first."""
    logs = {m: search.found[(m,)].log_evidence if (m,) in search.found else -np.inf for m in search.library}
    probability = _shares(logs)
    entries: dict[str, dict[str, Any]] = {}
    of_their_own = [search.screened(search.not_shared, several=False)] if search.not_shared else []
    for view in [search.screen, *of_their_own]:
        score, value = view.score[0], view.singles()
        information = np.maximum(view.information, 1e-300)
        z = score / np.sqrt(information)
        shown = view.information > 1e-12 * view.information.max(initial=0.0)  # a formula without a trace says nothing
        for k in np.argsort(np.where(shown, -value, np.inf)):
            v = view.candidates.each[k].variant
            entry = {
                "mechanism": v.mechanism,
                "variant": v.name,
                "statistic": finite(float(z[k])),
                "estimate": finite(float(score[k] / information[k] * v.plausible[0])),
                "detection_limit": finite(float(DETECTABLE / np.sqrt(information[k]) * v.plausible[0])),
                "unit": v.unit,
                "parameter": v.parameter,
                "probability": probability[v.mechanism],
                "sign": v.sign,
            }
            entries.setdefault(v.mechanism, entry)
    return tuple(sorted(entries.values(), key=lambda e: -e["probability"]))


def likeness_of(search: Search, sets: Sequence[Sequence[str]], ranking: Sequence[Mapping[str, Any]]) -> Likeness | None:
    """How alike the mechanisms of a ranking look, each by its best formula; None where none is shared by all tests."""
    if not search.shared:
        return None
    screen = search.screen
    value, mechanisms = screen.singles(), screen.candidates.mechanisms
    wanted = dict.fromkeys([name for names in sets for name in names] + [entry["mechanism"] for entry in ranking])
    names = [name for name in wanted if name in mechanisms]
    rows = np.array([max(np.flatnonzero(mechanisms == name), key=lambda k: value[k]) for name in names], int)
    score, signs = screen.score[0][rows], screen.candidates.signs[rows]
    sign = np.where(signs == 0, np.where(score < 0, -1, 1), signs)
    return Likeness(tuple(names), screen.similarity[np.ix_(rows, rows)] * sign * sign[:, None])


def residuals_of(base: Base, nothing: Fitted, fitted: Fitted) -> Residuals:
    """Residuals of every test, without and with what was found, both in units of the noise of the latter."""
    before, after = (residual_of(one.solution, one.design) for one in (nothing, fitted))
    white_before, _ = whitened(fitted.optimum.hyper, fitted.design, before)
    white_after, sd = whitened(fitted.optimum.hyper, fitted.design, after)
    record, mask, kept = base.tests.record, np.asarray(base.tests.mask), tuple(base.selection.kept)
    shown = (np.where(mask, x, 0.0) for x in (before, after, white_before, white_after, sd))
    return Residuals(np.asarray(record.time), np.asarray(record.kind), mask, *shown, particles=kept)


def places(base: Base, left: np.ndarray) -> tuple[Place, ...]:
    """The map of disagreement: squared differences by kind of segment and load; a hold is one place."""
    mask, kind = np.asarray(base.tests.mask), np.asarray(base.tests.record.kind)
    force = np.asarray(base.tests.force)
    load = force / np.max(np.where(mask, force, 0.0), axis=1, keepdims=True)
    total = max(float(np.sum(left[mask] ** 2)), 1e-300)
    bins = list(itertools.pairwise(np.linspace(0, 1, BINS + 1).tolist()))
    found = []
    for code, name in KINDS.items():
        if not (mask & (kind == code)).any():
            continue
        for low, high in [(0.0, 1.0)] if code == HOLD else bins:
            inside = mask & (kind == code) & (load >= low) & ((load < high) | (high >= 1))
            if not inside.any():
                found.append(Place(name, (low, high), float("nan"), 0, ()))
                continue
            each = np.sum(np.where(inside, left, 0.0) ** 2, 1)
            particles = tuple(np.flatnonzero(each > 0.5 * each.mean()).tolist())
            sign = int(np.sign(np.sum(left[inside])))
            found.append(Place(name, (low, high), float(each.sum() / total), sign, particles))
    return tuple(found)


def where(base: Base, places: Sequence[Place]) -> list[dict[str, Any]]:
    """The places that together hold most of the disagreement, largest first."""
    tests, mask = base.tests, np.asarray(base.tests.mask)
    travel = np.asarray(tests.displacement) - np.asarray(base.state.point.zero)[:, None]
    strain = travel / np.asarray(tests.effective_diameter)[:, None]
    least, most = np.where(mask, strain, np.inf).min(1), np.where(mask, strain, -np.inf).max(1)
    held, found = 0.0, []
    for place in sorted((p for p in places if p.share > 0), key=lambda p: -p.share):
        if held >= REPORTED:
            break
        held += place.share
        rows, direction = list(place.particles), "more" if place.sign > 0 else "less"
        entry = {"segment": place.segment, "load_fraction": list(place.load_fraction)}
        entry |= {"strain": [float(least[rows].min()), float(most[rows].max())], "share": place.share}
        entry |= {"particles": [base.names[i] for i in rows], "direction": f"{direction} displacement than the law"}
        found.append(entry)
    return found
