r"""The law of one contact: four numbers and the largest displacement so far, in any consistent units.

.. math::
    F &= k_1 \gamma - k_3 \gamma^3 + k_5 \gamma^5 && \text{loading}, \quad \gamma \ge \gamma_P \\
    F &= F_P\, f(s), \quad s = (\gamma_P - \gamma) / \Delta && \text{unloading and reloading} \\
    f(s) &= \tfrac{2}{\pi} \left[\arccos s - s \sqrt{1 - s^2}\right] \\
    \Delta^2 &= c\, (F_P / \gamma_P)^n\, \gamma_P^{n-1} && \text{recovered on full release},
        \quad \Delta \le \min\left(\gamma_P,\ \tfrac{3\pi}{8}\, F_P \Big/ \frac{dF}{d\gamma}\Big|_P\right)

Without the limit a release could give back more than loading took, at small peaks by the printed form, with a soft
modulus by every form. With it no cycle of any path gains energy; the proof is in the documentation, "The law". In a
pair each side has its own limit; the sides carry one force, so energies add.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._numerics import horner, recompute, rough_power, running_max, two_thirds_power
from .._types import Flag, Path, Scalar, Values

SHARE = 3 * math.pi / 8
r"""Largest :math:`\Delta F'/F_P`. Elastic energy is :math:`\tfrac{4}{3\pi} F_P \Delta`; with it :math:`F^2/(2F')`."""
PEAKS = 256  # evenly spread, at which `first_gain` compares what is lost with the peak before
HALLEY_STEPS = 4  # meet the last digit in every case tried: k3 = 0, loss of monotonicity, peaks approached to 1e-14

Flags = Bool[Array, "..."]


class Quintic(eqx.Module):
    """:math:`k_1 x - k_3 x^3 + k_5 x^5`, force against displacement or stress against scaled strain.

    Never below zero: pushing a particle together cannot pull. The bare quintic would where k3^2 > 4 k1 k5.
    """

    k1: Values
    k3: Values
    k5: Values

    def secant(self, x: Values) -> Values:
        """Value over x, as a polynomial: finite at x = 0, where their quotient is not."""
        square = x * x
        value = self.k1 - square * (self.k3 - square * self.k5)
        return jnp.where(value < 0, 0.0, value)  # this way round a parameter that is NaN shows

    def tangent(self, x: Values) -> Values:
        """Slope of the bare quintic."""
        square = x * x
        return self.k1 - square * (3 * self.k3 - 5 * square * self.k5)

    def loading(self, x: Values) -> Values:
        """Force or stress of loading."""
        return x * self.secant(x)

    def work(self, x: Values) -> Values:
        """Integral of loading. The stretch that is cut off ends at roots: derivatives do not depend on its ends."""

        def integral(square: Values) -> Values:
            return square * (self.k1 / 2 - square * (self.k3 / 4 - square * self.k5 / 6))

        square = x * x
        discriminant = self.k3 * self.k3 - 4 * self.k1 * self.k5
        pulls = discriminant > 0
        larger = jnp.where(pulls, self.k3 + jnp.sqrt(jnp.where(pulls, discriminant, 1.0)), 1.0)
        begin, end = jax.lax.stop_gradient((2 * self.k1 / larger, larger / jnp.where(pulls, 2 * self.k5, 1.0)))
        before = integral(jnp.where(pulls & (square > begin), begin, square))
        return before + jnp.where(pulls & (square > end), integral(square) - integral(end), 0.0)

    @property
    def is_monotone(self) -> Flag:
        r"""Whether loading never falls: :math:`9 k_3^2 \le 20 k_1 k_5`. It does in 2.4 % of the paper's draws."""
        return 9 * self.k3 * self.k3 <= 20 * self.k1 * self.k5

    def halley(self, x: Values) -> tuple[Values, Values, Values]:
        """Value, slope and half the curvature of the bare quintic: what a step of Halley's method takes."""
        square = x * x
        hardening = square * self.k5
        value = x * (self.k1 - square * (self.k3 - hardening))
        return value, self.k1 - square * (3 * self.k3 - 5 * hardening), x * (10 * hardening - 3 * self.k3)


