"""One half contact: what a particle offers to whatever presses on it from one direction."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .. import arguments
from .._errors import InputError
from .._format import described
from .._numerics import recompute
from .._types import Flag, Scalar, Values
from ..effects import AbstractModulusAtPeak
from ..formulas import Contact
from ..geometry import Particle
from ..law import TESTED_STRAIN, MccLaw
from ..law.passivity import first_gain
from ..law.response import factor_at_peak, folded

Normal = Float[Array, " 3"]

AREA = 1e6 * jnp.pi
"""Area over R_e^2, times what makes N of MPa m^2."""


class HalfContact(Contact):
    r"""Half of a plate test: force against the compression d of one side of a particle, towards a rigid flat.

    A `formulas.Contact` in metres and newtons. Damage and densification divide c by :math:`\varphi^n`, with
    :math:`\varphi(d_P / R_e, F_P / \pi R_e^2)` their factor. A particle between two plates is two half contacts in
    series, each compressed by half the platen displacement. Make many with ``jax.vmap(half_contact)``, pick with
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
        """The contact that unloads from a peak compression [m]: the effects' factor is part of c.

        Beyond the tested compression the factor stays as it is there. Where it is constant the recovery limit alone
        keeps a contact from gaining energy.
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
    if not sides.effects or any(map(arguments.is_traced, jax.tree.leaves(sides))):
        return sides
    if not jnp.all(jax.vmap(lambda one: one.is_passive)(sides) if sides.k1.ndim else sides.is_passive):
        names = ", ".join(effect.name for effect in sides.effects)
        problem = f"with {names} a contact would give back more energy than it took"
        raise InputError(problem, remedy="Take a smaller amplitude, or a stiffer effective modulus.")
    return sides


def half_contact(law: MccLaw, particle: Particle, normal: Normal | None = None) -> HalfContact:
    r"""Half contact of a particle in a direction, in SI units.

    .. math::
        h(n) = \sqrt{a^2 n_1^2 + b^2 n_2^2 + c^2 n_3^2}, \quad R_e(n) = abc / h^2, \quad
        \eta_p(n) = 1 + a_s (1 - h / R_e)

    .. math:: F(d) = \pi R_e^2\, \sigma(\eta_p d / R_e), \qquad \Delta = R_e\, \delta(\eta_p, d_P / R_e)

    with the semi-axes a, b, c = D1/2, D2/2, D3/2, and :math:`\sigma, \delta` of the law (its `a` is :math:`a_s`). R_e
    is the radius of Gaussian curvature of the ellipsoid where its tangent plane has that normal. Along e3 this is the
    paper's particle exactly; in other directions it is a generalisation of our own that no test supports yet.

    Effects on parameters (size, shape) take the particle as it is tested, along D3; those on the modulus take strain
    and stress of this side at its own peak.

    Args:
        law: the particle's own law; particles of one pair may differ in all of it but the unloading form.
        particle: its diameters [um].
        normal: unit vector in the frame of the particle's axes, of either sign; e3 if None.

    Raises:
        InputError: naming an effect that is no closed formula (`AbstractEffect.closed`), or by which it gains energy.

    References:
        Bommireddy et al. (2018), eqs. 3 to 5, 13, 16 and 24, for e3.
    """
    semi = 0.5e-6 * jnp.stack([particle.D1, particle.D2, particle.D3])  # m
    square = semi[2] * semi[2] if normal is None else jnp.sum((semi * normal) ** 2)
    radius = recompute(jnp.prod(semi) / square)
    formulas, at_peak = folded(law.formulas, law.effects, particle, "the half contact")
    eta = 1 + formulas.a * (1 - recompute(jnp.sqrt(square)) / radius)
    contact = formulas.contact_of_size(AREA, eta, radius, recompute(1 / radius))
    tested = recompute(TESTED_STRAIN * radius / eta)
    numbers = contact.k1, contact.k3, contact.k5, contact.c
    return passive(
        HalfContact(*numbers, tested, power=contact.power, effects=at_peak, radius=radius if at_peak else None)
    )
