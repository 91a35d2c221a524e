"""Figures of a discovery: where law and tests disagree, what explains the gap, and what it had done to the law."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from .._errors import InputError
from .._format import plain, with_unit
from ..calibrate.estimates import quantities
from ..calibrate.population import COEFFICIENTS
from ..discovery import Discovery
from ..discovery.settings import DETECTABLE
from ..effects.record import HOLD, RELOAD, UNLOAD
from . import style
from .curves import COLUMNS, plot_bands, segments
from .posterior import plot_prior_posterior

NOT_FITTED = "the base law was not fitted well enough; there is nothing to draw"
GAP_PANELS = 6  # most tests whose residuals are shown over time
ALIKE = 10  # mechanisms in the table of those that look alike, members of the sets aside
_FLOOR: style.Look = {"color": style.BLACK, "linestyle": "--", "linewidth": 1.0}
_SHADES = {HOLD: ("hold", "#FBEFD0"), UNLOAD: ("unloading", "#DFECF6"), RELOAD: ("reloading", "#E2F1E8")}
"""Word and background of kinds of segments; loading stays white."""


def discovery_figures(found: Discovery) -> dict[str, Figure]:
    """Every figure of a discovery that can be drawn, by the stem of its file's name; none without a fit of the law."""
    if found.residuals is None:
        return {}
    plots = [plot_where, plot_before_after, plot_ranking, plot_similarity]
    if found.held_out is not None:
        plots.append(plot_gap)
    if found.effects or found.closure is not None:
        plots.append(plot_shifts)
    figures = style.by_stem(plots, found)
    if found.posterior is not None:
        figures |= style.by_stem((plot_bands, plot_prior_posterior), found.posterior)
    return {f"discovery_{stem}": figure for stem, figure in figures.items()}


def _finished(figure: Figure, found: Discovery, **more: Any) -> Figure:
    if found.base is None:
        raise InputError(NOT_FITTED)
    return style.finish(figure, found.base.campaign, **more)


@style.styled
def plot_where(found: Discovery) -> Figure:
    """Where law and tests disagree: kind of segment, share of the test's largest force, share of the gap [-].

    Colour and number are the place's share of the squared difference between the law with and without what was added;
    the arrow says whether more (up) or less displacement is measured than the law predicts. A hold is one place.
    Hatched: no points.
    """
    kinds = list(dict.fromkeys(place.segment for place in found.places))
    shares = np.array([place.share for place in found.places])
    figure = style.new_figure(7.6, 3.1)
    ax = figure.subplots()
    largest = max(1e-3, float(np.nanmax(shares, initial=0.0)))
    colours = style.sequential(np.array([0.0, largest]))
    colours.set_cmap("YlOrBr")
    for place, share in zip(found.places, shares, strict=True):
        row, (low, high) = kinds.index(place.segment), place.load_fraction
        bar: style.Look = {"width": high - low, "left": low, "height": 0.86}
        if not np.isfinite(share):
            ax.barh(row, color="white", edgecolor="#D0D0D0", hatch="////", linewidth=0, **bar)
            continue
        ax.barh(row, color=colours.to_rgba(share), edgecolor="white", linewidth=1, **bar)
        if share >= 0.01:
            words = f"{100 * share:.0f} % {'↑' if place.sign > 0 else '↓'}"
            ink = "white" if 0.6 * largest < share else style.BLACK
            ax.text((low + high) / 2, row, words, ha="center", va="center", fontsize=style.SMALL, color=ink)
    ax.set_yticks(range(len(kinds)), kinds)
    ax.set(xlim=(0, 1), ylim=(len(kinds) - 0.45, -0.55), xlabel="force over the test's largest force [-]")
    ax.tick_params(axis="y", length=0)
    ax.spines[:].set_visible(False)
    nothing = found.verdict == "NO_GAP"
    what = "share of what noise leaves [-]" if nothing else "share of the systematic gap [-]"
    figure.colorbar(colours, ax=ax, label=what)
    title = "Where law and tests disagree" + (": nowhere beyond noise" if nothing else "")
    warning = "These are shares of what noise alone leaves: no gap was found." if nothing else ""
    return _finished(figure, found, title=title, warning=warning)


