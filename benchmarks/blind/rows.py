"""The rows of the table: one for every figure that the bench measures, with its bar and its 95 % interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import kstest

from .outcome import Outcome, calibration_error, share_over, wilson
from .settings import SETTINGS
from .truth import Truths

_S = SETTINGS.scoring


@dataclass(frozen=True)
class Row:
    """One figure. passed: whether its point estimate meets the bar; None without a bar or without data."""

    name: str
    bar: str
    text: str
    interval: str
    number: int
    passed: bool | None


def _rate(
    name: str,
    flags: Sequence[bool],
    *,
    least: float | None = None,
    most: float | None = None,
    groups: Sequence[str] | None = None,
) -> Row:
    bars = [f">= {100 * least:g} %" if least is not None else "", f"<= {100 * most:g} %" if most is not None else ""]
    bar = ", ".join(filter(None, bars))
    if not len(flags):
        return Row(name, bar, "not measured", "", 0, None)
    share = share_over(flags, groups)
    low, high = wilson(share * len(flags), len(flags))
    passed = (least is None or share >= least) and (most is None or share <= most) if bar else None
    return Row(name, bar, f"{100 * share:.1f} %", f"{100 * low:.1f}-{100 * high:.1f} %", len(flags), passed)


def _value(
    name: str,
    values: Sequence[float],
    *,
    bar: str = "",
    passes: Callable[[float], bool] | None = None,
    of: Callable[[np.ndarray], float] = np.mean,
) -> Row:
    """A number with the interval of a bootstrap over campaigns."""
    if not len(values):
        return Row(name, bar, "not measured", "", 0, None)
    data = np.asarray(values, float)
    picks = np.random.default_rng(0).integers(0, len(data), (400, len(data)))
    low, high = np.quantile([of(data[pick]) for pick in picks], [0.025, 0.975])
    found = float(of(data))
    return Row(name, bar, f"{found:.3g}", f"{low:.3g} to {high:.3g}", len(data), passes(found) if passes else None)


def _at_least(outcomes: Sequence[Outcome], strength: float) -> list[Outcome]:
    return [o for o in outcomes if o.strength >= _S.slack * strength]


def table(outcomes: Sequence[Outcome], truths: Truths, kinds: dict[str, str]) -> list[Row]:
    """All rows of one run."""
    by = {kind: [o for o in outcomes if o.kind == kind] for kind in ("single", "pair", "null", "unlisted", "fault")}
    return [
        *singles(by["single"]),
        *pairs(by["pair"]),
        *nulls(by["null"]),
        *faults(by["fault"]),
        *unlisted(by["unlisted"], by["single"] + by["pair"], truths),
        *places(by["single"], truths),
        *probabilities(by["single"], [o for o in outcomes if o.kind != "fault"]),
        *closing(by["single"], truths),
        *running(outcomes, kinds),
    ]


def singles(outcomes: Sequence[Outcome]) -> list[Row]:
    """One listed effect; shares are means over mechanisms."""

    def row(name: str, flag: Callable[[Outcome], bool], of: Sequence[Outcome], **bar: float) -> Row:
        return _rate(name, [flag(o) for o in of], groups=[o.truth[0] for o in of], **bar)

    seen, strong = _at_least(outcomes, _S.seen), _at_least(outcomes, _S.strong)
    weak = [o for o in outcomes if o.strength < _S.weak]
    rows = [
        row(f"right name alone, lambda >= {_S.seen:g}", lambda o: o.right, seen, least=0.92),
        row(f"right name alone, lambda >= {_S.strong:g}", lambda o: o.right, strong, least=0.95),
    ]
    for generator in ("first", "second"):
        of = [o for o in seen if o.case["generator"] == generator]
        rows.append(row(f"  of these by the {generator} generator", lambda o: o.right, of))
    return [
        *rows,
        row("  said as NAMED", lambda o: o.right and o.verdict == "NAMED", seen),
        row(f"ghost beside the right name, lambda >= {_S.seen:g}", lambda o: o.ghost, seen, most=0.02),
        row(f"true name reported, lambda >= {_S.seen:g}", lambda o: o.truth[0] in o.reported, seen, least=0.98),
        row(f"right name alone, lambda < {_S.weak:g} (oracle less 5 points)", lambda o: o.right, weak),
    ]


def pairs(outcomes: Sequence[Outcome]) -> list[Row]:
    """Two listed effects."""
    strong = _at_least(outcomes, _S.pair)
    apart = [o for o in strong if abs(o.answer["correlation"]) < _S.apart]
    both = [set(o.truth) <= set(o.named) for o in apart]
    wrong = [bool(set(o.named) - set(o.truth)) for o in apart]
    text = f"lambda >= {_S.pair:g}, correlation < {_S.apart:g}"
    correlations = [abs(o.answer["correlation"]) for o in strong]
    return [
        _rate(f"two effects, both named, {text}", both, least=0.80),
        _rate(f"two effects, a wrong name, {text}", wrong, most=0.05),
        _value("  projected correlation of the pairs, size (median)", correlations, of=np.median),
    ]


def nulls(outcomes: Sequence[Outcome]) -> list[Row]:
    """Nothing hidden."""
    rows = [_rate("alarm, nothing hidden", [o.verdict != "NO_GAP" for o in outcomes], most=0.065)]
    for kind in dict.fromkeys(o.case["noise"] for o in outcomes):
        flags = [o.verdict != "NO_GAP" for o in outcomes if o.case["noise"] == kind]
        rows.append(_rate(f"  of these with noise of kind {kind}", flags))
    p = [o.found["p_anything_missing"] for o in outcomes if o.found.get("p_anything_missing") is not None]
    name, bar = "bootstrap p values uniform (KS p)", "> 0.01"
    if not p:
        return [*rows, Row(name, bar, "not measured", "", 0, None)]
    ks = float(kstest(p, "uniform").pvalue)
    return [*rows, Row(name, bar, f"{ks:.3g}", "", len(p), ks > 0.01)]


def faults(outcomes: Sequence[Outcome]) -> list[Row]:
    """Faults of the tester."""
    rows = [_rate("fault of the tester, no physics named", [not o.named for o in outcomes], least=1.0)]
    rows.append(_rate("fault of the tester, told as what it is", [o.told for o in outcomes]))
    kinds = dict.fromkeys(o.case["fault"] for o in outcomes)
    return [*rows, *(_rate(f"  {k} told", [o.told for o in outcomes if o.case["fault"] == k]) for k in kinds)]


def unlisted(hidden: Sequence[Outcome], listed: Sequence[Outcome], truths: Truths) -> list[Row]:
    """Effects on no list, and UNLISTED where a name is true."""
    seen = _at_least(hidden, _S.unlisted)
    errors = [truths.curve_error(o) for o in seen if o.verdict == "UNLISTED"]
    errors = [error for error in errors if error is not None]
    return [
        _rate(
            f"UNLISTED said, residual lambda >= {_S.unlisted:g}", [o.verdict == "UNLISTED" for o in seen], least=0.88
        ),
        _rate("UNLISTED said where a listed mechanism is true", [o.verdict == "UNLISTED" for o in listed], most=0.02),
        _rate(f"curve within {100 * _S.curve:g} % of its range, held out", [e <= _S.curve for e in errors]),
        _value("  error of the curve over its range (median)", errors, of=np.median),
    ]


def places(outcomes: Sequence[Outcome], truths: Truths) -> list[Row]:
    """Where law and data disagree."""
    strong = _at_least(outcomes, _S.where)
    found = [truths.held_by_places(o) for o in strong]
    return [
        _rate(
            f"places hold >= {100 * _S.held:g} % of the difference, lambda >= {_S.where:g}",
            [held >= _S.held for held, _ in found],
            least=0.90,
        ),
        _value("  share of the readings in these places (mean)", [part for _, part in found]),
    ]


def probabilities(singles_: Sequence[Outcome], outcomes: Sequence[Outcome]) -> list[Row]:
    """Whether stated probabilities are as often right as they say."""
    scores = [np.log(max(o.probabilities.get(o.truth[0], 0.0), _S.floor)) for o in singles_ if o.probabilities]
    stated, hit = [], []
    for o in outcomes:
        first = o.found["effects"][0] if o.named else {}
        if first.get("probability") is not None:
            stated.append(float(first["probability"]))
            hit.append(first["mechanism"] in o.truth)
    rows = [_value("log score of the true name, nats a single campaign", scores)]
    if stated:
        both = np.stack([stated, hit], axis=1)
        rows.append(
            _value(
                "calibration error of stated probabilities (ECE)",
                np.arange(len(both)),
                bar="<= 0.05",
                passes=lambda v: v <= 0.05,
                of=lambda pick: calibration_error(both[pick.astype(int), 0], both[pick.astype(int), 1]),
            )
        )
    else:
        rows.append(Row("calibration error of stated probabilities (ECE)", "<= 0.05", "not measured", "", 0, None))
    beyond = []
    for o in singles_:
        sets = o.found.get("candidate_set") or []
        if o.named and sets and o.probabilities:
            mass = sum(o.probabilities.get(name, 0.0) for name in set(sets[0]))
            beyond.append(float(o.truth[0] in sets[0]) - min(mass, 1.0))
    within = "within 0.03"
    return [*rows, _value("coverage of sets less stated mass", beyond, bar=within, passes=lambda v: abs(v) <= 0.03)]


def closing(outcomes: Sequence[Outcome], truths: Truths) -> list[Row]:
    """Whether the extended law fits to the noise, and its parameters cover the truth.

    Formulas of a modulus have each a strain or a humidity of their own where it is the law's; at the peaks they agree.
    """
    good = []
    for o in _at_least(outcomes, _S.where):
        steps = (o.found.get("gap") or {}).get("steps") or []
        chi2 = steps[-1].get("chi2_per_dof") if steps else None
        if chi2 is not None:
            half = _S.quantile * np.sqrt(2.0 / o.answer["points"]) + _S.chi2_slack
            low, high = steps[-1].get("chi2_interval_95") or (1.0 - half, 1.0 + half)
            good.append(low <= (1.0 if "chi2_interval_95" in steps[-1] else chi2) <= high)
    rows = [_rate(f"chi2 per point of the extended law within its interval, lambda >= {_S.where:g}", good, least=0.90)]
    for name, path in (("effective_modulus_MPa", ()), ("modulus_at_peaks_MPa", ()), ("log_C1", ("mean",))):
        flags, right = [], []
        for o in outcomes:
            value = (o.found.get("parameters_after") or {}).get(name)
            for part in path:
                value = (value or {}).get(part)
            interval = (value or {}).get("interval_95")
            if interval and None not in interval:
                truth = truths.modulus_at_peaks(o) if name == "modulus_at_peaks_MPa" else o.answer["truth"][name]
                flags.append(interval[0] <= truth <= interval[1])
                if o.right:
                    right.append(flags[-1])
        rows.append(_rate(f"{name} within its 95 % interval", flags, least=0.92, most=0.98))
        rows.append(_rate("  of these where the name is right", right))
    return rows


def running(outcomes: Sequence[Outcome], kinds: dict[str, str]) -> list[Row]:
    """Failures, their kinds, and time."""
    wrong = [o.key for o in outcomes if o.truth and not o.right and not o.failed]
    known = [key for key in wrong if key in kinds]
    rows = [_rate("no answer (crash, time-out, invalid, not converged)", [o.failed for o in outcomes])]
    if wrong and len(known) == len(wrong):
        flags = [kinds.get(o.key) == "search failure" for o in outcomes]
        rows.append(_rate("search failures among all campaigns", flags, most=0.01))
    else:
        text = f"not measured: {len(known)} of {len(wrong)} wrong verdicts have a kind"
        rows.append(Row("search failures among all campaigns", "<= 1 %", text, "", 0, None))
    twenty = [o for o in outcomes if o.answer["particles"] == 20 and o.result["status"] == "ok"]
    warm = [o.result["wall_s"] for o in twenty if not o.result["cold"]]
    cold = [o.result["wall_s"] for o in twenty if o.result["cold"]]
    rows.append(_value("seconds a campaign of 20 particles, warm (median)", warm, of=np.median))
    return [*rows, _value("seconds a campaign of 20 particles, cold (median)", cold, of=np.median)]
