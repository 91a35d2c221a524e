"""The look that all figures share: colours, font sizes, layout, the note on simulated data."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, get_type_hints

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from .. import arguments
from ..calibrate import PaperCalibration, ShapeFit
from ..campaign import Campaign, Metadata, check_campaign, of_each_particle
from ..geometry import plastic_shape_factor
from .text import FONT, is_simulated

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
"""Okabe and Ito's palette, told apart by colour-blind readers."""
GREY, PALE = "#767676", "#B8B8B8"

STRAIN = "strain $\\varepsilon$ [-]"
SCALED_STRAIN = "scaled strain $\\eta_p\\,\\varepsilon$ [-]"
STRESS = "stress $\\sigma$ [MPa]"
SHAPE_FACTOR = "shape factor $\\eta_p$ [-]"
FORCE = "force $F$ [mN]"
DISPLACEMENT = "displacement $\\gamma$ [µm]"

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
_MADE_BY = {
    "PaperCalibration": "mcc_jax.calibrate_paper(campaign)",
    "LeastSquaresCalibration": "mcc_jax.calibrate_least_squares(campaign)",
    "BayesCalibration": "mcc_jax.calibrate_bayes(campaign)",
    "Discovery": "mcc_jax.discover.discover(campaign)",
}


def of_its_kind[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: what is not of the kind of the function's first argument is refused in words, before anything else."""

    @functools.cache
    def wanted() -> tuple[str, Any]:
        bare = inspect.unwrap(function)
        name = next(iter(inspect.signature(bare).parameters))
        return name, get_type_hints(bare)[name]

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        name, kind = wanted()
        given = args[0] if args else kwargs.get(name)
        if kind is Campaign:
            check_campaign(given, name)
        else:
            arguments.instance(given, kind, name, f"Make one with {_MADE_BY[kind.__name__]}.")
        return function(*args, **kwargs)

    return call


def styled[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: the function runs under these settings, leaves the caller's as they were, and checks what it draws."""
    return of_its_kind(rc_context(RC)(function))


_NOTE_IN, _LEGEND_IN, _TITLE_IN, _LINE_IN = 0.2, 0.3, 0.3, 0.19


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure of that size, apart from pyplot."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def finish(
    figure: Figure,
    metadata: Metadata,
    *,
    title: str = "",
    lines: Sequence[str] = (),
    handles: Sequence[Artist] = (),
) -> Figure:
    """Add title, lines below it, a legend for the whole figure and, for simulated data, a note; the panels make room.

    Args:
        figure: the figure, with its panels.
        metadata: the campaign's.
        title: one line at the top left.
        lines: warnings below the title.
        handles: artists with labels, for a legend below the panels.
    """
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


def sequential(values: np.ndarray) -> ScalarMappable:
    """Perceptually uniform colours over the range of the values, short of the brightest, which white would swallow."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    if not high - low > 1e-6 * max(abs(low), abs(high)):
        low, high = low - 0.05, high + 0.05
    return ScalarMappable(Normalize(low, high), ListedColormap(colormaps["viridis"](np.linspace(0, 0.9, 256))))


def shape_factors(calibration: PaperCalibration) -> np.ndarray:
    """eta_p of every particle of the campaign under the calibrated `a` [-], shape (N,)."""
    return of_each_particle(calibration.campaign.diameters_um, lambda p: plastic_shape_factor(p, calibration.a))


def shape_fit(calibration: PaperCalibration) -> ShapeFit:
    """The fit whose `a` is in the law."""
    reference = calibration.shape_reference
    return reference if calibration.objective == "reference" and reference is not None else calibration.shape


def faintness(count: int) -> dict[str, float]:
    """Line width and opacity for so many curves in one panel."""
    return {"linewidth": 1.1, "alpha": 0.9} if count <= 30 else {"linewidth": 0.7, "alpha": 0.55}
