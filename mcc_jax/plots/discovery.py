"""Pictures of a discovery: where law and tests disagree, what closes the gap, what that moves; and all of them."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..discover import Discovery
from ..discover.dictionary import KINDS, LEVELS
from ..discover.score import project
from .before_after import plot_before_after
from .ranking import plain_name, plot_ranking, plot_similarity
from .style import (
    BLACK,
    BLUE,
    VERMILION,
    empty,
    finish,
    new_figure,
    note,
    of_its_kind,
    sequential,
    styled,
)

FADED = 1e-4
"""Of a place whose information survives the projection by less, the law takes up everything: nothing can be said."""


def where_map(found: Discovery) -> dict[str, np.ndarray]:
    """Statistic [-] of every place, by kind of segment: estimate of an addition there over its standard error.

    Positive where more displacement is measured than the law says; NaN where there are no points, or where the law's
    own parameters take up whatever is added.
    """
    assert found.system is not None
    system = found.system
    view = project(system, system.place_columns)
    values = np.where(view.survival > FADED, view.gaussian, np.nan)
    raw = np.einsum("nkk->k", system.gram[system.usable][:, system.place_columns][:, :, system.place_columns])
    values = np.where(raw > 0, values, np.nan)
    return {
        kind: np.array([v for v, place in zip(values, system.places, strict=True) if place.kind == kind])
        for kind in KINDS
    }


@styled
def plot_where(found: Discovery) -> Figure:
    """Where law and tests disagree: kind of segment, share of the test's largest force, share of the gap [-].

    Colour and number are the place's share of the systematic gap; the arrow says whether more (up) or less displacement
    is measured than the law predicts. A hold is one place. Hatched: no points, or nothing the law could not take up.
    """
    assert found.base is not None
    values = where_map(found)
    every = np.concatenate(list(values.values()))
    energy = np.maximum(np.nan_to_num(every) ** 2 - 1, 0.0)
    total = float(energy.sum())
    figure = new_figure(7.6, 3.1)
    ax = figure.subplots()
    colours = sequential(np.array([0.0, max(1e-3, float(energy.max()) / total if total else 1.0)]))
    colours.set_cmap("YlOrBr")
    edges = np.clip(np.array([[c - 0.1, c + 0.1] for c in LEVELS]), 0, 1)
    for row, (kind, numbers) in enumerate(values.items()):
        boxes = [(0.0, 1.0)] if kind == "hold" else [(float(a), float(b)) for a, b in edges]
        for (low, high), t in zip(boxes, numbers, strict=True):
            _box(ax, row, low, high, float(t), total, colours)
    ax.set_yticks(range(len(values)), list(values))
    ax.set_ylim(len(values) - 0.45, -0.55)
    ax.set_xlim(0, 1)
    ax.set_xlabel("force over the test's largest force [-]")
    ax.tick_params(axis="y", length=0)
    ax.spines[:].set_visible(False)
    what = "share of what noise leaves [-]" if found.verdict == "NO_GAP" else "share of the systematic gap [-]"
    figure.colorbar(colours, ax=ax, label=what)
    title = "Where law and tests disagree"
    if found.verdict == "NO_GAP":
        title += ": nowhere beyond noise"
    lines = ["These are shares of what noise alone leaves: no gap was found."] if found.verdict == "NO_GAP" else []
    return finish(figure, found.base.campaign.metadata, title=title, lines=lines)


def _box(ax: Axes, row: int, low: float, high: float, t: float, total: float, colours) -> None:
    if not np.isfinite(t):
        ax.barh(row, high - low, left=low, height=0.86, color="white", edgecolor="#D0D0D0", hatch="////", linewidth=0)
        return
    share = max(t**2 - 1, 0.0) / total if total else 0.0
    ax.barh(row, high - low, left=low, height=0.86, color=colours.to_rgba(share), edgecolor="white", linewidth=1)
    if share >= 0.01:
        dark = share > 0.6 * colours.norm.vmax
        ax.text(
            (low + high) / 2, row, f"{100 * share:.0f} % {'↑' if t > 0 else '↓'}", ha="center", va="center",
            fontsize=7.5, color="white" if dark else BLACK,
        )  # fmt: skip


@styled
def plot_gap(found: Discovery) -> Figure:
    """The gap on particles that took no part in finding and fitting, step by step, down to the floor of the noise.

    Left chi2 per point (the floor is 1), right the systematic displacement [um] that is left once noise is taken off.
    """
    assert found.base is not None
    gap = found.gap()
    steps = gap["steps"]
    figure = new_figure(7.6, 3.2)
    left, right = figure.subplots(1, 2)
    if not steps:
        reason = "no gap was found" if found.verdict == "NO_GAP" else "held-out particles were not asked for"
        for ax in (left, right):
            empty(ax, reason)
        return finish(figure, found.base.campaign.metadata, title="The gap on held-out particles")
    labels = ["law alone", *(f"+ {plain_name(s['added'])}" for s in steps[1:])]
    x = np.arange(len(steps))
    colours = [VERMILION, *([BLUE] * (len(steps) - 1))]
    for ax, key, label, form in (
        (left, "chi2_per_dof", "χ² per point [-]", ".2f"),
        (right, "systematic_um", "systematic gap [µm]", ".2g"),
    ):
        values = np.array([np.nan if s[key] is None else s[key] for s in steps])
        ax.bar(x, values, width=0.55, color=colours)
        for i, value in enumerate(values):
            ax.text(i, value, f" {value:{form}}", ha="center", va="bottom", fontsize=8)
        ax.set_xticks(x, labels)
        ax.set_xlim(-0.6, len(steps) - 0.4)
        ax.set_ylabel(label)
        ax.margins(y=0.14)
    left.axhline(1.0, color=BLACK, linestyle="--", linewidth=1.0)
    right.axhline(0.0, color=BLACK, linestyle="--", linewidth=1.0)
    closed = gap["closed_fraction"]
    if closed is not None:
        note(right, f"{100 * closed:.0f} % of the gap closed", place="upper right")
    handles = [Line2D([], [], color=BLACK, linestyle="--", label="floor: noise alone")]
    return finish(
        figure,
        found.base.campaign.metadata,
        title="The gap on held-out particles, each left out in turn",
        handles=handles,
    )


@styled
def plot_shifts(found: Discovery) -> Figure:
    """What the missing effect had done to the law: its parameters before and after, with 95 % intervals."""
    assert found.base is not None
    figure = new_figure(9.0, 2.6)
    panels = figure.subplots(1, 5)
    names = ("$a$ [-]", r"$\bar E$ [GPa]", "mean log $C_1$ [-]", "mean log $C_3$ [-]", "mean log $C_5$ [-]")
    for j, (ax, name) in enumerate(zip(panels, names, strict=True)):
        for x, colour, parameters in ((0, VERMILION, found.before), (1, BLUE, found.after)):
            if not parameters:
                continue
            if j < 2:
                estimate = parameters[("a", "effective_modulus_MPa")[j]]
            else:
                estimate = parameters[f"log_{('C1', 'C3', 'C5')[j - 2]}"]["mean"]
            factor = 1e-3 if j == 1 else 1.0
            value = estimate["value"] * factor
            ax.plot(x, value, "o", color=colour, markersize=5)
            if estimate["interval_95"] is not None:
                low, high = (end * factor for end in estimate["interval_95"])
                ax.vlines(x, low, high, color=colour, linewidth=1.8)
        ax.set_xlim(-0.6, 1.6 if found.after else 0.6)
        ax.set_xticks([0, 1] if found.after else [0], ["before", "after"] if found.after else ["law alone"])
        ax.set_title(name, fontsize=8.5)
        ax.margins(y=0.15)
        ax.locator_params(axis="y", nbins=5)
        ax.grid(axis="y", color="#E6E6E6", linewidth=0.6)
    moved = found.after and (found.effects or found.closure)
    title = "What the missing effect had done to the law" if moved else "Parameters of the law"
    handles = [Line2D([], [], color=VERMILION, marker="o", label="law alone, 95 %")]
    if found.after:
        handles.append(Line2D([], [], color=BLUE, marker="o", label="with what was added, 95 %"))
    return finish(figure, found.base.campaign.metadata, title=title, handles=handles)


@of_its_kind
def discovery_figures(found: Discovery) -> dict[str, Figure]:
    """Every figure of a discovery, by the stem of its file's name.

    Returns:
        `discovery_where`, `discovery_before_after`, `discovery_ranking`, `discovery_gap`, `discovery_similarity`,
        `discovery_shifts`; none if the base law could not be fitted; no gap and no shifts if nothing was added.
    """
    if found.system is None:
        return {}
    figures = {
        "discovery_where": plot_where(found),
        "discovery_before_after": plot_before_after(found),
        "discovery_ranking": plot_ranking(found),
        "discovery_similarity": plot_similarity(found),
    }
    if found.held_out is not None:
        figures["discovery_gap"] = plot_gap(found)
    if found.effects or found.closure is not None:
        figures["discovery_shifts"] = plot_shifts(found)
    return figures
