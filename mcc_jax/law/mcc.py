"""The loading-unloading contact law of micro-crystalline cellulose particles."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._numerics import compiled_whole, derivative_kept, running_max, shared
from .._types import Flag, Path, Scalar, ScalarLike, scalar
from ..arguments import finite, instance, member, positive
from ..geometry import Particle, plastic_shape_factor
from .base import AbstractContactLaw
from .branch import AREA, branch_coefficients, branch_force
from .loading_inverse import loading_strain, secant_modulus, tangent_modulus
from .plastic import Plastic
from .recovery import energy_ratio, recovery, stress_ratio
from .recovery_limit import recovery_limit
from .unloading import StrainScaling, Unloading

AnyShape = Float[Array, "..."]
TESTED_STRAIN = 0.67
"""Scaled strain eta_p eps at which the paper's tests ended, on its mean curve (peaks of 7 to 16 MPa)."""


class History(eqx.Module):
    r"""What a particle remembers: the largest platen displacement.

    The paper's two internal variables :math:`\epsilon_P, \sigma_P` are functions of it (`MccLaw.internal_variables`).

    Attributes:
        displacement_max: largest displacement so far [um]; 0 for a virgin particle, never decreases.
    """

    displacement_max: Scalar = eqx.field(converter=scalar)


class Energy(eqx.Module):
    """Energy balance of one particle [nJ]; `work = recoverable + dissipated`.

    Attributes:
        work: work done by the platens up to now.
        recoverable: what the particle would still give back on full release.
        dissipated: what is lost for good; it does not change while unloading and reloading.
    """

    work: Scalar
    recoverable: Scalar
    dissipated: Scalar


def _coefficients(value: Plastic) -> Plastic:
    return instance(value, Plastic, "plastic", "Give mcc_jax.Plastic(C1, C3, C5).")


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


