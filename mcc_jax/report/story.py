"""The first screen: what was found in one sentence, the test that shows it best as two pictures, and what matters."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.style import context
from matplotlib.transforms import ScaledTranslation

from .._format import listed, number, percent, plain, probability, with_sd
from ..calibrate.curves import FittedCurve
from ..discovery import Discovery
from ..plots.style import BLACK, BLUE, GREY, ORANGE, PALE, RC, VERMILION, Look, new_figure
from .read import Results
from .texts import quantity

FEWEST = 12  # least number of readings in the enlarged part of a test that has them


@dataclass(frozen=True)
class Example:
    """The test that shows best what was found: measured, measured less predicted by each law, noise, and in words."""

    time_s: np.ndarray
    force_mN: np.ndarray
    displacement_um: np.ndarray
    before_um: np.ndarray
    caption: str
    after_um: np.ndarray | None = None  # by the law with what was added to it, which is called `added`
    noise_um: np.ndarray | None = None
    added: str = ""
    simulated: bool = False

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


def example_of(results: Results, shown: Sequence[FittedCurve]) -> Example | None:
    """The test to show: of a discovery the one whose gap closes most, else the one that the law fits worst."""
    example = None if results.found is None else most_informative_test(results.found)
    known = [one for one in shown if one.rms_um is not None]
    if example is not None or not known:
        return example
    one = max(known, key=lambda one: one.rms_um or 0.0)
    worst = f"of all particles the one that the law misses most, by {number(one.rms_um, 2)} µm on average"
    caption = f"Particle {one.name} with its own curve of loading: {worst}."
    used, away = one.used, one.displacement_um - one.own_um
    return Example(one.time_s[used], one.force_mN[used], one.displacement_um[used], away[used], caption)


def most_informative_test(found: Discovery) -> Example | None:
    """The test whose gap closes most, or where nothing was added the one that the law fits worst."""
    left, base = found.residuals, found.base
    if left is None or base is None:
        return None
    added = bool(found.effects) or found.closure is not None
    before, after, source = left.before, left.after, ""
    name = listed([plain(effect.mechanism) for effect in found.effects]) if found.effects else "the formula found"
    if added and found.held_out is not None and found.held_out.residual_um is not None:
        before, after = found.held_out.residual_um[0], found.held_out.residual_um[-1]
        source = (
            f" Here {name} is as estimated from the other particles; only what belongs to each particle (curve of "
            "loading, modulus, zero) is fitted to its test."
        )
    count = np.maximum(left.used.sum(1), 1)
    rms = [np.sqrt(np.sum(np.where(left.used, one, 0.0) ** 2, axis=1) / count) for one in (before, after)]
    j = int(np.argmax(rms[0] - rms[1] if added else rms[0]))
    campaign, i, rows = base.campaign, base.selection.kept[j], base.selection.rows[j]
    curve, used = campaign.curves[i], left.used[j, : len(rows)]
    rows = np.asarray(rows)[used]
    off, which = f"{number(float(rms[0][j]), 2)} µm", "fits worst"
    if added:
        middle = [f"{number(float(np.median(one)), 2)} µm" for one in rms]
        off += f" before and {number(float(rms[1][j]), 2)} µm after {name} was added"
        off += f" (median of all: {middle[0]} and {middle[1]})"
        which = "gains most"
    shown = f"particle {campaign.particles[i]}, which of {len(before)} particles {which}"
    caption = f"Shown: {shown}. On average the law is off by {off}.{source}"
    one, two, noise = (column[j, : len(used)][used] for column in (before, after, left.noise))
    return Example(
        curve.time_s[rows],
        curve.force_mN[rows],
        curve.displacement_um[rows],
        one,
        caption,
        two if added else None,
        noise,
        f"law with {name}" if added else "",
        campaign.metadata.simulated,
    )


@context(["default", RC, {"svg.hashsalt": "mcc_jax", "svg.fonttype": "none"}])  # equal pages; text stays text
def example_pictures(example: Example) -> list[tuple[str, str]]:
    """Force over displacement, a part of it enlarged; and what each law leaves over time. With each, what it shows."""
    found = []
    for draw, title, words in (
        (_enlarged, "where law and test differ, enlarged", "Force over displacement, enlarged where they differ most"),
        (_left_over, "test minus law, over time", "Measured less predicted displacement over time"),
    ):
        figure = new_figure(4.6, 3.6)  # no wider than a phone, where its type is read at the size in which it is set
        ax = figure.subplots()
        draw(ax, example)
        ax.set_title(title, fontsize=9.5, color=BLACK, pad=4)
        figure.legend(loc="outside upper center", ncols=3, columnspacing=1.2, handlelength=1.6)
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
        found.append((data_uri(stream.getvalue(), "svg+xml"), f"{words}: {example.caption}"))
    return found


def _enlarged(ax: Axes, example: Example) -> None:
    """Force over displacement where law and test differ most, in a corner the whole test."""
    across, up = example.displacement_um[example.near], example.force_mN[example.near]
    width, height = float(np.ptp(across)), float(np.ptp(up))
    dots: Look = {"color": PALE, "markeredgecolor": GREY, "markeredgewidth": 0.4}
    dots["label"] = "simulated test" if example.simulated else "measured"
    inset = ax.inset_axes(_emptiest(across, up))
    for panel, scale in ((ax, 1.0), (inset, 0.3)):
        panel.plot(example.displacement_um, example.force_mN, "o", markersize=4.5 * scale, **dots)
        for away, look in example.laws:
            line = look | {"linewidth": scale * look["linewidth"]}
            panel.plot(example.displacement_um - away, example.force_mN, **line)
    ax.set(xlabel="displacement [µm]", ylabel="force [mN]")
    ax.set_xlim(across.min() - 0.05 * width, across.max() + 0.05 * width)
    ax.set_ylim(up.min() - 0.05 * height, up.max() + 0.05 * height)
    inset.set(xticks=[], yticks=[])
    inset.spines[["top", "right"]].set_visible(True)
    inset.set_title("the whole test", fontsize=8.5, color=BLACK, pad=2, loc="center")
    frame: Look = {"fill": False, "edgecolor": BLACK, "linewidth": 1.1, "zorder": 9}
    inset.add_patch(Rectangle((across.min(), up.min()), width, height, **frame))
    _arrows(ax, example)


def _left_over(ax: Axes, example: Example) -> None:
    """What each law leaves over time, next to the noise."""
    if example.noise_um is not None:
        look: Look = {"color": ORANGE, "alpha": 0.45, "linewidth": 0, "label": "noise (± 1 sd)"}
        ax.fill_between(example.time_s, -example.noise_um, example.noise_um, **look)
    ax.axhline(0.0, color=GREY, linewidth=0.7)
    for away, look in example.laws:
        ax.plot(example.time_s, away, **look)
    ax.set(xlabel="time [s]", ylabel="test − law [µm]")
    ax.margins(x=0.01)


def _arrows(ax: Axes, example: Example) -> None:
    """Which way the test goes: an arrow next to the loading and the release that cover most force in sight."""
    near, rising = np.flatnonzero(example.near), np.append(np.diff(example.force_mN), 0.0)[example.near] > 0
    turns = np.flatnonzero((np.diff(near) > 1) | np.diff(rising)) + 1
    runs = [run for run in np.split(near, turns) if len(run) > 2]
    for up, shift in ((True, (-7, 7)), (False, (9, -5))):
        own = [run for run in runs if (example.force_mN[run[1]] > example.force_mN[run[0]]) == up]
        if not own:
            continue
        run = max(own, key=lambda r: float(np.ptp(example.force_mN[r])))
        start, end = run[int(0.4 * (len(run) - 1))], run[int(0.7 * (len(run) - 1))]
        offset = ax.transData + ScaledTranslation(shift[0] / 72, shift[1] / 72, ax.figure.dpi_scale_trans)
        ends = [(example.displacement_um[k], example.force_mN[k]) for k in (end, start)]
        look = {"arrowstyle": "-|>", "color": GREY, "linewidth": 1.0}
        ax.annotate("", *ends, xycoords=offset, textcoords=offset, arrowprops=look)


def _emptiest(across: np.ndarray, up: np.ndarray) -> tuple[float, float, float, float]:
    """The corner of a panel in which the fewest points lie, for a small panel: left, bottom, width, height."""
    wide, high = 0.36, 0.34
    x, y = ((column - column.min()) / max(float(np.ptp(column)), 1e-300) for column in (across, up))
    corners = [(left, low) for low in (0.0, 1.0 - high) for left in (0.0, 1.0 - wide)]
    lying = [np.sum((x >= a) & (x <= a + wide) & (y >= b) & (y <= b + high)) for a, b in corners]
    left, low = corners[int(np.argmin(lying))]
    return 0.03 + 0.94 * left, 0.03 + 0.9 * low, 0.94 * wide, 0.9 * high


def data_uri(picture: bytes, kind: str = "png") -> str:
    """A picture as part of the page."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode('ascii')}"


