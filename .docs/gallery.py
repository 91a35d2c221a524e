"""The gallery of effects and the tables of tests against effects, made from the library while the pages build."""

import json
import math
import re
from pathlib import Path

from effect_pictures import BLUE, GREY, how_to_read, pictures, png, signed, tension
from equations import in_tex

from mcc_jax._format import number, plain
from mcc_jax.effects import EQUIVALENCES

POWER = json.loads((Path(__file__).parent / "power.json").read_text(encoding="utf-8"))
FEW, MANY = "unload", "rates"
"""The two plans by which the gallery says what an effect is mistaken for."""

FOLDER = "images/effects"


def unit_of(unit):
    """A unit for people; nothing where there is none."""
    if unit.startswith("1/"):
        return " per %" if unit == "1/%" else f" {unit[2:]}⁻¹"
    return "" if unit == "-" else " " + unit.replace("um", "µm")


def written(value):
    """A number as a person writes it: 0.0002, 30, 1.43."""
    return number(value, 3)


# ---- the gallery -----------------------------------------------------------------------------------------------------

CAUSES = {
    "instrument": "Of the instrument",
    "contact": "Where particle and platen meet",
    "loading": "Of loading",
    "unloading": "Of unloading",
    "creep_and_cycles": "Of time and cycles",
    "material": "Of the particle and its material",
}
"""What mechanisms have in common, by the module that holds them."""


def gallery():
    """The page's entries, one for each mechanism, in the library's order."""
    from mcc_jax.effects import LIBRARY

    return "\n\n".join(entry(mechanism) for mechanism in LIBRARY.values())


def sheet():
    """All mechanisms by cause, each a small picture of what it adds that leads to its entry."""
    from mcc_jax.effects import LIBRARY

    cells = {cause: [] for cause in CAUSES.values()}
    for name, mechanism in LIBRARY.items():
        label = f"{plain(name)}<br>{signed(pictures()[name][1])} µm"
        cells[CAUSES[mechanism.variants[0].make.__module__.rpartition(".")[2]]].append(
            f"[![What {plain(name)} adds over time](../{FOLDER}/{name}-small.png) {label}](#{name})"
        )
    return "\n\n".join(
        f'**{cause}**\n\n<div class="sheet" markdown>\n' + "\n".join(some) + "\n</div>" for cause, some in cells.items()
    )


def entry(mechanism):
    """What the page says of one mechanism."""
    first, name = mechanism.variants[0], mechanism.name
    strength = f"{written(pictures()[name][0])}{unit_of(first.unit)}"
    facts = [
        f"| Parameter | `{first.parameter}`, {_range(first)} |",
        f"| Sign | {_sign(first)} |",
        f"| The tests need | {_listed(need.value for need in first.needs) or 'nothing special'} |",
    ]
    if first.helps:
        facts.append(f"| Easier to identify with | {_listed(need.value for need in first.helps)} |")
    facts.append(f"| Mistaken for | {mistaken_for(name)} |")
    equal = [
        f"{other}, without {e.need.value}" if e.need else other
        for e in EQUIVALENCES
        if any(name in one for one in e.names)
        for other in e.names
        if name not in other
    ]
    if equal:
        facts.append(f"| Cannot be distinguished, by tests of force and displacement, from | {_listed(equal)} |")
    facts.append(f"| What shows it by itself | {mechanism.check} |")
    sources = list(dict.fromkeys(variant.source for variant in mechanism))
    rows = [
        f"| `{v.name}` | ${in_tex(v.equation)}$ | {_own_range(v, first)}{v.explanation}"
        f"{_further(v)} | {f'[{1 + sources.index(v.source)}]'} |"
        for v in mechanism
    ]
    listed = " ".join(f"[{number}] {source.rstrip('.')}." for number, source in enumerate(sources, start=1))
    return "\n".join(
        [
            f"## {plain(name).capitalize()} {{ #{name} }}",
            "",
            f"`{name}`. {mechanism.explanation}",
            "",
            '<div class="two" markdown>',
            f"![A test without and with {plain(name)}](../{FOLDER}/{name}.png)",
            f"![What {plain(name)} adds over time](../{FOLDER}/{name}-added.png)",
            "</div>",
            "",
            f"*Plotted: {_code(first)} with {strength}, large enough to be visible.*",
            "",
            "| In short | |",
            "|---|---|",
            *facts,
            "",
            "| formula | | what happens | source |",
            "|---|---|---|---|",
            *rows,
            "",
            listed,
        ]
    )


def mistaken_for(name):
    """Which mechanisms look like it in simple tests, and which still do in the richest ones."""
    simple, rich = (_alike(plan, name) for plan in (FEW, MANY))
    if not simple and not rich:
        return "no other mechanism, even in tests that only load and unload"
    said = []
    if simple:
        said.append(f"in tests that only load and unload: {_pairs(simple)}")
    said.append(f"with rising peaks, holds, reloads and two rates: {_pairs(rich) if rich else 'none'}")
    return "; ".join(said)


def _alike(plan, name):
    pairs = POWER["plans"][plan]["alike"]
    return {b if a == name else a: value for a, b, value in pairs if name in (a, b)}


def _pairs(found):
    return ", ".join(f"[{plain(other)}](#{other}) ({_percent(value)} alike)" for other, value in found.items())


def _percent(value):
    return "over 99 %" if value > 0.99 else f"{100 * value:.0f} %"


def _listed(items):
    return ", ".join(items)


def _range(variant):
    low, high = variant.plausible
    unit = unit_of(variant.unit) or " (no unit)"
    return f"plausible from {written(low)} to {written(high)}{unit}"


