"""Effects on the loading curve: rate, friction at the platens, finite hardening exponent."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, Values, scalar
from ..formulas import PUNCH_AREA, Formulas, recovery, tangent_modulus
from ..geometry import Particle
from .context import Context, root
from .effect import AbstractEffect, Factors, at_least
from .record import Record
from .variant import Mechanism, Need, Nuisance, Variant

REFERENCE_FORCE_RATE = 2.0  # mN/s
REFERENCE_STRESS_RATE = 0.05  # MPa/s
REFERENCE_STRAIN_RATE = 2e-3  # 1/s
REFERENCE_STRAIN = 0.2
LOCKING_STRAIN = 0.5
MIN_FACTOR = 0.05


# ---- rate ------------------------------------------------------------------------------------------------------------


class AbstractRateEffect(AbstractEffect):
    """Flow stress that grows with a rate, relative to a reference rate; a rate that is not known changes nothing."""

    terms: tuple[bool, bool, bool] = eqx.field(static=True, default=(True, True, True))

    def relative_rate(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Values:
        """Rate of the latest loading ramp over the reference."""
        raise NotImplementedError

    def factor(self, rate: Values) -> Values:
        """Factor on flow stress at a relative rate > 0."""
        raise NotImplementedError

    def loading(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Factors:
        """The factor on the chosen terms."""
        rate = self.relative_rate(law, particle, record, strain)
        known = rate > 0
        factor = jnp.where(known, at_least(self.factor(jnp.where(known, rate, 1.0)), MIN_FACTOR), 1.0)
        one = jnp.ones_like(factor)
        first, third, fifth = (factor if term else one for term in self.terms)
        return first, third, fifth


class AbstractForceRate(AbstractRateEffect):
    """Rate of force."""

    def relative_rate(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Values:
        """F' / (2 mN/s)."""
        return record.loading_rate / REFERENCE_FORCE_RATE + jnp.zeros_like(strain)


