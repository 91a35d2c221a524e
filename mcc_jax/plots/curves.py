"""Raw and adjusted stress-strain curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .._errors import InputError
from ..calibrate import PaperCalibration
from ..campaign import stress_and_strain
from .style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SHAPE_FACTOR,
    SKY,
    STRAIN,
    STRESS,
    VERMILION,
    faintness,
    finish,
    new_figure,
    sequential,
    shape_factors,
    styled,
)
from .text import particle_labels

_CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)


def adjusted_curve(calibration: PaperCalibration, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Strain [-] and stress [MPa] of a whole kept test after the offset step, unloading included.

    The straight line of the offset step stands for everything before the threshold is first passed.
    """
    campaign, adjustment = calibration.campaign, calibration.adjustment
    segments = adjustment.segments[index]
    stress, strain = stress_and_strain(campaign.curves[index], campaign.diameters_um[index], segments)
    strain = strain + adjustment.shift[index]
    if adjustment.threshold_MPa == 0:
        return strain, stress
    touching = np.ones(len(stress), bool)
    for segment in segments:
        if segment.kind == "approach":
            touching[segment.start : segment.stop] = False
    first = int(np.argmax(touching & (stress > adjustment.threshold_MPa)))
    return (
        np.concatenate([[0.0, adjustment.strain], strain[first:]]),
        np.concatenate([[0.0, adjustment.threshold_MPa], stress[first:]]),
    )


@styled
def plot_curves(calibration: PaperCalibration, particles: Sequence[str] | None = None) -> Figure:
    """Stress [MPa] over strain [-] of some tests, loading and unloading, before and after the offset step.

    Solid: force and displacement as measured, divided by the area of the effective diameter and by that diameter,
    from first contact. Dashed: the same after the offset step, with its straight line up to the threshold. The right
    panel enlarges the threshold; without an offset step there are no dashed lines. Follows the paper's figure of raw
    and adjusted curves of particles 1 to 3.

    Args:
        calibration: the calibration.
        particles: names; by default up to three kept particles over the range of shape factors. Particles that were not
            kept have no dashed line. More than seven are coloured by shape factor in place of a legend.

    Raises:
        InputError: for a name that is not in the campaign.
    """
    campaign, adjustment = calibration.campaign, calibration.adjustment
    eta = shape_factors(calibration)
    if particles is None:
        kept = np.flatnonzero(adjustment.kept)
        by_shape = kept[np.argsort(eta[kept], kind="stable")]
        chosen = list(dict.fromkeys(by_shape[[0, len(kept) // 2, -1]].tolist()))
    else:
        if isinstance(particles, str) or not particles:
            raise InputError(f"particles must be a list of names, got {particles!r}")
        chosen = [campaign.index(name) for name in particles]
    labels = particle_labels(campaign.particles)
    many = len(chosen) > len(_CYCLE)
    colours = sequential(eta[chosen])
    figure = new_figure(7.6, 3.9)
    whole, toe = figure.subplots(1, 2, width_ratios=[1.45, 1])
    handles: list[Line2D] = []
    ends, highest = [0.0, 4 * adjustment.strain], 0.0
    rgba = colours.to_rgba(eta[chosen])
    for rank, i in enumerate(chosen):
        colour = rgba[rank] if many else _CYCLE[rank]
        stress, strain = stress_and_strain(campaign.curves[i], campaign.diameters_um[i], adjustment.segments[i])
        width = faintness(len(chosen))
        for ax in (whole, toe):
            ax.plot(strain, stress, color=colour, **width)
        suffix = ""
        if adjustment.kept[i] and adjustment.threshold_MPa > 0:
            adjusted = adjusted_curve(calibration, i)
            for ax in (whole, toe):
                ax.plot(*adjusted, color=colour, dashes=(3.5, 1.8), **width)
        elif not adjustment.kept[i]:
            suffix = ", not used"
        highest = max(highest, float(stress.max()))
        passed = int(np.argmax(stress > 3 * adjustment.threshold_MPa)) or len(stress)
        first = strain[:passed][stress[:passed] > adjustment.threshold_MPa / 4]
        ends += [float(first.min()), float(first.max())] if len(first) else []
        handles.append(Line2D([], [], color=colour, label=f"{labels[i]}{suffix} ($\\eta_p$ = {eta[i]:.2f})"))
    styles = [Line2D([], [], color=GREY, label="as measured")]
    if adjustment.threshold_MPa > 0:
        styles.append(Line2D([], [], color=GREY, dashes=(3.5, 1.8), label="adjusted"))
    if many:
        figure.colorbar(colours, ax=toe, label=SHAPE_FACTOR)
        whole.legend(handles=styles, loc="upper left")
    else:
        whole.legend(handles=handles + styles, loc="upper left")
    if adjustment.threshold_MPa > 0:
        for ax in (whole, toe):
            ax.axhline(adjustment.threshold_MPa, color=GREY, linewidth=0.8, dashes=(1, 1.5))
        toe.axvline(adjustment.strain, color=GREY, linewidth=0.8, dashes=(1, 1.5))
        toe.set_ylim(0, 3 * adjustment.threshold_MPa)
        toe.set_xlim(min(ends), max(*ends, 1e-6))
        toe.set_title(f"threshold {adjustment.threshold_MPa:g} MPa, mean strain {adjustment.strain:.3f}")
    else:
        toe.set_title("beginning (no offset step)")
        toe.set_xlim(0, 0.1 * whole.get_xlim()[1])
        toe.set_ylim(0, 0.1 * whole.get_ylim()[1])
    whole.set_title("whole test")
    if whole.dataLim.ymin > -0.02 * highest:
        whole.set_ylim(bottom=0)
    for ax in (whole, toe):
        ax.set_xlabel(STRAIN)
        ax.set_ylabel(STRESS)
    return finish(figure, campaign.metadata)
