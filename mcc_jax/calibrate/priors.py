"""Priors: what is believed before the data, as numbers, as distributions of NumPyro, and as draws and densities of the
population."""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Float
from numpyro.distributions import constraints

from .. import arguments
from .._errors import InputError
from .._format import described
from ..campaign import load_toml_file
from ..effects import Nuisance, Variant
from ..law import Unloading
from .population import COEFFICIENTS, Population

ALMOST = 0.98  # share of the way to the value of a at which a particle's shape factor would vanish
# Peak stress [MPa] and scaled strain there of the paper's tests, about: what the default priors belong to.
CELLULOSE = 11.0, 0.6
KNEE = 0.1  # share of its prior's scale above which a spread's coordinate is logarithmic
SCALES = 4  # an amplitude's prior is an equal mixture of so many scales, from barely credible to the largest that is
NOISE_PARAMETERS = "noise_displacement_um", "noise_force_mN", "noise_correlated_um", "noise_length"


@dataclass(frozen=True)
class NormalPrior:
    """A normal distribution; raises `InputError` if its standard deviation is not positive."""

    mean: float
    sd: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", arguments.number(self.mean, "the mean of a prior"))
        object.__setattr__(self, "sd", arguments.number(self.sd, "the sd of a prior", above=0))


@dataclass(frozen=True)
class LogNormalPrior:
    """A log-normal distribution: its median, and the standard deviation of the logarithm, both positive."""

    median: float
    log_sd: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "median", arguments.number(self.median, "the median of a prior", above=0))
        object.__setattr__(self, "log_sd", arguments.number(self.log_sd, "the log_sd of a prior", above=0))


@dataclass(frozen=True)
class NakagamiPrior:
    r"""A spread :math:`\tau \ge 0` with the density :math:`p(\tau) \propto \tau^{2m - 1} e^{-\tau^2 / (2 s^2)}`.

    That is Nakagami's distribution (1960) with :math:`\Omega = 2 m s^2`; at m = 1/2 it is half-normal.

    Attributes:
        sd: s, beyond which no spread is expected; at m = 1/2 that of the normal distribution that is cut off below 0.
        shape: m, at most 1/2. At 1/2 all spreads much below s are equally likely. At 1/8 even the order of magnitude is
            open: half of all spreads lie below s/14, one in five below s/560, one in ten below s/9000.
    """

    sd: float
    shape: float = 0.5

    def __post_init__(self) -> None:
        shape = arguments.number(self.shape, "the shape of a spread's prior", above=0, most=0.5)
        object.__setattr__(self, "sd", arguments.number(self.sd, "the scale sd of a spread", above=0))
        object.__setattr__(self, "shape", shape)


class NoisePrior(NamedTuple):
    """Log-normal priors of the four parameters of the noise: medians and standard deviations of the logarithm."""

    median: Float[Any, " 4"]
    log_sd: Float[Any, " 4"]

    def log_density(self, logs: np.ndarray) -> np.ndarray:
        """Log density of the logarithms; shape (..., 4) becomes (...)."""
        sd = np.asarray(self.log_sd)
        away = (logs - np.log(self.median)) / sd
        return np.asarray(-0.5 * np.sum(away**2, -1) - np.sum(np.log(sd * np.sqrt(2 * np.pi))))