class AbstractStressRate(AbstractRateEffect):
    """Rate of stress."""

    def relative_rate(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Values:
        """sigma' / (0.05 MPa/s)."""
        return particle.stress(record.loading_rate) / REFERENCE_STRESS_RATE + jnp.zeros_like(strain)


class AbstractStrainRate(AbstractRateEffect):
    """Rate of strain, from the rate of stress and the base law's tangent at that strain."""

    def relative_rate(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Values:
        """eps' / (2e-3 1/s), eps' = sigma' / (d sigma / d eps)."""
        K1, K3, K5 = law.plastic.polynomial
        eta = law.shape_factor(particle)
        slope = tangent_modulus(K1, K3, K5, eta * strain)
        least = 0.1 * K1
        slope = eta * jnp.where(slope > least, slope, least)
        return particle.stress(record.loading_rate) / slope / REFERENCE_STRAIN_RATE


class LogForceRate(AbstractForceRate):
    """Logarithmic in the rate of force."""

    def factor(self, rate: Values) -> Values:
        """1 + m ln(rate)."""
        return 1 + self.amplitude * jnp.log(rate)


class LogStrainRate(AbstractStrainRate):
    """Logarithmic in the rate of strain."""

    def factor(self, rate: Values) -> Values:
        """1 + m ln(rate)."""
        return 1 + self.amplitude * jnp.log(rate)


class PowerStressRate(AbstractStressRate):
    """A power of the rate of stress."""

    def factor(self, rate: Values) -> Values:
        """Rate^m."""
        return jnp.exp(self.amplitude * jnp.log(rate))


class PowerStrainRate(AbstractStrainRate):
    """A power of the rate of strain."""

    def factor(self, rate: Values) -> Values:
        """Rate^m."""
        return jnp.exp(self.amplitude * jnp.log(rate))


class CowperSymonds(AbstractStrainRate):
    """Overstress as a power of the rate of strain."""

    exponent: Scalar = eqx.field(converter=scalar, kw_only=True)

    def factor(self, rate: Values) -> Values:
        """1 + m rate^q."""
        return 1 + self.amplitude * jnp.exp(self.exponent * jnp.log(rate))


class Eyring(AbstractStrainRate):
    """Thermally activated flow: viscous at low rates, logarithmic at high ones."""

    rate_share: Scalar = eqx.field(converter=scalar, kw_only=True)

    def factor(self, rate: Values) -> Values:
        """1 + m asinh(rate / r)."""
        return 1 + self.amplitude * jnp.arcsinh(rate / self.rate_share)


class LogForceRateStiffness(LogForceRate):
    """Flow stress and modulus grow together with the rate of force."""

    def stiffness(self, context: Context) -> Values:
        """1 + m ln(rate of the latest ramp)."""
        rate = context.record.rate / REFERENCE_FORCE_RATE
        known = rate > 0
        factor = at_least(self.factor(jnp.where(known, rate, 1.0)), MIN_FACTOR)
        return jnp.where(known, factor, 1.0) + jnp.zeros_like(context.peak_strain)


def _rate(name: str, make: type[AbstractEffect], equation: str, explanation: str, source: str, **more: Any) -> Variant:
    return Variant(
        "rate_dependence", name, make, "rate_sensitivity", "-", 1, (0.003, 0.1), equation, explanation, source,
        helps=(Need.SEVERAL_SIZES,), **{"needs": (Need.TWO_RATES,), **more},
    )  # fmt: skip


_RATE = "Roberts and Rowe (1985), Chem. Eng. Sci. 40, 4; Schmalbach et al. (2021), J. Mater. Res."
_EYRING = "Eyring (1936), J. Chem. Phys. 4, 283; Ree and Eyring (1955), J. Appl. Phys. 26, 793"
_ACTIVATED = (Nuisance("rate_share", (0.1, 1.0, 10.0), (0.01, 100.0), "strain rate of the crossover over 0.002/s"),)
_ALONG = ()  # a strain rate varies along one test and from size to size, so that one force rate shows it, if weakly

RATE = Mechanism(
    "rate_dependence",
    "The faster the particle is loaded, the harder it is to deform plastically.",
    (
        _rate("yield_log_strain_rate", LogStrainRate, "C1 (1 + m ln(eps' / 0.002/s))",
              "Only the yield term C1 grows, with the logarithm of the strain rate.", _RATE, needs=_ALONG,
              fixed={"terms": (True, False, False)}),
        _rate("flow_log_strain_rate", LogStrainRate, "sigma(eps) (1 + m ln(eps' / 0.002/s))",
              "Flow stress grows with the logarithm of the strain rate.", "Johnson and Cook (1985)", needs=_ALONG),
        _rate("flow_log_force_rate", LogForceRate, "sigma(eps) (1 + m ln(F' / 2 mN/s))",
              "Flow stress grows with the logarithm of the loading rate.", _RATE),
        _rate("flow_power_strain_rate", PowerStrainRate, "sigma(eps) (eps' / 0.002/s)^m",
              "Flow stress as a power of the strain rate.", "Biwa and Storakers (1995), J. Mech. Phys. Solids 43, 1303",
              needs=_ALONG),
        _rate("flow_power_stress_rate", PowerStressRate, "sigma(eps) (sigma' / 0.05 MPa/s)^m",
              "Flow stress as a power of the stress rate.", _RATE, needs=_ALONG),
        _rate("cowper_symonds", CowperSymonds, "sigma(eps) (1 + m (eps' / 0.002/s)^q)",
              "Overstress as a power of the strain rate.", "Cowper and Symonds (1957)", needs=_ALONG,
              nuisances=(Nuisance("exponent", (0.2, 0.5), (0.05, 1.0), "power of the strain rate"),)),
        _rate("hardening_log_strain_rate", LogStrainRate, "C5^5 (1 + m ln(eps' / 0.002/s))",
              "Only the hardening term grows with the strain rate.", _RATE, needs=_ALONG,
              fixed={"terms": (False, False, True)}),
        _rate("flow_and_modulus_log_force_rate", LogForceRateStiffness,
              "sigma(eps) and E (1 + m ln(F' / 2 mN/s)), each at the rate of its own ramp",
              "Flow stress and unloading stiffness grow together.", _RATE),
        _rate("flow_eyring", Eyring, "sigma(eps) [1 + m asinh(eps' / (r 0.002/s))]",
              "Thermally activated flow: viscous at low rates, logarithmic at high ones.", _EYRING, needs=_ALONG,
              nuisances=_ACTIVATED),
        _rate("yield_eyring", Eyring, "C1 [1 + m asinh(eps' / (r 0.002/s))]",
              "The same of the yield term C1 only.", _EYRING, needs=_ALONG, nuisances=_ACTIVATED,
              fixed={"terms": (True, False, False)}),
    ),
    ("size_effect, at one force rate",),
    check="load at two rates or more within one class of sizes",
    coordinates=("peak", "rate"),
)  # fmt: skip


# ---- friction --------------------------------------------------------------------------------------------------------


class AbstractLoadingFactor(AbstractEffect):
    """One factor on the whole loading stress."""

    def factor(self, particle: Particle, strain: Values) -> Values:
        """The factor at a strain."""
        raise NotImplementedError

    def loading(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Factors:
        """The factor on all three terms."""
        factor = at_least(self.factor(particle, strain), MIN_FACTOR)
        return factor, factor, factor


def _slenderness(particle: Particle, strain: Values) -> Values:
    """Contact radius over the height left between the platens, which does not fall below a tenth of D3."""
    radius = particle.effective_diameter * root(PUNCH_AREA * strain)
    return radius / at_least_of(particle.D3 - particle.displacement(strain), 0.1 * particle.D3)


def at_least_of(x: Values, least: Values) -> Values:
    """`x`, but not below a floor that is itself a parameter."""
    return jnp.where(x > least, x, least)


class SiebelFriction(AbstractLoadingFactor):
    """Friction hill of a compressed disc, to first order."""

    def factor(self, particle: Particle, strain: Values) -> Values:
        """1 + (2 mu / 3) a / h."""
        return 1 + 2 / 3 * self.amplitude * _slenderness(particle, strain)


class SphereFriction(AbstractLoadingFactor):
    """Friction hill to first order over the height of a sphere of the same size, whatever the particle's shape."""

    def factor(self, particle: Particle, strain: Values) -> Values:
        """1 + (2 mu / 3) sqrt(PUNCH_AREA eps) / (1 - eps)."""
        return 1 + 2 / 3 * self.amplitude * root(PUNCH_AREA * strain) / at_least(1 - strain, 0.1)


class SlabFriction(AbstractLoadingFactor):
    """Friction hill of a compressed disc with exponential pressure."""

    def factor(self, particle: Particle, strain: Values) -> Values:
        """2 (e^k - k - 1) / k^2, k = 2 mu a / h."""
        k = 2 * self.amplitude * _slenderness(particle, strain)
        k = jnp.where(k < 20, k, 20.0)
        small = jnp.abs(k) < 1e-2
        safe = jnp.where(small, 1.0, k)
        return jnp.where(small, 1 + k * (1 / 3 + k * (1 / 12 + k / 60)), 2 * (jnp.expm1(safe) - safe) / (safe * safe))


class StickingFriction(AbstractLoadingFactor):
    """Constraint that grows with the square of the slenderness, as under full sticking."""

    def factor(self, particle: Particle, strain: Values) -> Values:
        """1 + mu (a / h)^2."""
        return 1 + self.amplitude * _slenderness(particle, strain) ** 2


class StrainFriction(AbstractLoadingFactor):
    """Constraint in proportion to strain, whatever the particle's height."""

    def factor(self, particle: Particle, strain: Values) -> Values:
        """1 + mu eps."""
        return 1 + self.amplitude * strain


def _friction(
    name: str, make: type[AbstractEffect], equation: str, explanation: str, source: str, most: float = 0.4
) -> Variant:
    return Variant(
        "platen_friction", name, make, "friction_coefficient", "-", 1, (most / 40, most), equation, explanation, source,
        helps=(Need.SEVERAL_SHAPES, Need.SEVERAL_PEAKS),
    )  # fmt: skip


FRICTION = Mechanism(
    "platen_friction",
    "The platens hold the spreading contact back, so that the particle carries more the flatter it gets.",
    (
        _friction("siebel", SiebelFriction, "sigma(eps) [1 + (2 mu / 3) a / h]",
                  "Mean pressure of the friction hill on a disc of radius a and height h.", "Siebel (1923)"),
        _friction("sphere", SphereFriction, "sigma(eps) [1 + (2 mu / 3) a / (D_e (1 - eps))]",
                  "The same over the height of a sphere of the particle's size: as if its shape played no part.",
                  "Siebel (1923)"),
        _friction("exponential_hill", SlabFriction, "sigma(eps) 2 (e^k - k - 1) / k^2, k = 2 mu a / h",
                  "The slab method with Coulomb friction.", "Hosford and Caddell, Metal Forming, ch. 7"),
        _friction("sticking", StickingFriction, "sigma(eps) [1 + mu (a / h)^2]",
                  "The contact sticks; the constraint grows with the square of its slenderness.",
                  "Brizmer, Kligerman and Etsion (2006), Int. J. Solids Struct. 43, 5736; Zait et al. (2010)",
                  0.1),
        _friction("strain", StrainFriction, "sigma(eps) (1 + mu eps)", "A constraint that grows with strain alone.",
                  "first-order form"),
    ),
    check="repeat with lubricated and with roughened platens",
    coordinates=("peak", "shape"),
)  # fmt: skip


class LockingFactor(AbstractLoadingFactor):
    """Pores that close up: little at small strain, steep at large."""

    exponent: Scalar = eqx.field(converter=scalar)

    def factor(self, particle: Particle, strain: Values) -> Values:
        """1 + b (eps / 0.5)^n."""
        some = strain > 1e-9
        power = jnp.exp(self.exponent * jnp.log(jnp.where(some, strain, 1.0) / LOCKING_STRAIN))
        return 1 + self.amplitude * jnp.where(some, power, 0.0)


class ExponentialLocking(AbstractLoadingFactor):
    """The same with an exponential: it sets in earlier and grows longer."""

    exponent: Scalar = eqx.field(converter=scalar)

    def factor(self, particle: Particle, strain: Values) -> Values:
        """1 + b (e^(k eps) - 1 - k eps) / (the same at 0.5)."""
        at = self.exponent * strain
        most = self.exponent * LOCKING_STRAIN
        return 1 + self.amplitude * (jnp.expm1(at) - at) / (jnp.expm1(most) - most)


# ---- hardening exponent ----------------------------------------------------------------------------------------------


class FiniteHardening(AbstractEffect):
    """Power-law hardening material: an exponent m of flow instead of perfect plasticity; the amplitude is 1/m."""

    terms: tuple[bool, bool, bool] = eqx.field(static=True, default=(True, False, False))

    def loading(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Factors:
        """(eps / 0.2)^(1 / 2m) on the chosen terms."""
        safe = jnp.where(strain > 1e-9, strain, 1e-9)
        factor = jnp.exp(0.5 * self.amplitude * jnp.log(safe / REFERENCE_STRAIN))
        one = jnp.ones_like(factor)
        first, third, fifth = (factor if term else one for term in self.terms)
        return first, third, fifth


def _power_of_load(half_inverse: Scalar, context: Context) -> Values:
    """Delta [s(u) - s(u^(1 / (1 + 1/2m)))], the same exponent on the elastic branch; `half_inverse` is 1/2m."""
    share = context.load_share
    some = share > 0
    log = jnp.log(jnp.where(some, share, 1.0))
    moved = jnp.where(some, share * jnp.exp(-half_inverse / (1 + half_inverse) * log), share)
    return context.recoverable * (recovery(share) - recovery(jnp.where(moved < 1, moved, 1.0)))


class FiniteHardeningBoth(FiniteHardening):
    """The same exponent on the elastic branch."""

    def inside(self, context: Context) -> Values:
        """Delta [s(u) - s(u^(1 / (1 + 1/2m)))]."""
        return _power_of_load(0.5 * self.amplitude, context)


class FiniteHardeningContact(FiniteHardening):
    """The same exponent on the recovered share: to first order, an exponent 2 (1 + 1/2m) in place of 2 on unloading."""

    def inside(self, context: Context) -> Values:
        """Delta [s - s^(1 / (1 + 1/2m))]."""
        share = context.recovered_share
        some = share > 0
        power = jnp.exp(jnp.log(jnp.where(some, share, 1.0)) / (1 + 0.5 * self.amplitude))
        return context.recoverable * jnp.where(some, share - power, 0.0)


class LudwikHardening(AbstractEffect):
    """Hardening that sets in at a yield strain; the amplitude is 1/m."""

    yield_strain: Scalar = eqx.field(converter=scalar)

    def loading(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Factors:
        """(1 + eps / eps_y)^(1 / 2m) over its value at eps = 0.2, on all terms."""
        grown = jnp.log1p(strain / self.yield_strain) - jnp.log1p(REFERENCE_STRAIN / self.yield_strain)
        factor = jnp.exp(0.5 * self.amplitude * grown)
        return factor, factor, factor


class StrainPower(AbstractEffect):
    """A power of strain in place of strain in every term; the amplitude is 1/m, 1 for Hertz."""

    def loading(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Factors:
        """(eps / 0.2)^(j / 2m) on the terms of order j = 1, 3, 5."""
        safe = jnp.where(strain > 1e-9, strain, 1e-9)
        first = jnp.exp(0.5 * self.amplitude * jnp.log(safe / REFERENCE_STRAIN))
        return first, first**3, first**5


class StrainPowerBoth(StrainPower):
    """The same exponent on the elastic branch."""

    def inside(self, context: Context) -> Values:
        """Delta [s(u) - s(u^(1 / (1 + 1/2m)))]."""
        return _power_of_load(0.5 * self.amplitude, context)


def _hardening(
    name: str,
    make: type[AbstractEffect],
    equation: str,
    explanation: str,
    source: str,
    *,
    plausible: tuple[float, float] = (0.01, 0.5),
    **more: Any,
) -> Variant:
    return Variant(
        "finite_hardening_exponent", name, make, "inverse_exponent", "-", 1, plausible, equation, explanation, source,
        helps=(Need.LOW_LOAD,), **more,
    )  # fmt: skip


_STORAKERS = "Biwa and Storakers (1995); Storakers, Biwa and Larsson (1997), Int. J. Solids Struct. 34, 3061"

HARDENING = Mechanism(
    "finite_hardening_exponent",
    "The material hardens as a power of strain instead of flowing at one stress: the curve bends the other way at low "
    "load.",
    (
        _hardening("linear_term", FiniteHardening, "C1 eta eps (eps / 0.2)^(1/2m)",
                   "The similarity solution of a power-law contact in place of the linear term.", _STORAKERS),
        _hardening("all_terms", FiniteHardening, "sigma(eps) (eps / 0.2)^(1/2m)",
                   "The power acts on the whole loading curve.", _STORAKERS, fixed={"terms": (True, True, True)}),
        _hardening("loading_and_unloading", FiniteHardeningBoth,
                   "sigma(eps) (eps / 0.2)^(1/2m); on unloading u^(1/(1 + 1/2m)) for u",
                   "The power acts on loading and on the pressure that unloading releases.",
                   "Olsson and Larsson (2013)", fixed={"terms": (True, True, True)}),
        _hardening("linear_term_and_unloading", FiniteHardeningContact,
                   "C1 eta eps (eps / 0.2)^(1/2m); on unloading s^(1/(1 + 1/2m)) for s",
                   "The similarity solution in place of the linear term, and to first order on unloading.", _STORAKERS),
        _hardening("ludwik", LudwikHardening, "sigma(eps) [(1 + eps / eps_y) / (1 + 0.2 / eps_y)]^(1/2m)",
                   "Hardening that begins at a yield strain.", "Ludwik (1909); Swift (1952)",
                   nuisances=(Nuisance("yield_strain", (0.01, 0.05), (0.001, 0.3), "strain where hardening sets in"),)),
        _hardening("every_term", StrainPower, "sigma(0.2 (eps / 0.2)^(1 + 1/2m))",
                   "A power of strain in place of strain in every term; 1/m = 1 is an elastic contact after Hertz, "
                   "ceramic pebbles show 1.2 to 1.6.", _STORAKERS, plausible=(0.02, 2.0)),
        _hardening("every_term_and_unloading", StrainPowerBoth,
                   "sigma(0.2 (eps / 0.2)^(1 + 1/2m)); on unloading u^(1/(1 + 1/2m)) for u",
                   "The same, and on the pressure that unloading releases.", "Olsson and Larsson (2013)",
                   plausible=(0.02, 2.0)),
    ),
    check="repeat between polished platens, or indent a compact of the same powder",
    coordinates=("peak", "load"),
)  # fmt: skip
