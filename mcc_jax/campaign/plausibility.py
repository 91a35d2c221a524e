"""Whether a campaign's numbers can be those of compressed particles, and which slip of unit or sign would explain them.

Every hypothesis is judged by the same wide ranges: the numbers as given, and the numbers with one slip undone. Forces,
displacements and diameters enter as logarithms, in which a wrong unit is a shift, so that all hypotheses together cost
next to nothing. A slip is named where undoing it brings the tests from far outside the ranges to inside: its log odds
against "as given" are the difference of the log densities plus the slip's prior log odds (a Bayes factor).

What cannot be seen: a factor that leaves everything within the ranges. Loading, unloading and their ratio say the same
of a sphere of half the size with a modulus 1.4 times as large; radii given for diameters show only where the platens
would have come closer than the particle allows, in tests of cellulose to 5 MPa and more. Forces of cellulose in uN
taken for mN are those of a strong metal where tests end below 3 MPa. Times show only where they are far from any
test's.

A fitted modulus accuses no unit: a wrong one moves it and the records' own stiffness by the same factor (both go as
force / (displacement^1.5 diameter^0.5)), so where the records are ordinary, the form of the law is at fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .curve_features import CurveFeatures, curve_features
from .findings import Finding, worst
from .memory import remembered
from .paper import PAPER_LOG_C, PAPER_SHAPE_PARAMETER
from .plausible_ranges import PlausibilityOptions, Range
from .schema import Campaign, Curve
from .segments import Segment
from .slips import (
    Apparent,
    Slip,
    beyond,
    hypotheses,
    in_decades,
    is_radius,
    likely,
    log_density,
    log_numbers,
    remedy_of,
    undo,
)
from .validate import check_campaign

CHECK = "plausibility"


def check_plausibility(
    campaign: Campaign,
    *,
    modulus_MPa: float | None = None,
    segments: Sequence[Sequence[Segment]] | None = None,
    options: PlausibilityOptions | None = None,
) -> tuple[Finding, ...]:
    """What a slip of unit, sign or column would explain in a campaign, in sentences.

    Judges raw tests, before any fit: each test's peak, the stiffness of loading and unloading, the work given back, its
    sizes and its times. Of a checked campaign those that it was made from. Nothing is changed, and nothing is an error.

    Args:
        campaign: the tests.
        modulus_MPa: the effective modulus of a fit [MPa], which is then held against the moduli of solids.
        segments: what `campaign_segments` gave, if it is known; first contact is then taken from there.
        options: the ranges and the odds.

    Returns:
        Findings: "bad" for a likely slip, with the column and the remedy, and for numbers that no solid has; "told"
        where the material is not like micro-crystalline cellulose, which is no fault. Empty where nothing is to be
        said. What is said of a fitted modulus is of the check "fitted modulus" and accuses no unit; all else is of
        the check "plausibility". `Finding.particles` names the particles where not all are concerned.
    """
    if not isinstance(campaign, Campaign):
        check_campaign(campaign)  # what is no campaign; one with wrong values is still looked at, to name their cause
    options = options or PlausibilityOptions()
    looks = _looks(campaign.raw or campaign, segments, options)
    if looks.typical is None or worst(looks.findings) == "bad":
        return looks.findings
    return (*looks.findings, *_fitted_modulus(looks.typical, modulus_MPa, options), *looks.told)


@dataclass(frozen=True)
class _Looks:
    """What a campaign looks like before any fit.

    Attributes:
        findings: slips, and numbers that no solid has.
        typical: median numbers of its tests, as `log_numbers` gives them; None where no test shows any.
        material: how it differs from micro-crystalline cellulose; None where it does not.
        told: a finding of it, where nothing else was found.
    """

    findings: tuple[Finding, ...] = ()
    typical: np.ndarray | None = None
    material: Material | None = None
    told: tuple[Finding, ...] = ()


def _looks(campaign: Campaign, segments: Sequence[Sequence[Segment]] | None, options: PlausibilityOptions) -> _Looks:
    """The same for every question about a campaign, so worked out once."""

    def find() -> _Looks:
        with np.errstate(all="ignore"):
            tests = _Tests.of(campaign, segments, options)
            if tests is None:
                return _Looks()
            found = list(_signs(tests))
            scales = _scales(tests, options)
            found += scales or _outside(tests, options)
            found += _clock(tests, options)
            if not scales:  # one diameter in another unit is out of order, too
                found += _order_of_diameters(tests, options)
            it = Apparent.of(tests.numbers)
            material = _material(tests, it, options)
            told = () if found or material is None else (_another_material(material, it),)
            return _Looks(tuple(found), _typical(tests.numbers), material, told)

    parts = None if segments is None else tuple(map(tuple, segments))
    return remembered(campaign, ("looks", parts, options), find)


def or_slip(campaign: Campaign, problem: str, remedy: str) -> tuple[str, str]:
    """A problem and its remedy; with the likely slip of unit, sign or column that explains it, where there is one."""
    slips = [one for one in check_plausibility(campaign) if one.level == "bad"]
    # What a slip explains needs no other remedy.
    return (f"{problem}; {slips[0].sentence}", slips[0].remedy) if slips else (problem, remedy)


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
    """The tests that show anything.

    Attributes:
        names, diameters_um: of their particles.
        given: features of their curves.
        numbers, swapped: what `log_numbers` makes of them, as given and with force and displacement swapped.
    """

    names: tuple[str, ...]
    diameters_um: np.ndarray
    given: tuple[CurveFeatures, ...]
    numbers: np.ndarray
    swapped: np.ndarray

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
            one = _features(curve, parts, options)
            if one is None or not (np.isfinite(diameters[i]) & (diameters[i] > 0)).all():
                continue
            rows.append(i)
            given.append(one)
            others.append(_features(curve, None, options) if swapped else None)
        if not rows:
            return None
        sizes = diameters[rows]
        numbers, exchanged = log_numbers(given, sizes), log_numbers(others, sizes)
        return cls(tuple(campaign.particles[i] for i in rows), sizes, tuple(given), numbers, exchanged)

    def some(self, chosen: np.ndarray) -> tuple[str, ...]:
        """Names of the chosen tests, none where all are."""
        return () if chosen.all() else tuple(n for n, c in zip(self.names, chosen, strict=True) if c)

    def column(self, name: str) -> np.ndarray:
        return np.array([getattr(one, name) for one in self.given], float)


def _features(curve: Curve, segments: Sequence[Segment] | None, options: PlausibilityOptions) -> CurveFeatures | None:
    """The features of a test with its segments, if any are known; None for them with its columns swapped."""
    time, force, path, seen = curve.time_s, curve.force_mN, curve.displacement_um, options.features

    def find() -> CurveFeatures | None:
        if segments is None:
            return curve_features(time, path, force, options=seen)
        return curve_features(time, force, path, segments=segments, options=seen)

    return remembered(curve, (None if segments is None else tuple(segments), seen), find)


# ---- slips of unit, and columns swapped ------------------------------------------------------------------------------


def _scales(tests: _Tests, options: PlausibilityOptions) -> list[Finding]:
    """Slips of unit and swapped columns, of the whole campaign and of single particles."""
    slips = hypotheses(options)
    prior = np.array([slip.prior for slip in slips])
    given = tests.numbers
    undone = undo(given, tests.swapped, slips)
    each = log_density(undone, options)
    whole = np.median(each, axis=0) + prior
    found: list[Finding] = []
    corrected = given
    concerned = np.zeros(len(tests.names), bool)
    if whole.max() > whole[0] + options.odds:
        best = int(np.argmax(whole))
        concerned = each[:, best] > each[:, 0] - options.odds
        if not concerned.any():
            concerned[:] = True  # the two medians may come from different tests
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


def _single_slips(
    tests: _Tests, numbers: np.ndarray, settled: np.ndarray, slips: Sequence[Slip], options: PlausibilityOptions
) -> list[Finding]:
    """Particles that differ from all others as a slip in their rows would make them differ."""
    if len(tests.names) < 4:
        return []
    it = Apparent.of(numbers)
    values = np.column_stack([numbers[:, 2:5], it.strain, it.loading_modulus])
    centre = _typical(values)
    width = np.maximum(options.spread, 1.4826 * _typical(np.abs(values - centre)))
    undone = undo(numbers, tests.swapped, slips)
    there = Apparent.of(undone)
    moved = np.concatenate([undone[..., 2:5], there.strain[..., None], there.loading_modulus[..., None]], axis=-1)
    # Student's t with four degrees of freedom: real particles have outliers, too.
    density = -2.5 * np.log1p(((moved - centre) / width) ** 2 / 4).sum(-1)
    density = np.where(np.isfinite(density), density, -np.inf)
    density = density + log_density(undone, options).clip(-20)
    prior = np.array([slip.prior - options.unit_slip + options.row_slip if slip.prior else 0.0 for slip in slips])
    # One soft particle may come close to flat; radii show only in what all of them do.
    odds = density + np.where([is_radius(slip) for slip in slips], -np.inf, prior)
    found: list[Finding] = []
    sure = (odds.max(axis=1) > odds[:, 0] + options.odds) & ~settled
    best = np.argmax(odds, axis=1)
    for h in np.unique(best[sure]):
        group = sure & (best == h)
        found.append(_slip_finding(tests, slips, np.median(odds[group], axis=0), group, numbers, options))
    return found


def _slip_finding(
    tests: _Tests,
    slips: Sequence[Slip],
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
    it = Apparent.of(numbers)
    modulus = it.modulus if np.isfinite(it.modulus) else it.loading_modulus
    who = "the tests" if not names else f"particle{'s' if len(names) > 1 else ''} {_listed(names)}"
    sentence = (
        f"{likely(best)}{'' if second is None else ', or ' + likely(second)}: as given, {who} reach"
        f"{'es' if len(names) == 1 else ''} {_number(it.stress)} MPa at a strain of {_number(it.strain)} with a modulus"
        f" of {_modulus(modulus)} and diameters of {_number(numbers[2:5].mean())} um"
        f", which {'fits no usual solid' if not names else 'fits neither the others nor any usual solid'}"
    )
    soft = best.force > 0 and not best.displacement and not any(best.diameters)
    remedy = remedy_of(best) + ("" if second is None else f"; or else {_lower(remedy_of(second))}")
    if soft:
        remedy += "; a material as soft as rubber would look the same, and is none that this law describes"
    return Finding(CHECK, "bad", sentence[0].upper() + sentence[1:], remedy, names)


def _lower(text: str) -> str:
    return text[0].lower() + text[1:]


def _listed(names: Sequence[str], most: int = 6) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _number(decades: float | np.ndarray) -> str:
    return f"{float(f'{10.0 ** min(float(decades), 300.0):.2g}'):g}"


def _modulus(decades: float | np.ndarray) -> str:
    return f"{_number(decades - 3)} GPa" if float(decades) >= 3 else f"{_number(decades)} MPa"


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
    density = -beyond(loading[:, None] + decades, *in_decades(options.loading_s), options.edge)
    density = density - beyond(interval[:, None] + decades, *in_decades(options.interval_s), options.edge)
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


def _outside(tests: _Tests, options: PlausibilityOptions) -> list[Finding]:
    """Numbers beyond every range though no slip explains them."""
    found: list[Finding] = []
    apart = Apparent.of(tests.numbers).closure > 0
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
    numbers = _typical(tests.numbers)
    whole = Apparent.of(numbers)
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
    return found


def _fitted_modulus(typical: np.ndarray, modulus_MPa: float | None, options: PlausibilityOptions) -> list[Finding]:
    """A fitted modulus that no solid has, of tests that look ordinary."""
    low, high = _hull([s.modulus_MPa for s in options.solids])
    if modulus_MPa is None or low / options.beyond <= modulus_MPa <= options.beyond * high:
        return []
    it = Apparent.of(typical)
    own = (
        f"with about {_modulus(it.modulus)} told by the slope of unloading"
        if np.isfinite(it.modulus)
        else f"as stiff in loading as an elastic sphere of {_modulus(it.loading_modulus)}"
    )
    return [
        Finding(
            "fitted modulus",
            "bad",
            f"The fitted modulus of {modulus_MPa / 1e3:.3g} GPa is none of a solid ({low / 1e3:g} to"
            f" {high / 1e3:g} GPa), though the tests are those of an ordinary one, {own}",
            "Do not use it: the fitted form of unloading is not that of these tests; another form may be",
        )
    ]


def _hull(ranges: Sequence[Range]) -> Range:
    return min(low for low, _ in ranges), max(high for _, high in ranges)


@dataclass(frozen=True)
class Material:
    """How stiff a campaign's material is beside micro-crystalline cellulose.

    Attributes:
        decades: logarithm to the base of 10 of the ratio of stresses at the same strain.
        stress_MPa: median peak stress.
        strain: median strain there, scaled with the paper's shape factor [-].
    """

    decades: float
    stress_MPa: float
    strain: float


def other_material(campaign: Campaign, options: PlausibilityOptions | None = None) -> Material | None:
    """How much stiffer or softer than micro-crystalline cellulose the tests are; None if they are like it, or if a slip
    of unit or sign is more likely."""
    check_campaign(campaign)
    looks = _looks(campaign.raw or campaign, None, options or PlausibilityOptions())
    return None if worst(looks.findings) == "bad" else looks.material


def _material(tests: _Tests, it: Apparent, options: PlausibilityOptions) -> Material | None:
    D1, D2, D3 = tests.diameters_um.T
    x = (1 + PAPER_SHAPE_PARAMETER * (1 - D3**2 / (D1 * D2))) * 10**it.strain
    C1, C3, C5 = (np.exp(PAPER_LOG_C[name][0]) for name in ("C1", "C3", "C5"))
    ratios = it.stress - np.log10(C1 * x - (C3 * x) ** 3 + (C5 * x) ** 5)
    ratio = _median(np.where(np.isfinite(tests.column("fullness")), ratios, np.nan))
    if not abs(ratio) > np.log10(options.stiffer):
        return None
    return Material(ratio, float(10 ** _median(it.stress)), float(np.nanmedian(x)))


def _another_material(found: Material, it: Apparent) -> Finding:
    """Tests that are much stiffer or softer than micro-crystalline cellulose, which accuses nobody."""
    word = "stiffer" if found.decades > 0 else "softer"
    return Finding(
        CHECK,
        "told",
        f"The material is {_number(abs(found.decades))} times {word} in loading than micro-crystalline cellulose"
        f" (Avicel PH-200): {_number(_median(it.stress))} MPa at a strain of"
        f" {_number(_median(it.strain))}; a typical solid otherwise",
    )
