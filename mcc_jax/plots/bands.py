"""Measured curves against what the joint calibrations say of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..calibrate import BayesCalibration, LeastSquaresCalibration, predict_measured
from ..campaign import campaign_segments
from .joint import cautions, flatness, kept_labels, spread_over
from .style import (
    BLACK,
    BLUE,
    DISPLACEMENT,
    FORCE,
    GREY,
    PALE,
    VERMILION,
    finish,
    new_figure,
    styled,
)

MAX_CELLS = 12
COLUMNS = 3
BAND_DRAWS = 1000
LOADING, UNLOADING = BLUE, VERMILION
RESIDUAL = "residual [µm]"


@dataclass(frozen=True)
class Cell:
    """One particle in a grid of curves.

    Attributes:
        title: two short lines.
        force: measured [mN], shape (n,).
        measured: displacement [um].
        predicted: displacement at the middle of what is predicted [um]; NaN where nothing is.
        band: lower and upper end of what may be measured [um], or None.
        used: which points were compared with the law.
        branches: rows of every segment, and whether it is virgin loading.
    """

    title: str
    force: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    band: tuple[np.ndarray, np.ndarray] | None
    used: np.ndarray
    branches: list[tuple[bool, np.ndarray]]


def branches_of(
    calibration: BayesCalibration | LeastSquaresCalibration, chosen: np.ndarray
) -> list[list[tuple[bool, np.ndarray]]]:
    """For each chosen particle, the rows of its test's segments in `selection.tests`, and whether they are loading."""
    selection = calibration.selection
    positions = np.asarray(selection.kept)[chosen]
    wanted = np.zeros(len(calibration.campaign), bool)
    wanted[positions] = True
    found = []
    for row, segments in zip(chosen, campaign_segments(calibration.campaign.select(wanted)), strict=True):
        taken = selection.rows[row]
        inside = [(s.kind == "load", np.flatnonzero((taken >= s.start) & (taken < s.stop))) for s in segments]
        found.append([(loading, rows) for loading, rows in inside if len(rows)])
    return found


