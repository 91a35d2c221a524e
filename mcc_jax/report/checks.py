"""Checks of the results: a word, a sign and a colour each, what it means, and what to do."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from .._format import number, percent
from ..calibrate.curves import FittedCurve
from ..calibrate.importance import LEAST_ESS, MOST_PARETO_K, MOST_RHAT
from ..calibrate.judgement import CORRELATED_SHARE, LARGE_MISFIT
from ..campaign import Finding, campaign_findings, check_plausibility, check_tests
from ..campaign.findings import has_error
from ..discovery.sentences import NOTHING_MISSING, headline, verdict_in_words, within_noise
from .read import CALIBRATION, DATA, Results

Level = Literal["good", "look", "bad", "unknown"]
RHAT_BAD, ESS_BAD, PARETO_K_BAD = 1.05, 100.0, 1.0  # from here on the gate is not just missed: the draws cannot be used

GOOD_MISFIT = 0.01
GOOD_NOISE_SHARE = 0.2
INSIDE = (0.90, 0.99)
NOT_MONOTONE = 0.05
FEW_PARTICLES = 6  # fewer say little of the scatter between particles
OF_FINDINGS: dict[str, tuple[Level, str]] = {
    "info": ("good", "settled"),
    "warning": ("look", "look at it"),
    "error": ("bad", "implausible"),
}
OF_VERDICTS: dict[str, Level] = {"NO_GAP": "good", "FIT_NOT_CONVERGED": "bad"}
"""What a verdict means for the law without what was found; "look" if something was."""

MEANINGS = {
    "Calibration converged": "Every part of the calibration must meet its own tolerances. If not: the numbers are not "
    "to be trusted before the checks below have passed.",
    "Particles used": "Few particles say little of how particles differ. Why some are left out is under The tests.",
    "Chains agree (R-hat)": "Independent chains must agree. If not: more draws (--draws).",
    "Independent draws (bulk ESS)": "Number of independent draws that the chains are worth. If too few: more draws "
    "(--draws).",
    "Diverging trajectories": "The sampler could not follow the posterior everywhere. If not 0: more draws, or "
    "narrower priors.",
    "Fast mode is accurate (Pareto k)": "How well the quadratic summaries of the fast mode approximate the tests "
    "themselves. If not: --mode joint.",
    "The law's form fits": "Median misfit with each particle's own coefficients, as a share of its range of "
    "displacement. If large: these may not be compressions of single particles, or the diameters are wrong.",
    "What is left is noise": "Share of what is left that is correlated along a test. A large one is not noise of the "
    "instrument but something that the law misses, and the stated errors are those of a law that misses it.",
    "New particles behave": "Share of particles drawn from this population whose loading curve would fall somewhere.",
    "Prediction bands hold": "Measured points inside the band that should hold 95 % of them. Fewer: the law misses "
    "something, or the noise is larger than estimated. More: the noise is smaller.",
    "Same data": "The data shown here are those that were calibrated. If not: calibrate again.",
}
"""What a check says, and what to do where it fails."""


@dataclass(frozen=True)
class Check:
    """What is checked, what was found, what it should be, and what that means; "look" is to be used with care."""

    level: Level
    check: str
    value: str
    want: str
    meaning: str


def check_results(results: Results, shown: Sequence[FittedCurve] = ()) -> list[Check]:
    """All checks that these results allow; `shown` are their predictions."""
    findings, content = tested(results), results.calibration
    found = [
        Check(OF_FINDINGS[one.level][0], f"Tests: {one.check}", OF_FINDINGS[one.level][1], "nothing found", str(one))
        for one in findings
    ]
    if content is not None:
        found += _calibration(content)
    inside = share_inside(shown)
    if inside is not None:
        level = "good" if INSIDE[0] <= inside <= INSIDE[1] else "look"
        want = f"about 95 %, {percent(INSIDE[0])} to {percent(INSIDE[1])}"
        found.append(_check("Prediction bands hold", level, f"{percent(inside, 3)} of points inside", want))
    if content is not None:
        found.append(_data(results))
    if results.discovery is not None:
        found.append(_complete(results, results.discovery))
    if has_error(findings):
        # Next to numbers that cannot be true nothing is fine: what would be is not judged.
        found = [replace(check, level="unknown") if check.level == "good" else check for check in found]
    return found


def tested(results: Results) -> tuple[Finding, ...]:
    """What the checks of the tests found: as the results say, or by the campaign itself where there are none."""
    recorded = [one for content in results.results.values() for one in content.get("findings", [])]
    if recorded:
        unique = {(one["check"], tuple(one["particles"]), one["sentence"]): one for one in recorded}
        return tuple(Finding.from_json(one) for one in unique.values())
    if results.results or results.campaign is None:
        return ()
    return (*check_plausibility(results.campaign), *campaign_findings(check_tests(results.campaign)))


def share_inside(shown: Sequence[FittedCurve]) -> float | None:
    """Share of all compared points inside their band [-]; None without bands."""
    inside = [one.inside for one in shown]
    return float(np.mean(np.concatenate(inside))) if sum(map(len, inside)) else None


def _check(check: str, level: Level, value: str, want: str) -> Check:
    return Check(level, check, value, want, MEANINGS[check])


def _gate(check: str, value: float | int | None, good: float, bad: float, text: str, want: str) -> Check:
    """A number that is fine up to one limit and to be used with care up to another."""
    level: Level = "unknown"
    if value is not None:
        level = "good" if value <= good else "look" if value <= bad else "bad"
    return _check(check, level, text, want)


def _calibration(content: dict[str, Any]) -> Iterator[Check]:
    """Whether it converged, on how many particles, by which draws, and how well the law fits."""
    count, used = len(content["particles"]), sum(entry["kept"] for entry in content["particles"])
    enough = "good" if used == count >= FEW_PARTICLES else "look" if used >= max(2, count / 2) else "bad"
    done, d = content["converged"], content["diagnostics"]
    yield _check("Calibration converged", "good" if done else "bad", "yes" if done else "no", "yes")
    yield _check("Particles used", enough, f"{used} of {count}", f"all, and at least {FEW_PARTICLES}")
    if content["method"] == "bayes":
        rhat, ess, divergences, k = (d.get(n) for n in ("rhat_max", "ess_bulk_min", "divergences", "pareto_k_max"))
        k = None if k is None else max(k, d.get("pareto_k_joint") or k)
        few, least, most = None if ess is None else -ess, f"at least {LEAST_ESS:.0f}", f"at most {MOST_PARETO_K}"
        yield _gate("Chains agree (R-hat)", rhat, MOST_RHAT, RHAT_BAD, number(rhat), f"at most {MOST_RHAT}")
        yield _gate("Independent draws (bulk ESS)", few, -LEAST_ESS, -ESS_BAD, number(ess), least)
        yield _gate("Diverging trajectories", divergences, 0.0, 0.0, number(divergences), "0")
        yield _gate("Fast mode is accurate (Pareto k)", k, MOST_PARETO_K, PARETO_K_BAD, number(k, 2), most)
    falling = (content.get("probability_not_monotone") or {}).get("value")
    for check, share, text, good, bad in (
        ("The law's form fits", d.get("own_misfit"), "off by {}", GOOD_MISFIT, LARGE_MISFIT),
        ("What is left is noise", d.get("noise_share"), "{} is autocorrelated", GOOD_NOISE_SHARE, CORRELATED_SHARE),
        ("New particles behave", falling, "{} snap through", NOT_MONOTONE, math.inf),
    ):
        if share is not None:
            yield _gate(check, share, good, bad, text.format(percent(share)), f"at most {percent(good)}")
    for gap in d.get("open_combinations", []):
        yield Check("bad", "Data determine the parameters", "not all", "all", f"The data leave open: {gap}.")


def _data(results: Results) -> Check:
    """Whether the tests at hand are those that were calibrated."""
    tests, name, want = results.provenance[CALIBRATION].campaign, "Same data", "checksums agree"
    if tests is None or not tests.sha256 or not results.checksums:
        return Check("unknown", name, "unknown", want, "Checksums or the campaign's files are missing.")
    same = all(results.checksums.get(file) == tests.sha256.get(file) for file in DATA)
    return _check(name, "good" if same and not results.cautions else "bad", want if same else "checksums differ", want)


def _complete(results: Results, found: dict[str, Any]) -> Check:
    """Whether the law lacks something: by the verdict or, with what was found added, by held-out particles."""
    name, want = "Law is complete", NOTHING_MISSING
    if not results.has_found:
        level = OF_VERDICTS.get(found["verdict"], "look")
        return Check(level, name, verdict_in_words(found), want, headline(found))
    answers: dict[bool | None, tuple[Level, str, str]] = {
        None: ("unknown", "not known", "was not tried on held-out particles"),
        True: ("good", "nothing more is missing", "agrees with held-out particles within the noise"),
        False: ("look", "part is missing", "closes a part of the gap; held-out particles still differ from it"),
    }
    level, answer, meaning = answers[within_noise(found["gap"])]
    return Check(level, name, answer, want, f"{results.law.capitalize()} {meaning}.")
