"""Two half contacts in series: equal force, one history scalar, derivatives in closed form."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .. import arguments
from .._errors import InputError
from .._format import described
from .._numerics import shared
from .._types import Scalar, ScalarLike
from ..formulas.branch import branch_force
from ..formulas.loading_inverse import loading_work, quintic, secant_modulus, tangent_modulus
from ..law import energy_ratio, stress_ratio
from .side import HalfContact, Numbers, recovered

SPLIT_STEPS = 2
"""Enough between particles of one law and radii from 80 to 120 um, with one more step on both sides.

Contacts that need more get more, 8 for radii from 20 to 150 um and the paper's scatter; only their batch waits.
"""
SPLIT_STEPS_AT_MOST = 200
"""A bracket is halved down to the last digit in fewer."""


class ContactEnergy(eqx.Module):
    """Energy balance of a contact [J]: work done on it = recoverable + dissipated.

    Attributes:
        recoverable: what it gives back on full release.
        dissipated: what is lost for good; does not change while unloading and reloading.
    """

    recoverable: Scalar
    dissipated: Scalar

    __repr__ = described(recoverable="J", dissipated="J")


def largest_overlap(overlap_max: ScalarLike, overlap: ScalarLike) -> Scalar:
    """The history after this overlap [m]: the larger of both; an overlap that is NaN shows."""
    overlap_max, overlap = (arguments.values(x, "an overlap [m]") for x in (overlap_max, overlap))
    return jnp.where(overlap < overlap_max, overlap_max, overlap)


def pair_force(i: HalfContact, j: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> Scalar:
    r"""Repulsive force between two particles.

    .. math::
        \delta_P = d_i + d_j, \quad F_i(d_i) = F_j(d_j) = F_P, \qquad
        F = F_P\, f(q), \quad q = (\delta_P - \delta) / (\Delta_i + \Delta_j)

    with f of `law.stress_ratio`. The equal-force split is unique where both sides are monotone. Both sides peaked at
    the same force, so they unload by the same share of it, and the largest overlap is all there is to remember.
    Particles that are alike share the overlap in halves. Each side recovers no more than its own
    `law.recovery_limit`, so that no path of a pair gains energy; beside a side that does not give way on loading the
    other behaves as against a wall.

    Args:
        i: one half contact.
        j: the other; exchanging them changes nothing but rounding.
        overlap_max: largest overlap before this one [m], 0 for a virgin contact.
        overlap: overlap now [m]; negative where the particles do not touch.

    Returns:
        Force [N], never negative. Scalar and first derivatives, in both modes, are finite everywhere; at the onset of
        unloading the derivative is that of loading.

    Raises:
        InputError: if one side unloads by the printed form and the other by a punch form.
    """
    if i.power != j.power:
        raise InputError(
            "a pair whose sides unload by different forms shares no unloading curve",
            remedy="Give both particles the same `unloading` form.",
        )
    overlap_max, overlap = _largest(i, overlap_max), _overlap(i, overlap)
    peak = largest_overlap(overlap_max, overlap)
    one, other = _numbers(i), _numbers(j)
    if i.effects or j.effects:  # XLA solves the split once, for here and for the force
        at_peak = _series(one, other, peak)
        one, other = i.numbers(at_peak.d_i), j.numbers(at_peak.d_j)
    return _series_force(i.power, one, other, peak, peak - overlap)


def wall_force(side: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> Scalar:
    r"""Force [N] of a rigid wall on a particle: the half contact alone, :math:`F = F_P f((d_P - d) / \Delta)`.

    Args:
        side: the particle's half contact.
        overlap_max: largest overlap before this one [m].
        overlap: overlap with the wall now [m].
    """
    overlap_max, overlap = _largest(side, overlap_max), _overlap(side, overlap)
    peak = largest_overlap(overlap_max, overlap)
    *loading, c = side.numbers(peak)
    return branch_force(side.power, *loading, shared(1 / c), peak, peak - overlap)


def pair_split(i: HalfContact, j: HalfContact, overlap: ScalarLike) -> tuple[Scalar, Scalar]:
    """Compressions [m] of the two sides while loading at an overlap [m], and so of the peak of any unloading."""
    overlap = _overlap(i, overlap)
    series = _series(_numbers(i), _numbers(j), overlap)
    return series.d_i, series.d_j


def pair_recovery(i: HalfContact, j: HalfContact, overlap_max: ScalarLike) -> Scalar:
    r"""Overlap [m] given back on full release, :math:`\Delta_i + \Delta_j`; arguments as in `pair_force`.

    It is 1 where no force was carried.
    """
    overlap_max = _largest(i, overlap_max)
    return _both_spans(i, j, _series(_numbers(i), _numbers(j), overlap_max))


def wall_recovery(side: HalfContact, overlap_max: ScalarLike) -> Scalar:
    r"""Overlap [m] that a rigid wall is given back, :math:`\Delta`; see `pair_recovery`."""
    overlap_max = _largest(side, overlap_max)
    force = overlap_max * secant_modulus(side.k1, side.k3, side.k5, overlap_max)
    return _span(side, force, overlap_max)


def pair_energy(i: HalfContact, j: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> ContactEnergy:
    r"""Energy of a contact [J].

    .. math:: W = \sum_s \left(\tfrac12 k_1 d^2 - \tfrac14 k_3 d^4 + \tfrac16 k_5 d^6\right)_s, \quad
        W_{rec} = F_P (\Delta_i + \Delta_j)\, g(q), \quad W_{diss} = W - W_{rec}(q = 0)

    with g of `law.energy_ratio`. Arguments as in `pair_force`.
    """
    overlap_max, overlap = _largest(i, overlap_max), _overlap(i, overlap)
    peak = largest_overlap(overlap_max, overlap)
    series = _series(_numbers(i), _numbers(j), peak)
    span = _both_spans(i, j, series)
    return _energy(
        loading_work(i.k1, i.k3, i.k5, series.d_i) + loading_work(j.k1, j.k3, j.k5, series.d_j),
        series.force,
        span,
        peak - overlap,
    )


def wall_energy(side: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> ContactEnergy:
    """Energy [J] of a contact with a rigid wall; see `pair_energy`."""
    overlap_max, overlap = _largest(side, overlap_max), _overlap(side, overlap)
    peak = largest_overlap(overlap_max, overlap)
    force = peak * secant_modulus(side.k1, side.k3, side.k5, peak)
    return _energy(loading_work(side.k1, side.k3, side.k5, peak), force, _span(side, force, peak), peak - overlap)


def _overlap(
    side: HalfContact, overlap: ScalarLike, name: str = "overlap [m]", least: float | int = -math.inf
) -> Scalar:
    """An overlap as an array: a plain number in the precision of the side."""
    if isinstance(overlap, jax.Array):
        return overlap
    return jnp.asarray(arguments.number(overlap, name, least=least), side.k1.dtype)


def _largest(side: HalfContact, overlap_max: ScalarLike) -> Scalar:
    return _overlap(side, overlap_max, "overlap_max [m]", least=0)


# ---- inside ----------------------------------------------------------------------------------------------------------


class _Series(NamedTuple):
    """Loading of the two sides: compressions, common force."""

    d_i: Scalar
    d_j: Scalar
    force: Scalar


def _numbers(side: HalfContact) -> Numbers:
    return Numbers(side.k1, side.k3, side.k5, side.c)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _series_force(power: int, i: Numbers, j: Numbers, peak: Scalar, drop: Scalar) -> Scalar:
    series = _solve(i, j, peak)
    span = recovered(power, i, series.force, series.d_i)[0] + recovered(power, j, series.force, series.d_j)[0]
    return series.force * _ratio(span, drop)[1]


@_series_force.defjvp
def _series_force_jvp(power, primals, tangents):
    #   dF = f dF_P + F_P f' d(drop) / W + (h / W) sum_s 2 F_P d(span_s),  h = -q f' / 2.
    i, j, peak, drop = primals
    di, dj, dpeak, ddrop = tangents
    series = _series(i, j, peak)
    span_i, span_j = (recovered(power, s, series.force, d) for s, d in ((i, series.d_i), (j, series.d_j)))
    span = span_i[0] + span_j[0]
    q, ratio = _ratio(span, drop)
    inside = (q > 0) & (q < 1)
    q = jnp.where(inside, q, 0.0)
    fall = jnp.where(inside, 4 / jnp.pi * shared(jnp.sqrt((1 - q) * (1 + q))), 0.0)  # -f'
    h = 0.5 * q * fall
    dd_i, dd_j, dforce = _series_change(i, j, series, di, dj, dpeak)
    force = series.force
    widths = _widening(power, i, di, force, dforce, series.d_i, dd_i, span_i)
    widths = widths + _widening(power, j, dj, force, dforce, series.d_j, dd_j, span_j)
    carried = series.force > 0
    per_span = shared(1 / jnp.where(carried, span, 1.0))
    change = ratio * dforce + per_span * (h * widths - force * fall * ddrop)
    return force * ratio, jnp.where(carried | (drop <= 0), change, 0.0)


def _widening(power, side, dside, force, dforce, d, dd, recovered):
    """Twice the force times the change of a side's recovered compression, by the formula or at its limit."""
    span, limited, steep = recovered
    secant, square = secant_modulus(side.k1, side.k3, side.k5, d), d * d
    slope = tangent_modulus(side.k1, side.k3, side.k5, d)
    dslope = dside.k1 - square * (3 * dside.k3 - 5 * square * dside.k5) - d * (6 * side.k3 - 20 * square * side.k5) * dd
    formula = shared(force / side.c) * dside.c + power * dforce - secant * dd
    at_limit = jnp.where(steep, 2 * (dforce - shared(force / jnp.where(steep, slope, 1.0)) * dslope), 2 * secant * dd)
    return span * jnp.where(limited, at_limit, formula)


