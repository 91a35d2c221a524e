"""Two half contacts in series: equal force, one history scalar, derivatives in closed form."""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .. import arguments
from .._errors import InputError
from .._format import described
from .._numerics import recompute
from .._types import Scalar, ScalarLike
from ..formulas import Contact, stored, stress_ratio
from ..formulas.contact import Recovered, falling
from ..formulas.loading_inverse import quintic
from .side import HalfContact

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
    return _larger(*(arguments.values(x, "an overlap [m]") for x in (overlap_max, overlap)))


def _larger(overlap_max: Scalar, overlap: Scalar) -> Scalar:
    return jnp.where(overlap < overlap_max, overlap_max, overlap)


def pair_force(i: HalfContact, j: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> Scalar:
    r"""Repulsive force [N] between two particles, never negative.

    .. math::
        \delta_P = d_i + d_j, \quad F_i(d_i) = F_j(d_j) = F_P, \qquad
        F = F_P\, f(q), \quad q = (\delta_P - \delta) / (\Delta_i + \Delta_j)

    with f of `law.stress_ratio`. The equal-force split is unique where both sides are monotone. Both sides peaked at
    the same force, so they unload by the same share of it, and the largest overlap is all there is to remember. Each
    side recovers no more than its own limit; next to a side that does not give way on loading the other behaves as
    against a wall. Value and first derivatives, in both modes, are finite everywhere; at the onset of unloading the
    derivative is that of loading.

    Args:
        i: one half contact.
        j: the other; exchanging them changes nothing but rounding.
        overlap_max: largest overlap before this one [m], 0 for a virgin contact.
        overlap: overlap now [m]; negative where the particles do not touch.

    Raises:
        InputError: if one side unloads by the printed form and the other by a punch form.
    """
    overlap_max, overlap = _numbers(overlap_max, overlap, i)
    if i.power != j.power:
        raise InputError(
            "a pair whose sides unload by different forms shares no unloading curve",
            remedy="Give both particles the same `unloading` form.",
        )
    peak = _larger(overlap_max, overlap)
    if not (i.effects or j.effects):
        return _series_force(i.at_peak(peak), j.at_peak(peak), peak, peak - overlap)
    series = _series(i.bare, j.bare, peak)  # XLA solves the split once, for here and for the force
    return _series_force(i.at_peak(series.d_i), j.at_peak(series.d_j), peak, peak - overlap)


def wall_force(side: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> Scalar:
    r"""Force [N] of a rigid wall on a particle: the half contact alone, :math:`F = F_P f((d_P - d) / \Delta)`."""
    overlap_max, overlap = _numbers(overlap_max, overlap, side)
    peak = _larger(overlap_max, overlap)
    return side.at_peak(peak).force(peak, peak - overlap)


def pair_split(i: HalfContact, j: HalfContact, overlap: ScalarLike) -> tuple[Scalar, Scalar]:
    """Compressions [m] of the two sides while loading at an overlap [m], and so of the peak of any unloading."""
    series = _series(i.bare, j.bare, _numbers(0.0, overlap, i)[1])
    return series.d_i, series.d_j


def pair_recovery(i: HalfContact, j: HalfContact, overlap_max: ScalarLike) -> Scalar:
    r"""Overlap [m] given back on full release, :math:`\Delta_i + \Delta_j`; arguments as in `pair_force`.

    It is 1 where no force was carried.
    """
    overlap_max, _ = _numbers(overlap_max, 0.0, i)
    return _recovered(i, j, _series(i.bare, j.bare, overlap_max))


def wall_recovery(side: HalfContact, overlap_max: ScalarLike) -> Scalar:
    r"""Overlap [m] that a rigid wall is given back, :math:`\Delta`; see `pair_recovery`."""
    peak, _ = _numbers(overlap_max, 0.0, side)
    return side.at_peak(peak).recovered(peak).span


def pair_energy(i: HalfContact, j: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> ContactEnergy:
    r"""Energy of a contact [J].

    .. math:: W = \sum_s \left(\tfrac12 k_1 d^2 - \tfrac14 k_3 d^4 + \tfrac16 k_5 d^6\right)_s, \quad
        W_{rec} = F_P (\Delta_i + \Delta_j)\, g(q), \quad W_{diss} = W - W_{rec}(q = 0)

    with g of `law.energy_ratio`. Arguments as in `pair_force`.
    """
    overlap_max, overlap = _numbers(overlap_max, overlap, i)
    peak = _larger(overlap_max, overlap)
    series = _series(i.bare, j.bare, peak)
    at_peak, now = stored(series.force, _recovered(i, j, series), peak - overlap)
    return ContactEnergy(now, i.work(series.d_i) + j.work(series.d_j) - at_peak)


def wall_energy(side: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> ContactEnergy:
    """Energy [J] of a contact with a rigid wall; see `pair_energy`."""
    overlap_max, overlap = _numbers(overlap_max, overlap, side)
    peak = _larger(overlap_max, overlap)
    at_peak, now = side.at_peak(peak).stored(peak, peak - overlap)
    return ContactEnergy(now, side.work(peak) - at_peak)


def _numbers(overlap_max: ScalarLike, overlap: ScalarLike, side: HalfContact) -> tuple[Scalar, Scalar]:
    """Both overlaps as arrays, plain numbers in the precision of a side."""

    def array(value: ScalarLike, name: str, least: float) -> Scalar:
        if isinstance(value, jax.Array):
            return value
        return jnp.asarray(arguments.number(value, name, least=least), side.k1.dtype)

    return array(overlap_max, "overlap_max [m]", 0.0), array(overlap, "overlap [m]", -math.inf)


# ---- inside ----------------------------------------------------------------------------------------------------------


class _Series(NamedTuple):
    """Loading of the two sides: compressions, common force."""

    d_i: Scalar
    d_j: Scalar
    force: Scalar


def _recovered(i: HalfContact, j: HalfContact, series: _Series) -> Scalar:
    return i.at_peak(series.d_i).recovered(series.d_i).span + j.at_peak(series.d_j).recovered(series.d_j).span


@jax.custom_jvp
def _series_force(i: Contact, j: Contact, peak: Scalar, drop: Scalar) -> Scalar:
    series = _solve(i, j, peak)
    span = i.recovered(series.d_i).span + j.recovered(series.d_j).span
    return series.force * _ratio(span, drop)[1]


@_series_force.defjvp
def _series_force_jvp(primals, tangents):
    #   dF = f dF_P + F_P f' d(drop) / W + (h / W) sum_s 2 F_P d(span_s),  h = -q f' / 2.
    i, j, peak, drop = primals
    di, dj, dpeak, ddrop = tangents
    series = _series(i, j, peak)
    recovered = i.recovered(series.d_i), j.recovered(series.d_j)
    span = recovered[0].span + recovered[1].span
    q, ratio = _ratio(span, drop)
    q, fall = falling(q)
    h = 0.5 * q * fall
    dd_i, dd_j, dforce = _series_change(i, j, series, di, dj, dpeak)
    widths = _widening(i, di, series.d_i, dd_i, dforce, recovered[0])
    widths = widths + _widening(j, dj, series.d_j, dd_j, dforce, recovered[1])
    carried = series.force > 0
    per_span = recompute(1 / jnp.where(carried, span, 1.0))
    change = ratio * dforce + per_span * (h * widths - series.force * fall * ddrop)
    return series.force * ratio, jnp.where(carried | (drop <= 0), change, 0.0)


def _widening(side: Contact, dside: Contact, d: Scalar, dd: Scalar, dforce: Scalar, recovered: Recovered) -> Scalar:
    """Twice the force times the change of a side's recovered compression."""
    per_span = recompute(recovered.bottom / recovered.top)
    with_force, with_peak, with_slope, with_c = side.growth(d, per_span, recovered.limited, recovered.steep)
    square = d * d
    dslope = dside.k1 - square * (3 * dside.k3 - 5 * square * dside.k5) - d * (6 * side.k3 - 20 * square * side.k5) * dd
    change = with_force * dforce + with_peak * side.secant(d) * dd + with_slope * dslope + with_c * dside.c
    return recovered.span * change


def _explicit(change: Contact, d: Scalar) -> Scalar:
    square = d * d
    return d * (change.k1 - square * (change.k3 - square * change.k5))


def _tangent(side: Contact, d: Scalar) -> Scalar:
    """Slope of a side; where it vanishes (on the verge of not being monotone) a small positive number."""
    floor = jnp.sqrt(jnp.finfo(d.dtype).eps) * side.k1
    slope = side.tangent(d)
    return jnp.where(slope < floor, floor, slope)


def _ratio(span: Scalar, drop: Scalar) -> tuple[Scalar, Scalar]:
    q = recompute(drop / span)
    return q, jnp.where(drop <= 0, 1.0, stress_ratio(q))


@jax.custom_jvp
def _series(i: Contact, j: Contact, overlap: Scalar) -> _Series:
    return _solve(i, j, overlap)


@_series.defjvp
def _series_jvp(primals, tangents):
    i, j, overlap = primals
    di, dj, doverlap = tangents
    series = _series(i, j, overlap)  # not its steps: a second derivative takes this rule again
    return series, _series_change(i, j, series, di, dj, doverlap)


def _series_change(i: Contact, j: Contact, series: _Series, di: Contact, dj: Contact, doverlap: Scalar) -> _Series:
    # With the tangents t of the sides and their explicit changes dF_s at fixed compression,
    #   dF_P = (t_i t_j doverlap + t_j dF_i + t_i dF_j) / (t_i + t_j),   d(d_s) = (dF_P - dF_s) / t_s,
    # and d(d_i) + d(d_j) = doverlap; written without a division by a tangent that may be small.
    t_i, t_j = _tangent(i, series.d_i), _tangent(j, series.d_j)
    change_i, change_j = _explicit(di, series.d_i), _explicit(dj, series.d_j)
    flexibility = recompute(1 / (t_i + t_j))
    return _Series(
        flexibility * (t_j * doverlap + change_j - change_i),
        flexibility * (t_i * doverlap + change_i - change_j),
        flexibility * (t_i * t_j * doverlap + t_j * change_i + t_i * change_j),
    )


def _solve(i: Contact, j: Contact, overlap: Scalar) -> _Series:
    whole = jnp.where(overlap > 0, overlap, 0.0)
    # A barrier closes the iteration, here and within: without, XLA iterates again for each use.
    d = jax.lax.optimization_barrier(_split(i, j, whole))
    # One more step, on both sides separately: beside a side much stiffer, what is left of the overlap has no digits.
    rest = whole - d
    force_i, force_j = i.loading(d), j.loading(rest)
    t_i, t_j = _tangent(i, d), _tangent(j, rest)
    flexibility = recompute(1 / (t_i + t_j))
    change = flexibility * (force_i - force_j)
    return _Series(d - change, rest + change, flexibility * (t_j * force_i + t_i * force_j))


def _split(i: Contact, j: Contact, whole: Scalar) -> Scalar:
    """Compression of i at equal force, by Newton's method with the curvature (Halley), kept between bounds.

    Most contacts are done after a fixed number of steps, which compile to one loop over the data with one result. A
    split that still moves leaves it with a negative sign, and goes on between new bounds.
    """
    zero = jnp.zeros_like(whole)
    bracket = _Bracket(-recompute(j.k1 / (i.k1 + j.k1)) * whole, zero, whole)
    for _ in range(SPLIT_STEPS):
        bracket = _halley_step(i, j, whole, bracket)
    d = jax.lax.optimization_barrier(bracket.d)

    def unfinished(carry: tuple[Array, _Bracket]) -> Array:
        step, bracket = carry
        return (bracket.d < 0) & (step < SPLIT_STEPS_AT_MOST)

    def further(carry: tuple[Array, _Bracket]) -> tuple[Array, _Bracket]:
        step, bracket = carry
        return step + 1, _halley_step(i, j, whole, bracket)

    start = jnp.asarray(SPLIT_STEPS, jnp.int32), _Bracket(d, zero, whole)
    return jnp.abs(jax.lax.while_loop(unfinished, further, start)[1].d)


class _Bracket(NamedTuple):
    """Compression of one side, negative while it moves by more than rounding, and what its size lies between."""

    d: Scalar
    low: Scalar
    high: Scalar


def _halley_step(i: Contact, j: Contact, whole: Scalar, bracket: _Bracket) -> _Bracket:
    """One bracketed Halley step. A split that meets the force but for rounding stays: the bounds would throw it out."""
    d, low, high = jnp.abs(bracket.d), bracket.low, bracket.high
    force_i, slope_i, bend_i = quintic(i.k1, i.k3, i.k5, d)
    force_j, slope_j, bend_j = quintic(j.k1, j.k3, j.k5, whole - d)
    excess, slope, bend = force_i - force_j, slope_i + slope_j, bend_i - bend_j
    low = jnp.where(excess < 0, d, low)
    high = jnp.where(excess > 0, d, high)
    settled = jnp.abs(excess) <= 4 * jnp.finfo(d.dtype).eps * (jnp.abs(force_i) + jnp.abs(force_j))
    square = slope * slope
    divisor = jnp.maximum(square - excess * bend, 0.5 * square)
    new = d - recompute(excess * slope / jnp.where(divisor > 0, divisor, 1.0))
    new = jnp.where((new < low) | (new > high) | (divisor <= 0), 0.5 * (low + high), new)
    new = jnp.where(settled, d, new)
    # The method cubes the error: after a step of 1e-5 of the smaller side only rounding is left.
    least = 1e-5 * jnp.minimum(new, whole - new) + 2 * jnp.finfo(d.dtype).eps * whole
    return _Bracket(jnp.where(jnp.abs(new - d) > least, -new, new), low, high)
