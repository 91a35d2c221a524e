"""Every particle by itself: starts without iteration, then its own least squares from several of them."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._types import Path, Scalar
from ..geometry import Particle
from .compiling import compiled
from .data import Tests
from .forward import Forms, Point, linearise, snap
from .settings import FIT
from .small_matrices import Cholesky


class ParticleFits(eqx.Module):
    """Fits of single particles.

    Attributes:
        point: where they ended.
        rms: root mean square residual [um].
        converged: whether the best start's fit met its tolerances.
        ends: where the fit from each start ended: b1, b3, b5, e, zero and the amplitudes that vary.
        settled: whether the fits from all starts met their tolerances.
    """

    point: Point
    rms: Float[Array, " particles"]
    converged: Bool[Array, " particles"]
    ends: Float[Array, "particles starts p"]
    settled: Bool[Array, " particles"]


def _polynomial(x: Path, stress: Path, weight: Path) -> Float[Array, " 3"]:
    """K1, K3, K5 by linear least squares."""
    design = jnp.stack([x, -(x**3), x**5], 1) * weight[:, None]
    scale = jnp.sqrt(jnp.sum(design**2, axis=0)) + 1e-30
    scaled = design / scale[None]
    ridge = jnp.eye(3) * 1e-9
    return Cholesky(scaled.T @ scaled + ridge).solve(scaled.T @ (stress * weight)) / scale


def linear_start(
    particle: Particle, force: Path, measured: Path, loading: Bool[Array, " steps"], contact: Scalar
) -> tuple[Float[Array, " 3"], Scalar]:
    """Coefficients (as b) and zero of one particle from its loading, without iteration.

    Stress is linear in the three coefficients at a given zero, so zeros are tried on a grid; deviations of stress are
    divided by the slope, which makes them deviations of strain.
    """
    stress = particle.stress(force)
    reach = particle.effective_diameter
    top = jnp.max(jnp.where(loading, stress, 0.0))

    def at(shift):
        x = jnp.where(loading, (measured - contact) / reach - shift, 0.0)
        possible = jnp.all(jnp.where(loading, x > 1e-4, True))
        x = jnp.maximum(x, 1e-4)
        used = jnp.where(loading, 1.0, 0.0)
        K = _polynomial(x, stress, used)

        def slope(K):
            return jnp.maximum(K[0] - 3 * K[1] * x**2 + 5 * K[2] * x**4, 0.05 * top / jnp.max(x))

        for _ in range(2):
            K = _polynomial(x, stress, used / slope(K))
        # Each term carries at least a hundredth of the largest stress: logarithms follow.
        far = jnp.max(x)
        K = jnp.maximum(K, 0.01 * top / jnp.stack([far, far**3, far**5]))
        deviation = (K[0] * x - K[1] * x**3 + K[2] * x**5 - stress) / slope(K)
        return jnp.where(possible, jnp.sum(used * deviation**2), jnp.inf), K

    shifts = jnp.linspace(-FIT.zero_reach, FIT.zero_reach, FIT.zeros)
    losses, coefficients = jax.vmap(at)(shifts)
    best = jnp.argmin(losses)
    K = jnp.where(jnp.isfinite(losses[best]), coefficients[best], jnp.array([6.0, 27.0, 144.0]))
    return jnp.log(K) / jnp.array([1.0, 3.0, 5.0]), contact + shifts[best] * reach


@compiled
def linear_starts(tests: Tests, log_modulus: Scalar) -> Float[Array, "starts particles 5"]:
    """Several starts for every particle: the linear one and variations of it."""
    assert tests.displacement is not None
    b, zero = jax.vmap(linear_start)(tests.particle, tests.force, tests.displacement, tests.loading, tests.contact)
    first = jnp.concatenate([b, jnp.full((len(tests), 1), log_modulus), zero[:, None]], 1)
    return first[None] + jnp.pad(jnp.asarray(FIT.variations), ((0, 0), (0, 2)))[:, None]


def fit_particles(
    tests: Tests, noise: Any, centre: Any, width: Any, theta: Any, starts: Any, forms: Forms,
    varying: tuple[int, ...] = (), most_steps: int = FIT.steps,
) -> ParticleFits:  # fmt: skip
    """Fit every particle by itself, its modulus included, from several starts, by Levenberg's and Marquardt's method.

    The law is linearised by the programs that every other fit uses, as many particles at a time as there are; a start
    that has converged takes no further part.

    Args:
        noise: scale of each particle's residuals [um].
        centre, width: normal prior of each particle's b1, b3, b5, e, zero [um], and the amplitudes that vary, shape
            (particles, p).
        theta: numbers of the effects, shape (particles, numbers); those whose places are in `varying` are fitted.
        starts: shape (starts, particles, p).
        most_steps: give up after as many.
    """
    noise, centre, width, theta, starts = (np.asarray(x) for x in (noise, centre, width, theta, starts))
    (count, N, size), places = starts.shape, list(varying)
    tests = jax.tree.map(np.asarray, tests)
    points = np.maximum(tests.mask.sum(1), 1)

    def at(y: np.ndarray, rows: np.ndarray) -> Point:
        own = theta[rows].copy()
        own[:, places] = y[:, 5:]
        return Point(jnp.asarray(y[:, :4]), jnp.asarray(y[:, 4]), jnp.asarray(own))

    def normal_equations(y: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Loss, gradient and curvature of some particles, as many as there are at most."""
        filled = np.resize(np.arange(len(rows)), N)  # of one shape, for one compilation
        some = tests if np.array_equal(rows, np.arange(N)) else jax.tree.map(lambda x: x[rows[filled]], tests)
        linear = linearise(at(y[filled], rows[filled]), some, forms)
        ones = np.where(some.mask, 1.0, 0.0)[..., None]
        J = np.concatenate([linear.columns[..., :4], ones, linear.columns[..., [4 + k for k in places]]], -1)
        scale = noise[rows[filled]][:, None]
        if some.reading_weight is not None:
            scale = scale / np.sqrt(some.reading_weight)
        r, J = (np.asarray(linear.residual) / scale)[: len(rows)], (-J / scale[..., None])[: len(rows)]
        away = (y - centre[rows]) / width[rows]
        H = J.mT @ J + np.eye(size) / width[rows][..., None] ** 2
        g = np.einsum("nkp,nk->np", J, r) + away / width[rows]
        loss = 0.5 * ((r**2).sum(1) + (away**2).sum(1))
        fine = np.isfinite(loss) & np.isfinite(g).all(1) & np.isfinite(H).all((1, 2))
        H = np.where(fine[:, None, None], H, np.eye(size))
        return np.where(fine, loss, np.inf), np.where(fine[:, None], g, 0.0), H

    def every(y: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
        cut = range(0, len(rows), N)
        found = [normal_equations(y[k : k + N], rows[k : k + N]) for k in cut]
        return [np.concatenate(several) for several in zip(*found, strict=True)]

    y, particle = starts.reshape(-1, size).astype(float), np.tile(np.arange(N), count)
    loss, g, H = every(y, particle)
    damping, done = np.full(len(y), 1e-3), np.zeros(len(y), bool)
    for _ in range(int(most_steps)):
        now = np.flatnonzero(~done)
        if not len(now):
            break
        rows = particle[now]
        damped = H[now] + damping[now, None, None] * np.eye(size) * H[now]
        move = -np.linalg.solve(damped, g[now][..., None])[..., 0]
        # No logarithm moves by more than a factor of e, nothing else by more than its prior's width, at a time.
        most = np.abs(move / np.concatenate([np.ones((len(now), 4)), width[rows, 4:]], 1)).max(1)
        tried = y[now] + move / np.maximum(most, 1.0)[:, None]
        new_loss, new_g, new_H = every(tried, rows)
        better = new_loss < loss[now]
        # What a step would still gain, in units of the scatter that there is: where the law does not describe the
        # curve, that is many times the noise.
        scatter = 1 + 2 * np.where(np.isfinite(loss[now]), loss[now], 0.0) / points[rows]
        gain = np.abs(np.einsum("np,np->n", move, g[now]))
        done[now] = (gain < FIT.gain * scatter) | (damping[now] > 1e8)
        damping[now] = np.where(better, np.maximum(damping[now] / 8, 1e-9), damping[now] * 4)
        for old, new in ((y, tried), (loss, new_loss), (g, new_g), (H, new_H)):
            old[now[better]] = new[better]
    y, loss, done = (v.reshape(count, N, *v.shape[1:]) for v in (y, loss, done))
    # A snap-through below the first load that counts is no part of the test: nothing shows it. A sharp rise from
    # nothing is fitted so if it may be, and the fit then presses the snap-through against that first load for good.
    first = np.where(tests.mask & tests.loading, tests.force, np.inf).min(1)
    unseen = np.stack([np.asarray(snaps(jnp.asarray(one[:, :4]), tests.particle)) for one in y]) < np.log(first)
    seen = np.where(unseen, np.inf, loss)
    # Unless nothing else comes near the data: then the particle has snapped through before anybody looked.
    near = seen.min(0) < FIT.unseen * loss.min(0) + FIT.unseen
    best = np.where(near, seen, loss).argmin(0), np.arange(N)
    rms = noise * np.sqrt(2 * loss[best] / points)
    found = at(y[best], np.arange(N)), rms, done[best], np.moveaxis(y, 0, 1), done.all(0)
    return ParticleFits(*jax.tree.map(jnp.asarray, found))


snaps = compiled(jax.vmap(snap))