@style.styled
def plot_before_after(found: Discovery) -> Figure:
    """Measured less predicted displacement [um] over time [s] without and with what was added, and the noise floor.

    The six tests that gain most (without a gap: that fit worst). In both cases every particle's own coefficients,
    modulus and zero are fitted, so that what is shown is what they could not take up. The orange band is the standard
    deviation of what earlier points do not predict. The numbers are root mean squares of the residuals in units of the
    noise, independent from point to point: 1 is the floor.
    """
    left, base = found.residuals, found.base
    if left is None or base is None:
        raise InputError(NOT_FITTED)
    added = bool(found.effects) or found.closure is not None
    points = np.maximum(left.used.sum(1), 1)
    before, after = (np.sum(white**2, 1) for white in (left.white_before, left.white_after))
    worth = before - after if added else before / points
    rows = np.sort(np.argsort(-worth, kind="stable")[:GAP_PANELS])
    labels: style.Look = {"xlabels": ["time [s]"], "ylabel": "measured − predicted [µm]"}
    figure, panels = style.grid(len(rows), COLUMNS, (2.87, 2.15), **labels)
    names = style.particle_labels(base.campaign.particles)
    kinds: set[int] = set()
    for (ax,), i in zip(panels, rows, strict=True):
        time, used = left.time_s[i], left.used[i]
        real = np.flatnonzero(np.concatenate([[True], np.diff(time) > 0]))
        for segment in segments(left.kind[i][real]):
            kind = int(left.kind[i][real[segment[0]]])
            if kind in _SHADES and len(segment) > 1:
                ends = time[real[[max(segment[0] - 1, 0), segment[-1]]]]
                ax.axvspan(*ends, color=_SHADES[kind][1], linewidth=0, zorder=0)
                kinds.add(kind)
        floor, one, two = (np.where(used, values[i], np.nan) for values in (left.noise, left.before, left.after))
        ax.fill_between(time, -floor, floor, color=style.ORANGE, alpha=0.55, linewidth=0, zorder=2)
        ax.axhline(0.0, color=style.GREY, linewidth=0.7, zorder=1)
        ax.plot(time, one, color=style.VERMILION, linewidth=0.9, zorder=3)
        if added:
            ax.plot(time, two, color=style.BLUE, linewidth=0.9, zorder=4)
        rms = [f"{np.sqrt(total[i] / points[i]):.2f}" for total in (before, after)]
        ax.set_title(names[left.particles[i]], fontsize=8)
        style.headroom(ax, 0.22)
        style.note(ax, f"{' → '.join(rms) if added else rms[0]} × noise")
        ax.margins(x=0.01)
    handles: list[Line2D | Patch] = [Line2D([], [], color=style.VERMILION, label="law alone")]
    if added:
        handles.append(Line2D([], [], color=style.BLUE, label="with what was added"))
    handles.append(Patch(color=style.ORANGE, alpha=0.55, linewidth=0, label="± noise"))
    handles += [Patch(color=shade, linewidth=0, label=w) for kind, (w, shade) in _SHADES.items() if kind in kinds]
    title = "What the law leaves, before and after" if added else "What the law leaves: nothing was added"
    return _finished(figure, found, title=title, handles=handles)