# ---- the elastic branch in one variable ------------------------------------------------------------------------------

# With s, linear in strain, instead of the paper's phi = sqrt(1 - s^2), which loses all digits near both ends and has no
# derivative at the onset, every function is an exact power of the distance to the singular end times a polynomial.
# Accuracy: 4e-16 of the peak in float64, 2e-7 in float32.


@jax.custom_jvp
def stress_ratio(s: Values | float) -> Values:
    r"""Stress over peak stress :math:`f(s)` [-] after a share s of the strain is recovered: 1 for s <= 0, 0 for s >= 1.

    Derivative :math:`-\tfrac{4}{\pi}\sqrt{1 - s^2}` on 0 <= s < 1, else 0. Bommireddy et al. (2018), eq. 23, with
    phi^2 = 1 - s^2.
    """
    u = jnp.clip(1 - s, 0, 1)
    return u * recompute(jnp.sqrt(u)) * horner(RATIO_64 if u.dtype == jnp.float64 else RATIO_32, 2 * u - 1)


@stress_ratio.defjvp
def _stress_ratio_jvp(primals, tangents):
    (s,), (ds,) = primals, tangents
    inside = (s >= 0) & (s < 1)
    chord = jnp.where(inside, (1 - s) * (1 + s), 1.0)
    return stress_ratio(s), jnp.where(inside, -4 / jnp.pi * recompute(jnp.sqrt(chord)), 0.0) * ds


@jax.custom_jvp
@jax.jit  # traced once for all its users
def recovery(ratio: Values | float) -> Values:
    r"""Inverse of `stress_ratio`: the recovered share of strain [-] at a share of the peak stress.

    Solves Kepler's equation of eccentricity 1, :math:`E - \sin E = \pi\,\sigma/\sigma_P` with :math:`s = \cos(E/2)`, in
    closed form: 1 for ratio <= 0, 0 for ratio >= 1. The derivative grows as ratio^(-1/3) towards full release and is 0
    beyond it.
    """
    r = jnp.clip(ratio, 0, 1)
    w = two_thirds_power(r)
    rest = recompute((1 - r) * (1 + r) / (1 + w * (1 + w)))  # 1 - w, all digits kept towards the peak
    return jnp.clip(rest * horner(RECOVERY_64 if w.dtype == jnp.float64 else RECOVERY_32, 2 * w - 1), 0, 1)


@recovery.defjvp
def _recovery_jvp(primals, tangents):
    (ratio,), (dratio,) = primals, tangents
    s = recovery(ratio)
    inside = (ratio > 0) & (ratio <= 1) & (s < 1)
    chord = jnp.where(inside, (1 - s) * (1 + s), 1.0)
    return s, jnp.where(inside, recompute(-jnp.pi / 4 / jnp.sqrt(chord)), 0.0) * dratio


@jax.custom_jvp
def energy_ratio(s: Values | float) -> Values:
    r"""Elastic energy [-] still stored at a recovered share s, over :math:`\sigma_P \delta`: 4/(3 pi) at the onset.

    .. math:: g(s) = \int_s^1 f = \tfrac{2}{\pi}\left[\sqrt{1 - s^2} - s\arccos s - \tfrac13 (1 - s^2)^{3/2}\right]
    """
    u = jnp.clip(1 - s, 0, 1)
    return u * u * jnp.sqrt(u) * horner(ENERGY_64, 2 * u - 1)


@energy_ratio.defjvp
def _energy_ratio_jvp(primals, tangents):
    (s,), (ds,) = primals, tangents
    return energy_ratio(s), jnp.where((s >= 0) & (s < 1), -stress_ratio(s), 0.0) * ds


# ---- a contact -------------------------------------------------------------------------------------------------------


