"""Whether a campaign's numbers can be those of compressed particles, and which slip of unit or sign would explain them.

Every hypothesis is judged by the same wide ranges: the numbers as given, and the numbers with one slip undone. Forces,
displacements and diameters enter as logarithms, in which a wrong unit is a shift, so that all hypotheses together cost
next to nothing. A slip is named where undoing it brings the tests from far outside the ranges to inside: its log odds
against "as given" are the difference of the log densities plus the slip's prior log odds (a Bayes factor).

What cannot be seen: a factor that leaves everything within the ranges. Loading, unloading and their ratio say the same
of a sphere of half the size with a modulus 1.4 times as large; radii given for diameters show only where the platens
would have come closer than the particle allows. Times show only where they are far from any test's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ._paper import PAPER_LOG_C, PAPER_SHAPE_PARAMETER
from ._schema import Campaign
from ._segments import Segment
from ._validate import check_campaign
from .curve_features import CurveFeatures, FeatureOptions, curve_features
from .findings import Finding

Range = tuple[float, float]
Values = np.ndarray | float
CHECK = "plausibility"


@dataclass(frozen=True)
class SolidClass:
    """Ranges of one class of solids, as particles between platens show them at the peak of a test.

    Attributes:
        name: of the class.
        modulus_MPa: elastic modulus told from the slope of unloading (Oliver and Pharr 1992, with the contact radius
            of a plastic sphere), and the effective modulus of a fit [MPa].
        loading_modulus_MPa: modulus of the elastic sphere (Hertz) that the same force would compress as far [MPa]; less
            than the modulus where the contact yields, or where loose first contact adds to the displacement.
        stress_MPa: force / (pi R_e^2) [MPa].
        strain: displacement / D_e [-].
        pressure_MPa: mean pressure in the contact, force / (pi R_e displacement) [MPa]; at most the hardness.
    """

    name: str
    modulus_MPa: Range
    loading_modulus_MPa: Range
    stress_MPa: Range
    strain: Range
    pressure_MPa: Range


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
            hardened steel, 8 GPa, or of ceramics, 40 GPa. Measured pebbles of lithium ceramics have loading moduli of
            0.8 to 180 GPa, strains of 0.7 to 17 % and pressures of 0.2 to 3.2 GPa; indentations with a made-up
            diameter lie within the ranges, too.
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
        SolidClass("metal", (5e3, 6e5), (3e2, 6e5), (0.02, 3e3), (3e-4, 0.9), (30.0, 8e3)),
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


@dataclass(frozen=True)
class _Slip:
    """One way in which numbers may be wrong; undoing it adds these decades to the logarithms of what was given."""

    force: float = 0.0
    displacement: float = 0.0
    diameters: tuple[float, float, float] = (0.0, 0.0, 0.0)
    swapped: bool = False
    prior: float = 0.0

    @property
    def shift(self) -> np.ndarray:
        return np.array([self.force, self.displacement, *self.diameters])


def check_plausibility(
    campaign: Campaign,
    *,
    modulus_MPa: float | None = None,
    segments: Sequence[Sequence[Segment]] | None = None,
    options: PlausibilityOptions | None = None,
) -> tuple[Finding, ...]:
    """What a slip of unit, sign or column would explain in a campaign, in sentences.

    Judges raw tests, before any fit: each test's peak, the stiffness of loading and unloading, the work given back, its
    sizes and its times. Nothing is changed, and nothing is an error.

    Args:
        campaign: the tests.
        modulus_MPa: the effective modulus of a fit [MPa], which is then judged together with the tests.
        segments: what `campaign_segments` gave, if it is known; first contact is then taken from there.
        options: the ranges and the odds.

    Returns:
        Findings: "bad" for a likely slip, with the column and the remedy, and for numbers that no solid has; "told"
        where the material is not like micro-crystalline cellulose, which is no fault. Empty where nothing is to be
        said. `Finding.particles` names the particles where not all are concerned.
    """
    check_campaign(campaign)
    options = options or PlausibilityOptions()
    with np.errstate(all="ignore"):
        tests = _Tests.of(campaign, segments, options)
        if tests is None:
            return ()
        found = list(_signs(tests))
        slips = _scales(tests, modulus_MPa, options)
        found += slips
        if not slips:
            found += _outside(tests, modulus_MPa, options)
        found += _clock(tests, options)
        found += _order_of_diameters(tests, options)
        if not found:
            found += _another_material(tests, options)
    return tuple(found)


def wrong_signs(campaign: Campaign) -> bool:
    """Whether force, displacement or both are counted the other way round in most tests of a campaign."""
    with np.errstate(all="ignore"):
        tests = _Tests.of(campaign, None, PlausibilityOptions(), swapped=False)
        if tests is None:
            return False
        turned = (tests.column("force_sign") < 0) | (tests.column("displacement_sign") < 0)
    return 2 * int(turned.sum()) > len(turned)


@dataclass(frozen=True)
class _Tests:
    """The tests that show anything: their features as given and with force and displacement swapped."""

    names: tuple[str, ...]
    count: int
    diameters_um: np.ndarray
    given: tuple[CurveFeatures, ...]
    swapped: tuple[CurveFeatures | None, ...]

    @classmethod
    def of(
        cls,
        campaign: Campaign,
        segments: Sequence[Sequence[Segment]] | None,
        options: PlausibilityOptions,
        *,
        swapped: bool = True,
    ) -> _Tests | None:
        """The tests of a campaign; without the features of swapped columns where nobody asks for them."""
        diameters = np.asarray(campaign.diameters_um, float)
        given: list[CurveFeatures] = []
        others: list[CurveFeatures | None] = []
        rows: list[int] = []
        for i, curve in enumerate(campaign.curves):
            parts = segments[i] if segments is not None and i < len(segments) else ()
            one = curve_features(
                curve.time_s, curve.force_mN, curve.displacement_um, segments=parts, options=options.features
            )
            if one is None or not (np.isfinite(diameters[i]) & (diameters[i] > 0)).all():
                continue
            rows.append(i)
            given.append(one)
            others.append(
                curve_features(curve.time_s, curve.displacement_um, curve.force_mN, options=options.features)
                if swapped
                else None
            )
        if not rows:
            return None
        names = tuple(campaign.particles[i] for i in rows)
        return cls(names, len(campaign), diameters[rows], tuple(given), tuple(others))

    def some(self, chosen: np.ndarray) -> tuple[str, ...]:
        """Names of the chosen tests, none where all are."""
        return () if chosen.all() else tuple(n for n, c in zip(self.names, chosen, strict=True) if c)

    def column(self, name: str) -> np.ndarray:
        return np.array([getattr(one, name) for one in self.given], float)


# ---- slips of unit, and columns swapped ------------------------------------------------------------------------------


def _slips(options: PlausibilityOptions) -> list[_Slip]:
    """All hypotheses, the numbers as given first."""
    slips = [_Slip()]
    all_three, single = [(1.0, 1.0, 1.0)], [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
    for decades in (-3.0, 3.0, -6.0, 6.0):
        far = options.far_slip * (abs(decades) > 3)
        one, two = options.unit_slip + far, options.unit_slip + far + options.more_slip
        slips += [_Slip(force=decades, prior=one), _Slip(displacement=decades, prior=one)]
        slips += [_Slip(diameters=_times(decades, which), prior=one) for which in all_three]
        slips += [_Slip(diameters=_times(decades, which), prior=two) for which in single]
        slips.append(_Slip(displacement=decades, diameters=_all(decades), prior=two))
        # Several columns of one file in units of one kind, for instance N and mm.
        for other in (-3.0, 3.0, -6.0, 6.0):
            far_too = options.far_slip * (abs(other) > 3)
            slips.append(_Slip(force=other, displacement=decades, prior=two + far_too))
            slips.append(_Slip(force=other, diameters=_all(decades), prior=two + far_too))
            three = two + far_too + options.more_slip * (not other == decades == 3)  # N and mm, as most testers write
            slips.append(_Slip(force=other, displacement=decades, diameters=_all(decades), prior=three))
            if other != decades:
                slips.append(_Slip(displacement=other, diameters=_all(decades), prior=two + far_too))
    slips.append(_Slip(diameters=_all(float(np.log10(2))), prior=options.unit_slip))
    slips.append(_Slip(swapped=True, prior=options.unit_slip))
    return slips


def _all(decades: float) -> tuple[float, float, float]:
    return decades, decades, decades


def _times(decades: float, which: tuple[float, float, float]) -> tuple[float, float, float]:
    a, b, c = which
    return decades * a, decades * b, decades * c


def _log_numbers(features: Sequence[CurveFeatures | None], diameters_um: np.ndarray) -> np.ndarray:
    """Decades of force, displacement, D1, D2, D3 and slope, then fullness and loss, shape (N, 8)."""
    missing = (np.nan,) * 5
    rows = [
        missing if one is None else (one.force_mN, one.displacement_um, one.slope_mN_per_um, one.fullness, one.loss)
        for one in features
    ]
    force, displacement, slope, fullness, loss = np.array(rows, float).T
    return np.column_stack(
        [np.log10(force), np.log10(displacement), np.log10(diameters_um), np.log10(slope), fullness, loss]
    )


@dataclass(frozen=True)
class _Apparent:
    """Decades of what a test says of its material; arrays of one shape."""

    strain: np.ndarray
    closure: np.ndarray
    stress: np.ndarray
    pressure: np.ndarray
    loading_modulus: np.ndarray
    modulus: np.ndarray

    @classmethod
    def of(cls, numbers: np.ndarray) -> _Apparent:
        force, way, d1, d2, d3, slope = (numbers[..., i] for i in range(6))
        diameter = d1 + d2 - d3
        radius = diameter - np.log10(2)
        # 1 mN / um^2 = 1000 MPa.
        return cls(
            strain=np.asarray(way - diameter),
            closure=np.asarray(way - d3),
            stress=np.asarray(force + 3 - np.log10(np.pi) - 2 * radius),
            pressure=np.asarray(force + 3 - np.log10(np.pi) - radius - way),
            # Hertz, half the displacement at each platen: F = 4/3 E sqrt(R) (gamma / 2)^1.5.
            loading_modulus=np.asarray(force + 3 + np.log10(0.75) - 0.5 * radius - 1.5 * (way - np.log10(2))),
            # Two contacts of radius a in series: S = E a, and a^2 = R gamma under full plasticity.
            modulus=np.asarray(slope + 3 - 0.5 * (radius + way)),
        )


def _log_density(numbers: np.ndarray, fitted: np.ndarray | float, options: PlausibilityOptions) -> np.ndarray:
    """Log density of tests under the ranges, up to a constant; -inf where nothing can be said.

    Args:
        numbers: as `_log_numbers` gives them, shape (..., 8).
        fitted: decades of the fitted modulus, NaN if there is none.
        options: the ranges.
    """
    it = _Apparent.of(numbers)
    diameters = numbers[..., 2:5]

    def far(value: Values, within: Range) -> Values:
        low, high = _decades(within)
        middle = (value - (low + high) / 2) / ((high - low) / 2)
        return _beyond(value, low, high, options.edge) + options.tilt * np.nan_to_num(middle) ** 2

    common = sum(far(diameters[..., i], options.diameter_um) for i in range(3))
    common = common + far(numbers[..., 0], options.force_mN) + far(numbers[..., 1], options.displacement_um)
    common = common + _beyond(diameters.max(-1) - diameters.min(-1), *_decades(options.elongation), options.edge)
    common = common + _beyond(it.closure, *_decades(options.closure), options.closure_edge)
    common = common + _beyond(numbers[..., 6], *options.fullness, options.fullness_edge)
    common = common + _beyond(numbers[..., 7], *options.loss, options.loss_edge)
    classes = [
        far(it.modulus, solid.modulus_MPa)
        + far(fitted, solid.modulus_MPa)
        + far(it.loading_modulus, solid.loading_modulus_MPa)
        + far(it.stress, solid.stress_MPa)
        + far(it.strain, solid.strain)
        + far(it.pressure, solid.pressure_MPa)
        for solid in options.solids
    ]
    total = -(common + np.min(classes, axis=0))
    return np.where(np.isfinite(numbers[..., 0]) & np.isfinite(numbers[..., 2]), total, -np.inf)


def _decades(within: Range) -> Range:
    return float(np.log10(within[0])), float(np.log10(within[1]))


def _beyond(value: Values, low: float, high: float, edge: float) -> Values:
    """Half the squared distance from a range in units of its edge; 0 within, and where there is no value."""
    outside = np.maximum(np.maximum(low - value, value - high), 0) / edge
    return 0.5 * np.nan_to_num(outside) ** 2


def _undone(numbers: np.ndarray, swapped: np.ndarray, slips: Sequence[_Slip]) -> np.ndarray:
    """The tests' numbers under every hypothesis, shape (N, H, 8)."""
    out = np.stack([swapped if slip.swapped else numbers for slip in slips], axis=1)
    shifts = np.array([slip.shift for slip in slips])
    out[..., :5] += shifts
    out[..., 5] += shifts[:, 0] - shifts[:, 1]
    return out


