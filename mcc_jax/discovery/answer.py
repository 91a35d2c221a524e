"""From a search to its answer: effects with their numbers, sets, rankings, residuals, what remains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import softmax

from ..calibrate import Posterior
from ..calibrate.estimates import estimate, finite, summary
from ..effects import Mechanism
from .at_peaks import of_modulus_at_peaks
from .base import Base
from .columns import Design
from .design import design_of
from .evidence import LinearModel, residual_of, whitened
from .fit import Fitted
from .hypothesis import UNLISTED, Hypothesis, Names
from .random_effects import RandomEffects
from .result import Effect, Likeness, Residuals
from .search import Search
from .settings import AT_PEAKS, DECISIONS, DETECTABLE, POPULATION

LEAD = 3.0  # log posterior odds from which on what remains next to a name is reported


def parameters_alone(base: Base) -> dict[str, Any]:
    """The population's parameters by the law alone, under the model's own noise: those of a calibration."""
    alone = _population(base, None, base.hyperparameters, design_of(base, base.state))
    return _averaged([alone], np.ones(1), len(base.tests))


def parameters_with(search: Search, probabilities: Mapping[Names, float]) -> dict[str, Any]:
    """The population's parameters, averaged over hypotheses (Bayesian model averaging, Hoeting et al. 1999).

    The sum of the `probabilities` of those that are averaged over need not be 1.
    """
    found = [search.found[names] for names in probabilities]
    each = [_population(search.base, one.at, *one.likely_form()) for one in found]
    weights = np.array(list(probabilities.values())) / sum(probabilities.values())
    return _averaged(each, weights, len(search.base.tests))


def _averaged(
    each: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], weights: np.ndarray, particles: int
) -> dict[str, Any]:
    """Parameters by name from means, errors and spreads, which are weighted.

    The mean of log C over particles whose spread is estimated from the same particles follows Student's t with one
    degree of freedom less than there are particles; a and the modulus, which no spread of particles limits, are normal.
    """
    from scipy.stats import t as student

    mean, sd, tau = (np.array(parts) for parts in zip(*each, strict=True))
    freedom = np.array([np.inf, np.inf, *3 * [max(particles - 1.0, 1.0)], np.inf])
    # Of three degrees of freedom and more Student's t has a standard deviation.
    wider = np.where(freedom > 2, student.std(freedom), 1.0)
    middle = weights @ mean
    wide = np.sqrt(weights @ ((sd * wider) ** 2 + (mean - middle) ** 2))
    low, high = (_quantiles(q, weights, mean, sd, freedom) for q in (0.025, 0.975))
    spread = weights @ tau

    def entry(j: int) -> dict[str, Any]:
        return estimate(float(middle[j]), float(wide[j]), (low[j], high[j]))

    def modulus(j: int) -> dict[str, Any]:
        value = float(np.exp(middle[j]))
        return estimate(value, value * float(wide[j]), (float(np.exp(low[j])), float(np.exp(high[j]))))

    return {
        "a": entry(0),
        "effective_modulus_MPa": modulus(1),
        AT_PEAKS: modulus(5),
        **{
            f"log_{name}": {"mean": entry(2 + j), "sd": estimate(float(spread[j]))}
            for j, name in enumerate(("C1", "C3", "C5"))
        },
    }


def likely(search: Search) -> dict[Names, float]:
    """The most probable hypotheses that are fitted, as many as hold what a set must."""
    found: dict[Names, float] = {}
    for names, probability in search.posterior().items():
        if sum(found.values()) < DECISIONS.set_mass and search.found[names].at is not None:
            found[names] = probability
    return found


def _population(
    base: Base, formulas: Fitted | None, hyper: np.ndarray, design: Design
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means of a, log modulus, log C1, C3, C5 and log modulus at the peaks under a hypothesis, their errors, and the
    spreads of the coefficients.

    Errors are those of the linear model. Where the formulas are off, so is the law that would answer for it: the misfit
    is integrated out, too, and widens the errors (Brynjarsdottir and O'Hagan 2014).
    """
    model = LinearModel(hyper, design)
    solution, covariance, width = model.solve(), model.covariance(), design.common.shape[-1]
    mean, factor = base.population_prior
    beta = mean + factor @ np.asarray(solution.common[:POPULATION])
    rows = np.zeros((POPULATION + 1, len(covariance)))
    rows[:POPULATION, :POPULATION] = factor
    change, slope = (0.0, np.zeros(0)) if formulas is None else of_modulus_at_peaks(base, formulas, solution)
    names = 0 if formulas is None else len(formulas.variants)
    rows[-1] = rows[1]
    rows[-1, width : width + names] += slope[:names]
    rows[-1, POPULATION : POPULATION + len(slope) - names] += slope[names:]
    sd = np.sqrt(np.diagonal(rows @ covariance @ rows.T))
    at_peaks = beta[1] + change
    beta[2:] -= np.mean(np.log1p(np.maximum(beta[0] * base.flatness, -0.99)))
    return np.append(beta, at_peaks), sd, model.scales[0][:3]


