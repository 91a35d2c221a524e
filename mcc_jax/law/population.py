"""How the plastic coefficients scatter from particle to particle."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import PRNGKeyArray

from .._format import described
from .._types import Scalar, Values, checked
from ..arguments import finite, positive, whole
from ..formulas import Plastic


class LogNormal(eqx.Module):
    r"""A log-normal quantity with mean and standard deviation of its logarithm, :math:`\log C \sim N(\mu, \tau^2)`."""

    mean: Scalar = eqx.field(converter=checked(finite, "the mean of the logarithm"))
    sd: Scalar = eqx.field(converter=checked(positive, "the sd of the logarithm", zero=True, plain=True))

    __repr__ = described()

    def moment(self, order: int) -> Scalar:
        r""":math:`E[C^k] = \exp(k\mu + k^2\tau^2/2)`."""
        return jnp.exp(order * self.mean + order**2 * self.sd**2 / 2)

    def variance_of_power(self, order: int) -> Scalar:
        r""":math:`\mathrm{Var}[C^k] = E[C^k]^2 (e^{k^2\tau^2} - 1)`."""
        return self.moment(order) ** 2 * jnp.expm1(order**2 * self.sd**2)

    @classmethod
    def from_power_moments(cls, order: int, mean: Scalar, variance: Scalar) -> LogNormal:
        r"""The log-normal C whose power :math:`C^k` has this mean (> 0) and variance (>= 0)."""
        spread = jnp.log1p(variance / mean**2)
        return cls((jnp.log(mean) - spread / 2) / order, jnp.sqrt(spread) / order)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Values:
        """Independent draws."""
        return jnp.exp(self.mean + self.sd * jax.random.normal(key, shape, dtype=self.mean.dtype))


class PlasticPopulation(eqx.Module):
    """Log-normal, independent C1, C3, C5 of a batch of particles (Bommireddy et al. 2018, Table 2 and eq. 17)."""

    C1: LogNormal
    C3: LogNormal
    C5: LogNormal

    __repr__ = described()

    @property
    def mean_law(self) -> Plastic:
        r"""The law of the expected stress: :math:`E[C_1] x - E[C_3^3] x^3 + E[C_5^5] x^5` (eq. 17)."""
        return Plastic.from_polynomial(self.C1.moment(1), self.C3.moment(3), self.C5.moment(5))

    @property
    def median_law(self) -> Plastic:
        """The law with every coefficient at its median exp(mu)."""
        return Plastic(jnp.exp(self.C1.mean), jnp.exp(self.C3.mean), jnp.exp(self.C5.mean))

    def stress_sd(self, x: Values) -> Values:
        """Standard deviation [MPa] of the stress at the scaled strain x."""
        first, third, fifth = (C.variance_of_power(k) for C, k in ((self.C1, 1), (self.C3, 3), (self.C5, 5)))
        return jnp.sqrt(first * x**2 + third * x**6 + fifth * x**10)

    @property
    def yield_stress(self) -> Scalar:
        r""":math:`\sigma_y = E[C_1] / 17.16` [MPa] from the ideal plastic contact (eq. 22).

        It takes the whole platen displacement as the deformation of one contact; shared by two contacts it doubles.
        """
        return self.C1.moment(1) / 17.16

    @property
    def probability_not_monotone(self) -> Scalar:
        r"""Share of particles with :math:`9 C_3^6 > 20 C_1 C_5^5`: a normal tail, as log C enters linearly."""
        gap = jnp.log(20 / 9) + self.C1.mean + 5 * self.C5.mean - 6 * self.C3.mean
        spread = jnp.sqrt(self.C1.sd**2 + 25 * self.C5.sd**2 + 36 * self.C3.sd**2)
        return norm.cdf(-gap / spread)

    def sample(self, key: PRNGKeyArray, count: int) -> Plastic:
        """Draws for `count` particles as one batched `Plastic`; those not monotone are kept, and flagged by it."""
        count = whole(count, "count")
        keys = jax.random.split(key, 3)
        draws = [c.sample(k, (count,)) for c, k in zip((self.C1, self.C3, self.C5), keys, strict=True)]
        return eqx.filter_vmap(Plastic)(*draws)
