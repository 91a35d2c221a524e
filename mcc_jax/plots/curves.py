"""Measured tests next to what a calibration predicts, and residuals over load."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import arguments
from .._errors import InputError
from .._extras import extra
from ..calibrate import LeastSquares, PaperCalibration, Posterior, predict_new_particle
from ..calibrate.curves import FittedCurve
from ..campaign import PAPER_DIAMETERS_UM, effective_diameter_um
from ..geometry import Particle
from . import style

with extra("plots"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

LOADING, UNLOADING = style.BLUE, style.VERMILION
PANELS, COLUMNS = 12, 3  # most particles in a grid of curves, and how many are in a row
PAGE, PAGE_COLUMNS = 20, 4  # the same on a page of all particles
POINTS = 20_000  # no more residuals than these are drawn; the histogram next to them counts them all
SMALL_POINTS = 8000  # of more points in a panel, dots are small and faint
NEW_DRAWS, SINGLE_DRAWS = 1000, 6  # curves of a new particle in its band, and of these drawn as lines
_DOT: style.Look = {"marker": "o", "linestyle": "", "markersize": 3.5, "markeredgewidth": 0}
_MEASURED = Line2D([], [], color=LOADING, label="measured, loading", **_DOT)
_RELEASED = Line2D([], [], color=UNLOADING, label="unloading, reloading", **_DOT)
_NOT_USED = Line2D([], [], color=style.PALE, label="not used", **_DOT)


def segments(kind: np.ndarray) -> list[np.ndarray]:
    """Rows of every segment."""
    return np.split(np.arange(len(kind)), np.flatnonzero(np.diff(kind)) + 1)


def _draw_curve(ax: Axes, strip: Axes | None, curve: FittedCurve) -> None:
    """Force over displacement, measured and by the law; over the residual in the strip, else with the typical curve."""
    measured, force, used = curve.displacement_um, curve.force_mN, curve.used
    ax.plot(measured[~used], force[~used], ".", color=style.PALE, markersize=2.5, markeredgewidth=0)
    drawn = [(ax, np.zeros(len(force)), style.every(len(force), style.CURVE_POINTS), 6.0)]
    if strip is not None:
        strip.axvline(0.0, color=style.GREY, linewidth=0.7)
        drawn.append((strip, curve.own_um, slice(None), 2.5))
    for segment in segments(curve.kind):
        colour = LOADING if curve.kind[segment[0]] == 0 else UNLOADING
        rows = segment[used[segment]]
        along = rows[np.argsort(force[rows], kind="stable")]  # noise of force must not fold the band
        for panel, origin, thinned, size in drawn:
            shown = rows[thinned]
            dots: style.Look = {"color": colour, "markersize": size, "markeredgewidth": 0, "alpha": 0.7}
            panel.plot((measured - origin)[shown], force[shown], ".", **dots)
            if len(along) > 1 and np.isfinite(curve.low_um[along]).any():
                low, high = ((end - origin)[along] for end in (curve.low_um, curve.high_um))
                panel.fill_betweenx(force[along], low, high, color=colour, alpha=0.3, linewidth=0)
    if strip is None:
        ax.plot(curve.typical_um, force, color=style.GREEN, linewidth=1.6)
    # A gap where points do not count; from one segment to the next the line goes on.
    ax.plot(np.where(used, curve.own_um, np.nan), force, color=style.BLACK, linewidth=0.8)
    if force.min() > -0.02 * force.max():
        ax.set_ylim(bottom=0)
    if strip is not None:
        reach = 1.1 * max(abs(end) for end in strip.get_xlim())
        tick = float(f"{0.65 * reach:.0e}")
        strip.set_xlim(-reach, reach)
        strip.set_xticks([-tick, 0.0, tick], [f"−{tick:g}", "0", f"{tick:g}"])
        strip.tick_params(labelleft=False)


def _draw_unused(ax: Axes, curve: FittedCurve) -> None:
    """A test that could not be used, with the reason."""
    ax.plot(curve.displacement_um, curve.force_mN, color=style.PALE, linewidth=1.0)
    style.headroom(ax, 0.45)  # for the reason
    ax.set_facecolor("#F6F6F6")
    words = textwrap.fill(style.plain(curve.why_not or "not used", 200), 26)
    ax.text(0.04, 0.95, words, transform=ax.transAxes, ha="left", va="top", fontsize=7, color=style.GREY)


def _quality(curve: FittedCurve, law_um: np.ndarray) -> str:
    """How well a curve is met: the share of points in the band, where there is one, or the rms residual of a law."""
    if len(curve.inside):
        return f", {100 * np.mean(curve.inside):.0f} % inside"
    rms = np.sqrt(np.mean((curve.displacement_um - law_um)[curve.used] ** 2))
    return f", rms {rms:.2g} µm" if np.isfinite(rms) else ""


def _draw_particles(calibration: PaperCalibration | LeastSquares | Posterior, chosen: Sequence[int]) -> Figure:
    """A panel for each of these particles of the campaign; of a joint calibration, a strip of residuals next to it."""
    joint = not isinstance(calibration, PaperCalibration)
    columns, size, widths = (COLUMNS, (3.2, 2.05), (1.9, 1.0)) if joint else (PAGE_COLUMNS, (2.35, 2.05), (1.0,))
    labels = (style.DISPLACEMENT, "residual [µm]")[: len(widths)]
    figure, panels = style.grid(len(chosen), columns, size, xlabels=labels, ylabel=style.FORCE, widths=widths)
    names, eta = style.particle_labels(calibration.campaign.particles), style.shape_factors(calibration)
    for i, (ax, *strips) in zip(chosen, panels, strict=True):
        curve, detail = calibration.curves[i], ", not used"
        if curve.why_not is not None:
            _draw_unused(ax, curve)
        else:
            for strip in strips:
                strip.sharey(ax)
            _draw_curve(ax, strips[0] if joint else None, curve)
            detail = _quality(curve, curve.own_um if joint else curve.typical_um)
        colour = style.BLACK if curve.why_not is None else style.GREY
        ax.set_title(f"{names[i]}\n$\\eta_p$ = {eta[i]:.2f}{detail}", fontsize=8, linespacing=1.15, color=colour)
        ax.locator_params(nbins=5)
    return figure


def _draw_kept(calibration: Posterior | LeastSquares, how: str, band: Sequence[Patch] = ()) -> Figure:
    """At most so many of the particles that took part, spread over the campaign; `how` is "predicted" or "fitted"."""
    kept = calibration.selection.kept
    chosen = [kept[row] for row in style.spread_over(len(kept), PANELS)]
    figure = _draw_particles(calibration, chosen)
    handles = [_MEASURED, _RELEASED]
    if any((~calibration.curves[i].used).any() for i in chosen):
        handles.append(_NOT_USED)
    handles.append(Line2D([], [], color=style.BLACK, linewidth=0.8, label=how))
    part = "" if len(chosen) == len(kept) else f", {len(chosen)} of {len(kept)} particles"
    return style.finish_joint(figure, calibration, f"Measured and {how}{part}", [*handles, *band])


@style.styled
def plot_bands(calibration: Posterior) -> Figure:
    """Force [mN] over displacement [um] of at most 12 particles, and what the posterior expects of each.

    The particles are spread evenly over the campaign. Points: measured, pale where they are not compared with the law.
    Line and band: mean and central 95 % of what would be measured at these forces, noise included. The strip next to
    each panel is the residual, measured less mean [um], with the same band: it shows what the panel is too coarse for.
    The title counts the points inside.
    """
    band = Patch(color=style.GREY, alpha=0.35, linewidth=0, label="95 %")
    return _draw_kept(calibration, "predicted", [band])


@style.styled
def plot_fits(calibration: LeastSquares) -> Figure:
    """Force [mN] over displacement [um] of at most 12 particles, spread over the campaign, measured and fitted.

    Points: measured, pale where they are not compared with the law. Line: the joint fit. The strip next to each panel
    is the residual, measured less fitted [um]; the title gives its root mean square.
    """
    return _draw_kept(calibration, "fitted")


def pages_of(calibration: PaperCalibration) -> int:
    """How many pages `plot_particles` has of a calibration."""
    return -(-len(calibration.campaign) // PAGE)


@style.styled
def plot_particles(calibration: PaperCalibration, page: int = 1) -> Figure:
    """Force [mN] over displacement [um], loading and unloading, one panel per particle, measured and predicted.

    Points: measured, pale where they are not compared with the law. Thick line: the mean law scaled by the particle's
    size and shape, under the measured force. Thin line: the same with the particle's own C1, C3, C5. The title gives
    the shape factor and the root mean square deviation from the mean law. Particles that could not be used are grey,
    with the reason. If the law misses the data altogether, a line below the title says so. Follows the paper's three
    figures of experimental values and predictions. Pages count from 1, with at most 20 particles each.
    """
    count, pages = len(calibration.campaign), pages_of(calibration)
    if page not in range(1, pages + 1):
        raise InputError(f"there is no page {page}; there are {pages}, counted from 1")
    chosen = range((page - 1) * PAGE, min(page * PAGE, count))
    figure = _draw_particles(calibration, chosen)
    handles = [_MEASURED, _RELEASED, Line2D([], [], color=style.GREEN, linewidth=1.6, label="mean law")]
    handles.append(Line2D([], [], color=style.BLACK, linewidth=0.8, label="own coefficients"))
    if any(calibration.curves[i].why_not for i in chosen):
        handles.append(_NOT_USED)
    title = "Measured and predicted" + (f", page {page} of {pages}" if pages > 1 else "")
    warning = " ".join(calibration.misfit_notes())
    return style.finish(figure, calibration.campaign, title=title, warning=warning, handles=handles)


@style.styled
def plot_whitened(calibration: LeastSquares) -> Figure:
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
    eta = style.shape_factors(calibration)[list(calibration.selection.kept)]
    colours = style.sequential(eta)
    rgba = colours.to_rgba(eta)
    values = residual[mask]
    reach = max(4.0, 1.1 * float(np.quantile(np.abs(values), 0.999)))
    figure = style.new_figure(8.6, 4.0)
    panels = figure.subplots(1, 3, sharey=True, width_ratios=[2, 2, 1])
    few = len(values) <= SMALL_POINTS
    dots: style.Look = {"s": 4 if few else 2, "alpha": 0.7 if few else 0.4, "linewidths": 0, "rasterized": True}
    branches = (("loading", loading & mask), ("unloading, reloading", mask & ~loading))
    for ax, (title, rows) in zip(panels, branches, strict=False):
        picked = np.flatnonzero(rows)
        picked = picked[style.every(len(picked), POINTS)]
        ax.axhspan(-1.96, 1.96, color=style.ORANGE, alpha=0.25, linewidth=0, zorder=0)
        ax.axhline(0.0, color=style.GREY, linewidth=0.8)
        ax.scatter(share.ravel()[picked], residual.ravel()[picked], c=rgba[picked // force.shape[1]], **dots)
        ax.set(xlim=(0, 1.02), title=title, xlabel="force over peak force [-]")
    panels[0].set(ylabel="whitened residual [-]", ylim=(-reach, reach))
    _histogram(panels[2], values, reach)
    beyond = int(np.sum(np.abs(values) > reach))
    if beyond:
        style.note(panels[0], f"{beyond} beyond the axis")
    figure.colorbar(colours, ax=panels.tolist(), label=style.SHAPE_FACTOR)
    loss = "" if calibration.loss == "linear" else f", {calibration.loss} loss"
    count = f"{len(residual)} particles" if len(residual) > 1 else "one particle"
    title = f"Residuals of {count}{loss}: rms {np.sqrt(np.mean(values**2)):.2f}"
    return style.finish_joint(figure, calibration, title)


def _histogram(ax: Axes, values: np.ndarray, reach: float) -> None:
    counts, edges = np.histogram(values, bins=40, range=(-reach, reach))
    density = counts / (len(values) * np.diff(edges))
    ax.stairs(density, edges, orientation="horizontal", fill=True, color=style.PALE, label="residuals")
    x = np.linspace(-reach, reach, 201)
    ax.plot(np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), x, color=style.BLACK, linewidth=1.0, label="normal")
    ax.set(xlabel="density [-]", xlim=(0, None))
    ax.legend(loc="upper right", handlelength=1.2)


@style.styled
def plot_new_particle(calibration: Posterior, diameters_um: Any = None) -> Figure:
    """Force [mN] over displacement [um] of a particle that was never measured, loading and unloading.

    Bands: central 50 % and 95 % of the posterior's curves at each force, scatter of the particles and uncertainty of
    the population together, without read-out noise. Line: their median. Thin lines: single draws, each the curve of
    one possible particle. It is loaded to the campaign's median peak stress. By default D1, D2, D3 [um] are the medians
    of the paper's Table 1.
    """
    sizes = np.median(PAPER_DIAMETERS_UM, axis=0) if diameters_um is None else arguments.one_particle(diameters_um)
    campaign, kept = calibration.campaign, list(calibration.selection.kept)
    peaks = np.array([campaign.curves[i].force_mN.max() for i in kept])
    usual = np.median(peaks / np.array([effective_diameter_um(d) for d in campaign.diameters_um[kept]]) ** 2)
    up = np.linspace(0.0, usual * effective_diameter_um(sizes) ** 2, 101)
    path = np.concatenate([up, up[-2::-1]])
    curves = predict_new_particle(calibration, sizes.tolist(), path, count=NEW_DRAWS)
    figure = style.new_figure(7.8, 4.1)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    branches = (slice(0, len(up)), slice(len(up) - 1, None))
    for ax, rows, colour, title in zip(panels, branches, (LOADING, UNLOADING), ("loading", "unloading"), strict=True):
        force = curves.force_mN[rows]
        for share, opacity in ((0.95, 0.2), (0.5, 0.35)):
            low, high = curves.band(share)
            ax.fill_betweenx(force, low[rows], high[rows], color=colour, alpha=opacity, linewidth=0)
        for draw in curves.displacement_um[:SINGLE_DRAWS, rows]:
            ax.plot(draw, force, color=style.GREY, linewidth=0.6)
        ax.plot(np.median(curves.displacement_um, axis=0)[rows], force, color=style.BLACK, linewidth=1.3)
        ax.set(title=title, xlabel=style.DISPLACEMENT)
    panels[0].set(ylabel=style.FORCE, ylim=(0, 1.02 * up[-1]), xlim=(0, None))
    D1, D2, D3 = sizes.tolist()
    eta = float(calibration.law().shape_factor(Particle(D1, D2, D3)))
    title = f"A new particle of {D1:.0f} × {D2:.0f} × {D3:.0f} µm, $\\eta_p$ = {eta:.2f}"
    handles = [
        Line2D([], [], color=style.BLACK, linewidth=1.3, label="median"),
        Patch(color=style.GREY, alpha=0.6, linewidth=0, label="50 %"),
        Patch(color=style.GREY, alpha=0.25, linewidth=0, label="95 %"),
        Line2D([], [], color=style.GREY, linewidth=0.6, label="single draws"),
    ]
    return style.finish_joint(figure, calibration, title, handles)