def _quantiles(q: float, weights: np.ndarray, mean: np.ndarray, sd: np.ndarray, freedom: np.ndarray) -> list[float]:
    """Quantiles of mixtures of Student's t distributions (normal ones of infinite freedom), one a column."""
    from scipy.optimize import root_scalar
    from scipy.stats import t as student

    def below(x: float, j: int) -> float:
        return float(weights @ student.cdf((x - mean[:, j]) / sd[:, j], freedom[j])) - q

    far = student.ppf(0.999, freedom) * sd
    low, high = np.min(mean - far, 0), np.max(mean + far, 0)
    return [root_scalar(below, args=(j,), bracket=(low[j], high[j])).root for j in range(mean.shape[1])]


def effects_of(search: Search, names: Names, probabilities: Mapping[str, float], p_any: float) -> tuple[Effect, ...]:
    """The effects of a hypothesis with their numbers."""
    one = search.found[names]
    own = () if one.own is None else (_of_their_own(one.own, probabilities[one.own.variant.mechanism], p_any),)
    r = one.at
    if r is None:
        return ()
    # As wide as with the misfit and the scatter that the tests prefer, as the population's parameters are.
    hyper, design = one.likely_form()
    cov, c = LinearModel(hyper, design).covariance(), design.common.shape[-1]
    place, found = len(r.variants), []
    for k, variant in enumerate(r.variants):
        nuisance = {n.name: float(r.theta[place + i]) for i, n in enumerate(variant.nuisances)}
        place += len(nuisance)
        sd = float(np.sqrt(cov[c + k, c + k])) * variant.plausible[0]
        size = one.sizes[k] if k < len(one.sizes) and one.is_off else 0.0
        amplitude = float(r.theta[k])
        found.append(Effect(variant, nuisance, amplitude, sd, probabilities[variant.mechanism], p_any, misfit=size))
    order = {name: i for i, name in enumerate(sorted(names, key=lambda n: -search.found[(n,)].log_evidence))}
    return tuple(sorted((*found, *own), key=lambda e: order[e.mechanism]))


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
    named = posterior.named_population()
    amplitude = named[effect.mechanism]
    further = {n.name: named[f"{effect.mechanism}.{n.name}"] for n in effect.variant.nuisances}
    return replace(
        effect,
        amplitude=float(amplitude.mean()),
        sd=float(amplitude.std()),
        nuisance={name: float(draws.mean()) for name, draws in further.items()},
        estimates={effect.variant.parameter: summary(amplitude)} | {n: summary(d) for n, d in further.items()},
    )


def name_probabilities(search: Search) -> dict[str, float]:
    """Probability of each mechanism to be missing, if anything is."""
    found = search.posterior()
    gap = max(1.0 - found.get((), 0.0), 1e-300)
    return {m: sum(p for names, p in found.items() if m in names) / gap for m in search.library}


def sets_of(
    search: Search, leader: Names, effects: Sequence[Effect], pairs: Sequence[Names]
) -> tuple[tuple[str, ...], ...]:
    """For each effect that was added, the mechanisms that may be in its place, most probable first, itself among them.

    Those of `pairs`, two names each that may be in place of a single one, come last.
    """
    alike = {names: one for names, one in search.found.items() if len(names) == len(leader) and names != UNLISTED}
    found = []
    for effect in effects:
        others = {e.mechanism for e in effects if e is not effect}
        rivals = {
            name: one.log_evidence
            for names, one in alike.items()
            if others <= set(names)
            for name in set(names) - others
        }
        held, members = 0.0, []
        for name, share in sorted(_shares(rivals).items(), key=lambda one: -one[1]):
            if held < DECISIONS.set_mass:
                members.append(name)
                held += share
        found.append(tuple(dict.fromkeys([effect.mechanism, *members, *(n for pair in pairs for n in pair)])))
    return tuple(found)


def _shares(logs: Mapping[str, float]) -> dict[str, float]:
    """Probabilities of names among each other, from their log evidences."""
    return dict(zip(logs, softmax(list(logs.values())).tolist(), strict=True))


def instead_of(search: Search, leader: Names) -> tuple[Names, ...]:
    """Two names that together may be in place of the one that is named, most probable first."""
    if len(leader) != 1:
        return ()
    left_out = 1.0 - DECISIONS.set_mass
    return tuple(n for n, p in search.posterior().items() if len(n) == 2 and leader[0] not in n and p > left_out)


