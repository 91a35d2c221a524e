"""One half contact: what a particle offers to whatever presses on it from one direction."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import arguments
from .._errors import InputError
from .._format import described
from .._numerics import shared
from .._types import Flag, Scalar, Values
from ..effects import AbstractModulusAtPeak
from ..formulas import Formulas, energy_ratio, recovery_limit, secant_modulus, tangent_modulus
from ..formulas.loading_inverse import loading_work
from ..geometry import Particle
from ..law import TESTED_STRAIN, MccLaw
from ..law.passivity import never_falls, peaks_up_to
from ..law.response import factor_at_peak, folded

Normal = Float[Array, " 3"]
Flags = Bool[Array, "..."]


class Numbers(NamedTuple):
    """The numbers of one side that its force depends on."""

    k1: Values
    k3: Values
    k5: Values
    c: Values


class HalfContact(eqx.Module):
    r"""Half of a plate test: force against the compression d of one side of a particle, towards a rigid flat.

    .. math:: F = k_1 d - k_3 d^3 + k_5 d^5 \ (\text{loading}), \qquad
        \Delta^2 = c\, (F_P / d_P)^n\, d_P^{n-1} \ (\text{compression recovered on full release from } d_P)

    and :math:`\Delta` no larger than `law.recovery_limit`, without which a release could give back more than it took.
    Damage and densification divide c by :math:`\varphi^n`, :math:`\varphi(d_P / R_e, F_P / \pi R_e^2)` their factor.

    A particle between two plates is two of them in series, each compressed by half the platen displacement. It is one
    half contact: make many with ``jax.vmap(half_contact)`` and pick from them with `sides_of`.

    Attributes:
        k1: initial stiffness [N/m].
        k3: softening [N/m^3].
        k5: hardening [N/m^5].
        c: factor of the recovered compression squared, [m^3/N] for n = 1 and [m^3/N^2] for n = 2.
        tested: compression at which the paper's tests ended, eta_p eps = 0.67 [m]; beyond it the law extrapolates.
        power: n, 1 for the printed unloading form and 2 for the punch forms.
        effects: those on the modulus at a peak (damage, densification).
        radius: of curvature R_e [m], where there are such effects: strain is d / R_e, stress F / (pi R_e^2).
    """

    k1: Scalar
    k3: Scalar
    k5: Scalar
    c: Scalar
    tested: Scalar
    power: int = eqx.field(static=True, default=1)
    effects: tuple[AbstractModulusAtPeak, ...] = ()
    radius: Scalar | None = None

    __repr__ = described()

    def numbers(self, d: Values) -> Numbers:
        """What the branch from a peak compression [m] depends on: the effects' factor is part of c.

        Beyond the tested compression the factor stays as it is there. Where it is constant the recovery limit alone
        keeps a contact from gaining energy.
        """
        c = self.c
        if self.radius is not None:
            d = jnp.where(d < self.tested, jnp.where(d > 0, d, 0.0), self.tested)
            stress = 1e-6 * d * secant_modulus(self.k1, self.k3, self.k5, d) / (jnp.pi * self.radius * self.radius)
            c = c / factor_at_peak(self.effects, d / self.radius, stress) ** self.power
        return Numbers(self.k1, self.k3, self.k5, c)

    @property
    def is_passive(self) -> Flag:
        """Whether the energy it loses grows with its peak: then no path of it gains energy.

        True without effects (`law.recovery_limit`). Damage adds recovery: much of it, in a soft particle, gives back
        more than further loading took.
        """
        if not self.effects:
            return jnp.asarray(True)
        d = peaks_up_to(self.tested)
        force = d * secant_modulus(self.k1, self.k3, self.k5, d)
        stored = force * recovered(self.power, self.numbers(d), force, d)[0] * energy_ratio(jnp.zeros_like(d))
        return jnp.all(never_falls(loading_work(self.k1, self.k3, self.k5, d), stored))

    @property
    def is_monotone(self) -> Flag:
        r"""Whether the force never falls while compression grows: :math:`9 k_3^2 \le 20 k_1 k_5`.

        Where it falls the split of a pair is not unique. About 2.4 % of the paper's log-normal draws do.
        """
        return 9 * self.k3 * self.k3 <= 20 * self.k1 * self.k5

    @property
    def is_valid(self) -> Flag:
        """Whether it resists at all, positive stiffness, hardening and recovery, nothing NaN; and `is_passive`.

        A shape factor that is not positive makes it invalid.
        """
        return (self.k1 > 0) & (self.k3 >= 0) & (self.k5 > 0) & (self.c > 0) & (self.tested > 0) & self.is_passive


def sides_of(sides: HalfContact, index: Int[Array | np.ndarray, " contacts"]) -> HalfContact:
    """The half contacts of the particles at an index, from a batch with one for each particle."""
    return jax.tree.map(lambda x: x[index], sides)


def recovered(power: int, side: Numbers, force: Values, d: Values) -> tuple[Values, Flags, Flags]:
    """Compression recovered on full release, 1 where no force was carried; whether at its limit, whether steep."""
    carries = (d > 0) & (force > 0)
    per_compression = shared(jnp.where(carries, force, 1.0) / jnp.where(carries, d, 1.0))
    square = side.c * per_compression if power == 1 else side.c * force * per_compression
    carries = carries & (square > 0)
    span = shared(jnp.sqrt(jnp.where(carries, square, 1.0)))
    limit, steep = recovery_limit(
        d, jnp.where(carries, per_compression, 0.0), tangent_modulus(side.k1, side.k3, side.k5, d)
    )
    limited = carries & (span > limit)
    return jnp.where(limited, limit, span), limited, steep


def passive(sides: HalfContact) -> HalfContact:
    """The half contacts, one or a batch, if no path of theirs gains energy; traced ones pass.

    Raises:
        InputError: naming the effects by which one would gain.
    """
    if not sides.effects or any(map(arguments.is_traced, jax.tree.leaves(sides))):
        return sides
    if not jnp.all(jax.vmap(lambda one: one.is_passive)(sides) if sides.k1.ndim else sides.is_passive):
        names = ", ".join(effect.name for effect in sides.effects)
        problem = f"with {names} a contact would give back more energy than it took"
        raise InputError(problem, remedy="Take a smaller amplitude, or a stiffer effective modulus.")
    return sides


def half_contact(law: MccLaw, particle: Particle, normal: Normal | None = None) -> HalfContact:
    r"""Half contact of a particle in a direction.

    .. math::
        h(n) = \sqrt{a^2 n_1^2 + b^2 n_2^2 + c^2 n_3^2}, \quad R_e(n) = abc / h^2, \quad
        \eta_p(n) = 1 + a_s (1 - h / R_e)

    .. math:: F(d) = \pi R_e^2\, \sigma(\eta_p d / R_e), \qquad \Delta = R_e\, \delta(\eta_p, d_P / R_e)

    with the semi-axes a, b, c = D1/2, D2/2, D3/2, and :math:`\sigma, \delta` of the law (its `a` is :math:`a_s`).
    R_e is the radius of Gaussian curvature of the ellipsoid where its tangent plane has that normal. Along e3 this is
    the paper's particle exactly; in other directions it is a generalisation of our own that no test supports yet.

    Effects on parameters (size, shape) take the particle as it is tested, along D3, in whatever direction; those on the
    modulus take strain and stress of this side at its own peak.

    Args:
        law: the particle's own law; particles of one pair may differ in all of it but the unloading form.
        particle: its diameters [um].
        normal: unit vector in the frame of the particle's axes; e3 if None. Its sign does not matter.

    Returns:
        The half contact in SI units, of scalars. For many particles use ``jax.vmap`` or `equinox.filter_vmap`.

    Raises:
        InputError: naming an effect that is no closed formula (`AbstractEffect.closed`), or by which it gains energy.

    References:
        Bommireddy et al. (2018), eqs. 3 to 5, 13, 16 and 24, for e3.
    """
    semi = 0.5e-6 * jnp.stack([particle.D1, particle.D2, particle.D3])  # m
    square = semi[2] * semi[2] if normal is None else jnp.sum((semi * normal) ** 2)
    radius = shared(jnp.prod(semi) / square)
    formulas, at_peak = folded(law.formulas, law.effects, particle, "the half contact")
    eta = 1 + formulas.a * (1 - shared(jnp.sqrt(square)) / radius)
    return passive(_side(formulas, at_peak, eta, radius))


def _side(law: Formulas, at_peak: tuple[AbstractModulusAtPeak, ...], eta: Scalar, radius: Scalar) -> HalfContact:
    area = jnp.pi * radius * radius
    scale = shared(eta / radius)
    K1, K3, K5 = (1e6 * K for K in law.plastic.polynomial)  # Pa
    power = law.unloading.stress_power
    stiffness = law.unloading.constant * eta**law.strain_scaling.power * (1e6 * law.effective_modulus * area) ** power
    return HalfContact(
        k1=K1 * area * scale,
        k3=K3 * area * scale**3,
        k5=K5 * area * scale**5,
        c=radius**3 / stiffness,
        tested=shared(TESTED_STRAIN / scale),
        power=power,
        effects=at_peak,
        radius=radius if at_peak else None,
    )
