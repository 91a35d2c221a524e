"""Whether a campaign's numbers can be those of compressed particles, and which wrong unit or sign would explain them.

Every hypothesis is judged by the same wide ranges: the numbers as given, and the numbers with one unit error undone
(`unit_errors`). One is named where undoing it brings the tests from far outside the ranges to inside: its log odds
against "as given" are the difference of the log densities plus its prior log odds (a Bayes factor).

What cannot be seen: a factor that leaves everything within the ranges. Loading, unloading and their ratio say the same
of a sphere of half the size with a modulus 1.4 times as large; radii given for diameters show only where the platens
would have come closer than the particle allows, in tests of cellulose to 5 MPa and more. Forces of cellulose in uN
taken for mN are those of a strong metal where tests end below 3 MPa. Times show only where they are far from any
test's.

A fitted modulus points to no unit: a wrong one moves it and the records' own stiffness by the same factor (both go as
force / (displacement^1.5 diameter^0.5)), so where the records are ordinary, the form of the law is at fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from .curve_features import CurveFeatures, curve_features
from .findings import Finding, worst
from .paper import PAPER_LOG_C, PAPER_SHAPE_PARAMETER
from .schema import Campaign, Curve, remembered
from .unit_errors import (
    CLOCKS,
    DIAMETER_UM,
    INTERVAL_S,
    LOADING_S,
    SOLIDS,
    UNIT_ERROR,
    Range,
    UnitError,
    apparent,
    beyond,
    hypotheses,
    in_words,
    is_radius,
    log_density,
    log_numbers,
    undo,
)
from .validate import check_campaign

CHECK = "plausibility"
ODDS = 3.0  # log odds from which on an error is reported: 20 to 1
ALIKE = 1.0  # log odds within which a second hypothesis is named, too
GROUP = 0.25  # share of the tests that have an error in common, of another instrument or another person
SPREAD = 0.2  # least standard deviation, in decades, between particles of one campaign
RANK_AT_REST = (0.80, 0.15, 0.05)
"""How often D3 is the smallest, middle and largest diameter of a particle that rests on a platen; of the paper's 20
particles (Table 1) it is so for 17, 3 and 0."""
BEYOND = 3.0  # factor beyond the ranges of all solids, themselves uncertain by about as much, that no solid reaches
STIFFER = 3.0
"""Factor of stress at the peak strain against the mean law of Avicel PH-200 beyond which another material is reported;
the law's particles scatter by 1.35."""


def check_plausibility(campaign: Campaign, *, modulus_MPa: float | None = None) -> tuple[Finding, ...]:
    """Report what a wrong unit, sign or column would explain in a campaign.

    Judges raw tests, before any fit: each test's peak, the stiffness of loading and unloading, the work given back, its
    sizes and its times. Of a checked campaign those that it was made from. Nothing is changed, and nothing is refused.
    The effective modulus of a fit is compared with the moduli of solids.

    Returns:
        Findings: "error" for a likely error, with the column and the remedy, and for numbers that no solid has; "info"
        where the material is not like micro-crystalline cellulose, which is no fault. What concerns a fitted modulus is
        of the check "fitted modulus" and points to no unit; all else is of the check "plausibility".
        `Finding.particles` names the particles where not all are concerned.
    """
    if not isinstance(campaign, Campaign):
        check_campaign(campaign)  # what is no campaign; one with wrong values is still looked at, to name their cause
    found = _diagnose(campaign.raw or campaign)
    if found.typical is None or worst(found.findings) == "error":
        return found.findings
    return (*found.findings, *_fitted_modulus(found.typical, modulus_MPa), *found.remark)


class Material(NamedTuple):
    """How stiff a material is compared with micro-crystalline cellulose: the ratio of stresses at the same strain in
    decades, the median peak stress, and the median strain there, scaled with the paper's shape factor."""

    decades: float
    stress_MPa: float
    strain: float


def other_material(campaign: Campaign) -> Material | None:
    """How much stiffer or softer than micro-crystalline cellulose the tests are; None if they are like it, or if a
    wrong unit or sign is more likely."""
    check_campaign(campaign)
    found = _diagnose(campaign.raw or campaign)
    return None if worst(found.findings) == "error" else found.material


