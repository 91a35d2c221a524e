"""The law between particles: half contacts, two of them in series, and one against a rigid wall."""

from __future__ import annotations

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .. import arguments
from .._errors import InputError
from .._format import described
from .._numerics import recompute
from .._types import Flag, Scalar, ScalarLike, Values
from ..effects import AbstractModulusAtPeak
from ..formulas import Contact, first_gain, stored, stress_ratio
from ..formulas.contact import Recovered, falling
from ..geometry import Particle
from ..law import TESTED_STRAIN, MccLaw
from ..law.response import factor_at_peak, folded

AREA = 1e6 * jnp.pi
"""Area over R_e^2, times what makes N of MPa m^2."""
SPLIT_STEPS = 2
"""Enough for one law and radii from 80 to 120 um; a batch with contacts that need more goes on until all are done."""
SPLIT_STEPS_AT_MOST = 200
"""A bracket is halved down to the last digit in fewer."""


class HalfContact(Contact):
    r"""Half of a plate test: force against the compression d of one side of a particle, towards a rigid flat.

    A `formulas.Contact` in metres and newtons. A particle between two plates is two half contacts in series, each
    compressed by half the platen displacement. Make many with ``equinox.filter_vmap(half_contact)``, pick with
    `sides_of`.

    Attributes:
        k1, k3, k5: initial stiffness [N/m], softening [N/m^3], hardening [N/m^5].
        c: factor of the recovered compression squared, [m^3/N] for n = 1 and [m^3/N^2] for n = 2.
        tested: compression at which the paper's tests ended, eta_p eps = 0.67 [m]; beyond it the law extrapolates.
        power: n, 1 for the printed unloading form and 2 for the punch forms.
        effects: those on the modulus at a peak (damage, densification).
        radius: of curvature R_e [m], where there are such effects: strain is d / R_e, stress F / (pi R_e^2).
    """

    tested: Scalar
    effects: tuple[AbstractModulusAtPeak, ...] = ()
    radius: Scalar | None = None

    __repr__ = described()

    def at_peak(self, d: Values) -> Contact:
        """The contact that unloads from a peak compression [m]: the effects' factor on the modulus is part of c.

        Beyond the tested compression the factor stays as it is there: the recovery limit alone then keeps a contact
        from gaining energy.
        """
        if self.radius is None:
            return self.bare
        d = jnp.where(d < self.tested, jnp.where(d > 0, d, 0.0), self.tested)
        stress = self.loading(d) / (AREA * self.radius * self.radius)
        return self.softened(factor_at_peak(self.effects, d / self.radius, stress))

    @property
    def is_passive(self) -> Flag:
        """Whether the energy it loses grows with its peak, so that no path gains energy. True without effects."""
        return jnp.isinf(first_gain(self.at_peak, self.tested)) if self.effects else jnp.asarray(True)

    @property
    def is_valid(self) -> Flag:
        """Whether stiffness, hardening and recovery are positive, nothing is NaN, and it `is_passive`."""
        return (self.k1 > 0) & (self.k3 >= 0) & (self.k5 > 0) & (self.c > 0) & (self.tested > 0) & self.is_passive


def sides_of(sides: HalfContact, index: Int[Array | np.ndarray, " contacts"]) -> HalfContact:
    """The half contacts of the particles at an index, from a batch with one for each particle."""
    return jax.tree.map(lambda x: x[index], sides)


def passive(sides: HalfContact) -> HalfContact:
    """The half contacts, one or a batch, if no path of theirs gains energy; traced ones pass."""
    if not sides.effects or arguments.is_traced(jax.tree.leaves(sides)):
        return sides
    if not jnp.all(jax.vmap(lambda one: one.is_passive)(sides) if sides.k1.ndim else sides.is_passive):
        names = ", ".join(effect.name for effect in sides.effects)
        problem = f"with {names} a contact would give back more energy than it took"
        raise InputError(problem, remedy="Take a smaller amplitude, or a stiffer effective modulus.")
    return sides


