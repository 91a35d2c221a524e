"""Effects on loading: rate, friction, hardening; and what first loading adds: asperities, tilted platens, breaks."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, Values
from ..formulas import Formulas, recovery
from ..geometry import Particle
from .effect import AbstractEffect, Factors, at_least, on_terms, pick
from .record import SMALL, Context, Record, contact_radius, positive, power
from .variant import Need, Nuisance, family, row

REFERENCE_FORCE_RATE = 2.0  # mN/s
REFERENCE_STRESS_RATE = 0.05  # MPa/s
REFERENCE_STRAIN_RATE = 2e-3  # 1/s
REFERENCE_STRAIN = 0.2


class RateDependence(AbstractEffect):
    """Flow stress that grows with a rate, relative to a reference rate; a rate that is not known changes nothing.

    It is the rate of force, stress or strain (`rate_of`) in the latest loading ramp, of strain by the tangent there.
    With `terms` only some of the linear, cubic and quintic term of loading grow.
    """

    rate_of: str = eqx.field(static=True, default="strain", kw_only=True)
    terms: tuple[float, float, float] = (1.0, 1.0, 1.0)
    exponent: Any = None
    rate_share: Any = None

    formulas: ClassVar = {
        "logarithm": lambda e, rate: 1 + e.amplitude * jnp.log(rate),
        "power": lambda e, rate: jnp.exp(e.amplitude * jnp.log(rate)),
        "cowper_symonds": lambda e, rate: 1 + e.amplitude * jnp.exp(e.exponent * jnp.log(rate)),
        "eyring": lambda e, rate: 1 + e.amplitude * jnp.arcsinh(rate / e.rate_share),
    }

    def rate(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Values:
        if self.rate_of == "force":
            return record.loading_rate / REFERENCE_FORCE_RATE + jnp.zeros_like(strain)
        stress_rate = particle.stress(record.loading_rate)
        if self.rate_of == "stress":
            return stress_rate / REFERENCE_STRESS_RATE + jnp.zeros_like(strain)
        eta = law.shape_factor(particle)
        slope = at_least(law.plastic.tangent(eta * strain), 0.1 * law.plastic.C1)
        return stress_rate / (eta * slope) / REFERENCE_STRAIN_RATE

    def factor(self, rate: Values) -> Values:
        known = rate > 0
        return jnp.where(known, at_least(self.of(jnp.where(known, rate, 1.0))), 1.0)

    def loading(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Factors:
        return on_terms(self.terms, self.factor(self.rate(law, particle, record, strain)))


class RateOfFlowAndModulus(RateDependence):
    """Flow stress and modulus grow together with the rate of force."""

    def stiffness(self, context: Context) -> Values:
        return self.factor(context.record.rate / REFERENCE_FORCE_RATE) + jnp.zeros_like(context.peak_strain)


_EYRING = "Eyring (1936), J. Chem. Phys. 4, 283; Ree and Eyring (1955), J. Appl. Phys. 26, 793"
_ACTIVATED = Nuisance("rate_share", (0.1, 1.0, 10.0), (0.01, 100.0), "strain rate of the crossover over 0.002/s")
_OVERSTRESS = Nuisance("exponent", (0.2, 0.5), (0.05, 1.0), "power of the strain rate")
_COWPER = "Cowper and Symonds (1957), Brown University, Div. Appl. Math. Report 28"
_TWO_RATES = (Need.TWO_RATES,)  # the other rates vary along one test and from size to size: one force rate shows them
_YIELD, _HARDENING = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)

RATE = family(RateDependence, "rate_dependence",
    "The faster the particle is loaded, the harder it is to deform plastically.",
    row("yield_log_strain_rate", "C1 (1 + m ln(eps' / 0.002/s))",
        "Only the yield term C1 grows, with the logarithm of the strain rate.", terms=_YIELD),
    row("flow_log_strain_rate", "sigma(eps) (1 + m ln(eps' / 0.002/s))",
        "Flow stress grows with the logarithm of the strain rate.", source="Johnson and Cook (1985)"),
    row("flow_log_force_rate", "sigma(eps) (1 + m ln(F' / 2 mN/s))",
        "Flow stress grows with the logarithm of the loading rate.", rate_of="force", needs=_TWO_RATES),
    row("flow_power_strain_rate", "sigma(eps) (eps' / 0.002/s)^m", "Flow stress as a power of the strain rate.",
        source="Biwa and Storakers (1995), J. Mech. Phys. Solids 43, 1303", formula="power"),
    row("flow_power_stress_rate", "sigma(eps) (sigma' / 0.05 MPa/s)^m", "Flow stress as a power of the stress rate.",
        formula="power", rate_of="stress"),
    row("cowper_symonds", "sigma(eps) (1 + m (eps' / 0.002/s)^q)", "Overstress as a power of the strain rate.",
        _OVERSTRESS, source=_COWPER, formula="cowper_symonds"),
    row("hardening_log_strain_rate", "C5^5 (1 + m ln(eps' / 0.002/s))",
        "Only the hardening term grows with the strain rate.", terms=_HARDENING),
    row("yield_log_force_rate", "C1 (1 + m ln(F' / 2 mN/s))", "Only the yield term C1 grows with the loading rate.",
        rate_of="force", terms=_YIELD, needs=_TWO_RATES),
    row("hardening_log_force_rate", "C5^5 (1 + m ln(F' / 2 mN/s))",
        "Only the hardening term grows with the loading rate.", rate_of="force", terms=_HARDENING, needs=_TWO_RATES),
    row("flow_and_modulus_log_force_rate", "sigma(eps) and E (1 + m ln(F' / 2 mN/s)), each at the rate of its own ramp",
        "Flow stress and unloading stiffness grow together.", make=RateOfFlowAndModulus, rate_of="force",
        needs=_TWO_RATES),
    row("flow_eyring", "sigma(eps) [1 + m asinh(eps' / (r 0.002/s))]",
        "Thermally activated flow: viscous at low rates, logarithmic at high ones.", _ACTIVATED, source=_EYRING,
        formula="eyring"),
    row("yield_cowper_symonds", "C1 (1 + m (eps' / 0.002/s)^q)", "The same of the yield term C1 only.", _OVERSTRESS,
        source=_COWPER, formula="cowper_symonds", terms=_YIELD),
    row("yield_eyring", "C1 [1 + m asinh(eps' / (r 0.002/s))]", "The same of the yield term C1 only.", _ACTIVATED,
        source=_EYRING, formula="eyring", terms=_YIELD),
    formula="logarithm", parameter="rate_sensitivity", plausible=(0.003, 0.1),
    source="Roberts and Rowe (1985), Chem. Eng. Sci. 40, 4; Schmalbach et al. (2021), J. Mater. Res.",
    helps=(Need.SEVERAL_SIZES,),
    check="load at two rates or more within one class of sizes", coordinates=("peak", "rate", "stress_rate"),
)  # fmt: skip


class LoadingFactor(AbstractEffect):
    """One factor on the whole loading stress; a formula is the factor of a particle at a strain."""

    def loading(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Factors:
        factor = at_least(self.of(particle, strain))
        return factor, factor, factor


def _slenderness(particle: Particle, strain: Values) -> Values:
    """Contact radius over the height left between the platens, which does not fall below a tenth of D3."""
    return contact_radius(particle, strain) / at_least(particle.D3 - particle.displacement(strain), 0.1 * particle.D3)


def _slab(e: PlatenFriction, particle: Particle, strain: Values) -> Values:
    k = 2 * e.amplitude * _slenderness(particle, strain)
    k = jnp.where(k < 20, k, 20.0)
    small = jnp.abs(k) < 1e-2
    safe = jnp.where(small, 1.0, k)
    return jnp.where(small, 1 + k * (1 / 3 + k * (1 / 12 + k / 60)), 2 * (jnp.expm1(safe) - safe) / (safe * safe))


class PlatenFriction(LoadingFactor):
    """Constraint by friction at the platens, mostly of a disc of radius a and height h; the amplitude is mu."""

    formulas: ClassVar = {
        "siebel": lambda e, particle, eps: 1 + 2 / 3 * e.amplitude * _slenderness(particle, eps),
        "sphere": lambda e, p, eps: (
            1 + 2 / 3 * e.amplitude * contact_radius(p, eps) / p.displacement(at_least(1 - eps, 0.1))
        ),
        "exponential_hill": _slab,
        "sticking": lambda e, particle, eps: 1 + e.amplitude * _slenderness(particle, eps) ** 2,
        "strain": lambda e, _, eps: 1 + e.amplitude * eps,
    }


FRICTION = family(PlatenFriction, "platen_friction",
    "The platens hold the spreading contact back, so that the particle carries more the flatter it gets.",
    row("siebel", "sigma(eps) [1 + (2 mu / 3) a / h]",
        "Mean pressure of the friction hill on a disc of radius a and height h.", source="Siebel (1923)"),
    row("sphere", "sigma(eps) [1 + (2 mu / 3) a / (D_e (1 - eps))]",
        "The same over the height of a sphere of the particle's size: as if its shape played no part.",
        source="Siebel (1923)"),
    row("exponential_hill", "sigma(eps) 2 (e^k - k - 1) / k^2, k = 2 mu a / h",
        "The slab method with Coulomb friction.", source="Hosford and Caddell, Metal Forming, ch. 7"),
    row("sticking", "sigma(eps) [1 + mu (a / h)^2]",
        "The contact sticks; the constraint grows with the square of its slenderness.",
        source="Brizmer, Kligerman and Etsion (2006), Int. J. Solids Struct. 43, 5736; Zait et al. (2010)",
        plausible=(0.1 / 40, 0.1)),
    row("strain", "sigma(eps) (1 + mu eps)", "A constraint that grows with strain alone."),
    parameter="friction_coefficient", plausible=(0.4 / 40, 0.4), helps=(Need.SEVERAL_SHAPES, Need.SEVERAL_PEAKS),
    check="repeat with lubricated and with roughened platens", coordinates=("peak", "shape"),
)  # fmt: skip


class Hardening(AbstractEffect):
    """Hardening as a power of strain in place of flow at one stress; the amplitude is 1/m, 1 for Hertz.

    A formula is a logarithm, and the factor on the chosen terms its exponential to the power 1/2m. With `every_term`
    the terms of order j = 1, 3, 5 have the j-th power of that, as where a power of strain takes the place of strain.
    """

    terms: tuple[float, float, float] = (1.0, 1.0, 1.0)
    every_term: bool = eqx.field(static=True, default=False, kw_only=True)
    yield_strain: Any = None

    formulas: ClassVar = {
        "power": lambda e, eps: jnp.log(jnp.where(eps > 1e-9, eps, 1e-9) / REFERENCE_STRAIN),
        "ludwik": lambda e, eps: jnp.log1p(eps / e.yield_strain) - jnp.log1p(REFERENCE_STRAIN / e.yield_strain),
    }

    def loading(self, law: Formulas, particle: Particle, record: Record, strain: Values) -> Factors:
        factor = jnp.exp(0.5 * self.amplitude * self.of(strain))
        return (factor, factor**3, factor**5) if self.every_term else on_terms(self.terms, factor)


class HardeningAndLoad(Hardening):
    """The same exponent on the pressure that unloading releases."""

    def inside(self, context: Context) -> Values:
        half_inverse, share = 0.5 * self.amplitude, context.load_share
        moved = share * power(share, -half_inverse / (1 + half_inverse))
        return context.recoverable * (recovery(share) - recovery(jnp.where(moved < 1, moved, 1.0)))


class HardeningAndContact(Hardening):
    """The same exponent on the recovered share: to first order, an exponent 2 (1 + 1/2m) in place of 2 on unloading."""

    def inside(self, context: Context) -> Values:
        share = context.recovered_share
        return context.recoverable * (share - power(share, 1 / (1 + 0.5 * self.amplitude)))


_OLSSON = "Olsson and Larsson (2013)"

HARDENING = family(Hardening, "finite_hardening_exponent",
    "The material hardens as a power of strain instead of flowing at one stress: the curve bends the other way at low "
    "load.",
    row("linear_term", "C1 eta eps (eps / 0.2)^(1/2m)",
        "The similarity solution of a power-law contact in place of the linear term.", terms=_YIELD),
    row("all_terms", "sigma(eps) (eps / 0.2)^(1/2m)", "The power acts on the whole loading curve."),
    row("loading_and_unloading", "sigma(eps) (eps / 0.2)^(1/2m); on unloading u^(1/(1 + 1/2m)) for u",
        "The power acts on loading and on the pressure that unloading releases.", source=_OLSSON,
        make=HardeningAndLoad),
    row("linear_term_and_unloading", "C1 eta eps (eps / 0.2)^(1/2m); on unloading s^(1/(1 + 1/2m)) for s",
        "The similarity solution in place of the linear term, and to first order on unloading.",
        make=HardeningAndContact, terms=_YIELD),
    row("ludwik", "sigma(eps) [(1 + eps / eps_y) / (1 + 0.2 / eps_y)]^(1/2m)",
        "Hardening that begins at a yield strain.",
        Nuisance("yield_strain", (0.01, 0.05), (0.001, 0.3), "strain where hardening sets in"),
        source="Ludwik (1909); Swift (1952)", formula="ludwik"),
    row("every_term", "sigma(0.2 (eps / 0.2)^(1 + 1/2m))",
        "A power of strain in place of strain in every term; 1/m = 1 is an elastic contact after Hertz, "
        "ceramic pebbles show 1.2 to 1.6.", plausible=(0.02, 2.0), every_term=True),
    row("every_term_and_unloading", "sigma(0.2 (eps / 0.2)^(1 + 1/2m)); on unloading u^(1/(1 + 1/2m)) for u",
        "The same, and on the pressure that unloading releases.", source=_OLSSON, plausible=(0.02, 2.0),
        make=HardeningAndLoad, every_term=True),
    formula="power", parameter="inverse_exponent", plausible=(0.01, 0.5),
    source="Biwa and Storakers (1995); Storakers, Biwa and Larsson (1997), Int. J. Solids Struct. 34, 3061",
    helps=(Need.LOW_LOAD,), check="repeat between polished platens, or indent a compact of the same powder",
    coordinates=("peak", "load"),
)  # fmt: skip


class Toe(AbstractEffect):
    """Asperities that are flattened at low stress; the amplitude is their height over D_e.

    A formula is the share flattened at x = stress over the scale that flattens most of them. Those without an end are 1
    at x = 9: their amplitude is the height flattened per decade of stress. Asperities spring back only with `springs`.
    """

    stress_scale_MPa: Scalar
    springs: float = 0.0

    formulas: ClassVar = {
        "exponential": lambda e, x: -jnp.expm1(-x),
        "hyperbolic": lambda e, x: x / (1 + x),
        "logarithmic": lambda e, x: jnp.log1p(x) / jnp.log(10.0),
        "power": lambda e, x: jnp.expm1(0.25 * jnp.log1p(x)) / (10**0.25 - 1),
        "hertz": lambda e, x: jnp.where(x < 1, 3 * (jnp.cbrt(x + SMALL) ** 2 - SMALL ** (2 / 3)) - 2 * x, 1.0),
    }

    def inside(self, context: Context) -> Values:
        stress = pick(self.springs, context.stress, context.peak_stress)
        return self.amplitude * context.particle.displacement(self.of(stress / self.stress_scale_MPa))


_FLATTENING = (0.05, 0.1, 0.18, 0.3, 0.55, 1.0, 3.0)
"""Stresses [MPa]: rough cellulose up to 1, ceramic pebbles 3 and more, a twelfth of what crushes them."""

TOE = family(Toe, "toe_asperity",
    "Asperities are flattened before the particle itself carries load: a soft toe at the beginning.",
    row("exponential", "d = D_e d_t (1 - exp(-sigma_P / s))",
        "Asperities of exponentially distributed height; once flat they stay flat."),
    row("hyperbolic", "d = D_e d_t x / (1 + x), x = sigma_P / s", "The toe ends slowly."),
    row("logarithmic", "d = D_e d_t lg(1 + sigma_P / s)", "Asperities of all heights."),
    row("power", "d = D_e d_t ((1 + sigma_P / s)^(1/4) - 1) / (10^(1/4) - 1)",
        "A soft layer that gives way further and further, as a small power of stress.",
        source="Archard (1957), Proc. R. Soc. A 243, 190"),
    row("hertz", "d = D_e d_t (3 x^(2/3) - 2 x), x = sigma_P / s, up to x = 1",
        "No asperities: the contact is elastic, after Hertz, until it yields at the stress s and goes on with the "
        "slope it has there, that of the law.",
        source="Thornton and Ning (1998), Powder Technol. 99, 154; Johnson (1985), Contact Mechanics, ch. 6"),
    row("elastic", "d = D_e d_t (1 - exp(-sigma / s))", "The asperities spring back on unloading.",
        formula="exponential", springs=1.0),
    row("elastic_hyperbolic", "d = D_e d_t x / (1 + x), x = sigma / s",
        "A rough joint that closes and opens again, as the joints of rock do.",
        source="Bandis, Lumsden and Barton (1983), Int. J. Rock Mech. Min. Sci. 20, 249", formula="hyperbolic",
        springs=1.0),
    row("elastic_logarithmic", "d = D_e d_t lg(1 + sigma / s)", "Asperities of all heights that spring back.",
        source="Persson (2007), Phys. Rev. Lett. 99, 125502", formula="logarithmic", springs=1.0),
    parameter="toe_strain", plausible=(5e-4, 2e-2), needs=(Need.LOW_LOAD,), helps=(Need.RELOAD,),
    source="Greenwood and Williamson (1966), Proc. R. Soc. A 295, 300",
    nuisances=(Nuisance("stress_scale_MPa", _FLATTENING, (0.01, 20.0), "stress that flattens most of them"),),
    check="measure how rough particles and platens are; on a reload asperities stay flat", coordinates=("peak", "load"),
)  # fmt: skip


class Tilt(AbstractEffect):
    """Platens that are not parallel: the contact begins at one edge, and with `radius_share` the force levels them."""

    radius_share: Any = None
    shrinks: float = 0.0

    def inside(self, context: Context) -> Values:
        radius = pick(self.shrinks, context.contact_radius, context.peak_contact_radius)
        if self.radius_share is None:
            return self.amplitude * radius
        size = self.radius_share * context.particle.effective_diameter
        return -self.amplitude * size * jnp.expm1(-radius / size)


_LEVELLED = Nuisance("radius_share", (0.1, 0.3), (0.02, 2.0), "radius of levelling over D_e")

MISALIGNMENT = family(Tilt, "misalignment",
    "The platens are tilted against each other: the contact first closes a wedge.",
    row("edge", "d = alpha a_P", "The wedge under the contact's radius at the peak."),
    row("elastic", "d = alpha a", "The wedge opens again as the contact shrinks.", shrinks=1.0),
    row("levelling", "d = alpha a_c (1 - exp(-a_P / a_c)), a_c = share D_e", "The force levels the platens.",
        _LEVELLED),
    row("elastic_levelling", "d = alpha a_c (1 - exp(-a / a_c)), a_c = share D_e",
        "Platens levelled by the force tilt back as the contact shrinks.", _LEVELLED, shrinks=1.0),
    parameter="tilt_rad", unit="rad", plausible=(2e-3, 5e-2), needs=(Need.LOW_LOAD,),
    source="Zhang et al. (2006), Scripta Mater. 54, 181; Kiener, Motz and Dehm (2009), Mater. Sci. Eng. A 505, 79",
    check="turn the punch by 90 degrees, level the platens, and repeat", coordinates=("peak", "load", "size"),
)  # fmt: skip


class PopIn(AbstractEffect):
    """A sudden jump when stress first reaches a level; it never comes back."""

    location_MPa: Scalar
    gradual: float = 0.0
    per_diameter: float = 0.0
    softens: float = 0.0

    def inside(self, context: Context) -> Values:
        beyond = context.peak_stress / self.location_MPa - 1
        share = beyond / pick(self.gradual, 0.3, 0.02) + 0.5
        share = jnp.where(share < 1, positive(share), 1.0)
        jump = share * share * (3 - 2 * share)
        jump = pick(self.softens, jump + 0.5 * positive(beyond), jump)
        return self.amplitude * pick(self.per_diameter, context.particle.displacement(jump), jump)


POP_IN = family(PopIn, "pop_in",
    "Something breaks inside the particle at a certain load: the platen drops by a step, anywhere in a test.",
    row("sharp", "d = J H(sigma_P - sigma_j)", "A jump, in some tests or all, at a stress of its own in each."),
    row("gradual", "d = J S(sigma_P; sigma_j -+ 15 %)", "A break that takes a while.", gradual=1.0),
    row("strain", "d = J D_e H(sigma_P - sigma_j)", "A jump in proportion to the particle's size.",
        parameter="jump_strain", unit="-", plausible=(5e-4, 2e-2), per_diameter=1.0),
    row("with_softening", "d = J [H(sigma_P - sigma_j) + 0.5 (sigma_P / sigma_j - 1)+]",
        "A break after which the particle is softer.", softens=1.0),
    parameter="jump_um", unit="um", plausible=(0.1, 5.0),
    source="Antonyuk et al. (2005), Granular Matter 7, 29; Jonsson and Frenning (2016); Cooper et al. (2020)",
    nuisances=(Nuisance("location_MPa", (1.0, 2.0, 4.0, 7.0), (0.3, 16.0), "stress at which it breaks",
                        random_per_test=True),),
    check="watch the particle from the side, or listen to it, while the step occurs", coordinates=("peak",),
    sudden=True,
)  # fmt: skip