def ranking_of(search: Search) -> tuple[dict[str, Any], ...]:
    """Every mechanism alone against the base law, most probable first."""
    logs = {m: search.found[(m,)].log_evidence if (m,) in search.found else -np.inf for m in search.library}
    probability = _shares(logs)
    own = {m: x for m, x in search.library.items() if m not in search.shared}
    views = [search.screen] if search.screen is not None else []
    if own:
        views.append(search.screened(own, several=False))
    entries = {}
    for view in views:
        first = view.settings[0]
        information = np.maximum(view.information, 1e-300)
        z = first.score / np.sqrt(information)
        value, _ = view.singles()
        shown = view.information > 1e-12 * view.information.max()  # a formula that leaves no trace says nothing
        for k in np.argsort(np.where(shown, -value, np.inf)):
            c = view.candidates[k]
            if c.mechanism in entries:
                continue
            unit = c.variant.plausible[0]
            entries[c.mechanism] = {
                "mechanism": c.mechanism,
                "variant": c.variant.name,
                "statistic": finite(float(z[k])),
                "estimate": finite(float(first.score[k] / information[k] * unit)),
                "detection_limit": finite(float(DETECTABLE / np.sqrt(information[k]) * unit)),
                "unit": c.variant.unit,
                "parameter": c.variant.parameter,
                "probability": probability[c.mechanism],
                "sign": c.variant.sign,
            }
    return tuple(sorted(entries.values(), key=lambda e: -e["probability"]))


def likeness_of(search: Search, sets: Sequence[Sequence[str]], ranking: Sequence[Mapping[str, Any]]) -> Likeness | None:
    """How alike the mechanisms of a ranking look, each by its best formula."""
    if search.screen is None:
        return None
    value, _ = search.screen.singles()
    wanted = [name for names in sets for name in names] + [entry["mechanism"] for entry in ranking]
    best: dict[str, int] = {}
    for name in dict.fromkeys(wanted):
        ks = [k for k, c in enumerate(search.screen.candidates) if c.mechanism == name]
        if ks:
            best[name] = max(ks, key=lambda k: value[k])
    rows = np.array(list(best.values()), int)
    score = search.screen.settings[0].score[rows]
    sign = np.where(search.screen.signs[rows] == 0, np.where(score < 0, -1, 1), search.screen.signs[rows])
    return Likeness(tuple(best), search.screen.similarity[np.ix_(rows, rows)] * sign * sign[:, None])


def residuals_of(search: Search, winner: Names | None) -> Residuals:
    """Residuals of every test, without and with what was found, both in units of the noise of the latter."""
    base: Base = search.base
    nothing = search.null
    before = residual_of(nothing.solution, nothing.design)
    fitted = search.found[winner or ()].at
    assert fitted is not None
    after = residual_of(fitted.solution, fitted.design)
    white_before, _ = whitened(fitted.optimum.hyper, fitted.design, before)
    white_after, sd = whitened(fitted.optimum.hyper, fitted.design, after)
    mask = np.asarray(base.tests.mask)
    return Residuals(
        np.asarray(base.tests.record.time),
        np.asarray(base.tests.record.kind),
        mask,
        np.where(mask, before, 0.0),
        np.where(mask, after, 0.0),
        np.where(mask, white_before, 0.0),
        np.where(mask, white_after, 0.0),
        np.where(mask, sd, 0.0),
        tuple(base.selection.kept),
    )


def leads_of(search: Search, winner: Names) -> tuple[dict[str, Any], ...]:
    """Second names that improve on the winner without leading it by the margin."""
    if len(winner) != 1 or winner == UNLISTED:
        return ()
    alone = search.found[winner]
    gap = max(alone.log_evidence - search.null.log_evidence, 1e-300)
    found = []
    for names, pair in search.found.items():
        if len(names) == 2 and winner[0] in names and pair.log_evidence > alone.log_evidence + LEAD:
            (second,) = set(names) - set(winner)
            share = (pair.log_evidence - alone.log_evidence) / (gap + pair.log_evidence - alone.log_evidence)
            found.append({"mechanism": second, "share": float(share), "resembles": []})
    return tuple(sorted(found, key=lambda lead: -lead["share"]))


def checks_of(known: Mapping[str, Mechanism], sets: Sequence[tuple[str, ...]]) -> tuple[dict[str, str], ...]:
    """For every mechanism that has rivals, what would show it by itself."""
    rivals = dict.fromkeys(name for names in sets if len(names) > 1 for name in names)
    return tuple({"mechanism": name, "check": known[name].check} for name in rivals if known[name].check)


def leader_of(search: Search) -> Hypothesis:
    """The most probable hypothesis other than nothing."""
    return next(search.found[names] for names in search.log_posteriors() if names)
