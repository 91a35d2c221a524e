"""Static pictures as SVG: the test that shows best what was found."""

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

from ..plots.style import BLACK, BLUE, GREY, ORANGE, PALE, RC, VERMILION, Look, new_figure

FEWEST = 12
"""Least number of readings in the enlarged part of a test that has them."""


@dataclass(frozen=True)
class Example:
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
        """Which readings are in the enlarged part: a strip of displacement, where law and test differ most in all."""
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
def example_pictures(example: Example) -> list[tuple[str, str]]:
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
        handles = draw(ax, example)
        ax.set_title(title, fontsize=9.5, color=BLACK, pad=4)
        figure.legend(handles=handles, loc="outside upper center", ncols=3, columnspacing=1.2, handlelength=1.6)
        figure.set_layout_engine("constrained")
        found.append((_svg(figure), f"{words}: {example.caption}"))
    return found


def draw_enlarged(ax: Axes, example: Example) -> list[Any]:
    """Force over displacement where law and test differ most, in a corner the whole test; entries of a legend."""
    near = example.near
    _force_over_displacement(ax, example)
    across, up = example.displacement_um[near], example.force_mN[near]
    ax.set_xlim(across.min() - 0.05 * np.ptp(across), across.max() + 0.05 * np.ptp(across))
    ax.set_ylim(up.min() - 0.05 * np.ptp(up), up.max() + 0.05 * np.ptp(up))
    ax.set_xlabel("displacement [µm]")
    ax.set_ylabel("force [mN]")
    inset = ax.inset_axes(_emptiest(across, up))
    _force_over_displacement(inset, example, 0.3)
    inset.set(xticks=[], yticks=[])
    inset.spines[["top", "right"]].set_visible(True)
    inset.set_title("the whole test", fontsize=8.5, color=BLACK, pad=2, loc="center")
    corner = across.min(), up.min()
    inset.add_patch(Rectangle(corner, np.ptp(across), np.ptp(up), fill=False, edgecolor=BLACK, linewidth=1.1, zorder=9))
    _arrows(ax, example)
    dots = Line2D(
        [], [], marker="o", linestyle="", markersize=4.5, color=PALE, markeredgecolor=GREY, label=example.test
    )
    return [dots, *(Line2D([], [], **look) for _, look in example.laws)]


def draw_left_over(ax: Axes, example: Example) -> list[Any]:
    """What each law leaves over time, next to the noise; entries of a legend."""
    handles: list[Any] = []
    if example.noise_um is not None:
        look: Look = {"color": ORANGE, "alpha": 0.45, "linewidth": 0, "label": "noise (± 1 sd)"}
        handles.append(ax.fill_between(example.time_s, -example.noise_um, example.noise_um, **look))
    ax.axhline(0.0, color=GREY, linewidth=0.7)
    for away, look in example.laws:
        handles += ax.plot(example.time_s, away, **look)
    ax.set_xlabel("time [s]")
    ax.set_ylabel("test − law [µm]")
    ax.margins(x=0.01)
    return handles


def _arrows(ax: Axes, example: Example) -> None:
    """Which way the test goes: an arrow next to the loading and the release that cover most force in sight."""
    near, rising = example.near, np.append(np.diff(example.force_mN), 0.0) > 0
    for up, above in ((True, (-7, 7)), (False, (9, -5))):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], (near & (rising == up)).astype(int), [0]])))
        runs = [slice(a, b) for a, b in edges.reshape(-1, 2) if b - a > 2]
        if not runs:
            continue
        run = max(runs, key=lambda r: float(np.ptp(example.force_mN[r])))
        place = run.start + (run.stop - 1 - run.start) * np.array([0.4, 0.7])
        start, end = ((example.displacement_um[k], example.force_mN[k]) for k in place.astype(int))
        offset = ax.transData + ScaledTranslation(above[0] / 72, above[1] / 72, ax.figure.dpi_scale_trans)
        look = {"arrowstyle": "-|>", "color": GREY, "linewidth": 1.0}
        ax.annotate("", end, start, xycoords=offset, textcoords=offset, arrowprops=look)


def _emptiest(across: np.ndarray, up: np.ndarray) -> tuple[float, float, float, float]:
    """The corner of a panel in which the fewest points lie, for a small panel: left, bottom, width, height."""
    wide, high = 0.36, 0.34
    x, y = ((column - column.min()) / max(float(np.ptp(column)), 1e-300) for column in (across, up))
    corners = [(left, low) for low in (0.0, 1.0 - high) for left in (0.0, 1.0 - wide)]
    lying = [np.sum((x >= a) & (x <= a + wide) & (y >= b) & (y <= b + high)) for a, b in corners]
    left, low = corners[int(np.argmin(lying))]
    return 0.03 + 0.94 * left, 0.03 + 0.9 * low, 0.94 * wide, 0.9 * high


def _force_over_displacement(ax: Axes, example: Example, scale: float = 1.0) -> None:
    dots: Look = {"markersize": 4.5 * scale, "color": PALE, "markeredgecolor": GREY, "markeredgewidth": 0.4}
    ax.plot(example.displacement_um, example.force_mN, "o", **dots)
    for away, look in example.laws:
        ax.plot(example.displacement_um - away, example.force_mN, **look | {"linewidth": scale * look["linewidth"]})


def data_uri(picture: bytes, kind: str = "png") -> str:
    """A picture as part of the page."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode('ascii')}"


def _svg(figure: Any) -> str:
    stream = io.BytesIO()
    # The same ids and no date: one input, one page. Text stays text, and small.
    with rc_context({"svg.hashsalt": "mcc_jax", "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return data_uri(stream.getvalue(), "svg+xml")