def _scales(tests: _Tests, modulus_MPa: float | None, options: PlausibilityOptions) -> list[Finding]:
    """Slips of unit and swapped columns, of the whole campaign and of single particles."""
    slips = _slips(options)
    prior = np.array([slip.prior for slip in slips])
    given = _log_numbers(tests.given, tests.diameters_um)
    undone = _undone(given, _log_numbers(tests.swapped, tests.diameters_um), slips)
    fitted = _fitted_decades(modulus_MPa) + np.array(
        [s.force - 1.5 * s.displacement - 0.5 * (s.diameters[0] + s.diameters[1] - s.diameters[2]) for s in slips]
    )
    fitted = np.where([s.swapped for s in slips], np.nan, fitted)
    each = _log_density(undone, np.nan, options)
    whole = np.median(_log_density(undone, fitted, options), axis=0) + prior
    found: list[Finding] = []
    corrected = given
    concerned = np.zeros(len(tests.names), bool)
    if whole.max() > whole[0] + options.odds:
        best = int(np.argmax(whole))
        concerned = each[:, best] > each[:, 0] - options.odds
        if not concerned.any():
            concerned[:] = True  # only the fitted modulus tells
        found.append(_slip_finding(tests, slips, whole, concerned, given, options))
        corrected = np.where(concerned[:, None], undone[:, best], given)
    elif len(tests.names) >= 3:
        # A group of tests of another tester or another person.
        alone = each + prior
        best_each = np.argmax(alone, axis=1)
        sure = alone.max(axis=1) > alone[:, 0] + options.odds
        for best in np.unique(best_each[sure]):
            group = sure & (best_each == best)
            if group.sum() >= 0.25 * len(group):
                total = np.median(alone[group], axis=0)
                found.append(_slip_finding(tests, slips, total, group, given, options))
                corrected = np.where(group[:, None], undone[:, best], corrected)
                concerned = concerned | group
    return found + _single_slips(tests, corrected, concerned, slips, options)


