"""Loading curves as strain over stress, the paper's removal of the first contact, and why a test cannot be used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import described
from .findings import Finding
from .plausibility import add_likely_unit_error
from .schema import Campaign, Curve, check_campaign
from .segments import Segment, contact_index, find_segments
from .signal import median

THRESHOLD_MPA = 0.2
"""Stress below which surface irregularities, not the particle, deform [MPa] (Bommireddy et al. 2018, section 3)."""
# Where the first displacement of a record without approach may lie, in shares of its range, for the test machine's
# zero to be the contact. Below, the platens would touch long before they meet; above, the test begins compressed.
MACHINE_ZERO = (-0.25, 1.0)
LEAST_LEVELS = 2  # a loading curve of fewer points above the threshold has no course there
FEW_FORCES = 5  # a record with no more different forces shows steps of its read-out, not a curve of three coefficients
# Factor in stress and strain within which tests on one material end: the paper's end between 7 and 16 MPa
FAR_APART = 100.0
CLIMB = 8.0  # displacement must grow over loading by this many standard errors of its noise
SHOWN = 3  # particles that an error names with their reasons, at most


@dataclass(frozen=True)
class LoadingCurve:
    r"""Strain at which virgin loading first reached a stress, :math:`\epsilon_i(\sigma)`; shape (n,), n >= 2."""

    stress_MPa: np.ndarray  # increasing
    strain: np.ndarray  # from the test's zero of displacement

    __repr__ = described()

    @property
    def stress_max_MPa(self) -> float:
        """The largest stress that was reached."""
        return float(self.stress_MPa[-1])

    def at(self, stress_MPa: np.ndarray | float) -> np.ndarray:
        """Strain at the stresses, linear between measured points; NaN beyond the largest stress that was measured."""
        return np.asarray(np.interp(stress_MPa, self.stress_MPa, self.strain, right=np.nan), dtype=float)


def effective_diameter_um(diameters_um: Any) -> float:
    """D_e = D1 D2 / D3 [um] of one particle's three diameters [um]."""
    D1, D2, D3 = arguments.one_particle(diameters_um)
    return float(D1 * D2 / D3)


def campaign_segments(campaign: Campaign) -> tuple[tuple[Segment, ...], ...]:
    """The segments of every test, found with the campaign's own control if it is known."""
    check_campaign(campaign)
    return tuple(find_segments(curve, control=campaign.metadata.control) for curve in campaign.curves)


def stress_and_strain(
    curve: Curve, diameters_um: np.ndarray, segments: tuple[Segment, ...]
) -> tuple[np.ndarray, np.ndarray]:
    r"""Effective stress [MPa] and strain [-] of every point of a test (Bommireddy et al. 2018, eqs. 3 and 4).

    .. math:: \sigma = F / (\pi R_e^2), \qquad \epsilon = (\gamma - \gamma_0) / D_e

    Strain counts from :math:`\gamma_0`, the platen's position at first contact: where the approach ends if the record
    has one, the test machine's own zero otherwise, or the first reading if that zero is far from the test
    (`MACHINE_ZERO`).
    """
    diameter, path = effective_diameter_um(diameters_um), curve.displacement_um
    first, reach = float(path[0]), float(np.ptp(path))
    zero = 0.0 if MACHINE_ZERO[0] * reach <= first <= MACHINE_ZERO[1] * reach else first
    if contact := contact_index(segments):
        zero = float(path[contact])
    return 1e3 * curve.force_mN / (np.pi * diameter**2 / 4), (path - zero) / diameter


def loading_curve(curve: Curve, diameters_um: np.ndarray, segments: tuple[Segment, ...]) -> LoadingCurve | None:
    """The virgin loading of a test, over all its cycles, as strain over stress; None if the test never loads.

    Force is made monotone by isotonic regression, which, unlike a running maximum, is not lifted by noise. Readings
    that may not be compared with a law do not count.
    """
    from scipy.optimize import isotonic_regression  # half a second to import, so only where it is used

    virgin = np.zeros(len(curve), bool)
    for part in segments:
        virgin[part.start : part.stop] = part.kind == "load"
    rows = np.flatnonzero(virgin & curve.compared)
    if not len(rows):
        return None
    stress, strain = stress_and_strain(curve, diameters_um, segments)
    fit = isotonic_regression(stress[rows])
    starts = fit.blocks[:-1]
    level = np.asarray(fit.x)[starts]
    mean_strain = np.add.reduceat(strain[rows], starts) / np.diff(fit.blocks)
    positive = level > 0
    level, mean_strain = level[positive], mean_strain[positive]
    if len(level) < 2:
        return None
    return LoadingCurve(np.concatenate([[0.0], level]), np.concatenate([[min(0.0, mean_strain[0])], mean_strain]))


