r"""Closed-form contact laws that the MCC law is measured against: elastic, rigid-plastic, ideally plastic.

They all speak of the effective stress :math:`\sigma = F/(\pi R_e^2)` and the effective strain
:math:`\epsilon = \gamma/D_e` of a particle between two platens. A particle has two contacts and :math:`\gamma` is the
displacement of one platen relative to the other, so each contact sees :math:`\gamma/2`. The paper's formulas put all of
:math:`\gamma` into **one** contact. Both conventions are wanted, one to reproduce the paper and one to compare with
other solutions, so every stress here takes `contacts`:

- 1, the paper's: the whole platen displacement deforms one contact;
- 2: two equal contacts share it, :math:`\epsilon \to \epsilon/2`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import arguments
from .._errors import InputError
from .._numerics import compiled_whole
from .._types import Scalar, ScalarLike, scalar
from ..geometry import Particle

AnyShape = Float[Array, "..."]

SELF_SIMILAR_AREA = 1.43
"""c^2 of perfect plasticity (Storakers and Larsson 1994). It equals the paper's `a` by coincidence: do not share it."""

# Both are quadratically convergent: enough for axis ratios up to 1e6 and to the last digit.
AGM_STEPS = 7
NEWTON_STEPS = 7


@compiled_whole
def hertz_shape_factor(particle: Particle) -> Scalar:
    r"""Shape factor of the elastic contact, exactly: the elliptic contact of Hertz.

    With the ratio of the radii of curvature :math:`R'/R'' = (D_1/D_2)^2` (the larger over the smaller), the ratio
    :math:`k' = b/a` of the semi-axes of the contact ellipse solves

    .. math:: \frac{R'}{R''} = \frac{(a/b)^2 E(e) - K(e)}{K(e) - E(e)}, \qquad e^2 = 1 - (b/a)^2,

    and the shape factor follows from the approach :math:`\gamma = (9F^2/16 \bar E^2 R_e)^{1/3} F_2(e)`,

    .. math::
        \eta_e = \frac{1}{F_2(e)} = \frac{\pi}{2} \sqrt{\frac{a}{b}}\, \frac{F_1(e)}{K(e)}, \qquad
        F_1^3 = \frac{4}{\pi e^2} \Big(\frac{b}{a}\Big)^{3/2}
            \sqrt{\left[\Big(\frac{a}{b}\Big)^2 E(e) - K(e)\right] \left[K(e) - E(e)\right]} .

    K and E come from the arithmetic-geometric mean, arranged so that nothing cancels for a nearly circular contact.
    `geometry.elastic_shape_factor` is the paper's closed form for the same quantity.

    Args:
        particle: the particle; only D1/D2 matters, in either order.

    Returns:
        The shape factor [-]: 1 at D1 = D2, where its first derivative is 0 and its second finite.

    References:
        Johnson (1985), Contact Mechanics, eqs. 4.26-4.28; for the definition Bommireddy et al. (arXiv 1812.06173),
        eq. 1.
    """
    log_axes = _log_axis_ratio(jnp.log(particle.D1) - jnp.log(particle.D2))
    mean, asymmetry = _elliptic(log_axes)
    return jnp.cbrt(mean * mean * jnp.sqrt(1 - 4 * asymmetry * asymmetry))


def hertz_stress(
    strain: Any, effective_modulus: ScalarLike, shape_factor: ScalarLike = 1.0, *, contacts: int = 1
) -> AnyShape:
    r"""Stress [MPa] of the elastic contact at the strain [-].

    .. math:: \sigma = \frac{8\sqrt2\,\bar E}{3\pi} \left[\eta_e\, \epsilon\right]^{3/2}

    for one contact; :math:`2^{3/2}` times less when two contacts share the displacement.

    Args:
        strain: effective strain [-]; no stress for strain <= 0.
        effective_modulus: :math:`\bar E = E/(1-\nu^2)` [MPa].
        shape_factor: :math:`\eta_e` [-] (`hertz_shape_factor`, `geometry.elastic_shape_factor`), 1 for a sphere.
        contacts: how many contacts share the platen displacement, 1 (the paper) or 2.

    Returns:
        Effective stress [MPa].

    Raises:
        ValueError: if `contacts` is neither 1 nor 2, or a plain number is out of its range.

    References:
        Hertz (1882); Bommireddy et al. (arXiv 1812.06173), eq. 5.
    """
    share, strain = _displacement_share(contacts), arguments.values(strain, "strain")
    arguments.positive(effective_modulus, "effective_modulus [MPa]", plain=True)
    arguments.positive(shape_factor, "shape_factor", plain=True)
    stretched = scalar(shape_factor) * share * strain
    return 8 * 2**0.5 / (3 * jnp.pi) * scalar(effective_modulus) * _positive_power(stretched, 1.5)