def _draw_cell(ax: Axes, strip: Axes, cell: Cell) -> None:
    unused = ~cell.used
    ax.plot(cell.measured[unused], cell.force[unused], ".", color=PALE, markersize=2.5, markeredgewidth=0)
    strip.axvline(0.0, color=GREY, linewidth=0.7)
    away = cell.measured - cell.predicted
    every = max(1, -(-len(cell.force) // 100))
    for kind, colour in ((True, LOADING), (False, UNLOADING)):
        parts = [rows[cell.used[rows]] for loading, rows in cell.branches if loading == kind]
        for rows in parts:
            shown = rows[::every]
            ax.plot(
                cell.measured[shown], cell.force[shown], "o", color=colour, markersize=3, markeredgewidth=0, alpha=0.7
            )
            _fill(ax, cell, rows, 0.0, colour, 0.35)
        together = np.concatenate([np.empty(0, int), *parts])
        strip.plot(
            away[together], cell.force[together], ".", color=colour, markersize=2.5, markeredgewidth=0, alpha=0.8
        )
        _fill(strip, cell, together, cell.predicted, colour, 0.25)
    # A gap where points do not count; from one segment to the next the line goes on.
    ax.plot(np.where(cell.used, cell.predicted, np.nan), cell.force, color=BLACK, linewidth=0.8)


def _fill(ax: Axes, cell: Cell, rows: np.ndarray, origin: np.ndarray | float, colour: str, opacity: float) -> None:
    """The band at some rows, displacement counted from an origin."""
    if cell.band is None or len(rows) < 2:
        return
    # Noise of force must not fold the band.
    along = rows[np.argsort(cell.force[rows], kind="stable")]
    low, high = ((end - origin)[along] for end in cell.band)
    ax.fill_betweenx(cell.force[along], low, high, color=colour, alpha=opacity, linewidth=0)


def draw_grid(cells: Sequence[Cell]) -> Figure:
    """Force over displacement of some particles, with a strip of residuals beside each."""
    columns = min(COLUMNS, len(cells))
    rows = -(-len(cells) // columns)
    scale = 1.0 if columns == COLUMNS else 1.5
    figure = new_figure(max(scale * 3.2 * columns, 6.4), max(scale * 2.05 * rows + 1.0, 3.4))
    grid = figure.subplots(rows, 2 * columns, squeeze=False, width_ratios=[1.9, 1.0] * columns)
    for rank in range(rows * columns):
        row, column = divmod(rank, columns)
        ax, strip = grid[row, 2 * column], grid[row, 2 * column + 1]
        if rank >= len(cells):
            ax.set_axis_off()
            strip.set_axis_off()
            continue
        cell = cells[rank]
        strip.sharey(ax)
        _draw_cell(ax, strip, cell)
        ax.set_title(cell.title, fontsize=8, linespacing=1.15)
        if cell.force.min() > -0.02 * cell.force.max():
            ax.set_ylim(bottom=0)
        reach = 1.1 * max(abs(end) for end in strip.get_xlim())
        strip.set_xlim(-reach, reach)
        tick = float(f"{0.65 * reach:.0e}")
        strip.set_xticks([-tick, 0.0, tick], [f"−{tick:g}", "0", f"{tick:g}"])
        strip.tick_params(labelleft=False)
        ax.locator_params(nbins=5)
        if column == 0:
            ax.set_ylabel(FORCE)
        if rank + columns >= len(cells):
            ax.set_xlabel(DISPLACEMENT)
            strip.set_xlabel(RESIDUAL)
    figure.align_ylabels(list(grid[:, 0]))
    return figure


def _handles(unused: bool) -> list[Line2D | Patch]:
    dot = {"marker": "o", "linestyle": "", "markersize": 3.5, "markeredgewidth": 0}
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=LOADING, label="measured, loading", **dot),
        Line2D([], [], color=UNLOADING, label="unloading, reloading", **dot),
    ]
    if unused:
        handles.append(Line2D([], [], color=PALE, label="not used", **dot))
    return handles


def _grid_title(what: str, shown: int, count: int) -> str:
    return f"{what}, {shown} of {count} particles" if shown < count else what


@styled
def plot_bands(calibration: BayesCalibration) -> Figure:
    """Force [mN] over displacement [um] of at most 12 particles, and what the posterior expects of each.

    The particles are spread evenly over the campaign. Points: measured, light where they are not compared with the law.
    Line and band: median and central 95 % of what would be measured at these forces, noise included. The strip beside
    each panel is the residual, measured less median [um], with the same band: it shows what the panel is too coarse
    for. The title counts the points inside.
    """
    labels, tests = kept_labels(calibration), calibration.selection.tests
    chosen = spread_over(len(labels), MAX_CELLS)
    eta = np.asarray(calibration.shape_factor).mean(axis=(0, 1))
    cells = []
    for row, branches in zip(chosen, branches_of(calibration, chosen), strict=True):
        curves = predict_measured(calibration, calibration.particles[row], count=BAND_DRAWS, seed=int(row))
        length = len(curves.force_mN)
        measured, used = np.asarray(tests.displacement[row])[:length], np.asarray(tests.mask[row])[:length]
        low, high = curves.band(0.95, observed=True)
        inside = 100 * np.mean(((measured >= low) & (measured <= high))[used])
        title = f"{labels[row]}\n$\\eta_p$ = {eta[row]:.2f}, {inside:.0f} % inside"
        middle = np.median(curves.displacement_um, axis=0)
        cells.append(Cell(title, curves.force_mN, measured, middle, (low, high), used, branches))
    figure = draw_grid(cells)
    handles = _handles(any((~cell.used).any() for cell in cells))
    handles.append(Line2D([], [], color=BLACK, linewidth=0.8, label="predicted"))
    handles.append(Patch(color=GREY, alpha=0.35, linewidth=0, label="95 %"))
    return finish(
        figure,
        calibration.campaign.metadata,
        title=_grid_title("Measured and predicted", len(cells), len(labels)),
        lines=cautions(figure, calibration),
        handles=handles,
    )


@styled
def plot_fits(calibration: LeastSquaresCalibration) -> Figure:
    """Force [mN] over displacement [um] of at most 12 particles, spread over the campaign, measured and fitted.

    Points: measured, light where they are not compared with the law. Line: the joint fit. The strip beside each panel
    is the residual, measured less fitted [um]; the title gives its root mean square.
    """
    labels, tests = kept_labels(calibration), calibration.selection.tests
    chosen = spread_over(len(labels), MAX_CELLS)
    eta = 1 + float(calibration.solution.value.shared[0]) * flatness(calibration)
    residual = calibration.residual()
    cells = []
    for row, branches in zip(chosen, branches_of(calibration, chosen), strict=True):
        length = len(calibration.selection.rows[row])
        force, measured, used = (np.asarray(v[row])[:length] for v in (tests.force, tests.displacement, tests.mask))
        rms = np.sqrt(np.mean(residual[row, :length][used] ** 2))
        title = f"{labels[row]}\n$\\eta_p$ = {eta[row]:.2f}, rms {rms:.2g} µm"
        cells.append(Cell(title, force, measured, measured - residual[row, :length], None, used, branches))
    figure = draw_grid(cells)
    handles = _handles(any((~cell.used).any() for cell in cells))
    handles.append(Line2D([], [], color=BLACK, linewidth=0.8, label="fitted"))
    return finish(
        figure,
        calibration.campaign.metadata,
        title=_grid_title("Measured and fitted", len(cells), len(labels)),
        lines=cautions(figure, calibration),
        handles=handles,
    )
