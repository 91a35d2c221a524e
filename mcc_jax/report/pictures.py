"""Pictures that stand still: every particle at a glance, and the posterior's marginals, as SVG."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np
from matplotlib import rc_context

from ..calibrate.curves import FittedCurve
from ..calibrate.results import PosteriorDraws
from ..plots.style import BLACK, BLUE, GREY, ORANGE, PALE, RC, SKY, VERMILION, new_figure, particle_labels

GRID = 30
"""At most so many particles stand in the grid; of more, those with the largest misfit."""

GRID_COLUMNS = 5
BINS = 40
PANELS = {
    "a": ("shape parameter a [-]", 1.0),
    "effective_modulus_MPa": ("effective modulus [GPa]", 1e-3),
    "C1_median": ("C₁, median particle [-]", 1.0),
    "C1_spread": ("sd of log C₁ [-]", 1.0),
    "C3_median": ("C₃, median particle [-]", 1.0),
    "C3_spread": ("sd of log C₃ [-]", 1.0),
    "C5_median": ("C₅, median particle [-]", 1.0),
    "C5_spread": ("sd of log C₅ [-]", 1.0),
}


def data_uri(picture: bytes, kind: str = "png") -> str:
    """A picture as part of the page."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode('ascii')}"


def _svg(figure: Any) -> str:
    from matplotlib import rc_context

    stream = io.BytesIO()
    # The same ids and no date: one input, one page. Text stays text, and small.
    with rc_context({"svg.hashsalt": "mcc_jax", "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return data_uri(stream.getvalue(), "svg+xml")


@rc_context(RC)
def marginals(posterior: PosteriorDraws) -> list[tuple[str, str, str]]:
    """For each number of the population: a picture of its posterior, its name, and what the picture shows in words."""
    named = {name: values.ravel() for name, values in posterior.named_population().items()}
    medians = {f"{name[3:]}_median": np.exp(values) for name, values in named.items() if name.startswith("mu_")}
    spreads = {f"{name[4:]}_spread": values for name, values in named.items() if name.startswith("tau_")}
    draws = named | medians | spreads
    found = []
    for name, (label, factor) in PANELS.items():
        values = draws[name] * factor
        low, middle, high = np.quantile(values, [0.025, 0.5, 0.975])
        figure = new_figure(3.2, 2.1)
        ax = figure.subplots()
        # Outside this range stand a few draws that would squeeze all others.
        ends = np.quantile(values, [0.001, 0.999])
        heights, edges = np.histogram(values, BINS, (ends[0], ends[1]) if ends[1] > ends[0] else None)
        ax.stairs(heights, edges, fill=True, color=SKY, alpha=0.75, linewidth=0)
        foot = -0.06 * heights.max()
        ax.hlines(foot, low, high, color=BLUE, linewidth=2.5)
        ax.plot(middle, foot, "o", color=BLACK, markersize=4.5)
        ax.set_ylim(2 * foot, None)
        ax.set_xlim(edges[0], edges[-1])
        ax.set_xlabel(label)
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
        ax.locator_params(axis="x", nbins=4)
        words = f"Posterior of {label}: median {middle:.4g}, 95 % between {low:.4g} and {high:.4g}"
        found.append((_svg(figure), label, words))
    return found


@rc_context(RC)
def grid(shown: list[FittedCurve]) -> tuple[str, int] | None:
    """Force over displacement of every particle, measured and predicted; and how many stand in it."""
    if not shown:
        return None
    misfit = np.array([one.rms_um or 0.0 for one in shown])
    chosen = np.sort(np.argsort(-misfit, kind="stable")[:GRID])
    labels = particle_labels([one.name for one in shown], 18)
    columns = min(GRID_COLUMNS, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = new_figure(2.0 * columns + 0.3, 1.5 * rows + 0.4)
    panels = figure.subplots(rows, columns, squeeze=False)
    for ax in panels.flat[len(chosen) :]:
        ax.set_axis_off()
    for ax, i in zip(panels.flat, chosen, strict=False):
        one = shown[i]
        colour = np.where(one.kind == 0, BLUE, VERMILION)
        colour = np.where(one.used, colour, PALE)
        every = max(1, len(colour) // 60)
        ax.scatter(
            one.displacement_um[::every], one.force_mN[::every], s=3, c=list(colour[::every]), linewidths=0, zorder=2
        )
        ax.plot(one.own_um, one.force_mN, color=BLACK, linewidth=0.7, zorder=3)
        ax.set_title(labels[i], fontsize=7.5, color=GREY if one.why_not else BLACK)
        ax.tick_params(labelsize=6.5, length=2, pad=1.5)
        ax.locator_params(nbins=3)
        ax.margins(0.04)
    figure.supxlabel("displacement [µm]", fontsize=8)
    figure.supylabel("force [mN]", fontsize=8)
    figure.set_layout_engine("constrained")
    return _svg(figure), len(chosen)


@rc_context(RC)
def shifts(before: dict[str, Any], after: dict[str, Any]) -> list[tuple[str, str]]:
    """Each parameter before and after what was added, with 95 % intervals; and the same in words."""
    names = [
        ("a", "shape parameter a [-]", 1.0),
        ("effective_modulus_MPa", "effective modulus [GPa]", 1e-3),
        *((f"log_C{k}", f"mean log C{'₀₁₂₃₄₅'[k]} [-]", 1.0) for k in (1, 3, 5)),
    ]
    found = []
    for name, label, factor in names:
        pair = [_estimate(parameters, name) for parameters in (before, after)]
        if any(e is None or e["value"] is None for e in pair):
            continue
        figure = new_figure(3.2, 1.25)
        ax = figure.subplots()
        told = []
        for y, (estimate, colour, marker, word) in enumerate(
            zip(pair, (VERMILION, BLUE), ("o", "s"), ("before", "after"), strict=True)
        ):
            assert estimate is not None
            value = estimate["value"] * factor
            ax.plot(value, y, marker, color=colour, markersize=5)
            if estimate["interval_95"] is not None:
                ax.hlines(y, *(end * factor for end in estimate["interval_95"]), color=colour, linewidth=2)
            told.append(f"{word} {value:.4g}")
        ax.set_yticks([0, 1], ["before", "after"])
        ax.set_ylim(1.5, -0.5)
        ax.set_xlabel(label)
        ax.locator_params(axis="x", nbins=4)
        ax.margins(x=0.1)
        ax.grid(axis="x", color=ORANGE, alpha=0.25, linewidth=0.6)
        found.append((_svg(figure), f"{label}: {', '.join(told)}"))
    return found


def _estimate(parameters: dict[str, Any], name: str) -> dict[str, Any] | None:
    entry = parameters.get(name)
    return entry.get("mean") if entry is not None and "mean" in entry else entry
