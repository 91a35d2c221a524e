r"""How much a contact can give back at most: the one remedy for all forms of the unloading law.

The formula for the recovered strain is not bound to the work that was put in. The printed form does not vanish with
strain, so that below a peak of about 0.01 the released particle would be larger than before and, a little lower, would
return more work than it took; with a soft modulus every form does so again far beyond the tested range. The limit

.. math:: \Delta \le \Delta_{lim} = \min\left(\gamma_P,\ \tfrac{3\pi}{8}\, F_P \Big/ \frac{dF}{d\gamma}\Big|_P\right)

says that release ends at the start of loading at the latest, and that unloading begins at least
:math:`32/(3\pi^2) = 1.08` times as stiff as loading ended. Where the formula gives less, it stays to the last bit.

With the elastic energy :math:`S = \tfrac{4}{3\pi} F_P \Delta` that is enough for what is dissipated,
:math:`D = W - S`, never to fall while the peak grows, :math:`dS \le F_P\, d\gamma_P`. So no cycle of any path, from any
state, gives back more than it took. With :math:`m = \gamma F'/F` at the peak:

- formula, :math:`\Delta^2 \propto (F_P/\gamma_P)^n \gamma_P^{n-1}`: :math:`dS/d\gamma_P = \tfrac{4}{3\pi} F_P
  (\Delta/\gamma_P) [(1 + n/2) m - 1/2]`, which the limit keeps below :math:`F_P` for n = 1 and 2;
- :math:`\Delta = \gamma_P`, where :math:`m \le 3\pi/8`: :math:`dS/d\gamma_P = \tfrac{4}{3\pi} (1 + m) F_P < F_P`;
- :math:`S = F^2/(2F')`, where m is larger: :math:`dS/d\gamma_P = F_P - F^2 F''/(2 F'^2)`, and where m > 1 the quintic
  is convex: it begins concave, and a concave curve from the origin has :math:`m \le 1`.

In a pair each side has its own limit; the sides carry one force, so their energies add.
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from .. import arguments
from .._numerics import shared
from .._types import Values

SHARE = 3 * math.pi / 8
r"""Largest :math:`\Delta F'/F_P`. Elastic energy is :math:`\tfrac{4}{3\pi} F_P \Delta`; with it :math:`F^2/(2F')`."""


def recovery_limit(peak: Any, secant: Any, tangent: Any) -> tuple[Values, Bool[Array, ...]]:
    r"""What a contact recovers at most from a peak, :math:`\Delta_{lim}`, and whether it is steep there.

    Args:
        peak: displacement at the peak, >= 0, in any unit; the result has the same.
        secant: loading force over displacement there, >= 0.
        tangent: slope of loading there, of any sign.

    Returns:
        The limit, 0 where no force is carried; and whether the second of its two terms holds, not the peak itself.
    """
    given = {"peak": peak, "secant": secant, "tangent": tangent}
    peak, secant, tangent = (arguments.values(value, name) for name, value in given.items())
    stiffness, steep = least_stiffness(secant, tangent)
    return peak * shared(secant / jnp.where(stiffness > 0, stiffness, 1.0)), steep


def least_stiffness(secant: Values, tangent: Values) -> tuple[Values, Bool[Array, ...]]:
    """Peak force over the limit, and whether the contact is steep there."""
    steep = tangent > SHARE * secant
    return jnp.where(steep, tangent * (1 / SHARE), secant), steep
