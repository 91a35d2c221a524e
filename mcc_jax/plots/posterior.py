"""The population's posterior, what the data added to the prior, and every particle's coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from arviz_stats.base.array import array_stats
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch
from matplotlib.ticker import MaxNLocator

from .._format import with_sd
from ..calibrate import LeastSquares, Posterior, compare_with_paper
from ..calibrate.population import COEFFICIENTS
from ..calibrate.predict import prior_draws
from . import style
from .curves import plot_bands, plot_fits, plot_new_particle, plot_whitened

LABELLED = 40  # so many particles have a labelled row each; of more an ordered sample is shown without labels
ROWS = 200  # size of that sample
MANY_ARROWS = 100  # of more particles, arrows and dots are small and faint
DOTS = 800  # draws in a cloud of dots
PRIOR_DRAWS = 2000
NEAR_DRAWS = 100  # from so many draws near a posterior on, the prior's density there is made from these alone
_SYMBOLS = ("$C_1$", "$C_3$", "$C_5$")
_PAPER: style.Look = {"color": style.VERMILION, "dashes": (3, 1.5)}

LABELS = {
    "a": "$a$ [-]",
    "effective_modulus_MPa": "$\\bar{E}$ [GPa]",
    **{f"{name}_C{k}": f"$\\{name}_{k}$ [-]" for k in (1, 3, 5) for name in ("mu", "tau")},
    "modulus_scatter": "$s_E$ [-]",
    "shape_scatter": "$s_a$ [-]",
    "noise_factor": "noise factor [-]",
}
"""Parameters of the population in the order in which they are drawn."""
MEANINGS = {
    "a": "$a$: shape parameter",
    "effective_modulus_MPa": "$\\bar{E}$: effective modulus",
    "mu_C1": "$\\mu_j$: mean of log $C_j$",
    "tau_C1": "$\\tau_j$: its standard deviation over the particles",
    "modulus_scatter": "$s_E$: standard deviation of log modulus",
    "shape_scatter": "$s_a$: standard deviation of $a$",
}


def posterior_figures(calibration: Posterior) -> dict[str, Figure]:
    """Every figure of the posterior, by the stem of its file's name: `pairs` for `plot_pairs`."""
    plots = (plot_pairs, plot_prior_posterior, plot_forest, plot_shrinkage, plot_bands, plot_new_particle)
    return style.by_stem(plots, calibration)


def least_squares_figures(calibration: LeastSquares) -> dict[str, Figure]:
    """Every figure of the joint least squares, by the stem of its file's name: `fits` for `plot_fits`."""
    return style.by_stem((plot_whitened, plot_fits, plot_estimates), calibration)


def _scaled(named: dict[str, Any]) -> dict[str, Any]:
    """Draws in the order and the units of the figures."""
    return {name: named[name] * (1e-3 if name.endswith("_MPa") else 1.0) for name in LABELS if name in named}


