"""The population's posterior: how its parameters hang together, and what the data added to the prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from ..calibrate import BayesCalibration, compare_with_paper
from .bands import plot_bands
from .forest import plot_forest, plot_shrinkage
from .joint import cautions, density, flat_draws, with_sd
from .new_particle import plot_new_particle
from .style import (
    BLACK,
    BLUE,
    GREY,
    PALE,
    SKY,
    VERMILION,
    finish,
    new_figure,
    note,
    of_its_kind,
    styled,
)

MAX_DOTS = 800
PRIOR_DRAWS = 2000


@dataclass(frozen=True)
class Parameter:
    """How a parameter of the population is shown.

    Attributes:
        label: symbol and unit.
        scale: what its numbers are multiplied with.
        positive: it may pile up at 0.
        log: it is positive and skewed.
    """

    label: str
    scale: float = 1.0
    positive: bool = False
    log: bool = False


PARAMETERS = {
    "a": Parameter("$a$ [-]"),
    "effective_modulus_MPa": Parameter("$\\bar{E}$ [GPa]", scale=1e-3, log=True),
    "mu_C1": Parameter("$\\mu_1$ [-]"),
    "tau_C1": Parameter("$\\tau_1$ [-]", positive=True),
    "mu_C3": Parameter("$\\mu_3$ [-]"),
    "tau_C3": Parameter("$\\tau_3$ [-]", positive=True),
    "mu_C5": Parameter("$\\mu_5$ [-]"),
    "tau_C5": Parameter("$\\tau_5$ [-]", positive=True),
    "modulus_scatter": Parameter("$s_E$ [-]", positive=True),
    "shape_scatter": Parameter("$s_a$ [-]", positive=True),
    "noise_factor": Parameter("noise factor [-]", log=True),
}
"""In the order in which they are drawn."""

SYMBOLS = {
    "a": "$a$: shape parameter",
    "effective_modulus_MPa": "$\\bar{E}$: effective modulus",
    "mu_C1": "$\\mu_j$: mean of log $C_j$",
    "tau_C1": "$\\tau_j$: its standard deviation over the particles",
    "modulus_scatter": "$s_E$: standard deviation of log modulus",
    "shape_scatter": "$s_a$: standard deviation of $a$",
}


def _population(calibration: BayesCalibration) -> dict[str, np.ndarray]:
    """Draws by name, in the order and the units of the figures."""
    named = calibration.named_population()
    return {name: named[name] * p.scale for name, p in PARAMETERS.items() if name in named}


@styled
def plot_pairs(calibration: BayesCalibration) -> Figure:
    """Every pair of the population's parameters, one dot per draw; on the diagonal each alone, with mean and sd.

    Shape parameter `a` [-], effective modulus [GPa], and mean and standard deviation of log C1, C3, C5 [-], with the
    scatter of modulus and `a` where they may scatter. A slanting cloud is a combination that the data know better than
    its parts.
    """
    draws = {name: values for name, values in _population(calibration).items() if name != "noise_factor"}
    names = list(draws)
    size = len(names)
    figure = new_figure(1.05 * size + 1.0, 1.0 * size + 1.0)
    grid = figure.subplots(size, size, squeeze=False, sharex="col")
    total = draws["a"].size
    shown = np.arange(0, total, max(1, -(-total // MAX_DOTS)))
    for i, name in enumerate(names):
        values = draws[name].ravel()
        for j, ax in enumerate(grid[i]):
            if j > i:
                ax.set_axis_off()
                continue
            if j == i:
                _marginal(ax, values, PARAMETERS[name])
            else:
                ax.plot(
                    draws[names[j]].ravel()[shown], values[shown], ".", color=BLUE, markersize=2.5, markeredgewidth=0,
                    alpha=0.45,
                )  # fmt: skip
                ax.yaxis.set_major_locator(MaxNLocator(3))
            ax.xaxis.set_major_locator(MaxNLocator(3))
            ax.tick_params(axis="x", labelrotation=90)
            if i == size - 1:
                ax.set_xlabel(PARAMETERS[names[j]].label)
            if j == 0 and i > 0:
                ax.set_ylabel(PARAMETERS[name].label)
            elif j < i:
                ax.tick_params(labelleft=False)
    figure.align_labels(list(grid.ravel()))
    chains, each = draws["a"].shape
    for rank, name in enumerate(name for name in SYMBOLS if name in draws):
        # Below each other in the empty corner, which shall not grow for them.
        words = grid[0, -1].text(
            1, 1 - 0.25 * rank, SYMBOLS[name], transform=grid[0, -1].transAxes, ha="right", va="top", fontsize=8.5
        )
        words.set_in_layout(False)
    return finish(
        figure,
        calibration.campaign.metadata,
        title=f"Population, {chains} × {each} draws",
        lines=cautions(figure, calibration),
    )


def _marginal(ax: Axes, values: np.ndarray, parameter: Parameter) -> None:
    x = _span(values, parameter)
    y = density(values, x, positive=parameter.positive, log=parameter.log)
    ax.fill_between(x, y, color=SKY, alpha=0.5, linewidth=0)
    ax.plot(x, y, color=BLUE, linewidth=1.0)
    ax.set_ylim(0, 1.08)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_title(with_sd(float(values.mean()), float(values.std())), fontsize=7, loc="center")


def _span(values: np.ndarray, parameter: Parameter, points: int = 200) -> np.ndarray:
    """Where the density of draws is drawn."""
    low, high = np.quantile(values, [0.001, 0.999])
    margin = 0.15 * (high - low)
    return np.linspace(0.0 if parameter.positive else low - margin, high + margin, points)


def prior_of(calibration: BayesCalibration) -> dict[str, np.ndarray]:
    """Draws of the population's prior, by the names and in the units of the figures."""
    from ..calibrate.arviz import prior_draws

    low, high = np.asarray(calibration.fit.numbers.a)[2:]
    found = prior_draws(calibration.model.chosen_priors, float(low), float(high), (1, PRIOR_DRAWS), 0)
    for vector in ("mu", "tau"):
        found |= {f"{vector}_{name}": found[vector][..., j] for j, name in enumerate(("C1", "C3", "C5"))}
    return {name: found[name] * p.scale for name, p in PARAMETERS.items() if name in found}


