"""Average against effective diameter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ..campaign import Campaign
from .style import BLACK, GREY, VERMILION, finish, new_figure, note, sequential, styled


@dataclass(frozen=True)
class DimensionStatistics:
    """How average and effective diameter of a campaign's particles relate.

    Attributes:
        average_um: (D1 + D2 + D3)/3 [um], shape (N,).
        effective_um: D1 D2 / D3 [um], shape (N,).
        slope: effective over average diameter, by least squares through the origin [-].
        effective_over_average: mean and sample standard deviation of the ratio [-].
        average_over_effective: the same of its inverse.
        correlation: Pearson's; NaN for fewer than three particles or equal sizes.
    """

    average_um: np.ndarray
    effective_um: np.ndarray
    slope: float
    effective_over_average: tuple[float, float]
    average_over_effective: tuple[float, float]
    correlation: float


def dimension_statistics(campaign: Campaign) -> DimensionStatistics:
    """The numbers of `plot_dimensions`."""
    average = campaign.diameters_um.mean(axis=1)
    D1, D2, D3 = campaign.diameters_um.T
    effective = D1 * D2 / D3
    varied = len(average) > 2 and np.ptp(average) > 0 and np.ptp(effective) > 0

    def moments(ratio: np.ndarray) -> tuple[float, float]:
        return float(ratio.mean()), float(ratio.std(ddof=1)) if len(ratio) > 1 else float("nan")

    return DimensionStatistics(
        average,
        effective,
        float(average @ effective / (average @ average)),
        moments(effective / average),
        moments(average / effective),
        float(np.corrcoef(average, effective)[0, 1]) if varied else float("nan"),
    )


@styled
def plot_dimensions(campaign: Campaign) -> Figure:
    """Effective diameter D_e = D1 D2 / D3 over average diameter (D1 + D2 + D3)/3 [um], one point per particle.

    With the line 1:1, the line through the origin fitted to the data, and the mean ratio both ways with its standard
    deviation. Colour is D3 over the geometric mean of D1 and D2: flat particles lie high. Follows the paper's figure
    of dimensions, but says what the data give; for the paper's own table the ratios are 1.31 and 0.78, not 1.5.
    """
    s = dimension_statistics(campaign)
    flat = campaign.diameters_um[:, 2] / np.sqrt(campaign.diameters_um[:, 0] * campaign.diameters_um[:, 1])
    colours = sequential(flat)
    figure = new_figure(5.2, 4.4)
    ax = figure.subplots()
    right = 1.08 * float(s.average_um.max())
    ends = np.array([0.0, right])
    ax.plot(ends, ends, color=GREY, linewidth=1.0, dashes=(4, 2), label="1:1")
    ax.plot(ends, s.slope * ends, color=VERMILION, label=f"fit through the origin, $D_e$ = {s.slope:.3f} × average")
    ax.scatter(
        s.average_um, s.effective_um, c=colours.to_rgba(flat), s=28, edgecolors=BLACK,
        linewidths=0.5, alpha=0.9, zorder=3, label=f"particles ({len(campaign)})",
    )  # fmt: skip
    figure.colorbar(colours, ax=ax, label="$D_3/\\sqrt{D_1 D_2}$ [-]")
    ax.set_xlim(0, right)
    ax.set_ylim(0, 1.08 * max(float(s.effective_um.max()), right / 1.08, s.slope * right / 1.08))
    ax.set_xlabel("average diameter $(D_1 + D_2 + D_3)/3$ [µm]")
    ax.set_ylabel("effective diameter $D_e = D_1 D_2/D_3$ [µm]")
    ax.legend(loc="upper left")

    def ratio(name: str, moments: tuple[float, float]) -> str:
        spread = f" ± {moments[1]:.2f}" if np.isfinite(moments[1]) else ""
        return f"{name}: {moments[0]:.2f}{spread}"

    lines = [
        ratio("mean of $D_e$/average", s.effective_over_average),
        ratio("mean of average/$D_e$", s.average_over_effective),
    ]
    if np.isfinite(s.correlation):
        lines.append(f"correlation: {s.correlation:.2f}")
    note(ax, "\n".join(lines), place="lower right")
    return finish(figure, campaign.metadata)