class Recovered(NamedTuple):
    """What full release from a peak gives back, as a quotient; whether the peak carries force, whether the limit holds,
    and there the second of its two terms (`steep`)."""

    top: Values
    bottom: Values
    carries: Flags
    limited: Flags
    steep: Flags

    @property
    def span(self) -> Values:
        """The recovered displacement; 1 where no force was carried."""
        return recompute(self.top / self.bottom)

    @property
    def displacement(self) -> Values:
        """The recovered displacement; 0 where no force was carried."""
        return jnp.where(self.carries, self.span, 0.0)


class Contact(Quintic):
    """A particle against a plane: platens (um, mN), a wall or a neighbour in a particle code (m, N).

    Attributes:
        k1, k3, k5: initial slope of loading, factors of its softening and its hardening term.
        c: factor of the recovered displacement squared.
        power: n, 1 for the printed unloading form and 2 for the punch forms.
    """

    c: Values
    power: int = eqx.field(static=True, default=1, kw_only=True)

    def step(self, peak: Scalar, displacement: Scalar) -> tuple[Scalar, Scalar]:
        """Largest displacement so far and force after one more displacement."""
        # This way round a displacement that is NaN shows; so it is below.
        peak = jnp.where(displacement < peak, peak, displacement)
        return peak, self.force(peak, peak - displacement)

    def path(self, peak: Scalar, displacement: Path) -> tuple[Scalar, Path]:
        """The same along a path: the scan of `step` in closed form, over the running maximum."""
        highest = running_max(displacement)
        peaks = jnp.where(highest < peak, peak, highest)
        return peaks[-1], self.force(peaks, peaks - displacement)

    def under(self, displacement_max: Scalar, force: Values, highest: Values) -> tuple[Values, Values]:
        """Largest displacement so far and displacement under forces, one or many, each with the highest up to it."""
        # The barriers make stages that share no intermediate values, which XLA would store, cutting the loop over the
        # data of the inverse into many pieces.
        contact = jax.lax.optimization_barrier(self)
        past = jax.lax.optimization_barrier(contact.loading(displacement_max))

        contact, displacement_max, highest = jax.lax.optimization_barrier((self, displacement_max, highest))
        peak_force = jnp.where(highest < past, past, highest)
        loaded = reached(Quintic(contact.k1, contact.k3, contact.k5), peak_force, displacement_max)
        elastic = (highest < past) | (loaded < displacement_max)
        peak = jax.lax.optimization_barrier(jnp.where(elastic, displacement_max, loaded))

        contact, force, highest = jax.lax.optimization_barrier((self, force, highest))
        peak_force = jnp.where(highest < past, past, highest)
        recovered = contact.recovered(peak)
        # Below that, the quotient's derivatives overflow.
        carries = recovered.carries & (peak_force > jnp.finfo(peak_force.dtype).tiny ** 0.5)
        ratio = recompute(jnp.where(carries, force, 0.0) / jnp.where(carries, peak_force, 1.0))
        released = recovered.span * recovery(ratio)
        return peak, peak - jnp.where(carries & (force < peak_force), released, 0.0)

    def softened(self, factor: Values | Scalar) -> Contact:
        """The bare contact with a factor on its effective modulus."""
        return Contact(self.k1, self.k3, self.k5, self.c / factor**self.power, power=self.power)

    @property
    def bare(self) -> Contact:
        """The four numbers alone, of a kind of contact that has more."""
        return Contact(self.k1, self.k3, self.k5, self.c, power=self.power)

    def recovered(self, peak: Values, secant: Values | None = None) -> Recovered:
        """What full release from a peak displacement gives back.

        The secant is that of a peak which effects moved off the curve: above it no more energy is stored than on it.
        """
        square = self.formula_squared(peak, secant)
        tiny = jnp.finfo(peak.dtype).tiny  # down to where the root still has a derivative
        carries = (self.loading(peak) > tiny) & (square > tiny)
        formula = recompute(jnp.sqrt(jnp.where(carries, square, 1.0)))
        top, bottom, steep = self.limit(peak)
        if secant is not None:
            on_curve = self.secant(peak)
            top = top * jnp.where(secant > on_curve, on_curve / jnp.where(carries, secant, 1.0), 1.0)
        limited = carries & (formula * bottom > top)
        top, bottom = jnp.where(limited, top, formula), jnp.where(limited, bottom, 1.0)
        return Recovered(jnp.where(carries, top, 1.0), bottom, carries, limited, steep)

    def formula_squared(self, peak: Values, secant: Values | None = None) -> Values:
        """Square of the recovered displacement by its formula, without the limit."""
        secant = self.secant(peak) if secant is None else secant
        return self.c * secant if self.power == 1 else self.c * secant * secant * peak

    def limit(self, peak: Values) -> tuple[Values, Values, Flags]:
        """The limit of the recovered displacement as a quotient, and whether the second of its terms holds."""
        secant, tangent = self.secant(peak), self.tangent(peak)
        steep = tangent > SHARE * secant
        return jnp.where(steep, peak * secant, peak), jnp.where(steep, tangent * (1 / SHARE), 1.0), steep

    def growth(self, peak: Values, per_span: Values, limited: Flags, steep: Flags) -> tuple[Values, ...]:
        r"""Factors of the changes of :math:`F_P`, of :math:`\gamma_P` times :math:`F_P/\gamma_P`, of the slope T of
        loading and of c in

        .. math:: 2 F_P\, d\Delta / \Delta = n\, dF_P - (F_P/\gamma_P)\, d\gamma_P + F_P\, dc/c \ (\text{formula}),
            \quad 2\, (F_P/\gamma_P)\, d\gamma_P, \quad 2\, dF_P - 2 (F_P/T)\, dT \ (\text{limits}).
        """
        secant = self.secant(peak)
        over_c = secant * per_span * per_span * (1.0 if self.power == 1 else peak * secant)  # by products
        return (
            jnp.where(limited, jnp.where(steep, 2.0, 0.0), float(self.power)),
            jnp.where(limited, jnp.where(steep, 0.0, 2.0), -1.0),
            jnp.where(limited & steep, -2 / SHARE * recompute(1 / per_span), 0.0),
            jnp.where(limited, 0.0, peak * secant * over_c),
        )

    def force(self, peak: Values, drop: Values) -> Values:
        r"""Force after the displacement dropped from its peak; zero where no force was carried there.

        Derivatives are written out, because reverse mode then stores half as many arrays along a path. With
        :math:`h = -\tfrac12 s f'`:

        .. math:: dF = f\, dF_P + (F_P / \Delta) f'\, d(drop) + h\, (2 F_P\, d\Delta / \Delta) \quad (`growth`).

        A drop of 0 is loading, with the derivative of loading.
        """
        return _force(self.bare, peak, drop)

    def stored(self, peak: Values, drop: Values) -> tuple[Values, Values]:
        """What full release gives back: from the peak, and after the displacement dropped from it."""
        return stored(self.loading(peak), self.recovered(peak).span, drop)


