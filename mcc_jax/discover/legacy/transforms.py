"""The population's prior in coordinates without bounds, and its most probable value given the summaries."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float, Int

from ..._types import Scalar
from .compiling import compiled
from .population import Population, Scatter, Summary, marginal_likelihood


class PriorNumbers(eqx.Module):
    """The population's priors as arrays, so that other numbers need no new compilation, and where data put its means.

    What data say of a mean is the mean of the particles' b, and how well they say it goes with the spread: a funnel, if
    a mild one. The coordinate of a mean is therefore the mean b, counted from `centre` in units of
    sqrt(tau^2/n + blur^2); a spread's coordinate is logarithmic where the spread is large and, around 0, linear in its
    power 2m of the prior's shape m. Both only help the sampler: the density takes the volumes into account.

    Attributes:
        a: mean, sd, lower and upper bound of the shape parameter.
        log_modulus, mu_1, mu_5: mean and sd.
        softening: mean and sd of its logarithm.
        spread: scale s of the priors of tau 1, 3, 5, of the modulus' and of a's scatter, and the power 1/(2m) to which
            a coordinate is raised.
        log_noise: mean and standard deviation.
        centre: about where the mean b1, b3, b5 of the particles will be found.
        blur: how wide they are where nothing scatters.
        flatness: of the particles.
        weight: 1 for particles, 0 for copies that only fill up; None where all are particles.
    """

    a: Float[Array, " 4"]
    log_modulus: Float[Array, " 2"]
    mu_1: Float[Array, " 2"]
    mu_5: Float[Array, " 2"]
    softening: Float[Array, " 2"]
    spread: Float[Array, "5 2"]
    log_noise: Float[Array, " 2"]
    centre: Float[Array, " 3"]
    blur: Float[Array, " 3"]
    flatness: Float[Array, " particles"]
    weight: Float[Array, " particles"] | None = None

    @property
    def count(self) -> Scalar | int:
        """Number of particles."""
        return len(self.flatness) if self.weight is None else jnp.sum(self.weight)

    def total(self, values: Float[Array, " particles"]) -> Scalar:
        """Sum over the particles."""
        return jnp.sum(values) if self.weight is None else jnp.sum(self.weight * values)

    def mean_log_eta(self, a: Scalar) -> Scalar:
        """Mean logarithm of the particles' shape factors."""
        log_eta = jnp.log(1 + a * self.flatness)
        return jnp.mean(log_eta) if self.weight is None else self.total(log_eta) / self.count


FIRST_SPREAD = 6
"""Position of the first spread among the coordinates: behind a, log modulus, three means and log noise."""

KNEE = 0.1
"""Share of its prior's scale above which a spread's coordinate is logarithmic."""


def spread_of(coordinate: Float[Array, " k"], prior: Float[Array, "k 2"]) -> Float[Array, " k"]:
    r"""Spreads at coordinates x that may have either sign: :math:`\tau = k s \sinh^p |x|`, k the knee."""
    scale, power = prior.T
    return KNEE * scale * jnp.sinh(jnp.abs(coordinate)) ** power


