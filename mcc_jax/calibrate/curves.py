"""Every test of a campaign next to its calibrated law: what report and figures show, worked out once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from .._format import described
from ..campaign import Campaign, Segment, campaign_segments, particle_batch
from ..effects import Record
from ..geometry import Particle
from ..law import MccLaw
from .compiling import compiled
from .data import MOST_POINTS, padded_length, records_of, rows_from_contact
from .estimates import Variants, laws_of
from .population import COEFFICIENTS
from .sharding import Blocks

KINDS = ("load", "hold", "unload", "reload")


@dataclass(frozen=True)
class FittedCurve:
    """One particle's test from contact on, and what the law says of it; every array of shape (n,).

    Attributes:
        name: of the particle.
        why_not: why it took no part in the calibration; None if it did, or nobody asked.
        time_s, force_mN, displacement_um: measured, raw.
        kind: index into `KINDS`.
        used: which points the calibration compared with the law.
        own_um: displacement by the law with this particle's own coefficients and zero, the mean of the posterior's
            predictions where there are some; NaN where there is none.
        typical_um: with those of the population's middle.
        low_um, high_um: central 95 % of what may be measured; NaN where there is no posterior.
    """

    name: str
    why_not: str | None
    time_s: np.ndarray
    force_mN: np.ndarray
    displacement_um: np.ndarray
    kind: np.ndarray
    used: np.ndarray
    own_um: np.ndarray
    typical_um: np.ndarray
    low_um: np.ndarray
    high_um: np.ndarray

    __repr__ = described()

    @property
    def rms_um(self) -> float | None:
        """Root mean square of measured less predicted at the compared points [um]; None without a prediction."""
        away = (self.displacement_um - self.own_um)[self.used]
        return float(np.sqrt(np.mean(away**2))) if len(away) and np.isfinite(away).all() else None


def measured_curves(campaign: Campaign) -> tuple[FittedCurve, ...]:
    """The tests of a campaign that nobody calibrated."""
    return tuple(
        _measured(campaign, i, parts, *_all_rows(campaign, i, parts))
        for i, parts in enumerate(campaign_segments(campaign))
    )


def fitted_curves(
    content: Mapping[str, Any],
    campaign: Campaign,
    compared: Mapping[int, tuple[np.ndarray, np.ndarray]],
    predictions: Callable[[str], np.ndarray | None],
    variants: Variants | None = None,
) -> tuple[FittedCurve, ...]:
    """The tests of a campaign with what its calibrated law predicts. Needs double precision, as calibration does.

    `compared` are, by place, the rows of the curves of particles that took part, and which of them are compared;
    `predictions` gives draws of what may be measured of a particle at its rows [um].
    """
    segments = campaign_segments(campaign)
    entries = {entry["particle"]: entry for entry in content["particles"]}
    chosen = [compared.get(i) or _all_rows(campaign, i, parts) for i, parts in enumerate(segments)]
    curves = [_measured(campaign, i, parts, *chosen[i]) for i, parts in enumerate(segments)]
    curves = [replace(one, why_not=entries[one.name]["why_not"]) for one in curves]
    known = {n: e["kept"] and all(e[c]["value"] is not None for c in COEFFICIENTS) for n, e in entries.items()}
    rows = [i for i, one in enumerate(curves) if known[one.name]]
    if not rows:
        return tuple(curves)
    # Campaigns of similar size and length share one compilation.
    longest = padded_length(max(len(chosen[i][0]) for i in rows))
    record, _, _ = records_of(campaign, rows, segments, [chosen[i][0] for i in rows], longest)
    sizes = campaign.diameters_um[rows]
    both = laws_of(content, [curves[i].name for i in rows], sizes, variants)
    blocks = Blocks(len(rows))
    own, typical = (np.asarray(blocks.all(responses, (laws, particle_batch(sizes), record))) for laws in both)
    for row, own_um, typical_um in zip(rows, own, typical, strict=True):
        one, zero = curves[row], entries[curves[row].name]["zero_um"]["value"] or 0.0
        length = len(one.kind)
        one = replace(one, own_um=own_um[:length] + zero, typical_um=typical_um[:length] + zero)
        draws = predictions(one.name) if row in compared else None
        if draws is not None:
            # Of two hundred draws mean and standard deviation say the ends of a near-normal band better than quantiles.
            centre, half = draws.mean(0), 1.96 * draws.std(0)
            low, high = (np.where(one.used, centre + sign * half, np.nan) for sign in (-1, 1))
            # Means of coefficients are not the coefficients of the mean.
            one = replace(one, own_um=np.where(one.used, centre, one.own_um), low_um=low, high_um=high)
        curves[row] = one
    return tuple(curves)


def _all_rows(campaign: Campaign, i: int, segments: tuple[Segment, ...]) -> tuple[np.ndarray, np.ndarray]:
    """All rows of a test from contact on, thinned, all of them compared."""
    rows = rows_from_contact(campaign.curves[i], segments, MOST_POINTS)
    return rows, np.ones(len(rows), bool)


def _measured(
    campaign: Campaign, i: int, segments: tuple[Segment, ...], rows: np.ndarray, used: np.ndarray
) -> FittedCurve:
    curve, nothing = campaign.curves[i], np.full(len(rows), np.nan)
    kind = np.zeros(len(curve), int)
    for part in segments:
        kind[part.start : part.stop] = KINDS.index(part.kind) if part.kind in KINDS else 0
    measured = curve.time_s[rows], curve.force_mN[rows], curve.displacement_um[rows]
    return FittedCurve(campaign.particles[i], None, *measured, kind[rows], used, nothing, nothing, nothing, nothing)


@compiled
def responses(laws: MccLaw, particles: Particle, records: Record) -> Array:
    """Displacement [um] of particles by a law each, along a record each, shape (N, points)."""
    return jax.vmap(lambda law, *one: law.respond(*one))(laws, particles, records)
