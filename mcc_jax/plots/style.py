"""What all figures share: settings, colours, layout, text from outside made fit to be drawn, and writing the files."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import arguments
from .._errors import InputError
from .._extras import extra
from ..calibrate import LeastSquares, PaperCalibration, Posterior
from ..campaign import Metadata

with extra("plots"):  # every other file of the package imports this one or `curves` first
    from matplotlib import colormaps, rc_context
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.figure import Figure
    from matplotlib.font_manager import findfont, get_font


CURVE_POINTS = 100  # about so many points of a curve are drawn, so that dots do not overlap
MEAN_MARKERS = 32  # about so many symbols on a mean curve
THIN_CURVES = 30  # of more curves in one panel, lines are thin and faint

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
"""Okabe and Ito's palette, distinguishable by colour-blind readers."""
GREY, PALE = "#767676", "#B8B8B8"

STRAIN = "strain $\\varepsilon$ [-]"
SCALED_STRAIN = "scaled strain $\\eta_p\\,\\varepsilon$ [-]"
STRESS = "stress $\\sigma$ [MPa]"
SHAPE_FACTOR = "shape factor $\\eta_p$ [-]"
FORCE = "force $F$ [mN]"
DISPLACEMENT = "displacement $\\gamma$ [µm]"

FONT = "DejaVu Sans"
"""Comes with matplotlib, so that a figure looks the same everywhere."""
SMALL = 7.5
RC: dict[Any, Any] = {
    "font.family": FONT,
    "font.size": 9.0,
    "axes.labelsize": 9.0,
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
    "mathtext.default": "it",
    "text.usetex": False,
    "text.parse_math": True,
    "savefig.facecolor": "white",
    "savefig.bbox": None,
    "figure.facecolor": "white",
}
type Look = dict[str, Any]
"""Keywords of what is drawn."""


styled = rc_context(RC)
"""Decorator: the function runs under these settings and leaves the caller's as they were."""


@rc_context(RC)
def save_figures(figures: Mapping[str, Figure], directory: str | Path, *, dpi: int = 150) -> list[Path]:
    """Write figures as `<stem>.png` into a directory that exists.

    Files of these names are overwritten; they are returned in the order of the figures. `dpi`: dots per inch.
    """
    folder = arguments.file_path(directory, "directory")
    dpi = arguments.whole(dpi, "dpi", least=1)
    if not folder.is_dir():
        raise InputError("no such folder", file=folder, remedy="Make it first.")
    files = []
    for stem, figure in figures.items():
        files.append(folder / f"{stem}.png")
        figure.savefig(files[-1], format="png", dpi=dpi)
    return files


# ---- text from outside -----------------------------------------------------------------------------------------------


def plain(text: str, longest: int = 24) -> str:
    """Any text as one short line that matplotlib draws literally.

    White space and characters that do not print become single blanks, characters that the font lacks the replacement
    character, a long text loses its middle, and `$` is escaped, which would begin mathematics.
    """
    font = get_font(findfont(FONT))
    visible = "".join(c if c.isprintable() else " " for c in text)
    drawn = "".join(
        c if font.get_char_index(ord(c)) else "\N{REPLACEMENT CHARACTER}" for c in " ".join(visible.split())
    )
    if len(drawn) > longest:
        head = longest // 2
        drawn = drawn[:head].rstrip() + "…" + drawn[len(drawn) - (longest - head - 1) :].lstrip()
    return drawn.replace("$", r"\$")


def particle_labels(names: Sequence[str], longest: int = 24) -> list[str]:
    """Names of particles for a figure, all different.

    A bare number becomes "particle 7"; where two look the same, or part cannot be drawn, the position in the campaign
    is added.
    """
    labels = [f"particle {name}" if name.isdecimal() and len(name) < 8 else plain(name, longest) for name in names]
    repeated = {label for label in labels if labels.count(label) > 1} if len(set(labels)) < len(labels) else set()
    return [
        f"{label} (no. {i})".strip()
        if not label or label in repeated or "\N{REPLACEMENT CHARACTER}" in label
        else label
        for i, label in enumerate(labels, start=1)
    ]


def is_simulated(metadata: Metadata) -> bool:
    """Whether the metadata say that nobody measured these data."""
    return "simulation" in metadata.other or "not a measurement" in (metadata.provenance or "")


