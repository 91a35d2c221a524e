"""The figures of the paper's calibration, for any campaign."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import ScalarFormatter

from ..calibrate import PaperCalibration
from ..calibrate.data import UNLOADED_FROM
from ..campaign import Campaign, stress_and_strain
from ..law import stress_ratio
from . import style
from .curves import pages_of, plot_particles

_DOTTED: style.Look = {"color": style.GREY, "linewidth": 0.8, "dashes": (1, 1.5)}
_DASHED: style.Look = {"dashes": (3.5, 1.8)}
_MEAN: style.Look = {"color": style.BLUE, "markeredgecolor": "white", "markeredgewidth": 0.4}
_BAND: style.Look = {"color": style.BLUE, "alpha": 0.25, "linewidth": 0}
_SMALL: style.Look = {"fontsize": 7, "color": style.GREY}


def paper_figures(calibration: PaperCalibration) -> dict[str, Figure]:
    """Every figure of the calibration by the stem of its file's name; more than 20 particles take several pages."""
    plots = (plot_curves, plot_collapse, plot_master, plot_law, plot_elastic, plot_residuals)
    figures = style.by_stem(plots, calibration)
    figures["dimensions"] = plot_dimensions(calibration.campaign)
    for page in range(1, pages_of(calibration) + 1):
        figures["particles" if page == 1 else f"particles_{page}"] = plot_particles(calibration, page)
    return figures