def _explicit(change: Numbers, d: Scalar) -> Scalar:
    square = d * d
    return d * (change.k1 - square * (change.k3 - square * change.k5))


def _tangent(side: Numbers, d: Scalar) -> Scalar:
    """Slope of a side; where it vanishes (on the verge of not being monotone) a small positive number."""
    floor = jnp.sqrt(jnp.finfo(d.dtype).eps) * side.k1
    slope = tangent_modulus(side.k1, side.k3, side.k5, d)
    return jnp.where(slope < floor, floor, slope)


def _span(side: HalfContact, force: Scalar, d: Scalar) -> Scalar:
    return recovered(side.power, side.numbers(d), force, d)[0]


def _both_spans(i: HalfContact, j: HalfContact, series: _Series) -> Scalar:
    return _span(i, series.force, series.d_i) + _span(j, series.force, series.d_j)


def _ratio(span: Scalar, drop: Scalar) -> tuple[Scalar, Scalar]:
    q = shared(drop / span)
    return q, jnp.where(drop <= 0, 1.0, stress_ratio(q))


def _energy(work: Scalar, force: Scalar, span: Scalar, drop: Scalar) -> ContactEnergy:
    q, _ = _ratio(span, drop)
    carried = force > 0
    scale = jnp.where(carried, force * span, 0.0)
    at_peak = scale * energy_ratio(jnp.zeros_like(q))
    now = jnp.where(drop <= 0, at_peak, scale * energy_ratio(q))
    return ContactEnergy(now, work - at_peak)