def spread_slope(coordinate: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Derivative of `spread_of` by the size of the coordinate."""
    scale, power = prior.T
    x = np.abs(coordinate)
    return KNEE * scale * power * np.sinh(x) ** (power - 1) * np.cosh(x)


def with_coordinates(scatter: Scatter) -> np.ndarray:
    """Which of the five spreads have a coordinate."""
    return np.asarray([0, 1, 2] + [3] * scatter.modulus + [4] * scatter.shape)


def given_mu_3(mu_1: Scalar, mu_5: Scalar, softening: Float[Array, " 2"]) -> tuple[Scalar, Scalar]:
    r"""Mean and standard deviation of :math:`\mu_3` given the other two, by the prior of the softening.

    .. math:: 6 \mu_3 = \log\tfrac{20}{9} + \mu_1 + 5\mu_5 + \log(\text{softening})
    """
    return (jnp.log(20 / 9) + mu_1 + 5 * mu_5 + softening[0]) / 6, softening[1] / 6


def constrain(free: Float[Array, " d"], numbers: PriorNumbers, scatter: Scatter) -> tuple[Population, Scalar]:
    """The population at unbounded coordinates, and the log density of its prior in those coordinates."""
    mean, sd, low, high = numbers.a
    unit = jax.nn.sigmoid(free[0])
    a = low + (high - low) * unit
    # log of a truncated normal's density, and of da/dfree
    inside = jnp.log(jnp.exp(log_ndtr((high - mean) / sd)) - jnp.exp(log_ndtr((low - mean) / sd)))
    density = -0.5 * ((a - mean) / sd) ** 2 - jnp.log(sd) - inside
    density += jnp.log(high - low) + jax.nn.log_sigmoid(free[0]) + jax.nn.log_sigmoid(-free[0])
    log_modulus, log_noise = free[1], free[5]
    priors = numbers.spread[with_coordinates(scatter)]
    # The coordinate may have either sign: the density is even and smooth at 0, so that a spread that is 0 is no
    # boundary and has no tail towards minus infinity. Of tau^(2m-1) and d tau/dx only cosh x is left.
    signed = free[FIRST_SPREAD : FIRST_SPREAD + scatter.size]
    spread = spread_of(signed, priors)
    density += jnp.sum(-0.5 * (spread / priors[:, 0]) ** 2 + jnp.log(KNEE * jnp.cosh(signed)))
    width = jnp.sqrt(spread[:3] ** 2 / numbers.count + numbers.blur**2)
    mu = numbers.centre + width * free[2:5] - numbers.mean_log_eta(a)
    density += jnp.sum(jnp.log(width))
    mu1, mu3, mu5 = mu
    normal = (
        (log_modulus, numbers.log_modulus),
        (mu1, numbers.mu_1),
        (mu3, given_mu_3(mu1, mu5, numbers.softening)),
        (mu5, numbers.mu_5),
        (log_noise, numbers.log_noise),
    )
    for value, (centre, width) in normal:
        density += -0.5 * ((value - centre) / width) ** 2 - jnp.log(width)
    zero = jnp.zeros(())
    population = Population(
        a,
        log_modulus,
        mu,
        spread[:3],
        spread[3] if scatter.modulus else zero,
        spread[-1] if scatter.shape else zero,
        log_noise,
    )
    return population, density


def unconstrain(
    a: float, log_modulus: float, mu: np.ndarray, tau: np.ndarray, numbers: PriorNumbers, scatter: Scatter
) -> Float[Array, " d"]:
    """Unbounded coordinates of a population, kept away from the bounds of `a`; further scatter begins at a tenth."""
    low, high = np.asarray(numbers.a)[2:]
    unit = np.clip((a - low) / (high - low), 1e-3, 1 - 1e-3)
    scale, power = np.asarray(numbers.spread)[with_coordinates(scatter)].T
    spread = np.concatenate([tau, np.full(scatter.size - 3, 0.1)])
    signed = np.arcsinh((spread / (KNEE * scale)) ** (1 / power))
    width = np.sqrt(np.asarray(tau) ** 2 / float(numbers.count) + np.asarray(numbers.blur) ** 2)
    log_eta = np.log(1 + a * np.asarray(numbers.flatness))
    weight = None if numbers.weight is None else np.asarray(numbers.weight)
    means = (mu + np.average(log_eta, weights=weight) - np.asarray(numbers.centre)) / width
    return jnp.asarray(np.concatenate([[np.log(unit / (1 - unit)), log_modulus, *means, 0.0], signed]))


def recentred(numbers: PriorNumbers, free: Float[Array, " d"]) -> tuple[PriorNumbers, Float[Array, " d"]]:
    """The same population in coordinates whose centre it is."""
    here = np.array(free)
    scale, power = np.asarray(numbers.spread)[:3].T
    tau = KNEE * scale * np.sinh(np.abs(here[FIRST_SPREAD : FIRST_SPREAD + 3])) ** power
    width = np.sqrt(tau**2 / float(numbers.count) + np.asarray(numbers.blur) ** 2)
    centre = np.asarray(numbers.centre) + width * here[2:5]
    here[2:5] = 0.0
    return eqx.tree_at(lambda n: n.centre, numbers, jnp.asarray(centre)), jnp.asarray(here)


class LogPosterior(eqx.Module):
    """The density of the population given all tests, in unbounded coordinates.

    Attributes:
        numbers: the priors, and the coordinates.
        summary: the tests.
        scatter: what scatters.
    """

    numbers: PriorNumbers
    summary: Summary
    scatter: Scatter

    @property
    def flatness(self) -> Float[Array, " particles"]:
        """Flatness of the particles."""
        return self.numbers.flatness

    def population(self, free: Float[Array, " d"]) -> Population:
        """The population at unbounded coordinates."""
        return constrain(free, self.numbers, self.scatter)[0]

    def log_density(self, free: Float[Array, " d"]) -> Scalar:
        """Log density of the population given all tests, up to a constant."""
        population, prior = constrain(free, self.numbers, self.scatter)
        return prior + self.numbers.total(marginal_likelihood(population, self.summary, self.flatness, self.scatter))


ROWS = 250
"""Most coordinates that gradients are asked for in one go."""

LEFT_TO_GAIN = 1e-6
"""Twice the log probability still to gain, by Newton's method, at which a mode is reached."""

ATTEMPTS = 4


@compiled
def _gradients(
    free: Float[Array, "rows d"], count: Int[Array, ""], target: LogPosterior
) -> tuple[Float[Array, " rows"], Float[Array, "rows d"]]:
    expand = jax.value_and_grad(lambda one: -target.log_density(one))

    def add(i, found):
        return jax.tree.map(lambda all_rows, one: all_rows.at[i].set(one), found, expand(free[i]))

    return jax.lax.fori_loop(0, count, add, (jnp.zeros_like(free[:, 0]), jnp.zeros_like(free)))


def gradients(free: np.ndarray, target: LogPosterior) -> tuple[np.ndarray, np.ndarray]:
    """Minus the log density at up to `ROWS` coordinates, shape (many, d), and its gradients.

    Always compiled for `ROWS`, so that few and many of them share their compilation.
    """
    rows = jnp.asarray(np.pad(free, ((0, ROWS - len(free)), (0, 0))))
    value, slope = _gradients(rows, jnp.asarray(np.asarray(len(free))), target)
    return np.asarray(value)[: len(free)], np.asarray(slope)[: len(free)]


def most_probable(
    start: Float[Array, " d"], target: LogPosterior
) -> tuple[Float[Array, " d"], Float[Array, "d d"], bool]:
    """Mode of the population in unbounded coordinates, covariance there, and whether the optimiser converged.

    Newton's method in a trust region (SciPy), in coordinates scaled by the curvature at the start. The curvature comes
    from differences of exact gradients, which are quicker than second derivatives are to compile. Where the density has
    no curvature that is a number, even at the start, the covariance is not one either.
    """
    # Steps may lead to where numbers overflow; they are refused.
    with np.errstate(over="ignore", invalid="ignore"):
        return _most_probable(np.asarray(start), target)


def _most_probable(origin: np.ndarray, target: LogPosterior) -> tuple[Float[Array, " d"], Float[Array, "d d"], bool]:
    d = len(origin)
    width = np.full(d, 1e-5)

    def expand(free: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        steps = np.diag(width)
        points = free + np.concatenate([np.zeros((1, d)), steps, -steps])
        value, slope = gradients(points, target)
        curvature = (slope[1 : d + 1] - slope[d + 1 :]) / (2 * width[:, None])
        return float(value[0]), slope[0], (curvature + curvature.T) / 2

    # Where data are very exact the scales at the start are far from those at the mode: then once more from there.
    success = False
    if not all(np.isfinite(part).all() for part in expand(origin)):
        return jnp.asarray(origin), jnp.asarray(np.full((d, d), np.nan)), False
    for _ in range(ATTEMPTS):
        unit = 1 / np.sqrt(np.maximum(np.abs(np.diagonal(expand(origin)[2])), 1e-8))
        width = 1e-3 * np.minimum(unit, 1.0)
        found = _newton(expand, origin, unit)
        origin = origin + unit * found.x
        success = bool(found.success)
        if success:
            break
    _, slope, curvature = expand(origin)
    # Curvatures differ by many powers of ten: on the scale of each coordinate, what is not convex is taken as wide.
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diagonal(curvature)), 1e-8))
    values, vectors = np.linalg.eigh(curvature * scale * scale[:, None])
    convex = bool(np.all(values > 1e-7))
    values = np.where(values > 1e-7, values, 0.01)
    covariance = (vectors / values) @ vectors.T * scale * scale[:, None]
    # Rounding may keep the optimiser from its tolerance at the very mode: what counts is what is left to gain.
    there = convex and float(slope @ covariance @ slope) < LEFT_TO_GAIN
    return jnp.asarray(origin), jnp.asarray(covariance), success or there


def _newton(expand: Callable[[np.ndarray], tuple[float, np.ndarray, np.ndarray]], origin: np.ndarray, unit: np.ndarray):
    from scipy.optimize import minimize

    memory: dict[bytes, tuple[float, np.ndarray, np.ndarray]] = {}

    def at(z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        key = z.tobytes()
        if key not in memory:
            memory.clear()
            found = expand(origin + unit * z)
            # A step may lead to where spreads overflow: then it is refused, for which SciPy wants finite derivatives.
            if not all(np.isfinite(part).all() for part in found):
                found = (np.inf, np.zeros_like(origin), np.eye(len(origin)))
            memory[key] = found
        return memory[key]

    return minimize(
        lambda z: at(z)[0],
        np.zeros_like(origin),
        jac=lambda z: at(z)[1] * unit,
        hess=lambda z: at(z)[2] * unit * unit[:, None],
        method="trust-exact",
        options={"gtol": 1e-4, "maxiter": 200},
    )
