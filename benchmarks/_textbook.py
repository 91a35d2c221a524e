"""What the two textbook hierarchical calibrations share: data, law, priors' constants, time budget and summary.

Model: stress on load and unload is normal about the printed law with one noise, log C1, log C3 and log C5 of each
particle are normal about a population, the shape parameter and the effective modulus are common to all. The zero of the
instrument is taken as known and the largest strain so far as measured, so that the law is explicit in displacement.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from mcc_jax.campaign import Campaign, campaign_segments, effective_diameter_um, stress_and_strain

TERMS = (1, 3, 5)
"""j of the coefficients C_j."""
CENTRE = {1: np.log(5.0), 3: np.log(3.0), 5: np.log(2.7)}
"""Mean of the prior of mu_j; its standard deviation is 1."""
POPULATION = ("a", "Ebar", "mu_1", "mu_3", "mu_5", "tau_1", "tau_3", "tau_5", "noise")
"""What all particles share: a [-], Ebar [MPa], mean and spread of log C_j, noise of stress [MPa]."""
COEFFICIENTS = ("C1", "C3", "C5")
"""What each particle has of its own."""

MIN_STRESS_MPA = 0.2
MIN_SHARE_OF_PEAK = 0.05


@dataclass(frozen=True)
class TextbookData:
    """Stress over strain of N tests, padded to K points with their last one.

    Attributes:
        flatness: 1 - D3^2 / (D1 D2) [-], shape (N,).
        strain: effective strain [-], shape (N, K).
        strain_max: largest strain so far in the whole record [-], shape (N, K).
        stress: effective stress [MPa], shape (N, K).
        mask: whether a point was measured, shape (N, K).
    """

    flatness: np.ndarray
    strain: np.ndarray
    strain_max: np.ndarray
    stress: np.ndarray
    mask: np.ndarray


def data_from_campaign(campaign: Campaign, *, points: int = 180, zero_um: np.ndarray | float = 0.0) -> TextbookData:
    """Points above 0.2 MPa on loading and above 5 % of the peak on unloading, every so many of them.

    Args:
        campaign: the tests, simulated, so that their zero is known.
        points: the most points to keep of one particle, evenly spread over those that qualify.
        zero_um: the instrument's zero of each particle [um], which is subtracted; `paper_campaign` has 0.
    """
    rows = []
    zeros = np.broadcast_to(zero_um, len(campaign))
    for curve, diameters, segments, zero in zip(
        campaign.curves, campaign.diameters_um, campaign_segments(campaign), zeros, strict=True
    ):
        stress, _ = stress_and_strain(curve, diameters, segments)
        strain = (curve.displacement_um - zero) / effective_diameter_um(diameters)
        elastic = np.zeros(len(curve), bool)
        for segment in segments:
            elastic[segment.start : segment.stop] = segment.kind in ("unload", "reload")
        fit = np.flatnonzero(stress > np.where(elastic, MIN_SHARE_OF_PEAK * stress.max(), MIN_STRESS_MPA))
        kept = fit[np.linspace(0, len(fit) - 1, min(points, len(fit))).round().astype(int)]
        rows.append((strain[kept], np.maximum.accumulate(strain)[kept], stress[kept]))
    lengths = np.array([len(strain) for strain, _, _ in rows])
    longest = lengths.max()
    strain, strain_max, stress = (
        np.stack([np.pad(row[k], (0, longest - len(row[k])), mode="edge") for row in rows]) for k in range(3)
    )
    D1, D2, D3 = campaign.diameters_um.T
    return TextbookData(1 - D3**2 / (D1 * D2), strain, strain_max, stress, np.arange(longest) < lengths[:, None])


def law_stress(xp: ModuleType, data: TextbookData, a: Any, Ebar: Any, C1: Any, C3: Any, C5: Any) -> Any:
    """Stress [MPa] of every point by the printed law, raw scaling.

    Without the limit of what a contact recovers, which would only add work: every point that is unloaded comes from a
    peak strain of 0.3 or more, and there the limit matters for moduli of a few MPa alone.

    Args:
        xp: the array library: `numpy`, `jax.numpy` or `pytensor.tensor`.
        data: sizes and strains.
        a: shape parameter [-].
        Ebar: effective modulus [MPa].
        C1: coefficient of each particle, shape (N,); likewise C3 and C5.
        C3: see C1.
        C5: see C1.
    """
    x = (1 + a * data.flatness)[:, None] * data.strain_max
    peak = C1[:, None] * x - (C3[:, None] * x) ** 3 + (C5[:, None] * x) ** 5
    # The floor of delta (1e-6) is far below any real recovery (1e-2); without it a peak stress below zero has no root.
    delta = xp.sqrt(xp.maximum(peak / (4.12 * Ebar * data.strain_max), 1e-12))
    s = (data.strain_max - data.strain) / delta
    released = s >= 1
    inside = xp.where(released, 0.0, s)  # on full release the arc cosine has no derivative
    return peak * xp.where(released, 0.0, 2 / np.pi * (xp.arccos(inside) - inside * xp.sqrt(1 - inside**2)))


def within_budget(run: Callable[..., dict[str, Any]], arguments: tuple[Any, ...], timeout_s: float) -> dict[str, Any]:
    """Call `run` in a fresh process and end that process when the time is up.

    Args:
        run: a function at the top level of its module; it returns `posterior`, `seconds` and `divergences`.
        arguments: what it is called with.
        timeout_s: wall-clock time [s], the start of the process included.

    Returns:
        What `run` returned and `why_not`: None, or a sentence that it did not finish; all else is then None.
    """
    # A pool of one: it hands exceptions through, and leaving the block ends the process.
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        try:
            return {**pool.apply_async(run, arguments).get(timeout_s), "why_not": None}
        except multiprocessing.TimeoutError:
            why_not = f"did not finish in {timeout_s:g} s"
            return {"posterior": None, "seconds": None, "divergences": None, "why_not": why_not}


def summary(posterior: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """One row per population parameter: mean, sd, bulk ESS, R-hat and whether R-hat < 1.01 and ESS > 400.

    Args:
        posterior: draws by name, shape (chains, draws).
    """
    from arviz_stats import ess, rhat

    rows = []
    for name in POPULATION:
        draws = np.asarray(posterior[name], float)
        size, mixing = float(ess(draws, method="bulk")), float(rhat(draws, method="rank"))
        rows.append(
            {
                "parameter": name,
                "mean": float(draws.mean()),
                "sd": float(draws.std(ddof=1)),
                "ess_bulk": size,
                "rhat": mixing,
                "converged": mixing < 1.01 and size > 400,
            }
        )
    return rows
