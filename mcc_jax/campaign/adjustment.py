"""Loading curves as strain over stress, and the paper's removal of the first, uncharacterised contact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import arguments
from .._format import described
from .findings import Finding
from .reasons import below_threshold, far_apart, no_climb, no_loading, too_few
from .schema import Campaign, Curve
from .segments import Segment, contact_index, find_segments
from .validate import check_campaign

THRESHOLD_MPA = 0.2
"""Stress below which surface irregularities, not the particle, deform [MPa] (Bommireddy et al. 2018, section 3)."""
MACHINE_ZERO = (-0.25, 1.0)
"""Where the first displacement of a record without approach may lie, in shares of the range of displacement, for the
test machine's zero to be the contact. Below, the platens would touch long before they meet; above, the test would have
begun after more compression than it then shows. Beyond, the first reading is the contact."""
LEAST_LEVELS = 2  # a loading curve of fewer points above the threshold has no course there


@dataclass(frozen=True)
class LoadingCurve:
    r"""Strain at which virgin loading first reached a stress, :math:`\epsilon_i(\sigma)`.

    Attributes:
        stress_MPa: increasing stresses [MPa], shape (n,), n >= 2.
        strain: the strains there [-], from the test's zero of displacement.
    """

    stress_MPa: np.ndarray
    strain: np.ndarray

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
    r"""Effective stress [MPa] and strain [-] of every point of a test.

    .. math:: \sigma = F / (\pi R_e^2), \qquad \epsilon = (\gamma - \gamma_0) / D_e

    Strain counts from :math:`\gamma_0`, the platen's position at first contact: where the approach ends if the record
    has one, the test machine's own zero otherwise, or the first reading if that zero is far from the test
    (`MACHINE_ZERO`).

    References:
        Bommireddy et al. (2018), eqs. 3 and 4.
    """
    diameters_um = arguments.one_particle(diameters_um)
    diameter = effective_diameter_um(diameters_um)
    zero = _contact_um(curve, segments)
    return 1e3 * curve.force_mN / (np.pi * diameter**2 / 4), (curve.displacement_um - zero) / diameter


def _contact_um(curve: Curve, segments: tuple[Segment, ...]) -> float:
    """The displacement at first contact [um]."""
    if contact := contact_index(segments):
        return float(curve.displacement_um[contact])
    first, reach = float(curve.displacement_um[0]), float(np.ptp(curve.displacement_um))
    low, high = MACHINE_ZERO
    return 0.0 if low * reach <= first <= high * reach else first


def loading_curve(curve: Curve, diameters_um: np.ndarray, segments: tuple[Segment, ...]) -> LoadingCurve | None:
    """The virgin loading of a test, over all its cycles, as strain over stress.

    Force is made monotone by isotonic regression, which, unlike a running maximum, is not lifted by noise; points that
    share one force are averaged. Readings that may not be compared with a law do not count. None if the test never
    loads.
    """
    diameters_um = arguments.one_particle(diameters_um)
    from scipy.optimize import isotonic_regression  # half a second to import, so only where it is used

    virgin = [np.arange(s.start, s.stop) for s in segments if s.kind == "load"]
    if not virgin:
        return None
    rows = np.concatenate(virgin)
    rows = rows[curve.compared[rows]]
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
    """The paper's offset step for a whole campaign.

    Attributes:
        curves: adjusted loading curve of every particle that is kept, None for the others.
        shift: what was added to each particle's strain [-], shape (N,); 0 where not kept.
        threshold_MPa: the stress at which all adjusted curves meet; 0 if no offset step was made.
        strain: their common strain there, the mean over the particles.
        reasons: for each particle, None if kept, else why it is not.
        segments: the segments of every test, for whoever needs them next.
    """

    curves: tuple[LoadingCurve | None, ...]
    shift: np.ndarray
    threshold_MPa: float
    strain: float
    reasons: tuple[Finding | None, ...]
    segments: tuple[tuple[Segment, ...], ...]

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
    documentation for how much. `threshold_MPa = 0` leaves every curve as measured.

    References:
        Bommireddy et al. (2018), section 3.
    """
    segments = campaign_segments(campaign)
    threshold_MPa = arguments.number(threshold_MPa, "threshold_MPa, a stress,", least=0)
    raw = [loading_curve(*one) for one in zip(campaign.curves, campaign.diameters_um, segments, strict=True)]
    reasons = [
        _why_not(*one, threshold_MPa) for one in zip(raw, campaign.curves, campaign.diameters_um, segments, strict=True)
    ]
    used = [c if r is None else None for c, r in zip(raw, reasons, strict=True)]
    stress = [None if c is None else c.stress_max_MPa for c in used]
    strain = [None if c is None else float(np.ptp(c.strain[1:])) for c in used]
    reasons = [reason or apart for reason, apart in zip(reasons, far_apart(stress, strain), strict=True)]
    kept = tuple(c if r is None else None for c, r in zip(raw, reasons, strict=True))
    at_threshold = [None if c is None else float(c.at(threshold_MPa)) for c in kept]
    known = [value for value in at_threshold if value is not None]
    if threshold_MPa == 0 or not known:
        return Adjustment(kept, np.zeros(len(raw)), threshold_MPa, 0.0, tuple(reasons), segments)
    mean = float(np.mean(known))
    shift = np.array([0.0 if value is None else mean - value for value in at_threshold])
    adjusted = tuple(
        None if curve is None else _through(curve, offset, threshold_MPa, mean)
        for curve, offset in zip(kept, shift, strict=True)
    )
    return Adjustment(adjusted, shift, threshold_MPa, mean, tuple(reasons), segments)


def _through(curve: LoadingCurve, offset: float, threshold_MPa: float, strain: float) -> LoadingCurve:
    """The curve moved by a strain, and straight from the origin to a strain at the threshold."""
    above = curve.stress_MPa > threshold_MPa
    return LoadingCurve(
        np.concatenate([[0.0, threshold_MPa], curve.stress_MPa[above]]),
        np.concatenate([[0.0, strain], curve.strain[above] + offset]),
    )


def _why_not(
    loading: LoadingCurve | None,
    curve: Curve,
    diameters_um: np.ndarray,
    segments: tuple[Segment, ...],
    threshold_MPa: float,
) -> Finding | None:
    """Why a test cannot be used; None if it can."""
    if loading is None:
        return no_loading(curve, segments, stress_and_strain(curve, diameters_um, segments)[0], threshold_MPa)
    if loading.stress_max_MPa <= threshold_MPa:
        return below_threshold(loading.stress_max_MPa, threshold_MPa)
    strain = loading.strain[1:][loading.stress_MPa[1:] > threshold_MPa]
    if len(strain) < LEAST_LEVELS:
        return too_few(len(strain), LEAST_LEVELS)
    third = max(len(strain) // 3, 1)
    rise = float(strain[-third:].mean() - strain[:third].mean())
    return None if rise > 0 else no_climb(rise * effective_diameter_um(diameters_um))
