"""Distributions of the model that NumPyro does not have: a spread, an amplitude, a whole test."""

from __future__ import annotations

import math
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Float
from numpyro.distributions import constraints

from ..effects import Nuisance, Variant
from .noise import Whitening
from .priors import NakagamiPrior


def numpy_of(x: Any) -> Any:
    """NumPy of NumPy's arrays and plain numbers, which then compile nothing; JAX's of its own."""
    return jnp if isinstance(x, jax.Array) else np


KNEE = 0.1
"""Share of its prior's scale above which a spread's coordinate is logarithmic."""


class SpreadCoordinate(dist.Distribution):
    r"""The coordinate x of a spread :math:`\tau = k s \sinh^p |x|`, p = 1/(2m), whose prior is Nakagami's.

    It may have either sign: the density is even and smooth at 0, so that a spread that is 0 is no boundary and has no
    tail towards minus infinity. Of :math:`\tau^{2m-1}` and :math:`d\tau/dx` only cosh x is left.
    """

    arg_constraints: Any = {}  # noqa: RUF012  # as NumPyro has it
    support: Any = constraints.real

    def __init__(self, prior: NakagamiPrior) -> None:
        self.prior, self.power = prior, 1 / (2 * prior.shape)
        super().__init__(batch_shape=(), event_shape=())

    @property
    def unit(self) -> float:
        """The spread where sinh |x| is 1."""
        return KNEE * self.prior.sd

    @property
    def constant(self) -> float:
        """The log density at 0."""
        m, s = self.prior.shape, self.prior.sd
        return -math.lgamma(m) - m * math.log(2 * s**2) + 2 * m * math.log(self.unit) + math.log(self.power)

    def spread(self, coordinate: Any) -> Any:
        """The spread at a coordinate."""
        xp = numpy_of(coordinate)
        return self.unit * xp.sinh(xp.abs(coordinate)) ** self.power

    def coordinate(self, spread: Any) -> Any:
        """The coordinate, >= 0, of a spread."""
        return numpy_of(spread).arcsinh((spread / self.unit) ** (1 / self.power))

    def log_prob(self, value: Any, intermediates: Any = None) -> Any:
        """Log density of the coordinate."""
        xp, spread = numpy_of(value), self.spread(value) / self.prior.sd
        return self.constant - 0.5 * spread**2 + xp.log(xp.cosh(value))

    def sample(self, key: Any, sample_shape: tuple[int, ...] = ()) -> Array:
        """Draws of the coordinate."""
        size, sign = jax.random.split(key)
        tau = self.prior.sd * jnp.sqrt(2 * jax.random.gamma(size, self.prior.shape, sample_shape))
        x = self.coordinate(tau)
        return jnp.where(jax.random.bernoulli(sign, 0.5, sample_shape), x, -x)


SCALES = 4
"""An amplitude may be of any size from barely credible to the largest that is: an equal mixture of so many scales."""


class Amplitude(dist.Distribution):
    """The amplitude of an effect in units of the smallest plausible one, along its physical sign.

    An equal mixture of half-normal distributions, of normal ones where both signs are physical, whose scales are spread
    evenly in the logarithm from the smallest to the largest plausible amplitude.
    """

    arg_constraints: Any = {}  # noqa: RUF012  # as NumPyro has it

    def __init__(self, variant: Variant) -> None:
        low, high = variant.plausible
        self.scales = np.geomspace(1.0, high / low, SCALES)
        self.both = variant.sign == 0
        super().__init__(batch_shape=(), event_shape=())

    @property
    def support(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Softplus keeps the coordinate linear where the amplitude is more than barely plausible."""
        return constraints.real if self.both else constraints.softplus_positive

    def log_prob(self, value: Any, intermediates: Any = None) -> Any:
        """Log density."""
        each = [-0.5 * (value / s) ** 2 - math.log(s * math.sqrt(2 * math.pi)) for s in self.scales.tolist()]
        total = reduce(numpy_of(value).logaddexp, each) - math.log(SCALES)
        return total if self.both else total + math.log(2)

    def sample(self, key: Any, sample_shape: tuple[int, ...] = ()) -> Array:
        """Draws."""
        which, size = jax.random.split(key)
        scale = jnp.asarray(self.scales)[jax.random.randint(which, sample_shape, 0, SCALES)]
        drawn = scale * jax.random.normal(size, sample_shape)
        return drawn if self.both else jnp.abs(drawn)


def nuisance_moments(nuisance: Nuisance) -> tuple[float, float]:
    """Prior mean and standard deviation of a further number of a formula, of its logarithm if it must be positive."""
    low, high = nuisance.plausible
    if low > 0:
        low, high = math.log(low), math.log(high)
    return (low + high) / 2, (high - low) / 4


def nuisance_prior(nuisance: Nuisance) -> dist.Distribution:
    """A further number of a formula: normal in the logarithm over its plausible range, or on it if it may be 0."""
    low, high = nuisance.plausible
    if low > 0:
        return dist.LogNormal(*nuisance_moments(nuisance))
    return dist.TruncatedNormal(*nuisance_moments(nuisance), low=low, high=high)


class RecordNoise(dist.Distribution):
    """Displacements of whole tests around a prediction [um]: one event is one test, log likelihoods are by particle."""

    arg_constraints: Any = {}  # noqa: RUF012  # as NumPyro has it
    support: Any = constraints.real_vector

    def __init__(self, loc: Float[Array, "particles points"], filters: Whitening, factor: Array) -> None:
        self.loc, self.filters, self.factor = loc, filters, factor
        super().__init__(batch_shape=loc.shape[:1], event_shape=loc.shape[1:])

    def log_prob(self, value: Any, intermediates: Any = None) -> Any:
        """Log density of every test; points that do not count carry nothing."""
        away = jnp.where(self.filters.mask, value - self.loc, 0.0)
        return jax.vmap(lambda f, one: f.log_density(one, jnp.log(self.factor)))(self.filters, away)

    def sample(self, key: Any, sample_shape: tuple[int, ...] = ()) -> Array:
        """Draws; points that do not count are NaN, as ArviZ wants ragged data."""
        count, points = self.loc.shape

        def one(key: Any) -> Array:
            white, of_branches, of_zero = (jax.random.normal(k, (count, points)) for k in jax.random.split(key, 3))
            drawn = eqx.filter_vmap(lambda f, *normal: f.colour(*normal))(
                self.filters, white, of_branches, of_zero[:, 0]
            )
            return jnp.where(self.filters.mask, self.loc + self.factor * drawn, jnp.nan)

        keys = jax.random.split(key, math.prod(sample_shape))
        return jax.vmap(one)(keys).reshape(*sample_shape, count, points)