def add_likely_unit_error(campaign: Campaign, problem: str, remedy: str) -> tuple[str, str]:
    """A problem and its remedy; with the likely wrong unit, sign or column that explains it, where there is one."""
    errors = [one for one in check_plausibility(campaign) if one.level == "error"]
    # What a wrong unit explains needs no other remedy.
    return (f"{problem}; {errors[0].sentence}", errors[0].remedy) if errors else (problem, remedy)


def wrong_signs(campaign: Campaign) -> bool:
    """Whether force, displacement or both are counted the other way round in most tests of a campaign."""
    tests = _Tests(campaign)
    turned = (tests.column("force_sign") < 0) | (tests.column("displacement_sign") < 0)
    return 2 * int(turned.sum()) > len(turned)


class _Diagnosis(NamedTuple):
    """What a campaign shows before any fit: findings, and, where its tests show anything, median numbers of theirs as
    `log_numbers` gives them, how its material differs from cellulose, and a remark on it if nothing else was found."""

    findings: tuple[Finding, ...] = ()
    typical: np.ndarray | None = None
    material: Material | None = None
    remark: tuple[Finding, ...] = ()


def _diagnose(campaign: Campaign) -> _Diagnosis:
    """The same for every question about a campaign, so worked out once."""

    def find() -> _Diagnosis:
        with np.errstate(all="ignore"):
            tests = _Tests(campaign)
            if not tests.names:
                return _Diagnosis()
            units = _units(tests)
            found = [*_signs(tests), *(units or _outside(tests)), *_clock(tests)]
            if not units:  # one diameter in another unit is out of order, too
                found += _order_of_diameters(tests)
            material, remark = _material(tests)
            return _Diagnosis(tuple(found), _typical(tests.numbers), material, () if found else remark)

    return remembered(campaign, "diagnosis", find)


class _Tests:
    """The tests of a campaign that show anything: names, sizes and features."""

    def __init__(self, campaign: Campaign) -> None:
        sizes = np.asarray(campaign.diameters_um, float)
        features = [_features(curve) for curve in campaign.curves]
        known = (np.isfinite(sizes) & (sizes > 0)).all(axis=1).tolist()
        rows = [i for i, (one, good) in enumerate(zip(features, known, strict=True)) if one is not None and good]
        self.names, self.diameters_um = [campaign.particles[i] for i in rows], sizes[rows]
        self.features, self.curves = [features[i] for i in rows], [campaign.curves[i] for i in rows]

    @cached_property
    def numbers(self) -> np.ndarray:
        """What `log_numbers` makes of them."""
        return log_numbers(self.features, self.diameters_um)

    @cached_property
    def swapped(self) -> np.ndarray:
        """The same with force and displacement exchanged."""
        return log_numbers([_features(curve, swapped=True) for curve in self.curves], self.diameters_um)

    def column(self, name: str) -> np.ndarray:
        return np.array([getattr(one, name) for one in self.features], float)

    def some(self, chosen: np.ndarray) -> tuple[str, ...]:
        """Names of the chosen tests, none where all are."""
        return () if chosen.all() else tuple(n for n, c in zip(self.names, chosen, strict=True) if c)


def _features(curve: Curve, *, swapped: bool = False) -> CurveFeatures | None:
    columns = (curve.displacement_um, curve.force_mN) if swapped else (curve.force_mN, curve.displacement_um)
    return remembered(curve, ("features", swapped), lambda: curve_features(curve.time_s, *columns))


# ---- units, and columns swapped --------------------------------------------------------------------------------------


