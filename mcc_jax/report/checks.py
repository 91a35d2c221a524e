"""Checks of the results: a word, a sign and a colour each, what it means, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from .._format import number, percent
from ..calibrate.curves import FittedCurve
from ..calibrate.importance import LEAST_ESS, MOST_PARETO_K, MOST_RHAT
from ..calibrate.judgement import CORRELATED_SHARE, LARGE_MISFIT
from ..campaign import Finding, campaign_findings, check_plausibility, check_tests
from ..campaign.findings import worst
from ..discovery.sentences import headline, verdict_in_words, within_noise
from .read import CALIBRATION, DATA, Results
from .sentences import beside_the_law

Level = Literal["good", "look", "bad", "unknown"]
RHAT_BAD, ESS_BAD, PARETO_K_BAD = 1.05, 100.0, 1.0
"""From here on the gate is not just missed: the draws cannot be used."""

GOOD_MISFIT = 0.01
GOOD_NOISE_SHARE = 0.2
INSIDE = (0.90, 0.99)
NOT_MONOTONE = 0.05
FEW_PARTICLES = 6
"""Fewer say little of the scatter between particles."""


@dataclass(frozen=True)
class Check:
    """One check.

    Attributes:
        level: good, look (use with care), bad, or unknown.
        check: what is checked.
        value: what was found.
        want: what it should be.
        meaning: what it says, and what to do where it fails.
    """

    level: Level
    check: str
    value: str
    want: str
    meaning: str


CHECKS = {
    "Calibration converged": (
        "yes",
        "Every part of the calibration must meet its own tolerances. If not: the numbers are not to be trusted before "
        "the checks below have passed.",
    ),
    "Particles used": (
        f"all, and at least {FEW_PARTICLES}",
        "Few particles say little of how particles differ. Why some are left out is said under The tests.",
    ),
    "Chains agree (R-hat)": (
        f"at most {MOST_RHAT}",
        "Independent chains must agree. If not: more draws (--draws).",
    ),
    "Independent draws (bulk ESS)": (
        f"at least {LEAST_ESS:.0f}",
        "Number of independent draws that the chains are worth. If too few: more draws (--draws).",
    ),
    "Diverging trajectories": (
        "0",
        "The sampler could not follow the posterior everywhere. If not 0: more draws, or narrower priors.",
    ),
    "Fast mode is accurate (Pareto k)": (
        f"at most {MOST_PARETO_K}",
        "How well the quadratic summaries of the fast mode approximate the tests themselves. If not: --mode joint.",
    ),
    "The law's form fits": (
        f"at most {percent(GOOD_MISFIT)}",
        "Median misfit with each particle's own coefficients, as a share of its range of displacement. If large: these "
        "may be no compressions of single particles, or the diameters are wrong.",
    ),
    "What is left is noise": (
        f"at most {percent(GOOD_NOISE_SHARE)}",
        "Share of what is left that is correlated along a test. A large one is not noise of the instrument but "
        "something that the law misses, and the stated errors are those of a law that misses it.",
    ),
    "New particles behave": (
        f"at most {percent(NOT_MONOTONE)}",
        "Share of particles drawn from this population whose loading curve would fall somewhere.",
    ),
    "Prediction bands hold": (
        f"about 95 %, {percent(INSIDE[0])} to {percent(INSIDE[1])}",
        "Measured points inside the band that should hold 95 % of them. Fewer: the law misses something, or the noise "
        "is larger than estimated. More: the noise is smaller.",
    ),
    "Same data": ("checksums agree", "The data shown here are those that were calibrated. If not: calibrate again."),
}
"""What every check should be, and what it means."""

COMPLETE = "Law is complete"
VERDICTS: dict[str, Level] = {
    "NO_GAP": "good",
    "NAMED": "look",
    "SET": "look",
    "UNLISTED": "look",
    "FIT_NOT_CONVERGED": "bad",
}
"""What a verdict means for the law without what was found."""


def check_results(results: Results, shown: Sequence[FittedCurve] = ()) -> list[Check]:
    """All checks that these results allow; `shown` are their predictions, for what the calibration does not say."""
    findings, content, inside = tested(results), results.calibration, share_inside(shown)
    found = [_finding(one) for one in findings]
    if content is not None:
        found += _calibration(content)
        if content["method"] == "bayes":
            found += _sampler(content["diagnostics"])
        found += _fit(content, shown)
    if inside is not None:
        level = "good" if INSIDE[0] <= inside <= INSIDE[1] else "look"
        found.append(_check("Prediction bands hold", level, f"{percent(inside, 3)} of points inside"))
    if content is not None:
        found.append(_data(results))
    if results.discovery is not None:
        found.append(_complete(results, results.discovery))
    if worst(findings) == "error":
        # Next to numbers that cannot be true nothing is fine: what would be is not judged.
        found = [replace(light, level="unknown") if light.level == "good" else light for light in found]
    return found


def _complete(results: Results, found: dict[str, Any]) -> Check:
    """Whether the law lacks something: by the verdict or, with what was found added, by held-out particles."""
    law = f"The law{beside_the_law(results)}"
    if not results.has_found:
        return Check(VERDICTS[found["verdict"]], COMPLETE, verdict_in_words(found), "nothing missing", headline(found))
    match within_noise(found["gap"]):
        case None:
            level, answer, meaning = "unknown", "not known", "was not tried on held-out particles"
        case True:
            level, answer, meaning = (
                "good",
                "nothing more is missing",
                "agrees with held-out particles within the noise",
            )
        case False:
            level, answer = "look", "part is missing"
            meaning = "closes a part of the gap; held-out particles still differ from it"
    return Check(level, COMPLETE, answer, "nothing missing", f"{law} {meaning}.")


def tested(results: Results) -> tuple[Finding, ...]:
    """What the checks of the tests found: as the results say, or by the campaign itself where there are none."""
    recorded = [one for content in results.results.values() for one in content.get("findings", [])]
    if recorded:
        unique = {(one["check"], tuple(one["particles"]), one["sentence"]): one for one in recorded}
        return tuple(Finding.from_json(one) for one in unique.values())
    if results.results or results.campaign is None:
        return ()
    return (
        *check_plausibility(results.campaign),
        *campaign_findings(check_tests(results.campaign)),
    )


def _check(check: str, level: Level, value: str) -> Check:
    return Check(level, check, value, *CHECKS[check])


def _finding(one: Finding) -> Check:
    levels: dict[str, tuple[Level, str]] = {
        "info": ("good", "settled"),
        "warning": ("look", "look at it"),
        "error": ("bad", "implausible"),
    }
    level, value = levels[one.level]
    return Check(level, f"Tests: {one.check}", value, "nothing found", str(one))


def _calibration(content: dict[str, Any]) -> list[Check]:
    count, used = len(content["particles"]), sum(entry["kept"] for entry in content["particles"])
    enough = "good" if used == count >= FEW_PARTICLES else "look" if used >= max(2, count / 2) else "bad"
    done = content["converged"]
    return [
        _check("Calibration converged", "good" if done else "bad", "yes" if done else "no"),
        _check("Particles used", enough, f"{used} of {count}"),
    ]


def _sampler(d: dict[str, Any]) -> list[Check]:
    rhat, ess, divergences, k = (d.get(n) for n in ("rhat_max", "ess_bulk_min", "divergences", "pareto_k_max"))
    k = None if k is None else max(k, d.get("pareto_k_joint") or k)
    few = _below(None if ess is None else -ess, -LEAST_ESS, -ESS_BAD)
    return [
        _check("Chains agree (R-hat)", _below(rhat, MOST_RHAT, RHAT_BAD), number(rhat)),
        _check("Independent draws (bulk ESS)", few, number(ess)),
        _check("Diverging trajectories", _below(divergences, 0.0, 0.0), number(divergences)),
        _check("Fast mode is accurate (Pareto k)", _below(k, MOST_PARETO_K, PARETO_K_BAD), number(k, 2)),
    ]


def _own_misfit(shown: Sequence[FittedCurve]) -> float:
    """Median over the particles of the root mean square misfit, in shares of the range of displacement."""
    own = [(one.rms_um, float(np.ptp(one.displacement_um[one.used]))) for one in shown if one.rms_um is not None]
    return float(np.median([rms / reach for rms, reach in own if rms is not None and reach > 0] or [np.nan]))


def _fit(content: dict[str, Any], shown: Sequence[FittedCurve]) -> list[Check]:
    d = content["diagnostics"]
    misfit, noise = d.get("own_misfit"), d.get("noise_share")
    falling = (content.get("probability_not_monotone") or {}).get("value")
    if misfit is None and shown:
        misfit = _own_misfit(shown)
    found = []
    if misfit is not None and np.isfinite(misfit):
        level = _below(misfit, GOOD_MISFIT, LARGE_MISFIT)
        found.append(_check("The law's form fits", level, f"off by {percent(misfit)}"))
    if noise is not None:
        level = _below(noise, GOOD_NOISE_SHARE, CORRELATED_SHARE)
        found.append(_check("What is left is noise", level, f"{percent(noise)} is autocorrelated"))
    if falling is not None:
        level = "good" if falling <= NOT_MONOTONE else "look"
        found.append(_check("New particles behave", level, f"{percent(falling)} snap through"))
    gaps = d.get("open_combinations", [])
    name = "Data determine the parameters"
    return found + [Check("bad", name, "not all", "all", f"The data leave open: {text}.") for text in gaps]


def share_inside(shown: Sequence[FittedCurve]) -> float | None:
    """Share of all compared points inside their band [-]; None without bands."""
    pairs = [(one.displacement_um, one.low_um, one.high_um, one.used & np.isfinite(one.low_um)) for one in shown]
    inside = [((um >= low) & (um <= high))[some] for um, low, high, some in pairs]
    return float(np.mean(np.concatenate(inside))) if sum(map(len, inside)) else None


def _data(results: Results) -> Check:
    tests = results.provenance[CALIBRATION].campaign
    if tests is None or not tests.sha256 or not results.checksums:
        why = "Checksums or the campaign's files are missing."
        return Check("unknown", "Same data", "cannot tell", "checksums agree", why)
    same = all(results.checksums.get(name) == tests.sha256.get(name) for name in DATA)
    level = "good" if same and not results.cautions else "bad"
    return _check("Same data", level, "checksums agree" if same else "checksums differ")


def _below(value: float | int | None, good: float, bad: float) -> Level:
    if value is None:
        return "unknown"
    return "good" if value <= good else "look" if value <= bad else "bad"