@jax.custom_jvp
def _series(i: Numbers, j: Numbers, overlap: Scalar) -> _Series:
    return _solve(i, j, overlap)


@_series.defjvp
def _series_jvp(primals, tangents):
    i, j, overlap = primals
    di, dj, doverlap = tangents
    series = _series(i, j, overlap)  # not its steps: a second derivative takes this rule again
    return series, _series_change(i, j, series, di, dj, doverlap)


def _series_change(i: Numbers, j: Numbers, series: _Series, di: Numbers, dj: Numbers, doverlap: Scalar) -> _Series:
    # With the tangents t of the sides and their explicit changes dF_s at fixed compression,
    #   dF_P = (t_i t_j doverlap + t_j dF_i + t_i dF_j) / (t_i + t_j),   d(d_s) = (dF_P - dF_s) / t_s,
    # and d(d_i) + d(d_j) = doverlap; written without a division by a tangent that may be small.
    t_i, t_j = _tangent(i, series.d_i), _tangent(j, series.d_j)
    change_i, change_j = _explicit(di, series.d_i), _explicit(dj, series.d_j)
    flexibility = shared(1 / (t_i + t_j))
    return _Series(
        flexibility * (t_j * doverlap + change_j - change_i),
        flexibility * (t_i * doverlap + change_i - change_j),
        flexibility * (t_i * t_j * doverlap + t_j * change_i + t_i * change_j),
    )


