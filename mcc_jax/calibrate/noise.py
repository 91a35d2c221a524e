r"""Noise of a test: white read-out noise, noise of force, and residuals that are correlated along its path.

.. math:: d_k - z - \gamma_k = o_k + w_k, \qquad
    w_k \sim N(0,\, s_i^2 (\sigma_w^2 + \sigma_F^2 \gamma'^2_k)), \qquad
    \mathrm{Cov}(o_k, o_l) = s_i^2 \sigma_o^2\, \rho(|p_k - p_l| / \ell)

with p the path length of force in shares of the peak, or time, :math:`\rho` an exponential or Matern correlation, and a
scale s_i of each particle's own. The force from which a branch starts has an error of its own, which moves the whole
branch: a variance :math:`s_i^2 \sigma_F^2 c c^T` with c the change of the branch with its peak. The covariance is never
formed: tinygp factors its quasiseparable part in linear time, and each branch's direction is then shrunk.
"""

from __future__ import annotations

import enum
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from tinygp.kernels import quasisep
from tinygp.noise import Diagonal
from tinygp.solvers.quasisep.solver import QuasisepSolver

from .._types import Path, Scalar
from .data import READING_UM, Tests
from .forward import Linear
from .priors import NoisePrior
from .running import compiled
from .small_matrices import eliminate


class Correlation(enum.Enum):
    """How residuals that are not white are autocorrelated: how rough they are."""

    EXPONENTIAL = "exponential"
    MATERN_32 = "matern-3/2"
    MATERN_52 = "matern-5/2"


KERNELS = {
    Correlation.EXPONENTIAL: quasisep.Exp,
    Correlation.MATERN_32: quasisep.Matern32,
    Correlation.MATERN_52: quasisep.Matern52,
}


class Along(enum.Enum):
    """What residuals are correlated along."""

    LOAD = "load"
    TIME = "time"


class Noise(eqx.Module):
    """Standard deviations of white noise of displacement [um] and force [mN] and of the correlated residual [um]."""

    displacement: Scalar
    force: Scalar
    correlated: Scalar
    length: Scalar  # of the correlation, in shares of the peak force passed [-] or in seconds
    scale: Float[Array, " particles"]  # each particle's factor on all [-]

    @property
    def logs(self) -> Float[Array, " 4"]:
        """Logarithms of the four numbers."""
        return jnp.log(jnp.stack([self.displacement, self.force, self.correlated, self.length]))

    @classmethod
    def of(cls, numbers: Sequence[float] | np.ndarray, scale: Float[Array, " particles"]) -> Noise:
        """From the four numbers, outside compiled functions."""
        return cls(*(jnp.asarray(np.asarray(v, float)) for v in numbers), scale=scale)

    @classmethod
    def from_logs(cls, logs: Float[Array, " 4"], scale: Float[Array, " particles"]) -> Noise:
        """From the logarithms of the four numbers."""
        return cls(*jnp.exp(logs), scale=scale)


# Variance of a point that does not count [um^2]: beyond any reading, and far from where doubles lose digits.
MASKED_UM2 = 1e12


