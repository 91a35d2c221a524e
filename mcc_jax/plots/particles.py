"""Every particle's test against the calibrated law."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .._errors import InputError
from ..calibrate import PaperCalibration, ParticleFit
from ..campaign import Curve
from .style import (
    BLACK,
    BLUE,
    DISPLACEMENT,
    FORCE,
    GREY,
    PALE,
    SKY,
    VERMILION,
    finish,
    new_figure,
    of_its_kind,
    shape_factors,
    styled,
)
from .text import particle_labels, plain

PER_PAGE = 20
_COLUMNS = 4


@of_its_kind
def particle_pages(calibration: PaperCalibration) -> int:
    """Number of pages that `plot_particles` needs for all particles."""
    return -(-len(calibration.campaign) // PER_PAGE)


def _rounded(rms_um: float) -> str:
    return f"{rms_um:.1f}" if rms_um >= 1 else f"{rms_um:.2g}"


def _kept_panel(ax: Axes, curve: Curve, fit: ParticleFit) -> None:
    every = max(1, int(np.ceil(len(curve) / 80)))
    for rows, colour in ((~fit.used, SKY), (fit.used, BLUE)):
        shown = np.flatnonzero(rows)[::every]
        ax.plot(
            fit.measured_um[shown], curve.force_mN[shown], "o", color=colour, markersize=3, markeredgewidth=0,
            alpha=0.8,
        )  # fmt: skip
    ax.plot(fit.predicted_um, curve.force_mN, color=VERMILION, linewidth=1.3)
    ax.plot(fit.own_um, curve.force_mN, color=BLACK, linewidth=0.7)


def _dropped_panel(ax: Axes, curve: Curve, reason: str) -> None:
    ax.plot(curve.displacement_um, curve.force_mN, color=PALE, linewidth=1.0)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.45 * (high - low))  # room for the reason
    ax.set_facecolor("#F6F6F6")
    ax.text(
        0.04, 0.95, textwrap.fill(plain(reason, 200), 26), transform=ax.transAxes, ha="left", va="top", fontsize=7,
        color=GREY,
    )  # fmt: skip


@styled
def plot_particles(calibration: PaperCalibration, page: int | None = None) -> Figure:
    """Force [mN] over displacement [um], loading and unloading, one panel per particle, measured and predicted.

    Points: measured, after the offset step (light where they do not enter the rms). Thick line: the mean law scaled
    by the particle's size and shape, under the measured force. Thin line: the same with the particle's own C1, C3,
    C5. The title gives the shape factor and the root mean square deviation from the mean law. Particles that could
    not be used are grey, as recorded, with the reason. If the law misses the data altogether, a line below the title
    says so. Follows the paper's three figures of experimental values and predictions.

    Args:
        calibration: the calibration.
        page: from 1, with at most 20 particles each (`particle_pages` gives their number); the first if None.

    Raises:
        ValueError: if there is no such page.
    """
    pages = particle_pages(calibration)
    number = 1 if page is None else page
    if number not in range(1, pages + 1):
        raise InputError(f"there is no page {number}; there are {pages}, counted from 1")
    campaign = calibration.campaign
    chosen = range((number - 1) * PER_PAGE, min(number * PER_PAGE, len(campaign)))
    columns = min(_COLUMNS, len(chosen)) if len(campaign) <= PER_PAGE else _COLUMNS
    rows = -(-len(chosen) // columns)
    scale = 1.5 if columns < 3 else 1.0
    figure = new_figure(max(scale * 2.35 * columns, 6.4), scale * 2.05 * rows + 0.9)
    grid = figure.subplots(rows, columns, squeeze=False)
    labels, eta = particle_labels(campaign.particles), shape_factors(calibration)
    for rank, ax in enumerate(grid.ravel()):
        if rank >= len(chosen):
            ax.set_axis_off()
            continue
        i = chosen[rank]
        fit = calibration.particles[i]
        if fit is None:
            _dropped_panel(ax, campaign.curves[i], calibration.adjustment.why_not[i] or "not used")
            detail = f"$\\eta_p$ = {eta[i]:.2f}, not used"
        else:
            _kept_panel(ax, campaign.curves[i], fit)
            force = campaign.curves[i].force_mN
            if force.min() > -0.02 * force.max():
                ax.set_ylim(bottom=0)
            detail = f"$\\eta_p$ = {eta[i]:.2f}, rms {_rounded(fit.rms_um)} µm"
        ax.set_title(f"{labels[i]}\n{detail}", fontsize=8, color=GREY if fit is None else BLACK, linespacing=1.15)
        ax.locator_params(nbins=5)
        if rank % columns == 0:
            ax.set_ylabel(FORCE)
        if rank + columns >= len(chosen):
            ax.set_xlabel(DISPLACEMENT)
    figure.align_ylabels(list(grid[:, 0]))
    handles = [
        Line2D([], [], color=BLUE, marker="o", linestyle="", markersize=3.5, label="measured, adjusted"),
        Line2D([], [], color=VERMILION, linewidth=1.3, label="mean law"),
        Line2D([], [], color=BLACK, linewidth=0.7, label="own coefficients"),
    ]
    if any(calibration.particles[i] is None for i in chosen):
        handles.append(Line2D([], [], color=PALE, label="not used"))
    counted = f", page {number} of {pages}" if pages > 1 else ""
    warning = calibration.misfit_note
    width = int(figure.get_size_inches()[0] * 14)
    lines = textwrap.wrap(plain(warning[0].upper() + warning[1:], 400), width) if warning else []
    return finish(figure, campaign.metadata, title=f"Measured and predicted{counted}", lines=lines, handles=handles)