def stored(force: Values, span: Values, drop: Values) -> tuple[Values, Values]:
    r"""Elastic energy :math:`F_P\, \Delta\, g(s)` (`energy_ratio`) of a peak force, at s = 0 and after a drop."""
    s = recompute(drop / span)
    scale = jnp.where(force > 0, force * span, 0.0)
    at_peak = scale * energy_ratio(jnp.zeros_like(s))
    return at_peak, jnp.where(drop <= 0, at_peak, scale * energy_ratio(s))


def first_gain(at_peak: Callable[[Scalar], Contact], highest: Scalar) -> Scalar:
    """Smallest peak displacement beyond which further loading gains energy; infinite where it never does.

    What is lost, the work of loading less what full release gives back, depends on the peak alone. A contact gains
    where it falls (by more than rounding) from one peak to the next, or is NaN. `at_peak` is the contact that unloads
    from a peak displacement.
    """
    peaks = highest * jnp.linspace(0.0, 1.0, PEAKS + 1, dtype=highest.dtype)

    def balance(peak: Scalar) -> tuple[Scalar, Scalar]:
        contact = at_peak(peak)
        return contact.work(peak), contact.stored(peak, jnp.zeros_like(peak))[0]

    work, given_back = jax.vmap(balance)(peaks)
    holds = jnp.diff(work - given_back) >= -8 * jnp.finfo(work.dtype).eps * work[-1]
    return jax.lax.stop_gradient(jnp.where(jnp.all(holds), jnp.inf, peaks[jnp.argmin(holds)]))


