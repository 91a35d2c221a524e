"""Effects on the law's parameters, from particle to particle and from peak to peak."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, Values, scalar
from ..formulas import Formulas, Plastic
from ..geometry import Particle
from .context import Context, positive
from .effect import AbstractEffect, AbstractModulusAtPeak, at_least
from .loading import ExponentialLocking, LockingFactor
from .record import REFERENCE_HUMIDITY_PERCENT, Record
from .variant import Mechanism, Need, Nuisance, Variant

REFERENCE_DIAMETER_UM = 200.0
REFERENCE_STRESS_MPA = 10.0
MIN_FACTOR = 0.05


def scaled(law: Formulas, first: Scalar, others: Scalar | None = None, modulus: Scalar | None = None) -> Formulas:
    """The law with its linear term, its cubic and quintic terms, and its modulus multiplied by factors > 0."""
    C1, C3, C5 = law.plastic.C1 * first, law.plastic.C3, law.plastic.C5
    if others is not None:
        C3, C5 = C3 * jnp.cbrt(others), C5 * others**0.2
    E = law.effective_modulus if modulus is None else law.effective_modulus * modulus
    return Formulas(Plastic(C1, C3, C5), law.a, E, law.unloading, law.strain_scaling)


class AbstractStrength(AbstractEffect):
    """One factor for the particle, on the chosen parameters."""

    terms: tuple[bool, bool, bool] = eqx.field(static=True, default=(True, False, False))  # C1, C3 and C5, modulus

    def factor(self, particle: Particle, record: Record) -> Scalar:
        """The factor."""
        raise NotImplementedError

    def modify(self, law: Formulas, particle: Particle, record: Record) -> Formulas:
        """The law with the factor on the chosen parameters."""
        factor = at_least(self.factor(particle, record), MIN_FACTOR)
        one = jnp.ones_like(factor)
        first, others, modulus = (factor if term else one for term in self.terms)
        return scaled(law, first, others, modulus)


# ---- size ------------------------------------------------------------------------------------------------------------


class SizePower(AbstractStrength):
    """Strength as a power of size."""

    closed: ClassVar[bool] = True
    mean_size: bool = eqx.field(static=True, default=False)

    def factor(self, particle: Particle, record: Record) -> Scalar:
        """(D / 200 um)^-n."""
        size = particle.mean_diameter if self.mean_size else particle.effective_diameter
        return jnp.exp(-self.amplitude * jnp.log(size / REFERENCE_DIAMETER_UM))


class SizeLogarithm(AbstractStrength):
    """Strength that falls with the logarithm of size."""

    closed: ClassVar[bool] = True

    def factor(self, particle: Particle, record: Record) -> Scalar:
        """1 - n ln(D / 200 um)."""
        return 1 - self.amplitude * jnp.log(particle.effective_diameter / REFERENCE_DIAMETER_UM)


class SizeGradient(AbstractStrength):
    """Strain-gradient hardening: more the smaller the particle."""

    closed: ClassVar[bool] = True

    def factor(self, particle: Particle, record: Record) -> Scalar:
        """sqrt(1 + 2n 200 um / D) / sqrt(1 + 2n)."""
        grown = at_least(1 + 2 * self.amplitude * REFERENCE_DIAMETER_UM / particle.effective_diameter, MIN_FACTOR)
        return jnp.sqrt(grown / at_least(1 + 2 * self.amplitude, MIN_FACTOR))


def _size(name: str, make: type[AbstractEffect], equation: str, explanation: str, source: str, **fixed: Any) -> Variant:
    return Variant(
        "size_effect", name, make, "size_exponent", "-", 0, (0.05, 1.5), equation, explanation, source,
        needs=(Need.SEVERAL_SIZES,), fixed=fixed,
    )  # fmt: skip


_COOPER = "Nix and Gao (1998), J. Mech. Phys. Solids 46, 411; Cooper et al. (2020), Powder Technol. 374, 10"
_ALL, _WHOLE = (True, True, False), (True, True, True)

SIZE = Mechanism(
    "size_effect",
    "Small particles are stronger than large ones of the same material (or weaker, if they are more porous).",
    (
        _size("C1", SizePower, "C1 (D_e / 200 um)^-n", "The yield term depends on size.", _COOPER),
        _size("flow", SizePower, "sigma(eps) (D_e / 200 um)^-n", "The whole loading curve depends on size.", _COOPER,
              terms=_ALL),
        _size("C1_and_modulus", SizePower, "C1 and E (D_e / 200 um)^-n", "Yield and stiffness depend on size.", _COOPER,
              terms=(True, False, True)),
        _size("flow_and_modulus", SizePower, "sigma(eps) and E (D_e / 200 um)^-n",
              "Everything depends on size, as with porosity that differs from sieve cut to sieve cut.", _COOPER,
              terms=_WHOLE),
        _size("flow_mean_diameter", SizePower, "sigma(eps) (mean diameter / 200 um)^-n",
              "Size is the mean of the three diameters, not D1 D2 / D3.", _COOPER, terms=_ALL, mean_size=True),
        _size("flow_logarithm", SizeLogarithm, "sigma(eps) [1 - n ln(D_e / 200 um)]", "Logarithmic in size.",
              "first-order form", terms=_ALL),
        _size("strain_gradient", SizeGradient, "sigma(eps) sqrt[(1 + 2n 200 um / D_e) / (1 + 2n)]",
              "Geometrically necessary dislocations, or any length of the material's own.", _COOPER, terms=_ALL),
    ),
    ("rate_dependence, at one force rate",),
    check="test sieved classes of size, each at the rate that strains it as fast as the others",
    coordinates=("size", "peak"),
)  # fmt: skip


# ---- shape -----------------------------------------------------------------------------------------------------------


class AbstractShape(AbstractEffect):
    r"""A second-order shape factor: it multiplies :math:`\eta_p`.

    Written as factors on coefficients, :math:`C_j \to C_j g`, and on the modulus, :math:`\bar E \to \bar E g^p` (half
    of p in the punch forms) with p of the `StrainScaling`; so it acts in the same way on the law of a fit, whose
    coefficients have taken in the shape factor and whose `a` is 0.
    """

    closed: ClassVar[bool] = True

    def factor(self, particle: Particle) -> Scalar:
        """The factor on the shape factor."""
        raise NotImplementedError

    def modify(self, law: Formulas, particle: Particle, record: Record) -> Formulas:
        """Coefficients and modulus with the factor."""
        g = at_least(self.factor(particle), MIN_FACTOR)
        power = law.strain_scaling.power / law.unloading.stress_power
        plastic = Plastic(law.plastic.C1 * g, law.plastic.C3 * g, law.plastic.C5 * g)
        return Formulas(plastic, law.a, law.effective_modulus * g**power, law.unloading, law.strain_scaling)


class SquaredFlatness(AbstractShape):
    """Curvature of the dependence on flatness."""

    def factor(self, particle: Particle) -> Scalar:
        """1 + b q^2."""
        return 1 + self.amplitude * particle.flatness**2


class ExponentialFlatness(AbstractShape):
    """The same, never negative."""

    def factor(self, particle: Particle) -> Scalar:
        """exp(b q^2)."""
        return jnp.exp(self.amplitude * particle.flatness**2)


class CubedFlatness(AbstractShape):
    """Skewness of the dependence on flatness."""

    def factor(self, particle: Particle) -> Scalar:
        """1 + b q^3."""
        return 1 + self.amplitude * particle.flatness**3


class InPlaneAspect(AbstractShape):
    """Elongation in the plane of the platens."""

    def factor(self, particle: Particle) -> Scalar:
        """1 + c ln^2(D1 / D2)."""
        return 1 + self.amplitude * jnp.log(particle.D1 / particle.D2) ** 2


class Upright(AbstractShape):
    """Logarithm of the aspect ratio across the platens, squared."""

    def factor(self, particle: Particle) -> Scalar:
        """1 + c ln^2(D3^2 / (D1 D2))."""
        return 1 + self.amplitude * jnp.log(particle.D3**2 / (particle.D1 * particle.D2)) ** 2


def _shape(name: str, make: type[AbstractEffect], equation: str, explanation: str) -> Variant:
    return Variant(
        "shape_second_order", name, make, "shape_coefficient", "-", 0, (0.05, 2.0), equation, explanation,
        "Bommireddy et al. (2018), eq. 13, taken to the next order; Zheng et al. (2013)", needs=(Need.SEVERAL_SHAPES,),
    )  # fmt: skip


SHAPE = Mechanism(
    "shape_second_order",
    "The shape factor is not linear in flatness, or the outline in the plane of the platens matters, too.",
    (
        _shape("flatness_squared", SquaredFlatness, "eta_p (1 + b q^2), q = 1 - D3^2/(D1 D2)",
               "The next term in flatness."),
        _shape("flatness_exponential", ExponentialFlatness, "eta_p exp(b q^2)", "The same, never negative."),
        _shape("flatness_cubed", CubedFlatness, "eta_p (1 + b q^3)", "The term after that."),
        _shape("in_plane_aspect", InPlaneAspect, "eta_p [1 + c ln^2(D1 / D2)]",
               "An elongated outline; symmetric in D1 and D2."),
        _shape("upright_aspect", Upright, "eta_p [1 + c ln^2(D3^2 / (D1 D2))]",
               "Flat and upright particles alike deviate from spheres."),
    ),
    ("shape parameter a and mean coefficients, if all particles have one shape",),
    check="test elongated particles both lying and standing",
    coordinates=("shape", "outline"),
)  # fmt: skip


# ---- humidity --------------------------------------------------------------------------------------------------------


class Humidity(AbstractStrength):
    """Water softens exponentially."""

    def factor(self, particle: Particle, record: Record) -> Scalar:
        """exp(-k (RH - 45 %))."""
        return jnp.exp(-self.amplitude * (record.relative_humidity - REFERENCE_HUMIDITY_PERCENT))


class TwoRateHumidity(Humidity):
    """Water softens yield and elasticity, each at a rate of its own."""

    modulus_share: Scalar = eqx.field(converter=scalar, kw_only=True)

    def modify(self, law: Formulas, particle: Particle, record: Record) -> Formulas:
        """C1 exp(-k (RH - 45 %)) and E exp(-r k (RH - 45 %))."""
        first = at_least(self.factor(particle, record), MIN_FACTOR)
        return scaled(law, first, jnp.ones_like(first), first**self.modulus_share)


class LinearHumidity(AbstractStrength):
    """Water softens in proportion."""

    def factor(self, particle: Particle, record: Record) -> Scalar:
        """1 - k (RH - 45 %)."""
        return 1 - self.amplitude * (record.relative_humidity - REFERENCE_HUMIDITY_PERCENT)


class ThresholdHumidity(AbstractStrength):
    """Water softens beyond a threshold."""

    threshold_percent: Scalar = eqx.field(converter=scalar, kw_only=True)

    def factor(self, particle: Particle, record: Record) -> Scalar:
        """exp(-k (RH - RH_0)), 1 below RH_0."""
        return jnp.exp(-self.amplitude * positive(record.relative_humidity - self.threshold_percent))


def _humidity(name: str, make: type[AbstractEffect], equation: str, explanation: str, **more: Any) -> Variant:
    return Variant(
        "humidity", name, make, "softening_per_percent_humidity", "1/%", 1, (5e-4, 2e-2), equation, explanation,
        "Amidon and Houghton (1995), Pharm. Res. 12, 923", needs=(Need.HUMIDITY_COLUMN,), **more,
    )  # fmt: skip


HUMIDITY = Mechanism(
    "humidity",
    "Water in the particle softens it: in humid air it deforms under less stress.",
    (
        _humidity("C1_and_modulus", TwoRateHumidity, "C1 exp(-k (RH - 45)) and E exp(-r k (RH - 45))",
                  "The yield term softens, and the modulus with it.",
                  nuisances=(Nuisance("modulus_share", (0.5, 1.0), (0.0, 3.0), "rate of E over that of C1"),)),
        _humidity("C1", Humidity, "C1 exp(-k (RH - 45))", "The yield term softens."),
        _humidity("flow", Humidity, "sigma(eps) exp(-k (RH - 45))", "The whole loading curve softens.",
                  fixed={"terms": _ALL}),
        _humidity("modulus", Humidity, "E exp(-k (RH - 45))", "Only the elastic modulus softens.",
                  fixed={"terms": (False, False, True)}),
        _humidity("flow_and_modulus", Humidity, "sigma(eps) and E exp(-k (RH - 45))", "Everything softens.",
                  fixed={"terms": _WHOLE}),
        _humidity("flow_linear", LinearHumidity, "sigma(eps) [1 - k (RH - 45)]", "Softening in proportion.",
                  fixed={"terms": _ALL}),
        _humidity("flow_threshold", ThresholdHumidity, "sigma(eps) exp(-k (RH - RH_0)) above RH_0",
                  "Nothing happens until about 5 % of water is taken up.", fixed={"terms": _ALL},
                  nuisances=(Nuisance("threshold_percent", (40.0, 60.0), (5.0, 90.0), "humidity where it begins"),)),
    ),
    check="test in a chamber at 10, 40 and 75 % relative humidity",
    coordinates=("humidity", "peak"),
)  # fmt: skip


# ---- modulus against peak --------------------------------------------------------------------------------------------


class ModulusStrain(AbstractModulusAtPeak):
    """Modulus that changes with the largest strain; `direction` is -1 for damage, +1 for densification."""

    direction: float = eqx.field(static=True, default=-1.0)
    form: str = eqx.field(static=True, default="exponential")

    def factor(self, strain: Values, stress: Values) -> Values:
        """The factor of the form at x = eps_P (or 2 eps_P^2, or sigma_P / 10 MPa)."""
        variable = {"square": 2 * strain * strain, "stress": stress / REFERENCE_STRESS_MPA}.get(self.form, strain)
        x = self.direction * self.amplitude * variable
        if self.form == "linear":
            return at_least(1 + x, MIN_FACTOR)
        if self.form == "rational":
            return 1 / at_least(1 - x, MIN_FACTOR)
        if self.form == "squared":
            return at_least(1 + x / 2, MIN_FACTOR) ** 2
        return jnp.exp(x)


class ThresholdDamage(AbstractModulusAtPeak):
    """Damage that begins at a strain."""

    threshold_strain: Scalar = eqx.field(converter=scalar)

    def factor(self, strain: Values, stress: Values) -> Values:
        """exp(-kappa (eps_P - eps_0)), 1 below eps_0."""
        return jnp.exp(-self.amplitude * positive(strain - self.threshold_strain))


class CyclicDamage(AbstractEffect):
    """Damage by every reload."""

    def stiffness(self, context: Context) -> Values:
        """1 / (1 + kappa N)."""
        return 1 / at_least(1 + self.amplitude * context.cycles, MIN_FACTOR)


class PorosityStiffening(AbstractModulusAtPeak):
    """Pores that close as stress grows; the amplitude multiplies the porosity lost."""

    heckel_stress_MPa: Scalar = eqx.field(converter=scalar)

    def factor(self, strain: Values, stress: Values) -> Values:
        """exp(b (1 - exp(-sigma_P / sigma_H)))."""
        return jnp.exp(-self.amplitude * jnp.expm1(-stress / self.heckel_stress_MPa))


class RelativeDensity(AbstractModulusAtPeak):
    """A power of relative density, which grows as the particle is squeezed."""

    def factor(self, strain: Values, stress: Values) -> Values:
        """(1 - eps_P / 2)^-b."""
        return jnp.exp(-self.amplitude * jnp.log(at_least(1 - strain / 2, MIN_FACTOR)))


def _damage(name: str, make: type[AbstractEffect], equation: str, explanation: str, **more: Any) -> Variant:
    return Variant(
        "damage", name, make, "damage_rate", "-", 1, (0.05, 4.0), equation, explanation,
        "Lemaitre (1985), J. Eng. Mater. Technol. 107, 83",
        **{"needs": (Need.UNLOADING, Need.SEVERAL_PEAKS), "helps": (Need.RELOAD,), **more},
    )  # fmt: skip


DAMAGE = Mechanism(
    "damage",
    "Bonds break while the particle is squeezed: the further it went, the softer it unloads.",
    (
        _damage("exponential", ModulusStrain, "E exp(-kappa eps_P)", "A share of the bonds breaks per unit of strain."),
        _damage("linear", ModulusStrain, "E (1 - kappa eps_P)", "Damage in proportion to strain.",
                fixed={"form": "linear"}),
        _damage("rational", ModulusStrain, "E / (1 + kappa eps_P)", "The compliance of cracks is added.",
                fixed={"form": "rational"}),
        _damage("square", ModulusStrain, "E exp(-2 kappa eps_P^2)", "Damage that sets in late.",
                fixed={"form": "square"}),
        _damage("stress", ModulusStrain, "E exp(-kappa sigma_P / 10 MPa)", "Damage driven by stress.",
                fixed={"form": "stress"}),
        _damage("threshold", ThresholdDamage, "E exp(-kappa (eps_P - eps_0)) above eps_0",
                "No damage until a strain is reached.",
                nuisances=(Nuisance("threshold_strain", (0.15, 0.3), (0.0, 0.6), "strain where damage begins"),)),
        _damage("cyclic", CyclicDamage, "E / (1 + kappa N)", "Every reload breaks some bonds more.",
                needs=(Need.RELOAD,), helps=(Need.SECOND_RELOAD,)),
    ),
    ("densification_stiffening with a negative amplitude",),
    check="cycle one particle to rising peaks: from peak to peak it unloads softer",
    coordinates=("peak", "cycles"),
    opposite="densification_stiffening",
)  # fmt: skip


def _dense(name: str, make: type[AbstractEffect], equation: str, explanation: str, source: str, **more: Any) -> Variant:
    return Variant(
        "densification_stiffening", name, make, "stiffening", "-", 1, (0.05, 4.0), equation, explanation, source,
        **{"needs": (Need.UNLOADING, Need.SEVERAL_PEAKS), "helps": (Need.RELOAD,), **more},
    )  # fmt: skip


DENSIFICATION = Mechanism(
    "densification_stiffening",
    "Pores close while the particle is squeezed: the further it went, the stiffer it is.",
    (
        _dense("exponential", ModulusStrain, "E exp(b eps_P)", "Porosity falls with strain; E = E_0 exp(-b p).",
               "Spriggs (1961), J. Am. Ceram. Soc. 44, 628", fixed={"direction": 1.0}),
        _dense("linear", ModulusStrain, "E (1 + b eps_P)", "The modulus grows in proportion to strain.",
               "first-order form", fixed={"direction": 1.0, "form": "linear"}),
        _dense("cellular", ModulusStrain, "E (1 + b eps_P / 2)^2", "The square of a density that grows with strain.",
               "Gibson and Ashby (1982), Proc. R. Soc. A 382, 43", fixed={"direction": 1.0, "form": "squared"}),
        _dense("relative_density", RelativeDensity, "E (1 - eps_P / 2)^-b", "A power of relative density.",
               "Gibson and Ashby (1982)"),
        _dense("square", ModulusStrain, "E exp(2 b eps_P^2)", "Stiffening that sets in late.", "late form",
               fixed={"direction": 1.0, "form": "square"}),
        _dense("stress", ModulusStrain, "E exp(b sigma_P / 10 MPa)", "Stiffening driven by stress.",
               "Schmalbach et al. (2021)", fixed={"direction": 1.0, "form": "stress"}),
        _dense("heckel", PorosityStiffening, "E exp[b (1 - exp(-sigma_P / sigma_H))]",
               "Pores close as Heckel found for tablets, and the modulus follows.",
               "Heckel (1961); Spriggs (1961)",
               nuisances=(Nuisance("heckel_stress_MPa", (3.0, 10.0), (0.5, 100.0), "stress that closes most pores"),)),
        _dense("locking", LockingFactor, "sigma(eps) [1 + b (eps / 0.5)^n]",
               "Loading itself stiffens at large strain, where walls of pores meet.",
               "Rusch (1969), J. Appl. Polym. Sci. 13, 2297; Gibson and Ashby (1997), Cellular Solids, ch. 5",
               needs=(), helps=(Need.SEVERAL_PEAKS,),
               nuisances=(Nuisance("exponent", (4.0, 8.0), (2.0, 16.0), "power of strain"),)),
        _dense("locking_exponential", ExponentialLocking, "sigma(eps) [1 + b (e^(k eps) - 1 - k eps) / (at eps = 0.5)]",
               "The same, exponential in strain.", "Gibson and Ashby (1997), Cellular Solids, ch. 5", needs=(),
               helps=(Need.SEVERAL_PEAKS,),
               nuisances=(Nuisance("exponent", (6.0, 15.0), (1.0, 40.0), "growth per strain"),)),
    ),
    ("damage with a negative amplitude",),
    check="cycle one particle to rising peaks, its porosity measured by tomography before and after",
    coordinates=("peak",),
    opposite="damage",
)  # fmt: skip
