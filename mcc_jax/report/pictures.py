"""Pictures that stand still: the most telling test, every particle at a glance, the posterior's marginals, as SVG."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.transforms import ScaledTranslation

from ..calibrate.curves import FittedCurve
from ..calibrate.results import PosteriorDraws
from ..plots.style import BLACK, BLUE, GREY, ORANGE, PALE, RC, SKY, VERMILION, Look, new_figure, particle_labels

GRID = 30
"""At most so many particles stand in the grid; of more, those with the largest misfit."""

FEWEST = 12
"""At least so many readings stand in the enlarged part of a test that has them."""
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


@dataclass(frozen=True)
class Telling:
    """The test that shows best what was found.

    Attributes:
        time_s, force_mN, displacement_um: measured.
        before_um, after_um: measured less predicted displacement by the law alone, and with what was added to it.
        noise_um: standard deviation of the noise.
        added: what the law with the addition is called.
        caption: what is shown, in words.
        simulated: whether the test was computed, not measured.
    """

    time_s: np.ndarray
    force_mN: np.ndarray
    displacement_um: np.ndarray
    before_um: np.ndarray
    after_um: np.ndarray | None
    noise_um: np.ndarray | None
    added: str
    caption: str
    simulated: bool = False

    @property
    def test(self) -> str:
        """What the test is called."""
        return "simulated test" if self.simulated else "measured"

    @property
    def laws(self) -> list[tuple[np.ndarray, Look]]:
        """Measured less predicted, and how it is drawn and called, of every law: broad and pale below narrow and dark.

        Dashes would not do: where a test goes back on its own path they fill each other's gaps.
        """
        if self.after_um is None:
            return [(self.before_um, {"color": VERMILION, "linewidth": 1.4, "label": "law"})]
        alone: Look = {"color": VERMILION, "alpha": 0.6, "linewidth": 2.8, "label": "law alone"}
        return [(self.before_um, alone), (self.after_um, {"color": BLUE, "linewidth": 1.4, "label": self.added})]

    @property
    def near(self) -> np.ndarray:
        """Which readings stand in the enlarged part: a strip of displacement, where law and test differ most in all."""
        gap = np.abs(self.before_um - (0.0 if self.after_um is None else self.after_um))
        width = max(10 * float(np.quantile(gap, 0.9)), 0.03 * float(np.ptp(self.displacement_um)))
        left = self.displacement_um[:, None]
        while True:
            inside = (self.displacement_um >= left) & (self.displacement_um <= left + width)
            found = inside[int(np.argmax(inside @ gap**2))]
            if found.sum() >= FEWEST or not width < np.ptp(self.displacement_um):
                return found
            width *= 1.5


@rc_context(RC)
def telling_pictures(told: Telling) -> list[tuple[str, str]]:
    """Force over displacement, a part of it enlarged; and what each law leaves over time. With each, what it shows."""
    found = []
    for draw, title, words in (
        (
            draw_enlarged,
            "where law and test differ, enlarged",
            "Force over displacement, enlarged where they differ most",
        ),
        (draw_left_over, "test minus law, over time", "Measured less predicted displacement over time"),
    ):
        # No wider than a phone: its type is read there at the size in which it is set.
        figure = new_figure(4.6, 3.6)
        ax = figure.subplots()
        handles = draw(ax, told)
        ax.set_title(title, fontsize=9.5, color=BLACK, pad=4)
        figure.legend(handles=handles, loc="outside upper center", ncols=3, columnspacing=1.2, handlelength=1.6)
        figure.set_layout_engine("constrained")
        found.append((_svg(figure), f"{words}: {told.caption}"))
    return found


def draw_enlarged(ax: Axes, told: Telling) -> list[Any]:
    """Force over displacement where law and test differ most, in a corner the whole test; what stands in a legend."""
    near = told.near
    _force_over_displacement(ax, told)
    across, up = told.displacement_um[near], told.force_mN[near]
    ax.set_xlim(across.min() - 0.05 * np.ptp(across), across.max() + 0.05 * np.ptp(across))
    ax.set_ylim(up.min() - 0.05 * np.ptp(up), up.max() + 0.05 * np.ptp(up))
    ax.set_xlabel("displacement [µm]")
    ax.set_ylabel("force [mN]")
    inset = ax.inset_axes(_emptiest(across, up))
    _force_over_displacement(inset, told, 0.3)
    inset.set(xticks=[], yticks=[])
    inset.spines[["top", "right"]].set_visible(True)
    inset.set_title("the whole test", fontsize=8.5, color=BLACK, pad=2, loc="center")
    corner = across.min(), up.min()
    inset.add_patch(Rectangle(corner, np.ptp(across), np.ptp(up), fill=False, edgecolor=BLACK, linewidth=1.1, zorder=9))
    _arrows(ax, told)
    dots = Line2D([], [], marker="o", linestyle="", markersize=4.5, color=PALE, markeredgecolor=GREY, label=told.test)
    return [dots, *(Line2D([], [], **look) for _, look in told.laws)]


def draw_left_over(ax: Axes, told: Telling) -> list[Any]:
    """What each law leaves over time, beside the noise; what stands in a legend."""
    handles: list[Any] = []
    if told.noise_um is not None:
        look: Look = {"color": ORANGE, "alpha": 0.45, "linewidth": 0, "label": "noise (± 1 sd)"}
        handles.append(ax.fill_between(told.time_s, -told.noise_um, told.noise_um, **look))
    ax.axhline(0.0, color=GREY, linewidth=0.7)
    for away, look in told.laws:
        handles += ax.plot(told.time_s, away, **look)
    ax.set_xlabel("time [s]")
    ax.set_ylabel("test − law [µm]")
    ax.margins(x=0.01)
    return handles


def _arrows(ax: Axes, told: Telling) -> None:
    """Which way the test goes: an arrow beside the loading and the release that cover most force in sight."""
    near, rising = told.near, np.append(np.diff(told.force_mN), 0.0) > 0
    for up, above in ((True, (-7, 7)), (False, (9, -5))):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], (near & (rising == up)).astype(int), [0]])))
        runs = [slice(a, b) for a, b in edges.reshape(-1, 2) if b - a > 2]
        if not runs:
            continue
        run = max(runs, key=lambda r: float(np.ptp(told.force_mN[r])))
        place = run.start + (run.stop - 1 - run.start) * np.array([0.4, 0.7])
        start, end = ((told.displacement_um[k], told.force_mN[k]) for k in place.astype(int))
        beside = ax.transData + ScaledTranslation(above[0] / 72, above[1] / 72, ax.figure.dpi_scale_trans)
        look = {"arrowstyle": "-|>", "color": GREY, "linewidth": 1.0}
        ax.annotate("", end, start, xycoords=beside, textcoords=beside, arrowprops=look)


def _emptiest(across: np.ndarray, up: np.ndarray) -> tuple[float, float, float, float]:
    """The corner of a panel in which the fewest points lie, for a small panel: left, bottom, width, height."""
    wide, high = 0.36, 0.34
    x, y = ((column - column.min()) / max(float(np.ptp(column)), 1e-300) for column in (across, up))
    corners = [(left, low) for low in (0.0, 1.0 - high) for left in (0.0, 1.0 - wide)]
    lying = [np.sum((x >= a) & (x <= a + wide) & (y >= b) & (y <= b + high)) for a, b in corners]
    left, low = corners[int(np.argmin(lying))]
    return 0.03 + 0.94 * left, 0.03 + 0.9 * low, 0.94 * wide, 0.9 * high


def _force_over_displacement(ax: Axes, told: Telling, scale: float = 1.0) -> None:
    dots: Look = {"markersize": 4.5 * scale, "color": PALE, "markeredgecolor": GREY, "markeredgewidth": 0.4}
    ax.plot(told.displacement_um, told.force_mN, "o", **dots)
    for away, look in told.laws:
        ax.plot(told.displacement_um - away, told.force_mN, **look | {"linewidth": scale * look["linewidth"]})


def data_uri(picture: bytes, kind: str = "png") -> str:
    """A picture as part of the page."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode('ascii')}"


def _svg(figure: Any) -> str:
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
