"""Measured tests and what a calibration or a discovery says of them, and residuals over load and time."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import arguments
from .._errors import InputError
from .._extras import extra
from ..calibrate import (
    LeastSquares,
    PaperCalibration,
    Posterior,
    predict_new_particle,
)
from ..calibrate.curves import FittedCurve
from ..calibrate.paper.prediction import ParticleFit
from ..campaign import PAPER_DIAMETERS_UM, Curve, effective_diameter_um
from ..discovery import Discovery
from ..effects.record import HOLD, RELOAD, UNLOAD
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
GAP_PANELS = 6  # most tests whose residuals are shown over time
POINTS = 20_000  # no more residuals than these are drawn; the histogram next to them counts them all
SMALL_POINTS = 8000  # of more points in a panel, dots are small and faint
NEW_DRAWS, SINGLE_DRAWS = 1000, 6  # curves of a new particle in its band, and of these drawn as lines
_DOT: style.Look = {"marker": "o", "linestyle": "", "markersize": 3.5, "markeredgewidth": 0}


# ---- the joint calibrations ------------------------------------------------------------------------------------------


def _fill(
    ax: Axes, curve: FittedCurve, rows: np.ndarray, origin: np.ndarray | float, colour: str, alpha: float
) -> None:
    """The band at some rows, displacement counted from an origin."""
    along = rows[np.argsort(curve.force_mN[rows], kind="stable")]  # noise of force must not fold the band
    if len(along) > 1 and np.isfinite(curve.low_um[along]).any():
        low, high = ((end - origin)[along] for end in (curve.low_um, curve.high_um))
        ax.fill_betweenx(curve.force_mN[along], low, high, color=colour, alpha=alpha, linewidth=0)


def _draw_curve(ax: Axes, strip: Axes, curve: FittedCurve) -> None:
    measured, force, used = curve.displacement_um, curve.force_mN, curve.used
    ax.plot(measured[~used], force[~used], ".", color=style.PALE, markersize=2.5, markeredgewidth=0)
    strip.axvline(0.0, color=style.GREY, linewidth=0.7)
    away, thinned = measured - curve.own_um, style.every(len(force), style.CURVE_POINTS)
    segments = np.split(np.arange(len(force)), np.flatnonzero(np.diff(curve.kind)) + 1)
    small: style.Look = _DOT | {"markersize": 3, "alpha": 0.7}
    for loading, colour in ((True, LOADING), (False, UNLOADING)):
        parts = [rows[used[rows]] for rows in segments if (curve.kind[rows[0]] == 0) == loading]
        for rows in parts:
            shown = rows[thinned]
            ax.plot(measured[shown], force[shown], color=colour, **small)
            _fill(ax, curve, rows, 0.0, colour, 0.35)
        together = np.concatenate([np.empty(0, int), *parts])
        dots: style.Look = {"markersize": 2.5, "markeredgewidth": 0, "alpha": 0.8}
        strip.plot(away[together], force[together], ".", color=colour, **dots)
        _fill(strip, curve, together, curve.own_um, colour, 0.25)
    # A gap where points do not count; from one segment to the next the line goes on.
    ax.plot(np.where(used, curve.own_um, np.nan), force, color=style.BLACK, linewidth=0.8)
    ax.locator_params(nbins=5)
    if force.min() > -0.02 * force.max():
        ax.set_ylim(bottom=0)
    reach = 1.1 * max(abs(end) for end in strip.get_xlim())
    tick = float(f"{0.65 * reach:.0e}")
    strip.set_xlim(-reach, reach)
    strip.set_xticks([-tick, 0.0, tick], [f"−{tick:g}", "0", f"{tick:g}"])
    strip.tick_params(labelleft=False)


def _draw_grid(curves: Sequence[FittedCurve], titles: Sequence[str]) -> Figure:
    """Force over displacement of some particles, with a strip of residuals next to each."""
    columns = min(COLUMNS, len(curves))
    rows = -(-len(curves) // columns)
    scale = 1.0 if columns == COLUMNS else 1.5
    figure = style.new_figure(max(scale * 3.2 * columns, 6.4), max(scale * 2.05 * rows + 1.0, 3.4))
    grid = figure.subplots(rows, 2 * columns, squeeze=False, width_ratios=[1.9, 1.0] * columns)
    for ax in grid.ravel()[2 * len(curves) :]:
        ax.set_axis_off()
    pairs = grid.reshape(-1, 2)
    for rank, (curve, title, (ax, strip)) in enumerate(zip(curves, titles, pairs, strict=False)):
        strip.sharey(ax)
        _draw_curve(ax, strip, curve)
        ax.set_title(title, fontsize=8, linespacing=1.15)
        ax.set_ylabel(style.FORCE if rank % columns == 0 else "")
        if rank + columns >= len(curves):
            ax.set_xlabel(style.DISPLACEMENT)
            strip.set_xlabel("residual [µm]")
    figure.align_ylabels(list(grid[:, 0]))
    return figure


def _beside(calibration: Posterior | LeastSquares, what: str, line: str, extra: Sequence[Patch] = ()) -> Figure:
    """At most so many particles that took part, spread over the campaign, measured and as the calibration has them."""
    kept = calibration.selection.kept
    chosen = [kept[row] for row in style.spread_over(len(kept), PANELS)]
    labels, eta = style.particle_labels(calibration.campaign.particles), style.shape_factors(calibration)
    curves = [calibration.curves[i] for i in chosen]
    titles = [f"{labels[i]}\n$\\eta_p$ = {eta[i]:.2f}{_quality(c)}" for i, c in zip(chosen, curves, strict=True)]
    figure = _draw_grid(curves, titles)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=LOADING, label="measured, loading", **_DOT),
        Line2D([], [], color=UNLOADING, label="unloading, reloading", **_DOT),
    ]
    if any((~curve.used).any() for curve in curves):
        handles.append(Line2D([], [], color=style.PALE, label="not used", **_DOT))
    handles += [Line2D([], [], color=style.BLACK, linewidth=0.8, label=line), *extra]
    title = what if len(chosen) == len(kept) else f"{what}, {len(chosen)} of {len(kept)} particles"
    return style.finish_joint(figure, calibration, title, handles)


def _quality(curve: FittedCurve) -> str:
    """How well a curve is met: the share of points in the band, where there is one, or the rms residual."""
    known = curve.used & np.isfinite(curve.low_um)
    if known.any():
        inside = (curve.displacement_um >= curve.low_um) & (curve.displacement_um <= curve.high_um)
        return f", {100 * np.mean(inside[known]):.0f} % inside"
    return "" if curve.rms_um is None else f", rms {curve.rms_um:.2g} µm"


@style.styled
def plot_bands(calibration: Posterior) -> Figure:
    """Force [mN] over displacement [um] of at most 12 particles, and what the posterior expects of each.

    The particles are spread evenly over the campaign. Points: measured, pale where they are not compared with the law.
    Line and band: mean and central 95 % of what would be measured at these forces, noise included. The strip next to
    each panel is the residual, measured less mean [um], with the same band: it shows what the panel is too coarse for.
    The title counts the points inside.
    """
    band = Patch(color=style.GREY, alpha=0.35, linewidth=0, label="95 %")
    return _beside(calibration, "Measured and predicted", "predicted", [band])


@style.styled
def plot_fits(calibration: LeastSquares) -> Figure:
    """Force [mN] over displacement [um] of at most 12 particles, spread over the campaign, measured and fitted.

    Points: measured, pale where they are not compared with the law. Line: the joint fit. The strip next to each panel
    is the residual, measured less fitted [um]; the title gives its root mean square.
    """
    return _beside(calibration, "Measured and fitted", "fitted")


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
    for ax, rows, title in (
        (panels[0], loading & mask, "loading"),
        (panels[1], mask & ~loading, "unloading, reloading"),
    ):
        picked = np.flatnonzero(rows)
        picked = picked[style.every(len(picked), POINTS)]
        ax.axhspan(-1.96, 1.96, color=style.ORANGE, alpha=0.25, linewidth=0, zorder=0)
        ax.axhline(0.0, color=style.GREY, linewidth=0.8)
        ax.scatter(share.ravel()[picked], residual.ravel()[picked], c=rgba[picked // force.shape[1]], **dots)
        ax.set_xlim(0, 1.02)
        ax.set_title(title)
        ax.set_xlabel("force over peak force [-]")
    panels[0].set_ylabel("whitened residual [-]")
    panels[0].set_ylim(-reach, reach)
    _histogram(panels[2], values, reach)
    beyond = int(np.sum(np.abs(values) > reach))
    if beyond:
        style.note(panels[0], f"{beyond} beyond the axis", place="upper left")
    figure.colorbar(colours, ax=panels.tolist(), label=style.SHAPE_FACTOR)
    loss = "" if calibration.loss == "linear" else f", {calibration.loss} loss"
    count = f"{len(residual)} particles" if len(residual) > 1 else "one particle"
    title = f"Residuals of {count}{loss}: rms {np.sqrt(np.mean(values**2)):.2f}"
    return style.finish_joint(figure, calibration, title)


def _histogram(ax: Axes, values: np.ndarray, reach: float) -> None:
    edges = np.linspace(-reach, reach, 41)
    counts = np.histogram(values, edges)[0] / (max(len(values), 1) * np.diff(edges))
    ax.stairs(counts, edges, orientation="horizontal", fill=True, color=style.PALE, label="residuals")
    x = np.linspace(-reach, reach, 201)
    ax.plot(np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), x, color=style.BLACK, linewidth=1.0, label="normal")
    ax.set_xlabel("density [-]")
    ax.set_xlim(left=0)
    ax.legend(loc="upper right", handlelength=1.2)


def _usual_force(calibration: Posterior, diameters_um: np.ndarray) -> float:
    """Force that brings a particle of that size to the campaign's median peak stress [mN]."""
    campaign = calibration.campaign
    ratios = [
        campaign.curves[i].force_mN.max() / effective_diameter_um(campaign.diameters_um[i]) ** 2
        for i in calibration.selection.kept
    ]
    return float(np.median(ratios)) * effective_diameter_um(diameters_um) ** 2


