"""Effects on the law's parameters, from particle to particle and from peak to peak."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from .._types import Scalar, Values
from ..formulas import Formulas, Plastic
from ..geometry import Particle
from .effect import AbstractEffect, AbstractModulusAtPeak, at_least, on_terms, pick
from .loading import LoadingFactor
from .record import REFERENCE_HUMIDITY_PERCENT, Context, Record, positive, power
from .variant import OWN, Need, Nuisance, family, row

REFERENCE_DIAMETER_UM = 200.0
REFERENCE_STRESS_MPA = 10.0
LOCKING_STRAIN = 0.5
WATER = 0.036, 12.0, 0.75  # isotherm of microcrystalline cellulose: monolayer [-], binding, multilayers (this work)
GLASS_K = 493.0, 136.0  # glass transitions of dry cellulose (assumed) and of water [K]
GORDON_TAYLOR = 1.55 * 493.0 / (1.0 * 136.0)  # rho T_g of cellulose over that of water (rule of Simha and Boyer)
SIGMOID_WIDTH = 8.0  # percent of relative humidity (this work)


def scaled(law: Formulas, first: Scalar, others: Scalar, modulus: Scalar) -> Formulas:
    """The law with its linear term, its cubic and quintic terms, and its modulus multiplied by factors > 0."""
    C = law.plastic
    plastic = Plastic(C.C1 * first, C.C3 * jnp.cbrt(others), C.C5 * others**0.2)
    return replace(law, plastic=plastic, effective_modulus=law.effective_modulus * modulus)


class Strength(AbstractEffect):
    """One factor for the particle and its test, the formula, on the chosen parameters: C1; C3 and C5; the modulus."""

    terms: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def modify(self, law: Formulas, particle: Particle, record: Record) -> Formulas:
        return scaled(law, *on_terms(self.terms, at_least(self.of(particle, record))))


_FLOW, _MODULUS, _WHOLE = (1.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0)


def _size_power(e: SizeEffect, particle: Particle, _: Record) -> Scalar:
    size = pick(e.mean_size, particle.mean_diameter, particle.effective_diameter)
    return jnp.exp(-e.amplitude * jnp.log(size / REFERENCE_DIAMETER_UM))


def _gradient(e: SizeEffect, particle: Particle, _: Record) -> Scalar:
    grown = at_least(1 + e.amplitude / particle.effective_diameter)
    return jnp.sqrt(grown / at_least(1 + e.amplitude / REFERENCE_DIAMETER_UM))


class SizeEffect(Strength):
    """Strength that depends on size, D_e or with `mean_size` the mean diameter."""

    closed: ClassVar[bool] = True
    mean_size: float = 0.0

    formulas: ClassVar = {
        "power": _size_power,
        "logarithm": lambda e, p, _: 1 - e.amplitude * jnp.log(p.effective_diameter / REFERENCE_DIAMETER_UM),
        "gradient": _gradient,
    }


SIZE = family(SizeEffect, "size_effect",
    "Small particles are stronger than large ones of the same material (or weaker, if they are more porous).",
    row("C1", "C1 (D_e / 200 um)^-n", "The yield term depends on size."),
    row("flow", "sigma(eps) (D_e / 200 um)^-n", "The whole loading curve depends on size.", terms=_FLOW),
    row("C1_and_modulus", "C1 and E (D_e / 200 um)^-n", "Yield and stiffness depend on size.", terms=(1.0, 0.0, 1.0)),
    row("flow_and_modulus", "sigma(eps) and E (D_e / 200 um)^-n",
        "Everything depends on size, as with porosity that differs from sieve cut to sieve cut.", terms=_WHOLE),
    row("flow_mean_diameter", "sigma(eps) (mean diameter / 200 um)^-n",
        "Size is the mean of the three diameters, not D1 D2 / D3.", terms=_FLOW, mean_size=1.0),
    row("flow_logarithm", "sigma(eps) [1 - n ln(D_e / 200 um)]", "Logarithmic in size.", source=OWN,
        formula="logarithm", terms=_FLOW),
    row("strain_gradient", "sigma(eps) sqrt[(1 + l / D_e) / (1 + l / 200 um)]",
        "Geometrically necessary dislocations, or any length of the material's own.", formula="gradient", terms=_FLOW,
        parameter="length_um", unit="um", sign=1, plausible=(20.0, 600.0)),
    formula="power", parameter="size_exponent", sign=0, plausible=(0.05, 1.5), needs=(Need.SEVERAL_SIZES,),
    source="Nix and Gao (1998), J. Mech. Phys. Solids 46, 411; Cooper et al. (2020), Powder Technol. 374, 10",
    check="test sieved classes of size, each at the rate that strains it as fast as the others",
    coordinates=("size", "peak"),
)  # fmt: skip


class SecondOrderShape(AbstractEffect):
    r"""A second-order shape factor: a formula is what multiplies :math:`\eta_p`.

    Written as factors on coefficients, :math:`C_j \to C_j g`, and on the modulus, :math:`\bar E \to \bar E g^p` (half
    of p in the punch forms) with p of the `StrainScaling`; so it acts in the same way on the law of a fit, whose
    coefficients have taken in the shape factor and whose `a` is 0.
    """

    closed: ClassVar[bool] = True

    formulas: ClassVar = {
        "flatness_squared": lambda e, p: 1 + e.amplitude * p.flatness**2,
        "flatness_exponential": lambda e, p: jnp.exp(e.amplitude * p.flatness**2),
        "flatness_cubed": lambda e, p: 1 + e.amplitude * p.flatness**3,
        "in_plane_aspect": lambda e, p: 1 + e.amplitude * jnp.log(p.D1 / p.D2) ** 2,
        "upright_aspect": lambda e, p: 1 + e.amplitude * jnp.log(p.D3**2 / (p.D1 * p.D2)) ** 2,
    }

    def modify(self, law: Formulas, particle: Particle, record: Record) -> Formulas:
        g = at_least(self.of(particle))
        power = law.strain_scaling.power / law.unloading.stress_power
        plastic = Plastic(law.plastic.C1 * g, law.plastic.C3 * g, law.plastic.C5 * g)
        return replace(law, plastic=plastic, effective_modulus=law.effective_modulus * g**power)


SHAPE = family(SecondOrderShape, "shape_second_order",
    "The shape factor is not linear in flatness, or the outline in the plane of the platens matters, too.",
    row("flatness_squared", "eta_p (1 + b q^2), q = 1 - D3^2/(D1 D2)", "The next term in flatness."),
    row("flatness_exponential", "eta_p exp(b q^2)", "The same, never negative."),
    row("flatness_cubed", "eta_p (1 + b q^3)", "The term after that."),
    row("in_plane_aspect", "eta_p [1 + c ln^2(D1 / D2)]", "An elongated outline; symmetric in D1 and D2."),
    row("upright_aspect", "eta_p [1 + c ln^2(D3^2 / (D1 D2))]",
        "Flat and upright particles alike deviate from spheres."),
    parameter="shape_coefficient", sign=0, plausible=(0.05, 2.0), needs=(Need.SEVERAL_SHAPES,),
    source="Bommireddy et al. (2018), eq. 13, taken to the next order; Zheng et al. (2013)",
    check="test elongated particles both lying and standing", coordinates=("shape", "outline"),
)  # fmt: skip


def _water(humidity_percent: Any) -> Any:
    """Water over dry mass at a relative humidity [%], isotherm of Guggenheim, Anderson and de Boer."""
    x = WATER[2] * humidity_percent / 100
    return WATER[0] * WATER[1] * x / ((1 - x) * (1 - x + WATER[1] * x))


def _glass(humidity_percent: Any) -> Any:
    """Glass transition of cellulose with the water it takes up [K], after Gordon and Taylor."""
    water = GORDON_TAYLOR * _water(humidity_percent)
    return (GLASS_K[0] + water * GLASS_K[1]) / (1 + water)


def _sigmoid(e: Humidity, humidity_percent: Any) -> Any:
    return jax.nn.sigmoid((humidity_percent - e.middle_percent) / SIGMOID_WIDTH)


class Humidity(Strength):
    """Water softens the particle; with a `modulus_share` the modulus at so many times the rate of C1."""

    modulus_share: Any = None
    threshold_percent: Any = None
    middle_percent: Any = None

    formulas: ClassVar = {
        "exponential": lambda e, _, r: jnp.exp(-e.amplitude * (r.relative_humidity - REFERENCE_HUMIDITY_PERCENT)),
        "linear": lambda e, _, r: 1 - e.amplitude * (r.relative_humidity - REFERENCE_HUMIDITY_PERCENT),
        "threshold": lambda e, _, r: jnp.exp(-e.amplitude * positive(r.relative_humidity - e.threshold_percent)),
        "glass_transition": lambda e, _, r: jnp.exp(
            e.amplitude * (_glass(r.relative_humidity) - _glass(REFERENCE_HUMIDITY_PERCENT))
        ),
        "sigmoid": lambda e, _, r: (
            1 - e.amplitude * (_sigmoid(e, r.relative_humidity) - _sigmoid(e, REFERENCE_HUMIDITY_PERCENT))
        ),
    }

    def modify(self, law: Formulas, particle: Particle, record: Record) -> Formulas:
        if self.modulus_share is None:
            return super().modify(law, particle, record)
        first = at_least(self.of(particle, record))
        return scaled(law, first, jnp.ones_like(first), first**self.modulus_share)


HUMIDITY = family(Humidity, "humidity",
    "Water in the particle softens it: in humid air it deforms under less stress.",
    row("C1_and_modulus", "C1 exp(-k (RH - 45)) and E exp(-r k (RH - 45))",
        "The yield term softens, and the modulus with it.",
        Nuisance("modulus_share", (0.5, 1.0), (0.0, 3.0), "rate of E over that of C1")),
    row("C1", "C1 exp(-k (RH - 45))", "The yield term softens."),
    row("flow", "sigma(eps) exp(-k (RH - 45))", "The whole loading curve softens.", terms=_FLOW),
    row("modulus", "E exp(-k (RH - 45))", "Only the elastic modulus softens.", terms=_MODULUS),
    row("flow_and_modulus", "sigma(eps) and E exp(-k (RH - 45))", "Everything softens.", terms=_WHOLE),
    row("flow_linear", "sigma(eps) [1 - k (RH - 45)]", "Softening in proportion.", formula="linear", terms=_FLOW),
    row("flow_threshold", "sigma(eps) exp(-k (RH - RH_0)) above RH_0",
        "Nothing happens until about 5 % of water is taken up.",
        Nuisance("threshold_percent", (40.0, 60.0), (5.0, 90.0), "humidity where it begins"), formula="threshold",
        terms=_FLOW),
    row("flow_glass_transition", "sigma(eps) exp(k (T_g(RH) - T_g(45)))",
        "Water lowers the glass transition of the amorphous part; strength follows the distance to it.",
        source="Gordon and Taylor (1952), J. Appl. Chem. 2, 493; Simha and Boyer (1962), J. Chem. Phys. 37, 1003; "
               "isotherm of about 5 % at 50 % (this work)", formula="glass_transition", terms=_FLOW,
        parameter="softening_per_kelvin", unit="1/K", plausible=(2e-4, 1e-2)),
    row("flow_sigmoid", "sigma(eps) [1 - k (S(RH) - S(45))], S = 1 / (1 + exp((RH_m - RH) / 8))",
        "Strength falls from one level to another around a humidity.",
        Nuisance("middle_percent", (45.0, 60.0, 75.0), (10.0, 95.0), "humidity half way"),
        source="Peleg (1994), J. Texture Stud. 25, 403", formula="sigmoid", terms=_FLOW, parameter="softened_share",
        unit="-", plausible=(0.02, 0.9)),
    formula="exponential", parameter="softening_per_percent_humidity", unit="1/%", plausible=(5e-4, 2e-2),
    source="Amidon and Houghton (1995), Pharm. Res. 12, 923", needs=(Need.HUMIDITY_COLUMN,),
    check="test in a chamber at 10, 40 and 75 % relative humidity", coordinates=("humidity", "peak"),
)  # fmt: skip


class Damage(AbstractModulusAtPeak):
    """Modulus that changes with the largest strain eps_P or the stress there; a formula is its factor."""

    direction: ClassVar[float] = -1.0

    threshold_strain: Any = None
    heckel_stress_MPa: Any = None

    formulas: ClassVar = {
        "exponential": lambda e, eps, _: jnp.exp(e.signed * eps),
        "linear": lambda e, eps, _: at_least(1 + e.signed * eps),
        "rational": lambda e, eps, _: 1 / at_least(1 - e.signed * eps),
        "cellular": lambda e, eps, _: at_least(1 + e.signed * eps / 2) ** 2,
        "square": lambda e, eps, _: jnp.exp(e.signed * (2 * eps * eps)),
        "stress": lambda e, _, sigma: jnp.exp(e.signed * (sigma / REFERENCE_STRESS_MPA)),
        "threshold": lambda e, eps, _: jnp.exp(-e.amplitude * positive(eps - e.threshold_strain)),
        "relative_density": lambda e, eps, _: jnp.exp(-e.amplitude * jnp.log(at_least(1 - eps / 2))),
        "heckel": lambda e, _, sigma: jnp.exp(-e.amplitude * jnp.expm1(-sigma / e.heckel_stress_MPa)),
    }

    @property
    def signed(self) -> Scalar:
        return self.direction * self.amplitude


class Densification(Damage):
    """The same where the modulus grows; of "heckel" the amplitude multiplies the porosity lost."""

    direction: ClassVar[float] = 1.0


class CyclicDamage(AbstractEffect):
    """Damage by every reload."""

    def stiffness(self, context: Context) -> Values:
        return 1 / at_least(1 + self.amplitude * context.cycles)


# Largest plausible amplitudes that differ below change the modulus by the same factor at a strain of 0.35, about 4.

DAMAGE = family(Damage, "damage",
    "Bonds break while the particle is squeezed: the further it went, the softer it unloads.",
    row("exponential", "E exp(-kappa eps_P)", "A share of the bonds breaks per unit of strain."),
    row("linear", "E (1 - kappa eps_P)", "Damage in proportion to strain."),
    row("rational", "E / (1 + kappa eps_P)", "The compliance of cracks is added.", plausible=(0.05, 9.0)),
    row("square", "E exp(-2 kappa eps_P^2)", "Damage that sets in late.", plausible=(0.05, 6.0)),
    row("stress", "E exp(-kappa sigma_P / 10 MPa)", "Damage driven by stress."),
    row("threshold", "E exp(-kappa (eps_P - eps_0)) above eps_0", "No damage until a strain is reached.",
        Nuisance("threshold_strain", (0.15, 0.3), (0.0, 0.6), "strain where damage begins")),
    row("cyclic", "E / (1 + kappa N)", "Every reload breaks some bonds more.", make=CyclicDamage, needs=(Need.RELOAD,),
        helps=(Need.SECOND_RELOAD,)),
    parameter="damage_rate", plausible=(0.05, 4.0), source="Lemaitre (1985), J. Eng. Mater. Technol. 107, 83",
    needs=(Need.UNLOADING, Need.SEVERAL_PEAKS), helps=(Need.RELOAD,),
    check="cycle one particle to rising peaks: from peak to peak it unloads softer", coordinates=("peak", "cycles"),
    opposite="densification_stiffening",
)  # fmt: skip


def _locking_exponential(e: Locking, _: Particle, strain: Values) -> Values:
    at, most = e.exponent * strain, e.exponent * LOCKING_STRAIN
    return 1 + e.amplitude * (jnp.expm1(at) - at) / (jnp.expm1(most) - most)


class Locking(LoadingFactor):
    """Pores that close up: little at small strain, steep at large."""

    exponent: Any = None

    formulas: ClassVar = {
        "locking": lambda e, _, eps: 1 + e.amplitude * power(eps / LOCKING_STRAIN, e.exponent),
        "locking_exponential": _locking_exponential,
    }


_FOAM = "Gibson and Ashby (1997), Cellular Solids, ch. 5"
_LOADING = {"make": Locking, "needs": (), "helps": (Need.SEVERAL_PEAKS,)}

DENSIFICATION = family(Densification, "densification_stiffening",
    "Pores close while the particle is squeezed: the further it went, the stiffer it is.",
    row("exponential", "E exp(b eps_P)", "Porosity falls with strain; E = E_0 exp(-b p).",
        source="Spriggs (1961), J. Am. Ceram. Soc. 44, 628"),
    row("linear", "E (1 + b eps_P)", "The modulus grows in proportion to strain.", plausible=(0.05, 9.0)),
    row("cellular", "E (1 + b eps_P / 2)^2", "The square of a density that grows with strain.",
        source="Gibson and Ashby (1982), Proc. R. Soc. A 382, 43", plausible=(0.05, 6.0)),
    row("relative_density", "E (1 - eps_P / 2)^-b", "A power of relative density.", source="Gibson and Ashby (1982)",
        plausible=(0.05, 8.0)),
    row("square", "E exp(2 b eps_P^2)", "Stiffening that sets in late.", plausible=(0.05, 6.0)),
    row("stress", "E exp(b sigma_P / 10 MPa)", "Stiffening driven by stress.", source="Schmalbach et al. (2021)"),
    row("heckel", "E exp[b (1 - exp(-sigma_P / sigma_H))]",
        "Pores close as Heckel found for tablets, and the modulus follows.",
        Nuisance("heckel_stress_MPa", (3.0, 10.0), (0.5, 100.0), "stress that closes most pores"),
        source="Heckel (1961); Spriggs (1961)"),
    row("locking", "sigma(eps) [1 + b (eps / 0.5)^n]",
        "Loading itself stiffens at large strain, where walls of pores meet.",
        Nuisance("exponent", (4.0, 8.0), (2.0, 16.0), "power of strain"),
        source=f"Rusch (1969), J. Appl. Polym. Sci. 13, 2297; {_FOAM}", **_LOADING),
    row("locking_exponential", "sigma(eps) [1 + b (e^(k eps) - 1 - k eps) / (at eps = 0.5)]",
        "The same, exponential in strain.", Nuisance("exponent", (6.0, 15.0), (1.0, 40.0), "growth per strain"),
        source=_FOAM, **_LOADING),
    parameter="stiffening", plausible=(0.05, 4.0), needs=(Need.UNLOADING, Need.SEVERAL_PEAKS), helps=(Need.RELOAD,),
    check="cycle one particle to rising peaks, its porosity measured by tomography before and after",
    coordinates=("peak",), opposite="damage",
)  # fmt: skip