def density(draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the kernel density of draws is drawn, and its values over the largest; ends of the range do not blur it."""
    x, y, _ = array_stats.kde(np.ravel(draws))
    return x, y / y.max()


def _area(ax: Axes, x: np.ndarray, y: np.ndarray, fill: str, edge: str) -> None:
    ax.fill_between(x, y, color=fill, alpha=0.5, linewidth=0)
    ax.plot(x, y, color=edge, linewidth=1.0)


def _mean_and_sd(draws: np.ndarray) -> str:
    """Mean and standard deviation of draws."""
    return with_sd({"value": float(draws.mean()), "sd": float(draws.std())})


@style.styled
def plot_pairs(calibration: Posterior) -> Figure:
    """Every pair of the population's parameters, one dot per draw; on the diagonal each alone, with mean and sd.

    A slanting cloud is a combination that the data determine better than its parts.
    """
    draws = _scaled(calibration.named_population())
    draws.pop("noise_factor", None)
    names = list(draws)
    size = len(names)
    figure = style.new_figure(1.05 * size + 1.0, 1.0 * size + 1.0)
    grid = figure.subplots(size, size, squeeze=False, sharex="col")
    shown = style.every(draws["a"].size, DOTS)
    dots: style.Look = {"color": style.BLUE, "markersize": 2.5, "markeredgewidth": 0, "alpha": 0.45}
    for i, name in enumerate(names):
        values = draws[name].ravel()
        for other, ax in zip(names[:i], grid[i], strict=False):
            ax.plot(draws[other].ravel()[shown], values[shown], ".", **dots)
            ax.yaxis.set_major_locator(MaxNLocator(3))
            ax.tick_params(labelleft=ax is grid[i, 0])
        own = grid[i, i]
        _area(own, *density(values), style.SKY, style.BLUE)
        own.set(ylim=(0, 1.08), yticks=[])
        own.spines["left"].set_visible(False)
        own.set_title(_mean_and_sd(values), fontsize=7, loc="center")
        if i:
            grid[i, 0].set_ylabel(LABELS[name])
        grid[-1, i].set_xlabel(LABELS[name])
        for ax in grid[i:, i]:
            ax.xaxis.set_major_locator(MaxNLocator(3))
            ax.tick_params(axis="x", labelrotation=90)
        for ax in grid[i, i + 1 :]:
            ax.set_axis_off()
    figure.align_labels(list(grid.ravel()))
    corner = grid[0, -1]
    for rank, meaning in enumerate(MEANINGS[name] for name in names if name in MEANINGS):
        # Below each other in the empty corner, which shall not grow for them.
        place: style.Look = {"transform": corner.transAxes, "ha": "right", "va": "top", "fontsize": 8.5}
        corner.text(1, 1 - 0.25 * rank, meaning, **place).set_in_layout(False)
    chains, each = draws["a"].shape
    return style.finish_joint(figure, calibration, f"Population, {chains} × {each} draws")


@style.styled
def plot_prior_posterior(calibration: Posterior) -> Figure:
    """Prior and posterior density of every parameter of the population, with the paper's value.

    Two panels per parameter: over the range of the prior, where a narrow posterior is what the data added, and
    enlarged to the posterior, where a level prior is one that says nothing there. Each density is divided by its peak.
    The paper has no value for the noise, the scatter of modulus and `a`, and for other forms of unloading no modulus.
    """
    drawn = prior_draws(calibration, PRIOR_DRAWS, 0)
    for vector in ("mu", "tau"):
        drawn |= {f"{vector}_{name}": drawn[vector][..., j] for j, name in enumerate(COEFFICIENTS)}
    known = {row["quantity"]: row["paper"] for row in compare_with_paper(calibration) if row["paper"] is not None}
    posterior, prior, paper = map(_scaled, (calibration.named_population(), drawn, known))
    labels: style.Look = {"xlabels": ["", ""], "ylabel": "density / peak [-]"}
    figure, panels = style.grid(len(posterior), 2, (4.8, 1.5), widths=(1.0, 1.0), **labels)
    for (name, values), (whole, near) in zip(posterior.items(), panels, strict=True):
        _prior_posterior(whole, near, prior[name], values, paper.get(name), spread="_scatter" in name or "tau" in name)
        whole.set_xlabel(LABELS[name])
        near.set_xlabel(LABELS[name])
    handles = [
        Patch(color=style.PALE, alpha=0.7, linewidth=0, label="prior"),
        Patch(color=style.SKY, alpha=0.7, linewidth=0, label="posterior"),
        Line2D([], [], label="paper", **_PAPER),
    ]
    return style.finish_joint(figure, calibration, "What the data added: over the prior's range, and enlarged", handles)


def _prior_posterior(
    whole: Axes, near: Axes, prior: np.ndarray, posterior: np.ndarray, paper: float | None, *, spread: bool
) -> None:
    """One parameter; a `spread` is a standard deviation between particles, whose prior may pile up at 0."""
    close = density(posterior)
    low, high = close[0][[0, -1]]
    enlarged = density(prior_near(prior, high) if spread else prior)
    reach = high - low
    inside = paper is not None and low - reach <= paper <= high + reach
    if inside:
        low, high = min(low, paper - 0.1 * reach), max(high, paper + 0.1 * reach)
    # Beyond these ends a few draws of a prior with long tails would squeeze all others.
    ends = [*np.quantile(prior, [0.001, 0.999]), low, high, *([] if paper is None else [paper])]
    for ax, before, x in ((whole, density(prior), (min(ends), max(ends))), (near, enlarged, (low, high))):
        _area(ax, *before, style.PALE, style.GREY)
        _area(ax, *close, style.SKY, style.BLUE)
        margin = 0.02 * (x[1] - x[0])
        ax.set(xlim=(x[0] - margin, x[1] + margin), ylim=(0, 1.1), yticks=[0, 1])
        ax.xaxis.set_major_locator(MaxNLocator(3))
        if paper is not None and x[0] <= paper <= x[1]:
            ax.axvline(paper, linewidth=1.3, **_PAPER)
    near.set_yticks([])
    near.set_title(_mean_and_sd(posterior), fontsize=8, color=style.BLACK)
    if paper is not None and not inside:
        style.note(near, f"paper {paper:.4g}", place="upper left" if paper < low else "upper right")


def prior_near(prior: np.ndarray, end: float) -> np.ndarray:
    """Draws of a prior up to where the posterior ends: it may pile up at 0 far within one kernel of all draws."""
    near = prior[prior <= 2 * end]
    return near if len(near) >= NEAR_DRAWS else prior


def draw_forest(
    labels: Sequence[str],
    centre: np.ndarray,
    wide: np.ndarray,
    median: np.ndarray,
    population: np.ndarray,
    narrow: np.ndarray | None = None,
) -> tuple[Figure, list[Line2D | Patch]]:
    """Three panels of C1, C3, C5 [-] of N particles, and the handles of their legend.

    Of the particles estimates, shape (N, 3), and ends of their 95 % and 50 % intervals, shape (2, N, 3), NaN where
    unknown; of the population median, shape (3,), and ends of the interval of 95 % of its particles, shape (2, 3).
    """
    count, single = len(labels), narrow is None
    labelled = count <= LABELLED
    thick, size = (3.2, 4.0) if labelled else (1.2, 1.5)
    outer = style.BLUE if single else style.SKY
    figure = style.new_figure(8.2, max(2.4, 0.19 * count + 1.3) if labelled else 6.0)
    panels = figure.subplots(1, 3, sharey=True)
    for j, ax in enumerate(panels):
        chosen, y = np.arange(count), np.arange(float(count))
        if not labelled:
            chosen = np.argsort(centre[:, j], kind="stable")[style.spread_over(count, ROWS)]
            y = np.linspace(0, 1, len(chosen))
        ax.axvspan(*population[:, j], color=style.ORANGE, alpha=0.22, linewidth=0, zorder=0)
        ax.axvline(median[j], color=style.VERMILION, linewidth=1.1, zorder=1)
        ax.hlines(y, *wide[:, chosen, j], color=outer, linewidth=1.1, zorder=2)
        if narrow is not None:
            ax.hlines(y, *narrow[:, chosen, j], color=style.BLUE, linewidth=thick, zorder=3)
        ax.plot(centre[chosen, j], y, "o", color=style.BLACK, markersize=size, markeredgewidth=0, zorder=4)
        ax.set_xlabel(f"{_SYMBOLS[j]} [-]")
        ax.locator_params(axis="x", nbins=5)
        ax.use_sticky_edges = False  # the band's ends are no limits of the axis
        ax.margins(x=0.04)
        least = 5e-4 * median[j]  # half of the narrowest axis: where nothing scatters, ticks would show rounding errors
        ax.set_xlim(min(ax.get_xlim()[0], median[j] - least), max(ax.get_xlim()[1], median[j] + least))
        # How wide intervals usually are: they may be narrower than their dots.
        half = (wide[1] - wide[0])[:, j] / (2 * centre[:, j])
        half = half[np.isfinite(half)]
        typical = f"typical 95 % interval: ± {100 * np.median(half):.2g} %" if len(half) else "no intervals"
        ax.set_title(typical, fontsize=8)
    if labelled:
        panels[0].set_yticks(np.arange(count), labels)
        panels[0].set_ylim(count - 0.4, -0.6)
    else:
        panels[0].set(ylim=(-0.02, 1.02), ylabel="share of particles with a smaller value [-]")
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=style.BLACK, marker="o", linestyle="", label="estimate" if single else "median"),
        *([] if single else [Line2D([], [], color=style.BLUE, linewidth=3.2, label="50 %")]),
        Line2D([], [], color=outer, label="95 %"),
        Line2D([], [], color=style.VERMILION, label="population median"),
        Patch(color=style.ORANGE, alpha=0.22, linewidth=0, label="95 % of the population"),
    ]
    return figure, handles


def _forest(calibration: Posterior | LeastSquares, **numbers: np.ndarray) -> Figure:
    names = style.particle_labels(calibration.campaign.particles)
    figure, handles = draw_forest([names[i] for i in calibration.selection.kept], **numbers)
    title, count = "Coefficients of the particles", len(calibration.selection.kept)
    if count > LABELLED:
        shown = f"{ROWS} of {count}" if count > ROWS else f"{count}"
        title += f", {shown} particles, each panel in its own order"
    return style.finish_joint(figure, calibration, title, handles)


@style.styled
def plot_forest(calibration: Posterior) -> Figure:
    """C1, C3, C5 [-] of every particle: median, 50 % and 95 % interval of the posterior.

    The line is the population's median, the band holds 95 % of its particles (uncertainty of the population included).
    Up to 40 particles have a row each, in the campaign's order. Of more, at most 200 are shown, in each panel from the
    smallest to the largest, so that the dots also draw the distribution function of the coefficient.
    """
    q = np.quantile(np.asarray(calibration.C), [0.025, 0.25, 0.5, 0.75, 0.975], axis=(0, 1))
    mu, tau = (np.asarray(v).reshape(-1, 3) for v in (calibration.population.mu, calibration.population.tau))
    new = mu[None] + tau[None] * np.random.default_rng(0).standard_normal((10, *mu.shape))
    band = np.exp(np.quantile(new.reshape(-1, 3), [0.025, 0.975], axis=0))
    median = np.exp(np.median(mu, axis=0))
    return _forest(calibration, centre=q[2], wide=q[[0, 4]], narrow=q[[1, 3]], median=median, population=band)


@style.styled
def plot_estimates(calibration: LeastSquares) -> Figure:
    """C1, C3, C5 [-] of every particle by joint least squares, with 95 % error bars.

    Line and band are the population's median and the interval of 95 % of its particles. Particles are ordered as in
    `plot_forest`. Without error bars where the data leave the coefficients open.
    """
    found = [[entry[n] for n in COEFFICIENTS] for entry in calibration.to_json()["particles"] if entry["kept"]]
    centre = np.array([[one["value"] for one in row] for row in found], float)
    wide = np.array([[one["interval_95"] or [np.nan, np.nan] for one in row] for row in found], float)
    mu, tau = np.asarray(calibration.solution.value.shared)[2:5], np.asarray(calibration.settings.population.tau)
    band = np.exp(mu + 1.96 * np.array([[-1.0], [1.0]]) * tau)
    return _forest(calibration, centre=centre, wide=np.moveaxis(wide, -1, 0), median=np.exp(mu), population=band)


def shrinkage(calibration: Posterior) -> tuple[np.ndarray, np.ndarray]:
    """log C1, C3, C5 of each particle alone, under the most probable a, and posterior means, both of shape (N, 3)."""
    fit = calibration.fit
    a = float(fit.population.a)
    eta = 1 + a * np.asarray(calibration.selection.tests.flatness)
    alone = np.asarray(fit.individual.point.latent)[:, :3] - np.log(eta)[:, None]
    return alone, np.log(np.asarray(calibration.C)).mean(axis=(0, 1))


@style.styled
def plot_shrinkage(calibration: Posterior) -> Figure:
    """What each particle gains from the others: log C1, C3, C5 [-] fitted alone, and in the posterior.

    An arrow leads from the best fit of the particle's own curve (circle; its shape factor under the most probable `a`)
    to its posterior mean (dot). The cross is the mean of the population, the ellipse holds 95 % of it. What a curve
    says badly moves far towards the cross, what it says well stays.
    """
    alone, together = shrinkage(calibration)
    mu = np.asarray(calibration.population.mu).reshape(-1, 3).mean(axis=0)
    tau = np.asarray(calibration.population.tau).reshape(-1, 3).mean(axis=0)
    many, move = len(alone) > MANY_ARROWS, together - alone
    ring: style.Look = {"color": style.SKY, "markerfacecolor": "white", "marker": "o", "linestyle": ""}
    dot: style.Look = {"color": style.BLUE, "marker": "o", "linestyle": ""}
    cross: style.Look = {"color": style.VERMILION, "marker": "+", "linestyle": ""}
    shade: style.Look = {"color": style.ORANGE, "alpha": 0.22, "linewidth": 0}
    figure = style.new_figure(9.6, 3.7)
    for ax, (i, j) in zip(figure.subplots(1, 3), ((0, 1), (2, 1), (0, 2)), strict=True):
        # Of two normal numbers 95 % lie within 2.45 standard deviations.
        ax.add_patch(Ellipse((mu[i], mu[j]), 2 * 2.45 * tau[i], 2 * 2.45 * tau[j], **shade))
        ax.quiver(
            alone[:, i], alone[:, j], move[:, i], move[:, j], angles="xy", scale_units="xy", scale=1, color=style.GREY,
            width=0.0035, headwidth=5, headlength=6, headaxislength=5.5, alpha=0.4 if many else 0.8, zorder=2,
        )  # fmt: skip
        ax.plot(alone[:, i], alone[:, j], markersize=2.5 if many else 4.5, zorder=3, **ring)
        ax.plot(together[:, i], together[:, j], markersize=2 if many else 3.5, zorder=4, **dot)
        ax.plot(mu[i], mu[j], markersize=11, markeredgewidth=1.8, zorder=5, **cross)
        ax.set(xlabel=f"log {_SYMBOLS[i]} [-]", ylabel=f"log {_SYMBOLS[j]} [-]")
        ax.locator_params(nbins=5)
        ax.margins(0.06)
    handles: list[Line2D | Patch] = [
        Line2D([], [], label="particle alone", **ring),
        Line2D([], [], markersize=3.5, label="posterior mean", **dot),
        Line2D([], [], markersize=9, label="population mean", **cross),
        Patch(label="95 % of the population", **shade),
    ]
    return style.finish_joint(figure, calibration, "Each particle alone, and among the others", handles)
