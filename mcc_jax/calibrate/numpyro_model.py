"""The probabilistic model of a campaign, as a NumPyro model: this file is its definition."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Float
from numpyro.distributions import constraints

from .. import arguments
from .._errors import InputError
from .._format import described
from .._types import Scalar
from ..effects import Variant, find_variant
from ..law import StrainScaling, Unloading
from .data import Tests
from .forward import Forms, Point, linearise
from .marginal import Marginal
from .noise import FREEDOM, Along, Correlation, Noise, Whitening, whitening
from .population import COEFFICIENTS, Population, Scatter, particles_at
from .priors import NOISE_PARAMETERS, Amplitude, NakagamiPrior, Priors, SpreadCoordinate, bounds_of_a, nuisance_prior

sample: Any = numpyro.sample
deterministic: Any = numpyro.deterministic


@dataclass(frozen=True)
class Model:
    """What is assumed about a campaign; called with tests, it is a NumPyro model. Forms may be given as their text.

    Attributes:
        unloading: form of unloading, to which the modulus belongs.
        strain_scaling: how the shape factor enters unloading.
        modulus_scatter, shape_scatter: let the modulus, or `a`, differ from particle to particle.
        priors: what is believed beforehand; the defaults of the form of unloading if None.
        effects: formulas that act on the law, one a mechanism; see `with_effects`.
        varying: mechanisms whose amplitude differs from particle to particle.
        correlation, along: how rough correlated residuals are, along the path of force or in time.
        robust: white noise is Student's with 4 degrees of freedom, so that spikes count for little.
    """

    unloading: Unloading
    strain_scaling: StrainScaling
    modulus_scatter: bool
    shape_scatter: bool
    priors: Priors | None
    effects: tuple[Variant, ...]
    varying: tuple[str, ...]
    correlation: Correlation
    along: Along
    robust: bool

    __repr__ = described()

    def __init__(
        self,
        unloading: Unloading | str = Unloading.PRINTED,
        strain_scaling: StrainScaling | str = StrainScaling.RAW,
        modulus_scatter: bool = False,
        shape_scatter: bool = False,
        priors: Priors | None = None,
        effects: Any = (),
        varying: Any = (),
        correlation: Correlation | str = Correlation.EXPONENTIAL,
        along: Along | str = Along.LOAD,
        robust: bool = False,
    ) -> None:
        chosen = tuple(_variant(one) for one in _several(effects))
        names = [v.mechanism for v in chosen]
        if twice := [name for name in names if names.count(name) > 1]:
            raise InputError(f"{twice[0]} appears twice in one model", remedy="Take one formula of each mechanism.")
        differ = tuple(dict.fromkeys([*_several(varying), *(v.mechanism for v in chosen if v.random_per_test)]))
        for name in differ:
            arguments.choice(name, names, "effect to vary")
        vars(self).update(
            unloading=arguments.member(unloading, Unloading, "unloading"),
            strain_scaling=arguments.member(strain_scaling, StrainScaling, "strain_scaling"),
            modulus_scatter=arguments.flag(modulus_scatter, "modulus_scatter"),
            shape_scatter=arguments.flag(shape_scatter, "shape_scatter"),
            priors=priors,
            effects=chosen,
            varying=differ,
            correlation=arguments.member(correlation, Correlation, "correlation"),
            along=arguments.member(along, Along, "along"),
            robust=arguments.flag(robust, "robust"),
        )

    # ---- the model ---------------------------------------------------------------------------------------------------

    def __call__(self, tests: Tests | None, marginal: Marginal | None = None) -> None:
        """Displacement under measured force, of particles of one material.

        Of `tests.unobserved()` it is predicted. With the `marginal` of a fit, particles are integrated out, and the
        tests themselves are not looked at.
        """
        if marginal is not None:
            numpyro.factor("tests", jnp.sum(marginal.log_likelihood(self.population(marginal))))
            return
        assert tests is not None
        p, count = self.chosen_priors, len(tests)
        population = self.population(tests, noise_factor=False)
        four = ((name, getattr(p, name)) for name in NOISE_PARAMETERS)
        values = [sample(name, dist.LogNormal(np.log(x.median), x.log_sd)) for name, x in four]
        noise = Noise(*values, scale=jnp.ones(count))
        with numpyro.plate("particle", count):
            xi = sample("deviation", dist.Normal().expand([self.scatter.size]).to_event(1))  # not centred: tau may be 0
            zero = sample("zero_um", dist.Normal(tests.contact + p.zero_um.mean, p.zero_um.sd))
            own = particles_at(population, tests.flatness, self.scatter, xi)
            deterministic("C", coefficients(own.latent, population, tests.flatness))
            law = jax.vmap(self.forms.displacement)
            clean = law(own.latent, own.theta, tests.particle, tests.record)
            if self.robust:
                # Normal noise whose precision is gamma distributed from reading to reading is Student's.
                gamma = dist.Gamma(FREEDOM / 2, FREEDOM / 2).expand([tests.force.shape[1]]).to_event(1)
                tests = dataclasses.replace(tests, reading_weight=sample("reading_weight", gamma))
            # How noise of force moves the prediction is taken as known.
            at = jax.lax.stop_gradient(Point(own.latent, zero, own.theta))
            linear, kind = linearise(at, tests, self.forms, with_numbers=False), (self.correlation, self.along)
            whiten = jax.vmap(lambda scale, one, linear: whitening(noise, scale, one, linear, *kind))
            filters = whiten(noise.scale, tests, linear)
            observed = RecordNoise(clean + zero[:, None], filters, jnp.exp(population.log_noise))
            sample("displacement_um", observed, obs=tests.displacement)

    def population(self, shapes: Any, *, noise_factor: bool = True) -> Population:
        """Priors of what all particles share, as NumPyro sites, for the `flatness` of `Tests` or of a `Marginal`."""
        p = self.chosen_priors
        weight = getattr(shapes, "weight", None)
        weight = jnp.ones_like(shapes.flatness) if weight is None else weight
        low, high = bounds_of_a(shapes.flatness)
        reach = max(8 * p.a.sd, 8.0)  # the bounds scale a coordinate; they are no belief
        low, high = jnp.maximum(low, p.a.mean - reach), jnp.minimum(high, p.a.mean + reach)
        a = sample("a", dist.TruncatedNormal(p.a.mean, p.a.sd, low=low, high=high))
        modulus, factor = p.effective_modulus_MPa, p.noise_factor
        log_modulus = sample("log_modulus", dist.Normal(np.log(modulus.median), modulus.log_sd))
        deterministic("effective_modulus_MPa", jnp.exp(log_modulus))
        # Means at the campaign's average shape, so that they hardly depend on a.
        shift = jnp.sum(weight * jnp.log1p(a * shapes.flatness)) / jnp.sum(weight)
        b1 = sample("b1", dist.Normal(np.log(p.C1.median) + shift, p.C1.log_sd))
        b5 = sample("b5", dist.Normal(np.log(p.C5.median) + shift, p.C5.log_sd))
        # The softening 9 C3^6 / (20 C1 C5^5) is log-normal: 1 where the curve goes flat.
        b3_mean = (np.log(20 / 9) + b1 + 5 * b5 + np.log(p.softening.median)) / 6
        b3 = sample("b3", dist.Normal(b3_mean, p.softening.log_sd / 6))
        mu = deterministic("mu", jnp.stack([b1, b3, b5]) - shift)
        for j, name in enumerate(COEFFICIENTS):
            deterministic(f"{name}_median", jnp.exp(mu[j]))
        tau = jnp.stack([spread(f"tau_{name}", getattr(p, f"tau_{name}")) for name in COEFFICIENTS])
        zero = jnp.zeros(())
        modulus_scatter = spread("modulus_scatter", p.modulus_scatter) if self.modulus_scatter else zero
        shape_scatter = spread("shape_scatter", p.shape_scatter) if self.shape_scatter else zero
        theta, theta_scatter = self._effects()
        log_noise = zero
        if noise_factor:
            log_noise = sample("log_noise_factor", dist.Normal(np.log(factor.median), factor.log_sd))
            deterministic("noise_factor", jnp.exp(log_noise))
        return Population(a, log_modulus, mu, tau, modulus_scatter, shape_scatter, log_noise, theta, theta_scatter)

    def _effects(self) -> tuple[Float[Array, " numbers"], Float[Array, " varying"]]:
        """Amplitudes on their physical side, further parameters, spreads of the amplitudes that vary."""
        amplitudes, further, spreads = [], [], []
        for v in self.effects:
            size = sample(f"{v.mechanism}_size", Amplitude(v))
            amplitudes.append(deterministic(v.mechanism, (v.sign or 1) * v.plausible[0] * size))
            further += [sample(f"{v.mechanism}.{n.name}", nuisance_prior(n)) for n in v.nuisances]
            if v.mechanism in self.varying:
                spreads.append(spread(f"tau_{v.mechanism}", self.spread_prior(v)))
        none = jnp.zeros(0)
        theta = jnp.concatenate([none, *(jnp.reshape(x, 1) for x in (*amplitudes, *further))])
        return theta, jnp.concatenate([none, *(jnp.reshape(x, 1) for x in spreads)])

    # ---- what follows from it ----------------------------------------------------------------------------------------

    @property
    def chosen_priors(self) -> Priors:
        """The priors given, or the defaults for the form of unloading."""
        return self.priors or Priors.default(self.unloading)

    @property
    def shape_power(self) -> float:
        """Power of the shape factor in e: the scaling's, or half of it in the forms that square the modulus."""
        return self.strain_scaling.power / self.unloading.stress_power

    @property
    def variants(self) -> dict[str, Variant]:
        """The formulas of the effects by "mechanism:variant"."""
        return {f"{v.mechanism}:{v.name}": v for v in self.effects}

    @property
    def forms(self) -> Forms:
        """The formulas of law and effects."""
        return Forms(self.unloading, self.effects)

    @property
    def scatter(self) -> Scatter:
        """What differs from particle to particle."""
        varying = tuple((k, self._signed(self.effects[k])) for k in self.varying_places.values())
        owners = [k for k, v in enumerate(self.effects) for _ in v.nuisances]
        positive = tuple((len(self.effects) + int(k), owners[k]) for k in np.flatnonzero(self.forms.positive))
        return Scatter(self.modulus_scatter, self.shape_scatter, self.shape_power, varying, positive)

    @property
    def varying_places(self) -> dict[str, int]:
        """Mechanisms whose amplitude differs from particle to particle, and their places among the effects."""
        return {v.mechanism: k for k, v in enumerate(self.effects) if v.mechanism in self.varying}

    def spread_prior(self, variant: Variant) -> NakagamiPrior:
        """Prior of how much an amplitude, or its logarithm, differs between particles: open in its magnitude."""
        return NakagamiPrior(variant.plausible[1] if self._signed(variant) else 0.5, shape=0.25)

    @staticmethod
    def _signed(variant: Variant) -> bool:
        return variant.sign == 0 or variant.random_per_test

    @property
    def zero_prior(self) -> Array:
        """Mean and standard deviation of the zeros, from the recorded contact [um]."""
        zero = self.chosen_priors.zero_um
        return jnp.asarray(np.array([zero.mean, zero.sd]))

    def with_effects(self, *effects: Any, varying: Any = ()) -> Model:
        """The model with further effects.

        Args:
            effects: each by name, "mechanism" or "mechanism:variant", of `mcc_jax.effects.LIBRARY`, or a `Variant`.
            varying: mechanisms whose amplitude differs from particle to particle, also of effects that it has.

        Raises:
            InputError: for an unknown name, with those that exist; for two formulas of one mechanism.
        """
        return dataclasses.replace(self, effects=(*self.effects, *effects), varying=(*self.varying, *_several(varying)))


