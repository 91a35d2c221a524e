"""Which unloading law: three forms, three ways in which the shape factor enters."""

from __future__ import annotations

import enum
import math

PUNCH_AREA = 1.43
"""c^2 of Storakers for perfect plasticity. It equals the paper's `a` by coincidence: never share one constant."""


class Unloading(enum.Enum):
    r"""Form of the strain :math:`\delta` recovered on full release.

    - `PRINTED`, the default: :math:`\delta^2 = \sigma_P / (4.12\,\bar E\,\epsilon_P)`, first power of
      :math:`\bar E/\sigma_P`. The paper's :math:`\bar E` = 16 GPa belongs to this form **only**. The rigid-punch
      derivation gives the second power.
    - `PUNCH`, that derivation with the paper's constant: :math:`\delta = \sigma_P / (\bar E \sqrt{k\,\epsilon_P})`,
      :math:`k = 256 c^2/(9\pi^2)` = 4.1213, where 4.12 comes from.
    - `PUNCH_EXACT`, with the constant of perfect plasticity, :math:`k = 4 c^2` = 5.72: unloading starts with the exact
      stiffness of a flat punch, :math:`dF/d\gamma = 2 \bar E a_P`.

    With 16 GPa in a punch form unloading is a vertical line (recovered strain about 5e-4); a punch form describes the
    same curves with 0.3 to 0.6 GPa. Independent finite elements favour the punch forms.

    With the paper's numbers the limit of recovery (`formulas.contact`) matters below a peak strain of 0.010 to 0.014 in
    the printed form (0.07 to 0.18 MPa) and below 2e-7 in the punch forms; above, every form is its formula.

    References:
        Bommireddy et al. (2018), eq. 24; Mesarovic and Johnson (2000); Hill and Storakers (1990).
    """

    PRINTED = "printed"
    PUNCH = "punch"
    PUNCH_EXACT = "punch_exact"

    @property
    def constant(self) -> float:
        """The numerical factor k of the form."""
        constants = {
            Unloading.PRINTED: 4.12,
            Unloading.PUNCH: 256 * PUNCH_AREA / (9 * math.pi**2),
            Unloading.PUNCH_EXACT: 4 * PUNCH_AREA,
        }
        return constants[self]

    @property
    def stress_power(self) -> int:
        r"""The power n of :math:`\sigma_P/\bar E` in :math:`\delta^2`: 1 as printed, 2 in the punch forms."""
        return 1 if self is Unloading.PRINTED else 2


class StrainScaling(enum.Enum):
    r"""How the shape factor enters unloading, as its power p in the arcsine law's argument.

    .. math:: 1 - \phi^2 = k\, (\bar E/\sigma_P)^n\, \eta_p^p\, \epsilon_P\, (\epsilon_P - \epsilon)^2

    - `RAW`, p = 0: the paper to the letter, bare strains in phi.
    - `CONTACT`, p = 1: contact area grows as :math:`\eta_p \epsilon_P`, elastic approach is the real displacement.
    - `MASTER`, p = 3: every strain scaled, :math:`\sigma_i(\epsilon) = \sigma(\eta_p \epsilon)`: all particles collapse
      on one curve.
    """

    RAW = "raw"
    CONTACT = "contact"
    MASTER = "master"

    @property
    def power(self) -> int:
        """The power p of the shape factor."""
        return {StrainScaling.RAW: 0, StrainScaling.CONTACT: 1, StrainScaling.MASTER: 3}[self]
