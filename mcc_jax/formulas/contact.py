r"""The law of one contact, four numbers and the largest displacement so far, in any consistent units.

.. math::
    F &= k_1 \gamma - k_3 \gamma^3 + k_5 \gamma^5 && \text{loading}, \quad \gamma \ge \gamma_P \\
    F &= F_P\, f(s), \quad s = (\gamma_P - \gamma) / \Delta && \text{unloading and reloading} \\
    \Delta^2 &= c\, (F_P / \gamma_P)^n\, \gamma_P^{n-1} && \text{recovered on full release},
        \quad \Delta \le \min\left(\gamma_P,\ \tfrac{3\pi}{8}\, F_P \Big/ \frac{dF}{d\gamma}\Big|_P\right)

with f of `stress_ratio`. Without the limit a release could give back more than loading took, at small peaks by the
printed form, with a soft modulus by every form. With it no cycle of any path gains energy; the proof is in the
documentation, "The law". In a pair each side has its own limit; the sides carry one force, so energies add.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._numerics import recompute, running_max
from .._types import Path, Scalar, Values
from .loading import Quintic, reached
from .recovery import energy_ratio, recovery, stress_ratio

SHARE = 3 * math.pi / 8
r"""Largest :math:`\Delta F'/F_P`. Elastic energy is :math:`\tfrac{4}{3\pi} F_P \Delta`; with it :math:`F^2/(2F')`."""
PEAKS = 256
"""Peaks, evenly spread, at which `first_gain` asks whether more is lost than at the one before."""

Flags = Bool[Array, "..."]


class Recovered(NamedTuple):
    """What full release from a peak gives back, as a quotient top / bottom; 1 where no force was carried.

    Whether the peak carries force, and whether the limit holds, and there the second of its two terms.
    """

    top: Values
    bottom: Values
    carries: Flags
    limited: Flags
    steep: Flags

    @property
    def span(self) -> Values:
        """The recovered displacement."""
        return recompute(self.top / self.bottom)

    @property
    def displacement(self) -> Values:
        """The same, 0 where no force was carried."""
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

    # ---- the law: a step, a path, and the same under load control ------------------------------------------------

    def step(self, peak: Scalar, displacement: Scalar) -> tuple[Scalar, Scalar]:
        """Largest displacement so far and force after one more displacement."""
        # Asked this way round, a displacement that is NaN shows; so it is below.
        peak = jnp.where(displacement < peak, peak, displacement)
        return peak, self.force(peak, peak - displacement)

    def path(self, peak: Scalar, displacement: Path) -> tuple[Scalar, Path]:
        """The same along a path: the scan of `step` in closed form, over the running maximum."""
        highest = running_max(displacement)
        peaks = jnp.where(highest < peak, peak, highest)
        return peaks[-1], self.force(peaks, peaks - displacement)

    def under(self, displacement_max: Scalar, force: Values, highest: Values) -> tuple[Values, Values]:
        """Largest displacement so far and displacement under forces, one or many, each with the highest up to it."""
        # The barriers make stages that share nothing but what they are given. Where they share intermediate values, XLA
        # stores those and cuts the loop over the data of the inverse in many pieces.
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

    # ---- unloading -----------------------------------------------------------------------------------------------

    def softened(self, factor: Values | Scalar) -> Contact:
        """The bare contact with a factor on its effective modulus."""
        return Contact(self.k1, self.k3, self.k5, self.c / factor**self.power, power=self.power)

    @property
    def bare(self) -> Contact:
        """The four numbers alone, of a kind of contact that has more."""
        return Contact(self.k1, self.k3, self.k5, self.c, power=self.power)

    def recovered(self, peak: Values, secant: Values | None = None) -> Recovered:
        """What full release from a peak displacement gives back.

        The secant is that of a peak which effects moved off the curve; the limit stays that of the curve.
        """
        square = self.formula_squared(peak, secant)
        tiny = jnp.finfo(peak.dtype).tiny  # down to where the root still has a derivative
        carries = (self.loading(peak) > tiny) & (square > tiny)
        formula = recompute(jnp.sqrt(jnp.where(carries, square, 1.0)))
        top, bottom, steep = self.limit(peak)
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

    What is lost, the work of loading less what full release gives back, depends on the peak alone. Where it falls (by
    more than rounding) from one peak to the next, a contact that is released, loaded further and released again has
    gained. NaN counts as a gain. `at_peak` is the contact that unloads from a peak displacement.
    """
    peaks = highest * jnp.linspace(0.0, 1.0, PEAKS + 1, dtype=highest.dtype)

    def balance(peak: Scalar) -> tuple[Scalar, Scalar]:
        contact = at_peak(peak)
        return contact.work(peak), contact.stored(peak, jnp.zeros_like(peak))[0]

    work, given_back = jax.vmap(balance)(peaks)
    holds = jnp.diff(work - given_back) >= -8 * jnp.finfo(work.dtype).eps * work[-1]
    return jax.lax.stop_gradient(jnp.where(jnp.all(holds), jnp.inf, peaks[jnp.argmin(holds)]))


# ---- derivatives -----------------------------------------------------------------------------------------------------


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