@jax.custom_jvp
def _force(contact: Contact, peak: Values, drop: Values) -> Values:
    force, _, _, _, ratio = _branch(contact, peak, drop)
    return force * ratio


@_force.defjvp
def _force_jvp(primals: Any, tangents: Any) -> tuple[Values, Values]:
    contact, peak, _ = primals
    change, dpeak, ddrop = tangents
    force, recovered, per_span, s, ratio = _branch(*primals)
    # The force and all derivatives need these: without a barrier XLA computes them again in the loop of each output.
    s, ratio, per_span = jax.lax.optimization_barrier((s, ratio, per_span))
    secant, tangent, square = contact.secant(peak), contact.tangent(peak), peak * peak
    s, fall = falling(s)
    h = 0.5 * s * fall
    with_force, with_peak, with_slope, with_c = contact.growth(peak, per_span, recovered.limited, recovered.steep)
    by_force, by_slope = jnp.where(secant > 0, ratio + with_force * h, 0.0), h * with_slope
    bend = peak * (20 * square * contact.k5 - 6 * contact.k3)
    by_peak = by_force * tangent + with_peak * h * secant + by_slope * bend
    # The same for each factor of a tangent: one barrier for each, so that what a derivative does not need is left out.
    factors = by_force * peak, by_slope, by_peak, h * with_c, fall * force * per_span
    by_force, by_slope, by_peak, by_c, by_drop = map(jax.lax.optimization_barrier, factors)
    total = (by_force + by_slope) * change.k1 - square * ((by_force + 3 * by_slope) * change.k3)
    total = total + square * square * ((by_force + 5 * by_slope) * change.k5) + by_peak * dpeak
    total = total + by_c * change.c - by_drop * ddrop
    # Transposed, this is a barrier for the cotangent, which otherwise would be computed again for each input.
    return force * ratio, jax.lax.optimization_barrier(total)


def falling(s: Values) -> tuple[Values, Values]:
    """The recovered share where force falls with it, else 0, and -f' there."""
    inside = (s > 0) & (s < 1)
    s = jnp.where(inside, s, 0.0)
    return s, jnp.where(inside, 4 / jnp.pi * recompute(jnp.sqrt((1 - s) * (1 + s))), 0.0)


def _branch(contact: Contact, peak: Values, drop: Values) -> tuple[Values, Recovered, Values, Values, Values]:
    """Peak force, what it recovers, one over that, the share of it recovered so far, share of the force left."""
    recovered = contact.recovered(peak)
    per_span = recompute(recovered.bottom / recovered.top)
    s = jnp.where(recovered.carries, drop * per_span, 1.0)
    return contact.loading(peak), recovered, per_span, s, jnp.where(drop <= 0, 1.0, stress_ratio(s))


# ---- the inverse of loading ------------------------------------------------------------------------------------------

# Halley's method needs a good start where the curve is nearly flat: at its bend when monotonicity is about to be lost,
# and at its peak when it is lost. Around the bend b the quintic is exactly
#   F(b + d) = F_b + m d + 2 k3 d^3 + 5 k5 b d^4 + k5 d^5,
# so the root of its cubic part is such a start, and an upper bound to the right of the bend. Around a peak p the curve
# falls by H0 e^2 + H1 e^3 + ..., e = p - x, again a cubic.