@style.styled
def plot_ranking(found: Discovery) -> Figure:
    """Every mechanism's statistic [-]: the estimate of its best formula alone over its standard error.

    The dashed line is the detection limit: a mechanism whose true strength reaches it is found with 95 % probability.
    Next to each bar are its probability among all, the estimate, and the limit in the mechanism's own unit. An empty
    bar is an estimate of the physically impossible sign. Below, grey: mechanisms that these data cannot show.
    """
    entries = found.to_json()["ranking"]
    members = {name for names in found.candidate_set for name in names}
    named = {effect.mechanism for effect in found.effects}
    count = len(entries) + len(found.untestable)
    figure = style.new_figure(9.4, 1.3 + 0.235 * count)
    ax = figure.subplots()
    column: style.Look = {"transform": ax.get_yaxis_transform(), "va": "center", "fontsize": style.SMALL}
    scale = max([1.6 * DETECTABLE, *(abs(e["statistic"]) for e in entries)])
    kinds: dict[str, style.Look] = {
        "added to the law": {"color": style.BLUE},
        "explains it as well": {"color": style.SKY},
        "others": {"color": style.PALE},
        "impossible sign": {"facecolor": "white", "edgecolor": style.PALE},
    }
    seen = {"others"}
    for row, entry in enumerate(entries):
        name, unit = entry["mechanism"], entry["unit"]
        kind = "added to the law" if name in named else "explains it as well" if name in members else "others"
        if entry["sign"] * entry["statistic"] < 0:
            kind = "impossible sign"
        seen.add(kind)
        ax.barh(row, abs(entry["statistic"]), height=0.66, linewidth=0.9, **kinds[kind])
        chance = f"{entry['probability']:.2f}" if entry["probability"] >= 0.005 else "< 0.01"
        ax.text(1.1, row, chance, ha="right", **column)
        limit = with_unit(entry["detection_limit"], unit)
        ax.text(1.13, row, f"{with_unit(entry['estimate'], unit)}  (limit {limit})", **column)
    patch: style.Look = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
    for row, missing in enumerate(found.untestable, start=len(entries)):
        needs = f"needs {missing['needs']}"
        ax.text(0.012 * scale, row, needs, va="center", fontsize=style.SMALL, color=style.GREY, zorder=5, bbox=patch)
    ax.axvline(DETECTABLE, **_FLOOR)
    ax.set_yticks(range(count), [plain(e["mechanism"]) for e in (*entries, *found.untestable)])
    for tick in ax.get_yticklabels()[len(entries) :]:
        tick.set_color(style.GREY)
    ax.set(xlim=(0, 1.05 * scale), ylim=(count - 0.4, -0.6))
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel("|estimate| / standard error, each mechanism alone [-]")
    header: style.Look = {"transform": ax.transAxes, "va": "bottom", "fontsize": 8, "color": style.GREY}
    ax.text(1.1, 1.0, "probability", ha="right", **header)
    ax.text(1.13, 1.0, "estimate and detection limit", **header)
    handles = [Patch(label=kind, **look) for kind, look in kinds.items() if kind in seen]
    line = Line2D([], [], label="detection limit", **_FLOOR)
    title = "What could be missing: no gap was found" if found.verdict == "NO_GAP" else "What explains the gap"
    return _finished(figure, found, title=title, handles=[*handles, line])


@style.styled
def plot_similarity(found: Discovery) -> Figure:
    """Correlation [-] of what mechanisms would leave in the tests once the law has taken up what it can.

    Members of the set first (bold). Above 0.9 no analysis of these data distinguishes two mechanisms; other data may.
    """
    if found.likeness is None:
        raise InputError(NOT_FITTED)
    members = {name for group in found.candidate_set for name in group}
    count = min(max(ALIKE, len(members)), len(found.likeness.names))
    names, both = found.likeness.names[:count], found.likeness.correlation[:count, :count]
    figure = style.new_figure(3.6 + 0.42 * count, 2.6 + 0.36 * count)
    ax = figure.subplots()
    colours = ax.imshow(both, cmap="PuOr_r", vmin=-1, vmax=1, aspect="auto")
    for (i, j), value in np.ndenumerate(both):
        ink, words = "white" if abs(value) > 0.65 else style.BLACK, f"{value:.2f}".replace("-0.00", "0.00")
        ax.text(j, i, words, ha="center", va="center", fontsize=7, color=ink)
    words = [plain(name) for name in names]
    ax.set_xticks(range(count), words, rotation=45, ha="right", rotation_mode="anchor")
    ax.set_yticks(range(count), words)
    for axis in (ax.get_xticklabels(), ax.get_yticklabels()):
        for tick, name in zip(axis, names, strict=True):
            tick.set_fontweight("bold" if name in members else "normal")
    ax.spines[:].set_visible(False)
    figure.colorbar(colours, ax=ax, label="correlation of projected signatures [-]", shrink=0.8)
    return _finished(figure, found, title="Which mechanisms look alike in these data")


