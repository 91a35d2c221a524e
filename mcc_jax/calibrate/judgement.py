"""What a reader of a calibration must know of its tests: faults, outlying particles, implausible numbers.

Whatever is found of single particles is reported with the answer without them, so that no flagged test moves or widens
the answer of the others in silence.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .._errors import InputError
from ..campaign import Campaign, Finding, campaign_findings, check_plausibility
from ..campaign.findings import named
from ..campaign.plausibility import add_likely_unit_error

MODULUS_OPEN = "unknown modulus"  # the `check` of the finding that the tests leave the modulus open
UNLOAD = "Unload the particles before the test ends, and record the unloading with as many readings as the loading"

# Found by trial on simulated campaigns.
# The law describes tests badly that it misses by this share of their range of displacement with every particle's own
# coefficients; with the law's own data and an instrument's noise it stays below 0.01.
LARGE_MISFIT = 0.05
# Share of the residual's variance from which on correlated noise is suspect: then it is as large as read-out noise.
CORRELATED_SHARE = 0.5
LEAST_LEFT = 3  # particles that an answer without the flagged ones rests on
# A particle is unlike the others if the logarithm of its residual lies so many robust standard deviations (1.4826 times
# the median absolute deviation) above their median, of which no one in 1000 normal ones does, and the residual is so
# many times their median, at least: smaller differences do no harm.
OUTLYING, TIMES = 5.0, 3.0
SHARE = 0.2  # of the particles, at most, can be unlike all others; more are a mixture
LEAST = 5  # particles to know what is usual
ANSWERS = 4  # sets of flagged particles that are left out in turn for an answer without them, at most
# Flagged particles are left out for such an answer if they are at least this share of all: fewer hardly move what all
# share, and the answer would cost a whole calibration of many particles.
FEW = 0.01
# The modulus is unknown if its standard deviation is at least this share of it: the 95 % interval then spans a factor
# of seven, nearly that of the prior (50), in which most solids lie.
UNKNOWN = 0.5


def unlike_others(names: Sequence[str], rms_um: np.ndarray, range_um: np.ndarray) -> Finding | None:
    """The particles whose root mean square residual is unlike all others', both in micrometres and as a share of their
    range of displacement [um]."""
    rms = np.asarray(rms_um, float)
    known = np.isfinite(rms) & (rms > 0) & (range_um > 0)
    if known.sum() < LEAST:
        return None
    far = np.zeros(len(rms), bool)
    logs = np.log([rms[known], rms[known] / range_um[known]])
    away = logs - np.median(logs, axis=1, keepdims=True)
    spread = 1.4826 * np.median(np.abs(away), axis=1, keepdims=True)
    far[known] = np.all(away > np.maximum(OUTLYING * spread, np.log(TIMES)), axis=0)
    if not far.any() or far.sum() > max(1, SHARE * len(rms)):
        return None
    which = tuple(n for n, out in zip(names, far, strict=True) if out)
    times = rms[far] / np.median(rms[known])
    low, high = f"{times.min():.2g}", f"{times.max():.2g}"
    text = f"{named(which, len(names))}: the residual is {low if low == high else f'{low} to {high}'} times the others'"
    remedy = "Look at the curve, and leave the particle out if it is not a valid test"
    return Finding("unlike the others", "warning", text, remedy, which)


def unknown_modulus(campaign: Campaign, modulus: Mapping[str, Any]) -> Finding | None:
    """That the tests leave the modulus [MPa] open, and why; None if they determine it, or the method gives no error."""
    if not is_unknown(modulus):
        return None
    interval = modulus.get("interval_95")
    between = "" if interval is None else f" (between {1e-3 * interval[0]:.2g} and {1e-3 * interval[1]:.2g} GPa)"
    # Of several channels at the end of their range it is that of the displacement which hides unloading.
    found = {one.code: one for curve in campaign.curves if curve.checked for one in curve.checked.findings}
    why, remedy = ": too little of their unloading can be compared with the law", UNLOAD
    for channel in ("force", "displacement"):
        if (end := found.get(f"{channel} range")) is not None:
            why, remedy = f": {channel} is at the end of its range where they unload", end.remedy
    return Finding(MODULUS_OPEN, "warning", f"The tests do not determine the modulus{between}{why}", remedy)


def is_unknown(modulus: Mapping[str, Any]) -> bool:
    """Whether an estimate of the modulus is so wide that it says nothing; not where the method gives no error."""
    value, sd = modulus["value"], modulus["sd"]
    return value is not None and sd is not None and sd >= UNKNOWN * abs(value)


def judged(
    campaign: Campaign,
    answer: Mapping[str, Any],
    outlying: Finding | None,
    again: Callable[[Campaign], Mapping[str, Any]] | None,
) -> tuple[Finding, ...]:
    """All findings of a calibrated campaign, with what `unlike_others` found, each with what the answer is without
    the particles that it names. `again` calibrates a campaign and returns its answer; None to leave these out."""
    modulus = answer["effective_modulus_MPa"]
    if not answer["converged"]:
        modulus = {**modulus, "interval_95": None}  # not to be believed, so not reported
    unknown = unknown_modulus(campaign, modulus)
    value = modulus["value"] if unknown is None else None  # what is not known cannot be implausible
    plausibility = check_plausibility(campaign, modulus_MPa=value)
    found = [one for one in (*campaign_findings(campaign), outlying, unknown, *plausibility) if one is not None]
    if again is None:
        return tuple(found)

    def without(names: tuple[str, ...]) -> str:
        it = "it" if len(names) == 1 else "them"
        try:
            return f"without {it} {_answer(again(campaign.without(*names)))}, with {it} {_answer(answer)}"
        except InputError as error:
            return f"without {it} there is no answer ({error.problem})"

    answers: dict[tuple[str, ...], str] = {}
    findings = []
    for one in found:
        names, left = one.particles, len(campaign) - len(one.particles)
        some = len(names) >= max(1, FEW * len(campaign)) and left >= max(LEAST_LEFT, len(names))
        if one.level != "info" and some:
            if names not in answers and len(answers) < ANSWERS:
                answers[names] = without(names)
            if names in answers:
                one = replace(one, sentence=f"{one.sentence}; {answers[names]}")
        findings.append(one)
    return tuple(findings)


@contextlib.contextmanager
def numbers_in_reach(campaign: Campaign) -> Iterator[None]:
    """Raise `InputError`, a line that a person can act on, in place of errors about singular or infinite matrices."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            yield
    except (ArithmeticError, ValueError) as error:
        text = str(error)
        # A ValueError of ours is about an argument; those of NumPy and SciPy that are meant here speak of NaN.
        if not isinstance(error, ArithmeticError | np.linalg.LinAlgError) and "infs or NaN" not in text:
            raise
        problem = "the law cannot be fitted to these tests: their numbers are beyond what arithmetic can resolve"
        remedy = "Look at the curves, leave out the test that is unlike the others, and check the units"
        problem, remedy = add_likely_unit_error(campaign, f"{problem} ({text})", remedy)
        raise InputError(problem, file=campaign.source or None, remedy=remedy) from None


def _answer(content: Mapping[str, Any]) -> str:
    def pair(estimate: Mapping[str, Any], factor: float = 1.0) -> str:
        value, sd = estimate["value"], estimate["sd"]
        if value is None:
            return "unknown"
        return f"{factor * value:.4g}" + ("" if sd is None else f" +- {factor * sd:.2g}")

    modulus, end = content["effective_modulus_MPa"], "" if content["converged"] else " (not converged)"
    known = modulus["value"] is not None and not is_unknown(modulus)
    return f"the modulus is {f'{pair(modulus, 1e-3)} GPa' if known else 'unknown'} and a {pair(content['a'])}{end}"
