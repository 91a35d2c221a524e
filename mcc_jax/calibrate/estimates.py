"""Estimates as result files hold them: value, standard deviation, interval; the same for every method."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..campaign import Curve
from .settings import JUDGEMENT

NO_SAMPLER: dict[str, None] = dict.fromkeys(("rhat_max", "ess_bulk_min", "divergences", "pareto_k_max"))
"""Diagnostics of methods that draw nothing."""


def misfit_note(own_misfit: float) -> str | None:
    """A sentence if the law describes the tests badly even with each particle's own coefficients, else None."""
    if not own_misfit > JUDGEMENT.misfit:
        return None
    return (
        "even with its own C1, C3, C5 the law misses a test's displacements by "
        f"{100 * own_misfit:.0f} % of their range (median): "
        "it describes these tests badly, or they are no compressions of single particles"
    )


def missed(rms_um: np.ndarray, share: float) -> str:
    """How far the law is from the tests, in words, from every particle's root mean square and `own_misfit`."""
    return f"{np.median(rms_um):.2g} um, {100 * share:.2g} % of their range (medians)"


def noise_note(share: float, by: str) -> str | None:
    """A sentence if correlated noise has taken up what the law misses, `by` so much (`missed`), else None."""
    if not share > JUDGEMENT.noise_share:
        return None
    return (
        f"the law misses displacements by {by}; {100 * share:.0f} % of that is correlated along a test: more likely "
        "something that the law lacks than noise of the instrument; mcc_jax.discover looks for what it is"
    )


def finite(value: float) -> float | None:
    """The number, or None if it is not finite: JSON knows neither NaN nor infinity."""
    return float(value) if math.isfinite(value) else None


def estimate(
    value: float | None, sd: float | None = None, interval_95: tuple[float, float] | None = None
) -> dict[str, Any]:
    """One estimate; what a method does not give, or what is not finite, is None."""
    known = interval_95 is not None and all(math.isfinite(end) for end in interval_95)
    return {
        "value": None if value is None else finite(value),
        "sd": None if sd is None else finite(sd),
        "interval_95": [float(end) for end in interval_95] if interval_95 is not None and known else None,
    }


def force_zero(curve: Curve) -> dict[str, Any]:
    """The zero of force [mN] that was taken off a test; null where no reading in the air tells it."""
    checked = curve.checked
    if checked is None or not (checked.force_zero_mN or checked.force_zero_sd_mN):
        return estimate(None)
    value, sd = checked.force_zero_mN, checked.force_zero_sd_mN
    return estimate(value, sd, (value - 1.96 * sd, value + 1.96 * sd))


def summary(draws: np.ndarray) -> dict[str, Any]:
    """Mean, standard deviation and central 95 % interval of draws."""
    low, high = np.quantile(draws, [0.025, 0.975])
    return estimate(float(np.mean(draws)), float(np.std(draws)), (float(low), float(high)))


def log_estimate(log: float, sd: float) -> dict[str, Any]:
    """An estimate from its logarithm's mean and standard deviation."""
    value = power_of_e(log)
    if not math.isfinite(sd):
        return estimate(value)
    sd = min(sd, 5.0)
    return estimate(value, value * sd, (value * math.exp(-1.96 * sd), value * math.exp(1.96 * sd)))


def power_of_e(log: float) -> float:
    """The exponential, infinite where it overflows."""
    try:
        return math.exp(log)
    except OverflowError:
        return math.inf
