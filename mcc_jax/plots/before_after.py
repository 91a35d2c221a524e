"""Residuals of the tests before and after what a discovery added."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..discover import Discovery
from ..effects.record import HOLD, RELOAD, UNLOAD
from .remaining_gap import Leftover, added_columns, leftover
from .style import BLUE, GREY, ORANGE, VERMILION, finish, new_figure, note, styled
from .text import particle_labels

MAX_PANELS = 6
SHADES = {HOLD: "#FBEFD0", UNLOAD: "#DFECF6", RELOAD: "#E2F1E8"}
WORDS = {HOLD: "hold", UNLOAD: "unloading", RELOAD: "reloading"}


def _shade(ax: Axes, time: np.ndarray, kind: np.ndarray) -> set[int]:
    """Background by kind of segment; loading stays white."""
    seen = set()
    edges = np.flatnonzero(np.diff(kind)) + 1
    for part in np.split(np.arange(len(kind)), edges):
        code = int(kind[part[0]])
        if code in SHADES and len(part) > 1:
            begin = max(part[0] - 1, 0)
            ax.axvspan(float(time[begin]), float(time[part[-1]]), color=SHADES[code], linewidth=0, zorder=0)
            seen.add(code)
    return seen


def _most_affected(left: Leftover) -> np.ndarray:
    """Rows of the tests from which the additions take most chi2, or with the largest chi2 if nothing was added."""
    before, after = (np.sum(white**2, 1) for white in (left.white_before, left.white_after))
    gain = before - after
    worth = gain if np.any(np.abs(gain) > 1e-9) else before / np.maximum(left.used.sum(1), 1)
    return np.sort(np.argsort(-worth, kind="stable")[:MAX_PANELS])


@styled
def plot_before_after(found: Discovery) -> Figure:
    """Measured less predicted displacement [um] over time [s] without and with what was added, and the noise floor.

    The six tests that gain most (without a gap: that fit worst). In both cases every particle's own coefficients,
    modulus and zero are fitted again, to first order around the base fit, so that what is shown is what they could not
    take up. The orange band is the standard deviation of what earlier points do not foretell. The numbers are root mean
    squares of the residuals in units of the noise, independent from point to point: 1 is the floor.
    """
    left = leftover(found)
    assert found.base is not None
    base = found.base
    added = len(added_columns(found)) > 0
    rows = _most_affected(left)
    columns = min(3, len(rows))
    lines = -(-len(rows) // columns)
    figure = new_figure(8.6, 1.0 + 2.15 * lines)
    panels = figure.subplots(lines, columns, squeeze=False)
    labels = particle_labels(base.campaign.particles)
    kinds: set[int] = set()
    for ax, i in zip(panels.flat, rows, strict=False):
        used = left.used[i]
        time = left.time_s[i]
        real = np.concatenate([[True], np.diff(time) > 0])
        kinds |= _shade(ax, time[real], left.kind[i][real])
        floor = np.where(used, left.noise[i], np.nan)
        ax.fill_between(time, -floor, floor, color=ORANGE, alpha=0.55, linewidth=0, zorder=2)
        ax.axhline(0.0, color=GREY, linewidth=0.7, zorder=1)
        ax.plot(time, np.where(used, left.before[i], np.nan), color=VERMILION, linewidth=0.9, zorder=3)
        if added:
            ax.plot(time, np.where(used, left.after[i], np.nan), color=BLUE, linewidth=0.9, zorder=4)
        rms = [np.sqrt(np.sum(w[i] ** 2) / used.sum()) for w in (left.white_before, left.white_after)]
        ax.set_title(labels[left.particles[i]], fontsize=8)
        text = f"{rms[0]:.2f} → {rms[1]:.2f} × noise" if added else f"{rms[0]:.2f} × noise"
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.22 * (high - low))
        note(ax, text, place="upper left")
        ax.margins(x=0.01)
    for ax in panels.flat[len(rows) :]:
        ax.set_visible(False)
    for ax in panels[-1]:
        ax.set_xlabel("time [s]")
    for ax in panels[:, 0]:
        ax.set_ylabel("measured − predicted [µm]")
    handles: list[Line2D | Patch] = [Line2D([], [], color=VERMILION, label="law alone")]
    if added:
        handles.append(Line2D([], [], color=BLUE, label="with what was added"))
    handles.append(Patch(color=ORANGE, alpha=0.55, linewidth=0, label="± noise"))
    handles += [Patch(color=SHADES[k], linewidth=0, label=WORDS[k]) for k in SHADES if k in kinds]
    title = "What the law leaves, before and after" if added else "What the law leaves: nothing was added"
    return finish(figure, base.campaign.metadata, title=title, handles=handles)