def adjusted_curve(calibration: PaperCalibration, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Strain [-] and stress [MPa] of a whole kept test after an offset step, with its line up to the threshold."""
    campaign, adjustment = calibration.campaign, calibration.adjustment
    segments = adjustment.segments[index]
    stress, strain = stress_and_strain(campaign.curves[index], campaign.diameters_um[index], segments)
    strain = strain + adjustment.shift[index]
    approach = max((part.stop for part in segments if part.kind == "approach"), default=0)
    first = approach + int(np.argmax(stress[approach:] > adjustment.threshold_MPa))
    corner = np.array([[0.0, adjustment.strain], [0.0, adjustment.threshold_MPa]])
    return np.concatenate([corner[0], strain[first:]]), np.concatenate([corner[1], stress[first:]])


@style.styled
def plot_curves(calibration: PaperCalibration) -> Figure:
    """Stress [MPa] over strain [-] of some tests, loading and unloading, before and after the offset step.

    Solid: as measured, from first contact. Dashed: after the offset step, with its straight line up to the threshold,
    which the right panel enlarges. Up to three kept particles are shown: of the smallest, the median and the largest
    shape factor. Follows the paper's figure of raw and adjusted curves.
    """
    campaign, adjustment, eta = calibration.campaign, calibration.adjustment, style.shape_factors(calibration)
    threshold, labels = adjustment.threshold_MPa, style.particle_labels(campaign.particles)
    kept = np.flatnonzero(adjustment.kept)
    by_shape = kept[np.argsort(eta[kept], kind="stable")]
    chosen = dict.fromkeys(by_shape[[0, len(kept) // 2, -1]].tolist())
    figure = style.new_figure(7.6, 3.9)
    whole, toe = figure.subplots(1, 2, width_ratios=[1.45, 1])
    handles: list[Line2D] = []
    ends = [0.0, 4 * adjustment.strain]
    for i, colour in zip(chosen, (style.BLUE, style.VERMILION, style.GREEN), strict=False):
        look = {"color": colour} | style.faintness(len(chosen))
        stress, strain = stress_and_strain(campaign.curves[i], campaign.diameters_um[i], adjustment.segments[i])
        for ax in (whole, toe):
            ax.plot(strain, stress, **look)
            if threshold > 0:
                ax.plot(*adjusted_curve(calibration, i), **_DASHED, **look)
        passed = int(np.argmax(stress > 3 * threshold)) or len(stress)
        ends += strain[:passed][stress[:passed] > threshold / 4].tolist()
        handles.append(Line2D([], [], color=colour, label=f"{labels[i]} ($\\eta_p$ = {eta[i]:.2f})"))
    handles.append(Line2D([], [], color=style.GREY, label="as measured"))
    if threshold > 0:
        handles.append(Line2D([], [], color=style.GREY, label="adjusted", **_DASHED))
    whole.legend(handles=handles, loc="upper left")
    whole.set(title="whole test", ylim=(min(0.0, whole.dataLim.ymin), None))
    for ax in (whole, toe):
        ax.set(xlabel=style.STRAIN, ylabel=style.STRESS)
    if threshold > 0:
        for ax in (whole, toe):
            ax.axhline(threshold, **_DOTTED)
        toe.axvline(adjustment.strain, **_DOTTED)
        toe.set(xlim=(min(ends), max(*ends, 1e-6)), ylim=(0, 3 * threshold))
        toe.set_title(f"threshold {threshold:g} MPa, mean strain {adjustment.strain:.3f}")
    else:
        toe.set(xlim=(0, 0.1 * whole.get_xlim()[1]), ylim=(0, 0.1 * whole.get_ylim()[1]))
        toe.set_title("beginning (no offset step)")
    return style.finish(figure, campaign)


@style.styled
def plot_dimensions(campaign: Campaign) -> Figure:
    """Effective diameter D_e = D1 D2 / D3 over average diameter (D1 + D2 + D3)/3 [um], one point per particle.

    With the line 1:1, the line through the origin fitted to the data, and the mean ratio both ways with its standard
    deviation; for the paper's own table these are 1.31 and 0.78, not 1.5. Flat particles lie high.
    """
    D1, D2, D3 = campaign.diameters_um.T
    average, effective, flat = campaign.diameters_um.mean(axis=1), D1 * D2 / D3, D3 / np.sqrt(D1 * D2)
    slope = float(average @ effective / (average @ average))
    colours = style.sequential(flat)
    figure = style.new_figure(5.2, 4.4)
    ax = figure.subplots()
    right = 1.08 * float(average.max())
    ends = np.array([0.0, right])
    ax.plot(ends, ends, color=style.GREY, linewidth=1.0, dashes=(4, 2), label="1:1")
    ax.plot(ends, slope * ends, color=style.VERMILION, label=f"fit through the origin, $D_e$ = {slope:.3f} × average")
    rings: style.Look = {"s": 28, "edgecolors": style.BLACK, "linewidths": 0.5, "alpha": 0.9, "zorder": 3}
    ax.scatter(average, effective, c=colours.to_rgba(flat), label=f"particles ({len(campaign)})", **rings)
    figure.colorbar(colours, ax=ax, label="$D_3/\\sqrt{D_1 D_2}$ [-]")
    ax.set(xlim=(0, right), ylim=(0, max(1.08 * float(effective.max()), right, slope * right)))
    ax.set_xlabel("average diameter $(D_1 + D_2 + D_3)/3$ [µm]")
    ax.set_ylabel("effective diameter $D_e = D_1 D_2/D_3$ [µm]")
    ax.legend(loc="upper left")
    lines = []
    for name, ratio in (("$D_e$/average", effective / average), ("average/$D_e$", average / effective)):
        sd = f" ± {ratio.std(ddof=1):.2f}" if len(ratio) > 1 else ""
        lines.append(f"mean of {name}: {ratio.mean():.2f}{sd}")
    if len(campaign) > 2 and np.ptp(average) > 0 and np.ptp(effective) > 0:
        lines.append(f"correlation: {np.corrcoef(average, effective)[0, 1]:.2f}")
    style.note(ax, "\n".join(lines), place="lower right")
    return style.finish(figure, campaign)


@style.styled
def plot_collapse(calibration: PaperCalibration) -> Figure:
    """Stress [MPa] of all kept loading curves over strain [-] and over strain scaled by the shape factor [-].

    Sorted by colour on the left, mixed on the right if the shape factor does what it is for. The black line is the
    mean, as far as all particles reach; the objective is the sum of squared relative deviations from it (or from the
    reference particle).
    """
    table, fit = calibration.table, calibration.chosen_shape
    eta = table.shape_factor(calibration.a)
    colours = style.sequential(eta)
    figure = style.new_figure(7.8, 3.9)
    panels = figure.subplots(1, 2, sharey=True)
    curves = [c for c in calibration.adjustment.curves if c is not None]
    # Further up the mean would jump wherever a particle's test ends.
    everyone = table.reached.all(axis=0)
    for ax, factors, title, value, label in (
        (panels[0], np.ones_like(eta), "not scaled, a = 0", fit.objective_at_zero, style.STRAIN),
        (panels[1], eta, f"scaled, a = {calibration.a:.2f}", fit.objective, style.SCALED_STRAIN),
    ):
        for curve, factor, colour in zip(curves, factors, colours.to_rgba(eta), strict=True):
            ax.plot(factor * curve.strain, curve.stress_MPa, color=colour, **style.faintness(len(eta)))
        mean = (factors[:, None] * table.strain[:, everyone]).mean(axis=0)
        dashes: style.Look = {"color": style.BLACK, "linewidth": 1.8, "dashes": (2.5, 1.2)}
        ax.plot(mean, table.stress_MPa[everyone], label="mean of all particles", **dashes)
        ax.set(xlabel=label, title=title, xlim=(0, None))
        ax.legend(loc="upper left", title=f"objective {value:.4g}", alignment="left", title_fontsize=8)
    panels[0].set(ylabel=style.STRESS, ylim=(0, None))
    figure.colorbar(colours, ax=panels.tolist(), label=style.SHAPE_FACTOR)
    warning = f"the fit of a did not succeed: {fit.reason}" if fit.reason else ""
    return style.finish(figure, calibration.campaign, warning=warning)


@style.styled
def plot_master(calibration: PaperCalibration) -> Figure:
    """Mean (symbols) and one standard deviation (band) of the scaled strain [-] over stress [MPa], as in the paper.

    Faint lines are the single particles' adjusted loading curves, scaled by their shape factors; the lower panel
    counts the particles that reach a stress. Mean and band end where no more than a fifth of the particles is left.
    """
    master, table = calibration.master, calibration.table
    eta = table.shape_factor(calibration.a)
    figure = style.new_figure(5.6, 4.9)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3.4, 1])
    single = np.where(table.reached, eta[:, None] * table.strain, np.nan)
    labels = ["single particles", *["_"] * (len(eta) - 1)]
    thin = style.faintness(len(eta)) | {"linewidth": 0.6}
    upper.plot(table.stress_MPa, single.T, color=style.PALE, label=labels, **thin)
    low, high = master.mean - master.sd, master.mean + master.sd
    upper.fill_between(master.stress_MPa, low, high, label="mean ± 1 sd", **_BAND)
    step = style.every(len(master.mean), style.MEAN_MARKERS).step
    upper.plot(master.stress_MPa, master.mean, "o", markevery=step, label="mean", **_MEAN)
    upper.set(ylabel=style.SCALED_STRAIN, ylim=(0, None))
    upper.legend(loc="lower right")
    style.note(upper, f"a = {calibration.a:.2f}, {len(eta)} particles")
    lower.fill_between(table.stress_MPa, table.reached.sum(axis=0), step="mid", color=style.PALE, linewidth=0)
    lower.plot(master.stress_MPa, master.count, color=style.BLUE, drawstyle="steps-mid")
    lower.axhline(len(eta) / 5, **_DOTTED)
    lower.annotate("one fifth", (0.01, len(eta) / 5), xycoords=("axes fraction", "data"), va="bottom", **_SMALL)
    lower.yaxis.get_major_locator().set_params(integer=True)
    lower.set(xlim=(0, 1.02 * table.stress_MPa[-1]), ylim=(0, 1.12 * len(eta)))
    lower.set(xlabel=style.STRESS, ylabel="particles [-]")
    return style.finish(figure, calibration.campaign)


def law_strain(calibration: PaperCalibration) -> np.ndarray:
    """Scaled strain of the mean law at the stresses of the master curve [-], shape (G,)."""
    plastic = calibration.mean_law.plastic
    return np.asarray(jax.jit(lambda stress: plastic.strain(stress))(jnp.asarray(calibration.master.stress_MPa)))


def stretches_outside(calibration: PaperCalibration) -> list[tuple[int, int]]:
    """First and last position on the master curve of every stretch of at least three points, above the threshold,
    where the mean law is more than one sample standard deviation of strain off."""
    master = calibration.master
    off = np.abs(law_strain(calibration) - master.mean) > master.sd
    outside = off & (master.stress_MPa > calibration.adjustment.threshold_MPa)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], outside, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 3]


@style.styled
def plot_law(calibration: PaperCalibration) -> Figure:
    """Stress [MPa] over scaled strain [-] of plastic loading: the calibrated law and the sample it was fitted to.

    Solid: mean law; dashed: one standard deviation of stress under the population of C1, C3, C5; dash-dotted: first
    term alone. Symbols and band: mean and one standard deviation of the sample's strain; crosses where the mean law
    lies outside that band. Grey beyond the largest scaled strain of any test, where the law extrapolates.
    """
    master, table = calibration.master, calibration.table
    population, plastic = calibration.plastic.population, calibration.mean_law.plastic
    last = np.where(table.reached, table.strain, 0.0).max(axis=1) * table.shape_factor(calibration.a)
    tested, right = float(last.max()), 1.08 * float(last.max())
    x = np.linspace(0.0, right, 400)
    mean, sd = np.asarray(plastic.stress(jnp.asarray(x))), np.asarray(population.stress_sd(jnp.asarray(x)))
    figure = style.new_figure(5.6, 4.3)
    ax = figure.subplots()
    ax.axvspan(tested, right, color="#ECECEC", linewidth=0, label="beyond the tests")
    low, high = master.mean - master.sd, master.mean + master.sd
    ax.fill_betweenx(master.stress_MPa, low, high, label="sample mean ± 1 sd of strain", **_BAND)
    step = style.every(len(master.mean), style.MEAN_MARKERS).step
    ax.plot(master.mean, master.stress_MPa, "o", markevery=step, label="sample mean", **_MEAN)
    law: style.Look = {"color": style.VERMILION, "linewidth": 1.0}
    ax.plot(x, mean, color=style.VERMILION, linewidth=1.6, label="mean law")
    ax.plot(x, mean + sd, label="± 1 sd of stress", dashes=(4, 2), **law)
    ax.plot(x, np.maximum(mean - sd, 0.0), dashes=(4, 2), **law)
    ax.plot(x, float(plastic.C1) * x, color=style.GREY, linewidth=1.1, dashes=(5, 1.5, 1, 1.5), label="first term only")
    ax.set(xlim=(0, right), ylim=(0, 1.25 * float(table.stress_MPa[-1])))
    ax.set(xlabel=style.SCALED_STRAIN, ylabel=style.STRESS)
    agreement, stretches = "within ± 1 sd of the sample over the tested range", stretches_outside(calibration)
    if stretches:
        shown = np.concatenate([np.arange(a, b + 1, max(1, step // 2)) for a, b in stretches])
        cross: style.Look = {"color": style.ORANGE, "markersize": 5, "markeredgewidth": 1.3}
        at = law_strain(calibration)[shown]
        ax.plot(at, master.stress_MPa[shown], "x", label="law off by > 1 sd", **cross)
        ends = ", ".join(f"{master.stress_MPa[a]:.2g} to {master.stress_MPa[b]:.2g}" for a, b in stretches[:3])
        more = f" and {len(stretches) - 3} more" if len(stretches) > 3 else ""
        agreement = f"more than 1 sd off the sample at {ends} MPa{more}"
    factors = [f"{float(f'{K:.3g}'):.6g}" for K in calibration.plastic.polynomial]
    text = "$\\sigma$/MPa = {} $x$ − {} $x^3$ + {} $x^5$,  $x = \\eta_p\\,\\varepsilon$".format(*factors)
    ax.set_title(f"{text}\nmean law {agreement}", fontsize=8.5)
    ax.legend(loc="upper left")
    if calibration.plastic.at_bound:
        style.note(ax, "at its lower bound:\n" + "\n".join(calibration.plastic.at_bound), place="lower right")
    return style.finish(figure, calibration.campaign)


@style.styled
def plot_elastic(calibration: PaperCalibration) -> Figure:
    """The elastic branches, unloading and reloading, collapsed on one curve, and how well one modulus serves all.

    Left: stress over peak stress [-] against recovered over recoverable strain [-], with the law's universal curve.
    Right: the effective modulus [GPa] of each branch alone over its peak stress [MPa], with the fitted one; it
    belongs to the form of unloading.
    """
    fit, law = calibration.elastic, calibration.mean_law
    figure = style.new_figure(7.8, 3.7)
    left, right = figure.subplots(1, 2)
    modulus = fit.effective_modulus_MPa
    if modulus is None:
        for ax in (left, right):
            ax.text(0.5, 0.5, fit.reason, ha="center", va="center", color=style.GREY, wrap=True)
            ax.set_axis_off()
        return style.finish(figure, calibration.campaign)
    eta = style.shape_factors(calibration)[[b.particle for b in fit.branches]]
    colours = style.sequential(eta)
    rgba = colours.to_rgba(eta)
    few = len(fit.branches) <= style.THIN_CURVES
    dots: style.Look = {"markersize": 3 if few else 1.8, "alpha": 0.7 if few else 0.35, "markeredgewidth": 0}
    for branch, recovered, colour in zip(fit.branches, fit.recovered, rgba, strict=True):
        left.plot(recovered, branch.stress_MPa / branch.stress_max_MPa, ".", color=colour, **dots)
    s = np.linspace(0.0, 1.0, 201)
    ratio = np.asarray(jax.jit(stress_ratio)(jnp.asarray(s)))
    left.plot(s, ratio, color=style.BLACK, linewidth=1.0, label="law, $f(s)$")
    left.axhline(UNLOADED_FROM, **_DOTTED)
    words = "each branch has its own zero;\nnot used below"
    left.annotate(words, (0.02, UNLOADED_FROM), xycoords=("axes fraction", "data"), va="bottom", **_SMALL)
    left.set_xlabel("recovered strain over recoverable strain $s$ [-]")
    left.set(ylabel="stress over peak stress $\\sigma/\\sigma_P$ [-]", ylim=(0, 1.05))
    left.legend(loc="upper right")
    left.set_title(f"{len(fit.branches)} branches, rms strain {fit.rms_strain:.2g}")
    single = fit.per_branch_MPa / 1e3
    known = np.isfinite(single) & (single > 0)
    peaks = np.array([b.stress_max_MPa for b in fit.branches])
    rings: style.Look = {"s": 22, "edgecolors": style.BLACK, "linewidths": 0.4, "zorder": 3}
    right.scatter(peaks[known], single[known], c=rgba[known], label="one branch alone", **rings)
    right.axhline(modulus / 1e3, color=style.VERMILION, label=f"all branches, {modulus / 1e3:.3g} GPa", zorder=2)
    if known.any() and single[known].max() > 5 * single[known].min():
        right.set_yscale("log")
        if single[known].max() < 100 * single[known].min():
            right.yaxis.set_major_formatter(ScalarFormatter())
            right.yaxis.set_minor_formatter(ScalarFormatter())
    else:
        right.margins(y=0.15)
        style.headroom(right, 0.2)
    missing = int((~known).sum())
    if missing:
        plural = "branch gives" if missing == 1 else "branches give"
        style.note(right, f"{missing} {plural} no modulus alone", place="lower right")
    right.set(xlabel="peak stress $\\sigma_P$ [MPa]", ylabel="effective modulus [GPa]")
    right.set_title(f"form of unloading: {law.unloading.value.replace('_', ' ')}")
    right.legend(loc="best" if right.get_yscale() == "log" else "upper left")
    figure.colorbar(colours, ax=[left, right], label=style.SHAPE_FACTOR)
    return style.finish(figure, calibration.campaign)


@style.styled
def plot_residuals(calibration: PaperCalibration) -> Figure:
    """Measured less predicted displacement [um] over force [mN, logarithmic], one line per kept particle.

    Above by the mean law: mostly the scatter of the particles' material. Below by each particle's own C1, C3, C5: what
    the form of the law itself misses. Level stretches are unloading, which keeps the deviation of its peak. The orange
    band is the noise from point to point, plus and minus one standard deviation.
    """
    campaign, noise = calibration.campaign, calibration.displacement_noise_um
    fits = [(i, fit) for i, fit in enumerate(calibration.particles) if fit is not None]
    eta = style.shape_factors(calibration)[[i for i, _ in fits]]
    colours = style.sequential(eta)
    thin = style.faintness(len(fits)) | {"linewidth": 0.8}
    figure = style.new_figure(6.4, 5.2)
    panels = figure.subplots(2, 1, sharex=True)
    for ax, name, title, rms in (
        (panels[0], "predicted_um", "mean law", "rms_um"),
        (panels[1], "own_um", "own coefficients of each particle", "own_rms_um"),
    ):
        for (i, fit), colour in zip(fits, colours.to_rgba(eta), strict=True):
            # A gap, not a line, where points do not count.
            deviation = np.where(fit.used, fit.measured_um - getattr(fit, name), np.nan)
            ax.plot(campaign.curves[i].force_mN, deviation, color=colour, **thin)
        ax.axhline(0.0, color=style.GREY, linewidth=0.8)
        ax.axhspan(-noise, noise, color=style.ORANGE, alpha=0.6, linewidth=0, zorder=3)
        ax.set(ylabel="measured − predicted [µm]", title=title)
        typical, point = np.nanmedian([getattr(fit, rms) for _, fit in fits]), f"{noise:.2g}" if noise > 1e-9 else "0"
        style.note(ax, f"median rms {typical:.2g} µm; point noise (orange) ± {point} µm", place="upper right")
        style.headroom(ax, 0.14)
    panels[1].set_xlabel(style.FORCE)
    panels[1].set_xscale("log")
    panels[1].xaxis.set_major_formatter(ScalarFormatter())
    figure.colorbar(colours, ax=panels.tolist(), label=style.SHAPE_FACTOR)
    return style.finish(figure, campaign)