def _sign(variant):
    return {1: "only above zero", -1: "only below zero", 0: "either"}[variant.sign] + (
        "; it differs from test to test" if variant.random_per_test else ""
    )


def _code(variant):
    return f"`{variant.mechanism}:{variant.name}`"


def _own_range(variant, first):
    """Parameter and range of a formula if they differ from those of the first."""
    if (variant.parameter, variant.plausible) == (first.parameter, first.plausible):
        return ""
    return f"`{variant.parameter}`, {_range(variant)}. "


def _further(variant):
    """Further parameters of a formula."""
    found = [
        f"`{n.name}` {written(n.plausible[0])} to {written(n.plausible[1])}: {n.explanation}" for n in variant.nuisances
    ]
    return "".join(f" ({text})" for text in found)


# ---- which test shows which effect -----------------------------------------------------------------------------------


def visible_share(mechanism, limit):
    """Share of the plausible range, on a logarithmic scale, in which the effect is found; 0 to 1."""
    low, high = mechanism.variants[0].plausible
    return min(1.0, max(0.0, math.log(high / limit) / math.log(high / low)))


def which_test():
    """A table of detection limits: mechanisms down, plans across."""
    from mcc_jax.effects import LIBRARY

    plans = POWER["plans"].values()
    lines = [
        "| effect | largest plausible | " + " | ".join(plan["title"] for plan in plans) + " |",
        "|---|---|" + "---|" * len(plans),
    ]
    for name, mechanism in LIBRARY.items():
        first = mechanism.variants[0]
        cells = []
        for plan in plans:
            limit = plan["limits"].get(name)
            if limit is None:
                cells.append("–")
                continue
            share = visible_share(mechanism, limit)
            mark = "●" if share >= 1 else "○" if share <= 0 else "◐"
            cells.append(f"{mark} {number(limit, 2)}")
        lines.append(
            f"| [{plain(name)}](effects.md#{name}) | {written(first.plausible[1])}{unit_of(first.unit)} | "
            + " | ".join(cells)
            + " |"
        )
    return "\n".join(lines)


def look_alikes():
    """A table of pairs that look alike under the simplest plan with unloading, and what each plan does to them."""
    names = list(POWER["plans"])
    shown = names[names.index(FEW) :]
    pairs = {}
    for plan in shown:
        for a, b, value in POWER["plans"][plan]["alike"]:
            pairs.setdefault((a, b), {})[plan] = value
    lines = [
        "| pair | " + " | ".join(POWER["plans"][plan]["title"] for plan in shown) + " |",
        "|---|" + "---|" * len(shown),
    ]
    for (a, b), values in sorted(pairs.items(), key=lambda item: -max(item[1].values())):
        cells = [_percent(values[plan]) if plan in values else _distinct(plan, a, b) for plan in shown]
        lines.append(f"| {plain(a)}, {plain(b)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _distinct(plan, *pair):
    """ "distinct", or a dash where one of the two cannot be seen at all."""
    return "distinct" if all(name in POWER["plans"][plan]["limits"] for name in pair) else "–"


def which_test_picture():
    """The table as a picture: the darker a cell, the smaller the effect that is found there."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from mcc_jax.effects import LIBRARY

    plans = list(POWER["plans"].values())
    with rc_context({"font.size": 9}):
        figure = Figure(figsize=(7.6, 6.6), layout="constrained")
        ax = figure.subplots()
        for row, (name, mechanism) in enumerate(LIBRARY.items()):
            for column, plan in enumerate(plans):
                limit = plan["limits"].get(name)
                if limit is None:
                    ax.text(column, row, "cannot", ha="center", va="center", fontsize=7.5, color=GREY)
                    continue
                share = visible_share(mechanism, limit)
                ax.add_patch(_cell(column, row, share))
                words = "all" if share >= 1 else "none" if share <= 0 else f"{min(99, round(100 * share))} %"
                ax.text(
                    column, row, words, ha="center", va="center", fontsize=8, color="white" if share > 0.6 else "black"
                )
        ax.set_xlim(-0.5, len(plans) - 0.5)
        ax.set_ylim(len(LIBRARY) - 0.5, -0.5)
        ax.set_yticks(range(len(LIBRARY)), [plain(name) for name in LIBRARY])
        ax.set_xticks(range(len(plans)), [_broken(plan["title"]) for plan in plans], fontsize=8)
        ax.xaxis.tick_top()
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        return png(figure, 120)


def _cell(column, row, share):
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Rectangle

    dark = to_rgb(BLUE)
    colour = tuple(1 - share * (1 - value) for value in dark)
    return Rectangle((column - 0.48, row - 0.46), 0.96, 0.92, facecolor=colour, edgecolor="0.8", linewidth=0.6)


def _broken(title):
    """A title in lines of about twelve letters."""
    lines = [""]
    for word in title.split():
        if lines[-1] and len(lines[-1]) + len(word) > 12:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)


def files():
    """Every picture by its path in the pages."""
    found = {}
    for name, (_, _, curve, added, small) in pictures().items():
        found |= {
            f"{FOLDER}/{name}.png": curve,
            f"{FOLDER}/{name}-added.png": added,
            f"{FOLDER}/{name}-small.png": small,
        }
    found |= {f"{FOLDER}/how-to-read.png": how_to_read(), f"{FOLDER}/tension.png": tension()}
    return found | {"images/which-test.png": which_test_picture()}


BLOCKS = {"gallery": gallery, "sheet": sheet, "which-test": which_test, "look-alikes": look_alikes}
_MARK = re.compile(rf"^!({'|'.join(BLOCKS)})$", re.M)


def filled(markdown):
    """The page with `!gallery`, `!sheet` and the two tables in place of their marks."""
    return _MARK.sub(lambda match: BLOCKS[match[1]](), markdown)
