"""Every particle against the calibrated law: what was measured, what the law says, what is left."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._format import described
from ...campaign import Adjustment, Campaign, effective_diameter_um, particle_batch, stress_and_strain
from ...law import MccLaw, Plastic
from ..curves import responses
from ..data import padded_length, records_of
from ..sharding import filled_rows
from .loading import fit_polynomial


@dataclass(frozen=True)
class ParticleFit:
    """One particle against the calibrated law.

    Attributes:
        plastic: C1, C3, C5 of this particle's own adjusted loading curve, under the common `a`.
        zero_um: what the offset step, and the contact point, take off its displacement [um].
        measured_um: measured displacement less `zero_um` [um], at every point.
        predicted_um: displacement under the measured force by the mean law, scaled by this particle's size and shape
            [um].
        own_um: the same with the particle's own C1, C3, C5.
        used: which points enter `rms_um`: those after contact and above the threshold that may be compared.
        rms_um: root mean square of measured less predicted [um].
        own_rms_um: the same with its own coefficients [um].
    """

    plastic: tuple[float, float, float]
    zero_um: float
    measured_um: np.ndarray
    predicted_um: np.ndarray
    own_um: np.ndarray
    used: np.ndarray
    rms_um: float
    own_rms_um: float

    __repr__ = described()

    @property
    def range_um(self) -> float:
        """Range of the measured displacement where it is compared [um]."""
        return float(np.ptp(self.measured_um[self.used]))


def predict_particles(
    campaign: Campaign, adjustment: Adjustment, law: MccLaw, eta: np.ndarray
) -> tuple[ParticleFit | None, ...]:
    """Every kept particle's displacement under its measured force, by the mean law and by its own coefficients.

    `eta` are the shape factors of all particles, shape (N,). One entry per particle, None where it was not kept.
    """
    kept = np.flatnonzero(adjustment.kept)
    own = []
    for i in kept:
        curve = adjustment.curves[i]
        assert curve is not None
        # Residuals are relative: below a fiftieth of the peak they would be those of the force read-out.
        use = curve.stress_MPa >= max(adjustment.threshold_MPa, 0.02 * curve.stress_max_MPa)
        own.append(fit_polynomial(eta[i] * curve.strain[use], curve.stress_MPa[use]))
    # Campaigns of similar size and length share one compilation.
    rows = filled_rows(len(kept))
    points = [np.arange(len(campaign.curves[i])) for i in kept]
    longest = padded_length(max(map(len, points)))
    record = records_of(campaign, kept.tolist(), adjustment.segments, points, longest).record
    records = jax.tree.map(lambda x: np.asarray(x)[rows], record)
    sizes = particle_batch(campaign.diameters_um[kept[rows]])
    plastic = eqx.filter_vmap(Plastic.from_polynomial)(*jnp.asarray(np.array(own)[rows].T))
    same = eqx.filter_vmap(lambda one: eqx.tree_at(lambda each: each.plastic, law, one))(plastic)
    mean = eqx.filter_vmap(lambda _: law)(plastic.C1)
    by_mean, by_own = (np.asarray(responses(laws, sizes, records)) for laws in (mean, same))
    fits: list[ParticleFit | None] = [None] * len(campaign)
    for row, i in enumerate(kept):
        curve = campaign.curves[i]
        stress, strain = stress_and_strain(curve, campaign.diameters_um[i], adjustment.segments[i])
        measured = (strain + adjustment.shift[i]) * effective_diameter_um(campaign.diameters_um[i])
        touching = np.ones(len(curve), bool)
        for segment in adjustment.segments[i]:
            if segment.kind == "approach":
                touching[segment.start : segment.stop] = False
        used = touching & (stress > max(adjustment.threshold_MPa, 0.02 * stress.max())) & curve.compared
        predicted, with_own = by_mean[row, : len(curve)], by_own[row, : len(curve)]
        fits[i] = ParticleFit(
            (float(plastic.C1[row]), float(plastic.C3[row]), float(plastic.C5[row])),
            float(curve.displacement_um[0] - measured[0]),
            measured,
            predicted,
            with_own,
            used,
            _rms(measured - predicted, used),
            _rms(measured - with_own, used),
        )
    return tuple(fits)


def _rms(deviation: np.ndarray, used: np.ndarray) -> float:
    return float(np.sqrt(np.mean(deviation[used] ** 2))) if used.any() else float("nan")
