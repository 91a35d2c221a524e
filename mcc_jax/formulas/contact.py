"""The paper's formulas for one particle between platens: loading, unloading, recovered strain, work; no memory."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._format import table, value_of
from .._numerics import compiled_whole, derivative_kept, shared
from .._types import Flag, Scalar, ScalarLike, Values, scalar
from ..arguments import finite, member, positive
from ..geometry import Particle, plastic_shape_factor
from .branch import AREA, branch_coefficients, branch_force
from .loading_inverse import loading_strain, secant_modulus, tangent_modulus
from .plastic import Plastic
from .recovery import energy_ratio, recovery, stress_ratio
from .recovery_limit import recovery_limit
from .unloading import StrainScaling, Unloading

AnyShape = Float[Array, "..."]


def _shape(value: ScalarLike) -> Scalar:
    finite(value, "a, the geometric parameter [-],")
    return scalar(value)


def _modulus(value: ScalarLike) -> Scalar:
    positive(value, "the effective modulus [MPa]", plain=True)
    return scalar(value)


def _unloading(value: Unloading | str) -> Unloading:
    return member(value, Unloading, "unloading")


def _strain_scaling(value: StrainScaling | str) -> StrainScaling:
    return member(value, StrainScaling, "strain_scaling")


class Formulas(eqx.Module):
    r"""Stress, force and recovered strain of a particle at a given peak: the parameters of the law, without memory.

    What stands here an effect can change through its parameters (size, shape, humidity), and `MccLaw` adds memory,
    effects and control. Attributes and validity are those of `MccLaw`.
    """

    plastic: Plastic
    a: Scalar = eqx.field(converter=_shape)
    effective_modulus: Scalar = eqx.field(converter=_modulus)
    unloading: Unloading = eqx.field(static=True, converter=_unloading, default=Unloading.PRINTED)
    strain_scaling: StrainScaling = eqx.field(static=True, converter=_strain_scaling, default=StrainScaling.RAW)

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

    # ---- stress and strain -------------------------------------------------------------------------------------------

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

        with p of the `StrainScaling`, and never more than a contact can give back (`recovery_limit`),

        .. math:: \delta \le \min\left(\epsilon_P,\ \tfrac{3\pi}{8}\, \sigma_P \Big/ \frac{d\sigma}{d\epsilon}\right).
        """
        eta = self.shape_factor(particle)
        _, _, recoverable = self._elastic(eta, eta * strain_max)
        return recoverable

    @compiled_whole
    def unloading_stress(self, particle: Particle, strain: AnyShape, strain_max: AnyShape) -> AnyShape:
        """Stress [MPa] on the elastic branch that starts at `strain_max`."""
        eta = self.shape_factor(particle)
        peak_stress, carries, recoverable = self._elastic(eta, eta * strain_max)
        return peak_stress * stress_ratio(_recovered(strain_max - strain, carries, recoverable))

    def recoverable_displacement(
        self, particle: Particle, peak_displacement: Values, peak_force: Values, factor: Values | Scalar
    ) -> Values:
        """Displacement [um] recovered on full release from a peak, with a factor on the effective modulus.

        `recoverable_strain` in terms of force and displacement at the peak, which effects may have moved off the
        loading curve. The limit takes the slope of loading over its secant from the curve without effects, so that it
        stays in closed form.
        """
        eta = self.shape_factor(particle)
        x = eta * particle.strain(peak_displacement)
        moved = x > jnp.finfo(x.dtype).tiny ** 0.5
        secant = jnp.where(moved, particle.stress(peak_force), self.plastic.C1) / jnp.where(moved, x, 1.0)
        carries, recoverable = self._recoverable(
            eta, x, secant, self.plastic.secant(x), self.effective_modulus * factor
        )
        return particle.displacement(jnp.where(moved & carries, recoverable, 0.0))

    def _elastic(
        self, eta: Scalar, x: AnyShape, modulus: Scalar | None = None
    ) -> tuple[AnyShape, Bool[Array, ...], AnyShape]:
        """Peak stress, whether it is positive, and the recoverable strain, at the peak scaled strain `x`."""
        secant = secant_modulus(*self.plastic.polynomial, x)
        modulus = self.effective_modulus if modulus is None else modulus
        return x * secant, *self._recoverable(eta, x, secant, secant, modulus)

    def _recoverable(
        self, eta: Scalar, x: AnyShape, secant: AnyShape, loading_secant: AnyShape, modulus: AnyShape
    ) -> tuple[Bool[Array, ...], AnyShape]:
        """Whether the peak carries stress, and the recoverable strain, at the peak scaled strain `x`."""
        k, power = self.unloading.constant, self.strain_scaling.power
        if self.unloading is Unloading.PRINTED:
            square = shared(eta ** (1 - power) * secant / (k * modulus))
        else:
            square = eta ** (1 - power) * x * shared(secant / modulus) ** 2 / k
        carries = (x > 0) & (square > jnp.finfo(square.dtype).tiny)  # down to where the root still has a derivative
        recoverable = shared(jnp.sqrt(jnp.where(carries, square, 1.0)))
        tangent = tangent_modulus(*self.plastic.polynomial, x)
        limit, _ = recovery_limit(shared(x / eta), loading_secant, tangent)
        return carries, jnp.where(carries & (recoverable > limit), limit, recoverable)

    # ---- force and displacement --------------------------------------------------------------------------------------

    def force(self, particle: Particle, displacement: AnyShape, peak: AnyShape) -> AnyShape:
        """Force [mN] at platen displacements [um], the largest up to each being `peak`."""
        # A path then depends on its particle through four numbers only.
        eta, diameter = derivative_kept(self.shape_factor(particle)), derivative_kept(particle.effective_diameter)
        size = eta, diameter, particle.inverse_diameter
        form, law = (self.unloading, self.strain_scaling), (*self.plastic.polynomial, self.effective_modulus)
        numbers = branch_coefficients(*form, *law, *size)
        return branch_force(self.unloading.stress_power, *numbers, peak, peak - displacement)

    @compiled_whole
    def peak_and_displacement(
        self, particle: Particle, displacement_max: Scalar, force: AnyShape, highest: AnyShape
    ) -> tuple[AnyShape, AnyShape]:
        """Largest displacement so far and displacement [um] under forces [mN], one or many.

        Args:
            particle: the particle.
            displacement_max: its largest displacement before the first of the forces [um].
            force: forces [mN].
            highest: the largest force up to each of them [mN].
        """
        # The barriers make stages that share nothing but what they are given. Where they share intermediate values, XLA
        # stores those and cuts the loop over the data of the inverse in many pieces.
        eta, diameter = jax.lax.optimization_barrier((self.shape_factor(particle), particle.effective_diameter))

        carried = self.plastic.stress(shared(eta * displacement_max / diameter))
        past = jax.lax.optimization_barrier(AREA * (diameter * diameter) * carried)

        law, eta, diameter, displacement_max, highest = jax.lax.optimization_barrier(
            (self, eta, diameter, displacement_max, highest)
        )
        scale, area = shared(diameter / eta), AREA * (diameter * diameter)
        stress = shared(jnp.where(highest < past, past, highest) / area)
        K1, K3, K5 = law.plastic.polynomial
        reached = scale * loading_strain(K1, K3, K5, stress, displacement_max / scale)
        elastic = (highest < past) | (reached < displacement_max)
        peak = jax.lax.optimization_barrier(jnp.where(elastic, displacement_max, reached))

        law, eta, diameter, force, highest = jax.lax.optimization_barrier((self, eta, diameter, force, highest))
        peak_force = jnp.where(highest < past, past, highest)
        _, carries, recoverable = law._elastic(eta, shared(eta * peak / diameter))
        # Below that, the quotient's derivatives overflow.
        loaded = carries & (peak_force > jnp.finfo(peak_force.dtype).tiny ** 0.5)
        ratio = shared(jnp.where(loaded, force, 0.0) / jnp.where(loaded, peak_force, 1.0))
        released = diameter * recoverable * recovery(ratio)
        return peak, peak - jnp.where(loaded & (force < peak_force), released, 0.0)

    # ---- energy ------------------------------------------------------------------------------------------------------

    @compiled_whole
    def loading_work(self, particle: Particle, displacement: Scalar) -> Scalar:
        r"""Work [nJ] of plastic loading from zero to the displacement [um].

        .. math:: W = \frac{\pi R_e^2 D_e}{\eta_p}
            \left(\tfrac12 C_1 x^2 - \tfrac14 C_3^3 x^4 + \tfrac16 C_5^5 x^6\right), \quad x = \eta_p \gamma / D_e
        """
        eta = self.shape_factor(particle)
        density = self.plastic.work(eta * particle.strain(displacement)) / eta
        return particle.force(density) * particle.effective_diameter

    def recoverable_work(
        self, particle: Particle, peak: Scalar, displacement: Scalar, factor: Scalar | None = None
    ) -> tuple[Scalar, Scalar]:
        r"""What full release gives back [nJ]: from the peak, and from a displacement on its branch.

        .. math:: W_{rec} = \pi R_e^2 D_e\, \sigma_P\, \delta\, g(s), \quad g(0) = \tfrac{4}{3\pi}

        Args:
            particle: the particle.
            peak: its largest displacement [um].
            displacement: where it is now [um].
            factor: on the effective modulus.
        """
        diameter = particle.effective_diameter
        eta = self.shape_factor(particle)
        modulus = self.effective_modulus if factor is None else factor * self.effective_modulus
        peak_stress, carries, recoverable = self._elastic(eta, eta * peak / diameter, modulus)
        s = _recovered((peak - displacement) / diameter, carries, recoverable)
        scale = particle.force(peak_stress) * diameter * jnp.where(carries, recoverable, 0.0)
        at_peak = scale * energy_ratio(jnp.zeros_like(s))
        return at_peak, jnp.where(displacement >= peak, at_peak, scale * energy_ratio(s))


def _recovered(drop: AnyShape, carries: Bool[Array, ...], recoverable: AnyShape) -> AnyShape:
    """Share of the recoverable strain recovered after the strain dropped; all of it where no stress was carried."""
    return jnp.where(carries, drop / recoverable, 1.0)
