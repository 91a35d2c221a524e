"""The answer as a paragraph that a person can read."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .experiments import ENOUGH

if TYPE_CHECKING:
    from .result import Discovery, Effect


SHOWN = 5
"""Most jumps that are told one by one."""

CHECKED = 3
"""Most members of a set of which is told what would show them by themselves."""


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " or " + names[-1]


def _plain(name: str) -> str:
    return name.replace("_", " ")


def summary_of(found: Discovery) -> str:
    """One paragraph: is there a gap, where, what explains it, what that did, what next."""
    sentences = []
    count = len(found.base.selection.kept) if found.base is not None else 0
    if found.verdict == "NO_GAP":
        sentences.append(
            f"The law and the {count} tests agree within the noise (probability of so large a deviation by chance: "
            f"{found.p_any:.2g}); nothing is missing that these data could show."
        )
    else:
        sentences.append(f"The law and the {count} tests disagree (family-wise p = {found.p_any:.2g}){_place(found)}.")
    for effect, names in zip(found.effects, found.candidate_set, strict=True):
        value = f"{effect.variant.parameter} = {effect.amplitude:.3g} +- {effect.sd:.2g}"
        rivals = [_plain(n) for n in names if n != effect.mechanism]
        sentences.append(f"Best name: {_plain(effect.mechanism)} (probability {effect.probability:.2f}; {value}).")
        if effect.jumps:
            sentences.append(_jumps(found, effect))
        if rivals:
            sentences.append(f"These data cannot tell it from {_listed(rivals)}.")
    if found.closure is not None:
        near = f", most like {_plain(found.closure.resembles[0][0])}" if found.closure.resembles else ""
        sentences.append(f"No listed mechanism explains it; a formula does{near}: {found.closure.formula}.")
    gap = found.gap()
    if gap["closed_fraction"] is not None:
        steps = gap["steps"]
        sentences.append(
            f"On held-out particles this closes {100 * gap['closed_fraction']:.0f} % of the systematic gap "
            f"(chi2 per point {steps[0]['chi2_per_dof']:.3f} before, {steps[-1]['chi2_per_dof']:.3f} after)."
        )
    if found.after and found.verdict in ("NAMED", "SET", "UNLISTED"):
        before, after = (p["effective_modulus_MPa"]["value"] / 1000 for p in (found.before, found.after))
        sentences.append(f"It moves the effective modulus from {before:.3g} to {after:.3g} GPa.")
    if found.next_experiments:
        best = found.next_experiments[0]
        names = _listed([_plain(n) for n in best["separates"]])
        sure = best["power"] >= ENOUGH
        doubt = "" if sure else f"No further test of those tried on paper would surely separate {names}. "
        done = f"separate {names}" if sure else "do so"
        sentences.append(
            f"{doubt}{'Next' if sure else 'The best'}: {best['experiment']}, {best['particles']} further particles, "
            f"judged together with these, would {done} with probability {best['power']:.2f}."
        )
    surely = found.next_experiments and found.next_experiments[0]["power"] >= ENOUGH
    if found.checks and not surely:
        each = "; ".join(f"{_plain(one['mechanism'])}: {one['check']}" for one in found.checks[:CHECKED])
        sentences.append(f"Each would show by itself ({each}).")
    if found.untestable:
        sentences.append(
            "These data say nothing about "
            + "; ".join(f"{_plain(u['mechanism'])} (needs {u['needs']})" for u in found.untestable)
            + "."
        )
    return " ".join(sentences)


def _jumps(found: Discovery, effect: Effect) -> str:
    """The largest sudden steps, one by one."""
    largest = sorted(effect.jumps, key=lambda jump: -jump.size)[:SHOWN]
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
    return f", most of all on {first['segment']}{part}, in {len(first['particles'])} particles"
