"""What all figures share: settings, colours, layout, text from outside made fit to be drawn, and writing the files."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import extra
from ..calibrate import LeastSquares, PaperCalibration, Posterior
from ..campaign import Campaign

with extra("plots"):  # every other file of the package imports this one or `curves` first
    from matplotlib import colormaps
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.figure import Figure
    from matplotlib.font_manager import findfont, get_font
    from matplotlib.offsetbox import AnchoredText
    from matplotlib.style import context

CURVE_POINTS = 100  # about so many points of a curve are drawn, so that dots do not overlap
MEAN_MARKERS = 32  # about so many symbols on a mean curve
THIN_CURVES = 30  # of more curves in one panel, lines are thin and faint

BLACK, ORANGE, SKY, GREEN, BLUE, VERMILION = "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00"
"""Of Okabe and Ito's palette, distinguishable by colour-blind readers."""
GREY, PALE = "#767676", "#B8B8B8"

STRAIN = "strain $\\varepsilon$ [-]"
SCALED_STRAIN = "scaled strain $\\eta_p\\,\\varepsilon$ [-]"
STRESS = "stress $\\sigma$ [MPa]"
SHAPE_FACTOR = "shape factor $\\eta_p$ [-]"
FORCE = "force $F$ [mN]"
DISPLACEMENT = "displacement $\\gamma$ [µm]"

FONT = "DejaVu Sans"  # comes with matplotlib, so that a figure looks the same everywhere
SMALL = 7.5
RC: dict[Any, Any] = {
    "font.family": FONT,
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "lines.markersize": 4.0,
}
type Look = dict[str, Any]
"""Keywords of what is drawn."""

styled = context(["default", RC])
"""Decorator: the function runs under these settings and leaves the caller's as they were."""


def by_stem(plots: Iterable[Callable[[Any], Figure]], result: Any) -> dict[str, Figure]:
    """What these functions draw of a result, by the stem of the file's name: `pairs` for `plot_pairs`."""
    return {plot.__name__.removeprefix("plot_"): plot(result) for plot in plots}


@styled
def save_figures(figures: Mapping[str, Figure], directory: str | Path, *, dpi: int = 150) -> list[Path]:
    """Write figures as `<stem>.png` into a directory that exists; the files in the order of the figures."""
    files = {Path(directory) / f"{stem}.png": figure for stem, figure in figures.items()}
    for file, figure in files.items():
        figure.savefig(file, dpi=dpi)
    return list(files)


def plain(text: str, longest: int = 24) -> str:
    """Any text as one short line that matplotlib draws literally, and as well as its font can."""
    font = get_font(findfont(FONT))
    words = "".join(c if c.isprintable() else " " for c in text).split()
    drawn = "".join(c if font.get_char_index(ord(c)) else "\N{REPLACEMENT CHARACTER}" for c in " ".join(words))
    if len(drawn) > longest:
        head = longest // 2
        drawn = drawn[:head].rstrip() + "…" + drawn[len(drawn) - (longest - head - 1) :].lstrip()
    return drawn.replace("$", r"\$")


