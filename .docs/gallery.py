"""The gallery of effects and the tables of tests against effects, made from the library while the pages build."""

import io
import json
import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

from equations import in_tex

from mcc_jax._format import number, plain
from mcc_jax.effects import EQUIVALENCES

POWER = json.loads((Path(__file__).parent / "power.json").read_text(encoding="utf-8"))
FEW, MANY = "unload", "rates"
"""The two plans by which the gallery says what an effect is mistaken for."""

FOLDER = "images/effects"
BLUE, VERMILION, GREY = "#0072B2", "#D55E00", "0.45"
DIAMETERS_UM, HUMIDITY_PERCENT, PEAK_STRESS_MPA = (213.5, 196.1, 150.0), 75.0, 8.0
"""The particle of all pictures: flat, not of 200 um, in humid air, so that no effect of size, shape or water hides."""

STYLE = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
LARGEST_SHARE = 0.12
"""Of the largest displacement: an effect that adds more is drawn weaker than its largest plausible strength."""


def unit_of(unit):
    """A unit for people; nothing where there is none."""
    if unit.startswith("1/"):
        return " per %" if unit == "1/%" else f" {unit[2:]}⁻¹"
    return "" if unit == "-" else " " + unit.replace("um", "µm")


def written(value):
    """A number as a person writes it: 0.0002, 30, 1.43."""
    return number(value, 3)


# ---- pictures --------------------------------------------------------------------------------------------------------


@cache
def _programme():
    import jax

    jax.config.update("jax_enable_x64", True)
    import mcc_jax as mcc

    return mcc.Programme.cycles(levels=(0.6, 1.0), unload_to=0.1, hold_s=40.0, points=240)


def _test(effects=()):
    """Time [s], force [mN] and displacement [um] of one particle under the programme of all pictures."""
    import jax
    import numpy as np

    programme = _programme()
    import mcc_jax as mcc

    law = mcc.paper_law()
    laws = mcc.simulate.law_for_each(
        plastic=jax.tree.map(lambda x: x[None], law.plastic), a=law.a, effective_modulus_MPa=law.effective_modulus
    )
    particle = mcc.Particle(*DIAMETERS_UM)
    peak = PEAK_STRESS_MPA * math.pi * float(particle.effective_diameter) ** 2 / 4e3
    campaign = mcc.simulate_campaign(
        laws,
        np.array([DIAMETERS_UM]),
        np.array([peak]),
        programme,
        effects=effects,
        relative_humidity_percent=np.array([HUMIDITY_PERCENT]),
    )
    return campaign.curves[0]


def _shown(variant):
    """A strength to draw, and the test with it."""
    import numpy as np

    import mcc_jax as mcc

    # No draw by test: every test of the picture is the same.
    same = replace(variant, random_per_test=False)
    middle = {n.name: n.middle for n in variant.nuisances}
    law = _law_alone()
    strength = (variant.sign or 1) * variant.plausible[1]
    while True:
        curve = _test((mcc.HiddenEffect(same, strength, middle),))
        added = np.max(np.abs(curve.displacement_um - law.displacement_um))
        if added <= LARGEST_SHARE * law.displacement_um.max() or abs(strength) <= variant.plausible[0]:
            return strength, curve
        strength /= 2


@cache
def _law_alone():
    return _test()


def picture(mechanism):
    """Strength, most it adds or takes away [um], and three pictures of a mechanism's first formula.

    One test with holds and a reload: the whole curve, and what is added to it, two, so that a phone shows one below the
    other; the latter small, too.
    """
    import numpy as np
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    law, (strength, curve) = _law_alone(), _shown(mechanism.variants[0])
    with rc_context(STYLE):
        figures = [Figure(figsize=size, layout="constrained") for size in ((3.8, 2.7), (3.8, 2.7), (1.6, 1.1))]
        left = figures[0].subplots()
        right, small = (figure.subplots(2, 1, sharex=True, height_ratios=(4, 1)) for figure in figures[1:])
        # Broad and pale below narrow and dark: dashes of a path that goes back on itself would fill each other's gaps.
        left.plot(law.displacement_um, law.force_mN, color=VERMILION, alpha=0.6, lw=2.8, label="law alone")
        left.plot(curve.displacement_um, curve.force_mN, color=BLUE, lw=1.3, label="with the effect")
        left.set(xlabel="displacement / µm", ylabel="force / mN")
        left.legend(frameon=False, fontsize=8, loc="upper left")
        added = curve.displacement_um - law.displacement_um
        for axes in (right, small):
            _draw_added(*axes, law, added)
        right[0].set(ylabel="added\ndisplacement / µm")
        right[1].set(xlabel="time / s", ylabel="force")
        for ax in small:
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(False)
        drawn = [_png(figure) for figure in figures]
    return strength, float(added[np.abs(added).argmax()]), *drawn


