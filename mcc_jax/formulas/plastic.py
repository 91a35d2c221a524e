r"""The master loading law, a quintic in the scaled strain :math:`x = \eta_p \epsilon`, and its inverse."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._format import value_of
from .._numerics import compiled_whole
from .._types import Flag, Scalar, ScalarLike, scalar
from ..arguments import positive
from .loading_inverse import loading_strain, loading_work, secant_modulus, tangent_modulus


def _coefficient(value: ScalarLike) -> Scalar:
    positive(value, "a plastic coefficient", plain=True)
    return scalar(value)


def _softening(value: ScalarLike) -> Scalar:
    positive(value, "the softening coefficient C3", zero=True, plain=True)
    return scalar(value)


class Plastic(eqx.Module):
    r"""The three plastic coefficients of the master loading law.

    .. math:: \sigma(x) / \mathrm{MPa} = C_1 x - (C_3 x)^3 + (C_5 x)^5

    Attributes:
        C1: coefficient of the linear term [-], > 0.
        C3: coefficient of the softening term [-], >= 0.
        C5: coefficient of the hardening term [-], > 0.

    Raises:
        InputError: for a plain number out of its range; computed ones are judged by `MccLaw.is_valid`.

    References:
        Bommireddy et al. (2018), eq. 16, where they are C1, C2, C3 in MPa, MPa^-3, MPa^-5.
    """

    C1: Scalar = eqx.field(converter=_coefficient)
    C3: Scalar = eqx.field(converter=_softening)
    C5: Scalar = eqx.field(converter=_coefficient)

    def __repr__(self) -> str:
        return f"Plastic(C1={value_of(self.C1)}, C3={value_of(self.C3)}, C5={value_of(self.C5)})"

    @classmethod
    def from_polynomial(cls, K1: ScalarLike, K3: ScalarLike, K5: ScalarLike) -> Plastic:
        r"""From the factors of :math:`\sigma = K_1 x - K_3 x^3 + K_5 x^5` [MPa], all positive."""
        for name, value in (("K1", K1), ("K3", K3), ("K5", K5)):
            positive(value, f"{name} [MPa]", zero=name == "K3", plain=True)
        return cls(scalar(K1), jnp.cbrt(scalar(K3)), scalar(K5) ** 0.2)

    @property
    def polynomial(self) -> tuple[Scalar, Scalar, Scalar]:
        r""":math:`(K_1, K_3, K_5) = (C_1, C_3^3, C_5^5)` [MPa]."""
        square = self.C5 * self.C5
        return self.C1, self.C3 * self.C3 * self.C3, square * square * self.C5

    @property
    def is_monotone(self) -> Flag:
        r"""Whether stress never falls while strain grows: :math:`9 C_3^6 \le 20 C_1 C_5^5`.

        Beyond equality the curve has a peak and a trough: under load control the particle snaps through to the rising
        branch, and force as a function of displacement has no derivative with respect to load at the peak.
        """
        K1, K3, K5 = self.polynomial
        return 9 * K3 * K3 <= 20 * K1 * K5

    def stress(self, x: Float[Array, ...]) -> Float[Array, ...]:
        """Stress [MPa] at the scaled strain `x` = eta_p eps >= 0, never below zero."""
        return x * self.secant(x)

    def secant(self, x: Float[Array, ...]) -> Float[Array, ...]:
        """Stress over scaled strain [MPa], never below zero, and C1 at `x` = 0."""
        return secant_modulus(*self.polynomial, x)

    def tangent(self, x: Float[Array, ...]) -> Float[Array, ...]:
        r"""Slope :math:`d\sigma/dx = C_1 - 3 C_3^3 x^2 + 5 C_5^5 x^4` [MPa]."""
        K1, K3, K5 = self.polynomial
        return tangent_modulus(K1, K3, K5, x)

    @compiled_whole
    def strain(self, stress: Float[Array, ...]) -> Float[Array, ...]:
        """Scaled strain at which the stress [MPa] is first reached from the virgin state; 0 for stress <= 0.

        Of a law that is not monotone it jumps over peak and trough. Derivatives by the implicit-function rule.
        """
        return loading_strain(*self.polynomial, stress, jnp.zeros_like(self.C1))

    def work(self, x: Scalar) -> Scalar:
        """Integral of `stress` over scaled strain [MPa], without the stretch in which the quintic is negative."""
        return loading_work(*self.polynomial, x)
