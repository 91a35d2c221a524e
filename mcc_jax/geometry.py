"""A particle's size and shape: effective radius, effective diameter and the two shape factors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._format import described
from ._numerics import compiled_whole, positive_pow, recompute
from ._types import Scalar, ScalarLike, Values, checked, scalar
from .arguments import diameters, finite, is_traced, positive

_diameter = checked(positive, "a particle's diameter [um]")


class Particle(eqx.Module):
    r"""A particle approximated by an ellipsoid and compressed along :math:`D_3`.

    .. math:: D_e = 2 R_e = D_1 D_2 / D_3

    :math:`R_e` is the mean radius of curvature at the contact. It exceeds every half diameter of a flat particle.
    D1 and D2 are interchangeable: every quantity here is symmetric in them, to the last bit.

    Attributes:
        D1, D2: diameters in the plane of the platens [um], > 0.
        D3: diameter along the direction of compression [um], > 0.

    References:
        Bommireddy et al. (2018), text below eq. 1 (in its Table 1 the major diameter is D1 or D2).
    """

    D1: Scalar = eqx.field(converter=_diameter)
    D2: Scalar = eqx.field(converter=_diameter)
    D3: Scalar = eqx.field(converter=_diameter)

    __repr__ = described(D1="um", D2="um", D3="um")

    @property
    def effective_diameter(self) -> Scalar:
        """D_e = D1 D2 / D3 [um], the length that turns displacement into strain."""
        return self.D1 * self.D2 * self._per_height

    @property
    def inverse_diameter(self) -> Scalar:
        """1 / D_e [1/um]."""
        return self._uprightness * self._per_height

    @property
    def effective_radius(self) -> Scalar:
        """R_e = D1 D2 / (2 D3) [um]."""
        return 0.5 * self.effective_diameter

    @property
    def effective_area(self) -> Scalar:
        """pi R_e^2 [um^2], the area that turns force into stress; no cross-section of the particle."""
        return jnp.pi * self.effective_radius**2

    @property
    def mean_diameter(self) -> Scalar:
        """(D1 + D2 + D3) / 3 [um]."""
        return (self.D1 + self.D2 + self.D3) / 3

    @property
    def flatness(self) -> Scalar:
        """1 - D3^2 / (D1 D2) [-]: 0 for a sphere, towards 1 for a flake, negative for an upright particle."""
        return 1 - self._uprightness

    @property
    def _uprightness(self) -> Scalar:
        # One of only two quotients, which are slow on a CPU, of all that is derived from diameters; 1 for a sphere.
        return recompute(self.D3 * self.D3 / (self.D1 * self.D2))

    @property
    def _per_height(self) -> Scalar:
        return recompute(1 / self.D3)

    def strain(self, displacement: Values) -> Values:
        """Effective strain gamma / D_e [-] of a platen displacement [um] (Bommireddy et al. 2018, eq. 4)."""
        return recompute(displacement / self.effective_diameter)

    def stress(self, force: Values) -> Values:
        """Effective stress F / (pi R_e^2) [MPa] of a force [mN] (Bommireddy et al. 2018, eq. 3)."""
        return recompute(force * 1e3 / self.effective_area)

    def displacement(self, strain: Values) -> Values:
        """Platen displacement [um] of an effective strain [-]."""
        return strain * self.effective_diameter

    def force(self, stress: Values) -> Values:
        """Force [mN] of an effective stress [MPa]; 1 MPa um^2 = 1e-3 mN."""
        return stress * self.effective_area * 1e-3


def plastic_shape_factor(particle: Particle, a: ScalarLike) -> Scalar:
    r"""Shape factor of plastic loading [-], 1 for a sphere (Bommireddy et al. 2018, eq. 13).

    .. math:: \eta_p = 1 + a \left(1 - \frac{D_3^2}{D_1 D_2}\right)

    `a` is the geometric parameter of the loading condition [-], 1.43 for Avicel PH-200. Negative values are sensible
    (dense bodies), but :math:`\eta_p` must stay positive for the law to carry stress.
    """
    finite(a, "the geometric parameter a")
    return _plastic_shape_factor(particle, scalar(a))


@compiled_whole
def _plastic_shape_factor(particle: Particle, a: Scalar) -> Scalar:
    return 1 + a * particle.flatness


@compiled_whole
def elastic_shape_factor(particle: Particle) -> Scalar:
    r"""Shape factor of the elastic (Hertz) contact [-] (Bommireddy et al. 2018, eq. 2, after Zheng et al. 2013).

    .. math:: 1/\eta_e = 1 - (r^{0.1368} - 1)^{1.531}, \qquad r = \max(D_1, D_2) / \min(D_1, D_2)

    The paper prints :math:`D_1/D_2` for :math:`r`, which is not a number whenever :math:`D_1 < D_2`. Against the exact
    elliptic contact of Hertz it is within 0.4 % up to r = 5. At D1 = D2 it is 1, with first derivative 0.
    """
    # The modulus of a logarithm, not max/min: exactly symmetric, and at D1 = D2 no diameter wins the tie.
    log_ratio = jnp.abs(jnp.log(particle.D1) - jnp.log(particle.D2))
    return 1 / (1 - positive_pow(jnp.expm1(0.1368 * log_ratio), 1.531))


def particle_batch(diameters_um: Any) -> Particle:
    """One `Particle` whose fields have a leading axis N, from diameters [um] of shape (N, 3)."""
    sizes = diameters_um if is_traced(diameters_um) else diameters(diameters_um)
    # Not cut by JAX unless it must: every operation on another number of particles would be compiled.
    D1, D2, D3 = jnp.asarray(sizes, dtype=float).T if is_traced(sizes) else (jnp.asarray(x, float) for x in sizes.T)
    return eqx.filter_vmap(Particle)(D1, D2, D3)


def of_each_particle(diameters_um: Any, quantity: Callable[[Particle], Scalar]) -> np.ndarray:
    """A quantity of every particle, shape (N,), from diameters [um] of shape (N, 3)."""
    # What files and figures show is in double precision, whatever precision the caller computes in.
    with jax.enable_x64(True):
        return np.array(eqx.filter_vmap(quantity)(particle_batch(diameters_um)))