def _units(tests: _Tests) -> list[Finding]:
    """Wrong units and swapped columns, of the whole campaign, of a group of its tests and of single particles."""
    errors = hypotheses()
    prior = np.array([one.prior for one in errors])
    undone = undo(tests.numbers, tests.swapped, errors)
    odds = log_density(undone) + prior
    whole = np.median(odds, axis=0)
    found = []
    if whole.max() > whole[0] + ODDS:
        concerned = (odds - prior)[:, np.argmax(whole)] > odds[:, 0] - ODDS
        found.append((whole, concerned if concerned.any() else ~concerned))  # the medians may be of different tests
    elif len(tests.names) >= 3:
        groups = [group for group in _agreeing(odds) if group.sum() >= GROUP * len(group)]
        found += [(np.median(odds[group], axis=0), group) for group in groups]
    corrected, settled = tests.numbers.copy(), np.zeros(len(tests.names), bool)
    for total, group in found:
        corrected[group] = undone[group, np.argmax(total)]
        settled |= group
    if len(tests.names) >= 4:
        single = _unlike_the_others(undo(corrected, tests.swapped, errors), corrected)
        # One soft particle may come close to flat; radii show only in what all of them do.
        single += np.where([is_radius(one) for one in errors], -np.inf, prior)
        groups = [group & ~settled for group in _agreeing(single)]
        found += [(np.median(single[group], axis=0), group) for group in groups if group.any()]
    return [_unit_finding(tests, errors, total, group) for total, group in found]


def _agreeing(odds: np.ndarray) -> list[np.ndarray]:
    """Groups of tests, booleans of shape (N,), which the same hypothesis explains; from log odds of shape (N, H)."""
    best, sure = np.argmax(odds, axis=1), odds.max(axis=1) > odds[:, 0] + ODDS
    return [sure & (best == one) for one in np.unique(best[sure])]


