"""What the law leaves unexplained."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from ..calibrate import PaperCalibration
from .style import (
    FORCE,
    GREY,
    ORANGE,
    SHAPE_FACTOR,
    faintness,
    finish,
    new_figure,
    note,
    sequential,
    shape_factors,
    styled,
)


@styled
def plot_residuals(calibration: PaperCalibration) -> Figure:
    """Measured less predicted displacement [um] over force [mN, logarithmic], one line per kept particle.

    Above by the mean law: mostly the scatter of the particles' material. Below by each particle's own C1, C3, C5, on
    a scale of its own: what the form of the law itself misses. Level stretches are unloading, which keeps the
    deviation of its peak. The orange band is the noise from point to point, plus and minus one standard deviation; a
    law that described everything would leave only that. The paper has no such figure.
    """
    campaign, noise = calibration.campaign, calibration.displacement_noise_um
    eta = shape_factors(calibration)
    shown = f"{noise:.2g}" if noise > 1e-9 else "0"
    kept = [i for i, fit in enumerate(calibration.particles) if fit is not None]
    colours = sequential(eta[kept])
    rgba = colours.to_rgba(eta[kept])
    figure = new_figure(6.4, 5.2)
    panels = figure.subplots(2, 1, sharex=True)
    for ax, name, title, rms in (
        (panels[0], "predicted_um", "mean law", "rms_um"),
        (panels[1], "own_um", "own coefficients of each particle", "own_rms_um"),
    ):
        for row, i in enumerate(kept):
            fit = calibration.particles[i]
            assert fit is not None
            # A gap, not a line, where points do not count.
            deviation = np.where(fit.used, fit.measured_um - getattr(fit, name), np.nan)
            ax.plot(
                campaign.curves[i].force_mN, deviation, color=rgba[row],
                **(faintness(len(kept)) | {"linewidth": 0.8}),
            )  # fmt: skip
        ax.axhline(0.0, color=GREY, linewidth=0.8)
        ax.axhspan(-noise, noise, color=ORANGE, alpha=0.6, linewidth=0, zorder=3)
        ax.set_ylabel("measured − predicted [µm]")
        ax.set_title(title)
        values = [getattr(fit, rms) for fit in calibration.particles if fit is not None]
        note(ax, f"median rms {np.nanmedian(values):.2g} µm; point noise (orange) ± {shown} µm", place="upper right")
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.14 * (high - low))
    panels[1].set_xlabel(FORCE)
    panels[1].set_xscale("log")
    panels[1].xaxis.set_major_formatter(ScalarFormatter())
    figure.colorbar(colours, ax=panels.tolist(), label=SHAPE_FACTOR)
    return finish(figure, campaign.metadata)
