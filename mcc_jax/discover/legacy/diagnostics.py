"""The gate that draws must pass, and the population's draws as result files hold them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ...calibrate.estimates import summary
from .population import COEFFICIENTS, Population

RHAT_MOST = 1.01
ESS_LEAST = 400.0
"""The gate: R-hat at most, bulk ESS at least, no divergence, Pareto k at most `PARETO_K_MOST` (Vehtari et al. 2021,
2024)."""


class Worst(NamedTuple):
    """The parameter that a diagnostic is worst for, and its value."""

    name: str
    value: float


def population_json(draws: Population) -> dict[str, Any]:
    """a, modulus, means and spreads of log C1, log C3, log C5, as they stand in result files."""
    mu, tau = np.asarray(draws.mu), np.asarray(draws.tau)
    return {
        "a": summary(np.asarray(draws.a)),
        "effective_modulus_MPa": summary(np.exp(np.asarray(draws.log_modulus))),
        **{
            f"log_{name}": {"mean": summary(mu[..., j]), "sd": summary(tau[..., j])}
            for j, name in enumerate(COEFFICIENTS)
        },
    }


def unmixed(rhat: Mapping[str, float], ess_bulk: Mapping[str, float]) -> tuple[Worst | None, Worst | None]:
    """The largest R-hat and the smallest bulk ESS; None for what passes the gate."""
    slowest = max(rhat, key=lambda name: rhat[name])
    fewest = min(ess_bulk, key=lambda name: ess_bulk[name])
    return (
        None if rhat[slowest] <= RHAT_MOST else Worst(slowest, rhat[slowest]),
        None if ess_bulk[fewest] >= ESS_LEAST else Worst(fewest, ess_bulk[fewest]),
    )
