"""What the figures of both joint calibrations share: names, colours of branches, cautions, densities."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.figure import Figure

from ..calibrate import BayesCalibration, LeastSquaresCalibration
from ..campaign import of_each_particle
from .text import particle_labels, plain

COEFFICIENT_SYMBOLS = ("$C_1$", "$C_3$", "$C_5$")
COEFFICIENT_NAMES = ("C1", "C3", "C5")
"""As in files."""

MAX_DRAWS = 2000
"""No more draws than these go into one density."""


def kept_labels(calibration: BayesCalibration | LeastSquaresCalibration) -> list[str]:
    """Labels of the particles that took part."""
    labels = particle_labels(calibration.campaign.particles)
    return [labels[i] for i in calibration.selection.kept]


def flatness(calibration: BayesCalibration | LeastSquaresCalibration) -> np.ndarray:
    """1 - D3^2 / (D1 D2) of the particles that took part [-]."""
    diameters_um = calibration.campaign.diameters_um[list(calibration.selection.kept)]
    return of_each_particle(diameters_um, lambda p: p.flatness)


def spread_over(count: int, most: int) -> np.ndarray:
    """Positions of at most so many of `count` things, spread evenly over them, first and last included."""
    return np.unique(np.round(np.linspace(0, count - 1, min(most, count))).astype(int))


def cautions(figure: Figure, calibration: BayesCalibration | LeastSquaresCalibration) -> list[str]:
    """Lines below the title that say why the numbers must not be relied on; none if they may be."""
    if isinstance(calibration, BayesCalibration):
        reasons = calibration.failures()
    else:
        reasons = [calibration.reason] if calibration.reason else []
        reasons += [f"the data leave this combination open: {text}" for text in calibration.identifiability.open]
    if not reasons:
        return []
    further = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    text = f"{'' if calibration.converged else 'not converged: '}{plain(reasons[0], 300)}{further}"
    return textwrap.wrap(text[0].upper() + text[1:], int(figure.get_size_inches()[0] * 14))


def flat_draws(draws: np.ndarray) -> np.ndarray:
    """Draws of all chains in one row, thinned to at most `MAX_DRAWS`."""
    row = np.asarray(draws, float).ravel()
    return row[:: max(1, -(-len(row) // MAX_DRAWS))]


def density(draws: np.ndarray, x: np.ndarray, *, positive: bool = False, log: bool = False) -> np.ndarray:
    """Kernel density of draws at x, over its largest value there.

    Args:
        draws: any shape.
        x: where, in order.
        positive: draws cannot be negative and may pile up at 0, where the kernel is reflected.
        log: draws are positive and skewed: the kernel is even in the logarithm.
    """
    from scipy.stats import gaussian_kde

    row = flat_draws(draws)
    if log:
        at = np.maximum(x, 1e-300)
        values = np.where(x > 0, gaussian_kde(np.log(row))(np.log(at)) / at, 0.0)
    elif positive:
        kernel = gaussian_kde(row)
        values = np.where(x >= 0, kernel(x) + kernel(-x), 0.0)
    else:
        values = gaussian_kde(row)(x)
    return values / max(float(values.max()), 1e-300)


def with_sd(value: float, sd: float) -> str:
    """A number and its standard deviation, to two digits of the latter."""
    if not (np.isfinite(sd) and sd > 0):
        return f"{value:.4g}"
    digits = 1 - int(np.floor(np.log10(sd)))
    if digits > 6:
        return f"{value:.2g} ± {sd:.1g}"
    return f"{value:.{max(digits, 0)}f} ± {sd:.{max(digits, 0)}f}"