class MccLaw(AbstractContactLaw[History]):
    r"""Plastic loading along a quintic, elastic unloading and reloading along an arcsine branch.

    With :math:`\epsilon = \gamma/D_e`, :math:`\sigma = F/(\pi R_e^2)`, :math:`\eta_p` from `plastic_shape_factor` and
    :math:`(\epsilon_P, \sigma_P)` the largest strain so far and its stress,

    .. math::
        \sigma &= C_1 \eta_p\epsilon - (C_3 \eta_p\epsilon)^3 + (C_5 \eta_p\epsilon)^5
            && \text{plastic loading},\ \epsilon \ge \epsilon_P \\
        \sigma &= \tfrac{2}{\pi} \sigma_P \left[\arccos s - s\sqrt{1 - s^2}\right],\quad
            s = (\epsilon_P - \epsilon)/\delta && \text{elastic unloading and reloading}

    and zero once s >= 1. The recovered strain :math:`\delta` has three forms (`Unloading`) and three ways in which
    :math:`\eta_p` enters (`StrainScaling`); the defaults are the paper's. Reloading retraces unloading and rejoins the
    loading curve at :math:`\epsilon_P`. Rate independent, no adhesion.

    Validity: the paper's tests ended at 7 to 16 MPa, :math:`\eta_p\epsilon \le 0.67` on the mean curve. If the quintic
    is not monotone (`is_monotone`), displacement control follows it down, load control snaps through; nothing becomes
    NaN.

    At zero displacement, at the onset of unloading, on full release and out of contact, value and first derivatives are
    finite in both modes. Where branches meet (a kink of the model itself) the derivative is that of loading at the
    onset, and that of the released particle at full release.

    Attributes:
        plastic: C1, C3, C5.
        a: geometric parameter of the shape factor [-].
        effective_modulus: :math:`\bar E = E/(1-\nu^2)` [MPa], > 0; its value belongs to the chosen `unloading` form.
        unloading: form of the recovered strain, also as its text: "printed", "punch", "punch_exact".
        strain_scaling: how the shape factor enters it, also as its text: "raw", "contact", "master".

    Raises:
        InputError: for a plain number out of its range, or an unknown form.

    References:
        Bommireddy et al. (2018), eqs. 16, 23 and 24.
    """

    plastic: Plastic = eqx.field(converter=_coefficients)
    a: Scalar = eqx.field(converter=_shape)
    effective_modulus: Scalar = eqx.field(converter=_modulus)
    unloading: Unloading = eqx.field(static=True, converter=_unloading, default=Unloading.PRINTED)
    strain_scaling: StrainScaling = eqx.field(static=True, converter=_strain_scaling, default=StrainScaling.RAW)

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

        The printed form does not vanish at zero strain: below a peak strain of about 0.01 (0.2 MPa) its residual strain
        would be negative, and a little lower its unloading would create energy. There the limit holds; with the paper's
        modulus, above it the formula is untouched up to far beyond the tested range.
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

    def internal_variables(self, particle: Particle, history: History) -> tuple[Scalar, Scalar]:
        r"""The paper's :math:`(\epsilon_P, \sigma_P)`: largest strain [-] and its stress [MPa]."""
        strain_max = particle.strain(history.displacement_max)
        return strain_max, self.loading_stress(particle, strain_max)

    @compiled_whole
    def residual_displacement(self, particle: Particle, history: History) -> Scalar:
        """Displacement [um] that stays after full release."""
        strain_max = particle.strain(history.displacement_max)
        return history.displacement_max - particle.displacement(self.recoverable_strain(particle, strain_max))

    def _elastic(self, eta: Scalar, x: AnyShape) -> tuple[AnyShape, Bool[Array, ...], AnyShape]:
        """Peak stress, whether it is positive, and the recoverable strain, at the peak scaled strain `x`."""
        polynomial = self.plastic.polynomial
        secant = secant_modulus(*polynomial, x)
        k, power = self.unloading.constant, self.strain_scaling.power
        if self.unloading is Unloading.PRINTED:
            square = shared(eta ** (1 - power) * secant / (k * self.effective_modulus))
        else:
            square = eta ** (1 - power) * x * shared(secant / self.effective_modulus) ** 2 / k
        carries = (x > 0) & (square > jnp.finfo(square.dtype).tiny)  # down to where the root still has a derivative
        recoverable = shared(jnp.sqrt(jnp.where(carries, square, 1.0)))
        limit, _ = recovery_limit(shared(x / eta), secant, tangent_modulus(*polynomial, x))
        return x * secant, carries, jnp.where(carries & (recoverable > limit), limit, recoverable)

    # ---- force and displacement --------------------------------------------------------------------------------------

    def init(self, particle: Particle) -> History:
        """A virgin particle."""
        return History(jnp.zeros_like(particle.D3))

    @compiled_whole
    def step(self, particle: Particle, state: History, displacement: Scalar) -> tuple[History, Scalar]:
        """Force [mN] at the platen displacement [um] (negative: not yet touching), and the history after it."""
        # Asked this way round, a displacement that is NaN shows; so it is below.
        peak = jnp.where(displacement < state.displacement_max, state.displacement_max, displacement)
        return History(peak), self._force(particle, displacement, peak)

    @compiled_whole
    def step_load(self, particle: Particle, state: History, force: Scalar) -> tuple[History, Scalar]:
        """Platen displacement [um] under the force [mN], and the history after it.

        A force <= 0 means out of contact: the displacement stays where the platen left the particle.
        """
        peak, displacement = self.peak_and_displacement(particle, state, force, force)
        return History(peak), displacement

    @compiled_whole
    def path(self, particle: Particle, state: History, displacement: Path) -> tuple[History, Path]:
        """Forces [mN] along a path of displacements [um], in closed form over the running maximum (no scan)."""
        highest = running_max(displacement)
        peak = jnp.where(highest < state.displacement_max, state.displacement_max, highest)
        return History(peak[-1]), self._force(particle, displacement, peak)

    @compiled_whole
    def path_load(self, particle: Particle, state: History, force: Path) -> tuple[History, Path]:
        """Displacements [um] along a path of forces [mN], in closed form over the running maximum (no scan)."""
        peak, displacement = self.peak_and_displacement(particle, state, force, running_max(force))
        return History(peak[-1]), displacement

    def _force(self, particle: Particle, displacement: AnyShape, peak: AnyShape) -> AnyShape:
        # A path then depends on its particle through four numbers only.
        eta, diameter = derivative_kept(self.shape_factor(particle)), derivative_kept(particle.effective_diameter)
        form = self.unloading, self.strain_scaling
        k1, k3, k5, c = branch_coefficients(*form, *self.plastic.polynomial, self.effective_modulus, eta, diameter)
        return branch_force(self.unloading.stress_power, k1, k3, k5, c, peak, peak - displacement)

    @compiled_whole
    def peak_and_displacement(
        self, particle: Particle, state: History, force: AnyShape, highest: AnyShape
    ) -> tuple[AnyShape, AnyShape]:
        """Largest displacement so far and displacement [um] under forces [mN], one or many.

        Args:
            particle: the particle.
            state: its history before the first of the forces.
            force: forces [mN].
            highest: the largest force up to each of them [mN].
        """
        # The barriers make stages that share nothing but what they are given. Where they share intermediate values, XLA
        # stores those and cuts the loop over the data of the inverse in many pieces.
        eta, diameter = jax.lax.optimization_barrier((self.shape_factor(particle), particle.effective_diameter))

        carried = self.plastic.stress(shared(eta * state.displacement_max / diameter))
        past = jax.lax.optimization_barrier(AREA * (diameter * diameter) * carried)

        law, eta, diameter, state, highest = jax.lax.optimization_barrier((self, eta, diameter, state, highest))
        scale, area = shared(diameter / eta), AREA * (diameter * diameter)
        stress = shared(jnp.where(highest < past, past, highest) / area)
        K1, K3, K5 = law.plastic.polynomial
        reached = scale * loading_strain(K1, K3, K5, stress, state.displacement_max / scale)
        elastic = (highest < past) | (reached < state.displacement_max)
        peak = jax.lax.optimization_barrier(jnp.where(elastic, state.displacement_max, reached))

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

    @compiled_whole
    def energy(self, particle: Particle, history: History, displacement: Scalar) -> Energy:
        r"""Energy balance [nJ] at a displacement [um] on the branch that starts at the history's peak.

        .. math:: W_{rec} = \pi R_e^2 D_e\, \sigma_P\, \delta\, g(s), \quad g(0) = \tfrac{4}{3\pi}, \qquad
            W_{diss} = W_{load}(\epsilon_P) - W_{rec}(s = 0)

        Args:
            particle: the particle.
            history: its largest displacement; a larger `displacement` counts as further loading.
            displacement: where it is now [um].
        """
        peak = jnp.where(displacement >= history.displacement_max, displacement, history.displacement_max)
        diameter = particle.effective_diameter
        eta = self.shape_factor(particle)
        peak_stress, carries, recoverable = self._elastic(eta, eta * peak / diameter)
        s = _recovered((peak - displacement) / diameter, carries, recoverable)
        scale = particle.force(peak_stress) * diameter * jnp.where(carries, recoverable, 0.0)
        at_peak = scale * energy_ratio(jnp.zeros_like(s))
        now = jnp.where(displacement >= peak, at_peak, scale * energy_ratio(s))
        dissipated = self.loading_work(particle, peak) - at_peak
        return Energy(dissipated + now, now, dissipated)


def _recovered(drop: AnyShape, carries: Bool[Array, ...], recoverable: AnyShape) -> AnyShape:
    """Share of the recoverable strain recovered after the strain dropped; all of it where no stress was carried."""
    return jnp.where(carries, drop / recoverable, 1.0)
