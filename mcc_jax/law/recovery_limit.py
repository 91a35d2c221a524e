r"""How much a contact can give back at most: the one remedy for all forms of the unloading law.

The formula for the recovered displacement is not bound to the work that was put in. The printed form does not vanish
with strain, so that below a peak of about 0.01 the released particle would be larger than before and, a little lower,
would return more work than it took; with a soft modulus every form does so again far beyond the tested range. The limit
on the displacement :math:`\Delta` recovered from a peak at :math:`\gamma_P`,

.. math:: \Delta \le \frac{F_P}{k_1 + \tfrac{40}{3\pi} k_5 \gamma_P^4} \le \gamma_P, \qquad
    F = k_1 \gamma - k_3 \gamma^3 + k_5 \gamma^5 \ (\text{loading}),

is the peak itself at small strain and :math:`\tfrac{3\pi}{40} \gamma_P` far beyond. Where the formula gives less, it
stays to the last bit.

With the elastic energy :math:`S = \tfrac{4}{3\pi} F_P \Delta` that is enough for what is dissipated,
:math:`D = W - S`, never to fall while the peak grows, :math:`dS \le F_P\, d\gamma_P`. So no cycle of any path, from any
state, gives back more than it took. With the slope :math:`F'` at the peak, :math:`m = \gamma_P F'/F_P` and
:math:`T = \tfrac{3\pi}{8} k_1 + 5 k_5 \gamma_P^4 \ge F'`,

- at the limit :math:`S = F_P^2/(2T)`, so :math:`S' = F_P F'/T - F_P^2 T'/(2T^2) \le F_P`;
- by the formula, :math:`\Delta^2 \propto (F_P/\gamma_P)^n \gamma_P^{n-1}`, so :math:`S' = \tfrac{4}{3\pi} F_P
  (\Delta/\gamma_P) [(1 + n/2) m - 1/2]`; as :math:`\Delta/\gamma_P` is at most 1 and at most
  :math:`\tfrac{3\pi}{8} F_P/(T \gamma_P) \le \tfrac{3\pi}{8}/m`, it is below :math:`F_P` for n = 1 and 2.

In a pair each side has its own limit; the sides carry one force, so their energies add.
"""

from __future__ import annotations

import math

from .._types import Scalar, Values

HARDENING = 40 / (3 * math.pi)
r"""Weight of the hardening term: 5, of the slope, over 3 pi/8, which makes :math:`\tfrac{4}{3\pi} F \Delta` half."""


def least_stiffness(k1: Scalar, k5: Scalar, peak: Values) -> Values:
    r"""Least force at a peak over what is recovered from it, :math:`k_1 + \tfrac{40}{3\pi} k_5 \gamma_P^4`.

    With k1, k5 of stress over scaled strain [MPa] and the peak scaled strain it is a stress over scaled strain, with
    those of force over displacement a stiffness.

    Args:
        k1: initial slope of loading.
        k5: factor of the hardening term.
        peak: where unloading begins.
    """
    square = peak * peak
    return k1 + square * (square * (HARDENING * k5))