def similarity_strength(yield_stress: ScalarLike, youngs_modulus: ScalarLike, exponent: ScalarLike) -> Scalar:
    r"""Representative strength :math:`\kappa = \sigma_y^{1 - 1/m} E^{1/m}` [MPa] of a power-law hardening solid.

    Args:
        yield_stress: uniaxial yield stress [MPa].
        youngs_modulus: Young's modulus E [MPa], not the effective one.
        exponent: hardening exponent m >= 1 [-]; `math.inf` is perfect plasticity.

    Returns:
        The strength [MPa]: E for m = 1, the yield stress for m = inf.

    References:
        Mesarovic and Fleck (1999); Bommireddy et al. (arXiv 1812.06173), eq. 20.
    """
    arguments.positive(yield_stress, "yield_stress [MPa]", plain=True)
    arguments.positive(youngs_modulus, "youngs_modulus [MPa]", plain=True)
    _check_exponent(exponent)
    hardening = 1 / scalar(exponent)
    return scalar(yield_stress) ** (1 - hardening) * scalar(youngs_modulus) ** hardening


def similarity_stress(strain: Any, strength: ScalarLike, exponent: ScalarLike, *, contacts: int = 1) -> AnyShape:
    r"""Stress [MPa] of the similarity solution for a rigid-plastic, power-law hardening sphere.

    .. math::
        \sigma = 4 \cdot 3^{1 - 1/m}\, (c^2)^{1 + 1/2m}\, \kappa\, \epsilon^{1 + 1/2m}, \qquad
        c^2 = 1.43\, e^{-0.97/m}

    This is the formula as the paper prints it. Inserting :math:`a^2 = 2 c^2 R h` into
    :math:`F = \pi a^2\, 3^{1 - 1/m} \kappa (a/R)^{1/m}` for a sphere on a rigid plate, :math:`h = 2R\epsilon`, gives a
    further factor :math:`2^{1/m}` that the paper's formula lacks. It tends to 1 in the perfectly plastic limit, the
    only one that the paper uses; at finite m take the absolute level with that in mind.

    Args:
        strain: effective strain [-]; no stress for strain <= 0.
        strength: :math:`\kappa` [MPa] (`similarity_strength`).
        exponent: hardening exponent m >= 1 [-]; `math.inf` is perfect plasticity.
        contacts: how many contacts share the platen displacement, 1 (the paper) or 2 (:math:`2^{1 + 1/2m}` times less).

    Returns:
        Effective stress [MPa].

    Raises:
        ValueError: if `contacts` is neither 1 nor 2, or a plain number is out of its range.

    References:
        Biwa and Storakers (1995); Storakers and Larsson (1994) for c^2; Bommireddy et al. (arXiv 1812.06173), eqs. 19
        and 21.
    """
    share, strain = _displacement_share(contacts), arguments.values(strain, "strain")
    arguments.positive(strength, "strength [MPa]", plain=True)
    _check_exponent(exponent)
    hardening = 1 / scalar(exponent)
    power = 1 + hardening / 2
    area = SELF_SIMILAR_AREA * jnp.exp(-0.97 * hardening)
    return 4 * 3 ** (1 - hardening) * scalar(strength) * _positive_power(area * share * strain, power)


