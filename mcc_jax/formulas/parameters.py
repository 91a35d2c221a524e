"""The parameters of the law, and the contact that they make of a particle between platens."""

from __future__ import annotations

import enum
import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._format import described, in_words, table
from .._numerics import compiled_whole, cotangent_barrier, recompute
from .._types import Flag, Scalar, ScalarLike, Values, checked, scalar
from ..arguments import finite, member, positive
from ..geometry import Particle, plastic_shape_factor
from .contact import Contact, Quintic, reached, stress_ratio

AREA = 1e-3 * jnp.pi / 4  # effective area over the diameter squared, times what makes mN of MPa um^2
PUNCH_AREA = 1.43
"""c^2 of Storakers for perfect plasticity. It equals the paper's `a` by coincidence: never share one constant."""


class Plastic(eqx.Module):
    r"""The three plastic coefficients of the master loading law, in the scaled strain :math:`x = \eta_p \epsilon`.

    .. math:: \sigma(x) / \mathrm{MPa} = C_1 x - (C_3 x)^3 + (C_5 x)^5

    Attributes:
        C1: coefficient of the linear term [-], > 0.
        C3: coefficient of the softening term [-], >= 0.
        C5: coefficient of the hardening term [-], > 0.

    `InputError` for a plain number out of its range; computed ones are judged by `MccLaw.is_valid`.

    References:
        Bommireddy et al. (2018), eq. 16, where they are C1, C2, C3 in MPa, MPa^-3, MPa^-5.
    """

    C1: Scalar = eqx.field(converter=checked(positive, "a plastic coefficient", plain=True))
    C3: Scalar = eqx.field(converter=checked(positive, "the softening coefficient C3", zero=True, plain=True))
    C5: Scalar = eqx.field(converter=checked(positive, "a plastic coefficient", plain=True))

    __repr__ = described()

    @classmethod
    def from_polynomial(cls, K1: ScalarLike, K3: ScalarLike, K5: ScalarLike) -> Plastic:
        r"""From the factors of :math:`\sigma = K_1 x - K_3 x^3 + K_5 x^5` [MPa], all positive."""
        for name, value in (("K1", K1), ("K3", K3), ("K5", K5)):
            positive(value, f"{name} [MPa]", zero=name == "K3", plain=True)
        return cls(scalar(K1), jnp.cbrt(scalar(K3)), scalar(K5) ** 0.2)

    @property
    def polynomial(self) -> tuple[Scalar, Scalar, Scalar]:
        r""":math:`(K_1, K_3, K_5) = (C_1, C_3^3, C_5^5)` [MPa]."""
        square = self.C5 * self.C5
        return self.C1, self.C3 * self.C3 * self.C3, square * square * self.C5

    @property
    def curve(self) -> Quintic:
        """Stress against scaled strain."""
        return Quintic(*self.polynomial)

    @property
    def is_monotone(self) -> Flag:
        r"""Whether stress never falls while strain grows: :math:`9 C_3^6 \le 20 C_1 C_5^5`.

        Else the curve has a peak and a trough: under load control the particle snaps through to the rising branch.
        """
        return self.curve.is_monotone

    def stress(self, x: Values) -> Values:
        """Stress [MPa] at the scaled strain `x` = eta_p eps >= 0, never below zero."""
        return self.curve.loading(x)

    def tangent(self, x: Values) -> Values:
        r"""Slope :math:`d\sigma/dx = C_1 - 3 C_3^3 x^2 + 5 C_5^5 x^4` [MPa]."""
        return self.curve.tangent(x)

    @compiled_whole
    def strain(self, stress: Values) -> Values:
        """Scaled strain at which the stress [MPa] is first reached from the virgin state; 0 for stress <= 0.

        Of a law that is not monotone it jumps over peak and trough. Derivatives by the implicit-function rule.
        """
        return reached(self.curve, stress, jnp.zeros_like(self.C1))