@dataclass(frozen=True)
class Adjustment:
    """The paper's offset step for a whole campaign."""

    curves: tuple[LoadingCurve | None, ...]  # adjusted, of every particle that is kept
    shift: np.ndarray  # what was added to each particle's strain [-], shape (N,); 0 where not kept
    threshold_MPa: float  # at which all adjusted curves meet; 0 if no offset step was made
    strain: float  # their common strain there, the mean over the particles
    reasons: tuple[Finding | None, ...]  # why a particle is not kept
    segments: tuple[tuple[Segment, ...], ...]  # of every test

    __repr__ = described()

    @property
    def kept(self) -> np.ndarray:
        """Which particles are kept, booleans of shape (N,)."""
        return np.array([reason is None for reason in self.reasons])

    @property
    def why_not(self) -> tuple[str | None, ...]:
        """The reasons in words."""
        return tuple(None if one is None else one.reason for one in self.reasons)


def adjust(campaign: Campaign, threshold_MPa: float = THRESHOLD_MPA) -> Adjustment:
    r"""Shift every curve so that at the threshold stress all share the mean strain; below it, a straight line.

    .. math:: \epsilon_i \leftarrow \epsilon_i - \epsilon_i(\sigma_t) + \bar\epsilon_t, \qquad
        \bar\epsilon_t = \tfrac1N \sum_j \epsilon_j(\sigma_t)

    The step also removes true differences in shape below the threshold, which biases `a`; see `calibrate`'s
    documentation for how much. `threshold_MPa = 0` leaves every curve as measured (Bommireddy et al. 2018, section 3).
    """
    segments = campaign_segments(campaign)
    threshold_MPa = arguments.number(threshold_MPa, "threshold_MPa, a stress,", least=0)
    used: dict[int, LoadingCurve] = {}
    reasons: list[Finding | None] = []
    for i, test in enumerate(zip(campaign.curves, campaign.diameters_um, segments, strict=True)):
        loading = loading_curve(*test)
        if loading is None:
            stress, _ = stress_and_strain(*test)
            reasons.append(no_loading(campaign.curves[i], segments[i], stress, threshold_MPa))
            continue
        strain = loading.strain[1:][loading.stress_MPa[1:] > threshold_MPa]
        climb_um = strain * effective_diameter_um(campaign.diameters_um[i])
        reasons.append(no_curve(climb_um, loading.stress_max_MPa, threshold_MPa, least_points=LEAST_LEVELS))
        if reasons[i] is None:
            used[i] = loading
    apart = far_apart({i: (curve.stress_max_MPa, float(np.ptp(curve.strain[1:]))) for i, curve in used.items()})
    used = {i: curve for i, curve in used.items() if i not in apart}
    shift, mean = np.zeros(len(campaign)), 0.0
    if threshold_MPa > 0 and used:
        strain = {i: float(curve.at(threshold_MPa)) for i, curve in used.items()}
        mean = float(np.mean(list(strain.values())))
        for i, curve in used.items():
            shift[i] = mean - strain[i]
            above = curve.stress_MPa > threshold_MPa
            used[i] = LoadingCurve(
                np.concatenate([[0.0, threshold_MPa], curve.stress_MPa[above]]),
                np.concatenate([[0.0, mean], curve.strain[above] + shift[i]]),
            )
    curves = tuple(used.get(i) for i in range(len(campaign)))
    why_not = tuple(apart.get(i, reason) for i, reason in enumerate(reasons))
    return Adjustment(curves, shift, threshold_MPa, mean, why_not, segments)


