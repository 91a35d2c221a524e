"""The curve of a particle that was never measured."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from .. import arguments
from ..calibrate import BayesCalibration, predict_new_particle
from ..campaign import PAPER_DIAMETERS_UM, effective_diameter_um, of_each_particle
from ..geometry import plastic_shape_factor
from .bands import LOADING, UNLOADING
from .joint import cautions
from .style import BLACK, DISPLACEMENT, FORCE, GREY, finish, new_figure, styled

DRAWS, SINGLE = 1000, 6


def _usual_force(calibration: BayesCalibration, diameters_um: np.ndarray) -> float:
    """Force that brings a particle of that size to the campaign's median peak stress [mN]."""
    campaign = calibration.campaign
    ratios = [
        campaign.curves[i].force_mN.max() / effective_diameter_um(campaign.diameters_um[i]) ** 2
        for i in calibration.selection.kept
    ]
    return float(np.median(ratios)) * effective_diameter_um(diameters_um) ** 2


@styled
def plot_new_particle(calibration: BayesCalibration, diameters_um: Any = None) -> Figure:
    """Force [mN] over displacement [um] of a particle that was never measured, loading and unloading.

    Bands: central 50 % and 95 % of the posterior's curves at each force, scatter of the particles and uncertainty of
    the population together, without read-out noise. Line: their median. Thin lines: single draws, each the curve of
    one possible particle. It is loaded to the campaign's median peak stress.

    Args:
        calibration: the posterior.
        diameters_um: its D1, D2, D3 [um]; by default the medians of the paper's Table 1.

    Raises:
        InputError: for diameters that are not three positive numbers.
    """
    sizes = np.median(PAPER_DIAMETERS_UM, axis=0) if diameters_um is None else arguments.one_particle(diameters_um)
    up = np.linspace(0.0, _usual_force(calibration, sizes), 101)
    curves = predict_new_particle(calibration, sizes.tolist(), np.concatenate([up, up[-2::-1]]), count=DRAWS)
    figure = new_figure(7.8, 4.1)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    branches = (slice(0, len(up)), slice(len(up) - 1, None))
    for ax, rows, colour, title in zip(panels, branches, (LOADING, UNLOADING), ("loading", "unloading"), strict=True):
        force = curves.force_mN[rows]
        for share, opacity in ((0.95, 0.2), (0.5, 0.35)):
            low, high = curves.band(share)
            ax.fill_betweenx(force, low[rows], high[rows], color=colour, alpha=opacity, linewidth=0)
        for draw in curves.displacement_um[:SINGLE, rows]:
            ax.plot(draw, force, color=GREY, linewidth=0.6)
        ax.plot(np.median(curves.displacement_um, axis=0)[rows], force, color=BLACK, linewidth=1.3)
        ax.set_title(title)
        ax.set_xlabel(DISPLACEMENT)
    panels[0].set_ylabel(FORCE)
    panels[0].set_xlim(left=0)
    panels[0].set_ylim(0, 1.02 * up[-1])
    a = float(np.median(np.asarray(calibration.population.a)))
    (eta,) = of_each_particle(sizes[None], lambda p: plastic_shape_factor(p, a))
    D1, D2, D3 = sizes
    title = f"A new particle of {D1:.0f} × {D2:.0f} × {D3:.0f} µm, $\\eta_p$ = {eta:.2f}"
    handles = [
        Line2D([], [], color=BLACK, linewidth=1.3, label="median"),
        Patch(color=GREY, alpha=0.6, linewidth=0, label="50 %"),
        Patch(color=GREY, alpha=0.25, linewidth=0, label="95 %"),
        Line2D([], [], color=GREY, linewidth=0.6, label="single draws"),
    ]
    lines = cautions(figure, calibration)
    return finish(figure, calibration.campaign.metadata, title=title, lines=lines, handles=handles)
