r"""Noise of a test: white read-out noise, noise of force, and residuals that are correlated along the load path.

.. math:: d_k - z - \gamma_k = o_k + w_k, \qquad
    w_k \sim N(0,\, s_i^2 (\sigma_w^2 + \sigma_F^2 \gamma'^2_k)), \qquad
    \mathrm{Cov}(o_k, o_l) = s_i^2 \sigma_o^2 \exp(-|p_k - p_l| / \ell)

with p the path length of force in shares of the peak (an Ornstein-Uhlenbeck process along it), and a scale s_i of each
particle's own. The peak from which an elastic branch starts is one noisy reading, too, and moves the whole branch: a
variance :math:`s_i^2 \sigma_F^2 c c^T` with c the change of the branch with its peak. The covariance is never formed: a
Kalman filter turns residuals into independent ones in linear time, and each branch's direction is then shrunk.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._types import Path, Scalar
from ...calibrate.settings import PAPER
from .compiling import compiled
from .sharding import Blocks, Parts
from .small_matrices import Cholesky


class Noise(eqx.Module):
    """Standard deviations of a campaign's noise.

    Attributes:
        displacement: white noise of displacement [um].
        force: white noise of force [mN].
        correlated: standard deviation of the correlated residual [um].
        length: its correlation length, in shares of the peak force passed [-].
        scale: each particle's own factor on all of them [-], shape (N,).
    """

    displacement: Scalar
    force: Scalar
    correlated: Scalar
    length: Scalar
    scale: Float[Array, " particles"]

    @property
    def logs(self) -> Float[Array, " 4"]:
        """Logarithms of the four numbers."""
        return jnp.log(jnp.stack([self.displacement, self.force, self.correlated, self.length]))

    @classmethod
    def of(cls, numbers: Sequence[float] | np.ndarray, scale: Float[Array, " particles"]) -> Noise:
        """From the four numbers, outside compiled functions."""
        displacement, force, correlated, length = (jnp.asarray(np.asarray(v, float)) for v in numbers)
        return cls(displacement, force, correlated, length, scale)

    @classmethod
    def from_logs(cls, logs: Float[Array, " 4"], scale: Float[Array, " particles"]) -> Noise:
        """From the logarithms of the four numbers."""
        displacement, force, correlated, length = jnp.exp(logs)
        return cls(displacement, force, correlated, length, scale)


class Whitening(eqx.Module):
    """The Kalman filter of one test, ready to whiten any residuals of it; linear.

    Attributes:
        decay: correlation with the point before.
        gain: share of a surprise that the correlated part takes.
        weight: one over the standard deviation of a surprise, 0 where the point is masked.
        peak: whitened change of every point with the noise of its branch's peak, 0 on loading.
        branch: which branch a point belongs to.
        common: whitened change of every point with the error of the zero of force, which all points share; None where
            no zero was measured.
    """

    decay: Path
    gain: Path
    weight: Path
    peak: Path
    branch: Int[Array, " steps"]
    common: Path | None = None

    def __call__(self, residual: Path) -> Path:
        """Independent residuals of standard deviation 1 (0 where masked)."""

        def advance(expected, point):
            r, decay, gain = point
            surprise = r - decay * expected
            return decay * expected + gain * surprise, surprise

        _, surprise = jax.lax.scan(advance, jnp.zeros_like(residual[0]), (residual, self.decay, self.gain))
        white = surprise * self.weight
        # 1 + p is the variance along a branch's direction: along it, and only there, divide by its root.
        power = self._power()
        shrink = (1 - 1 / jnp.sqrt(1 + power)) / jnp.where(power > 0, power, 1.0)
        along = jax.ops.segment_sum(self.peak * white, self.branch, len(white))
        white = white - self.peak * (shrink * along)[self.branch]
        if self.common is None:
            return white
        shared = self.common @ self.common
        # Division by its root along one more direction; the second form of (1 - 1/sqrt(1 + p))/p is finite at p = 0.
        root = jnp.sqrt(1 + shared)
        return white - self.common * (self.common @ white) / (root * (1 + root))

    @property
    def least_squares(self) -> Scalar:
        """Sum of squares that reading alone brings about, however well the law fits."""
        return PAPER.reading_um**2 * jnp.sum(self.weight**2)

    def _power(self) -> Path:
        return jax.ops.segment_sum(self.peak**2, self.branch, len(self.peak))

    @property
    def log_det(self) -> Scalar:
        """Logarithm of the covariance's determinant, over the points that are not masked."""
        used = self.weight > 0
        own = -2 * jnp.sum(jnp.where(used, jnp.log(jnp.where(used, self.weight, 1.0)), 0.0))
        shared = 0.0 if self.common is None else jnp.log1p(self.common @ self.common)
        return own + jnp.sum(jnp.log1p(self._power())) + shared