def wrapped(text: str, figure: Figure) -> list[str]:
    """A warning as lines below the title of a figure; none for an empty one."""
    return textwrap.wrap(text[:1].upper() + text[1:], int(figure.get_size_inches()[0] * 14))


def cautions(figure: Figure, calibration: Posterior | LeastSquares) -> list[str]:
    """Lines below the title that say why the numbers must not be relied on; none if they may be."""
    if isinstance(calibration, Posterior):
        reasons = calibration.failures()
    else:
        reasons = [calibration.reason] if calibration.reason else []
        reasons += [f"the data leave this combination open: {text}" for text in calibration.identifiability.open]
    if not reasons:
        return []
    further = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    return wrapped(f"{'' if calibration.converged else 'not converged: '}{plain(reasons[0], 300)}{further}", figure)


# ---- layout ----------------------------------------------------------------------------------------------------------

_NOTE_IN, _LEGEND_IN, _TITLE_IN, _LINE_IN = 0.2, 0.3, 0.3, 0.19


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure of that size, not known to pyplot."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def finish(
    figure: Figure,
    metadata: Metadata,
    *,
    title: str = "",
    lines: Sequence[str] = (),
    handles: Sequence[Artist] = (),
) -> Figure:
    """Add a title, lines of warnings below it, a legend below the panels and, for simulated data, a note."""
    width, height = figure.get_size_inches()
    below = above = 0.0
    if is_simulated(metadata):
        figure.text(
            1 - 0.06 / width, 0.05 / height, "simulated data", ha="right", va="bottom", fontsize=SMALL, color=GREY
        )
        below += _NOTE_IN
    if handles:
        figure.legend(
            handles=list(handles), loc="lower center", bbox_to_anchor=(0.5, below / height), ncols=len(handles),
            borderaxespad=0.2,
        )  # fmt: skip
        below += _LEGEND_IN
    if title:
        figure.text(0.08 / width, 1 - 0.07 / height, title, ha="left", va="top", fontsize=10.5)
        above += _TITLE_IN
    for line in lines:
        figure.text(0.08 / width, 1 - (above + 0.02) / height, line, ha="left", va="top", fontsize=8.5, color=VERMILION)
        above += _LINE_IN
    figure.set_layout_engine("constrained", rect=(0, below / height, 1, 1 - (below + above) / height))
    for ax in figure.axes:
        # Ticks are made when drawn, by then under the caller's settings.
        ax.tick_params(labelsize=RC["xtick.labelsize"], width=0.7, length=3)
    return figure


def finish_joint(
    figure: Figure, calibration: Posterior | LeastSquares, title: str, handles: Sequence[Artist] = ()
) -> Figure:
    """`finish` for a joint calibration, with what keeps its numbers from being relied on below the title."""
    lines = cautions(figure, calibration)
    return finish(figure, calibration.campaign.metadata, title=title, lines=lines, handles=handles)


def note(ax: Axes, text: str, *, place: str = "upper left") -> None:
    """A few small words in a corner of a panel."""
    vertical, horizontal = place.split()
    x, y = {"left": 0.025, "right": 0.975}[horizontal], {"upper": 0.975, "lower": 0.03}[vertical]
    ax.text(
        x, y, text, transform=ax.transAxes, ha=horizontal, va="top" if vertical == "upper" else "bottom",
        fontsize=SMALL, linespacing=1.35, zorder=10,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5},
    )  # fmt: skip


def empty(ax: Axes, text: str) -> None:
    """Say why a panel shows nothing."""
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", color=GREY, wrap=True)
    ax.spines[:].set_visible(False)
    ax.set_xticks([])
    ax.set_yticks([])


def headroom(ax: Axes, share: float) -> None:
    """Room above what is drawn for words."""
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + share * (high - low))


def sequential(values: np.ndarray) -> ScalarMappable:
    """Perceptually uniform colours over the range of the values, short of the brightest, which white would swallow."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
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
    """Every so manieth of `count` things, so that at most `most` are left."""
    return slice(None, None, max(1, -(-count // most)))


def shape_factors(calibration: PaperCalibration | Posterior | LeastSquares) -> np.ndarray:
    """eta_p of every particle of the campaign as the calibration states it [-], shape (N,); NaN where it does not."""
    return np.array([entry["eta_p"]["value"] for entry in calibration.to_json()["particles"]], float)