@dataclass(frozen=True)
class Priors:
    r"""Priors of the joint calibration.

    Attributes:
        a: shape parameter [-], cut off where any particle's shape factor would not be positive. Dense bodies want
            negative values, porous irregular ones 1 to 2.
        effective_modulus_MPa: Ebar [MPa]; its default depends on the form of unloading, to which it belongs.
        C1: median of C1 over the particles [-], the initial slope of the master curve in MPa.
        C5: median of C5 over the particles [-].
        softening: :math:`9 C_3^6 / (20 C_1 C_5^5)` of the median particle [-], 0.33 in the paper: the share of the
            initial slope that is lost at the curve's bend. It replaces C3, whose median follows. At 1 the curve is flat
            there, beyond 1 its stress falls; most powders stay well below, single particles need not.
        tau_C1, tau_C3, tau_C5: standard deviation of log C over the particles. That of C3 is open in its order of
            magnitude: the paper's 20 particles show none at all (Table 2).
        modulus_scatter, shape_scatter: that of the logarithm of the modulus, and of a, if these may scatter.
        zero_um: how far the true zero of displacement may lie from the recorded contact [um].
        noise_displacement_um, noise_force_mN, noise_correlated_um, noise_length: see `Noise`.
        noise_factor: common factor on the noise as estimated beforehand.
    """

    a: NormalPrior = NormalPrior(1.0, 1.0)
    effective_modulus_MPa: LogNormalPrior = LogNormalPrior(10_000.0, 1.0)
    C1: LogNormalPrior = LogNormalPrior(6.0, 0.5)
    C5: LogNormalPrior = LogNormalPrior(2.7, 0.3)
    softening: LogNormalPrior = LogNormalPrior(0.33, 0.6)
    tau_C1: NakagamiPrior = NakagamiPrior(0.5)
    tau_C3: NakagamiPrior = NakagamiPrior(0.05, shape=0.125)
    tau_C5: NakagamiPrior = NakagamiPrior(0.15)
    modulus_scatter: NakagamiPrior = NakagamiPrior(0.3)
    shape_scatter: NakagamiPrior = NakagamiPrior(0.3)
    zero_um: NormalPrior = NormalPrior(0.0, 5.0)
    noise_displacement_um: LogNormalPrior = LogNormalPrior(0.02, 1.5)
    noise_force_mN: LogNormalPrior = LogNormalPrior(0.05, 1.0)
    noise_correlated_um: LogNormalPrior = LogNormalPrior(0.01, 1.5)
    noise_length: LogNormalPrior = LogNormalPrior(0.2, 1.0)
    noise_factor: LogNormalPrior = LogNormalPrior(1.0, 0.5)

    __repr__ = described()

    @classmethod
    def default(cls, unloading: Unloading | str = Unloading.PRINTED) -> Priors:
        """The defaults; the modulus of a punch form is some twenty times smaller than that of the printed one."""
        unloading = arguments.member(unloading, Unloading, "unloading")
        if unloading is Unloading.PRINTED:
            return cls()
        return cls(effective_modulus_MPa=LogNormalPrior(500.0, 1.0))

    @classmethod
    def of_scale(cls, stress_MPa: float, strain: float, unloading: Unloading | str = Unloading.PRINTED) -> Priors:
        r"""Priors in a campaign's own stress and strain, for a material that is not like microcrystalline cellulose.

        Under a change of units of stress and strain the coefficients go as :math:`C_1 \sim \sigma/\epsilon`,
        :math:`C_5 \sim \sigma^{1/5}/\epsilon` and the modulus as :math:`\sigma/\epsilon^3` (printed form) or
        :math:`\sigma/\epsilon^{3/2}` (punch forms), so medians move with stress and strain at the median test's peak;
        widths are twice those for cellulose. The length of correlated noise stays near its median: noise that is
        correlated over several branches would describe any test.
        """
        base = cls.default(unloading)
        up, along = stress_MPa / CELLULOSE[0], strain / CELLULOSE[1]
        form = arguments.member(unloading, Unloading, "unloading")
        modulus = up / along ** (3.0 if form.stress_power == 1 else 1.5)
        factors = {"C1": up / along, "C5": up**0.2 / along, "softening": 1.0, "effective_modulus_MPa": modulus}
        changed: dict[str, Any] = {"noise_length": LogNormalPrior(base.noise_length.median, 0.25)}
        for name, factor in factors.items():
            prior = getattr(base, name)
            changed[name] = LogNormalPrior(prior.median * factor, 2 * prior.log_sd)
        for name in ("tau_C1", "tau_C3", "tau_C5"):
            prior = getattr(base, name)
            changed[name] = NakagamiPrior(2 * prior.sd, prior.shape)
        return dataclasses.replace(base, **changed)

    @property
    def log_C3(self) -> float:
        """log C3 at the medians of the others."""
        log_C1, log_C5 = np.log(self.C1.median), np.log(self.C5.median)
        return float((np.log(20 / 9) + log_C1 + 5 * log_C5 + np.log(self.softening.median)) / 6)

    @property
    def noise(self) -> NoisePrior:
        """The four priors of the noise together."""
        four = [getattr(self, name) for name in NOISE_PARAMETERS]
        return NoisePrior(np.array([p.median for p in four]), np.array([p.log_sd for p in four]))

    def to_json(self) -> dict[str, Any]:
        """Every prior with its numbers."""
        names = {NormalPrior: "normal", LogNormalPrior: "log-normal", NakagamiPrior: "nakagami"}
        known = vars(self).items()
        return {name: {"distribution": names[type(one)], **dataclasses.asdict(one)} for name, one in known}


def bounds_of_a(flatness: Any) -> tuple[Any, Any]:
    """Between which values of `a` every particle's shape factor is positive, of NumPy's or JAX's arrays."""
    return -ALMOST / flatness.max().clip(1e-3), -ALMOST / flatness.min().clip(None, -1e-3)


