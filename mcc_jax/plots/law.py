"""The loading law against the master curve."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from ..calibrate import PaperCalibration
from .style import (
    BLUE,
    GREY,
    ORANGE,
    SCALED_STRAIN,
    STRESS,
    VERMILION,
    finish,
    new_figure,
    note,
    styled,
)


def law_strain(calibration: PaperCalibration) -> np.ndarray:
    """Scaled strain of the mean law at the stresses of the master curve [-], shape (G,)."""
    plastic = calibration.mean_law.plastic
    return np.asarray(jax.jit(lambda stress: plastic.strain(stress))(jnp.asarray(calibration.master.stress_MPa)))


def stretches_outside(calibration: PaperCalibration) -> list[tuple[int, int]]:
    """Where the mean law is more than one sample standard deviation of strain off, above the threshold.

    Returns:
        First and last position on the master curve of every stretch of at least three points; fewer say nothing.
    """
    master = calibration.master
    with np.errstate(invalid="ignore"):
        off = np.abs(law_strain(calibration) - master.mean) > master.sd
    outside = off & (master.stress_MPa > calibration.adjustment.threshold_MPa)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], outside, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 3]


def _where(stress: np.ndarray, stretches: list[tuple[int, int]]) -> str:
    if not stretches:
        return "mean law within ± 1 sd of the sample over the tested range"
    shown = ", ".join(f"{stress[a]:.2g} to {stress[b]:.2g}" for a, b in stretches[:3])
    more = f" and {len(stretches) - 3} more" if len(stretches) > 3 else ""
    return f"mean law more than 1 sd off the sample at {shown} MPa{more}"


@styled
def plot_law(calibration: PaperCalibration) -> Figure:
    """Stress [MPa] over scaled strain [-] of plastic loading: the calibrated law and the sample it was fitted to.

    Solid: mean law; dashed: one standard deviation of stress under the population of C1, C3, C5; dash-dotted: first
    term alone. Symbols and band: mean and one standard deviation of the sample's strain; crosses where the mean law
    lies outside that band. Grey beyond the largest scaled strain of any test, where the law extrapolates. Follows the
    paper's figure of the master law as stress over strain.
    """
    master, table = calibration.master, calibration.table
    population, plastic = calibration.plastic.population, calibration.mean_law.plastic
    last = np.where(table.reached, table.strain, 0.0).max(axis=1) * table.shape_factor(calibration.a)
    tested, right = float(last.max()), 1.08 * float(last.max())
    x = np.linspace(0.0, right, 400)
    mean, sd = np.asarray(plastic.stress(jnp.asarray(x))), np.asarray(population.stress_sd(jnp.asarray(x)))
    figure = new_figure(5.6, 4.3)
    ax = figure.subplots()
    ax.axvspan(tested, right, color="#ECECEC", linewidth=0, label="beyond the tests")
    known = np.isfinite(master.sd)
    ax.fill_betweenx(
        master.stress_MPa[known], (master.mean - master.sd)[known], (master.mean + master.sd)[known], color=BLUE,
        alpha=0.25, linewidth=0, label="sample mean ± 1 sd of strain",
    )  # fmt: skip
    step = max(1, len(master.mean) // 32)
    ax.plot(
        master.mean, master.stress_MPa, "o", color=BLUE, markevery=step, markeredgecolor="white", markeredgewidth=0.4,
        label="sample mean",
    )  # fmt: skip
    ax.plot(x, mean, color=VERMILION, linewidth=1.6, label="mean law")
    ax.plot(x, mean + sd, color=VERMILION, linewidth=1.0, dashes=(4, 2), label="± 1 sd of stress")
    ax.plot(x, np.maximum(mean - sd, 0.0), color=VERMILION, linewidth=1.0, dashes=(4, 2))
    ax.plot(x, float(plastic.C1) * x, color=GREY, linewidth=1.1, dashes=(5, 1.5, 1, 1.5), label="first term only")
    stretches = stretches_outside(calibration)
    if stretches:
        shown = np.concatenate([np.arange(a, b + 1, max(1, step // 2)) for a, b in stretches])
        ax.plot(
            law_strain(calibration)[shown], master.stress_MPa[shown], "x",
            color=ORANGE, markersize=5, markeredgewidth=1.3, label="law off by > 1 sd",
        )  # fmt: skip
    ax.set_xlim(0, right)
    ax.set_ylim(0, 1.25 * float(table.stress_MPa[-1]))
    ax.set_xlabel(SCALED_STRAIN)
    ax.set_ylabel(STRESS)
    K1, K3, K5 = calibration.plastic.polynomial
    factors = [f"{float(f'{K:.3g}'):.6g}" for K in (K1, K3, K5)]
    text = "$\\sigma$/MPa = {} $x$ − {} $x^3$ + {} $x^5$,  $x = \\eta_p\\,\\varepsilon$".format(*factors)
    ax.set_title(text + "\n" + _where(master.stress_MPa, stretches), fontsize=8.5)
    ax.legend(loc="upper left")
    if calibration.plastic.at_bound:
        note(ax, "at its lower bound:\n" + "\n".join(calibration.plastic.at_bound), place="lower right")
    return finish(figure, calibration.campaign.metadata)