def whitening(
    noise: Noise,
    scale: Scalar,
    step: Path,
    mask: Bool[Array, " steps"],
    compliance: Path,
    peak: Path,
    branch: Int[Array, " steps"],
    peak_sd: Path | None = None,
    common: Path | None = None,
) -> Whitening:
    """The filter of one test.

    Args:
        noise: the campaign's noise; `noise.scale` is not used.
        scale: this particle's scale.
        step: path length since the point before [-].
        mask: which points count.
        compliance: how far noise of force moves the predicted displacement [um/mN].
        peak: how far noise of the branch's peak force moves it [um/mN].
        branch: which branch a point belongs to.
        peak_sd: standard deviation of the branch's peak force where it was worked out, not read [mN]; None where all
            were read.
        common: how far one standard deviation of the zero of force moves the predicted displacement [um]; None where
            no zero was measured.
    """
    decay = jnp.exp(-step / noise.length)
    stationary = noise.correlated**2
    read_out = noise.displacement**2 + (noise.force * compliance) ** 2

    def advance(variance, point):
        decay, used, own = point
        variance = decay**2 * variance + (1 - decay**2) * stationary
        total = variance + own
        gain = jnp.where(used, variance / total, 0.0)
        return (1 - gain) * variance, (gain, total)

    _, (gain, total) = jax.lax.scan(advance, stationary, (decay, mask, read_out))
    weight = jnp.where(mask, 1 / (scale * jnp.sqrt(total)), 0.0)
    still = Whitening(decay, gain, weight, jnp.zeros_like(step), branch)
    read = scale * noise.force
    level = read if peak_sd is None else jnp.sqrt(read**2 + peak_sd**2)
    filtered = Whitening(decay, gain, weight, still(jnp.where(mask, level * peak, 0.0)), branch)
    if common is None:
        return filtered
    return Whitening(decay, gain, weight, filtered.peak, branch, filtered(jnp.where(mask, common, 0.0)))


class Linear(eqx.Module):
    """Residuals of N tests, linear in each particle's own parameters around a point.

    Attributes:
        residual: at the point [um].
        jacobian: derivative with respect to the particle's P parameters.
        prior: precision that keeps directions without data in place.
        step, mask, compliance, peak, branch, peak_sd, common: as in `whitening`.
        weight: 1 for particles, 0 for copies that only fill up; None where all are particles.
    """

    residual: Float[Array, "particles points"]
    jacobian: Float[Array, "particles points P"]
    prior: Float[Array, "particles P"]
    step: Float[Array, "particles points"]
    mask: Bool[Array, "particles points"]
    compliance: Float[Array, "particles points"]
    peak: Float[Array, "particles points"]
    branch: Int[Array, "particles points"]
    weight: Float[Array, " particles"] | None = None
    peak_sd: Float[Array, "particles points"] | None = None
    common: Float[Array, "particles points"] | None = None


def restricted_likelihood(noise: Noise, data: Linear) -> Float[Array, " particles"]:
    """Log likelihood of each test under the noise, with the particle's own parameters integrated out."""

    def one(scale, residual, jacobian, prior, *path):
        filtered = whitening(noise, scale, *path)
        r = filtered(residual)
        J = jax.vmap(filtered, in_axes=1, out_axes=1)(jacobian)
        factor = Cholesky(J.T @ J + jnp.diag(prior))
        explained = factor.forward(J.T @ r)
        return -0.5 * (filtered.log_det + r @ r - explained @ explained + factor.log_det())

    return jax.vmap(one)(
        noise.scale,
        data.residual,
        data.jacobian,
        data.prior,
        data.step,
        data.mask,
        data.compliance,
        data.peak,
        data.branch,
        data.peak_sd,
        data.common,
    )


