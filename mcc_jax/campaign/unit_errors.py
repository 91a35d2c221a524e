"""Units, times and swapped columns that a file may have wrong, as hypotheses: how likely each makes its numbers.

Forces, displacements, diameters and times enter as logarithms, in which a wrong unit is a shift, so that all hypotheses
together cost next to nothing.

The ranges of solids: moduli and hardnesses are those of Ashby, "Materials selection in mechanical design", charts of
modulus against density and against strength: polymers 0.1 to 10 GPa, ceramics and glasses 20 to 700 GPa, metals 10 to
450 GPa; a hardness is about three times the strength. They are widened downwards by 2 to 4 for porous and granular
bodies. Elastomers and gels are left out on purpose: the law describes solids that yield, and a stiff solid whose forces
are 1000 times too small looks like rubber.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from .curve_features import CurveFeatures

Range = tuple[float, float]
Values = np.ndarray | float


class Solid(NamedTuple):
    """Ranges of one class of solids, as particles between platens show them at the peak of a test.

    Attributes:
        modulus_MPa: elastic modulus by the slope of unloading (Oliver and Pharr 1992, with the contact radius of a
            plastic sphere).
        loading_modulus_MPa: modulus of the elastic sphere (Hertz) that the same force would compress as far; less than
            the modulus where the contact yields, or where loose first contact adds to the displacement.
        stress_MPa: force / (pi R_e^2).
        strain: displacement / D_e.
        pressure_MPa: mean pressure in the contact, force / (pi R_e displacement); at most the hardness.
        weight: prior log odds of the class against those that are usually tested.
    """

    modulus_MPa: Range
    loading_modulus_MPa: Range
    stress_MPa: Range
    strain: Range
    pressure_MPa: Range
    weight: float = 0.0


SOLIDS = (
    # Soft. Below 0.2 MPa only surface irregularities deform (Bommireddy et al. 2018, section 3), so no test ends there.
    # Polymers yield at strains of 1 to 5 % (Ashby), and a test that shows plasticity goes beyond 3 %.
    Solid((50.0, 6e4), (5.0, 3e4), (0.2, 2e3), (0.03, 1.2), (0.3, 2e3)),
    # Ceramic. Pressures begin at the hardness of lead, 30 MPa, here and below. Measured pebbles of lithium ceramics
    # have loading moduli of 0.8 to 180 GPa, strains of 0.7 to 17 % and pressures of 0.2 to 3.2 GPa.
    Solid((5e3, 9e5), (8e2, 9e5), (0.02, 3e3), (3e-4, 0.15), (30.0, 4e4)),
    # Ductile metal, with moduli to that of molybdenum (330 GPa). Metals between platens are rarer than the cellulose
    # and the ceramics for which law and test machines are made, one in eight by assumption.
    Solid((5e3, 3.5e5), (3e2, 3.5e5), (0.02, 3e3), (3e-4, 0.9), (30.0, 4e3), -2.0),
    # Hard metal, to hardened steel and cemented carbides. It breaks: a yield strength above 1.3 GPa leaves less than
    # 10 % of elongation (Ashby, strength against ductility).
    Solid((5e3, 7e5), (3e2, 7e5), (0.02, 3e3), (3e-4, 0.15), (30.0, 2e4), -2.0),
)
DIAMETER_UM = (3.0, 2e4)  # what test machines for single particles take between their platens
FORCE_MN = (1e-3, 1e8)  # peaks, from a nanoindenter's least to a universal test machine's largest (100 kN)
DISPLACEMENT_UM = (0.01, 1e4)  # at the peak; below 10 nm nobody resolves a curve
ELONGATION = (1.0, 10.0)  # largest over smallest diameter of a body that stands on its own
CLOSURE = (1e-6, 0.9)  # displacement over D3: at 1 the platens would touch; the paper's particles reach 0.5 to 0.9
FULLNESS = (0.05, 0.53)
"""Area below the loading curve as a share of its box: of a sphere 0.4 elastically and 0.5 fully plastically; settling
adds some (most of 229 pebbles have 0.3 to 0.55), and swapped columns give what is missing to 1."""
LOSS = (-0.03, 1.1)  # share of the work not given back; negative only where columns are swapped, or by drift
LOADING_S = (0.01, 1.4e4)  # from a tenth to nine tenths of the peak: pebbles are crushed in 0.3 s, few tests take hours
INTERVAL_S = (1e-6, 30.0)  # between samples: from 1 MHz to two readings a minute
EDGE = 0.05  # width of a range's edge in decades: the log density falls as a normal one's outside
CLOSURE_EDGE, FULLNESS_EDGE, LOSS_EDGE = 0.02, 0.05, 0.03  # the same; of fullness and loss as they are
TILT = 0.5  # weight of the distance from a range's middle, which orders hypotheses that explain the data equally
UNIT_ERROR = -6.0  # prior log odds of one column, or one particle's row, in a wrong unit: one campaign in 400
FAR = -2.0  # added for a factor of a million
MORE = -2.0  # added for each further column


class UnitError(NamedTuple):
    """One way in which numbers may be wrong.

    Attributes:
        decades: what undoing it adds to the logarithms of force, displacement, D1, D2, D3 and time.
        prior: its log odds.
        swapped: whether force and displacement are exchanged.
    """

    decades: tuple[float, ...]
    prior: float = UNIT_ERROR
    swapped: bool = False


AS_GIVEN = UnitError((0.0,) * 6, 0.0)
CLOCKS = (AS_GIVEN, *(UnitError((0.0, 0.0, 0.0, 0.0, 0.0, decades)) for decades in (-3.0, 3.0)))


def hypotheses() -> list[UnitError]:
    """All hypotheses of forces, displacements and diameters, the numbers as given first."""
    decades = (0.0, -3.0, 3.0, -6.0, 6.0)
    found = [AS_GIVEN]
    for force, way, size in product(decades, repeat=3):
        if not (force or way or size) or (force and way and size not in (0.0, way)):
            continue
        columns = sum(map(bool, (force, way, size)))
        if force == way == size == 3:
            columns -= 1  # N and mm, as most test machines write
        far = (abs(force) > 3) + (abs(way) > 3) + (abs(size) > 3 and size != way)
        found.append(UnitError((force, way, size, size, size, 0.0), UNIT_ERROR + FAR * far + MORE * (columns - 1)))
    for one in decades[1:]:
        prior = UNIT_ERROR + FAR * (abs(one) > 3) + MORE
        found += [UnitError((0.0, 0.0, *sizes, 0.0), prior) for sizes in (one * np.eye(3)).tolist()]
    double = float(np.log10(2))
    return [*found, UnitError((0.0, 0.0, double, double, double, 0.0)), UnitError(AS_GIVEN.decades, swapped=True)]


def log_numbers(features: Sequence[CurveFeatures | None], diameters_um: np.ndarray) -> np.ndarray:
    """Decades of force, displacement, D1, D2, D3 and slope, then fullness and loss, shape (N, 8)."""
    names = ("force_mN", "displacement_um", "slope_mN_per_um", "fullness", "loss")
    rows = [[np.nan if one is None else getattr(one, name) for name in names] for one in features]
    force, displacement, slope, fullness, loss = np.array(rows, float).T
    return np.column_stack([*np.log10([force, displacement, *diameters_um.T, slope]), fullness, loss])


def undo(numbers: np.ndarray, swapped: np.ndarray, errors: Sequence[UnitError]) -> np.ndarray:
    """The numbers of N tests with each of H unit errors undone, shape (N, H, 8).

    `numbers` are as `log_numbers` gives them, shape (N, 8), `swapped` the same with force and displacement exchanged.
    """
    out = np.stack([swapped if one.swapped else numbers for one in errors], axis=1)
    shifts = np.array([one.decades for one in errors])
    out[..., :5] += shifts[:, :5]
    out[..., 5] += shifts[:, 0] - shifts[:, 1]
    return out


class Apparent(NamedTuple):
    """Decades of what a test shows of its material; arrays of one shape."""

    modulus: np.ndarray
    loading_modulus: np.ndarray
    stress: np.ndarray
    strain: np.ndarray
    pressure: np.ndarray
    closure: np.ndarray


def apparent(numbers: np.ndarray) -> Apparent:
    """From numbers as `log_numbers` gives them, shape (..., 8)."""
    force, way, d1, d2, d3, slope = (numbers[..., i] for i in range(6))
    diameter = d1 + d2 - d3
    radius = diameter - np.log10(2)
    # 1 mN / um^2 = 1000 MPa.
    return Apparent(
        # Two contacts of radius a in series: S = E a, and a^2 = R gamma under full plasticity.
        modulus=np.asarray(slope + 3 - 0.5 * (radius + way)),
        # Hertz, half the displacement at each platen: F = 4/3 E sqrt(R) (gamma / 2)^1.5.
        loading_modulus=np.asarray(force + 3 + np.log10(0.75) - 0.5 * radius - 1.5 * (way - np.log10(2))),
        stress=np.asarray(force + 3 - np.log10(np.pi) - 2 * radius),
        strain=np.asarray(way - diameter),
        pressure=np.asarray(force + 3 - np.log10(np.pi) - radius - way),
        closure=np.asarray(way - d3),
    )


def log_density(numbers: np.ndarray) -> np.ndarray:
    """Log density of tests under the ranges, up to a constant; -inf where nothing can be said.

    `numbers` are as `log_numbers` gives them, shape (..., 8).
    """
    it, diameters = apparent(numbers), numbers[..., 2:5]

    def far(value: Values, within: Range) -> Values:
        low, high = np.log10(within)
        middle = (value - (low + high) / 2) / ((high - low) / 2)
        return beyond(value, (low, high)) + TILT * np.nan_to_num(middle) ** 2

    common = sum(far(diameters[..., i], DIAMETER_UM) for i in range(3))
    common = common + far(numbers[..., 0], FORCE_MN) + far(numbers[..., 1], DISPLACEMENT_UM)
    common = common + beyond(diameters.max(-1) - diameters.min(-1), np.log10(ELONGATION))
    common = common + beyond(it.closure, np.log10(CLOSURE), CLOSURE_EDGE)
    common = common + beyond(numbers[..., 6], FULLNESS, FULLNESS_EDGE) + beyond(numbers[..., 7], LOSS, LOSS_EDGE)
    classes = [sum(map(far, it[:5], solid[:5])) - solid.weight for solid in SOLIDS]
    total = -(common + np.min(classes, axis=0))
    return np.where(np.isfinite(numbers[..., 0]) & np.isfinite(numbers[..., 2]), total, -np.inf)


def beyond(value: Values, within: Sequence[float] | np.ndarray, edge: float = EDGE) -> Values:
    """Half the squared distance from a range in units of its edge; 0 within, and where there is no value."""
    outside = np.maximum(np.maximum(within[0] - value, value - within[1]), 0) / edge
    return 0.5 * np.nan_to_num(outside) ** 2


def is_radius(error: UnitError) -> bool:
    """Whether a hypothesis is that radii were given for diameters."""
    return 0 < error.decades[2] < 1


_FORCES = {-6: "nN", -3: "uN", 3: "N", 6: "kN"}
_LENGTHS = {-6: "pm", -3: "nm", 3: "mm", 6: "m"}
_TIMES = {-3: "ms", 3: "ks"}


def in_words(error: UnitError) -> tuple[str, str]:
    """What seems to be wrong, and what to write in its place; both without a capital."""
    if error.swapped:
        where = "force_mN and displacement_um in curves.csv (force and displacement in a mapping file)"
        return "force and displacement seem to be swapped", f"exchange the columns {where}"
    if is_radius(error):
        where = "D1_um, D2_um and D3_um of particles.csv (or --diameters)"
        said = "the diameters seem to be radii, half of what they should be"
        return said, f"if they are radii, write twice these values into {where}"
    force, way, *sizes, time = map(round, error.decades)
    which = [f"D{i}" for i, decades in enumerate(sizes, start=1) if decades]
    size = "diameters" if len(which) == 3 else f"diameters {''.join(which)}"
    columns = (
        ("forces", force, _FORCES, "mN", ["force"], "curves.csv"),
        ("displacements", way, _LENGTHS, "um", ["displacement"], "curves.csv"),
        (size, max(sizes, key=abs), _LENGTHS, "um", which, "particles.csv"),
        ("times", time, _TIMES, "s", ["time"], "curves.csv"),
    )
    said, remedies = [], []
    for what, decades, units, right, names, file in columns:
        if not decades:
            continue
        unit, times = units[decades], "1000 times" if abs(decades) == 3 else "a million times"
        much, other = ("large", "smaller") if decades < 0 else ("small", "larger")
        said.append(f"the {what} seem {times} too {much}, as {unit} taken for {right}")
        name = ", ".join(f"{name}_{unit}" for name in names)
        mapped = f'in a mapping file: unit = "{unit}"' if file == "curves.csv" else "or convert them to um"
        # The numbers may have been given in any unit; what is known is the factor.
        remedies.append(
            f"if the {what} are in {unit}, name the column{'s' if len(names) > 1 else ''} {name} in {file}"
            f" ({mapped}; in place of another unit, take the one {times} {other})"
        )
    return " and ".join(said), "; ".join(remedies)