@style.styled
def plot_new_particle(calibration: Posterior, diameters_um: Any = None) -> Figure:
    """Force [mN] over displacement [um] of a particle that was never measured, loading and unloading.

    Bands: central 50 % and 95 % of the posterior's curves at each force, scatter of the particles and uncertainty of
    the population together, without read-out noise. Line: their median. Thin lines: single draws, each the curve of
    one possible particle. It is loaded to the campaign's median peak stress.

    By default D1, D2, D3 [um] are the medians of the paper's Table 1.
    """
    sizes = np.median(PAPER_DIAMETERS_UM, axis=0) if diameters_um is None else arguments.one_particle(diameters_um)
    up = np.linspace(0.0, _usual_force(calibration, sizes), 101)
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
        ax.set_title(title)
        ax.set_xlabel(style.DISPLACEMENT)
    panels[0].set_ylabel(style.FORCE)
    panels[0].set_xlim(left=0)
    panels[0].set_ylim(0, 1.02 * up[-1])
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


# ---- the paper's calibration -----------------------------------------------------------------------------------------


def particle_pages(calibration: PaperCalibration) -> int:
    """Number of pages that `plot_particles` needs for all particles."""
    return -(-len(calibration.campaign) // PAGE)


def _kept_panel(ax: Axes, curve: Curve, fit: ParticleFit) -> None:
    dots: style.Look = {"markersize": 3, "markeredgewidth": 0, "alpha": 0.8}
    for rows, colour in ((~fit.used, style.SKY), (fit.used, style.BLUE)):
        shown = np.flatnonzero(rows)[style.every(len(curve), style.CURVE_POINTS)]
        ax.plot(fit.measured_um[shown], curve.force_mN[shown], "o", color=colour, **dots)
    ax.plot(fit.predicted_um, curve.force_mN, color=style.VERMILION, linewidth=1.3)
    ax.plot(fit.own_um, curve.force_mN, color=style.BLACK, linewidth=0.7)
    if curve.force_mN.min() > -0.02 * curve.force_mN.max():
        ax.set_ylim(bottom=0)


def _dropped_panel(ax: Axes, curve: Curve, reason: str) -> None:
    ax.plot(curve.displacement_um, curve.force_mN, color=style.PALE, linewidth=1.0)
    style.headroom(ax, 0.45)  # for the reason
    ax.set_facecolor("#F6F6F6")
    words = textwrap.fill(style.plain(reason, 200), 26)
    ax.text(0.04, 0.95, words, transform=ax.transAxes, ha="left", va="top", fontsize=7, color=style.GREY)


@style.styled
def plot_particles(calibration: PaperCalibration, page: int = 1) -> Figure:
    """Force [mN] over displacement [um], loading and unloading, one panel per particle, measured and predicted.

    Points: measured, after the offset step (pale where they do not enter the rms). Thick line: the mean law scaled
    by the particle's size and shape, under the measured force. Thin line: the same with the particle's own C1, C3,
    C5. The title gives the shape factor and the root mean square deviation from the mean law. Particles that could
    not be used are grey, as recorded, with the reason. If the law misses the data altogether, a line below the title
    says so. Follows the paper's three figures of experimental values and predictions.

    Pages count from 1, with at most 20 particles each (`particle_pages` gives their number).
    """
    pages, most = particle_pages(calibration), PAGE
    if page not in range(1, pages + 1):
        raise InputError(f"there is no page {page}; there are {pages}, counted from 1")
    campaign = calibration.campaign
    chosen = range((page - 1) * most, min(page * most, len(campaign)))
    columns = PAGE_COLUMNS if pages > 1 else min(PAGE_COLUMNS, len(chosen))
    rows = -(-len(chosen) // columns)
    scale = 1.5 if columns < 3 else 1.0
    figure = style.new_figure(max(scale * 2.35 * columns, 6.4), scale * 2.05 * rows + 0.9)
    grid = figure.subplots(rows, columns, squeeze=False)
    labels, eta = style.particle_labels(campaign.particles), style.shape_factors(calibration)
    for ax in grid.ravel()[len(chosen) :]:
        ax.set_axis_off()
    for rank, (i, ax) in enumerate(zip(chosen, grid.ravel(), strict=False)):
        fit = calibration.particles[i]
        if fit is None:
            _dropped_panel(ax, campaign.curves[i], calibration.adjustment.why_not[i] or "not used")
            detail = "not used"
        else:
            _kept_panel(ax, campaign.curves[i], fit)
            detail = f"rms {fit.rms_um:.1f} µm" if fit.rms_um >= 1 else f"rms {fit.rms_um:.2g} µm"
        title = f"{labels[i]}\n$\\eta_p$ = {eta[i]:.2f}, {detail}"
        ax.set_title(title, fontsize=8, color=style.GREY if fit is None else style.BLACK, linespacing=1.15)
        ax.locator_params(nbins=5)
        ax.set_ylabel(style.FORCE if rank % columns == 0 else "")
        ax.set_xlabel(style.DISPLACEMENT if rank + columns >= len(chosen) else "")
    figure.align_ylabels(list(grid[:, 0]))
    handles = [
        Line2D([], [], color=style.BLUE, marker="o", linestyle="", markersize=3.5, label="measured, adjusted"),
        Line2D([], [], color=style.VERMILION, linewidth=1.3, label="mean law"),
        Line2D([], [], color=style.BLACK, linewidth=0.7, label="own coefficients"),
    ]
    if any(calibration.particles[i] is None for i in chosen):
        handles.append(Line2D([], [], color=style.PALE, label="not used"))
    title = "Measured and predicted" + (f", page {page} of {pages}" if pages > 1 else "")
    lines = style.wrapped(style.plain(calibration.misfit_note or "", 400), figure)
    return style.finish(figure, campaign.metadata, title=title, lines=lines, handles=handles)


# ---- a discovery -----------------------------------------------------------------------------------------------------

_SHADES = {HOLD: "#FBEFD0", UNLOAD: "#DFECF6", RELOAD: "#E2F1E8"}
_WORDS = {HOLD: "hold", UNLOAD: "unloading", RELOAD: "reloading"}


def _shade(ax: Axes, time: np.ndarray, kind: np.ndarray) -> set[int]:
    """Background by kind of segment; loading stays white."""
    seen = set()
    for part in np.split(np.arange(len(kind)), np.flatnonzero(np.diff(kind)) + 1):
        code = int(kind[part[0]])
        if code in _SHADES and len(part) > 1:
            ax.axvspan(*time[[max(part[0] - 1, 0), part[-1]]], color=_SHADES[code], linewidth=0, zorder=0)
            seen.add(code)
    return seen


@style.styled
def plot_before_after(found: Discovery) -> Figure:
    """Measured less predicted displacement [um] over time [s] without and with what was added, and the noise floor.

    The six tests that gain most (without a gap: that fit worst). In both cases every particle's own coefficients,
    modulus and zero are fitted, so that what is shown is what they could not take up. The orange band is the standard
    deviation of what earlier points do not predict. The numbers are root mean squares of the residuals in units of the
    noise, independent from point to point: 1 is the floor.
    """
    left, base = found.residuals, found.base
    if left is None or base is None:
        raise InputError("the base law was not fitted well enough; there is nothing to compare")
    added = bool(found.effects) or found.closure is not None
    points = np.maximum(left.used.sum(1), 1)
    before, after = (np.sum(white**2, 1) for white in (left.white_before, left.white_after))
    worth = before - after if added else before / points
    rows = np.sort(np.argsort(-worth, kind="stable")[:GAP_PANELS])
    columns = min(COLUMNS, len(rows))
    lines = -(-len(rows) // columns)
    figure = style.new_figure(8.6, 1.0 + 2.15 * lines)
    panels = figure.subplots(lines, columns, squeeze=False)
    labels = style.particle_labels(base.campaign.particles)
    kinds: set[int] = set()
    for ax, i in zip(panels.flat, rows, strict=False):
        time, used = left.time_s[i], left.used[i]
        real = np.concatenate([[True], np.diff(time) > 0])
        kinds |= _shade(ax, time[real], left.kind[i][real])
        floor, one, two = (np.where(used, values[i], np.nan) for values in (left.noise, left.before, left.after))
        ax.fill_between(time, -floor, floor, color=style.ORANGE, alpha=0.55, linewidth=0, zorder=2)
        ax.axhline(0.0, color=style.GREY, linewidth=0.7, zorder=1)
        ax.plot(time, one, color=style.VERMILION, linewidth=0.9, zorder=3)
        if added:
            ax.plot(time, two, color=style.BLUE, linewidth=0.9, zorder=4)
        rms = [f"{np.sqrt(total[i] / points[i]):.2f}" for total in (before, after)]
        ax.set_title(labels[left.particles[i]], fontsize=8)
        style.headroom(ax, 0.22)
        style.note(ax, f"{' → '.join(rms) if added else rms[0]} × noise", place="upper left")
        ax.margins(x=0.01)
    for ax in panels.flat[len(rows) :]:
        ax.set_visible(False)
    for ax in panels[-1]:
        ax.set_xlabel("time [s]")
    for ax in panels[:, 0]:
        ax.set_ylabel("measured − predicted [µm]")
    handles: list[Line2D | Patch] = [Line2D([], [], color=style.VERMILION, label="law alone")]
    if added:
        handles.append(Line2D([], [], color=style.BLUE, label="with what was added"))
    handles.append(Patch(color=style.ORANGE, alpha=0.55, linewidth=0, label="± noise"))
    handles += [Patch(color=_SHADES[k], linewidth=0, label=_WORDS[k]) for k in _SHADES if k in kinds]
    title = "What the law leaves, before and after" if added else "What the law leaves: nothing was added"
    return style.finish(figure, base.campaign.metadata, title=title, handles=handles)