def check_prior_of_a(priors: Priors, flatness: np.ndarray) -> None:
    """Raise `InputError` if the prior of `a` leaves no value under which every particle's shape factor is positive."""
    low, high = bounds_of_a(flatness)
    if not (low < priors.a.mean + 6 * priors.a.sd and high > priors.a.mean - 6 * priors.a.sd):
        raise InputError(
            f"the prior of a ({priors.a.mean:g} +- {priors.a.sd:g}) leaves no value under which every particle's shape "
            f"factor is positive ({low:.3g} < a < {high:.3g})",
            remedy="Widen the prior, or check the diameters.",
        )


def read_priors(file: str | Path, unloading: Unloading | str = Unloading.PRINTED) -> Priors:
    """Read priors from a TOML file; what it does not name keeps its default.

    The file holds one table per prior, with the fields of its distribution::

        [a]
        mean = 1.4
        sd = 0.3

    Raises:
        InputError: naming table, entry and what is allowed.
    """
    file = arguments.file_path(file, "file")
    priors = Priors.default(unloading)
    known = vars(priors)
    changes: dict[str, Any] = {}
    for name, entry in load_toml_file(file).items():
        if name not in known:
            remedy = f"Known priors: {', '.join(sorted(known))}."
            raise InputError(f"there is no prior {name!r}", file=file, remedy=remedy)
        remedy = f"Write [{name}] and its {', '.join(vars(known[name]))}."
        if not isinstance(entry, dict):
            raise InputError(f"prior {name!r} must be a table", file=file, remedy=remedy)
        if strange := sorted(set(entry) - set(vars(known[name]))):
            raise InputError(f"prior {name!r} has no entry {strange[0]!r}", file=file, remedy=remedy)
        try:
            numbers = {key: arguments.number(value, f"{name}.{key}") for key, value in entry.items()}
            changes[name] = dataclasses.replace(known[name], **numbers)
        except InputError as error:
            raise InputError(error.problem, file=file, column=name, remedy="Correct the entry.") from None
    return dataclasses.replace(priors, **changes)


# ---- distributions that NumPyro does not have ------------------------------------------------------------------------


def numpy_of(x: Any) -> Any:
    """NumPy of NumPy's arrays and plain numbers, which then compile nothing; JAX's of its own."""
    return jnp if isinstance(x, jax.Array) else np


class SpreadCoordinate(dist.Distribution):
    r"""The coordinate x of a spread :math:`\tau = k s \sinh^p |x|`, p = 1/(2m), whose prior is Nakagami's.

    It may have either sign: the density is even and smooth at 0, so that a spread that is 0 is no boundary and has no
    tail towards minus infinity. Of :math:`\tau^{2m-1}` and :math:`d\tau/dx` only cosh x is left.
    """

    arg_constraints: Any = {}  # noqa: RUF012  # as NumPyro has it
    support: Any = constraints.real

    def __init__(self, prior: NakagamiPrior) -> None:
        m, s = prior.shape, prior.sd
        self.prior, self.power = prior, 1 / (2 * m)
        self.unit = KNEE * s  # the spread where sinh |x| is 1
        # The log density at 0.
        self.constant = -math.lgamma(m) - m * math.log(2 * s**2) + 2 * m * math.log(self.unit) + math.log(self.power)
        super().__init__(batch_shape=(), event_shape=())

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

    logpdf = log_prob  # as SciPy has it

    def rvs(self, size: int, random_state: np.random.Generator) -> np.ndarray:
        """Draws of the coordinate, >= 0, by NumPy."""
        return self.coordinate(self.prior.sd * np.sqrt(2 * random_state.gamma(self.prior.shape, size=size)))

    def sample(self, key: Any, sample_shape: tuple[int, ...] = ()) -> Array:
        """Draws of the coordinate."""
        size, sign = jax.random.split(key)
        tau = self.prior.sd * jnp.sqrt(2 * jax.random.gamma(size, self.prior.shape, sample_shape))
        x = self.coordinate(tau)
        return jnp.where(jax.random.bernoulli(sign, 0.5, sample_shape), x, -x)