class Whitening(eqx.Module):
    """The factored covariance of one test's noise, which turns residuals into independent ones of variance 1."""

    solver: QuasisepSolver  # the factor of the quasiseparable part, white and correlated noise
    mask: Bool[Array, " steps"]
    peak: Path  # the whitened changes of every point with the error of its branch's peak
    branch: Int[Array, " steps"]
    common: Path | None = None  # the same with the error of the zero of force
    weights: Path | None = None

    def __call__(self, values: Float[Array, "steps columns"]) -> Float[Array, "steps columns"]:
        """Columns of values over the points, independent and of variance 1; they must be 0 where masked."""
        white = forward_substitution(self.solver, values)
        # 1 + p is the variance along a branch's direction: along it, and only there, divide by its root.
        shrink = _shrink(self._power())
        along = jax.ops.segment_sum(self.peak[:, None] * white, self.branch, len(self.peak))
        white = white - self.peak[:, None] * (shrink[:, None] * along)[self.branch]
        if self.common is None:
            return white
        return white - self.common[:, None] * (_shrink(self.common @ self.common) * (self.common @ white))[None]

    def colour(self, white: Path, of_branches: Path, of_zero: Scalar) -> Path:
        """A draw of the noise [um] from standard normal numbers: of every point, every branch and the zero of force."""
        power = self._power()
        drawn = white + self.peak * of_branches[self.branch]
        if self.common is not None:
            # `common` has been shrunk along the branches: along them, multiply by the root again.
            along = jax.ops.segment_sum(self.peak * self.common, self.branch, len(self.peak))
            grown = self.common + self.peak * (along / (1 + jnp.sqrt(1 + power)))[self.branch]
            drawn = drawn + grown * of_zero
        with standard_promotion():
            return self.solver.dot_triangular(drawn)

    @property
    def log_det(self) -> Scalar:
        """Logarithm of the covariance's determinant, over the points that count."""
        diagonal = self.solver.factor.diag.d
        own = 2 * jnp.sum(jnp.where(self.mask, jnp.log(jnp.where(self.mask, diagonal, 1.0)), 0.0))
        shared = 0.0 if self.common is None else jnp.log1p(self.common @ self.common)
        return own + jnp.sum(jnp.log1p(self._power())) + shared

    @property
    def information(self) -> Scalar:
        """Sum over the points that count of one over the variance of each given those before [1/um^2]."""
        return jnp.sum(jnp.where(self.mask, self.solver.factor.diag.d**-2.0, 0.0))

    def log_density(self, away: Path, log_factor: Scalar) -> Scalar:
        """Log density of a test's residuals [um], 0 where masked, under the noise times a common factor."""
        squares = jnp.sum(self(away[:, None]) ** 2) + self.reading
        count = jnp.sum(jnp.where(self.mask, float(np.log(2 * np.pi)), 0.0))
        constant = self.log_det + 2 * self.points * log_factor + count
        return -0.5 * (jnp.exp(-2 * log_factor) * squares + constant)

    @property
    def points(self) -> Scalar:
        """Number of readings that count, each with its weight: what a factor on all noise is known by."""
        return jnp.sum(jnp.where(self.mask, 1.0 if self.weights is None else self.weights, 0.0))

    @property
    def reading(self) -> Scalar:
        """Sum of squares that reading a display of finite steps alone brings about, however well the law fits."""
        return READING_UM**2 * self.information

    def _power(self) -> Path:
        return jax.ops.segment_sum(self.peak**2, self.branch, len(self.peak))


def _shrink(power: Array) -> Array:
    """(1 - 1/sqrt(1 + p))/p, finite at p = 0."""
    root = jnp.sqrt(1 + power)
    return 1 / (root * (1 + root))


_TRACING = threading.RLock()


@contextmanager
def standard_promotion() -> Iterator[None]:
    """JAX's usual promotion of types and ranks, on which NumPyro and tinygp count; for one thread at a time, since
    NumPyro keeps its handlers in one list for all of them."""
    with _TRACING, jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def forward_substitution(
    solver: QuasisepSolver, values: Float[Array, "steps columns"]
) -> Float[Array, "steps columns"]:
    """The factor's lower triangular system solved, in half the time of tinygp's `solve_triangular` on a CPU: its
    products of tiny matrices are calls of a library at every step; as sums they are part of the loop."""
    (diagonal,), (left, right, transition) = solver.factor

    def step(state: Array, at: tuple[Array, ...]) -> tuple[Array, Array]:
        diagonal, left, right, transition, value = at
        white = (value - jnp.sum(left[:, None] * state, 0)) / diagonal
        return jnp.sum(transition[:, :, None] * state[None], 1) + right[:, None] * white[None], white

    start = jnp.zeros((left.shape[1], values.shape[1]), values.dtype)
    return jax.lax.scan(step, start, (diagonal, left, right, transition, values))[1]


def places(tests: Tests, along: Along) -> Array:
    """What the correlation of residuals is measured by: shares of the peak force passed [-], or time [s]."""
    return tests.path if along is Along.LOAD else tests.record.time


