"""What a test shows whatever its units, and which wrong units, times or swapped columns would explain it.

Numbers enter as logarithms, in which a wrong unit is a shift, so that all hypotheses together cost next to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from .signal import differences, median

CONTACT = 0.005  # share of the peak force that is contact: cellulose takes a quarter of its displacement below 3 %
CONTACT_NOISE = 4.0  # the same in standard deviations of the force's noise, where that is more
# Times the force of contact that no reading before contact reaches; a first cycle below it is taken for approach
LOADED = 4.0
# Shares of the peak force: below, plastic unloading bends (Oliver and Pharr 1992); above, it creeps
UNLOADING = (0.9, 0.5)
LEAST_RETREAT = 0.2  # share of the displacement that must be given back for the lost work to count
CORRELATION = 0.6  # of force and displacement up to the peak, at least: loading of any material has more than 0.8
MOST_SAMPLES = 4000  # longer records are thinned: enough for features of a curve's size

Range = tuple[float, float]
Values = np.ndarray | float


class CurveFeatures(NamedTuple):
    """One test (or several, as arrays), counted positive in compression; NaN where it does not show a feature."""

    force_sign: Any  # -1 where the forces are negative in compression, else 1
    displacement_sign: Any  # -1 where the displacements fall as the load rises, else 1
    force_mN: Any  # the largest
    displacement_um: Any  # from contact to there
    slope_mN_per_um: Any  # at the beginning of unloading
    fullness: Any  # area below the loading curve as a share of its box: 1 / (1 + n) for a power n of the displacement
    loss: Any  # share of the work of loading that unloading does not give back; negative where more came back
    loading_s: Any  # time from a tenth to nine tenths of the peak force
    interval_s: Any  # median time between two samples


def curve_features(time: np.ndarray, force: np.ndarray, displacement: np.ndarray) -> CurveFeatures | None:
    """The features of one test [s, mN, um]; None if it shows no loading or holds values that are not finite."""
    step = -(-len(time) // MOST_SAMPLES)
    time, force, displacement = (np.asarray(values, float)[::step] for values in (time, force, displacement))
    if len(time) < 2 or not all(np.isfinite(v).all() for v in (time, force, displacement)):
        return None
    force, displacement = _without_spikes(force), _without_spikes(displacement)
    with np.errstate(all="ignore"):
        low, high = float(force.min()), float(force.max())
        if min(abs(low), abs(high)) > 0.5 * (high - low) and low * high > 0:
            return None  # far from zero all the time: a large offset, or a preload without a test
        force_sign = 1 if high >= -low else -1
        rise = force_sign * force
        peak = int(np.argmax(rise))
        if not (np.isfinite(rise[peak]) and rise[peak] > 0):
            return None
        begins_at_peak = peak < 0.05 * len(rise)
        contact, base = (0, 0.0) if begins_at_peak else _contact(rise[: peak + 1])
        load = rise - base
        part = slice(peak, None) if begins_at_peak else slice(contact, peak + 1)
        together = _correlation(load[part], displacement[part])
        if abs(together) < CORRELATION:
            return None
        displacement_sign = 1 if together > 0 else -1
        depth = displacement_sign * displacement
        height = float(load[peak])
        way = float(abs(depth[peak]) if begins_at_peak else depth[peak] - depth[contact])
        fullness = loading_s = loss = np.nan
        if not begins_at_peak and way > 0:
            climb = load[contact : peak + 1]
            rows = contact + np.flatnonzero(climb >= np.maximum.accumulate(climb))
            fullness = float(np.trapezoid(load[rows], depth[rows])) / (height * way)
            first, last = (rows[np.argmax(load[rows] >= share * height)] for share in (0.1, 0.9))
            loading_s = float(time[last] - time[first])
            if depth[peak] - depth[peak:].min() > LEAST_RETREAT * way and fullness > 0:
                loss = 1 + float(np.trapezoid(load[peak:], depth[peak:])) / (fullness * height * way)
        slope, interval_s = _unloading_slope(load[peak:], depth[peak:]), median(differences(time))
        way = way if way > 0 else np.nan
        return CurveFeatures(force_sign, displacement_sign, height, way, slope, fullness, loss, loading_s, interval_s)


def _without_spikes(values: np.ndarray) -> np.ndarray:
    """Running median of five, so that one wild reading is no peak."""
    if len(values) < 9:
        return values
    out = values.copy()
    out[2:-2] = np.partition(np.lib.stride_tricks.sliding_window_view(values, 5), 2, axis=1)[:, 2]
    out[:2], out[-2:] = median(values[:5]), median(values[-5:])
    return out


def _noise(values: np.ndarray) -> float:
    """Standard deviation of white noise on a smooth course: its second differences have 6 times the variance."""
    return 0.0 if len(values) < 8 else 1.4826 * median(np.abs(differences(values, 2))) / np.sqrt(6.0)


def _contact(rise: np.ndarray) -> tuple[int, float]:
    """The last sample before the force first rises for good, and the force there; later unloadings do not count."""
    noise = _noise(rise)
    base = float(rise.min()) + 2 * noise  # the least of some hundred readings lies about two deviations below
    level = max(CONTACT * (float(rise[-1]) - base), CONTACT_NOISE * noise)
    first_rise = int(np.argmax(rise - base >= LOADED * level))
    below = np.flatnonzero(rise[:first_rise] <= base + level)
    return (int(below[-1]) if len(below) and below[-1] < len(rise) - 1 else 0), base


def _correlation(load: np.ndarray, depth: np.ndarray) -> float:
    """Of the samples whose load was not reached before (or is not again, where the record only unloads)."""
    if load[0] <= load[-1]:
        virgin = load >= np.maximum.accumulate(load)
        load, depth = load[virgin], depth[virgin]
    if not (np.ptp(load) > 0 and np.ptp(depth) > 0):
        return 0.0
    return float(np.corrcoef(load / np.ptp(load), depth / np.ptp(depth))[0, 1])


def _unloading_slope(load: np.ndarray, depth: np.ndarray) -> float:
    """Slope of the first unloading; NaN where none is seen, or the displacement goes on as the force falls."""
    begin, end = (share * load[0] for share in UNLOADING)
    if not (load < begin).any():
        return np.nan
    first = int(np.argmax(load < begin))
    deep = np.flatnonzero(load[first:] < end)
    last = first + int(deep[0] if len(deep) else np.argmin(load[first:]))
    fall, back = float(load[first] - load[last]), float(depth[first] - depth[last])
    if last - first < 3 or fall < 0.1 * load[0] or back <= 3 * _noise(depth):
        return np.nan
    return fall / back


class Properties(NamedTuple):
    """What the peak of a test shows of its material, as values (decades) or as ranges of one class of solids."""

    modulus_MPa: Any  # by the slope of unloading (Oliver and Pharr 1992, with the contact radius of a plastic sphere)
    loading_modulus_MPa: Any  # of the elastic sphere (Hertz) that the same force would compress as far
    stress_MPa: Any  # force / (pi R_e^2)
    strain: Any  # displacement / D_e
    pressure_MPa: Any  # mean in the contact, force / (pi R_e displacement); at most the hardness


# Moduli and hardnesses from Ashby, "Materials selection in mechanical design", charts of modulus against density and
# against strength (a hardness is about three times it), widened downwards by 2 to 4 for porous and granular bodies.
# Elastomers and gels are left out: the law describes solids that yield, and a stiff solid whose forces are 1000 times
# too small looks like rubber.
SOLIDS = (
    # Soft. Below 0.2 MPa only surface irregularities deform (Bommireddy et al. 2018, section 3), so no test ends there.
    # Polymers yield at strains of 1 to 5 % (Ashby), and a test that shows plasticity goes beyond 3 %.
    Properties((50.0, 6e4), (5.0, 3e4), (0.2, 2e3), (0.03, 1.2), (0.3, 2e3)),
    # Ceramic. Pressures begin at the hardness of lead, 30 MPa, here and below. Measured pebbles of lithium ceramics
    # have loading moduli of 0.8 to 180 GPa, strains of 0.7 to 17 % and pressures of 0.2 to 3.2 GPa.
    Properties((5e3, 9e5), (8e2, 9e5), (0.02, 3e3), (3e-4, 0.15), (30.0, 4e4)),
    # Ductile metal, with moduli to that of molybdenum (330 GPa).
    Properties((5e3, 3.5e5), (3e2, 3.5e5), (0.02, 3e3), (3e-4, 0.9), (30.0, 4e3)),
    # Hard metal, to hardened steel and cemented carbides. It breaks: a yield strength above 1.3 GPa leaves less than
    # 10 % of elongation (Ashby, strength against ductility).
    Properties((5e3, 7e5), (3e2, 7e5), (0.02, 3e3), (3e-4, 0.15), (30.0, 2e4)),
)
# Prior log odds of the classes: metals are rarer between platens, one in eight by assumption
WEIGHTS = (0.0, 0.0, -2.0, -2.0)
DIAMETER_UM = (3.0, 2e4)  # what test machines for single particles take between their platens
FORCE_MN = (1e-3, 1e8)  # peaks, from a nanoindenter's least to a universal test machine's largest (100 kN)
DISPLACEMENT_UM = (0.01, 1e4)  # at the peak; below 10 nm nobody resolves a curve
ELONGATION = (1.0, 10.0)  # largest over smallest diameter of a body that stands on its own
CLOSURE = (1e-6, 0.9)  # displacement over D3: at 1 the platens would touch; the paper's particles reach 0.5 to 0.9
# Area below the loading curve over its box: of a sphere 0.4 elastically and 0.5 fully plastically; settling adds some
# (most of 229 pebbles have 0.3 to 0.55), and swapped columns give what is missing to 1.
FULLNESS = (0.05, 0.53)
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
    """One way in which numbers may be wrong."""

    decades: tuple[float, ...]  # what undoing it adds to the logarithms of force, displacement, D1, D2, D3 and time
    prior: float = UNIT_ERROR  # its log odds
    swapped: bool = False  # whether force and displacement are exchanged


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


def log_numbers(it: CurveFeatures, diameters_um: np.ndarray) -> np.ndarray:
    """Decades of force, displacement, D1, D2, D3 and slope, then fullness and loss, of N tests, shape (N, 8)."""
    decades = np.log10([it.force_mN, it.displacement_um, *diameters_um.T, it.slope_mN_per_um])
    return np.column_stack([*decades, it.fullness, it.loss])


def undo(numbers: np.ndarray, swapped: np.ndarray, errors: Sequence[UnitError]) -> np.ndarray:
    """The numbers of N tests, and the same with force and displacement exchanged, shape (N, 8), with each of H unit
    errors undone, shape (N, H, 8)."""
    out = np.stack([swapped if one.swapped else numbers for one in errors], axis=1)
    shifts = np.array([one.decades for one in errors])
    out[..., :5] += shifts[:, :5]
    out[..., 5] += shifts[:, 0] - shifts[:, 1]
    return out


def apparent(numbers: np.ndarray) -> Properties:
    """What numbers as `log_numbers` gives them, shape (..., 8), show of the material, in decades."""
    force, way, d1, d2, d3, slope = np.moveaxis(numbers, -1, 0)[:6]
    diameter = d1 + d2 - d3
    radius = diameter - np.log10(2)
    # 1 mN / um^2 = 1000 MPa.
    return Properties(
        # Two contacts of radius a in series: S = E a, and a^2 = R gamma under full plasticity.
        modulus_MPa=slope + 3 - 0.5 * (radius + way),
        # Hertz, half the displacement at each platen: F = 4/3 E sqrt(R) (gamma / 2)^1.5.
        loading_modulus_MPa=force + 3 + np.log10(0.75) - 0.5 * radius - 1.5 * (way - np.log10(2)),
        stress_MPa=force + 3 - np.log10(np.pi) - 2 * radius,
        strain=way - diameter,
        pressure_MPa=force + 3 - np.log10(np.pi) - radius - way,
    )


def closure(numbers: np.ndarray) -> np.ndarray:
    """Displacement over D3, in decades."""
    return numbers[..., 1] - numbers[..., 4]


def log_density(numbers: np.ndarray) -> np.ndarray:
    """Log density under the ranges, up to a constant, of numbers as `log_numbers` gives them, shape (..., 8); -inf
    where nothing can be said."""

    def far(value: Values, within: Range) -> Values:
        low, high = np.log10(within)
        middle = (value - (low + high) / 2) / ((high - low) / 2)
        return beyond(value, (low, high)) + TILT * np.nan_to_num(middle) ** 2

    diameters = numbers[..., 2:5]
    common = sum(far(diameters[..., i], DIAMETER_UM) for i in range(3))
    common = common + far(numbers[..., 0], FORCE_MN) + far(numbers[..., 1], DISPLACEMENT_UM)
    common = common + beyond(diameters.max(-1) - diameters.min(-1), np.log10(ELONGATION))
    common = common + beyond(closure(numbers), np.log10(CLOSURE), CLOSURE_EDGE)
    common = common + beyond(numbers[..., 6], FULLNESS, FULLNESS_EDGE) + beyond(numbers[..., 7], LOSS, LOSS_EDGE)
    it = apparent(numbers)
    classes = [sum(map(far, it, solid)) - weight for solid, weight in zip(SOLIDS, WEIGHTS, strict=True)]
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
        problem = "the diameters seem to be radii, half of what they should be"
        return problem, f"if they are radii, write twice these values into {where}"
    force, way, *sizes, time = map(round, error.decades)
    which = [f"D{i}" for i, decades in enumerate(sizes, start=1) if decades]
    diameters = "diameters" if len(which) == 3 else f"diameters {''.join(which)}"
    problems, remedies = [], []
    for what, names, decades, units, right in (
        ("forces", ["force"], force, _FORCES, "mN"),
        ("displacements", ["displacement"], way, _LENGTHS, "um"),
        (diameters, which, max(sizes, key=abs), _LENGTHS, "um"),
        ("times", ["time"], time, _TIMES, "s"),
    ):
        if not decades:
            continue
        unit, times = units[decades], "1000 times" if abs(decades) == 3 else "a million times"
        much, other = ("large", "smaller") if decades < 0 else ("small", "larger")
        problems.append(f"the {what} seem {times} too {much}, as {unit} taken for {right}")
        columns = f"column{'s' if len(names) > 1 else ''} {', '.join(f'{name}_{unit}' for name in names)}"
        file, mapped = "curves.csv", f'in a mapping file: unit = "{unit}"'
        if what == diameters:
            file, mapped = "particles.csv", "or convert them to um"
        # The numbers may have been given in any unit; what is known is the factor.
        instead = f"in place of another unit, take the one {times} {other}"
        remedies.append(f"if the {what} are in {unit}, name the {columns} in {file} ({mapped}; {instead})")
    return " and ".join(problems), "; ".join(remedies)