def half_contact(law: MccLaw, particle: Particle, normal: Float[Array, " 3"] | None = None) -> HalfContact:
    r"""Half contact of a particle in a direction, in SI units.

    .. math::
        h(n) = \sqrt{a^2 n_1^2 + b^2 n_2^2 + c^2 n_3^2}, \quad R_e(n) = abc / h^2, \quad
        \eta_p(n) = 1 + a_s (1 - h / R_e)

    .. math:: F(d) = \pi R_e^2\, \sigma(\eta_p d / R_e), \qquad \Delta = R_e\, \delta(\eta_p, d_P / R_e)

    with the semi-axes a, b, c = D1/2, D2/2, D3/2, and :math:`\sigma, \delta` of the law (its `a` is :math:`a_s`). R_e
    is the radius of Gaussian curvature where the tangent plane of the ellipsoid has that normal. Along e3 this is the
    paper's particle exactly (Bommireddy et al. 2018, eqs. 3 to 5, 13, 16 and 24); in other directions it is our own
    generalisation, which no test supports yet. Effects on parameters (size, shape) take the particle as it is tested,
    along D3; those on the modulus take strain and stress of this side at its own peak. Particles of one pair may differ
    in all of their laws but the unloading form. `normal` is a unit vector in the frame of the particle's axes, e3 if
    None. `InputError` names an effect that is no closed formula (`AbstractEffect.closed`), or by which it gains energy.
    """
    semi = 0.5e-6 * jnp.stack([particle.D1, particle.D2, particle.D3])  # m
    square = semi[2] * semi[2] if normal is None else jnp.sum((semi * normal) ** 2)
    radius = recompute(jnp.prod(semi) / square)
    formulas, at_peak = folded(law, law.effects, particle, "the half contact")
    eta = 1 + formulas.a * (1 - recompute(jnp.sqrt(square)) / radius)
    contact = formulas.contact_of_size(AREA, eta, radius, recompute(1 / radius))
    tested = recompute(TESTED_STRAIN * radius / eta)
    numbers = contact.k1, contact.k3, contact.k5, contact.c, tested, at_peak, radius if at_peak else None
    return passive(HalfContact(*numbers, power=contact.power))


class ContactEnergy(eqx.Module):
    """Energy balance of a contact [J]: work done on it is what it gives back on full release and what is lost."""

    recoverable: Scalar
    dissipated: Scalar

    __repr__ = described(recoverable="J", dissipated="J")


def largest_overlap(overlap_max: Values | float, overlap: Values | float) -> Values:
    """The history after this overlap [m]: the larger of both; an overlap that is NaN shows."""
    return jnp.where(overlap < overlap_max, overlap_max, overlap)


