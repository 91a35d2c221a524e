"""Why a test cannot be used, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._errors import InputError
from .findings import Finding
from .plausibility import add_likely_unit_error
from .schema import Campaign, Curve
from .segments import Segment
from .signal import median

FEW_FORCES = 5  # a record with no more different forces shows steps of its read-out, not a curve of three coefficients
FAR_APART = 100.0
"""Tests on one material end within this factor of each other in stress and in strain: the paper's end between 7 and 16
MPa, and of the 801 stresses at which its method compares them a test so far below would see eight."""
SHOWN = 3
"""Most particles that an error names with their reasons."""


def _reason(sentence: str, remedy: str) -> Finding:
    return Finding("usable", "error", sentence, remedy)


def no_loading(curve: Curve, segments: tuple[Segment, ...], stress_MPa: np.ndarray, threshold_MPa: float) -> Finding:
    """Why a test with these stresses [MPa], shape (n,), has no virgin loading; below the threshold nothing counts."""
    force = np.asarray(curve.force_mN, float)
    low, high = float(force.min()), float(force.max())
    column = "check that the right column is taken as force, or"
    if not high > low:
        return _reason(f"has one force throughout, {high:.4g} mN, so it never loads", f"{column} export the test again")
    if np.abs(stress_MPa).max() <= threshold_MPa:
        return below_threshold(float(stress_MPa.max()), threshold_MPa)
    if -low > high:
        what = f"is under load where its force is negative, down to {low:.4g} mN"
        return _reason(what, "reverse the sign of force: compression must count as positive")
    touching = [part.kind for part in segments if part.kind in ("load", "unload", "reload")]
    if touching[:1] == ["unload"]:
        what = f"begins at its largest force, {force[0]:.4g} mN (unloading only), so its loading is missing"
        return _reason(what, "join the loading part of the test to it: some test machines store the two separately")
    levels = np.unique(force)
    if len(levels) <= FEW_FORCES:
        what = f"has {len(levels)} different forces only, in steps of {np.diff(levels).min():.4g} mN"
        return _reason(what, "export the force with more digits, or test with a finer load cell")
    return _reason("has no loading: force never rises above its noise", f"{column} leave the particle out")


def no_climb(rise_um: float) -> Finding:
    """Why a test has no loading curve although it loads: its displacement does not grow, by `rise_um` [um]."""
    if rise_um == 0:
        what = "displacement stays the same while force grows"
        remedy = "check that the right column is taken as displacement, or leave the particle out"
    elif rise_um < 0:
        what = f"displacement falls by {-rise_um:.3g} um while force grows"
        remedy = "reverse the sign of displacement: it must grow as the platens approach each other"
    else:
        what = f"displacement grows with force by {rise_um:.3g} um only, not beyond its noise"
        remedy = "check the unit and the column of displacement, or leave the particle out"
    return _reason(f"shows no loading curve: {what}", remedy)


def below_threshold(stress_MPa: float, threshold_MPa: float) -> Finding:
    """Why a test is too weak: it reaches no more than `stress_MPa`."""
    what = f"reaches {stress_MPa:.3g} MPa only, not the threshold of {threshold_MPa:g} MPa"
    return _reason(
        what, "check the unit of force and the diameters (they turn force into stress), or lower the threshold"
    )


def too_few(points: int, least: int) -> Finding:
    """Why a loading curve is too short."""
    what = f"has {points} usable points on loading, fewer than {least}"
    return _reason(what, "record loading with more readings, or lower the threshold")


def far_apart(stress_MPa: Sequence[float | None], strain: Sequence[float | None]) -> list[Finding | None]:
    """Which tests are in other units than the rest, by the largest stress of each particle and its range of
    displacement in shares of its effective diameter; None for those that are not used anyway."""
    found: list[Finding | None] = [None] * len(stress_MPa)
    weak = (
        "reaches {:.3g} MPa where the others reach {:.3g} MPa",
        "force and its diameters (they turn force into stress)",
    )
    short = "is compressed by {:.3g} of its size where the others are by {:.3g}", "displacement and its diameters"
    for values, (what, unit) in ((stress_MPa, weak), (strain, short)):
        ordered = np.sort([value for value in values if value is not None])
        for i, own in enumerate(values):
            if own is None or len(ordered) < 2 or found[i] is not None:
                continue
            usual = median(np.delete(ordered, np.searchsorted(ordered, own)))
            if not usual / FAR_APART <= own <= usual * FAR_APART:
                found[i] = _reason(what.format(own, usual), f"check its unit of {unit}, or leave the particle out")
    return found


def refusal(campaign: Campaign, problem: str, reasons: Sequence[Finding | None]) -> InputError:
    """The error that says why a campaign's particles cannot be used, with every reason once, and what to do; reasons
    are None for particles that can be used."""
    groups: dict[tuple[str, str], list[str]] = {}
    for name, reason in zip(campaign.particles, reasons, strict=True):
        if reason is not None:
            groups.setdefault((reason.sentence, reason.remedy), []).append(repr(name))
    parts, remedies = [], {}
    for (what, remedy), names in list(groups.items())[:SHOWN]:
        more = ", ".join(names[1:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        parts.append(f"particle {names[0]} {what}" + (f" (likewise {more})" if more else ""))
        remedies[remedy[:1].upper() + remedy[1:]] = None
    parts += ["..."] * (len(groups) > SHOWN)
    said = ". ".join(remedies)
    problem, said = add_likely_unit_error(campaign, f"{problem}: {'; '.join(parts)}", said)
    return InputError(problem, file=campaign.source or None, remedy=f"{said}.")
