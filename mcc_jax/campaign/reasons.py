"""Why a test cannot be used, and what to do about it: "what is wrong; what to do"."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._errors import InputError
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


def no_loading(curve: Curve, segments: tuple[Segment, ...], stress_MPa: np.ndarray, threshold_MPa: float) -> str:
    """Why a test with these stresses [MPa], shape (n,), has no virgin loading; below the threshold nothing counts."""
    force = np.asarray(curve.force_mN, float)
    low, high = float(force.min()), float(force.max())
    if not high > low:
        return (
            f"has one force throughout, {high:.4g} mN, so it never loads; "
            "check that the right column is taken as force, or export the test again"
        )
    if np.abs(stress_MPa).max() <= threshold_MPa:
        return below_threshold(float(stress_MPa.max()), threshold_MPa)
    if -low > high:
        return (
            f"is under load where its force is negative, down to {low:.4g} mN; "
            "reverse the sign of force: compression must count as positive"
        )
    touching = [part.kind for part in segments if part.kind in ("load", "unload", "reload")]
    if touching[:1] == ["unload"]:
        return (
            f"begins at its largest force, {force[0]:.4g} mN (unloading only), so its loading is missing; "
            "join the loading part of the test to it: some testers store the two apart"
        )
    levels = np.unique(force)
    if len(levels) <= FEW_FORCES:
        return (
            f"has {len(levels)} different forces only, in steps of {np.diff(levels).min():.4g} mN; "
            "export the force with more digits, or test with a finer load cell"
        )
    return (
        "has no loading: force never rises above its noise; "
        "check that the right column is taken as force, or leave the particle out"
    )


def no_climb(rise_um: float) -> str:
    """Why a test has no loading curve although it loads: its displacement does not grow, by `rise_um` [um]."""
    if rise_um == 0:
        return (
            "shows no loading curve: displacement stays the same while force grows; "
            "check that the right column is taken as displacement, or leave the particle out"
        )
    if rise_um < 0:
        return (
            f"shows no loading curve: displacement falls by {-rise_um:.3g} um while force grows; "
            "reverse the sign of displacement: it must grow as the platens approach each other"
        )
    return (
        f"shows no loading curve: displacement grows with force by {rise_um:.3g} um only, not beyond its noise; "
        "check the unit and the column of displacement, or leave the particle out"
    )


def below_threshold(stress_MPa: float, threshold_MPa: float) -> str:
    """Why a test is too weak: it reaches no more than `stress_MPa`."""
    return (
        f"reaches {stress_MPa:.3g} MPa only, not the threshold of {threshold_MPa:g} MPa; "
        "check the unit of force and the diameters (they turn force into stress), or lower the threshold"
    )


def too_few(points: int, least: int) -> str:
    """Why a loading curve is too short."""
    return (
        f"has {points} usable points on loading, fewer than {least}; "
        "record loading with more readings, or lower the threshold"
    )


def far_apart(stress_MPa: Sequence[float | None], strain: Sequence[float | None]) -> list[str | None]:
    """Which tests are in other units than the rest: their stresses or strains are far from those of all others.

    Args:
        stress_MPa: the largest stress of each particle; None for those that are not used anyway.
        strain: the range of displacement of each, in shares of its effective diameter; None likewise.
    """
    found: list[str | None] = []
    stresses, strains = (np.sort([v for v in values if v is not None]) for values in (stress_MPa, strain))
    for stress, share in zip(stress_MPa, strain, strict=True):
        reason = None
        if (usual := _others_median(stress, stresses)) is not None:
            reason = (
                f"reaches {stress:.3g} MPa where the others reach {usual:.3g} MPa; "
                "check its unit of force and its diameters (they turn force into stress), or leave the particle out"
            )
        elif (usual := _others_median(share, strains)) is not None:
            reason = (
                f"is compressed by {share:.3g} of its size where the others are by {usual:.3g}; "
                "check its unit of displacement and its diameters, or leave the particle out"
            )
        found.append(reason)
    return found


def _others_median(own: float | None, ordered: np.ndarray) -> float | None:
    """The median of the others, of all particles' values in order, if a particle's own is far from it; else None."""
    if own is None or len(ordered) < 2:
        return None
    usual = median(np.delete(ordered, np.searchsorted(ordered, own)))
    return None if usual / FAR_APART <= own <= usual * FAR_APART else usual


def refusal(campaign: Campaign, problem: str, why_not: Sequence[str | None]) -> InputError:
    """The error that says why a campaign's particles cannot be used, with every reason once, and what to do.

    Args:
        problem: what fails for want of particles.
        why_not: a reason for each particle, None for those that can be used.
    """
    names: dict[str, list[str]] = {}
    remedies: dict[str, None] = {}
    for name, reason in zip(campaign.particles, why_not, strict=True):
        if reason is not None:
            what, _, remedy = reason.partition("; ")
            names.setdefault(what, []).append(repr(name))
            if len(names) <= SHOWN:
                remedies.setdefault(remedy)
    parts = []
    for what, those in list(names.items())[:SHOWN]:
        more = ", ".join(those[1:4]) + (f" and {len(those) - 4} more" if len(those) > 4 else "")
        parts.append(f"particle {those[0]} {what}" + (f" (likewise {more})" if more else ""))
    if len(names) > SHOWN:
        parts.append("...")
    said = ". ".join(remedy[:1].upper() + remedy[1:] for remedy in remedies if remedy)
    problem, said = add_likely_unit_error(campaign, f"{problem}: {'; '.join(parts)}", said)
    return InputError(problem, file=campaign.source or None, remedy=f"{said}.")