def particle_labels(names: Sequence[str], longest: int = 24) -> list[str]:
    """Names of particles for a figure, all different: with their position in the campaign where two look the same."""
    labels = [f"particle {name}" if name.isdecimal() and len(name) < 8 else plain(name, longest) for name in names]
    ambiguous = {label for label, count in Counter(labels).items() if count > 1 or "\N{REPLACEMENT CHARACTER}" in label}
    ambiguous.add("")
    return [f"{label} (no. {i})".strip() if label in ambiguous else label for i, label in enumerate(labels, start=1)]


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure of that size, not known to pyplot."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def grid(
    count: int,
    columns: int,
    size_in: tuple[float, float],
    *,
    xlabels: Sequence[str],
    ylabel: str,
    widths: Sequence[float] = (1.0,),
) -> tuple[Figure, np.ndarray]:
    """A figure of `count` panels in rows of at most `columns`, and its axes, of shape (count, axes of a panel).

    A panel of size `size_in` is made of axes side by side with these relative widths; one or two panels are larger.
    Labels are at the bottom and at the left only.
    """
    columns = min(columns, count)
    rows = -(-count // columns)
    scale = 1.5 if count < 3 else 1.0
    width, height = (scale * side for side in size_in)
    figure = new_figure(max(width * columns, 6.4), max(height * rows + 1.0, 3.4))
    axes = figure.subplots(rows, columns * len(widths), squeeze=False, width_ratios=[*widths] * columns)
    panels = axes.reshape(-1, len(widths))
    for ax in panels[count:].flat:
        ax.set_axis_off()
    for panel in panels[max(count - columns, 0) : count]:
        for ax, label in zip(panel, xlabels, strict=True):
            ax.set_xlabel(label)
    for ax in axes[:, 0]:
        ax.set_ylabel(ylabel)
    figure.align_ylabels(axes[:, 0].tolist())
    return figure, panels[:count]


def finish(
    figure: Figure, campaign: Campaign, *, title: str = "", warning: str = "", handles: Sequence[Artist] = ()
) -> Figure:
    """Add a title with a warning below it, a legend below the panels and, for simulated data, a note."""
    width = int(figure.get_size_inches()[0] * 13)
    lines = textwrap.wrap(warning[:1].upper() + plain(warning[1:], 400), width)
    colour = VERMILION if lines else BLACK
    figure.suptitle("\n".join(filter(None, [title, *lines])) or " ", x=0.01, ha="left", fontsize=10.0, color=colour)
    if campaign.metadata.simulated:
        figure.text(0.99, 0.995, "simulated data", ha="right", va="top", fontsize=SMALL, color=GREY)
    if handles:
        figure.legend(handles=list(handles), loc="outside lower center", ncols=len(handles), columnspacing=1.5)
    for ax in figure.axes:
        # Ticks are made when drawn, by then under the caller's settings.
        ax.tick_params(labelsize=RC["xtick.labelsize"], width=0.7, length=3)
    return figure


def finish_joint(
    figure: Figure, calibration: Posterior | LeastSquares, title: str, handles: Sequence[Artist] = ()
) -> Figure:
    """`finish` for a joint calibration, with the first reason not to rely on its numbers below the title."""
    reasons = calibration.failures()
    if isinstance(calibration, LeastSquares):
        reasons += [f"the data leave this combination open: {text}" for text in calibration.identifiability.open]
    warning = ""
    if reasons:
        further = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
        warning = f"{'' if calibration.converged else 'not converged: '}{reasons[0]}{further}"
    return finish(figure, calibration.campaign, title=title, warning=warning, handles=handles)


def note(ax: Axes, text: str, *, place: str = "upper left") -> None:
    """A few small words in a corner of a panel."""
    box = AnchoredText(text, loc=place, prop={"fontsize": SMALL, "linespacing": 1.35}, pad=0.2, borderpad=0.3)
    box.patch.set(facecolor="white", edgecolor="none", alpha=0.75)
    box.set_zorder(10)
    ax.add_artist(box)


def headroom(ax: Axes, share: float) -> None:
    """Space for text above what is drawn."""
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + share * (high - low))


def sequential(values: np.ndarray) -> ScalarMappable:
    """Perceptually uniform colours over the range of the values, short of the brightest, which white would swallow."""
    low, high = float(values.min()), float(values.max())
    if not high - low > 1e-6 * max(abs(low), abs(high)):
        low, high = low - 0.05, high + 0.05
    return ScalarMappable(Normalize(low, high), ListedColormap(colormaps["viridis"](np.linspace(0, 0.9, 256))))


def faintness(count: int) -> dict[str, float]:
    """Line width and opacity for so many curves in one panel."""
    few = count <= THIN_CURVES
    return {"linewidth": 1.1, "alpha": 0.9} if few else {"linewidth": 0.7, "alpha": 0.55}


def spread_over(count: int, most: int) -> np.ndarray:
    """Positions of at most so many of `count` things, spread evenly over them, first and last included."""
    return np.unique(np.round(np.linspace(0, count - 1, min(most, count))).astype(int))


def every(count: int, most: int) -> slice:
    """Every n-th of `count` things, so that at most `most` are left."""
    return slice(None, None, max(1, -(-count // most)))


def shape_factors(calibration: PaperCalibration | Posterior | LeastSquares) -> np.ndarray:
    """eta_p of every particle of the campaign as the calibration states it [-], shape (N,); NaN where it does not."""
    return np.array([entry["eta_p"]["value"] for entry in calibration.to_json()["particles"]], float)