def _solve(i: Numbers, j: Numbers, overlap: Scalar) -> _Series:
    whole = jnp.where(overlap > 0, overlap, 0.0)
    # A barrier closes the iteration, here and within: without, XLA iterates again for each use.
    d = jax.lax.optimization_barrier(_split(i, j, whole))
    # One more step, on both sides separately: beside a side much stiffer, what is left of the overlap has no digits.
    rest = whole - d
    force_i, force_j = (x * secant_modulus(s.k1, s.k3, s.k5, x) for s, x in ((i, d), (j, rest)))
    t_i, t_j = _tangent(i, d), _tangent(j, rest)
    flexibility = shared(1 / (t_i + t_j))
    change = flexibility * (force_i - force_j)
    return _Series(d - change, rest + change, flexibility * (t_j * force_i + t_i * force_j))


def _split(i: Numbers, j: Numbers, whole: Scalar) -> Scalar:
    """Compression of i at equal force, by Newton's method with the curvature (Halley), kept between bounds.

    Most contacts are done after a fixed number of steps, which compile to one loop over the data with one result. A
    split that still moves leaves it with a negative sign, and goes on between new bounds.
    """
    zero = jnp.zeros_like(whole)
    bracket = _Bracket(-shared(j.k1 / (i.k1 + j.k1)) * whole, zero, whole)
    for _ in range(SPLIT_STEPS):
        bracket = _narrowed(i, j, whole, bracket)
    d = jax.lax.optimization_barrier(bracket.d)

    def unfinished(carry: tuple[Array, _Bracket]) -> Array:
        step, bracket = carry
        return (bracket.d < 0) & (step < SPLIT_STEPS_AT_MOST)

    def further(carry: tuple[Array, _Bracket]) -> tuple[Array, _Bracket]:
        step, bracket = carry
        return step + 1, _narrowed(i, j, whole, bracket)

    start = jnp.asarray(SPLIT_STEPS, jnp.int32), _Bracket(d, zero, whole)
    return jnp.abs(jax.lax.while_loop(unfinished, further, start)[1].d)


class _Bracket(NamedTuple):
    """Compression of one side, negative while it moves by more than rounding, and what its size lies between."""

    d: Scalar
    low: Scalar
    high: Scalar


def _narrowed(i: Numbers, j: Numbers, whole: Scalar, bracket: _Bracket) -> _Bracket:
    """One step. A split that meets the force but for rounding stays: asked again, the bounds would throw it out."""
    d, low, high = jnp.abs(bracket.d), bracket.low, bracket.high
    force_i, slope_i, bend_i = quintic(i.k1, i.k3, i.k5, d)
    force_j, slope_j, bend_j = quintic(j.k1, j.k3, j.k5, whole - d)
    excess, slope, bend = force_i - force_j, slope_i + slope_j, bend_i - bend_j
    low = jnp.where(excess < 0, d, low)
    high = jnp.where(excess > 0, d, high)
    settled = jnp.abs(excess) <= 4 * jnp.finfo(d.dtype).eps * (jnp.abs(force_i) + jnp.abs(force_j))
    square = slope * slope
    divisor = jnp.maximum(square - excess * bend, 0.5 * square)
    new = d - shared(excess * slope / jnp.where(divisor > 0, divisor, 1.0))
    new = jnp.where((new < low) | (new > high) | (divisor <= 0), 0.5 * (low + high), new)
    new = jnp.where(settled, d, new)
    # The method cubes the error: after a step of 1e-5 of the smaller side only rounding is left.
    least = 1e-5 * jnp.minimum(new, whole - new) + 2 * jnp.finfo(d.dtype).eps * whole
    return _Bracket(jnp.where(jnp.abs(new - d) > least, -new, new), low, high)
