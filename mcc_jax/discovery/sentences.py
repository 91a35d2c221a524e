"""The answer in a few words, in one sentence, and as a paragraph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from .._format import interval, listed, plain, with_sd
from ..calibrate.judgement import is_unknown
from .settings import AT_PEAKS, DECISIONS, ENOUGH, WITHIN

if TYPE_CHECKING:
    from .result import Discovery, Effect

JUMPS, CHECKS = 5, 3  # sudden steps and checks that a summary lists


def within_noise(gap: Mapping[str, Any]) -> bool | None:
    """Whether held-out particles agree with what was added within the noise; None where nobody knows."""
    if gap["closed_fraction"] is None or not gap["steps"]:
        return None
    last = gap["steps"][-1]
    low = (last.get("chi2_interval_95") or [None])[0]
    return (last["chi2_per_dof"] if low is None else low) <= 1 + WITHIN


def verdict_in_words(content: Mapping[str, Any]) -> str:
    """The verdict of a `discovery.json` for people, in a few words."""
    match content["verdict"]:
        case "NO_GAP":
            return "nothing missing"
        case "FIT_NOT_CONVERGED":
            return "no answer, the law could not be fitted"
        case "UNLISTED":
            return "unlisted effect, described by a formula"
    names = listed([plain(effect["mechanism"]) for effect in content["effects"]])
    if content["verdict"] == "SET":
        return f"effect not unique: {names} or what looks like it"
    return f"effect{'s' if len(content['effects']) > 1 else ''} identified: {names}"


def headline(content: Mapping[str, Any], tests: str = "tests") -> str:
    """The answer of a `discovery.json` in one sentence; `tests` is what the tests are called."""
    match content["verdict"]:
        case "NO_GAP":
            return "Nothing is missing in the law that these tests could show."
        case "FIT_NOT_CONVERGED":
            return "The law could not be fitted well enough to ask what it lacks."
    closed = within_noise(content["gap"])
    agree = f"law and {tests} agree within the noise" if closed else "part of the gap closes, and part remains"
    return f"{_missing(content)}{'' if closed is None else f'; with it added, {agree}'}."


def _missing(content: Mapping[str, Any]) -> str:
    if content["verdict"] == "UNLISTED" or not content["effects"]:
        return "The law misses something that no listed mechanism explains"
    names = listed([plain(effect["mechanism"]) for effect in content["effects"]])
    return f"The law misses {names}{', or what looks like it' if content['verdict'] == 'SET' else ''}"


def summary_of(found: Discovery) -> str:
    """One paragraph: what is missing, where, how sure, what that did, what next."""
    count = len(found.base.selection.kept) if found.base is not None else 0
    sentences = [_verdict(found, count)]
    for effect, names in zip(found.effects, found.candidate_set, strict=True):
        unit = "" if effect.variant.unit == "-" else f" {effect.variant.unit}"
        value = f"{plain(effect.variant.name)}, {effect.amplitude:.3g} +- {effect.sd:.2g}{unit}"
        sentences.append(f"It is {plain(effect.mechanism)} with probability {effect.probability:.2f} ({value}).")
        if effect.jumps:
            sentences.append(_jumps(found, effect))
        elif abs(effect.amplitude) > effect.variant.plausible[1]:
            most = f"{effect.variant.plausible[1]:g}{unit}"
            sentences.append(
                f"That is more than is plausible (at most {most}): something else may be in it, and the parameters "
                "beside it are as doubtful."
            )
        rivals = [plain(n) for n in names if n != effect.mechanism and n not in found.paired]
        rivals += [" together with ".join(map(plain, pair)) for pair in found.pairs]
        if rivals:
            sentences.append(f"These tests cannot distinguish it from {listed(rivals, 'or')}.")
        if effect.misfit > 2 * DECISIONS.misfit:
            sentences.append(f"Its formula is off by about {100 * effect.misfit:.0f} % of the effect.")
    if found.closure is not None:
        near = f", most like {plain(found.closure.resembles[0][0])}" if found.closure.resembles else ""
        sentences.append(f"A formula describes it{near}: {found.closure.formula}.")
    sentences += _gap(found)
    if found.leads:
        each = [f"{plain(one['mechanism'])} ({max(100 * one['share'], 0.1):.2g} %)" for one in found.leads]
        text = f"Beside it, a share of the evidence may be due to {listed(each, 'or')}; that is not added to the law."
        sentences.append(text)
    if found.parameters_after and found.verdict in ("NAMED", "SET", "UNLISTED"):
        sentences.append(_modulus(found.parameters_before, found.parameters_after))
    sentences += next_tests(found.next_experiments, found.checks)
    if found.untestable:
        needs = "; ".join(f"{plain(u['mechanism'])} (needs {u['needs']})" for u in found.untestable)
        sentences.append(f"These tests say nothing about {needs}.")
    return " ".join(sentences)


def _modulus(before: dict[str, Any], after: dict[str, Any]) -> str:
    """What the addition did to the modulus: to that at the peaks, where formulas of the modulus take it elsewhere."""
    own, now, was = after["effective_modulus_MPa"], after[AT_PEAKS], before[AT_PEAKS]
    if is_unknown(now):
        return f"With it these tests do not determine the effective modulus (95 % interval {interval(now, 1e-3)} GPa)."
    where = "" if own["value"] == now["value"] else " at the peaks of these tests"
    return f"With it the effective modulus{where} is {with_sd(now, 1e-3)} GPa instead of {with_sd(was, 1e-3)} GPa."


def _verdict(found: Discovery, count: int) -> str:
    """What is missing, and where, in one sentence."""
    chance = f"probability of so much evidence by chance: {found.p_any:.2g}"
    if found.verdict == "NO_GAP":
        return (
            f"The law and the {count} tests agree within the noise; nothing is missing that they could show ({chance})."
        )
    names = " and ".join(plain(e.mechanism) for e in found.effects)
    lead = f"The law misses {names}" if names else "The law misses something that no listed mechanism explains"
    if found.verdict == "SET":
        lead += ", or what looks like it"
    return f"{lead}: law and {count} tests disagree{_place(found)} ({chance})."


def _gap(found: Discovery) -> list[str]:
    gap = found.gap()
    if gap["closed_fraction"] is None:
        return []
    first, last = (step["chi2_per_dof"] for step in (gap["steps"][0], gap["steps"][-1]))
    open_still = gap["steps"][-1]["chi2_interval_95"][0]
    sentences = [
        f"On held-out particles it closes {100 * gap['closed_fraction']:.0f} % of the gap "
        f"(chi2 per point {first:.3g} before, {last:.3g} after; 1 is noise alone)."
    ]
    if open_still is not None and open_still > 1 + WITHIN:
        sentences.append("The gap is named, not closed: the formula does not describe all of it.")
    return sentences


def next_tests(experiments: Sequence[Mapping[str, Any]], checks: Sequence[Mapping[str, str]]) -> list[str]:
    """Which further test, or which direct checks, would separate the candidates, in sentences."""
    sentences = []
    best = experiments[0] if experiments else None
    sure = best is not None and best["power"] >= ENOUGH
    if best is not None:
        names = listed([plain(n) for n in best["separates"]], "or")
        doubt = "" if sure else f"No further test of those tried on paper would surely separate {names}. "
        sentences.append(
            f"{doubt}{'Next' if sure else 'The best'}: {best['experiment']}, {best['particles']} further particles; "
            f"with these it would separate {names} with probability {best['power']:.2f}."
        )
    if checks and not sure:
        each = "; ".join(f"{plain(one['mechanism'])}: {one['check']}" for one in checks[:CHECKS])
        sentences.append(f"Each would show by itself ({each}).")
    return sentences


def _jumps(found: Discovery, effect: Effect) -> str:
    """The largest sudden steps, one by one."""
    largest = sorted(effect.jumps, key=lambda jump: -jump.size)[:JUMPS]
    unit = effect.variant.unit
    each = [f"{j.size:.2g} {unit} at {j.stress_MPa:.2g} MPa in {found.name_of(j.particle)}" for j in largest]
    more = len(effect.jumps) - len(largest)
    return f"It jumps by {', by '.join(each)}{f' and {more} more' if more else ''}."


def _place(found: Discovery) -> str:
    if not found.where:
        return ""
    first = found.where[0]
    low, high = first["load_fraction"]
    part = "" if first["segment"] == "hold" else f" between {100 * low:.0f} and {100 * high:.0f} % of the largest load"
    segment = f"{first['segment']}s" if first["segment"] == "hold" else first["segment"]
    return f", most of all in {segment}{part}, in {len(first['particles'])} particles"
