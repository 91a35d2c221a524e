"""The parameters of the law, and the contact that they make of a particle between platens."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._format import table, value_of
from .._numerics import compiled_whole, cotangent_barrier
from .._types import Flag, Scalar, ScalarLike, Values, scalar
from ..arguments import finite, member, positive
from ..geometry import Particle, plastic_shape_factor
from .contact import Contact, coefficients
from .plastic import Plastic
from .recovery import stress_ratio
from .unloading import StrainScaling, Unloading

AnyShape = Float[Array, "..."]

AREA = 1e-3 * jnp.pi / 4
"""Effective area over the diameter squared, times what makes mN of MPa um^2."""


def _shape(value: ScalarLike) -> Scalar:
    finite(value, "a, the geometric parameter [-],")
    return scalar(value)


def _modulus(value: ScalarLike) -> Scalar:
    positive(value, "the effective modulus [MPa]", plain=True)
    return scalar(value)


class Formulas(eqx.Module):
    """The law without memory: what an effect can change of a particle. Attributes are those of `MccLaw`."""

    plastic: Plastic
    a: Scalar = eqx.field(converter=_shape)
    effective_modulus: Scalar = eqx.field(converter=_modulus)
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
            *((name, value_of(getattr(self.plastic, name))) for name in ("C1", "C3", "C5")),
            ("shape parameter a", value_of(self.a)),
            ("effective modulus", value_of(self.effective_modulus, "MPa")),
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
        """The contact of a shape factor, and of a length that makes strains of displacements (`coefficients`)."""
        forms = self.unloading, self.strain_scaling, area
        numbers = coefficients(*forms, *self.plastic.polynomial, self.effective_modulus, eta, length, inverse)
        return Contact(*numbers, power=self.unloading.stress_power)

    @compiled_whole
    def loading_stress(self, particle: Particle, strain: AnyShape) -> AnyShape:
        """Stress [MPa] of plastic loading at the strain [-]."""
        return self.plastic.stress(self.shape_factor(particle) * strain)

    @compiled_whole
    def recoverable_strain(self, particle: Particle, strain_max: AnyShape) -> AnyShape:
        r"""Strain :math:`\delta` [-] recovered on full release from the largest strain :math:`\epsilon_P` [-].

        .. math::
            \delta^2 = \frac{\sigma_P}{4.12\, \bar E\, \eta_p^p\, \epsilon_P} \ (\text{printed}), \qquad
            \delta^2 = \frac{\sigma_P^2}{k\, \bar E^2\, \eta_p^p\, \epsilon_P} \ (\text{punch forms})

        with p of the `StrainScaling`, and never more than a contact can give back,

        .. math:: \delta \le \min\left(\epsilon_P,\ \tfrac{3\pi}{8}\, \sigma_P \Big/ \frac{d\sigma}{d\epsilon}\right).
        """
        return particle.strain(self.contact(particle).recovered(particle.displacement(strain_max)).displacement)

    @compiled_whole
    def unloading_stress(self, particle: Particle, strain: AnyShape, strain_max: AnyShape) -> AnyShape:
        """Stress [MPa] on the elastic branch that starts at `strain_max`."""
        recovered = self.recoverable_strain(particle, strain_max)
        carries = recovered > 0
        s = jnp.where(carries, (strain_max - strain) / jnp.where(carries, recovered, 1.0), 1.0)
        return self.loading_stress(particle, strain_max) * stress_ratio(s)

    def recoverable_displacement(
        self, particle: Particle, peak: Values, peak_force: Values, factor: Values | Scalar
    ) -> Values:
        """Displacement [um] recovered on full release from a peak, with a factor on the effective modulus.

        Effects may have moved the peak off the loading curve; the limit of recovery stays that of the curve.
        """
        moved = peak > jnp.finfo(peak.dtype).tiny ** 0.5
        contact = self.contact(particle)
        secant = jnp.where(moved, peak_force, contact.k1) / jnp.where(moved, peak, 1.0)
        return jnp.where(moved, contact.softened(factor).recovered(peak, secant).displacement, 0.0)

    @compiled_whole
    def loading_work(self, particle: Particle, displacement: Scalar) -> Scalar:
        """Work [nJ] of plastic loading from zero to the displacement [um]."""
        return self.contact(particle).work(displacement)
