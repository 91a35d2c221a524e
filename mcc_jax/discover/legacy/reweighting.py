r"""The exact likelihood of many particles together.

The exact weight of a draw of the population is the product of all particles' ratios of exact to quadratic likelihood.
Of many particles the product scatters far more than it says: nearly all of its scatter is that of the particles' own
draws. With the same random numbers for every draw of the population that scatter cancels, and what is left of

.. math:: T(\theta) = \sum_i \log r_i(\theta)

is smooth in :math:`\theta`, and linear over the little that the posterior leaves open: some tens of draws tell it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


def evenly(count: int, some: int) -> np.ndarray:
    """Positions of some of many draws, spread evenly."""
    return np.linspace(0, count - 1, some).astype(int)


class Correction(NamedTuple):
    """What the exact likelihood adds to the log density of the population.

    Attributes:
        log_weight: of every draw, up to a constant.
        error: standard error of its slope, in standard deviations of the posterior by which it would move the means.
    """

    log_weight: np.ndarray
    error: float


PROBES = 25
"""Draws of the population at which the sum of all particles' log ratios is worked out."""


def correction(total: Callable[[int, np.ndarray], np.ndarray], draws: np.ndarray) -> Correction:
    """Regression of the sum of log ratios on the population's parameters, and its prediction for every draw.

    Args:
        total: the sums at the given rows of `draws`, all with the same random numbers, which depend on the first
            argument: 0 or 1.
        draws: of the parameters, shape (draws, parameters).
    """
    rows = evenly(len(draws), PROBES)
    unit, values, _ = np.linalg.svd(draws - draws.mean(0), full_matrices=False)
    # Uncorrelated and of standard deviation 1, so that a slope is the shift of a mean in standard deviations.
    white = unit[:, values > 1e-9 * values[0]] * np.sqrt(len(draws))
    design = np.concatenate([np.ones((len(rows), 1)), white[rows]], 1)
    slopes = np.stack([np.linalg.lstsq(design, total(which, rows), rcond=None)[0][1:] for which in (0, 1)])
    # Two estimates from independent random numbers: half their difference is the standard error of their mean.
    return Correction(white @ slopes.mean(0), float(np.linalg.norm(slopes[0] - slopes[1]) / 2))