@jax.custom_jvp
def reached(curve: Quintic, stress: Values, floor: Scalar) -> Values:
    """Smallest x at which loading reaches a stress, 0 for stress <= 0; derivatives by the implicit-function rule.

    `floor` is the largest x so far: behind the peak of a curve that falls there is no way back.
    """
    target = jnp.maximum(stress, 0.0)
    # The barrier makes two loops over the data, which on a CPU take four fifths of the time of a single one.
    x = jax.lax.optimization_barrier(_start(curve, target, floor))
    # The slope vanishes only where the curve just stops being monotone, and there at the root itself: stay there. Stay,
    # too, once the stress is met but for rounding, which over a small slope would be a large step.
    noise = 8 * jnp.finfo(x.dtype).eps * curve.k1
    rounding = 2 * jnp.finfo(x.dtype).eps * target
    for _ in range(HALLEY_STEPS):
        stress_there, slope, half_curvature = curve.halley(x)
        excess = stress_there - target
        squared = slope * slope
        divisor = jnp.maximum(squared - excess * half_curvature, 0.5 * squared)
        moves = (slope > noise) & (jnp.abs(excess) > rounding)
        x = x - recompute(excess * slope / jnp.where(moves, divisor, jnp.inf))
    return x


@reached.defjvp
def _reached_jvp(primals, tangents):
    curve, stress, _ = primals
    change, dstress, _ = tangents
    x = reached(*primals)
    cube = x * x * x
    slope = curve.tangent(x)
    # At the peak of a curve that is not monotone the derivative is infinite; a floor keeps it finite.
    smallest = jnp.sqrt(jnp.finfo(x.dtype).eps) * curve.k1
    total = dstress - x * change.k1 + cube * change.k3 - x * x * cube * change.k5
    return x, jnp.where(stress >= 0, recompute(total / jnp.where(slope > smallest, slope, smallest)), 0.0)


def _root(x: Values) -> Values:
    """Square root of the positive part, for code that is never differentiated."""
    return recompute(jnp.sqrt(jnp.maximum(x, 0.0)))


def _rough(x: Values, p: float) -> Values:
    """A power within 5 %, of numbers kept within what float32 can hold."""
    return rough_power(jnp.clip(x, 1e-37, 1e37), p)


def _start(curve: Quintic, target: Values, floor: Scalar) -> Values:
    K1, K3, K5 = curve.k1, curve.k3, curve.k5
    # Written with maxima, and with each costly value used in few places: it then compiles to few loops over the data.
    tiny = jnp.finfo(target.dtype).tiny ** 0.5
    discriminant = 9 * K3 * K3 - 20 * K1 * K5
    falls = discriminant > 0
    # Square of the scaled strain at the peak, the smaller root of the slope, without cancellation and division by K5.
    y = recompute(2 * K1 / (3 * K3 + _root(discriminant) + tiny))
    peak = _root(y)
    drop = peak * (K1 - y * (K3 - y * K5)) - target
    first_branch = falls & (drop >= 0) & (floor <= peak)

    # Below a peak, H0 e^2 + H1 e^3 = drop: e = E g(H1 E / H0) with E = sqrt(drop / H0) and g(z) = (1 + 3z/2)^(-1/3),
    # right at both ends and 13 % off at worst between them.
    over_H0 = recompute(1 / jnp.maximum(peak * (3 * K3 - 10 * K5 * y), tiny))
    E = _root(drop * over_H0)
    widening = 1 + jnp.maximum(15 * K5 * y - 1.5 * K3, 0.0) * E * over_H0

    # Around the bend, d^3 + 3 p d = 2 q. With K3 -> 0 there is no bend; the cubic then replaces K5 x^5.
    over_K5 = recompute(1 / jnp.maximum(K5, tiny))
    bend_squared = 0.3 * K3 * over_K5
    bend = _root(bend_squared)
    factor = recompute(1 / jnp.maximum(2 * K3, _rough(K1 * K5, 0.5)))
    p = (K1 - 1.5 * bend_squared * K3) * factor * (1 / 3)
    secant = K1 - 0.7 * bend_squared * K3
    q = (target - bend * secant) * factor * 0.5
    concave = (q < 0) & ~falls
    half = jnp.abs(q)
    # One cube root for both; that of a start need not be exact.
    root_cubed = jnp.where(first_branch, widening, half + _root(half * half + p * p * p))
    root = jnp.maximum(_rough(root_cubed, 1 / 3), jnp.where(first_branch, 1.0, _root(-p)))
    over_root = recompute(1 / root)
    around_bend = bend + jnp.where(concave, -1.0, 1.0) * (root - p * over_root)

    # An upper bound: K5 x^5 is at most 9/4 of the stress (monotone), or else half of stress + K3 x^3. Where K1 x is
    # more than K5 x^5 the place where they are equal will do.
    quotient = K1 * over_K5
    bound = 1.05 * _rough(jnp.maximum(2.25 * target * over_K5, quotient * _rough(quotient, 0.25)), 0.2)
    bound = jnp.maximum(bound, jnp.where(falls, 2.6, 0.0) * bend)
    bound = jnp.where(concave, target / secant, bound)  # left of the bend, the chord
    x = jnp.where(first_branch, peak - E * over_root, jnp.minimum(around_bend, bound))
    # At or left of the root of a concave piece.
    return jnp.maximum(x, jnp.where((q < 0) | first_branch, target / K1, 0.0))


