"""Unloading: all branches on the universal curve, and the modulus that each alone would give."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, ScalarFormatter

from ..calibrate import MIN_RATIO, PaperCalibration
from ..calibrate.paper.modulus import recoverable_strain
from ..formulas import recovery
from ..law import stress_ratio
from .style import (
    BLACK,
    GREY,
    SHAPE_FACTOR,
    VERMILION,
    empty,
    finish,
    new_figure,
    note,
    sequential,
    shape_factors,
    styled,
)


def collapsed_branches(calibration: PaperCalibration) -> list[tuple[np.ndarray, np.ndarray]]:
    """Recovered over recoverable strain and stress over peak stress of every elastic branch, under the fitted modulus.

    The zero of each branch is the one that the fit leaves free.
    """
    modulus, law, branches = (
        calibration.elastic.effective_modulus_MPa,
        calibration.mean_law,
        calibration.elastic.branches,
    )
    if modulus is None:
        return []
    eta = shape_factors(calibration)[[b.particle for b in branches]]
    top, deepest = np.array([(b.stress_max_MPa, b.strain_max) for b in branches]).T
    recoverable = np.asarray(
        recoverable_strain(
            jnp.log(jnp.asarray(float(modulus))),
            jnp.asarray(top),
            jnp.asarray(deepest),
            jnp.asarray(eta**law.strain_scaling.power),
            law.unloading,
        )
    )
    ratios = [b.stress_MPa / b.stress_max_MPa for b in branches]
    # All branches in one call: every new length would be compiled anew.
    expected = np.asarray(jax.jit(recovery)(jnp.asarray(np.concatenate(ratios))))
    expected = np.split(expected, np.cumsum([len(r) for r in ratios])[:-1])
    collapsed = []
    for branch, delta, ratio, s in zip(branches, recoverable, ratios, expected, strict=True):
        measured = (branch.strain_max - branch.strain) / delta
        collapsed.append((measured - np.mean(measured - s), ratio))
    return collapsed


@styled
def plot_elastic(calibration: PaperCalibration) -> Figure:
    """The elastic branches, unloading and reloading, collapsed on one curve, and how well one modulus serves all.

    Left: stress over peak stress [-] against recovered over recoverable strain [-], with the law's universal curve.
    Right: the effective modulus [GPa] of each branch alone over its peak stress [MPa], with the fitted one; it
    belongs to the form of unloading. Colour is the shape factor. The paper shows unloading only within its figures of
    single particles.
    """
    fit, law = calibration.elastic, calibration.mean_law
    figure = new_figure(7.8, 3.7)
    left, right = figure.subplots(1, 2)
    modulus = fit.effective_modulus_MPa
    if modulus is None:
        for ax in (left, right):
            empty(ax, fit.reason or "no effective modulus")
        return finish(figure, calibration.campaign.metadata)
    eta = shape_factors(calibration)[[b.particle for b in fit.branches]]
    colours = sequential(eta)
    rgba = colours.to_rgba(eta)
    few = len(fit.branches) <= 30
    for (recovered, ratio), colour in zip(collapsed_branches(calibration), rgba, strict=True):
        left.plot(
            recovered, ratio, ".", color=colour, markersize=3 if few else 1.8,
            alpha=0.7 if few else 0.35, markeredgewidth=0,
        )  # fmt: skip
    s = np.linspace(0.0, 1.0, 201)
    left.plot(s, np.asarray(jax.jit(stress_ratio)(jnp.asarray(s))), color=BLACK, linewidth=1.0, label="law, $f(s)$")
    left.axhline(MIN_RATIO, color=GREY, linewidth=0.8, dashes=(1, 1.5))
    left.text(
        0.02,
        MIN_RATIO,
        "each branch has a zero of its own;\nnot used below",
        transform=left.get_yaxis_transform(),
        va="bottom",
        fontsize=7,
        color=GREY,
    )
    left.set_xlabel("recovered strain over recoverable strain $s$ [-]")
    left.set_ylabel("stress over peak stress $\\sigma/\\sigma_P$ [-]")
    left.set_ylim(0, 1.05)
    left.legend(loc="upper right")
    left.set_title(f"{len(fit.branches)} branches, rms strain {fit.rms_strain:.2g}")
    single = fit.per_branch_MPa / 1e3
    known = np.isfinite(single) & (single > 0)
    peaks = np.array([b.stress_max_MPa for b in fit.branches])
    right.scatter(
        peaks[known], single[known], c=rgba[known], s=22,
        edgecolors=BLACK, linewidths=0.4, label="one branch alone", zorder=3,
    )  # fmt: skip
    right.axhline(modulus / 1e3, color=VERMILION, label=f"all branches, {modulus / 1e3:.3g} GPa", zorder=2)
    if known.any() and single[known].max() > 5 * single[known].min():
        right.set_yscale("log")
        wide = single[known].max() > 100 * single[known].min()
        for axis in ("set_major_formatter", "set_minor_formatter"):
            plain = LogFormatterSciNotation() if wide else ScalarFormatter()
            getattr(right.yaxis, axis)(plain)
    else:
        span = np.concatenate([single[known], [modulus / 1e3]])
        margin = max(0.15 * np.ptp(span), 0.02 * modulus / 1e3)
        right.set_ylim(span.min() - margin, span.max() + 2.5 * margin)
    if not known.all():
        missing = int((~known).sum())
        said = "1 branch gives" if missing == 1 else f"{missing} branches give"
        note(right, f"{said} no modulus alone", place="lower right")
    right.set_xlabel("peak stress $\\sigma_P$ [MPa]")
    right.set_ylabel("effective modulus [GPa]")
    right.set_title(f"form of unloading: {law.unloading.value.replace('_', ' ')}")
    right.legend(loc="best" if right.get_yscale() == "log" else "upper left")
    figure.colorbar(colours, ax=[left, right], label=SHAPE_FACTOR)
    return finish(figure, calibration.campaign.metadata)
