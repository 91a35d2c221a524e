"""Every particle by itself: starts without iteration, then its own least squares from several of them."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .data import Tests
from .forward import Forms, Point, derivatives, snap
from .running import compiled, side_by_side

# Found by trial on simulated campaigns.
ZEROS, ZERO_REACH = 21, 0.04  # zeros of displacement that are tried, within this share of the effective diameter
# What is added to the linear start's b1, b3, b5 for further starts.
VARIATIONS = ((0.0, 0.0, 0.0), (0.05, -0.1, 0.03), (-0.05, 0.06, -0.02))
STEPS = 200  # most steps of a particle's fit
UNSEEN = 4.0  # a fit without unseen snap-through is preferred up to so many times the least sum of squares
GAIN = 1e-6  # log probability still to gain at which a fit is finished, where residuals are as large as the noise

snaps = compiled(jax.vmap(snap))


class ParticleFits(eqx.Module):
    """Where fits of single particles ended, and whether the tolerances were met."""

    point: Point
    converged: Bool[Array, " particles"]


def linear_start(stress: np.ndarray, strain: np.ndarray) -> tuple[np.ndarray, float]:
    """Coefficients (as b) of one particle and the strain at its zero, from its loading. At a given zero stress is
    linear in them, so zeros are tried on a grid. Deviations of stress over the slope are deviations of strain."""
    top, shifts = np.max(stress, initial=0.0), np.linspace(-ZERO_REACH, ZERO_REACH, ZEROS)
    x = strain - shifts[:, None]
    possible, x = (x > 1e-4).all(1), np.maximum(x, 1e-4)
    far, square = x.max(1, initial=1e-4)[:, None], x**2
    design = np.stack([x, -x * square, x * square**2], -1)
    slope, K = np.ones_like(x), np.zeros((len(x), 3))
    for _ in range(3):
        weighted = design / slope[..., None]
        scale = np.sqrt(np.sum(weighted**2, 1, keepdims=True)) + 1e-30
        scaled = np.swapaxes(weighted / scale, 1, 2)
        normal = scaled @ np.swapaxes(scaled, 1, 2) + 1e-9 * np.eye(3)
        K = np.linalg.solve(normal, scaled @ (stress / slope)[..., None])[..., 0] / scale[:, 0]
        slope = np.maximum(K[:, :1] - 3 * K[:, 1:2] * square + 5 * K[:, 2:] * square**2, 0.05 * top / far)
    # Each term carries at least a hundredth of the largest stress: logarithms follow.
    K = np.maximum(K, 0.01 * top / far ** np.array([1, 3, 5]))
    slope = np.maximum(K[:, :1] - 3 * K[:, 1:2] * square + 5 * K[:, 2:] * square**2, 0.05 * top / far)
    deviation = ((design @ K[..., None])[..., 0] - stress) / slope
    losses = np.where(possible, np.sum(deviation**2, 1), np.inf)
    best = int(np.argmin(losses))
    K = K[best] if np.isfinite(losses[best]) else np.array([6.0, 27.0, 144.0])
    return np.log(K) / np.array([1.0, 3.0, 5.0]), float(shifts[best])


def linear_starts(tests: Tests, log_modulus: float) -> np.ndarray:
    """Several starts for every particle, shape (particles, starts, 5): the linear one and variations of it."""
    given = tests.force, tests.displacement, tests.loading, tests.contact, tests.effective_diameter
    force, displacement, loading, contact, reach = map(np.asarray, given)
    first = np.full((len(tests), 5), log_modulus)
    for row, used in enumerate(loading):
        # [mN] over [um^2] is 1e3 MPa.
        stress = 1e3 * force[row, used] / (np.pi / 4 * reach[row] ** 2)
        first[row, :3], shift = linear_start(stress, (displacement[row, used] - contact[row]) / reach[row])
        first[row, 4] = contact[row] + shift * reach[row]
    return first[:, None] + np.pad(VARIATIONS, ((0, 0), (0, 2)))


def fit_particles(
    tests: Tests, noise: Any, centre: Any, width: Any, theta: Any, starts: Any, forms: Forms,
    varying: tuple[int, ...] = (), block: int = 0,
) -> ParticleFits:  # fmt: skip
    """Fit every particle by itself, its modulus included, from several starts, by Levenberg's and Marquardt's method.

    Args:
        noise: scale of each particle's residuals [um].
        centre, width: normal prior of each particle's b1, b3, b5, e, zero [um], and the amplitudes that vary, shape
            (particles, p).
        theta: numbers of the effects, shape (particles, numbers); those whose places are in `varying` are fitted.
        starts: shape (particles, starts, p).
        block: particles of a block; all if 0.
    """
    noise, centre, width, theta, starts = (np.asarray(x) for x in (noise, centre, width, theta, starts))
    (N, count, size), places = starts.shape, list(varying)
    tests, block = jax.tree.map(np.asarray, tests), block or N
    points = np.maximum(tests.mask.sum(1), 1)

    def at(y: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        own = theta[rows].copy()
        own[:, places] = y[:, 5:]
        return y[:, :4], y[:, 4], own

    def of_block(y: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Loss, gradient and curvature of some particles, as many as there are in a block at most."""
        filled = np.resize(np.arange(len(rows)), block)  # of one shape, for one compilation
        some = jax.tree.map(lambda x: x[rows[filled]], tests)
        residual, columns, _, _ = derivatives(*at(y[filled], rows[filled]), some, forms)
        ones = np.where(some.mask, 1.0, 0.0)[..., None]
        J = np.concatenate([columns[..., :4], ones, columns[..., [4 + k for k in places]]], -1)
        root = 1 / noise[rows[filled]][:, None]
        if some.reading_weight is not None:
            root = root * np.sqrt(some.reading_weight)
        r, J = (residual * root)[: len(rows)], (-J * root[..., None])[: len(rows)]
        away = (y - centre[rows]) / width[rows]
        H = J.mT @ J + np.eye(size) / width[rows][..., None] ** 2
        g = np.einsum("nkp,nk->np", J, r) + away / width[rows]
        loss = 0.5 * ((r**2).sum(1) + (away**2).sum(1))
        fine = np.isfinite(loss) & np.isfinite(g).all(1) & np.isfinite(H).all((1, 2))
        H = np.where(fine[:, None, None], H, np.eye(size))
        return np.where(fine, loss, np.inf), np.where(fine[:, None], g, 0.0), H

    def normal_equations(y: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
        found = side_by_side(lambda k: of_block(y[k : k + block], rows[k : k + block]), range(0, len(rows), block))
        return [np.concatenate(several) for several in zip(*found, strict=True)]

    # All starts of all particles in a row, those of one start after those of another.
    y, particle = np.moveaxis(starts, 1, 0).reshape(-1, size).astype(float), np.tile(np.arange(N), count)
    loss, g, H = normal_equations(y, particle)
    damping, done = np.full(len(y), 1e-3), np.zeros(len(y), bool)
    for _ in range(STEPS):
        now = np.flatnonzero(~done)
        if not len(now):
            break
        rows = particle[now]
        damped = H[now] + damping[now, None, None] * np.eye(size) * H[now]
        move = -np.linalg.solve(damped, g[now][..., None])[..., 0]
        # No logarithm moves by more than a factor of e, nothing else by more than its prior's width, at a time.
        most = np.abs(move / np.concatenate([np.ones((len(now), 4)), width[rows, 4:]], 1)).max(1)
        tried = y[now] + move / np.maximum(most, 1.0)[:, None]
        new_loss, new_g, new_H = normal_equations(tried, rows)
        better = new_loss < loss[now]
        # What a step would still gain, in units of the scatter that there is: where the law does not describe the
        # curve, that is many times the noise.
        scatter = 1 + 2 * np.where(np.isfinite(loss[now]), loss[now], 0.0) / points[rows]
        gain = np.abs(np.einsum("np,np->n", move, g[now]))
        done[now] = (gain < GAIN * scatter) | (damping[now] > 1e8)
        damping[now] = np.where(better, np.maximum(damping[now] / 8, 1e-9), damping[now] * 4)
        for old, new in ((y, tried), (loss, new_loss), (g, new_g), (H, new_H)):
            old[now[better]] = new[better]
    y, loss, done = (v.reshape(count, N, *v.shape[1:]) for v in (y, loss, done))
    # A snap-through below the first load that counts is no part of the test: nothing shows it. A sharp rise from
    # nothing is fitted so if it may be, and the fit then presses the snap-through against that first load for good.
    first = np.where(tests.mask & tests.loading, tests.record.force, np.inf).min(1)
    unseen = np.stack([np.asarray(snaps(jnp.asarray(one[:, :4]), tests.particle)) for one in y]) < np.log(first)
    seen = np.where(unseen, np.inf, loss)
    # Unless nothing else comes near the data: then the particle has snapped through before anybody looked.
    near = seen.min(0) < UNSEEN * loss.min(0) + UNSEEN
    best = np.where(near, seen, loss).argmin(0), np.arange(N)
    point, converged = jax.tree.map(jnp.asarray, (at(y[best], np.arange(N)), done[best]))
    return ParticleFits(Point(*point), converged)