def whitening(
    noise: Noise, scale: Scalar, tests: Tests, linear: Linear, correlation: Correlation, along: Along
) -> Whitening:
    """The factored covariance of one test: tests and linear have no axis of particles, and the scale is this particle's
    in place of `noise.scale`."""
    variance = jnp.where(tests.mask, scale**2 * _read_out(noise, tests, linear), MASKED_UM2)
    with standard_promotion():
        kernel = KERNELS[correlation](scale=noise.length, sigma=scale * noise.correlated)
        solver = QuasisepSolver(kernel, places(tests, along), Diagonal(variance), assume_sorted=True)
    error = scale * noise.force * tests.peak_error
    if tests.peak_sd is not None:
        # A root has no slope at 0, and most peaks were read and not worked out.
        known = tests.peak_sd > 0
        error = jnp.where(known, jnp.sqrt(jnp.where(known, error**2 + tests.peak_sd**2, 1.0)), error)
    peak = forward_substitution(solver, (error * linear.by_peak)[:, None])[:, 0]
    found = Whitening(solver, tests.mask, peak, tests.branch, None, tests.reading_weight)
    if tests.force_zero_sd is None:
        return found
    return replace(found, common=found((tests.force_zero_sd * linear.by_offset)[:, None])[:, 0])


def correlations(tests: Tests, length: float, correlation: Correlation, along: Along) -> np.ndarray:
    """Correlation of the residuals that are not white, between all points of every test."""
    with standard_promotion():
        kernel = KERNELS[correlation](scale=length, sigma=1.0)
        return np.asarray(jax.vmap(lambda x: kernel(x, x))(jnp.asarray(places(tests, along))))


def _read_out(noise: Noise, tests: Tests, linear: Linear) -> Array:
    variance = noise.displacement**2 + (noise.force * linear.by_force) ** 2
    return variance if tests.reading_weight is None else variance / tests.reading_weight


# Degrees of freedom of robust noise (Lange, Little and Taylor 1989): weights fall off from two deviations on.
FREEDOM = 4.0


@compiled
def squared_innovations(
    tests: Tests, filters: Whitening, linear: Linear, noise: Noise
) -> Float[Array, "particles points"]:
    """Squares of the residuals, each given those before it, in variances that they have at a weight of 1."""

    def one(scale: Scalar, tests: Tests, filters: Whitening, linear: Linear) -> Array:
        white = filters(linear.residual[:, None])[:, 0]
        variance = filters.solver.factor.diag.d**2
        weight = jnp.ones(()) if tests.reading_weight is None else tests.reading_weight
        own = scale**2 * _read_out(noise, tests, linear)
        return jnp.where(tests.mask, white**2 * variance / (variance + own * (weight - 1)), 0.0)

    return jax.vmap(one)(noise.scale, tests, filters, linear)


def student_weights(squares: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, float]:
    r"""Weights :math:`(\nu + 1)/(\nu + z^2)` of readings under Student noise, and by how much they overstate them.

    They are those of the EM algorithm, for squares z^2 of shape (N, points). Taken for known they make the readings
    look more exact than they are, by the ratio of Huber's sandwich variance of a mean to the weighted one.
    """
    weight = np.where(mask, (FREEDOM + 1) / (FREEDOM + squares), 1.0)
    z2, w = squares[mask], weight[mask]
    slope = (FREEDOM + 1) * (FREEDOM - z2) / (FREEDOM + z2) ** 2
    sandwich = np.mean(w**2 * z2) / np.maximum(np.mean(slope), 0.1) ** 2
    return weight, float(max(sandwich * np.mean(w) / np.mean(w * z2), 1.0))


@compiled
def grams_and_likelihoods(
    scale: Float[Array, " particles"],
    tests: Tests,
    linear: Linear,
    logs: Float[Array, "many 4"],
    zero_sd: Scalar,
    correlation: Correlation,
    along: Along,
) -> tuple[Float[Array, "particles many q q"], Float[Array, "particles many"]]:
    """Gram matrix of each test's effects and residual under each of many noises, and log likelihood without effects.
    The particle's b1, b3, b5, e and zero are integrated out, with wide standard deviations, 1 and `zero_sd`."""

    def of_each(logs: Array) -> tuple[Array, Array]:
        noise = Noise.from_logs(logs, scale)

        def of_one(scale: Scalar, tests: Tests, linear: Linear) -> tuple[Array, Array]:
            filtered = whitening(noise, scale, tests, linear, correlation, along)
            own = linear.columns[:, :4], jnp.where(tests.mask, zero_sd, 0.0)[:, None]
            white = filtered(jnp.concatenate([*own, linear.columns[:, 4:], linear.residual[:, None]], 1))
            left, log_integral = eliminate(white.T @ white, tuple(range(5)), jnp.ones(5))
            return left, log_integral - 0.5 * filtered.log_det - 0.5 * left[-1, -1]

        return jax.vmap(of_one)(scale, tests, linear)

    return jax.vmap(of_each, out_axes=1)(logs)


