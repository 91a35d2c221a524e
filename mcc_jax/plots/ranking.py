"""Which mechanisms explain what the law leaves, and which of them look alike."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..discover import Discovery
from ..discover.score import DETECTABLE, project
from .style import BLACK, BLUE, GREY, PALE, SKY, finish, new_figure, styled

MAX_ALIKE = 10
"""Where the detection limit lies on the axis of statistics; `Discovery.limits` is made with the same number."""


def plain_name(name: str) -> str:
    """A mechanism's name in words."""
    return name.replace("_", " ")


def _with_unit(value: float, unit: str) -> str:
    return f"{value:.2g}" if unit == "-" else f"{value:.2g} {unit}"


@styled
def plot_ranking(found: Discovery) -> Figure:
    """Every mechanism's statistic [-]: the estimate of its best formula alone over its standard error.

    The dashed line is the detection limit: a mechanism whose true strength reaches it is found with 95 % probability.
    Beside each bar stand its probability among all, the estimate, and the limit in the mechanism's own unit. Bars of
    the set (what explains the gap as well as the best) are blue. An empty bar is an estimate of the physically
    impossible sign, which explains nothing. Mechanisms that these data cannot show stand below, grey, with what they
    need.
    """
    assert found.ranking is not None
    assert found.system is not None
    assert found.base is not None
    entries = found.to_json()["ranking"]
    members = {name for names in found.candidate_set for name in names}
    named = {effect.mechanism for effect in found.effects}
    rows = len(entries) + len(found.untestable)
    figure = new_figure(9.4, 1.3 + 0.235 * rows)
    ax = figure.subplots()
    values = np.array([abs(e["statistic"]) for e in entries])
    signs = [found.system.candidates[k].variant.sign for k in found.ranking.best]
    any_impossible = False
    labels = []
    scale = max(float(values.max(initial=0.0)), 1.6 * DETECTABLE)
    for row, entry in enumerate(entries):
        name = entry["mechanism"]
        colour = BLUE if name in named else SKY if name in members else PALE
        impossible = signs[row] * entry["statistic"] < 0
        ax.barh(
            row, values[row], height=0.66, color="white" if impossible else colour,
            edgecolor=PALE if impossible else colour, linewidth=0.9,
        )  # fmt: skip
        any_impossible = any_impossible or impossible
        labels.append(plain_name(name))
        unit = entry["unit"]
        chance = f"{entry['probability']:.2f}" if entry["probability"] >= 0.005 else "< 0.01"
        ax.text(1.1, row, chance, transform=ax.get_yaxis_transform(), va="center", ha="right", fontsize=7.5)
        text = f"{_with_unit(entry['estimate'], unit)}  (limit {_with_unit(entry['detection_limit'], unit)})"
        ax.text(1.13, row, text, transform=ax.get_yaxis_transform(), va="center", fontsize=7.5)
    patch = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
    for row, missing in enumerate(found.untestable, start=len(entries)):
        labels.append(plain_name(missing["mechanism"]))
        ax.text(
            0.012 * scale, row, f"needs {missing['needs']}", va="center", fontsize=7.5, color=GREY, zorder=5, bbox=patch
        )
    ax.axvline(DETECTABLE, color=BLACK, linestyle="--", linewidth=1.0)
    ax.set_yticks(range(rows), labels)
    for tick in ax.get_yticklabels()[len(entries) :]:
        tick.set_color(GREY)
    ax.set_ylim(rows - 0.4, -0.6)
    ax.set_xlim(0, 1.05 * scale)
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel("|estimate| / standard error, each mechanism alone [-]")
    header = {"transform": ax.transAxes, "va": "bottom", "fontsize": 8, "color": GREY}
    ax.text(1.1, 1.0, "probability", ha="right", **header)
    ax.text(1.13, 1.0, "estimate and detection limit", **header)
    handles: list[Line2D | Patch] = []
    if named:
        handles.append(Patch(color=BLUE, label="added to the law"))
    if members - named:
        handles.append(Patch(color=SKY, label="explains it as well"))
    handles.append(Patch(color=PALE, label="others"))
    if any_impossible:
        handles.append(Patch(facecolor="white", edgecolor=PALE, label="impossible sign"))
    handles += [Line2D([], [], color=BLACK, linestyle="--", label="detection limit")]
    title = "What could be missing: no gap was found" if found.verdict == "NO_GAP" else "What explains the gap"
    return finish(figure, found.base.campaign.metadata, title=title, handles=handles)


def likeness(found: Discovery) -> tuple[list[str], np.ndarray]:
    """Mechanisms whose projected signatures are compared, and the correlations of their best formulas, shape (K, K).

    They are the members of the sets, then the ranking from the top. Each formula counts with its physical sign: 1 means
    that the data cannot tell the two apart, -1 that one would look like the other with the impossible sign.
    """
    assert found.ranking is not None
    assert found.system is not None
    ranking, system = found.ranking, found.system
    members = dict.fromkeys(name for names in found.candidate_set for name in names)
    names = [*members, *(n for n in ranking.names if n not in members)][: max(MAX_ALIKE, len(members))]
    best = dict(zip(ranking.names, ranking.best, strict=True))
    for effect in found.effects:
        for k, candidate in enumerate(system.candidates):
            if candidate.variant == effect.variant and dict(candidate.nuisance) == effect.nuisance:
                best[effect.mechanism] = k
                break
    index = np.array([best[name] for name in names])
    view = project(system, np.array([system.column(int(k)) for k in index]))
    estimate = np.sign(view.estimate)
    sign = np.array([system.candidates[k].variant.sign for k in index])
    sign = np.where(sign == 0, np.where(estimate == 0, 1.0, estimate), sign)
    return names, view.similarity() * sign * sign[:, None]


@styled
def plot_similarity(found: Discovery) -> Figure:
    """Correlation [-] of what mechanisms would leave in the tests once the law has taken up what it can.

    Members of the set first (bold). Above 0.9 no analysis of these data tells two mechanisms apart; other data may.
    """
    assert found.base is not None
    names, both = likeness(found)
    members = {name for group in found.candidate_set for name in group}
    count = len(names)
    figure = new_figure(3.6 + 0.42 * count, 2.6 + 0.36 * count)
    ax = figure.subplots()
    colours = ScalarMappable(Normalize(-1, 1), colormaps["PuOr_r"])
    ax.imshow(both, cmap=colours.cmap, vmin=-1, vmax=1, aspect="auto")
    for i in range(count):
        for j in range(count):
            dark = abs(both[i, j]) > 0.65
            ax.text(
                j, i, f"{both[i, j]:.2f}".replace("-0.00", "0.00"), ha="center", va="center", fontsize=7,
                color="white" if dark else BLACK,
            )  # fmt: skip
    words = [plain_name(name) for name in names]
    ax.set_xticks(range(count), words, rotation=45, ha="right", rotation_mode="anchor")
    ax.set_yticks(range(count), words)
    for axis in (ax.get_xticklabels(), ax.get_yticklabels()):
        for tick, name in zip(axis, names, strict=True):
            tick.set_fontweight("bold" if name in members else "normal")
    ax.spines[:].set_visible(False)
    figure.colorbar(colours, ax=ax, label="correlation of projected signatures [-]", shrink=0.8)
    return finish(figure, found.base.campaign.metadata, title="Which mechanisms look alike in these data")
