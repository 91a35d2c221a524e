"""Figures of the joint least squares."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..calibrate import LeastSquaresCalibration
from .bands import plot_fits
from .forest import plot_estimates
from .joint import cautions, flatness
from .style import (
    BLACK,
    GREY,
    ORANGE,
    PALE,
    SHAPE_FACTOR,
    finish,
    new_figure,
    note,
    of_its_kind,
    sequential,
    styled,
)

MAX_POINTS = 20_000
"""No more residuals than these are drawn as points; the histogram counts them all."""


@styled
def plot_whitened(calibration: LeastSquaresCalibration) -> Figure:
    """Residuals of all particles over load, each divided by its noise and freed from correlation [-].

    Load is the share of the particle's own peak force [-]; virgin loading left, unloading and reloading in the middle.
    If the law holds and the noise is right, they scatter like independent standard normal numbers: 95 % within the
    orange band, the histogram on the line, no trend with load or shape (colour). Under a robust loss they are what that
    loss made of them, pulled towards 0.
    """
    tests = calibration.selection.tests
    residual, mask = np.asarray(calibration.solution.residual[0]), np.asarray(tests.mask)
    force, loading = np.asarray(tests.force), np.asarray(tests.loading)
    share = force / force.max(axis=1, keepdims=True)
    eta = 1 + float(calibration.solution.value.shared[0]) * flatness(calibration)
    colours = sequential(eta)
    rgba = colours.to_rgba(eta)
    values = residual[mask]
    reach = max(4.0, 1.1 * float(np.quantile(np.abs(values), 0.999)))
    figure = new_figure(8.6, 4.0)
    panels = figure.subplots(1, 3, sharey=True, width_ratios=[2, 2, 1])
    few = len(values) <= 8000
    for ax, rows, title in (
        (panels[0], loading & mask, "loading"),
        (panels[1], mask & ~loading, "unloading, reloading"),
    ):
        picked = np.flatnonzero(rows)
        picked = picked[:: max(1, -(-len(picked) // MAX_POINTS))]
        ax.axhspan(-1.96, 1.96, color=ORANGE, alpha=0.25, linewidth=0, zorder=0)
        ax.axhline(0.0, color=GREY, linewidth=0.8)
        ax.scatter(
            share.ravel()[picked], residual.ravel()[picked], c=rgba[picked // force.shape[1]], s=4 if few else 2,
            linewidths=0, alpha=0.7 if few else 0.4, rasterized=True,
        )  # fmt: skip
        ax.set_xlim(0, 1.02)
        ax.set_title(title)
        ax.set_xlabel("force over peak force [-]")
    panels[0].set_ylabel("whitened residual [-]")
    panels[0].set_ylim(-reach, reach)
    _histogram(panels[2], values, reach)
    beyond = int(np.sum(np.abs(values) > reach))
    if beyond:
        note(panels[0], f"{beyond} beyond the axis", place="upper left")
    figure.colorbar(colours, ax=panels.tolist(), label=SHAPE_FACTOR)
    loss = "" if calibration.loss == "linear" else f", {calibration.loss} loss"
    count = f"{len(residual)} particles" if len(residual) > 1 else "one particle"
    title = f"Residuals of {count}{loss}: rms {np.sqrt(np.mean(values**2)):.2f}"
    return finish(figure, calibration.campaign.metadata, title=title, lines=cautions(figure, calibration))


def _histogram(ax: Axes, values: np.ndarray, reach: float) -> None:
    edges = np.linspace(-reach, reach, 41)
    counts, _ = np.histogram(values, edges)
    ax.stairs(
        counts / (max(len(values), 1) * np.diff(edges)), edges, orientation="horizontal", fill=True, color=PALE,
        label="residuals",
    )  # fmt: skip
    x = np.linspace(-reach, reach, 201)
    ax.plot(np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), x, color=BLACK, linewidth=1.0, label="normal")
    ax.set_xlabel("density [-]")
    ax.set_xlim(left=0)
    ax.legend(loc="upper right", handlelength=1.2)


@of_its_kind
def least_squares_figures(calibration: LeastSquaresCalibration) -> dict[str, Figure]:
    """Every figure of the joint least squares, by the stem of its file's name.

    Returns:
        `whitened`, `fits`, `estimates`.
    """
    return {
        "whitened": plot_whitened(calibration),
        "fits": plot_fits(calibration),
        "estimates": plot_estimates(calibration),
    }
