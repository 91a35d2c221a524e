r"""The elastic branch in one variable: how stress falls as strain is recovered, its inverse and its energy.

With :math:`s = (\epsilon_P - \epsilon)/\delta = \sqrt{1 - \phi^2}`, linear in strain, the arcsine law of unloading is

.. math:: \sigma / \sigma_P = f(s) = \tfrac{2}{\pi}\left[\arccos s - s\sqrt{1 - s^2}\right].

The printed form in :math:`\phi` loses all digits near both ends and has no derivative at the onset. Here every function
is an exact power of the distance to the singular end times a polynomial. Accuracy: 4e-16 of the peak in float64, 2e-7
in float32.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from .._numerics import horner, recompute, two_thirds_power
from .._types import Values

# ---- polynomials, from the highest power down; printed by `benchmarks/make_recovery_coefficients.py` -----------------

# fmt: off
RATIO_64 = (  # degree 17, largest relative error 9.8e-18
    -3.1112491627037324e-12, -1.0778152191898491e-11, -2.3673219699814047e-11, -8.452689239590027e-11,
    -3.319421170673405e-10, -1.212942982787599e-09, -4.4814427848648566e-09, -1.7003372928575843e-08,
    -6.612178244595573e-08, -2.649041501718955e-07, -1.1023540242429571e-06, -4.820198795141472e-06,
    -2.254626055400008e-05, -0.00011623474094004388, -0.000698837433216929, -0.005589066336873583,
    -0.09948832042832373, 1.1059212819304507,
)
RATIO_32 = (  # degree 7, largest relative error 3.2e-9
    -1.2480960895296546e-06, -5.401048983674062e-06, -2.2452455776047703e-05, -0.00011586145470259827,
    -0.000698856413808037, -0.005589141822871462, -0.0994883198339057, 1.1059212842941968,
)
ENERGY_64 = (  # degree 17, largest relative error 8.4e-19
    -1.2239264552240398e-13, -4.4775614368770457e-13, -1.1073099259581753e-12, -4.2101557246143604e-12,
    -1.7312782661902265e-11, -6.796752849276065e-11, -2.718377691137876e-10, -1.121199897586585e-09,
    -4.774596592639362e-09, -2.1136379601434695e-08, -9.823826421390291e-08, -4.86180133022437e-07,
    -2.6172239575116677e-06, -1.5869018635618415e-05, -0.00011552024703257536, -0.001165001243505945,
    -0.027759519411803355, 0.4534723205369016,
)
RECOVERY_64 = (  # degree 23, largest relative error 1.3e-17
    1.684851935524473e-10, 3.902923299587117e-10, -1.0449113448846025e-10, -2.3081087011875581e-10,
    2.146188540744108e-09, 5.038533760882086e-09, 7.874134110883696e-09, 1.884467339936365e-08,
    4.918527595833039e-08, 1.187491893488825e-07, 2.863356700467264e-07, 7.023157910261354e-07,
    1.740154861392644e-06, 4.357528422504284e-06, 1.1058300851757174e-05, 2.852318981764797e-05,
    7.506797103188011e-05, 0.00020270626531019277, 0.0005662800841837647, 0.0016583781234766374,
    0.00521071202287205, 0.01841721236162996, 0.08318341840902267, 1.0687365999717602,
)
RECOVERY_32 = (  # degree 9, largest relative error 1.9e-8
    1.6910062929247536e-05, 4.308438627404585e-05, 6.947846935028573e-05, 0.0001888210178514567,
    0.000568356038508883, 0.0016635313387641567, 0.005210447896423434, 0.018416556927822268,
    0.08318342370927062, 1.0687366131235896,
)
# fmt: on


@jax.custom_jvp
def stress_ratio(s: Values | float) -> Values:
    r"""Stress over peak stress :math:`f(s)` [-] after a share s of the strain is recovered: 1 for s <= 0, 0 for s >= 1.

    Relative accuracy is kept towards s = 1. The derivative is :math:`-\tfrac{4}{\pi}\sqrt{1 - s^2}` on 0 <= s < 1, else
    0.

    References:
        Bommireddy et al. (2018), eq. 23, with phi^2 = 1 - s^2.
    """
    u = jnp.clip(1 - s, 0, 1)
    return u * recompute(jnp.sqrt(u)) * horner(RATIO_64 if u.dtype == jnp.float64 else RATIO_32, 2 * u - 1)


@stress_ratio.defjvp
def _stress_ratio_jvp(primals, tangents):
    (s,), (ds,) = primals, tangents
    inside = (s >= 0) & (s < 1)
    chord = jnp.where(inside, (1 - s) * (1 + s), 1.0)
    return stress_ratio(s), jnp.where(inside, -4 / jnp.pi * recompute(jnp.sqrt(chord)), 0.0) * ds


@jax.custom_jvp
@jax.jit  # traced once for all its users
def recovery(ratio: Values | float) -> Values:
    r"""Inverse of `stress_ratio`: the recovered share of strain [-] at a share of the peak stress.

    Solves Kepler's equation of eccentricity 1, :math:`E - \sin E = \pi\,\sigma/\sigma_P` with :math:`s = \cos(E/2)`, in
    closed form: 1 for ratio <= 0, 0 for ratio >= 1. The derivative grows as ratio^(-1/3) towards full release and is 0
    beyond it, where the platen no longer touches.
    """
    r = jnp.clip(ratio, 0, 1)
    w = two_thirds_power(r)
    rest = recompute((1 - r) * (1 + r) / (1 + w * (1 + w)))  # 1 - w, all digits kept towards the peak
    return jnp.clip(rest * horner(RECOVERY_64 if w.dtype == jnp.float64 else RECOVERY_32, 2 * w - 1), 0, 1)


@recovery.defjvp
def _recovery_jvp(primals, tangents):
    (ratio,), (dratio,) = primals, tangents
    s = recovery(ratio)
    inside = (ratio > 0) & (ratio <= 1) & (s < 1)
    chord = jnp.where(inside, (1 - s) * (1 + s), 1.0)
    return s, jnp.where(inside, recompute(-jnp.pi / 4 / jnp.sqrt(chord)), 0.0) * dratio


@jax.custom_jvp
def energy_ratio(s: Values | float) -> Values:
    r"""Elastic energy [-] still stored at a recovered share s, over :math:`\sigma_P \delta`: 4/(3 pi) at the onset.

    .. math:: g(s) = \int_s^1 f = \tfrac{2}{\pi}\left[\sqrt{1 - s^2} - s\arccos s - \tfrac13 (1 - s^2)^{3/2}\right]
    """
    u = jnp.clip(1 - s, 0, 1)
    return u * u * jnp.sqrt(u) * horner(ENERGY_64, 2 * u - 1)


@energy_ratio.defjvp
def _energy_ratio_jvp(primals, tangents):
    (s,), (ds,) = primals, tangents
    return energy_ratio(s), jnp.where((s >= 0) & (s < 1), -stress_ratio(s), 0.0) * ds