# ---- polynomials of the branch, from the highest power down; printed by `benchmarks/make_recovery_coefficients.py` ---

# fmt: off
RATIO_64 = (  # degree 17, largest relative error 9.8e-18
    -3.1112491627037324e-12, -1.0778152191898491e-11, -2.3673219699814047e-11, -8.452689239590027e-11,
    -3.319421170673405e-10, -1.212942982787599e-09, -4.4814427848648566e-09, -1.7003372928575843e-08,
    -6.612178244595573e-08, -2.649041501718955e-07, -1.1023540242429571e-06, -4.820198795141472e-06,
    -2.254626055400008e-05, -0.00011623474094004388, -0.000698837433216929, -0.005589066336873583,
    -0.09948832042832373, 1.1059212819304507,
)
RATIO_32 = (  # degree 7, largest relative error 3.2e-9
    -1.2480960895296546e-06, -5.401048983674062e-06, -2.2452455776047703e-05, -0.00011586145470259827,
    -0.000698856413808037, -0.005589141822871462, -0.0994883198339057, 1.1059212842941968,
)
ENERGY_64 = (  # degree 17, largest relative error 8.4e-19
    -1.2239264552240398e-13, -4.4775614368770457e-13, -1.1073099259581753e-12, -4.2101557246143604e-12,
    -1.7312782661902265e-11, -6.796752849276065e-11, -2.718377691137876e-10, -1.121199897586585e-09,
    -4.774596592639362e-09, -2.1136379601434695e-08, -9.823826421390291e-08, -4.86180133022437e-07,
    -2.6172239575116677e-06, -1.5869018635618415e-05, -0.00011552024703257536, -0.001165001243505945,
    -0.027759519411803355, 0.4534723205369016,
)
RECOVERY_64 = (  # degree 23, largest relative error 1.3e-17
    1.684851935524473e-10, 3.902923299587117e-10, -1.0449113448846025e-10, -2.3081087011875581e-10,
    2.146188540744108e-09, 5.038533760882086e-09, 7.874134110883696e-09, 1.884467339936365e-08,
    4.918527595833039e-08, 1.187491893488825e-07, 2.863356700467264e-07, 7.023157910261354e-07,
    1.740154861392644e-06, 4.357528422504284e-06, 1.1058300851757174e-05, 2.852318981764797e-05,
    7.506797103188011e-05, 0.00020270626531019277, 0.0005662800841837647, 0.0016583781234766374,
    0.00521071202287205, 0.01841721236162996, 0.08318341840902267, 1.0687365999717602,
)
RECOVERY_32 = (  # degree 9, largest relative error 1.9e-8
    1.6910062929247536e-05, 4.308438627404585e-05, 6.947846935028573e-05, 0.0001888210178514567,
    0.000568356038508883, 0.0016635313387641567, 0.005210447896423434, 0.018416556927822268,
    0.08318342370927062, 1.0687366131235896,
)
# fmt: on