def cards(found: dict[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    """How much of the gap is closed, what that did to the modulus, the amplitudes: level, heading, answer, meaning."""
    gap = found["gap"]
    if gap["closed_fraction"] is not None:
        before, after = (number(gap["steps"][i]["chi2_per_dof"], 3) for i in (0, -1))
        meaning = (
            "of what the law alone missed on particles that were held out, each predicted from others: χ² "
            f"per point (misfit in units of the noise) falls from {before} to {after}; 1 is noise alone."
        )
        yield "", "Gap closed", percent(gap["closed_fraction"], 3), meaning
    sides = found["parameters_before"], found["parameters_after"]
    before, after = (side.get("modulus_at_peaks_MPa", side.get("effective_modulus_MPa")) or {} for side in sides)
    if before.get("value") is not None and after.get("value") is not None:
        change = 100 * (after["value"] / before["value"] - 1)
        way = f"{number(abs(change), 2)} % {'higher' if change > 0 else 'lower'}"
        meaning = f"at the peaks of these tests; {way} than by the law alone, which gives {with_sd(before, 1e-3)} GPa."
        yield "", "Effective modulus", f"{with_sd(after, 1e-3)} GPa", meaning
    for effect in found["effects"]:
        (name, value), *others = [(quantity(name), with_sd(value)) for name, value in effect["parameters"].items()]
        more = "".join(f"; {other} {text}" for other, text in others)
        meaning = (
            f"{name}, ± one standard deviation{more}. That it is this one, of {len(found['ranking'])} effects that "
            f"these tests could show, has probability {probability(effect['probability'])}."
        )
        yield "", plain(effect["mechanism"]).capitalize(), value, meaning
    if found["verdict"] == "NO_GAP":
        chance = found["p_anything_missing"]
        if chance is not None:
            meaning = "that tests of a law that lacks nothing disagree with it at least so much."
            yield "", "Disagreement by chance", f"probability {probability(chance)}", meaning
        seen = [
            f"{plain(one['mechanism'])} from {number(one['detection_limit'], 2)} "
            + one["unit"].replace("um", "µm").strip("-")
            for one in found["ranking"]
            if one["detection_limit"] is not None
        ]
        if seen:
            examples = "; ".join(text.rstrip() for text in seen[:3])
            yield "", "What would have shown", f"{len(found['ranking'])} effects", f"For example {examples}."
