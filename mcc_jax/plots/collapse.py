"""What the shape factor is for: the particles' curves before and after scaling."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ..calibrate import PaperCalibration
from .style import (
    BLACK,
    SCALED_STRAIN,
    SHAPE_FACTOR,
    STRAIN,
    STRESS,
    faintness,
    finish,
    new_figure,
    sequential,
    shape_fit,
    styled,
)


@styled
def plot_collapse(calibration: PaperCalibration) -> Figure:
    """Stress [MPa] of all kept loading curves over strain [-] and over strain scaled by the shape factor [-].

    Colour is the shape factor: sorted by colour on the left, mixed on the right if it does what it is for. The black
    line is the mean, as far as all particles reach. Each panel gives the objective, the sum of squared relative
    deviations from the mean (or from the reference particle). The paper prints no such figure; the right panel is its
    master curve before averaging.
    """
    table, fit = calibration.table, shape_fit(calibration)
    eta = table.shape_factor(calibration.a)
    colours = sequential(eta)
    figure = new_figure(7.8, 3.9)
    panels = figure.subplots(1, 2, sharey=True)
    curves = [c for c in calibration.adjustment.curves if c is not None]
    rgba = colours.to_rgba(eta)
    # Further up the mean would jump wherever a particle's test ends.
    everyone = table.reached.all(axis=0)
    for ax, factors, title, value, label in (
        (panels[0], np.ones_like(eta), "not scaled, a = 0", fit.objective_at_zero, STRAIN),
        (panels[1], eta, f"scaled, a = {calibration.a:.2f}", fit.objective, SCALED_STRAIN),
    ):
        for curve, factor, colour in zip(curves, factors, rgba, strict=True):
            ax.plot(factor * curve.strain, curve.stress_MPa, color=colour, **faintness(len(eta)))
        mean = (factors[:, None] * table.strain[:, everyone]).mean(axis=0)
        ax.plot(
            mean,
            table.stress_MPa[everyone],
            color=BLACK,
            linewidth=1.8,
            dashes=(2.5, 1.2),
            label="mean of all particles",
        )
        ax.set_xlim(left=0)
        ax.set_xlabel(label)
        ax.set_title(title)
        ax.legend(loc="upper left", title=f"objective {value:.4g}", alignment="left", title_fontsize=8)
    panels[0].set_ylim(bottom=0)
    panels[0].set_ylabel(STRESS)
    figure.colorbar(colours, ax=panels.tolist(), label=SHAPE_FACTOR)
    lines = [f"the fit of a did not succeed: {fit.reason}"] if fit.reason else []
    return finish(figure, calibration.campaign.metadata, lines=lines)