def pair_force(i: HalfContact, j: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> Scalar:
    r"""Repulsive force [N] between two particles, never negative.

    .. math::
        \delta_P = d_i + d_j, \quad F_i(d_i) = F_j(d_j) = F_P, \qquad
        F = F_P\, f(q), \quad q = (\delta_P - \delta) / (\Delta_i + \Delta_j)

    with f of `law.stress_ratio`. `overlap_max` is the largest overlap before this one [m], 0 for a virgin contact, and
    `overlap` that of now, negative where the particles do not touch. The equal-force split is unique where both sides
    are monotone. Both sides peaked at the same force, so they unload by the same share of it, and the largest overlap
    is all there is to remember. Each side recovers no more than its own limit. Value and first derivatives, in both
    modes, are finite everywhere; at the onset of unloading the derivative is that of loading.

    Raises:
        InputError: if one side unloads by the printed form and the other by a punch form.
    """
    if i.power != j.power:
        raise InputError(
            "a pair whose sides unload by different forms shares no unloading curve",
            remedy="Give both particles the same `unloading` form.",
        )
    peak, drop = _peak_and_drop(i, overlap_max, overlap)
    if not (i.effects or j.effects):
        return _series_force(i.bare, j.bare, peak, drop)
    series = _series(i.bare, j.bare, peak)  # XLA solves the split once, for here and for the force
    return _series_force(i.at_peak(series.d_i), j.at_peak(series.d_j), peak, drop)


def wall_force(side: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> Scalar:
    r"""Force [N] of a rigid wall on a particle: the half contact alone, :math:`F = F_P f((d_P - d) / \Delta)`."""
    peak, drop = _peak_and_drop(side, overlap_max, overlap)
    return side.at_peak(peak).force(peak, drop)


def pair_split(i: HalfContact, j: HalfContact, overlap: ScalarLike) -> tuple[Scalar, Scalar]:
    """Compressions [m] of the two sides while loading at an overlap [m], and so of the peak of any unloading."""
    series = _series(i.bare, j.bare, _peak_and_drop(i, 0.0, overlap)[0])
    return series.d_i, series.d_j


def pair_recovery(i: HalfContact, j: HalfContact, overlap_max: ScalarLike) -> Scalar:
    r"""Overlap [m] given back on full release, :math:`\Delta_i + \Delta_j`; 1 where no force was carried."""
    peak, _ = _peak_and_drop(i, overlap_max, overlap_max)
    return _recovered(i, j, _series(i.bare, j.bare, peak))


def wall_recovery(side: HalfContact, overlap_max: ScalarLike) -> Scalar:
    r"""Overlap [m] that a rigid wall is given back, :math:`\Delta`; see `pair_recovery`."""
    peak, _ = _peak_and_drop(side, overlap_max, overlap_max)
    return side.at_peak(peak).recovered(peak).span


def pair_energy(i: HalfContact, j: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> ContactEnergy:
    r"""Energy of a contact [J].

    .. math:: W = \sum_s \left(\tfrac12 k_1 d^2 - \tfrac14 k_3 d^4 + \tfrac16 k_5 d^6\right)_s, \quad
        W_{rec} = F_P (\Delta_i + \Delta_j)\, g(q), \quad W_{diss} = W - W_{rec}(q = 0)

    with g of `law.energy_ratio`.
    """
    peak, drop = _peak_and_drop(i, overlap_max, overlap)
    series = _series(i.bare, j.bare, peak)
    at_peak, now = stored(series.force, _recovered(i, j, series), drop)
    return ContactEnergy(now, i.work(series.d_i) + j.work(series.d_j) - at_peak)


def wall_energy(side: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> ContactEnergy:
    """Energy [J] of a contact with a rigid wall; see `pair_energy`."""
    peak, drop = _peak_and_drop(side, overlap_max, overlap)
    at_peak, now = side.at_peak(peak).stored(peak, drop)
    return ContactEnergy(now, side.work(peak) - at_peak)


def _peak_and_drop(side: HalfContact, overlap_max: ScalarLike, overlap: ScalarLike) -> tuple[Scalar, Scalar]:
    """Largest overlap and how far the present one is below it; plain numbers in the precision of a side."""
    largest, now = (x if isinstance(x, jax.Array) else jnp.asarray(x, side.k1.dtype) for x in (overlap_max, overlap))
    peak = largest_overlap(largest, now)
    return peak, peak - now


class _Series(NamedTuple):
    """Loading of the two sides: compressions, common force."""

    d_i: Scalar
    d_j: Scalar
    force: Scalar


def _recovered(i: HalfContact, j: HalfContact, series: _Series) -> Scalar:
    return i.at_peak(series.d_i).recovered(series.d_i).span + j.at_peak(series.d_j).recovered(series.d_j).span


@jax.custom_jvp
def _series_force(i: Contact, j: Contact, peak: Scalar, drop: Scalar) -> Scalar:
    series = _series(i, j, peak)
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
    dslope = dside.tangent(d) + 2 * side.halley(d)[2] * dd
    change = with_force * dforce + with_peak * side.secant(d) * dd + with_slope * dslope + with_c * dside.c
    return recovered.span * change


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
    whole = jnp.where(overlap > 0, overlap, 0.0)
    # A barrier closes the iteration, here and within: without, XLA iterates again for each use.
    d = jax.lax.optimization_barrier(_split(i, j, whole))
    # One more step, on both sides separately: next to a much stiffer side, what is left of the overlap has no digits.
    rest = whole - d
    force_i, force_j = i.loading(d), j.loading(rest)
    t_i, t_j = _tangent(i, d), _tangent(j, rest)
    flexibility = recompute(1 / (t_i + t_j))
    change = flexibility * (force_i - force_j)
    return _Series(d - change, rest + change, flexibility * (t_j * force_i + t_i * force_j))


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
    change_i, change_j = di.halley(series.d_i)[0], dj.halley(series.d_j)[0]
    flexibility = recompute(1 / (t_i + t_j))
    return _Series(
        flexibility * (t_j * doverlap + change_j - change_i),
        flexibility * (t_i * doverlap + change_i - change_j),
        flexibility * (t_i * t_j * doverlap + t_j * change_i + t_i * change_j),
    )


def _split(i: Contact, j: Contact, whole: Scalar) -> Scalar:
    """Compression of i at equal force, by Halley's method kept between bounds.

    Most contacts are done after a fixed number of steps, which compile to one loop over the data with one result. A
    split that still moves leaves it with a negative sign, and goes on between new bounds.
    """
    zero = jnp.zeros_like(whole)
    bracket = _Bracket(-recompute(j.k1 / (i.k1 + j.k1)) * whole, zero, whole, jnp.asarray(0, jnp.int32))
    for _ in range(SPLIT_STEPS):
        bracket = _halley_step(i, j, whole, bracket)
    bracket = bracket._replace(d=jax.lax.optimization_barrier(bracket.d), low=zero, high=whole)

    def unfinished(bracket: _Bracket) -> Flag:
        return (bracket.d < 0) & (bracket.steps < SPLIT_STEPS_AT_MOST)

    return jnp.abs(jax.lax.while_loop(unfinished, functools.partial(_halley_step, i, j, whole), bracket).d)


class _Bracket(NamedTuple):
    """Compression of one side, negative while it moves by more than rounding, what its size lies between, and steps."""

    d: Scalar
    low: Scalar
    high: Scalar
    steps: Int[Array, ""]


def _halley_step(i: Contact, j: Contact, whole: Scalar, bracket: _Bracket) -> _Bracket:
    """One bracketed Halley step. A split that meets the force but for rounding stays: the bounds would throw it out."""
    d, low, high = jnp.abs(bracket.d), bracket.low, bracket.high
    force_i, slope_i, bend_i = i.halley(d)
    force_j, slope_j, bend_j = j.halley(whole - d)
    excess, slope, bend = force_i - force_j, slope_i + slope_j, bend_i - bend_j
    low = jnp.where(excess < 0, d, low)
    high = jnp.where(excess > 0, d, high)
    meets = jnp.abs(excess) <= 4 * jnp.finfo(d.dtype).eps * (jnp.abs(force_i) + jnp.abs(force_j))
    square = slope * slope
    divisor = jnp.maximum(square - excess * bend, 0.5 * square)
    new = d - recompute(excess * slope / jnp.where(divisor > 0, divisor, 1.0))
    new = jnp.where((new < low) | (new > high) | (divisor <= 0), 0.5 * (low + high), new)
    new = jnp.where(meets, d, new)
    # The method cubes the error: after a step of 1e-5 of the smaller side only rounding is left.
    least = 1e-5 * jnp.minimum(new, whole - new) + 2 * jnp.finfo(d.dtype).eps * whole
    return _Bracket(jnp.where(jnp.abs(new - d) > least, -new, new), low, high, bracket.steps + 1)
