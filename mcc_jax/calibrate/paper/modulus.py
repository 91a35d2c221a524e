"""The effective modulus from the unloading branches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from ... import arguments
from ..._format import described
from ..._types import Scalar
from ...campaign import Adjustment, Campaign, Curve, Segment, check_campaign, stress_and_strain
from ...formulas import recovery
from ...law import StrainScaling, Unloading
from ..settings import PAPER
from ..sharding import filled_rows

MIN_RATIO = PAPER.unloaded_from


BRANCHES = "Take those of mcc_jax.calibrate.campaign_branches(campaign, adjustment)."


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
        Branches with at least five points between `MIN_RATIO` and the peak.
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
        points = points[(stress[points] > MIN_RATIO * top) & (stress[points] <= top)]
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
    check_campaign(campaign)
    arguments.instance(adjustment, Adjustment, "adjustment", "Take mcc_jax.adjust(campaign).")
    return [
        branch
        for i in np.flatnonzero(adjustment.kept)
        for branch in elastic_branches(
            int(i), campaign.curves[i], campaign.diameters_um[i], adjustment.segments[i], float(adjustment.shift[i])
        )
    ]


def recoverable_strain(
    log_modulus: Scalar,
    stress_max: Float[Array, " branches"],
    strain_max: Float[Array, " branches"],
    shape_power: Float[Array, " branches"],
    unloading: Unloading,
) -> Float[Array, " branches"]:
    """Recoverable strain from the *measured* peak of each branch, whatever the loading law."""
    modulus = jnp.exp(log_modulus)
    if unloading is Unloading.PRINTED:
        return jnp.sqrt(stress_max / (unloading.constant * modulus * shape_power * strain_max))
    return stress_max / (modulus * jnp.sqrt(unloading.constant * shape_power * strain_max))


@partial(jax.jit, static_argnames="unloading")
def _fit(
    start: Scalar,
    stress_max: Float[Array, " branches"],
    strain_max: Float[Array, " branches"],
    shape_power: Float[Array, " branches"],
    strain: Float[Array, " points"],
    ratio: Float[Array, " points"],
    branch: Int[Array, " points"],
    counted: Float[Array, " points"],
    *,
    unloading: Unloading,
):
    released, count = recovery(ratio), len(stress_max)
    points = jnp.maximum(jax.ops.segment_sum(counted, branch, count), 1.0)

    def about_mean_of_branch(values):
        """Each value less the mean of its branch; nothing where it only fills up."""
        mean = jax.ops.segment_sum(counted * values, branch, count) / points
        return counted * (values - mean[branch])

    def residuals(log_modulus, _):
        delta = recoverable_strain(log_modulus, stress_max, strain_max, shape_power, unloading)
        # The zero of every branch is free; least squares over it is the branch's mean.
        return about_mean_of_branch(strain - (strain_max[branch] - delta[branch] * released))

    # Each branch alone, from the slope of strain over the recovery curve: linear, so in closed form.
    centred = about_mean_of_branch(released)
    slope = -jax.ops.segment_sum(strain * centred, branch, count) / jax.ops.segment_sum(centred**2, branch, count)
    unit = recoverable_strain(jnp.zeros_like(start), stress_max, strain_max, shape_power, unloading)
    exponent = 2 if unloading is Unloading.PRINTED else 1
    alone = (unit / jnp.where(slope > 0, slope, jnp.nan)) ** exponent
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)
    first = jnp.where(jnp.isfinite(jnp.nanmedian(alone)), jnp.log(jnp.nanmedian(alone)), start)
    solution = optx.least_squares(residuals, solver, first, max_steps=200, throw=False)
    final = residuals(solution.value, None)
    rms = jnp.sqrt(jnp.sum(final**2) / jnp.sum(counted))
    return solution.value, rms, alone, solution.result == optx.RESULTS.successful


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
    for one in arguments.instance(branches, Sequence, "branches", BRANCHES):
        arguments.instance(one, ElasticBranch, "every one of branches", BRANCHES)
    shape_factor = arguments.floats(shape_factor, "shape_factor", shape="a shape factor for every particle")
    branches = tuple(branches)
    if not branches:
        return ElasticFit(None, np.nan, np.empty(0), (), False, "no unloading branch was measured")
    index = np.concatenate([np.full(len(b.strain), i) for i, b in enumerate(branches)])
    top = np.array([b.stress_max_MPa for b in branches])
    stress = np.concatenate([b.stress_MPa for b in branches])
    eta = np.asarray(shape_factor)[[b.particle for b in branches]]
    of_branches = (top, np.array([b.strain_max for b in branches]), eta**strain_scaling.power)
    of_points = (np.concatenate([b.strain for b in branches]), stress / top[index], index)
    # Copies of the last branch and point, of which none counts, so that campaigns share one compilation.
    rows, points = filled_rows(len(top)), 1 << (len(index) - 1).bit_length()
    at = np.minimum(np.arange(points), len(index) - 1)
    value, rms, alone, converged = _fit(
        jnp.log(jnp.asarray(1e4)),
        *(jnp.asarray(x[rows], float) for x in of_branches),
        *(jnp.asarray(x[at]) for x in of_points),
        jnp.asarray(np.arange(points) < len(index), float),
        unloading=unloading,
    )
    alone = np.asarray(alone)[: len(branches)]
    modulus = float(jnp.exp(value))
    if not (np.isfinite(modulus) and modulus > 0):
        return ElasticFit(None, np.nan, alone, branches, False, "strain does not fall on unloading")
    reason = "" if converged else "the optimiser did not meet its tolerances within 200 steps"
    return ElasticFit(modulus, float(rms), alone, branches, bool(converged), reason)


def collapsed_branches(
    fit: ElasticFit, shape_factor: np.ndarray, unloading: Unloading, strain_scaling: StrainScaling
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Recovered over recoverable strain, and stress over peak stress, of every branch under the fitted modulus [-].

    The zero of each branch is the one that the fit leaves free. Arguments as in `fit_effective_modulus`.
    """
    if fit.effective_modulus_MPa is None:
        return []
    top, deepest, eta = jnp.asarray(
        [(b.stress_max_MPa, b.strain_max, shape_factor[b.particle]) for b in fit.branches]
    ).T
    log_modulus = jnp.log(jnp.asarray(float(fit.effective_modulus_MPa)))
    delta = np.asarray(recoverable_strain(log_modulus, top, deepest, eta**strain_scaling.power, unloading))
    ratios = [b.stress_MPa / b.stress_max_MPa for b in fit.branches]
    # All branches in one call: every new length would be compiled anew.
    released = np.split(
        np.asarray(jax.jit(recovery)(jnp.asarray(np.concatenate(ratios)))), np.cumsum([len(r) for r in ratios])[:-1]
    )
    recovered = [(b.strain_max - b.strain) / d for b, d in zip(fit.branches, delta, strict=True)]
    return [(m - np.mean(m - s), r) for m, s, r in zip(recovered, released, ratios, strict=True)]