class Amplitude(dist.Distribution):
    """The amplitude of an effect in units of the smallest plausible one, along its physical sign: an equal mixture of
    normal distributions, cut off at 0 if of one sign, scales even in the logarithm up to the largest plausible."""

    arg_constraints: Any = {}  # noqa: RUF012  # as NumPyro has it

    def __init__(self, variant: Variant) -> None:
        low, high = variant.plausible
        self.scales = np.geomspace(1.0, high / low, SCALES)
        self.both = variant.sign == 0
        # Softplus keeps the coordinate linear where the amplitude is more than barely plausible.
        self._support = constraints.real if self.both else constraints.softplus_positive
        super().__init__(batch_shape=(), event_shape=())

    def log_prob(self, value: Any, intermediates: Any = None) -> Any:
        """Log density."""
        each = [-0.5 * (value / s) ** 2 - math.log(s * math.sqrt(2 * math.pi)) for s in self.scales.tolist()]
        total = reduce(numpy_of(value).logaddexp, each) - math.log(SCALES)
        return total if self.both else total + math.log(2)

    logpdf = log_prob  # as SciPy has it

    def rvs(self, size: int, random_state: np.random.Generator) -> np.ndarray:
        """Draws by NumPy."""
        drawn = random_state.choice(self.scales, size) * random_state.standard_normal(size)
        return drawn if self.both else np.abs(drawn)

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


# ---- the population's prior by NumPy, which compiles nothing ---------------------------------------------------------


class Sites(NamedTuple):
    """A prior and values of every sampled site of `Model.population`, by name, and the populations of these values."""

    priors: dict[str, Any]
    values: dict[str, np.ndarray]
    population: Population

    def log_densities(self) -> dict[str, np.ndarray]:
        """Log density of the prior of every site at its values."""
        return {name: prior.logpdf(self.values[name]) for name, prior in self.priors.items()}


def population_sites(
    model: Any, flatness: np.ndarray, known: Mapping[str, np.ndarray] | None, rng: Any = None, count: int = 1
) -> Sites:
    """The sites of a `Model` at known numbers of the population, as `coordinates_of` has them, or at prior draws."""
    from scipy.stats import lognorm, norm, truncnorm  # slow to import, so only where it is used

    prior, priors, values = model.chosen_priors, {}, {}
    at: Mapping[str, Any] = known or defaultdict(float)

    def site(name: str, prior: Any, value: Any) -> np.ndarray:
        priors[name] = prior
        values[name] = value if known else prior.rvs(size=count, random_state=rng)
        return values[name]

    def truncated(mean: float, sd: float, low: float, high: float) -> Any:
        return truncnorm((low - mean) / sd, (high - mean) / sd, mean, sd)

    def spread(name: str, prior: Any) -> Any:
        one = SpreadCoordinate(prior)
        return one.spread(site(f"{name}_coordinate", one, one.coordinate(at[name])))

    a = site("a", truncated(prior.a.mean, prior.a.sd, *bounds_of_a(flatness)), at["a"])
    modulus, factor, softening = prior.effective_modulus_MPa, prior.noise_factor, prior.softening
    log_modulus = site("log_modulus", norm(np.log(modulus.median), modulus.log_sd), at["log_modulus"])
    shift = np.log1p(a[:, None] * flatness).mean(-1)
    b1 = site("b1", norm(np.log(prior.C1.median) + shift, prior.C1.log_sd), at["mu_C1"] + shift)
    b5 = site("b5", norm(np.log(prior.C5.median) + shift, prior.C5.log_sd), at["mu_C5"] + shift)
    middle = (np.log(20 / 9 * softening.median) + b1 + 5 * b5) / 6
    b3 = site("b3", norm(middle, softening.log_sd / 6), at["mu_C3"] + shift)
    tau = [spread(f"tau_{name}", getattr(prior, f"tau_{name}")) for name in COEFFICIENTS]
    scatters = [
        spread(name, getattr(prior, name)) if getattr(model, name) else np.zeros_like(a)
        for name in ("modulus_scatter", "shape_scatter")
    ]
    theta, further, own = [], [], []
    for v in model.effects:
        unit = (v.sign or 1) * v.plausible[0]
        theta.append(unit * site(f"{v.mechanism}_size", Amplitude(v), at[v.mechanism] / unit))
        for n in v.nuisances:
            name, (mean, sd) = f"{v.mechanism}.{n.name}", nuisance_moments(n)
            law = lognorm(sd, scale=np.exp(mean)) if n.plausible[0] > 0 else truncated(mean, sd, *n.plausible)
            further.append(site(name, law, at[name]))
        if v.mechanism in model.varying:
            own.append(spread(f"tau_{v.mechanism}", model.spread_prior(v)))
    log_noise = site("log_noise_factor", norm(np.log(factor.median), factor.log_sd), at["noise_factor"])
    mu, tau = np.stack([b1, b3, b5], -1) - shift[:, None], np.stack(tau, -1)
    numbers, spreads = (np.reshape(x, (-1, len(a))).T for x in (theta + further, own))
    fields = (a, log_modulus, mu, tau, *scatters, log_noise, numbers, spreads)
    return Sites(priors, values, jax.vmap(lambda one: Population(*one))(fields))
