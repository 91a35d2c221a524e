"""Pull-off: the tension at which a particle lets go of the platens, and the work of adhesion that it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..formulas import PUNCH_AREA
from .adjustment import effective_diameter_um, stress_and_strain
from .findings import Finding
from .force_zero import AIR_READINGS, unusual
from .schema import Curve
from .segments import find_segments
from .signal import SMALLEST_STEP, median, point_noise

MILLIJOULE = 1e6  # mJ/m^2 in one mN/um
PULLED_OFF = Finding(
    "pull-off",
    "info",
    "the platens had to be pulled off, with up to {} mN; by the curvature of the imprint that is a work of adhesion of "
    "{} (DMT) to {} mJ/m^2 (JKR)",
    "The two are the limits of a stiff and of a compliant contact",
    code="pulled off",
)


@dataclass(frozen=True)
class PullOff:
    r"""Tension at which a particle lets go of two platens, and the work of adhesion :math:`w` of either limit.

    .. math:: F = \tfrac32 \pi w R \ (\text{JKR}), \quad F = 2 \pi w R \ (\text{DMT}), \qquad
        R = 4 a_P^2 / \Delta, \quad a_P^2 = c^2 D_e \gamma_P / 2

    R is the radius of curvature that full release leaves: near it the elastic branch is Hertz's for this radius, so the
    limits hold for a tension small against the largest force. Johnson, Kendall and Roberts (1971), Proc. R. Soc. A 324,
    301; Derjaguin, Muller and Toporov (1975); of plastic imprints Mesarovic and Johnson (2000), J. Mech. Phys. Solids
    48, 2009.

    Attributes:
        force_mN: the largest tension [mN].
        radius_um: R [um].
    """

    force_mN: float
    radius_um: float

    @property
    def work_by_jkr(self) -> float:
        """Work of adhesion [mJ/m^2] of a compliant contact."""
        return MILLIJOULE * self.force_mN / (1.5 * np.pi * self.radius_um)

    @property
    def work_by_dmt(self) -> float:
        """Work of adhesion [mJ/m^2] of a stiff contact."""
        return 0.75 * self.work_by_jkr


def pull_off(curve: Curve, diameters_um: Any) -> PullOff | None:
    """The pull-off of a test on a particle with three diameters [um]; None where its record shows none.

    Force falls below what it is after the contact has broken, by more than noise and drift there explain. A record
    that ends in contact shows none.
    """
    force, path = curve.force_mN, curve.displacement_um
    top = int(np.argmax(force))
    lowest = top + int(np.argmin(force[top:]))
    free = force[lowest + 1 :]
    if len(free) < AIR_READINGS:
        return None
    zero = median(free)
    tension, largest = zero - float(force[lowest]), float(force[top]) - zero
    noise = max(point_noise(force), float(np.std(free)))
    if tension <= max(unusual(len(force) - top) * noise, SMALLEST_STEP * largest):
        return None
    released = top + int(np.argmax(force[top:] <= zero))  # where the branch goes through zero
    recovered = float(path[top] - path[released])
    _, strain = stress_and_strain(curve, np.asarray(diameters_um), find_segments(curve))
    if recovered <= 0 or strain[top] <= 0:
        return None
    return PullOff(tension, 2 * PUNCH_AREA * effective_diameter_um(diameters_um) ** 2 * float(strain[top]) / recovered)


def pulled_off(curve: Curve, diameters_um: np.ndarray) -> tuple[Finding, ...]:
    """What is said of a test that shows a pull-off."""
    found = pull_off(curve, diameters_um)
    return () if found is None else (PULLED_OFF.of(found.force_mN, found.work_by_dmt, found.work_by_jkr),)