@styled
def plot_prior_posterior(calibration: BayesCalibration) -> Figure:
    """Prior and posterior density of every parameter of the population, with the paper's value.

    Two panels per parameter: over the range of the prior, where a narrow posterior is what the data added, and
    enlarged to the posterior, where a level prior is one that says nothing there. Each density is divided by its peak.
    The paper has no value for the noise, the scatter of modulus and `a`, and for other forms of unloading no modulus.
    """
    posterior, prior = _population(calibration), prior_of(calibration)
    paper = {row["quantity"]: row["paper"] for row in compare_with_paper(calibration)}
    rows = -(-len(posterior) // 2)
    figure = new_figure(9.6, 1.5 * rows + 1.0)
    grid = figure.subplots(rows, 4, squeeze=False)
    for ax in grid.ravel()[2 * len(posterior) :]:
        ax.set_axis_off()
    for rank, (name, values) in enumerate(posterior.items()):
        parameter = PARAMETERS[name]
        whole, near = grid[rank // 2, 2 * (rank % 2) : 2 * (rank % 2) + 2]
        said = paper.get(name)
        mark = None if said is None else said * parameter.scale
        _prior_posterior(whole, near, prior[name], values, mark, parameter)
        if rank % 2 == 0:
            whole.set_ylabel("density / peak [-]")
    handles = [
        Patch(color=PALE, alpha=0.7, linewidth=0, label="prior"),
        Patch(color=SKY, alpha=0.7, linewidth=0, label="posterior"),
        Line2D([], [], color=VERMILION, dashes=(3, 1.5), label="paper"),
    ]
    return finish(
        figure,
        calibration.campaign.metadata,
        title="What the data added: over the prior's range, and enlarged",
        lines=cautions(figure, calibration),
        handles=handles,
    )


def _prior_posterior(
    whole: Axes, near: Axes, prior: np.ndarray, posterior: np.ndarray, paper: float | None, parameter: Parameter
) -> None:
    close = _span(posterior, parameter)
    far = _span(flat_draws(prior), parameter)
    ends = [far[0], far[-1], close[0], close[-1], *([] if paper is None else [paper])]
    # The posterior's own points as well: on the prior's range it may be narrower than one step.
    far = np.unique(np.concatenate([np.linspace(min(ends), max(ends), 300), close]))
    reach = close[-1] - close[0]
    inside = paper is not None and close[0] - reach <= paper <= close[-1] + reach
    if inside and not close[0] <= paper <= close[-1]:
        close = np.linspace(min(close[0], paper - 0.1 * reach), max(close[-1], paper + 0.1 * reach), 300)
    options = {"positive": parameter.positive, "log": parameter.log}
    everywhere = density(prior, far, **options)
    for ax, x, before in (
        (whole, far, everywhere),
        (near, close, enlarged_prior(prior, far, everywhere, close, parameter)),
    ):
        ax.fill_between(x, before, color=PALE, alpha=0.5, linewidth=0)
        ax.plot(x, before, color=GREY, linewidth=1.0)
        after = density(posterior, x, **options)
        ax.fill_between(x, after, color=SKY, alpha=0.5, linewidth=0)
        ax.plot(x, after, color=BLUE, linewidth=1.1)
        margin = 0.02 * (x[-1] - x[0])
        ax.set_xlim(x[0] - margin, x[-1] + margin)
        ax.set_ylim(0, 1.1)
        ax.set_yticks([0, 1])
        ax.xaxis.set_major_locator(MaxNLocator(3))
        ax.set_xlabel(parameter.label)
        if paper is not None and x[0] <= paper <= x[-1]:
            ax.axvline(paper, color=VERMILION, dashes=(3, 1.5), linewidth=1.3)
    near.set_yticks([])
    near.set_title(with_sd(float(posterior.mean()), float(posterior.std())), fontsize=8, color=BLACK)
    if paper is not None and not inside:
        note(near, f"paper {paper:.4g}", place="upper left" if paper < close[0] else "upper right")


ENOUGH_DRAWS = 100


def enlarged_prior(
    prior: np.ndarray, far: np.ndarray, everywhere: np.ndarray, close: np.ndarray, parameter: Parameter
) -> np.ndarray:
    """The prior's density where the posterior is.

    That of a spread may pile up at 0 far within one kernel of all draws: then from those near by alone, over the
    largest value there.
    """
    row = flat_draws(prior)
    beside = row[row <= 2 * close[-1]]
    if parameter.positive and len(beside) >= ENOUGH_DRAWS:
        return density(beside, close, positive=True)
    return np.interp(close, far, everywhere)


@of_its_kind
def posterior_figures(calibration: BayesCalibration) -> dict[str, Figure]:
    """Every figure of the posterior, by the stem of its file's name.

    Returns:
        `pairs`, `prior_posterior`, `forest`, `shrinkage`, `bands`, `new_particle`.
    """
    return {
        "pairs": plot_pairs(calibration),
        "prior_posterior": plot_prior_posterior(calibration),
        "forest": plot_forest(calibration),
        "shrinkage": plot_shrinkage(calibration),
        "bands": plot_bands(calibration),
        "new_particle": plot_new_particle(calibration),
    }
