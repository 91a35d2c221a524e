"""The wide ranges of solids that a campaign's numbers are held against, and the odds by which they are judged."""

from __future__ import annotations

from dataclasses import dataclass, field

from .._format import described
from .curve_features import FeatureOptions

Range = tuple[float, float]


@dataclass(frozen=True)
class SolidClass:
    """Ranges of one class of solids, as particles between platens show them at the peak of a test.

    Attributes:
        name: of the class.
        modulus_MPa: elastic modulus told from the slope of unloading (Oliver and Pharr 1992, with the contact radius
            of a plastic sphere) [MPa].
        loading_modulus_MPa: modulus of the elastic sphere (Hertz) that the same force would compress as far [MPa]; less
            than the modulus where the contact yields, or where loose first contact adds to the displacement.
        stress_MPa: force / (pi R_e^2) [MPa].
        strain: displacement / D_e [-].
        pressure_MPa: mean pressure in the contact, force / (pi R_e displacement) [MPa]; at most the hardness.
        weight: prior log odds of the class against those that are usually tested.
    """

    name: str
    modulus_MPa: Range
    loading_modulus_MPa: Range
    stress_MPa: Range
    strain: Range
    pressure_MPa: Range
    weight: float = 0.0

    __repr__ = described()


@dataclass(frozen=True)
class PlausibilityOptions:
    """The ranges and the odds by which numbers are judged.

    Moduli and hardnesses are those of Ashby, "Materials selection in mechanical design", charts of modulus against
    density and against strength: polymers 0.1 to 10 GPa, ceramics and glasses 20 to 700 GPa, metals 10 to 450 GPa; a
    hardness is about three times the strength. They are widened downwards by 2 to 4 for porous and granular bodies.
    Elastomers and gels are left out on purpose: the law describes solids that yield, and a stiff solid whose forces
    are 1000 times too small looks like rubber.

    Attributes:
        solids: the classes of solids; a test is plausible where one of them holds it. Stresses begin at 0.2 MPa for
            soft solids: below, only surface irregularities deform (Bommireddy et al. 2018, section 3), so no test
            ends there. Their strains begin at 3 %: polymers yield at 1 to 5 % (Ashby), and a test that tells of
            plasticity goes beyond. Pressures of hard solids begin at the hardness of lead, 30 MPa, and end at that of
            ductile metals, 4 GPa, of hardened steel and cemented carbides, 20 GPa, or of ceramics, 40 GPa. Metals are
            ductile, with moduli to that of molybdenum (330 GPa), or hard, and then they break: a yield strength above
            1.3 GPa leaves less than 10 % of elongation (Ashby, strength against ductility). Metals between platens are
            rarer than the cellulose and the ceramics for which law and testers are made, one in eight by assumption.
            Measured pebbles of lithium ceramics have loading moduli of 0.8 to 180 GPa, strains of 0.7 to 17 % and
            pressures of 0.2 to 3.2 GPa; indentations with a made-up diameter of up to 500 um lie within, too.
        diameter_um: sizes that testers of single particles take between their platens.
        force_mN: peak forces, from a nanoindenter's least to a universal tester's largest (100 kN).
        displacement_um: displacements at the peak; below 10 nm nobody resolves a curve.
        elongation: largest over smallest diameter of a particle; at most 10 for a body that stands alone.
        closure: displacement over D3, with its edge in decades; at 1 the platens would touch. The paper's law on the
            paper's particles reaches 0.5 to 0.9.
        fullness: area below the loading curve as a share of its box, with its edge. A sphere has 0.4 elastically and
            0.5 fully plastically, settling adds some (most of 229 pebbles have 0.3 to 0.55); swapped columns give
            what is missing to 1.
        loss: share of the work of loading that is not given back, with its edge; negative only where columns are
            swapped, or by drift.
        loading_s: time from a tenth to nine tenths of the peak; pebbles are crushed in 0.3 s, and hardly anybody loads
            a particle for four hours.
        interval_s: time between samples; from 1 MHz to two readings a minute.
        edge: width of every range's edge in decades (a factor 1.12): the log density falls as a normal one's outside.
        tilt: weight of the distance from a range's middle. It orders slips that explain the data equally.
        unit_slip: prior log odds of one column in a wrong unit, 1000 times too large or small: one campaign in 400.
        far_slip: what is added for a factor of a million.
        more_slip: what is added for each further column.
        row_slip: prior log odds of one particle's slip in an otherwise consistent campaign.
        odds: log odds from which on a slip is said; 3 is "20 to 1".
        alike: log odds within which a second slip is named, too.
        spread: least standard deviation, in decades, between particles of one campaign.
        rank_at_rest: how often D3 is the smallest, middle and largest diameter of a particle that rests on a platen; of
            the paper's 20 particles (Table 1) it is so for 17, 3 and 0.
        beyond: factor beyond the ranges of all solids from which on numbers are told to be none of a solid, though no
            slip explains them; the ranges themselves are uncertain by about as much.
        stiffer: factor of stress at the peak strain against the mean law of Avicel PH-200 beyond which another material
            is spoken of; the law's particles scatter by 1.35.
        features: where a test's features are read.
    """

    solids: tuple[SolidClass, ...] = (
        SolidClass("soft", (50.0, 6e4), (5.0, 3e4), (0.2, 2e3), (0.03, 1.2), (0.3, 2e3)),
        SolidClass("ceramic", (5e3, 9e5), (8e2, 9e5), (0.02, 3e3), (3e-4, 0.15), (30.0, 4e4)),
        SolidClass("ductile metal", (5e3, 3.5e5), (3e2, 3.5e5), (0.02, 3e3), (3e-4, 0.9), (30.0, 4e3), -2.0),
        SolidClass("hard metal", (5e3, 7e5), (3e2, 7e5), (0.02, 3e3), (3e-4, 0.15), (30.0, 2e4), -2.0),
    )
    diameter_um: Range = (3.0, 2e4)
    force_mN: Range = (1e-3, 1e8)
    displacement_um: Range = (0.01, 1e4)
    elongation: Range = (1.0, 10.0)
    closure: Range = (1e-6, 0.9)
    closure_edge: float = 0.02
    fullness: Range = (0.05, 0.53)
    fullness_edge: float = 0.05
    loss: Range = (-0.03, 1.1)
    loss_edge: float = 0.03
    loading_s: Range = (0.01, 1.4e4)
    interval_s: Range = (1e-6, 30.0)
    edge: float = 0.05
    tilt: float = 0.5
    unit_slip: float = -6.0
    far_slip: float = -2.0
    more_slip: float = -2.0
    row_slip: float = -6.0
    odds: float = 3.0
    alike: float = 1.0
    spread: float = 0.2
    rank_at_rest: tuple[float, float, float] = (0.80, 0.15, 0.05)
    beyond: float = 3.0
    stiffer: float = 3.0
    features: FeatureOptions = field(default_factory=FeatureOptions)

    __repr__ = described()