class NoisePrior(eqx.Module):
    """Log-normal priors of the four numbers of the noise: medians and standard deviations of the logarithm."""

    median: Float[Array, " 4"]
    log_sd: Float[Array, " 4"]

    def log_density(self, logs: np.ndarray) -> np.ndarray:
        """Log density of the logarithms, up to a constant; shape (..., 4) becomes (...)."""
        return np.asarray(-0.5 * np.sum(((logs - np.log(self.median)) / np.asarray(self.log_sd)) ** 2, -1))


@compiled
def likelihoods(
    logs: Float[Array, "many 4"], scale: Float[Array, " particles"], data: Linear
) -> Float[Array, "many particles"]:
    """Log likelihood of each test under each of many noises; 0 of copies that only fill up."""
    each = jax.vmap(lambda one: restricted_likelihood(Noise.from_logs(one, scale), data))(logs)
    return each if data.weight is None else data.weight[None] * each


STEP = 1e-3
"""Step of the differences in the logarithms; the loss is smooth on the scale of 1 and exact to 1e-12 of its size."""

DIFFERENCES = STEP * np.concatenate([np.zeros((1, 4)), np.eye(4), -np.eye(4)])
"""What is added to the logarithms for a value and its gradient."""


def estimate_noise(
    data: Linear | Parts,
    prior: NoisePrior,
    start: Noise,
    *,
    uncertainty: bool = True,
    blocks: Blocks | None = None,
) -> tuple[Noise, Float[Array, " 4"], bool]:
    """Noise by restricted maximum likelihood with its prior.

    The particles' scales stay as they are (`particle_scales`). Derivatives with respect to four numbers are cheaper as
    differences, all of them in one batch, than to compile.

    Args:
        data: linear residuals; with `blocks`, of this process's own particles.
        prior: prior of the four numbers.
        start: where to begin, and the particles' scales.
        uncertainty: whether to work out standard deviations.
        blocks: how the particles are cut; all in one block by default.

    Returns:
        The noise, standard deviations of the logarithms of its four numbers (or NaN), and whether the optimiser
        converged.
    """
    from scipy.optimize import minimize

    blocks = blocks or Blocks(len(start.scale))
    own = data if isinstance(data, Parts) else blocks.cut(data)
    scale = blocks.cut(start.scale)

    def value_and_gradient(logs: np.ndarray) -> tuple[float, np.ndarray]:
        at = logs + DIFFERENCES
        each = blocks.whole(blocks.each(likelihoods, jnp.asarray(at), scale, own, axis=1))
        # Summed here, in one order, however the particles are spread.
        values = -(np.sum(np.asarray(each), axis=1) + prior.log_density(at))
        return float(values[0]), (values[1:5] - values[5:]) / (2 * STEP)

    # No tester reads better than a few tenths of a nanometre: noise-free data, of a simulation say, get that much.
    bounds = [(m - 3 * s, m + 6 * s) for m, s in zip(np.log(prior.median), np.asarray(prior.log_sd), strict=True)]
    numbers = start.displacement, start.force, start.correlated, start.length
    inside = np.clip(np.log([float(v) for v in numbers]), *np.transpose(bounds))
    found = minimize(value_and_gradient, inside, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-9})
    noise = Noise.of(np.exp(found.x), start.scale)
    if not uncertainty:
        return noise, jnp.asarray(np.full(4, np.nan)), bool(found.success)
    width = 0.02
    columns = [
        (value_and_gradient(found.x + width * e)[1] - value_and_gradient(found.x - width * e)[1]) / (2 * width)
        for e in np.eye(4)
    ]
    if not np.isfinite(columns).all():
        return noise, jnp.asarray(np.full(4, np.nan)), False
    values, vectors = np.linalg.eigh((np.array(columns) + np.array(columns).T) / 2)
    sd = np.sqrt(np.sum(vectors**2 / np.maximum(values, 1e-6), axis=1))
    return noise, jnp.asarray(sd), bool(found.success)


OUTLYING = 5.0
"""A particle whose noise differs by this many standard deviations keeps its own scale whatever the others do."""


def particle_scales(scale: np.ndarray, squares: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Every particle's scale from its whitened sum of squares, pulled towards 1 unless they scatter beyond chance.

    Args:
        scale: scales that the sums were whitened with, shape (N,).
        squares: sums of squares of whitened residuals, shape (N,).
        freedom: degrees of freedom, shape (N,).
    """
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