def _reason(sentence: str, remedy: str) -> Finding:
    return Finding("usable", "error", sentence, remedy)


def no_loading(curve: Curve, segments: tuple[Segment, ...], stress_MPa: np.ndarray, threshold_MPa: float) -> Finding:
    """Why a test with these stresses [MPa] has no virgin loading; below the threshold nothing counts."""
    force = curve.force_mN
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


def no_curve(
    climb_um: np.ndarray, stress_max_MPa: float, threshold_MPa: float, *, least_points: int, noise_um: float = 0.0
) -> Finding | None:
    """Why a test that loads has no curve that a law could be compared with; None if it has one. `climb_um`, its
    displacement along the loading that counts, must grow beyond its noise."""
    if stress_max_MPa <= threshold_MPa:
        return below_threshold(stress_max_MPa, threshold_MPa)
    if len(climb_um) < least_points:
        what = f"has {len(climb_um)} usable points on loading, fewer than {least_points}"
        return _reason(what, "record loading with more readings, or lower the threshold")
    third = max(len(climb_um) // 3, 1)
    rise = float(climb_um[-third:].mean() - climb_um[:third].mean())
    least = CLIMB * noise_um / np.sqrt(third)
    if rise > least:
        return None
    if rise > 0:
        what = f"displacement grows with force by {rise:.3g} um only, not beyond its noise"
        remedy = "check the unit and the column of displacement, or leave the particle out"
    elif rise < -least:
        what = f"displacement falls by {-rise:.3g} um while force grows"
        remedy = "reverse the sign of displacement: it must grow as the platens approach each other"
    else:
        what = "displacement stays the same while force grows"
        remedy = "check that the right column is taken as displacement, or leave the particle out"
    return _reason(f"shows no loading curve: {what}", remedy)


def below_threshold(stress_MPa: float, threshold_MPa: float) -> Finding:
    """Why a test is too weak: it reaches no more than `stress_MPa`."""
    what = f"reaches {stress_MPa:.3g} MPa only, not the threshold of {threshold_MPa:g} MPa"
    remedy = "check the unit of force and the diameters (they turn force into stress), or lower the threshold"
    return _reason(what, remedy)


_APART = (
    ("reaches {:.3g} MPa where the others reach {:.3g} MPa", "force and its diameters (they turn force into stress)"),
    ("is compressed by {:.3g} of its size where the others are by {:.3g}", "displacement and its diameters"),
)


def far_apart(ends: Mapping[int, tuple[float, float]]) -> dict[int, Finding]:
    """Which tests are in other units than the rest, by the largest stress [MPa] of each and its range of displacement
    over its effective diameter."""
    found: dict[int, Finding] = {}
    for k, (what, unit) in enumerate(_APART):
        ordered = np.sort([end[k] for end in ends.values()])
        for i, end in ends.items() if len(ends) > 1 else ():
            usual = median(np.delete(ordered, np.searchsorted(ordered, end[k])))
            if i not in found and not usual / FAR_APART <= end[k] <= usual * FAR_APART:
                found[i] = _reason(what.format(end[k], usual), f"check its unit of {unit}, or leave the particle out")
    return found


def refusal(campaign: Campaign, problem: str, reasons: Sequence[Finding | None]) -> InputError:
    """The error that says why particles cannot be used, with every reason once, and what to do."""
    groups: dict[Finding, list[str]] = {}
    for name, reason in zip(campaign.particles, reasons, strict=True):
        if reason is not None:
            groups.setdefault(reason, []).append(repr(name))
    parts, remedies = [], []
    for reason, names in list(groups.items())[:SHOWN]:
        more = ", ".join(names[1:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        parts.append(f"particle {names[0]} {reason.sentence}" + (f" (likewise {more})" if more else ""))
        remedies.append(reason.remedy[:1].upper() + reason.remedy[1:])
    parts += ["..."] * (len(groups) > SHOWN)
    remedy = ". ".join(dict.fromkeys(remedies))
    problem, remedy = add_likely_unit_error(campaign, f"{problem}: {'; '.join(parts)}", remedy)
    return InputError(problem, file=campaign.source or None, remedy=f"{remedy}.")