@style.styled
def plot_gap(found: Discovery) -> Figure:
    """The gap on particles that took no part in finding and fitting, step by step, down to the floor of the noise.

    Left chi2 per point (the floor is 1), right the systematic displacement [um] that is left once noise is taken off.
    """
    gap = found.gap()
    steps = gap["steps"]
    figure = style.new_figure(7.6, 3.2)
    left, right = figure.subplots(1, 2)
    labels = ["law alone" if step["added"] is None else f"+ {plain(step['added'])}" for step in steps]
    colours = [style.VERMILION if step["added"] is None else style.BLUE for step in steps]
    for ax, key, label, form, floor in (
        (left, "chi2_per_dof", "χ² per point [-]", "{:.2f}", 1.0),
        (right, "systematic_um", "systematic gap [µm]", "{:.2g}", 0.0),
    ):
        values = np.array([s[key] for s in steps], float)
        ax.bar_label(ax.bar(labels, values, width=0.55, color=colours), fmt=form, fontsize=8)
        ax.set(xlim=(-0.6, len(steps) - 0.4), ylabel=label)
        ax.margins(y=0.14)
        ax.axhline(floor, **_FLOOR)
    if gap["closed_fraction"] is not None:
        style.note(right, f"{100 * gap['closed_fraction']:.0f} % of the gap closed", place="upper right")
    handles = [Line2D([], [], label="floor: noise alone", **_FLOOR)]
    what = ", each left out in turn" if steps else ": no gap was found, or they were not asked for"
    return _finished(figure, found, title=f"The gap on held-out particles{what}", handles=handles)


@style.styled
def plot_shifts(found: Discovery) -> Figure:
    """What the missing effect had done to the law: its parameters before and after, with 95 % intervals."""
    sides = [("law alone", style.VERMILION, found.parameters_before)]
    if found.parameters_after:
        sides.append(("with what was added", style.BLUE, found.parameters_after))
    names = ("a", "effective_modulus_MPa", *(f"{name}_median" for name in COEFFICIENTS))
    figure = style.new_figure(9.0, 2.6)
    panels = dict(zip(names, figure.subplots(1, len(names)), strict=True))
    for x, (_, colour, parameters) in enumerate(sides):
        for one in quantities(parameters):
            ax, value, ends = panels.get(one.name), one.estimate["value"], one.estimate["interval_95"]
            if ax is None or value is None:
                continue
            ax.plot(x, value * one.factor, "o", color=colour, markersize=5)
            if ends is not None:
                ax.vlines(x, *(end * one.factor for end in ends), color=colour, linewidth=1.8)
            ax.set_title(f"{one.label} [{one.unit or '-'}]", fontsize=8.5)
    labels = ["before", "after"] if found.parameters_after else ["law alone"]
    for ax in panels.values():
        ax.set_xlim(-0.6, len(sides) - 0.4)
        ax.set_xticks(range(len(sides)), labels)
        ax.margins(y=0.15)
        ax.locator_params(axis="y", nbins=5)
        ax.grid(axis="y", color="#E6E6E6", linewidth=0.6)
    moved = found.parameters_after and (found.effects or found.closure)
    title = "What the missing effect had done to the law" if moved else "Parameters of the law"
    handles = [Line2D([], [], color=colour, marker="o", label=f"{label}, 95 %") for label, colour, _ in sides]
    return _finished(figure, found, title=title, handles=handles)
