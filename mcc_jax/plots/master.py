"""The master curve."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ..calibrate import PaperCalibration
from .style import (
    BLUE,
    GREY,
    PALE,
    SCALED_STRAIN,
    STRESS,
    faintness,
    finish,
    new_figure,
    note,
    styled,
)


@styled
def plot_master(calibration: PaperCalibration) -> Figure:
    """Mean (symbols) and one standard deviation (band) of the scaled strain [-] over stress [MPa].

    Faint lines are the single particles' adjusted loading curves, scaled by their shape factors; the lower panel
    counts the particles that reach a stress. Mean and band end where no more than a fifth of the particles is left.
    Follows the paper's figure of the master contact law as a distribution of strain.
    """
    master, table = calibration.master, calibration.table
    eta = table.shape_factor(calibration.a)
    figure = new_figure(5.6, 4.9)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3.4, 1])
    thin = faintness(len(eta)) | {"linewidth": 0.6}
    for row, factor in enumerate(eta):
        reached = table.reached[row]
        line = upper.plot(table.stress_MPa[reached], factor * table.strain[row, reached], color=PALE, **thin)[0]
        line.set_label("single particles" if row == 0 else "_")
    known = np.isfinite(master.sd)
    upper.fill_between(
        master.stress_MPa[known],
        (master.mean - master.sd)[known],
        (master.mean + master.sd)[known],
        color=BLUE,
        alpha=0.25,
        linewidth=0,
        label="mean ± 1 sd",
    )
    step = max(1, len(master.mean) // 32)
    upper.plot(
        master.stress_MPa, master.mean, "o", color=BLUE, markevery=step, markeredgecolor="white",
        markeredgewidth=0.4, label="mean",
    )  # fmt: skip
    upper.set_ylabel(SCALED_STRAIN)
    upper.set_ylim(bottom=0)
    upper.legend(loc="lower right")
    note(upper, f"a = {calibration.a:.2f}, {len(eta)} particles")
    lower.fill_between(table.stress_MPa, table.reached.sum(axis=0), step="mid", color=PALE, linewidth=0)
    lower.plot(master.stress_MPa, master.count, color=BLUE, drawstyle="steps-mid")
    lower.axhline(len(eta) / 5, color=GREY, linewidth=0.8, dashes=(1, 1.5))
    lower.set_ylim(0, 1.12 * len(eta))
    lower.set_xlim(0, 1.02 * table.stress_MPa[-1])
    lower.yaxis.get_major_locator().set_params(integer=True)
    lower.set_ylabel("particles [-]")
    lower.set_xlabel(STRESS)
    lower.text(
        0.01, len(eta) / 5, "one fifth", transform=lower.get_yaxis_transform(), va="bottom", fontsize=7, color=GREY
    )
    return finish(figure, calibration.campaign.metadata)