# Steps of the differences in the logarithms; the loss is smooth on the scale of 1 and exact to 1e-12 of its size.
STEP, WIDE_STEP = 1e-3, 0.02
OUTLYING = 5.0  # a particle whose noise differs by so many standard deviations keeps its own scale; found by trial


class NoiseFit(eqx.Module):
    """The noise of a campaign, whether the optimiser converged, and, NaN where not worked out, covariance of the
    logarithms of its four numbers and what these add to a log marginal likelihood (log prior and Laplace's volume)."""

    noise: Noise
    converged: bool = eqx.field(static=True)
    covariance: Array = eqx.field(default_factory=lambda: jnp.asarray(np.full((4, 4), np.nan)))
    log_evidence: Array = eqx.field(default_factory=lambda: jnp.asarray(np.nan))

    @property
    def log_sd(self) -> np.ndarray:
        """Standard deviations of the logarithms of the four numbers."""
        return np.sqrt(np.diagonal(np.asarray(self.covariance)))


def estimate_noise(
    log_likelihoods: Callable[[Array], Array], prior: NoisePrior, start: Noise, *, uncertainty: bool = True
) -> NoiseFit:
    """Noise by restricted maximum likelihood with its prior and the scales at the start, from log likelihoods of each
    particle under many logarithms of the four numbers, shape (particles, many)."""
    from scipy.optimize import minimize

    def value_and_gradient(logs: np.ndarray) -> tuple[float, np.ndarray]:
        # Differences, all of them in one batch, are cheaper than derivatives to compile.
        at = logs + STEP * np.concatenate([np.zeros((1, 4)), np.eye(4), -np.eye(4)])
        # Summed here, in one order, however the particles are spread.
        values = -(np.sum(np.asarray(log_likelihoods(jnp.asarray(at))), axis=0) + prior.log_density(at))
        return float(values[0]), (values[1:5] - values[5:]) / (2 * STEP)

    # No instrument reads better than a few tenths of a nanometre: noise-free data, of a simulation say, get that much.
    bounds = [(m - 3 * s, m + 6 * s) for m, s in zip(np.log(prior.median), np.asarray(prior.log_sd), strict=True)]
    inside = np.clip(np.asarray(start.logs), *np.transpose(bounds))
    found = minimize(value_and_gradient, inside, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-9})
    noise, converged = Noise.of(np.exp(found.x), start.scale), bool(found.success)
    if not uncertainty:
        return NoiseFit(noise, converged)
    steps = WIDE_STEP * np.eye(4)
    up, down = (np.array([value_and_gradient(found.x + step)[1] for step in way]) for way in (steps, -steps))
    curvature = (up - down) / (2 * WIDE_STEP)
    if not np.isfinite(curvature).all():
        return NoiseFit(noise, converged=False)
    values, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
    values = np.maximum(values, 1e-6)
    volume = float(prior.log_density(found.x)) + 2 * np.log(2 * np.pi) - 0.5 * np.sum(np.log(values))
    return NoiseFit(noise, converged, jnp.asarray((vectors / values) @ vectors.T), jnp.asarray(volume))


def particle_scales(scale: np.ndarray, squares: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Every particle's scale from its sum of squares, whitened with the given scales and of so many degrees of freedom,
    pulled towards 1 unless they scatter beyond chance."""
    freedom = np.maximum(freedom, 1)
    log_scale = np.log(scale) + 0.5 * np.log(np.maximum(squares / freedom, 1e-12))
    chance = 0.5 / freedom
    away = log_scale - np.median(log_scale)
    spread = 1.4826 * np.median(np.abs(away))
    scatter = spread**2 - np.median(chance)
    # Up to twice the uncertainty of this estimate itself, all particles share one scale, but for outliers.
    if scatter <= 2 * np.median(chance) * np.sqrt(2 / len(log_scale)):
        scatter = 0.0
    outlier = np.abs(away) > OUTLYING * np.sqrt(scatter + chance)
    return np.exp(np.where(outlier, away, scatter / (scatter + chance) * away))