def _unlike_the_others(undone: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Log density of each test, with each error undone, among all others: shape (N, H)."""

    def compared(numbers: np.ndarray) -> np.ndarray:
        it = apparent(numbers)
        return np.concatenate([numbers[..., 2:5], it.strain[..., None], it.loading_modulus[..., None]], axis=-1)

    values = compared(numbers)
    centre = _typical(values)
    width = np.maximum(SPREAD, 1.4826 * _typical(np.abs(values - centre)))
    # Student's t with four degrees of freedom: real particles have outliers, too.
    density = -2.5 * np.log1p(((compared(undone) - centre) / width) ** 2 / 4).sum(-1)
    return np.where(np.isfinite(density), density, -np.inf) + log_density(undone).clip(-20)


def _unit_finding(tests: _Tests, errors: Sequence[UnitError], odds: np.ndarray, concerned: np.ndarray) -> Finding:
    """A finding of the likeliest unit error, and of a second that is about as likely, by their log odds."""
    first, second = np.argsort(-odds)[:2].tolist()
    likely, remedy = in_words(errors[first])
    if odds[second] > odds[first] - ALIKE and second != 0:
        other, instead = in_words(errors[second])
        likely, remedy = f"{likely}, or {other}", f"{remedy}; or else {instead}"
    force, *lengths, _ = errors[first].decades
    if force > 0 and not any(lengths):
        remedy += "; a material as soft as rubber would look the same, and is none that this law describes"
    names = tests.some(concerned)
    numbers = _typical(tests.numbers[concerned])
    it = apparent(numbers)
    modulus = it.modulus if np.isfinite(it.modulus) else it.loading_modulus
    sentence = (
        f"{likely}: as given, {_who(names, 'the tests')} reach{'es' if len(names) == 1 else ''} {_number(it.stress)}"
        f" MPa at a strain of {_number(it.strain)} with a modulus of {_modulus(modulus)} and diameters of"
        f" {_number(numbers[2:5].mean())} um, which fits {'neither the others nor any' if names else 'no'} usual solid"
    )
    return Finding(CHECK, "error", _capital(sentence), _capital(remedy), names)


# ---- signs, times, order of diameters --------------------------------------------------------------------------------


HEADERS = {"force": "force_mN", "displacement": "displacement_um"}


def _signs(tests: _Tests) -> list[Finding]:
    """Forces or displacements that are negative in compression."""
    force, displacement = tests.column("force_sign") < 0, tests.column("displacement_sign") < 0
    heights = np.log10(tests.column("force_mN"))
    # A record without a particle has a sign, too.
    real = heights > _median(heights) - 1.5
    kinds = (
        (force & displacement, ("force", "displacement"), "both go below zero as the load rises"),
        (force & ~displacement, ("force",), "the load rises as the force falls below zero"),
        (~force & displacement, ("displacement",), "the displacement falls as the force rises"),
    )
    found = []
    for turned, columns, seen in kinds:
        if not (real & turned).any():
            continue
        names = tests.some(real & turned)
        what, headers = " and ".join(f"{one}s" for one in columns), " and ".join(HEADERS[one] for one in columns)
        sentence = (
            f"The {what} of {_who(names)} seem to have the wrong sign: {seen}, and compression counts positive here"
        )
        remedy = (
            f"Turn the sign of {headers} in curves.csv, or write sign = -1 for {' and '.join(columns)} in the mapping"
            " file"
        )
        found.append(Finding(CHECK, "error", sentence, remedy, names))
    return found


def _clock(tests: _Tests) -> list[Finding]:
    """Times in a wrong unit."""
    loading, interval = np.log10(tests.column("loading_s")), np.log10(tests.column("interval_s"))
    shifts = np.array([one.decades[-1] for one in CLOCKS])
    density = -beyond(loading[:, None] + shifts, np.log10(LOADING_S))
    density = density - beyond(interval[:, None] + shifts, np.log10(INTERVAL_S))
    density = np.where(np.isfinite(loading)[:, None], density, 0.0)
    odds = np.median(density, axis=0) + np.array([one.prior for one in CLOCKS])
    best = int(np.argmax(odds))
    if best == 0 or odds[best] < odds[0] + ODDS:
        return []
    likely, remedy = in_words(CLOCKS[best])
    sentence = (
        f"{likely}: as given, loading takes {_number(_median(loading))} s with a reading every"
        f" {_number(_median(interval))} s"
    )
    return [Finding(CHECK, "error", _capital(sentence), _capital(remedy))]


def _order_of_diameters(tests: _Tests) -> list[Finding]:
    """D3 in a column of another diameter: particles rest on their flat side, so D3 is the smallest of most."""
    sizes = np.unique(tests.diameters_um, axis=0)
    sizes = sizes[sizes.max(axis=1) > 1.03 * sizes.min(axis=1)]
    if len(sizes) < 3:
        return []
    ranks = np.argsort(np.argsort(sizes, axis=1), axis=1)
    by_order = np.log(RANK_AT_REST)[ranks].sum(axis=0)
    # As given, or bodies that lie anyhow.
    odds = by_order[:2] + UNIT_ERROR - np.logaddexp(by_order[2], len(sizes) * np.log(1 / 3))
    best = int(np.argmax(odds))
    if odds[best] < ODDS:
        return []
    smallest = (ranks == 0).sum(axis=0)
    sentence = (
        f"The diameters D{best + 1} and D3 seem to be swapped: D{best + 1} is the smallest of {smallest[best]} of"
        f" {len(sizes)} particles and D3 of {smallest[2]}, and particles rest on their flat side"
    )
    remedy = (
        f"D3 is the diameter along the compression; exchange D{best + 1}_um and D3_um in particles.csv, unless the"
        " particles stood upright"
    )
    return [Finding(CHECK, "error", sentence, remedy)]


# ---- numbers that no solid has, and other materials ------------------------------------------------------------------


def _outside(tests: _Tests) -> list[Finding]:
    """Numbers beyond every range though no unit error explains them."""
    found: list[Finding] = []
    closed = apparent(tests.numbers).closure > 0
    if closed.any():
        names = tests.some(closed)
        sentence = f"The displacement of {_who(names)} exceeds the diameter D3, so that the platens would have touched"
        remedy = "Check the diameters and the zero of displacement"
        found.append(Finding(CHECK, "warning" if names else "error", sentence, remedy, names))
    numbers = _typical(tests.numbers)
    it = apparent(numbers)
    hulls = (
        ("diameter", "um", numbers[2:5].mean(), DIAMETER_UM),
        ("stress", "MPa", it.stress, _hull("stress_MPa")),
        ("stiffness of loading", "MPa", it.loading_modulus, _hull("loading_modulus_MPa")),
        ("modulus of unloading", "MPa", it.modulus, _hull("modulus_MPa")),
    )
    for what, unit, value, (low, high) in hulls:
        if value < np.log10(low / BEYOND) or value > np.log10(high * BEYOND):
            sentence = (
                f"A typical {what} of {_number(value)} {unit} is outside the range of any solid between platens"
                f" ({low:g} to {high:g} {unit}), and no single unit error explains it"
            )
            remedy = "Check the units of force, displacement and diameters, and that tests are of single particles"
            return [*found, Finding(CHECK, "error", sentence, remedy)]
    return found


def _fitted_modulus(typical: np.ndarray, modulus_MPa: float | None) -> list[Finding]:
    """A fitted modulus that no solid has, of tests that look ordinary."""
    low, high = _hull("modulus_MPa")
    if modulus_MPa is None or low / BEYOND <= modulus_MPa <= BEYOND * high:
        return []
    it = apparent(typical)
    own = (
        f"with about {_modulus(it.modulus)} by the slope of unloading"
        if np.isfinite(it.modulus)
        else f"as stiff in loading as an elastic sphere of {_modulus(it.loading_modulus)}"
    )
    sentence = (
        f"The fitted modulus of {modulus_MPa / 1e3:.3g} GPa is outside the range of any solid ({low / 1e3:g} to"
        f" {high / 1e3:g} GPa), though the tests are those of an ordinary one, {own}"
    )
    remedy = "Do not use it: the fitted form of unloading is not that of these tests; another form may be"
    return [Finding("fitted modulus", "error", sentence, remedy)]


def _material(tests: _Tests) -> tuple[Material | None, tuple[Finding, ...]]:
    """How the tests differ from micro-crystalline cellulose, with a remark on it, which points to no fault."""
    D1, D2, D3 = tests.diameters_um.T
    it = apparent(tests.numbers)
    x = (1 + PAPER_SHAPE_PARAMETER * (1 - D3**2 / (D1 * D2))) * 10**it.strain
    C1, C3, C5 = (np.exp(PAPER_LOG_C[name][0]) for name in ("C1", "C3", "C5"))
    ratios = it.stress - np.log10(C1 * x - (C3 * x) ** 3 + (C5 * x) ** 5)
    ratio = _median(np.where(np.isfinite(tests.column("fullness")), ratios, np.nan))
    if not abs(ratio) > np.log10(STIFFER):
        return None, ()
    sentence = (
        f"The material is {_number(abs(ratio))} times {'stiffer' if ratio > 0 else 'softer'} in loading than"
        f" micro-crystalline cellulose (Avicel PH-200): {_number(_median(it.stress))} MPa at a strain of"
        f" {_number(_median(it.strain))}; a typical solid otherwise"
    )
    material = Material(ratio, float(10 ** _median(it.stress)), float(np.nanmedian(x)))
    return material, (Finding(CHECK, "info", sentence),)


# ---- numbers and words -----------------------------------------------------------------------------------------------


def _hull(name: str) -> Range:
    """The range of all classes of solids together."""
    ranges = [getattr(solid, name) for solid in SOLIDS]
    return min(low for low, _ in ranges), max(high for _, high in ranges)


def _median(values: np.ndarray) -> float:
    """Median of what is finite; NaN if nothing is."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.nan


def _typical(rows: np.ndarray) -> np.ndarray:
    """Median of each column of an array of shape (N, n)."""
    return np.array([_median(column) for column in rows.T])


def _who(names: Sequence[str], everyone: str = "all tests") -> str:
    if not names:
        return everyone
    more = f" and {len(names) - 6} more" if len(names) > 6 else ""
    return f"particle{'s' if len(names) > 1 else ''} {', '.join(names[:6])}{more}"


def _capital(text: str) -> str:
    return text[0].upper() + text[1:]


def _number(decades: float | np.ndarray) -> str:
    return f"{float(f'{10.0 ** min(float(decades), 300.0):.2g}'):g}"


def _modulus(decades: float | np.ndarray) -> str:
    return f"{_number(decades - 3)} GPa" if float(decades) >= 3 else f"{_number(decades)} MPa"