def _median(values: np.ndarray) -> float:
    """Median of what is finite; NaN if nothing is."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.nan


def _typical(rows: np.ndarray) -> np.ndarray:
    """Median of each column of an array of shape (N, n)."""
    return np.array([_median(column) for column in rows.T])


def _fitted_decades(modulus_MPa: float | None) -> float:
    return float(np.log10(modulus_MPa)) if modulus_MPa is not None and 0 < modulus_MPa < np.inf else np.nan


def _single_slips(
    tests: _Tests, numbers: np.ndarray, settled: np.ndarray, slips: Sequence[_Slip], options: PlausibilityOptions
) -> list[Finding]:
    """Particles that differ from all others as a slip in their rows would make them differ."""
    if len(tests.names) < 4:
        return []
    it = _Apparent.of(numbers)
    values = np.column_stack([numbers[:, 2:5], it.strain, it.loading_modulus])
    centre = _typical(values)
    width = np.maximum(options.spread, 1.4826 * _typical(np.abs(values - centre)))
    undone = _undone(numbers, _log_numbers(tests.swapped, tests.diameters_um), slips)
    there = _Apparent.of(undone)
    moved = np.concatenate([undone[..., 2:5], there.strain[..., None], there.loading_modulus[..., None]], axis=-1)
    # Student's t with four degrees of freedom: real particles have outliers, too.
    density = -2.5 * np.log1p(((moved - centre) / width) ** 2 / 4).sum(-1)
    density = np.where(np.isfinite(density), density, -np.inf)
    density = density + _log_density(undone, np.nan, options).clip(-20)
    prior = np.array([slip.prior - options.unit_slip + options.row_slip if slip.prior else 0.0 for slip in slips])
    # One soft particle may come close to flat; radii show only in what all of them do.
    odds = density + np.where([_is_radius(slip) for slip in slips], -np.inf, prior)
    found: list[Finding] = []
    sure = (odds.max(axis=1) > odds[:, 0] + options.odds) & ~settled
    best = np.argmax(odds, axis=1)
    for h in np.unique(best[sure]):
        group = sure & (best == h)
        found.append(_slip_finding(tests, slips, np.median(odds[group], axis=0), group, numbers, options))
    return found


def _slip_finding(
    tests: _Tests,
    slips: Sequence[_Slip],
    odds: np.ndarray,
    concerned: np.ndarray,
    given: np.ndarray,
    options: PlausibilityOptions,
) -> Finding:
    order = np.argsort(-odds)
    best = slips[order[0]]
    second = slips[order[1]] if odds[order[1]] > odds[order[0]] - options.alike and order[1] != 0 else None
    names = tests.some(concerned)
    numbers = _typical(given[concerned])
    it = _Apparent.of(numbers)
    modulus = it.modulus if np.isfinite(it.modulus) else it.loading_modulus
    who = "the tests" if not names else f"particle{'s' if len(names) > 1 else ''} {_listed(names)}"
    sentence = (
        f"{_likely(best)}{'' if second is None else ', or ' + _likely(second)}: as given, {who} reach"
        f"{'es' if len(names) == 1 else ''} {_number(it.stress)} MPa at a strain of {_number(it.strain)} with a modulus"
        f" of {_modulus(modulus)} and diameters of {_number(numbers[2:5].mean())} um"
        f", which {'fits no solid' if not names else 'fits neither the others nor any usual solid'}"
    )
    soft = best.force > 0 and not best.displacement and not any(best.diameters)
    remedy = _remedy(best) + ("" if second is None else f"; or else {_lower(_remedy(second))}")
    if soft:
        remedy += "; a material as soft as rubber would look the same, and is none that this law describes"
    return Finding(CHECK, "bad", sentence[0].upper() + sentence[1:], remedy, names)


FORCE_UNITS = {-3: ("uN", "1000 times too large"), 3: ("N", "1000 times too small")}
FORCE_UNITS |= {-6: ("nN", "a million times too large"), 6: ("kN", "a million times too small")}
LENGTH_UNITS = {-3: ("nm", "1000 times too large"), 3: ("mm", "1000 times too small")}
LENGTH_UNITS |= {-6: ("pm", "a million times too large"), 6: ("m", "a million times too small")}


def _columns(slip: _Slip) -> list[tuple[str, str, str, str, str]]:
    """The columns that a slip concerns: what they hold, unit they seem to hold, by how much, name, where."""
    out: list[tuple[str, str, str, str, str]] = []
    if slip.force:
        unit, much = FORCE_UNITS[round(slip.force)]
        out.append(("forces", unit, much, f"force_{unit}", "curves.csv"))
    if slip.displacement:
        unit, much = LENGTH_UNITS[round(slip.displacement)]
        out.append(("displacements", unit, much, f"displacement_{unit}", "curves.csv"))
    which = [f"D{i + 1}" for i, value in enumerate(slip.diameters) if value]
    if which:
        unit, much = LENGTH_UNITS[round(max(slip.diameters, key=abs))]
        what = "diameters" if len(which) == 3 else f"diameters {which[0]}"
        out.append((what, unit, much, ", ".join(f"{one}_{unit}" for one in which), "particles.csv"))
    return out


def _is_radius(slip: _Slip) -> bool:
    return 0 < slip.diameters[0] < 1


def _likely(slip: _Slip) -> str:
    if slip.swapped:
        return "force and displacement seem to be swapped"
    if _is_radius(slip):
        return "the diameters seem to be radii, half of what they should be"
    parts = [
        f"the {what} seem {much}, as {unit} taken for {'mN' if what == 'forces' else 'um'}"
        for what, unit, much, _, _ in _columns(slip)
    ]
    return " and ".join(parts)


def _remedy(slip: _Slip) -> str:
    if slip.swapped:
        return (
            "Exchange the columns force_mN and displacement_um in curves.csv (force and displacement in a mapping file)"
        )
    if _is_radius(slip):
        return (
            "If they are radii, write twice these values into D1_um, D2_um and D3_um of particles.csv (or --diameters)"
        )
    parts: list[str] = []
    for what, unit, _, name, file in _columns(slip):
        mapped = f' (in a mapping file: unit = "{unit}")' if file == "curves.csv" else " (or convert them to um)"
        parts.append(
            f"if the {what} are in {unit}, name the column{'s' if ',' in name else ''} {name} in {file}{mapped}"
        )
    text = "; ".join(parts)
    return text[0].upper() + text[1:]


def _lower(text: str) -> str:
    return text[0].lower() + text[1:]


def _listed(names: Sequence[str], most: int = 6) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _number(decades: float | np.ndarray) -> str:
    return f"{float(f'{10.0 ** float(decades):.2g}'):g}"


def _modulus(decades: float | np.ndarray) -> str:
    value = 10.0 ** float(decades)
    return f"{_number(decades - 3)} GPa" if value >= 1e3 else f"{_number(decades)} MPa"


# ---- signs -----------------------------------------------------------------------------------------------------------


def _signs(tests: _Tests) -> list[Finding]:
    """Forces or displacements that are negative in compression."""
    force, displacement = tests.column("force_sign") < 0, tests.column("displacement_sign") < 0
    heights = np.log10(tests.column("force_mN"))
    # A record of the tester's idling has a sign, too.
    real = heights > _median(heights) - 1.5
    kinds: tuple[tuple[np.ndarray, Literal["force", "displacement", "both"]], ...] = (
        (real & force & displacement, "both"),
        (real & force & ~displacement, "force"),
        (real & ~force & displacement, "displacement"),
    )
    return [_sign_finding(tests, chosen, kind) for chosen, kind in kinds if chosen.any()]


def _sign_finding(tests: _Tests, chosen: np.ndarray, kind: Literal["force", "displacement", "both"]) -> Finding:
    names = tests.some(chosen)
    who = "all tests" if not names else f"particle{'s' if len(names) > 1 else ''} {_listed(names)}"
    subject, columns, seen = {
        "force": ("forces", "force_mN", "the load rises as the force falls below zero"),
        "displacement": ("displacements", "displacement_um", "the displacement falls as the force rises"),
        "both": ("forces and displacements", "force_mN and displacement_um", "both go below zero as the load rises"),
    }[kind]
    where = "force and displacement" if kind == "both" else kind
    return Finding(
        CHECK,
        "bad",
        f"The {subject} of {who} seem to have the wrong sign: {seen}, and compression counts positive here",
        f"Turn the sign of {columns} in curves.csv, or write sign = -1 for {where} in the mapping file",
        names,
    )


# ---- times, order of diameters ---------------------------------------------------------------------------------------


def _clock(tests: _Tests, options: PlausibilityOptions) -> list[Finding]:
    """Times in a wrong unit."""
    loading, interval = np.log10(tests.column("loading_s")), np.log10(tests.column("interval_s"))
    decades = np.array([0.0, -3.0, 3.0])
    density = -_beyond(loading[:, None] + decades, *_decades(options.loading_s), options.edge)
    density = density - _beyond(interval[:, None] + decades, *_decades(options.interval_s), options.edge)
    density = np.where(np.isfinite(loading)[:, None], density, 0.0)
    odds = np.median(density, axis=0) + np.array([0.0, options.unit_slip, options.unit_slip])
    best = int(np.argmax(odds))
    if best == 0 or odds[best] < odds[0] + options.odds:
        return []
    unit, much = {1: ("ms", "1000 times too large"), 2: ("ks", "1000 times too small")}[best]
    return [
        Finding(
            CHECK,
            "bad",
            f"The times seem {much}, as {unit} taken for s: as given, loading takes {_number(_median(loading))} s"
            f" with a reading every {_number(_median(interval))} s",
            f'If the times are in {unit}, name the column time_{unit} in curves.csv (mapping file: unit = "{unit}")',
        )
    ]


def _order_of_diameters(tests: _Tests, options: PlausibilityOptions) -> list[Finding]:
    """D3 in a column of another diameter: particles rest on their flat side, so D3 is the smallest of most."""
    sizes = np.unique(tests.diameters_um, axis=0)
    sizes = sizes[sizes.max(axis=1) > 1.03 * sizes.min(axis=1)]
    if len(sizes) < 3:
        return []
    ranks = np.argsort(np.argsort(sizes, axis=1), axis=1)
    log_order = np.log(options.rank_at_rest)
    as_given = log_order[ranks[:, 2]].sum()
    # Bodies that lie anyhow.
    anyhow = len(sizes) * np.log(1 / 3)
    moved = np.array([log_order[ranks[:, i]].sum() for i in range(2)])
    odds = moved + options.unit_slip - np.logaddexp(as_given, anyhow)
    best = int(np.argmax(odds))
    if odds[best] < options.odds:
        return []
    smallest = int((ranks[:, best] == 0).sum())
    return [
        Finding(
            CHECK,
            "bad",
            f"The diameters D{best + 1} and D3 seem to be swapped: D{best + 1} is the smallest of {smallest} of"
            f" {len(sizes)} particles and D3 of {int((ranks[:, 2] == 0).sum())}, and particles rest on their flat side",
            f"D3 is the diameter along the compression; exchange D{best + 1}_um and D3_um in particles.csv, unless the"
            " particles stood upright",
        )
    ]


# ---- numbers that no solid has, and other materials ------------------------------------------------------------


def _outside(tests: _Tests, modulus_MPa: float | None, options: PlausibilityOptions) -> list[Finding]:
    """Numbers beyond every range though no slip explains them."""
    found: list[Finding] = []
    it = _Apparent.of(_log_numbers(tests.given, tests.diameters_um))
    apart = it.closure > 0
    if apart.any():
        names = tests.some(apart)
        who = "all tests" if not names else f"particle{'s' if len(names) > 1 else ''} {_listed(names)}"
        found.append(
            Finding(
                CHECK,
                "look" if names else "bad",
                f"The displacement of {who} exceeds the diameter D3, so that the platens would have touched",
                "Check the diameters and the zero of displacement",
                names,
            )
        )
    numbers = _typical(_log_numbers(tests.given, tests.diameters_um))
    whole = _Apparent.of(numbers)
    solids = options.solids
    hulls = (
        ("diameter", "um", numbers[2:5].mean(), options.diameter_um),
        ("stress", "MPa", whole.stress, _hull([s.stress_MPa for s in solids])),
        ("stiffness of loading", "MPa", whole.loading_modulus, _hull([s.loading_modulus_MPa for s in solids])),
        ("modulus of unloading", "MPa", whole.modulus, _hull([s.modulus_MPa for s in solids])),
    )
    for what, unit, value, (low, high) in hulls:
        if value < np.log10(low / options.beyond) or value > np.log10(high * options.beyond):
            found.append(
                Finding(
                    CHECK,
                    "bad",
                    f"A typical {what} of {_number(value)} {unit} is none of a solid between platens ({low:g} to"
                    f" {high:g} {unit}), and no single slip of a unit explains it",
                    "Check the units of force, displacement and diameters, and that tests are of single particles",
                )
            )
            return found
    low, high = _hull([s.modulus_MPa for s in solids])
    if modulus_MPa is not None and not low / options.beyond <= modulus_MPa <= options.beyond * high:
        found.append(
            Finding(
                CHECK,
                "bad",
                f"The fitted modulus of {modulus_MPa / 1e3:.3g} GPa is none of a solid ({low / 1e3:g} to"
                f" {high / 1e3:g} GPa), though the tests themselves look plausible",
                "Do not use it; check unloading and the units of forces, displacements and diameters",
            )
        )
    return found


def _hull(ranges: Sequence[Range]) -> Range:
    return min(low for low, _ in ranges), max(high for _, high in ranges)


def _another_material(tests: _Tests, options: PlausibilityOptions) -> list[Finding]:
    """Tests that are much stiffer or softer than micro-crystalline cellulose, which accuses nobody."""
    numbers = _log_numbers(tests.given, tests.diameters_um)
    it = _Apparent.of(numbers)
    D1, D2, D3 = tests.diameters_um.T
    x = (1 + PAPER_SHAPE_PARAMETER * (1 - D3**2 / (D1 * D2))) * 10**it.strain
    C1, C3, C5 = (np.exp(PAPER_LOG_C[name][0]) for name in ("C1", "C3", "C5"))
    ratios = it.stress - np.log10(C1 * x - (C3 * x) ** 3 + (C5 * x) ** 5)
    ratio = _median(np.where(np.isfinite(tests.column("fullness")), ratios, np.nan))
    if not abs(ratio) > np.log10(options.stiffer):
        return []
    word = "stiffer" if ratio > 0 else "softer"
    return [
        Finding(
            CHECK,
            "told",
            f"The material is {_number(abs(ratio))} times {word} in loading than micro-crystalline cellulose"
            f" (Avicel PH-200): {_number(_median(it.stress))} MPa at a strain of"
            f" {_number(_median(it.strain))}; a typical solid otherwise",
        )
    ]
