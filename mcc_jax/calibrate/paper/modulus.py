"""The effective modulus from the unloading branches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from ..._format import described
from ...campaign import Adjustment, Campaign, Curve, Segment, stress_and_strain
from ...formulas import recovery
from ...law import StrainScaling, Unloading
from ..data import UNLOADED_FROM


@dataclass(frozen=True)
class ElasticBranch:
    r"""One elastic branch: unloading from a peak and, if any, the reloading that follows, up to further virgin loading.

    Attributes:
        particle: position of the particle in the campaign.
        strain_max: :math:`\epsilon_P` [-], with the offset step applied.
        stress_max_MPa: :math:`\sigma_P` [MPa].
        strain: strains along the branch [-], shape (n,).
        stress_MPa: stresses along it [MPa], shape (n,).
    """

    particle: int
    strain_max: float
    stress_max_MPa: float
    strain: np.ndarray
    stress_MPa: np.ndarray

    __repr__ = described()


@dataclass(frozen=True)
class ElasticFit:
    """A fitted effective modulus.

    Attributes:
        effective_modulus_MPa: the modulus shared by all particles [MPa]; None if no branch could be used.
        rms_strain: root mean square residual [-].
        per_branch_MPa: the modulus that each branch alone would give [MPa].
        branches: the branches used.
        converged: whether the optimiser met its tolerances.
        reason: why there is no modulus or no convergence, in words; empty if all is well.
    """

    effective_modulus_MPa: float | None
    rms_strain: float
    per_branch_MPa: np.ndarray
    branches: tuple[ElasticBranch, ...]
    converged: bool
    reason: str

    __repr__ = described()


def elastic_branches(
    particle: int, curve: Curve, diameters_um: np.ndarray, segments: tuple[Segment, ...], shift: float = 0.0
) -> list[ElasticBranch]:
    """Collect a test's elastic branches.

    Args:
        particle: position in the campaign, kept in the result.
        curve: the test.
        diameters_um: D1, D2, D3 [um].
        segments: the test's segments.
        shift: offset of strain from the offset step [-].

    Returns:
        Branches with at least five points between `UNLOADED_FROM` and the peak.
    """
    stress, strain = stress_and_strain(curve, diameters_um, segments)
    strain = strain + shift
    branches: list[ElasticBranch] = []
    rows: list[np.ndarray] = []
    peak: int | None = None

    def close() -> None:
        if peak is None or not rows:
            return
        # The samples on both sides of the turning point: noise would make their maximum alone too large. One whose
        # force was worked out has no such neighbour.
        around = np.arange(max(peak - 1, 0), peak + 1)
        if curve.worked_out[around].any():
            around = around[curve.worked_out[around]]
        top, deepest = float(stress[around].mean()), float(strain[around].max())
        points = np.concatenate(rows)
        points = points[curve.compared[points]]
        points = points[(stress[points] > UNLOADED_FROM * top) & (stress[points] <= top)]
        if len(points) >= 5 and deepest > 0 and top > 0:
            branches.append(ElasticBranch(particle, deepest, top, strain[points], stress[points]))

    loaded = False
    for segment in segments:
        if segment.kind == "load":
            close()
            rows, peak, loaded = [], None, True
        elif segment.kind in ("unload", "reload") and loaded:
            if peak is None:
                peak = segment.start
            rows.append(np.arange(segment.start, segment.stop))
    close()
    return branches


def campaign_branches(campaign: Campaign, adjustment: Adjustment) -> list[ElasticBranch]:
    """The elastic branches of every particle that the offset step kept, in its adjusted strain."""
    return [
        branch
        for i in np.flatnonzero(adjustment.kept)
        for branch in elastic_branches(
            int(i), campaign.curves[i], campaign.diameters_um[i], adjustment.segments[i], float(adjustment.shift[i])
        )
    ]


def _unit_recoverable(branches: Sequence[ElasticBranch], shape_power: np.ndarray, unloading: Unloading) -> np.ndarray:
    """Recoverable strain from the *measured* peak of each branch at a modulus of 1 MPa, whatever the loading law."""
    top, deepest = np.array([(b.stress_max_MPa, b.strain_max) for b in branches]).T
    if unloading is Unloading.PRINTED:
        return np.sqrt(top / (unloading.constant * shape_power * deepest))
    return top / np.sqrt(unloading.constant * shape_power * deepest)


def _released(branches: Sequence[ElasticBranch]) -> list[np.ndarray]:
    """Recovered share of strain at the measured stresses of each branch."""
    ratio = np.concatenate([b.stress_MPa / b.stress_max_MPa for b in branches])
    # Padded to a power of two: every new length would be compiled again.
    padded = np.pad(ratio, (0, (1 << (len(ratio) - 1).bit_length()) - len(ratio)))
    released = np.asarray(_recovery(jnp.asarray(padded)))[: len(ratio)]
    return np.split(released, np.cumsum([len(b.strain) for b in branches])[:-1])


_recovery = jax.jit(recovery)


def fit_effective_modulus(
    branches: Sequence[ElasticBranch],
    shape_factor: np.ndarray,
    unloading: Unloading = Unloading.PRINTED,
    strain_scaling: StrainScaling = StrainScaling.RAW,
) -> ElasticFit:
    r"""Least squares for one modulus over all elastic branches, in strain at measured stress.

    .. math:: \min_{\bar E,\, o_b} \sum_{b, k} \left[\epsilon_{bk} - o_b - \epsilon_{P,b}
        + \delta_b(\bar E)\, s(\sigma_{bk}/\sigma_{P,b})\right]^2

    with the recoverable strain :math:`\delta_b` of the chosen form at the measured peak, and a free zero :math:`o_b`
    per branch, so that neither the loading law nor the contact point enters.

    Args:
        branches: elastic branches of all particles.
        shape_factor: eta_p of every particle of the campaign, shape (N,); it enters unless the scaling is raw.
        unloading: form of the recoverable strain; the modulus belongs to it.
        strain_scaling: how the shape factor enters.

    References:
        Bommireddy et al. (2018), section 6, eqs. 23 and 24.
    """
    branches = tuple(branches)
    if not branches:
        return ElasticFit(None, np.nan, np.empty(0), (), False, "no unloading branch was measured")
    unit = _unit_recoverable(branches, shape_factor[[b.particle for b in branches]] ** strain_scaling.power, unloading)
    # Strain is linear in c = E^(-1/2) of the printed form, E^-1 of a punch. The free zero of a branch is its mean.
    power = -2 if unloading is Unloading.PRINTED else -1
    strain = [b.strain - b.strain.mean() for b in branches]
    slope = [u * (s.mean() - s) for u, s in zip(unit, _released(branches), strict=True)]
    products = np.array([(x @ y, x @ x) for x, y in zip(slope, strain, strict=True)])
    own, c = products[:, 0] / products[:, 1], products[:, 0].sum() / products[:, 1].sum()
    alone = np.where(own > 0, own, np.nan) ** power
    if not c > 0:
        return ElasticFit(None, np.nan, alone, branches, False, "strain does not fall on unloading")
    residual = np.concatenate(strain) - c * np.concatenate(slope)
    return ElasticFit(float(c**power), float(np.sqrt(np.mean(residual**2))), alone, branches, True, "")


def collapsed_branches(
    fit: ElasticFit, shape_factor: np.ndarray, unloading: Unloading, strain_scaling: StrainScaling
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Recovered over recoverable strain, and stress over peak stress, of every branch under the fitted modulus [-].

    The zero of each branch is the one that the fit leaves free. Arguments as in `fit_effective_modulus`.
    """
    if fit.effective_modulus_MPa is None:
        return []
    eta = np.array([shape_factor[b.particle] for b in fit.branches])
    power = 1 / 2 if unloading is Unloading.PRINTED else 1
    unit = _unit_recoverable(fit.branches, eta**strain_scaling.power, unloading)
    recovered = [
        (b.strain_max - b.strain) / delta
        for b, delta in zip(fit.branches, unit / fit.effective_modulus_MPa**power, strict=True)
    ]
    ratios = [b.stress_MPa / b.stress_max_MPa for b in fit.branches]
    both = zip(recovered, _released(fit.branches), ratios, strict=True)
    return [(m - np.mean(m - s), r) for m, s, r in both]
