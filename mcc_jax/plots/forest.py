"""Every particle's coefficients with their intervals, and the population behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch

from ..calibrate import BayesCalibration, LeastSquaresCalibration
from .joint import (
    COEFFICIENT_NAMES,
    COEFFICIENT_SYMBOLS,
    cautions,
    flatness,
    kept_labels,
    spread_over,
)
from .style import BLACK, BLUE, GREY, ORANGE, SKY, VERMILION, finish, new_figure, styled

MAX_LABELS = 40
"""So many particles have a labelled row each; of more, an ordered sample is shown without labels."""

MAX_ROWS = 200


@dataclass(frozen=True)
class CoefficientTable:
    """C1, C3, C5 of N particles [-], and of the population.

    Attributes:
        centre: best value or median, shape (N, 3).
        wide: ends of the 95 % interval, shape (2, N, 3); NaN where there is none.
        narrow: ends of the 50 % interval, or None.
        median: of the population, shape (3,).
        spread: interval of 95 % of the particles, shape (2, 3).
    """

    centre: np.ndarray
    wide: np.ndarray
    narrow: np.ndarray | None
    median: np.ndarray
    spread: np.ndarray


def posterior_table(calibration: BayesCalibration) -> CoefficientTable:
    """Medians and intervals of the posterior; the spread includes what is not known of the population."""
    C = np.asarray(calibration.C)
    C = C.reshape(-1, *C.shape[2:])
    q = np.quantile(C, [0.025, 0.25, 0.5, 0.75, 0.975], axis=0)
    mu, tau = (np.asarray(v).reshape(-1, 3) for v in (calibration.population.mu, calibration.population.tau))
    new = mu[None] + tau[None] * np.random.default_rng(0).standard_normal((10, *mu.shape))
    spread = np.exp(np.quantile(new.reshape(-1, 3), [0.025, 0.975], axis=0))
    return CoefficientTable(q[2], q[[0, 4]], q[[1, 3]], np.exp(np.median(mu, axis=0)), spread)


def least_squares_table(calibration: LeastSquaresCalibration) -> CoefficientTable:
    """Estimates and 95 % intervals of the joint least squares."""
    entries = [entry for entry in calibration.to_json()["particles"] if entry["kept"]]

    def each(ends: int | None) -> np.ndarray:
        rows = []
        for entry in entries:
            found = [entry[name] for name in COEFFICIENT_NAMES]
            rows.append([e["value"] if ends is None else (e["interval_95"] or [np.nan, np.nan])[ends] for e in found])
        return np.asarray(rows, float)

    mu, tau = np.asarray(calibration.solution.value.shared)[2:], np.asarray(calibration.settings.tau)
    spread = np.exp(mu + 1.96 * np.array([[-1.0], [1.0]]) * tau)
    return CoefficientTable(each(None), np.stack([each(0), each(1)]), None, np.exp(mu), spread)


def _rows(ax: Axes, table: CoefficientTable, j: int, chosen: np.ndarray, y: np.ndarray) -> None:
    labelled = len(chosen) <= MAX_LABELS
    thick, size = (3.2, 4.0) if labelled else (1.2, 1.5)
    ax.axvspan(*table.spread[:, j], color=ORANGE, alpha=0.22, linewidth=0, zorder=0)
    ax.axvline(table.median[j], color=VERMILION, linewidth=1.1, zorder=1)
    ax.hlines(y, *table.wide[:, chosen, j], color=BLUE if table.narrow is None else SKY, linewidth=1.1, zorder=2)
    if table.narrow is not None:
        ax.hlines(y, *table.narrow[:, chosen, j], color=BLUE, linewidth=thick, zorder=3)
    ax.plot(table.centre[chosen, j], y, "o", color=BLACK, markersize=size, markeredgewidth=0, zorder=4)


def _typical(wide: np.ndarray, centre: np.ndarray) -> str:
    """How wide intervals usually are: they may be narrower than their dots."""
    half = (wide[1] - wide[0]) / (2 * centre)
    half = half[np.isfinite(half)]
    return f"typical 95 % interval: ± {100 * np.median(half):.2g} %" if len(half) else "no intervals"


def draw_forest(table: CoefficientTable, labels: list[str]) -> tuple[Figure, list[Line2D | Patch]]:
    """Three panels of intervals, and the handles of their legend."""
    count = len(labels)
    labelled = count <= MAX_LABELS
    figure = new_figure(8.2, max(2.4, 0.19 * count + 1.3) if labelled else 6.0)
    panels = figure.subplots(1, 3, sharey=True)
    for j, ax in enumerate(panels):
        if labelled:
            chosen = np.arange(count)
            y = chosen.astype(float)
        else:
            chosen = np.argsort(table.centre[:, j], kind="stable")[spread_over(count, MAX_ROWS)]
            y = np.linspace(0, 1, len(chosen))
        _rows(ax, table, j, chosen, y)
        ax.set_xlabel(f"{COEFFICIENT_SYMBOLS[j]} [-]")
        ax.locator_params(axis="x", nbins=5)
        ax.use_sticky_edges = False  # the band's ends are no limits of the axis
        ax.margins(x=0.04)
        ax.set_title(_typical(table.wide[:, :, j], table.centre[:, j]), fontsize=8)
    first = panels[0]
    if labelled:
        first.set_yticks(np.arange(count), labels)
        first.set_ylim(count - 0.4, -0.6)
    else:
        first.set_ylim(-0.02, 1.02)
        first.set_ylabel("share of particles with a smaller value [-]")
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=BLACK, marker="o", linestyle="", label="estimate" if table.narrow is None else "median")
    ]
    if table.narrow is not None:
        handles.append(Line2D([], [], color=BLUE, linewidth=3.2, label="50 %"))
    handles += [
        Line2D([], [], color=BLUE if table.narrow is None else SKY, label="95 %"),
        Line2D([], [], color=VERMILION, label="population median"),
        Patch(color=ORANGE, alpha=0.22, linewidth=0, label="95 % of the population"),
    ]
    return figure, handles


def _title(count: int, what: str) -> str:
    if count <= MAX_LABELS:
        return what
    shown = f"{MAX_ROWS} of {count}" if count > MAX_ROWS else f"{count}"
    return f"{what}, {shown} particles, each panel in its own order"


@styled
def plot_forest(calibration: BayesCalibration) -> Figure:
    """C1, C3, C5 [-] of every particle: median, 50 % and 95 % interval of the posterior.

    The line is the population's median, the band holds 95 % of its particles (uncertainty of the population included).
    Up to 40 particles have a row each, in the campaign's order. Of more, at most 200 are shown, in each panel from the
    smallest to the largest, so that the dots also draw the distribution function of the coefficient.
    """
    labels = kept_labels(calibration)
    figure, handles = draw_forest(posterior_table(calibration), labels)
    title = _title(len(labels), "Coefficients of the particles")
    return finish(
        figure, calibration.campaign.metadata, title=title, lines=cautions(figure, calibration), handles=handles
    )


@styled
def plot_estimates(calibration: LeastSquaresCalibration) -> Figure:
    """C1, C3, C5 [-] of every particle by joint least squares, with 95 % error bars.

    Line and band are the population's median and the interval of 95 % of its particles. Particles stand as in
    `plot_forest`. Without error bars where the data leave the coefficients open.
    """
    labels = kept_labels(calibration)
    figure, handles = draw_forest(least_squares_table(calibration), labels)
    title = _title(len(labels), "Coefficients of the particles")
    return finish(
        figure, calibration.campaign.metadata, title=title, lines=cautions(figure, calibration), handles=handles
    )


def shrinkage(calibration: BayesCalibration) -> tuple[np.ndarray, np.ndarray]:
    """log C1, C3, C5 of each particle alone, under the most probable a, and posterior means, both of shape (N, 3)."""
    from ..calibrate.fit import population_at

    fit = calibration.fit
    a = float(population_at(fit.mode, fit.numbers, calibration.model.scatter).a)
    alone = np.asarray(fit.individual.latent)[:, :3] - np.log(1 + a * flatness(calibration))[:, None]
    return alone, np.log(np.asarray(calibration.C)).mean(axis=(0, 1))


@styled
def plot_shrinkage(calibration: BayesCalibration) -> Figure:
    """What each particle gains from the others: log C1, C3, C5 [-] fitted alone, and in the posterior.

    An arrow leads from the best fit of the particle's own curve (circle; its shape factor under the most probable `a`)
    to its posterior mean (dot). The cross is the mean of the population, the ellipse holds 95 % of it. What a curve
    says badly moves far towards the cross, what it says well stays.
    """
    alone, together = shrinkage(calibration)
    mu = np.asarray(calibration.population.mu).reshape(-1, 3).mean(axis=0)
    tau = np.asarray(calibration.population.tau).reshape(-1, 3).mean(axis=0)
    many = len(alone) > 100
    figure = new_figure(9.6, 3.7)
    for ax, (i, j) in zip(figure.subplots(1, 3), ((0, 1), (2, 1), (0, 2)), strict=True):
        ax.add_patch(
            Ellipse((mu[i], mu[j]), 2 * 2.45 * tau[i], 2 * 2.45 * tau[j], color=ORANGE, alpha=0.22, linewidth=0)
        )
        move = together - alone
        ax.quiver(
            alone[:, i], alone[:, j], move[:, i], move[:, j], angles="xy", scale_units="xy", scale=1, color=GREY,
            width=0.0035, headwidth=5, headlength=6, headaxislength=5.5, alpha=0.4 if many else 0.8, zorder=2,
        )  # fmt: skip
        ax.plot(
            alone[:, i], alone[:, j], "o", color=SKY, markerfacecolor="white", markersize=2.5 if many else 4.5, zorder=3
        )
        ax.plot(together[:, i], together[:, j], "o", color=BLUE, markersize=2 if many else 3.5, zorder=4)
        ax.plot(mu[i], mu[j], "+", color=VERMILION, markersize=11, markeredgewidth=1.8, zorder=5)
        ax.set_xlabel(f"log {COEFFICIENT_SYMBOLS[i]} [-]")
        ax.set_ylabel(f"log {COEFFICIENT_SYMBOLS[j]} [-]")
        ax.locator_params(nbins=5)
        ax.margins(0.06)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=SKY, markerfacecolor="white", marker="o", linestyle="", label="particle alone"),
        Line2D([], [], color=BLUE, marker="o", linestyle="", markersize=3.5, label="posterior mean"),
        Line2D([], [], color=VERMILION, marker="+", linestyle="", markersize=9, label="population mean"),
        Patch(color=ORANGE, alpha=0.22, linewidth=0, label="95 % of the population"),
    ]
    return finish(
        figure,
        calibration.campaign.metadata,
        title="Each particle alone, and among the others",
        lines=cautions(figure, calibration),
        handles=handles,
    )
