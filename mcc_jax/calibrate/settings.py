"""Numbers of a calibration that several modules, or other packages, read. All others live next to what reads them.

They have been found by trial on simulated campaigns unless a source is named: `benchmarks/study_posterior.py` (whether
intervals cover), `study_modes.py` (fast against joint), `study_noise.py` and `bench_scale.py` repeat what they rest on.
"""

from __future__ import annotations

from dataclasses import dataclass

MOST_POINTS = 400
"""Longer records are thinned to about so many rows."""

UNLOADED_FROM = 0.05
"""Points of unloading below this share of the peak stress are left out: strain there depends on stress with an infinite
slope."""

READING_UM = 2e-4
"""What no record of displacement is better than [um]: counted as misfit at every point, so that the noise of a record
without any, of a simulation say, is small but not nothing."""


@dataclass(frozen=True)
class SamplingSettings:
    """When a posterior counts as converged: R-hat at most, bulk ESS at least, Pareto k at most (Vehtari et al. 2021,
    2024)."""

    rhat: float = 1.01
    ess: float = 400.0
    pareto_k: float = 0.7


@dataclass(frozen=True)
class JudgementSettings:
    """When an answer must not be called fine.

    Attributes:
        misfit: share of the range of displacement that the law misses with every particle's own coefficients; with the
            law's own data and an instrument's noise it stays below 0.01.
        noise_share: share of the residual's variance that correlated noise holds: at half it is as large as read-out
            noise.
        left: particles, at least, that an answer without the flagged ones rests on.
    """

    misfit: float = 0.05
    noise_share: float = 0.5
    left: int = 3


SAMPLING, JUDGEMENT = SamplingSettings(), JudgementSettings()
