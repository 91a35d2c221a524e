"""Diagnostics as traffic lights: a word, a sign and a colour each, what it means, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from .._format import number, percent
from ..calibrate.curves import FittedCurve
from ..calibrate.settings import JUDGEMENT, SAMPLING
from ..campaign import Finding, campaign_findings, check_plausibility, check_tests
from ..campaign.findings import worst
from .read import Results, checksums_told

Level = Literal["good", "look", "bad", "unknown"]
RHAT_BAD, ESS_BAD, PARETO_K_BAD = 1.05, 100.0, 1.0
"""From here on the gate is not just missed: the draws cannot be used."""

GOOD_MISFIT = 0.01
GOOD_NOISE_SHARE = 0.2
INSIDE = (0.90, 0.99)
NOT_MONOTONE = 0.05
ANSWERS = {
    "NO_GAP": "Nothing missing",
    "NAMED": "Missing and named",
    "SET": "Missing, several candidates",
    "UNLISTED": "Missing, unlisted",
    "FIT_NOT_CONVERGED": "Cannot ask",
}
"""What a verdict says, in words."""
FEW_PARTICLES = 6
"""Fewer say little of the scatter between particles."""


@dataclass(frozen=True)
class Light:
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


def lights(results: Results, shown: Sequence[FittedCurve] = ()) -> list[Light]:
    """All checks that these results allow, the convergence of the calibration first.

    Args:
        results: what a folder holds.
        shown: its particles with their predictions, for what the calibration itself does not tell.
    """
    findings = tested(results)
    found = [_finding(one) for one in findings]
    if results.calibration is not None:
        found += _calibration(results.calibration)
        if results.calibration["method"] == "bayes":
            found += _sampler(results.calibration["diagnostics"])
        found += _fit(results.calibration, shown)
    inside = share_inside(shown)
    if inside is not None:
        found.append(_coverage(inside))
    if results.calibration is not None:
        found.append(_data(results))
    if results.discovery is not None:
        found.append(_discovery(results.discovery))
    if worst(findings) == "bad":
        # Beside numbers that cannot be true nothing is fine: what would be is not judged.
        found = [replace(light, level="unknown") if light.level == "good" else light for light in found]
    return found


def tested(results: Results) -> tuple[Finding, ...]:
    """What the checks of the tests found: as the results tell it, or by the campaign itself where there are none."""
    told = [one for _, content in results.results for one in content.get("findings", [])]
    if told:
        unique = {(one["check"], tuple(one["particles"]), one["sentence"]): one for one in told}
        return tuple(Finding.from_json(one) for one in unique.values())
    if results.results or results.campaign is None:
        return ()
    return (
        *check_plausibility(results.campaign),
        *campaign_findings(check_tests(results.campaign)),
    )


def _finding(one: Finding) -> Light:
    level: dict[str, Level] = {"told": "good", "look": "look", "bad": "bad"}
    value = {"told": "settled", "look": "look at it", "bad": "cannot be true as it stands"}[one.level]
    return Light(level[one.level], f"Tests: {one.check}", value, "nothing found", str(one))


def _calibration(content: dict[str, Any]) -> list[Light]:
    count, used = len(content["particles"]), sum(entry["kept"] for entry in content["particles"])
    share = used / count
    return [
        Light(
            "good" if content["converged"] else "bad",
            "Calibration converged",
            "yes" if content["converged"] else "no",
            "yes",
            "Every part of the calibration met its own tolerances."
            if content["converged"]
            else "The numbers are not to be trusted before the checks below are mended.",
        ),
        Light(
            "good" if share == 1 and used >= FEW_PARTICLES else "look" if share >= 0.5 and used > 1 else "bad",
            "Particles used",
            f"{used} of {count}",
            f"all, and at least {FEW_PARTICLES}",
            "Few particles say little of how particles differ. Why some are left out stands with what was measured.",
        ),
    ]


def _sampler(d: dict[str, Any]) -> list[Light]:
    rhat, ess, divergences, k = (d.get(n) for n in ("rhat_max", "ess_bulk_min", "divergences", "pareto_k_max"))
    joint = d.get("pareto_k_joint")
    worst = None if k is None else max(k, joint or k)
    return [
        Light(
            _below(rhat, SAMPLING.rhat, RHAT_BAD),
            "Chains agree (R-hat)",
            number(rhat),
            f"at most {SAMPLING.rhat}",
            "Chains that started apart must end with one answer. If not: more draws (--draws).",
        ),
        Light(
            _below(None if ess is None else -ess, -SAMPLING.ess, -ESS_BAD),
            "Independent draws (bulk ESS)",
            number(ess),
            f"at least {SAMPLING.ess:.0f}",
            "So many independent draws the chains are worth. If too few: more draws (--draws).",
        ),
        Light(
            "unknown" if divergences is None else "good" if divergences == 0 else "bad",
            "Diverging trajectories",
            number(divergences),
            "0",
            "The sampler could not follow the posterior everywhere. If not 0: more draws, or narrower priors.",
        ),
        Light(
            _below(worst, SAMPLING.pareto_k, PARETO_K_BAD),
            "Fast mode is accurate (Pareto k)",
            number(worst, 2),
            f"at most {SAMPLING.pareto_k}",
            "How well the quadratic summaries of the fast mode stand for the tests themselves. If not: --mode joint.",
        ),
    ]


def _own_misfit(shown: Sequence[FittedCurve]) -> float:
    """Median over the particles of the root mean square misfit, in shares of the range of displacement."""
    own = [(one.rms_um, float(np.ptp(one.displacement_um[one.used]))) for one in shown if one.rms_um is not None]
    return float(np.median([rms / reach for rms, reach in own if rms is not None and reach > 0] or [np.nan]))


def _fit(content: dict[str, Any], shown: Sequence[FittedCurve]) -> list[Light]:
    d = content["diagnostics"]
    misfit, share = d.get("own_misfit"), (content.get("probability_not_monotone") or {}).get("value")
    if misfit is None and shown:
        misfit = _own_misfit(shown)
    found = []
    if misfit is not None and np.isfinite(misfit):
        found.append(
            Light(
                _below(misfit, GOOD_MISFIT, JUDGEMENT.misfit),
                "The law's form fits",
                f"off by {percent(misfit)}",
                f"at most {percent(GOOD_MISFIT)}",
                "Median misfit with each particle's own coefficients, as a share of its range of displacement. If "
                "large: these may be no compressions of single particles, or the diameters are wrong.",
            )
        )
    noise = d.get("noise_share")
    if noise is not None:
        found.append(
            Light(
                _below(noise, GOOD_NOISE_SHARE, JUDGEMENT.noise_share),
                "What is left is noise",
                f"{percent(noise)} hangs together",
                f"at most {percent(GOOD_NOISE_SHARE)}",
                "Share of what is left that is correlated along a test. A large one is not noise of the instrument but "
                "something that the law misses, and the stated errors are those of a law that misses it.",
            )
        )
    if share is not None:
        found.append(
            Light(
                "good" if share <= NOT_MONOTONE else "look",
                "New particles behave",
                f"{percent(share)} snap through",
                f"at most {percent(NOT_MONOTONE)}",
                "Share of particles drawn from this population whose loading curve would fall somewhere.",
            )
        )
    gaps = d.get("open_combinations", [])
    name = "Data determine the parameters"
    return found + [Light("bad", name, "not all", "all", f"The data leave open: {text}.") for text in gaps]


def share_inside(shown: Sequence[FittedCurve]) -> float | None:
    """Share of all compared points inside their band [-]; None without bands."""
    pairs = [(one.displacement_um, one.low_um, one.high_um, one.used & np.isfinite(one.low_um)) for one in shown]
    inside = [((um >= low) & (um <= high))[some] for um, low, high, some in pairs]
    return float(np.mean(np.concatenate(inside))) if sum(map(len, inside)) else None


def _coverage(inside: float) -> Light:
    low, high = INSIDE
    return Light(
        "good" if low <= inside <= high else "look",
        "Prediction bands hold",
        f"{percent(inside, 3)} of points inside",
        f"about 95 %, {percent(low)} to {percent(high)}",
        "Measured points inside the band that should hold 95 % of them. Fewer: the law misses something, or the "
        "noise is larger than estimated. More: the noise is smaller.",
    )


def _data(results: Results) -> Light:
    assert results.calibration is not None
    told = checksums_told(results.calibration)
    if not told or not results.checksums:
        return Light(
            "unknown", "Same data", "cannot tell", "checksums agree", "Checksums or the campaign's files are missing."
        )
    same = all(results.checksums.get(name) == told.get(name) for name in ("particles.csv", "curves.csv"))
    return Light(
        "good" if same and not results.cautions else "bad",
        "Same data",
        "checksums agree" if same else "checksums differ",
        "checksums agree",
        "The data shown here are those that were calibrated. If not: calibrate again.",
    )


def _discovery(content: dict[str, Any]) -> Light:
    level: dict[str, Level] = {"NO_GAP": "good", "FIT_NOT_CONVERGED": "bad"}
    meaning = {
        "NO_GAP": "Nothing is missing in the law that these tests could show.",
        "NAMED": "The law alone is incomplete: use its parameters together with the effect that was added.",
        "SET": "The law alone is incomplete, and these tests cannot tell several causes apart.",
        "UNLISTED": "The law alone is incomplete, and no listed mechanism explains it.",
        "FIT_NOT_CONVERGED": "The law could not be fitted well enough to ask what it lacks.",
    }
    verdict = content["verdict"]
    return Light(
        level.get(verdict, "look"), "Law is complete", ANSWERS[verdict], ANSWERS["NO_GAP"].lower(), meaning[verdict]
    )


def _below(value: float | int | None, good: float, bad: float) -> Level:
    if value is None:
        return "unknown"
    return "good" if value <= good else "look" if value <= bad else "bad"
