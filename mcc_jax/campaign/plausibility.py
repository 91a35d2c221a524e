"""Whether a campaign's numbers can be those of compressed particles, and which wrong unit or sign would explain them.

A unit error is named where undoing it (`unit_errors`) brings the tests from far outside wide ranges to inside: its log
odds against "as given" are the difference of the log densities plus its prior log odds (a Bayes factor). A factor that
leaves everything within the ranges cannot be seen. A fitted modulus points to no unit: a wrong one moves it and the
records' own stiffness by the same factor.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from . import unit_errors
from .findings import Finding, Level, has_error
from .paper import PAPER_LOG_C, PAPER_SHAPE_PARAMETER
from .schema import Campaign, Curve, check_campaign, remembered
from .unit_errors import CurveFeatures, UnitError, apparent, beyond, curve_features, in_words, log_density

ODDS = 3.0  # log odds from which on an error is reported: 20 to 1
ALIKE = 1.0  # log odds within which a second hypothesis is named, too
GROUP = 0.25  # share of the tests that have an error in common, of another instrument or another person
SPREAD = 0.2  # least standard deviation, in decades, between particles of one campaign
# How often D3 is the smallest, middle and largest diameter; of the paper's 20 particles 17, 3 and 0
RANK_AT_REST = (0.80, 0.15, 0.05)
BEYOND = 3.0  # factor beyond the ranges of all solids, themselves uncertain by about as much, that no solid reaches
NO_SOLID = "fitted modulus"  # the `check` of the finding that no solid has the modulus of a fit
# Factor of stress against Avicel PH-200 beyond which another material is reported; its particles scatter by 1.35
STIFFER = 3.0


@np.errstate(all="ignore")
def check_plausibility(campaign: Campaign, *, modulus_MPa: float | None = None) -> tuple[Finding, ...]:
    """Report what a wrong unit, sign or column would explain in a campaign; nothing is changed or refused.

    Judges the raw tests: peak, stiffness of loading and unloading, the work given back, sizes and times; and the
    effective modulus of a fit. A finding is an "error" for a likely error, with the column and the remedy, and for
    numbers that no solid has; "info" where the material is not like microcrystalline cellulose.
    """
    tests = _tests(campaign)  # one with wrong values is looked at, too, to name their cause
    if not tests.names or has_error(tests.findings):
        return tests.findings
    fitted = _fitted_modulus(_typical(tests.numbers), modulus_MPa)
    material = None if tests.findings else _material(tests)
    return (*tests.findings, *fitted, *([] if material is None else [material.remark]))


class Material(NamedTuple):
    """Another material than microcrystalline cellulose."""

    stress_MPa: float  # median at the peaks
    strain: float  # there, times the paper's shape factor
    remark: Finding  # that it is stiffer or softer


@np.errstate(all="ignore")
def other_material(campaign: Campaign) -> Material | None:
    """The material of the tests; None if it is the paper's, or a wrong unit or sign is more likely."""
    tests = _tests(check_campaign(campaign))
    return None if not tests.names or has_error(tests.findings) else _material(tests)


def add_likely_unit_error(campaign: Campaign, problem: str, remedy: str) -> tuple[str, str]:
    """A problem and its remedy; with the likely wrong unit, sign or column that explains it, where there is one."""
    errors = [one for one in check_plausibility(campaign) if one.level == "error"]
    # What a wrong unit explains needs no other remedy.
    return (f"{problem}; {errors[0].sentence}", errors[0].remedy) if errors else (problem, remedy)


def wrong_signs(campaign: Campaign) -> bool:
    """Whether force, displacement or both are counted the other way round in most tests of a campaign."""
    features = _tests(campaign).features
    turned = (features.force_sign < 0) | (features.displacement_sign < 0)
    return 2 * int(turned.sum()) > len(turned)