def ideal_plastic_stress(strain: Any, yield_stress: ScalarLike, *, contacts: int = 1) -> AnyShape:
    r"""Stress [MPa] of a perfectly plastic sphere, the similarity solution for :math:`m \to \infty`.

    .. math:: \sigma = 12 c^2 \sigma_y\, \epsilon = 17.16\, \sigma_y\, \epsilon

    for one contact, :math:`8.58\, \sigma_y\, \epsilon` when two contacts share the displacement. A yield stress read
    off a measured initial slope is therefore twice as large in the second convention.

    Args:
        strain: effective strain [-]; no stress for strain <= 0.
        yield_stress: :math:`\sigma_y` [MPa].
        contacts: how many contacts share the platen displacement, 1 (the paper) or 2.

    Returns:
        Effective stress [MPa].

    Raises:
        ValueError: if `contacts` is neither 1 nor 2, or a plain number is out of its range.

    References:
        Biwa and Storakers (1995); Bommireddy et al. (arXiv 1812.06173), eq. 22.
    """
    share, strain = _displacement_share(contacts), arguments.values(strain, "strain")
    arguments.positive(yield_stress, "yield_stress [MPa]", plain=True)
    return 12 * SELF_SIMILAR_AREA * share * scalar(yield_stress) * jnp.where(strain > 0, strain, 0.0)


def _check_exponent(exponent: ScalarLike) -> None:
    if isinstance(exponent, int | float | np.number):
        arguments.number(exponent, "exponent, of hardening,", least=1, infinite=True)


def _displacement_share(contacts: int) -> float:
    """Part of the platen displacement that one contact takes."""
    if isinstance(contacts, bool) or not isinstance(contacts, int | np.integer) or contacts not in (1, 2):
        raise InputError(
            f"contacts={contacts!r}: pass contacts=1 if the whole platen displacement deforms one contact (the paper's "
            "convention) or contacts=2 if the particle's two contacts share it."
        )
    return 1 / contacts


def _positive_power(x: AnyShape, p: float | Scalar) -> AnyShape:
    """`max(x, 0)**p` for p >= 1 and any shape, with the derivative 0 at and below zero."""
    positive = x > 0
    return jnp.where(positive, jnp.where(positive, x, 1.0) ** p, 0.0)


def _elliptic(q: Scalar) -> tuple[Scalar, Scalar]:
    r"""Both elliptic integrals of the contact ellipse, as functions of :math:`q = \log(a/b)` of either sign.

    Returns:
        :math:`\mathrm{agm}(\sqrt{a/b}, \sqrt{b/a}) = \pi \sqrt{a/b} / 2K`, even in q, and
        :math:`T = (K - E)/(e^2 K) - 1/2`, odd in q.
    """
    # After one step of the mean from (exp(q/2), exp(-q/2)). c is half the last difference of its two sequences, and
    # T = sum 2^(n-1) c_n^2 / (4 sinh(q/2) cosh(q/2)), n >= 1, is divided by sinh(q/2) term by term: no 0/0 at q = 0.
    c = (jnp.expm1(q / 2) - jnp.expm1(-q / 2)) / 2  # sinh(q/2), and exactly odd
    larger, smaller = jnp.sqrt(1 + c * c), jnp.ones_like(q)
    scale, share = 4 * larger, jnp.ones_like(q)  # share = c_n / c_1
    total = c
    for n in range(AGM_STEPS):
        larger, smaller = (larger + smaller) / 2, jnp.sqrt(larger * smaller)
        share = share * c / (4 * larger)
        c = c * c / (4 * larger)
        total = total + 2 ** (n + 1) * c * share
    return larger, total / scale


def _log_curvature_ratio(q: Scalar) -> Scalar:
    r"""Half the logarithm of R'/R'' that belongs to the contact ellipse: :math:`q - \mathrm{artanh}\, 2T(q)`."""
    _, asymmetry = _elliptic(q)
    return q - jnp.arctanh(2 * asymmetry)


@jax.custom_jvp
def _log_axis_ratio(log_ratio: Scalar) -> Scalar:
    """Logarithm of the axis ratio a/b of the contact ellipse, from that of D1/D2: odd and smooth."""
    target = jnp.abs(log_ratio)
    # `_log_curvature_ratio` rises and is convex from slope 3/4 to slope 1, so Newton comes down from this upper bound.

    def newton(_, q):
        value, slope = jax.jvp(_log_curvature_ratio, (q,), (jnp.ones_like(q),))
        return q - (value - target) / slope

    return jnp.sign(log_ratio) * jax.lax.fori_loop(0, NEWTON_STEPS, newton, 4 / 3 * target)


@_log_axis_ratio.defjvp
def _log_axis_ratio_jvp(primals, tangents):
    (log_ratio,), (tangent,) = primals, tangents
    q = _log_axis_ratio(log_ratio)
    _, slope = jax.jvp(_log_curvature_ratio, (q,), (jnp.ones_like(q),))
    return q, tangent / slope