class RecordNoise(dist.Distribution):
    """Displacements of whole tests around a prediction [um]; one event is one test."""

    arg_constraints: Any = {}  # noqa: RUF012  # as NumPyro has it
    support: Any = constraints.real_vector

    def __init__(self, loc: Float[Array, "particles points"], filters: Whitening, factor: Array) -> None:
        self.loc, self.filters, self.factor = loc, filters, factor
        super().__init__(batch_shape=loc.shape[:1], event_shape=loc.shape[1:])

    def log_prob(self, value: Any, intermediates: Any = None) -> Any:
        """Log density of every test."""
        away = jnp.where(self.filters.mask, value - self.loc, 0.0)
        return jax.vmap(lambda f, one: f.log_density(one, jnp.log(self.factor)))(self.filters, away)

    def sample(self, key: Any, sample_shape: tuple[int, ...] = ()) -> Array:
        """Draws; points that do not count are NaN."""
        count, points = self.loc.shape
        colour = eqx.filter_vmap(lambda f, *normal: f.colour(*normal))

        def one(key: Any) -> Array:
            white, of_branches, of_zero = (jax.random.normal(k, (count, points)) for k in jax.random.split(key, 3))
            drawn = colour(self.filters, white, of_branches, of_zero[:, 0])
            return jnp.where(self.filters.mask, self.loc + self.factor * drawn, jnp.nan)

        keys = jax.random.split(key, math.prod(sample_shape))
        return jax.vmap(one)(keys).reshape(*sample_shape, count, points)


def coefficients(latent: Array, population: Population, flatness: Array) -> Array:
    """C1, C3, C5 of particles, without their shape factors."""
    return jnp.exp(latent[:, :3]) / (1 + population.a * flatness)[:, None]


def spread(name: str, prior: NakagamiPrior) -> Scalar:
    """A standard deviation over the particles, sampled through a coordinate that may have either sign."""
    distribution = SpreadCoordinate(prior)
    return deterministic(name, distribution.spread(sample(f"{name}_coordinate", distribution)))


def _several(value: Any) -> tuple[Any, ...]:
    return (value,) if isinstance(value, str | Variant) else tuple(value)


def _variant(effect: Any) -> Variant:
    found = find_variant(effect) if isinstance(effect, str) else effect
    for nuisance in found.nuisances:
        if nuisance.random_per_test:
            problem = f"{nuisance.name} of {found.mechanism}:{found.name} differs at random from test to test"
            remedy = "A model has one value for all tests; take another formula of the mechanism."
            raise InputError(problem, remedy=remedy)
    return found