class _Tests:
    """The tests of a campaign that show anything: names, sizes, features, and what they let conclude."""

    def __init__(self, campaign: Campaign) -> None:
        sizes = np.asarray(campaign.diameters_um, float)
        known = (np.isfinite(sizes) & (sizes > 0)).all(axis=1)
        rows = [i for i, curve in enumerate(campaign.curves) if known[i] and _features(curve) is not None]
        self.names, self.diameters_um = [campaign.particles[i] for i in rows], sizes[rows]
        self.curves = [campaign.curves[i] for i in rows]
        self.features = _columns([_features(curve) for curve in self.curves])

    @cached_property
    def numbers(self) -> np.ndarray:
        """What `unit_errors.log_numbers` makes of them."""
        return unit_errors.log_numbers(self.features, self.diameters_um)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong with them."""
        if not self.names:
            return ()
        units = _units(self)
        found = [*_signs(self), *(units or _outside(self)), *_clock(self.features)]
        if not units:  # one diameter in another unit is out of order, too
            found += _order_of_diameters(self.diameters_um)
        return tuple(found)

    def some(self, chosen: np.ndarray) -> tuple[str, ...]:
        """Names of the chosen tests, none where all are."""
        return () if chosen.all() else tuple(n for n, c in zip(self.names, chosen, strict=True) if c)


def _tests(campaign: Campaign) -> _Tests:
    raw = campaign.raw or campaign
    return remembered(raw, "tests", lambda: _Tests(raw))


def _features(curve: Curve, *, swapped: bool = False) -> CurveFeatures | None:
    columns = (curve.displacement_um, curve.force_mN) if swapped else (curve.force_mN, curve.displacement_um)
    return remembered(curve, ("features", swapped), lambda: curve_features(curve.time_s, *columns))


def _columns(tests: Sequence[CurveFeatures | None]) -> CurveFeatures:
    """Features of several tests as arrays, NaN for a test without any."""
    unknown = (np.nan,) * len(CurveFeatures._fields)
    rows = np.array([unknown if one is None else one for one in tests], float)
    return CurveFeatures(*rows.reshape(-1, len(unknown)).T)


def _finding(sentence: str, remedy: str, names: tuple[str, ...] = (), level: Level = "error") -> Finding:
    return Finding("plausibility", level, sentence[0].upper() + sentence[1:], remedy[:1].upper() + remedy[1:], names)


def _units(tests: _Tests) -> list[Finding]:
    """Wrong units and swapped columns, of the whole campaign, of a group of its tests and of single particles."""
    errors = unit_errors.hypotheses()
    prior = np.array([one.prior for one in errors])
    exchanged = _columns([_features(curve, swapped=True) for curve in tests.curves])
    swapped = unit_errors.log_numbers(exchanged, tests.diameters_um)
    undone = unit_errors.undo(tests.numbers, swapped, errors)
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
        single = _unlike_the_others(unit_errors.undo(corrected, swapped, errors), corrected)
        # One soft particle may come close to flat; radii show only in what all of them do.
        single += np.where([unit_errors.is_radius(one) for one in errors], -np.inf, prior)
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
        return np.concatenate([numbers[..., 2:5], it.strain[..., None], it.loading_modulus_MPa[..., None]], axis=-1)

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
        remedy += "; a material as soft as rubber would look the same, but this law does not describe such a material"
    names = tests.some(concerned)
    numbers = _typical(tests.numbers[concerned])
    it = apparent(numbers)
    modulus = it.modulus_MPa if np.isfinite(it.modulus_MPa) else it.loading_modulus_MPa
    reached = f"{_number(it.stress_MPa)} MPa at a strain of {_number(it.strain)} with a modulus of {_modulus(modulus)}"
    sizes = f"diameters of {_number(numbers[2:5].mean())} um"
    sentence = (
        f"{likely}: as given, {_who(names, 'the tests')} reach{'es' if len(names) == 1 else ''} {reached} and {sizes},"
        f" which matches {'neither the other tests nor any' if names else 'no'} common solid"
    )
    return _finding(sentence, remedy, names)


def _signs(tests: _Tests) -> Iterator[Finding]:
    """Forces or displacements that are negative in compression."""
    force, displacement = tests.features.force_sign < 0, tests.features.displacement_sign < 0
    heights = np.log10(tests.features.force_mN)
    real = heights > _median(heights) - 1.5  # a record without a particle has a sign, too
    for turned, columns, seen in (
        (force & displacement, ("force_mN", "displacement_um"), "both go below zero as the load rises"),
        (force & ~displacement, ("force_mN",), "the load rises as the force falls below zero"),
        (~force & displacement, ("displacement_um",), "the displacement falls as the force rises"),
    ):
        if (real & turned).any():
            names = tests.some(real & turned)
            channels = [column.partition("_")[0] for column in columns]
            what = f"the {' and '.join(f'{channel}s' for channel in channels)} of {_who(names)}"
            sentence = f"{what} seem to have the wrong sign: {seen}, and compression is positive here"
            remedy = f"reverse the sign of {' and '.join(columns)} in curves.csv, or write sign = -1 for"
            yield _finding(sentence, f"{remedy} {' and '.join(channels)} in the mapping file", names)


def _clock(features: CurveFeatures) -> list[Finding]:
    """Times in a wrong unit."""
    loading, interval = np.log10(features.loading_s)[:, None], np.log10(features.interval_s)[:, None]
    shifts, prior = np.array([(one.decades[-1], one.prior) for one in unit_errors.CLOCKS]).T
    outside = beyond(loading + shifts, np.log10(unit_errors.LOADING_S))
    outside = outside + beyond(interval + shifts, np.log10(unit_errors.INTERVAL_S))
    odds = np.median(np.where(np.isfinite(loading), -outside, 0.0), axis=0) + prior
    best = int(np.argmax(odds))
    if best == 0 or odds[best] < odds[0] + ODDS:
        return []
    likely, remedy = in_words(unit_errors.CLOCKS[best])
    pace = f"loading takes {_number(_median(loading))} s with a reading every {_number(_median(interval))} s"
    return [_finding(f"{likely}: as given, {pace}", remedy)]


def _order_of_diameters(diameters_um: np.ndarray) -> list[Finding]:
    """D3 in a column of another diameter: particles rest on their flat side, so D3 is the smallest of most."""
    sizes = np.unique(diameters_um, axis=0)
    sizes = sizes[sizes.max(axis=1) > 1.03 * sizes.min(axis=1)]
    if len(sizes) < 3:
        return []
    ranks = np.argsort(np.argsort(sizes, axis=1), axis=1)
    by_order = np.log(RANK_AT_REST)[ranks].sum(axis=0)
    # As given, or bodies that lie anyhow.
    odds = by_order[:2] + unit_errors.UNIT_ERROR - np.logaddexp(by_order[2], len(sizes) * np.log(1 / 3))
    best = int(np.argmax(odds))
    if odds[best] < ODDS:
        return []
    smallest, other = (ranks == 0).sum(axis=0), f"D{best + 1}"
    sentence = (
        f"the diameters {other} and D3 seem to be swapped: {other} is the smallest diameter in {smallest[best]} of"
        f" {len(sizes)} particles and D3 of {smallest[2]}, and particles rest on their flat side"
    )
    exchange = f"exchange {other}_um and D3_um in particles.csv, unless the particles stood upright"
    return [_finding(sentence, f"D3 is the diameter along the compression; {exchange}")]


def _outside(tests: _Tests) -> Iterator[Finding]:
    """Numbers beyond every range though no unit error explains them."""
    closed = unit_errors.closure(tests.numbers) > 0
    if closed.any():
        names = tests.some(closed)
        sentence = f"the displacement of {_who(names)} exceeds the diameter D3, so that the platens would have touched"
        remedy = "check the diameters and the zero of displacement"
        yield _finding(sentence, remedy, names, "warning" if names else "error")
    numbers = _typical(tests.numbers)
    it = apparent(numbers)
    for what, unit, value, (low, high) in (
        ("diameter", "um", numbers[2:5].mean(), unit_errors.DIAMETER_UM),
        ("stress", "MPa", it.stress_MPa, _hull("stress_MPa")),
        ("stiffness of loading", "MPa", it.loading_modulus_MPa, _hull("loading_modulus_MPa")),
        ("modulus of unloading", "MPa", it.modulus_MPa, _hull("modulus_MPa")),
    ):
        if value < np.log10(low / BEYOND) or value > np.log10(high * BEYOND):
            sentence = (
                f"a typical {what} of {_number(value)} {unit} is outside the range of any solid between platens"
                f" ({low:g} to {high:g} {unit}), and no single unit error explains it"
            )
            remedy = "check the units of force, displacement and diameters, and that tests are of single particles"
            yield _finding(sentence, remedy)
            return


def _fitted_modulus(typical: np.ndarray, modulus_MPa: float | None) -> list[Finding]:
    """A fitted modulus that no solid has, of tests that look ordinary."""
    low, high = _hull("modulus_MPa")
    if modulus_MPa is None or low / BEYOND <= modulus_MPa <= BEYOND * high:
        return []
    it = apparent(typical)
    own = f"as stiff in loading as an elastic sphere of {_modulus(it.loading_modulus_MPa)}"
    if np.isfinite(it.modulus_MPa):
        own = f"with about {_modulus(it.modulus_MPa)} by the slope of unloading"
    sentence = (
        f"The fitted modulus of {modulus_MPa / 1e3:.3g} GPa is outside the range of any solid ({low / 1e3:g} to"
        f" {high / 1e3:g} GPa), although the tests look like those of an ordinary solid, {own}"
    )
    remedy = "Do not use it: the fitted form of unloading is not that of these tests; another form may be"
    return [Finding(NO_SOLID, "error", sentence, remedy)]


def _material(tests: _Tests) -> Material | None:
    """The material of the tests if it is not like microcrystalline cellulose, which is no fault."""
    D1, D2, D3 = tests.diameters_um.T
    it = apparent(tests.numbers)
    x = (1 + PAPER_SHAPE_PARAMETER * (1 - D3**2 / (D1 * D2))) * 10**it.strain
    C1, C3, C5 = (np.exp(PAPER_LOG_C[name][0]) for name in ("C1", "C3", "C5"))
    ratios = it.stress_MPa - np.log10(C1 * x - (C3 * x) ** 3 + (C5 * x) ** 5)
    ratio = _median(np.where(np.isfinite(tests.features.fullness), ratios, np.nan))
    if not abs(ratio) > np.log10(STIFFER):
        return None
    stress, strain = _median(it.stress_MPa), _median(it.strain)
    remark = (
        f"the material is {_number(abs(ratio))} times {'stiffer' if ratio > 0 else 'softer'} in loading than"
        f" microcrystalline cellulose (Avicel PH-200): {_number(stress)} MPa at a strain of {_number(strain)}; a"
        " typical solid otherwise"
    )
    return Material(float(10**stress), float(np.nanmedian(x)), _finding(remark, "", level="info"))


def _hull(name: str) -> unit_errors.Range:
    """The range of all classes of solids together."""
    lows, highs = zip(*(getattr(solid, name) for solid in unit_errors.SOLIDS), strict=True)
    return min(lows), max(highs)


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


def _number(decades: float | np.ndarray) -> str:
    return f"{float(f'{10.0 ** min(float(decades), 300.0):.2g}'):g}"


def _modulus(decades: float | np.ndarray) -> str:
    return f"{_number(decades - 3)} GPa" if float(decades) >= 3 else f"{_number(decades)} MPa"