def _png(figure, dpi=140):
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, metadata={"Software": None})
    return stream.getvalue()


def _draw_added(above, below, law, added):
    """What an effect adds to the displacement, over time; below it the force in grey."""
    above.plot(law.time_s, added, color=BLUE, lw=1.3)
    above.axhline(0, color=GREY, lw=0.6)
    above.margins(y=0.08)
    below.fill_between(law.time_s, law.force_mN, color="0.75", lw=0)
    below.set_ylim(0, 1.05 * law.force_mN.max())
    below.set_yticks([])


@cache
def pictures():
    """Of every mechanism: the strength that is drawn, and its pictures."""
    from mcc_jax.effects import LIBRARY

    return {name: picture(mechanism) for name, mechanism in LIBRARY.items()}


EXAMPLE = "creep"


def how_to_read():
    """The picture of one effect with words in it, for those who see such pictures for the first time."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from mcc_jax.campaign import find_segments
    from mcc_jax.effects import LIBRARY

    law, (_, curve) = _law_alone(), _shown(LIBRARY[EXAMPLE].variants[0])
    added = curve.displacement_um - law.displacement_um
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.4), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        _draw_added(above, below, law, added)
        above.set(title=f"how to read the small pictures: {plain(EXAMPLE)}", ylabel="added\ndisplacement / µm")
        below.set(xlabel="time / s", ylabel="force")
        top = int(added.argmax())
        most = _signed(added[top])
        above.annotate(
            f"at most {most[1:]} µm more than\nby the law alone: {most} µm\nis printed below the small picture",
            (law.time_s[top], added[top]), (0.02, 0.97), textcoords="axes fraction", va="top",
            arrowprops={"arrowstyle": "->", "color": GREY},
        )  # fmt: skip
        above.text(law.time_s[-1], 0.0, "the law alone (below this line: less displacement)", ha="right", va="bottom")
        words = {"load": "loaded", "hold": "held", "unload": "unloaded", "reload": "reloaded"}
        for part in find_segments(law, control="load"):
            middle = (law.time_s[part.start] + law.time_s[part.stop - 1]) / 2
            below.text(middle, 0.06 * law.force_mN.max(), words[part.kind], ha="center", va="bottom", fontsize=8)
        return _png(figure)


def tension():
    """Force over displacement where a particle that sticks is pulled off, by several formulas."""
    import numpy as np
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    import mcc_jax as mcc

    law, particle = mcc.paper_law(), mcc.Particle(*DIAMETERS_UM)
    drawn = {"law alone": None, "jkr": 0.3, "kendall": 3.0, "bond": 0.3, "mobilised": 0.3}
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.0), layout="constrained")
        ax = figure.subplots()
        for name, strength in drawn.items():
            sticks = () if strength is None else (mcc.LIBRARY["adhesion"][name].build(strength),)
            path = np.concatenate([np.linspace(0.0, 15.0, 60), np.linspace(15.0, 11.1, 700)])
            test = mcc.drive(
                law.with_effects(*sticks), particle, path, time=np.arange(float(len(path))) if sticks else None
            )
            color = VERMILION if strength is None else None
            ax.plot(path[60:], test.force[60:], lw=2.8 if strength is None else 1.3, color=color, label=plain(name))
        ax.axhline(0, color=GREY, lw=0.6)
        ax.set(xlabel="displacement / µm", ylabel="force / mN", ylim=(-0.4, 0.8), xlim=(11.2, 11.8))
        ax.legend(frameon=False, fontsize=8, loc="upper left")
        return _png(figure)


def _signed(value):
    return f"{value:+.2g}".replace("-", "\N{MINUS SIGN}")


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
        label = f"{plain(name)}<br>{_signed(pictures()[name][1])} µm"
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
        return _png(figure, 120)


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