class Unloading(enum.Enum):
    r"""Form of the strain :math:`\delta` recovered on full release.

    - `PRINTED`, the default: :math:`\delta^2 = \sigma_P / (4.12\,\bar E\,\epsilon_P)`, first power of
      :math:`\bar E/\sigma_P`. The paper's :math:`\bar E` = 16 GPa belongs to this form **only**. The rigid-punch
      derivation gives the second power.
    - `PUNCH`, that derivation with the paper's constant: :math:`\delta = \sigma_P / (\bar E \sqrt{k\,\epsilon_P})`,
      :math:`k = 256 c^2/(9\pi^2)` = 4.1213, where 4.12 comes from.
    - `PUNCH_EXACT`, with the constant of perfect plasticity, :math:`k = 4 c^2` = 5.72: unloading starts with the exact
      stiffness of a flat punch, :math:`dF/d\gamma = 2 \bar E a_P`.

    A punch form describes the same curves with 0.3 to 0.6 GPa; with 16 GPa its unloading is a vertical line (recovered
    strain about 5e-4). Independent finite elements favour the punch forms. With the paper's numbers the limit of
    recovery (`formulas.contact`) matters below a peak strain of 0.010 to 0.014 in the printed form (0.07 to 0.18 MPa)
    and below 2e-7 in the punch forms.

    References:
        Bommireddy et al. (2018), eq. 24; Mesarovic and Johnson (2000); Hill and Storakers (1990).
    """

    PRINTED = "printed"
    PUNCH = "punch"
    PUNCH_EXACT = "punch_exact"

    @property
    def constant(self) -> float:
        """The numerical factor k of the form."""
        constants = {"printed": 4.12, "punch": 256 * PUNCH_AREA / (9 * math.pi**2), "punch_exact": 4 * PUNCH_AREA}
        return constants[self.value]

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
        return {"raw": 0, "contact": 1, "master": 3}[self.value]


class Formulas(eqx.Module):
    """The law's parameters, which effects may change, and its closed formulas; attributes as of `MccLaw`."""

    plastic: Plastic
    a: Scalar = eqx.field(converter=checked(finite, "a, the geometric parameter [-],"))
    effective_modulus: Scalar = eqx.field(converter=checked(positive, "the effective modulus [MPa]", plain=True))
    unloading: Unloading = eqx.field(
        static=True, converter=lambda value: member(value, Unloading, "unloading"), default=Unloading.PRINTED
    )
    strain_scaling: StrainScaling = eqx.field(
        static=True, converter=lambda value: member(value, StrainScaling, "strain_scaling"), default=StrainScaling.RAW
    )

    def __repr__(self) -> str:
        return table(type(self).__name__, self._rows())

    def _rows(self) -> list[tuple[str, str]]:
        return [
            *((name, in_words(getattr(self.plastic, name))) for name in ("C1", "C3", "C5")),
            ("shape parameter a", in_words(self.a)),
            ("effective modulus", in_words(self.effective_modulus, "MPa")),
            ("unloading", f"{self.unloading.value}, strain scaling {self.strain_scaling.value}"),
        ]

    @property
    def is_monotone(self) -> Flag:
        """Whether the loading curve never falls (`Plastic.is_monotone`)."""
        return self.plastic.is_monotone

    @property
    def is_valid(self) -> Flag:
        """Whether C1, C5 and the modulus are positive, C3 is not negative and nothing is NaN."""
        C1, C3, C5 = self.plastic.C1, self.plastic.C3, self.plastic.C5
        return (C1 > 0) & (C3 >= 0) & (C5 > 0) & (self.effective_modulus > 0) & jnp.isfinite(self.a)

    def carries_stress(self, particle: Particle) -> Flag:
        """Whether the particle's shape factor is positive."""
        return self.shape_factor(particle) > 0

    def shape_factor(self, particle: Particle) -> Scalar:
        """eta_p of the particle under this law's `a` [-]."""
        return plastic_shape_factor(particle, self.a)

    def contact(self, particle: Particle) -> Contact:
        """The particle between platens: force [mN] against platen displacement [um]."""
        # A path then depends on its particle through four numbers only.
        eta, diameter = cotangent_barrier(self.shape_factor(particle)), cotangent_barrier(particle.effective_diameter)
        return self.contact_of_size(AREA, eta, diameter, particle.inverse_diameter)

    def contact_of_size(self, area: float, eta: Scalar, length: Scalar, inverse: Scalar) -> Contact:
        """The contact of a shape factor, and of a length that makes strains of displacements (`_coefficients`)."""
        form = self.unloading, self.strain_scaling, area
        numbers = _coefficients(form, self.plastic.polynomial, self.effective_modulus, (eta, length, inverse))
        return Contact(*numbers, power=self.unloading.stress_power)

    @compiled_whole
    def loading_stress(self, particle: Particle, strain: Values) -> Values:
        """Stress [MPa] of plastic loading at the strain [-]."""
        return self.plastic.stress(self.shape_factor(particle) * strain)

    @compiled_whole
    def recoverable_strain(self, particle: Particle, strain_max: Values) -> Values:
        r"""Strain :math:`\delta` [-] recovered on full release from the largest strain :math:`\epsilon_P` [-].

        .. math:: \delta^2 = \frac{(\sigma_P / \bar E)^n}{k\, \eta_p^p\, \epsilon_P}, \qquad
            \delta \le \min\left(\epsilon_P,\ \tfrac{3\pi}{8}\, \sigma_P \Big/ \frac{d\sigma}{d\epsilon}\right)

        with k and n of the `Unloading` form and p of the `StrainScaling`; a contact cannot give back more.
        """
        return particle.strain(self.contact(particle).recovered(particle.displacement(strain_max)).displacement)

    @compiled_whole
    def unloading_stress(self, particle: Particle, strain: Values, strain_max: Values) -> Values:
        """Stress [MPa] on the elastic branch that starts at `strain_max`."""
        recovered = self.recoverable_strain(particle, strain_max)
        carries = recovered > 0
        s = jnp.where(carries, (strain_max - strain) / jnp.where(carries, recovered, 1.0), 1.0)
        return self.loading_stress(particle, strain_max) * stress_ratio(s)

    def recoverable_displacement(
        self, particle: Particle, peak: Values, peak_force: Values, factor: Values | Scalar
    ) -> Values:
        """Displacement [um] recovered on full release from a peak, with a factor on the effective modulus.

        Effects may have moved the peak off the loading curve; the energy that it stores stays within the curve's limit.
        """
        moved = peak > jnp.finfo(peak.dtype).tiny ** 0.5
        contact = self.contact(particle)
        secant = jnp.where(moved, peak_force, contact.k1) / jnp.where(moved, peak, 1.0)
        return jnp.where(moved, contact.softened(factor).recovered(peak, secant).displacement, 0.0)


