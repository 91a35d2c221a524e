"""The answer in a few words, in one sentence, and as a paragraph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from .._format import interval, listed, plain, with_sd
from ..calibrate.judgement import is_unknown
from ..campaign.plausibility import NO_SOLID
from .settings import AT_PEAKS, DECISIONS, ENOUGH, WITHIN

if TYPE_CHECKING:
    from .result import Discovery, Effect

NOTHING_MISSING = "nothing missing"
FORM = "form"  # code of the finding that the tests follow another form of unloading than was asked for
TAKEN = "It also explains the unloading, which tells the effective modulus: the value that is left is of no solid."
JUMPS, CHECKS = 5, 3  # sudden steps and checks that a summary lists


def within_noise(gap: Mapping[str, Any]) -> bool | None:
    """Whether held-out particles agree with what was added within the noise; None where that is not known."""
    if gap["closed_fraction"] is None or not gap["steps"]:
        return None
    last = gap["steps"][-1]
    low = (last.get("chi2_interval_95") or [None])[0]
    return (last["chi2_per_dof"] if low is None else low) <= 1 + WITHIN


def verdict_in_words(content: Mapping[str, Any]) -> str:
    """The verdict of a `discovery.json` for people, in a few words."""
    names = listed([plain(effect["mechanism"]) for effect in content["effects"]])
    return {
        "NO_GAP": NOTHING_MISSING,
        "FIT_NOT_CONVERGED": "no answer, the law could not be fitted",
        "UNLISTED": "unlisted effect, described by a formula",
        "SET": f"effect not unique: {names} or what looks like it",
        "NAMED": f"effect{'s' if len(content['effects']) > 1 else ''} identified: {names}",
    }[content["verdict"]]


def headline(content: Mapping[str, Any], tests: str = "tests") -> str:
    """The answer of a `discovery.json` in one sentence; `tests` is what the tests are called."""
    if content["verdict"] == "NO_GAP":
        return "As far as these tests can show, nothing is missing from the law."
    if content["verdict"] == "FIT_NOT_CONVERGED":
        return "The law could not be fitted well enough to ask what it lacks."
    closed = within_noise(content["gap"])
    agree = f"law and {tests} agree within the noise" if closed else "part of the gap closes, and part remains"
    missing = _missing(content["verdict"], [effect["mechanism"] for effect in content["effects"]])
    return f"{missing}{'' if closed is None else f'; with it added, {agree}'}."


def _missing(verdict: str, names: Sequence[str]) -> str:
    if verdict == "UNLISTED" or not names:
        return "The law misses something that no listed mechanism explains"
    return f"The law misses {listed(list(map(plain, names)))}{', or what looks like it' if verdict == 'SET' else ''}"


def taken_back(names: Sequence[str], objection: str) -> str:
    """One paragraph: what would explain the tests does not hold on held-out particles; `names` of mechanisms."""
    most = listed(list(map(plain, names))) if names else "a formula of its own"
    return (
        f"The law does not describe these tests, and nothing was found that does. What explains most is {most}, but "
        f"it fails on held-out particles: {objection}. Inspect the tests one by one: records that continue through "
        "slip or breakage, particles of several kinds, or a material other than the one the law was made for could "
        "cause this. Leave out any record that is not a test of a single particle, and run discover again."
    )


def summary_of(found: Discovery) -> str:
    """One paragraph: what is missing, where, how sure, what that did, what next."""
    sentences = [f"{one.sentence}." for one in found.findings if one.code == FORM] + [_verdict(found)]
    for effect, names in zip(found.effects, found.candidate_set, strict=True):
        sentences += _effect(effect, names, found.pairs)
    if found.closure is not None:
        near = f", most like {plain(found.closure.resembles[0][0])}" if found.closure.resembles else ""
        sentences.append(f"A formula describes it{near}: {found.closure.formula}.")
    sentences += _gap(found.gap())
    if found.leads:
        each = [f"{plain(one['mechanism'])} ({max(100 * one['share'], 0.1):.2g} %)" for one in found.leads]
        text = f"In addition, a share of the evidence may be due to {listed(each, 'or')}; that is not added to the law."
        sentences.append(text)
    if found.parameters_after and found.verdict in ("NAMED", "SET", "UNLISTED"):
        no_solid = any(one.check == NO_SOLID for one in found.findings)
        sentences.append(TAKEN if no_solid else _modulus(found.parameters_before, found.parameters_after))
    sentences += next_tests(found.next_experiments, found.checks)
    if found.untestable:
        needs = "; ".join(f"{plain(u['mechanism'])} (needs {u['needs']})" for u in found.untestable)
        sentences.append(f"These tests say nothing about {needs}.")
    return " ".join(sentences)


def _verdict(found: Discovery) -> str:
    """What is missing, and where, in one sentence."""
    count = len(found.base.selection.kept) if found.base is not None else 0
    chance = f"probability of so much evidence by chance: {found.p_any:.2g}"
    if found.verdict == "NO_GAP":
        agree = f"The law and the {count} tests agree within the noise"
        if found.p_any < DECISIONS.level:
            chance += "; even so it is more probable that nothing is missing"
        return f"{agree}; as far as they can show, nothing is missing ({chance})."
    place = ""
    if found.where:
        first = found.where[0]
        low, high = (f"{100 * share:.0f}" for share in first["load_fraction"])
        part = f"{first['segment']} between {low} and {high} % of the largest load"
        part = "holds" if first["segment"] == "hold" else part
        place = f", most of all in {part}, in {len(first['particles'])} particles"
    missing = _missing(found.verdict, [e.mechanism for e in found.effects])
    return f"{missing}: law and {count} tests disagree{place} ({chance})."


def _effect(effect: Effect, names: Sequence[str], pairs: Sequence[Sequence[str]]) -> list[str]:
    """An effect with its numbers, and what may be in its place."""
    unit, (_, most) = "" if effect.variant.unit == "-" else f" {effect.variant.unit}", effect.variant.plausible
    value = f"{plain(effect.variant.name)}, {effect.amplitude:.3g} +- {effect.sd:.2g}{unit}"
    sentences = [f"It is {plain(effect.mechanism)} with probability {effect.probability:.2f} ({value})."]
    if effect.jumps:
        largest = sorted(effect.jumps, key=lambda jump: -jump.size)[:JUMPS]
        each = [f"{j.size:.2g} {effect.variant.unit} at {j.stress_MPa:.2g} MPa in {j.particle}" for j in largest]
        more = len(effect.jumps) - len(largest)
        sentences.append(f"It jumps by {', by '.join(each)}{f' and {more} more' if more else ''}.")
    elif abs(effect.amplitude) > most:
        sentences.append(
            f"That is more than is plausible (at most {most:g}{unit}): something else may be in it, and the parameters "
            "next to it are as doubtful."
        )
    paired = {name for pair in pairs for name in pair}
    rivals = [plain(n) for n in names if n != effect.mechanism and n not in paired]
    rivals += [" together with ".join(map(plain, pair)) for pair in pairs]
    if rivals:
        sentences.append(f"These tests cannot distinguish it from {listed(rivals, 'or')}.")
    if effect.misfit > 2 * DECISIONS.misfit:
        sentences.append(f"Its formula is off by about {100 * effect.misfit:.0f} % of the effect.")
    return sentences


def _gap(gap: Mapping[str, Any]) -> list[str]:
    if gap["closed_fraction"] is None:
        return []
    first, last = gap["steps"][0], gap["steps"][-1]
    sentences = [
        f"On held-out particles it closes {100 * gap['closed_fraction']:.0f} % of the gap (chi2 per point "
        f"{first['chi2_per_dof']:.3g} before, {last['chi2_per_dof']:.3g} after; 1 is noise alone)."
    ]
    still = last["chi2_interval_95"][0]
    if still is not None and still > 1 + WITHIN:
        sentences.append("The gap is named, not closed: the formula does not describe all of it.")
    return sentences


def _modulus(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """What the addition did to the modulus: to that at the peaks, where formulas of the modulus take it elsewhere."""
    own, now, was = after["effective_modulus_MPa"], after[AT_PEAKS], before[AT_PEAKS]
    if is_unknown(now):
        return f"With it these tests do not determine the effective modulus (95 % interval {interval(now, 1e-3)} GPa)."
    where = "" if own["value"] == now["value"] else " at the peaks of these tests"
    return f"With it the effective modulus{where} is {with_sd(now, 1e-3)} GPa instead of {with_sd(was, 1e-3)} GPa."


def next_tests(experiments: Sequence[Mapping[str, Any]], checks: Sequence[Mapping[str, str]]) -> list[str]:
    """Which further test, or which direct checks, would separate the candidates, in sentences."""
    sentences, sure = [], False
    if experiments:
        best = experiments[0]
        sure = best["power"] >= ENOUGH
        names = listed([plain(n) for n in best["separates"]], "or")
        doubt = "" if sure else f"None of the further tests considered would reliably separate {names}. "
        sentences.append(
            f"{doubt}{'Next' if sure else 'The best'}: {best['experiment']}, {best['particles']} further particles; "
            f"with these it would separate {names} with probability {best['power']:.2f}."
        )
    if checks and not sure:
        each = "; ".join(f"{plain(one['mechanism'])}: {one['check']}" for one in checks[:CHECKS])
        sentences.append(f"Each mechanism can be checked directly ({each}).")
    return sentences