# Of unloading, of the shape factor, and A / L^2, which turns MPa and the unit of length into the unit of force.
Form = tuple[Unloading, StrainScaling, float]
Size = tuple[Scalar, Scalar, Scalar]  # shape factor eta_p, length L, and 1 / L, for derivatives a function of L


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _coefficients(form: Form, polynomial: tuple[Scalar, Scalar, Scalar], modulus: Scalar, size: Size) -> Any:
    r"""k1, k3, k5 and c of a contact with :math:`\sigma = K_1 x - K_3 x^3 + K_5 x^5` at :math:`x = \eta_p \gamma / L`.

    .. math:: k_m = A K_m (\eta_p / L)^m, \qquad c = L^3 / (k\, \eta_p^p\, (\bar E A)^n)

    with k and n of the `Unloading` form and p of the `StrainScaling`. Derivatives are written out: reverse mode then
    takes half as many operations.
    """
    K1, K3, K5 = polynomial
    first, third, fifth, _ = _powers(form, size)
    return K1 * first, K3 * third, K5 * fifth, _compliance(form, form[0].stress_power, modulus, size)


@_coefficients.defjvp
def _coefficients_jvp(form: Form, primals: Any, tangents: Any) -> Any:
    (K1, K3, K5), modulus, size = primals
    (dK1, dK3, dK5), dmodulus, (deta, dlength, _) = tangents
    unloading, scaling, area = form
    eta, length, inverse = size
    first, third, fifth, square = _powers(form, size)
    by_eta, by_length = area * length, area * eta
    n, p = unloading.stress_power, scaling.power
    c, per_modulus = (_compliance(form, k, modulus, size) for k in (n, n + 1))
    dc = (3 - 2 * n) * (c * inverse) * dlength - n * per_modulus * dmodulus
    changes = (
        first * dK1 + K1 * (by_eta * deta + by_length * dlength),
        third * dK3 + K3 * square * (3 * by_eta * deta - by_length * dlength),
        fifth * dK5 + K5 * (square * square) * (5 * by_eta * deta - 3 * by_length * dlength),
        dc - p * recompute(c / eta) * deta if p else dc,
    )
    # Transposed, these are barriers for the cotangents, which otherwise would be computed again for each input. One for
    # each: what does not depend on the input at hand has no transpose.
    return (K1 * first, K3 * third, K5 * fifth, c), tuple(map(jax.lax.optimization_barrier, changes))


def _powers(form: Form, size: Size) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """k_m / K_m for m = 1, 3, 5, and the square of the scaled strain over the displacement."""
    eta, length, inverse = size
    slope = eta * inverse
    square = slope * slope
    first = form[2] * (eta * length)
    third = first * square
    return first, third, third * square, square


def _compliance(form: Form, power: int, modulus: Scalar, size: Size) -> Scalar:
    """c, or c over the modulus with its power one higher: a quotient of its own, which reverse mode need not store."""
    unloading, scaling, area = form
    eta, length, inverse = size
    n = unloading.stress_power
    rest = unloading.constant * area**n * eta**scaling.power
    return recompute((length if n == 1 else inverse) / (rest * modulus**power))
