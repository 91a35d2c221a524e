"""Every particle by itself: starts without iteration, then its own least squares from several of them."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

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


def linear_start(stress: np.ndarray, strain: np.ndarray) -> tuple[np.ndarray, float]:
    """Coefficients (as b) of one particle and the strain at its zero, from its loading, without iteration.

    Stress is linear in the three coefficients at a given zero, so zeros are tried on a grid; deviations of stress are
    divided by the slope, which makes them deviations of strain.
    """
    top, shifts = np.max(stress, initial=0.0), np.linspace(-FIT.zero_reach, FIT.zero_reach, FIT.zeros)
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
    """Several starts for every particle, shape (starts, particles, 5): the linear one and variations of it."""
    force, displacement, loading, contact = (
        np.asarray(x) for x in (tests.force, tests.displacement, tests.loading, tests.contact)
    )
    reach = np.asarray(tests.effective_diameter)
    first = np.full((len(tests), 5), log_modulus)
    for row, used in enumerate(loading):
        # [mN] over [um^2] is 1e3 MPa.
        stress = 1e3 * force[row, used] / (np.pi / 4 * reach[row] ** 2)
        first[row, :3], shift = linear_start(stress, (displacement[row, used] - contact[row]) / reach[row])
        first[row, 4] = contact[row] + shift * reach[row]
    return first + np.pad(FIT.variations, ((0, 0), (0, 2)))[:, None]


@compiled
def fit_particles(
    tests: Tests,
    noise: Float[Array, " particles"],
    centre: Float[Array, "particles p"],
    width: Float[Array, "particles p"],
    theta: Float[Array, "particles numbers"],
    starts: Float[Array, "starts particles p"],
    forms: Forms,
    varying: tuple[int, ...] = (),
    most_steps: int | Int[Array, ""] = FIT.steps,
) -> ParticleFits:
    """Fit every particle by itself, its modulus included, from several starts.

    Levenberg-Marquardt for all particles and starts in step, each with a damping of its own: one that has converged
    waits for the others, so there is one loop whatever their number.

    Args:
        noise: scale of each particle's residuals [um].
        centre, width: normal prior of each particle's b1, b3, b5, e, zero [um], and the amplitudes that vary.
        theta: numbers of the effects; those whose places are in `varying` are fitted.
        most_steps: give up after as many.
    """
    count, size = len(starts), starts.shape[-1]

    def tile(x: Array) -> Array:
        return jnp.tile(x, (count, *[1] * (x.ndim - 1)))

    many: Tests = jax.tree.map(tile, tests)
    scale = tile(noise)[:, None]
    points = jnp.maximum(jnp.sum(many.mask, 1), 1).astype(noise.dtype)
    middle, width, shared = tile(centre), tile(width), tile(theta)

    def at(y: Array) -> Point:
        own = shared.at[:, jnp.asarray(varying, int)].set(y[:, 5:]) if varying else shared
        return Point(y[:, :4], y[:, 4], own)

    def normal_equations(y):
        linear = linearise(at(y), many, forms, with_force=False)
        columns = [linear.columns[..., :4], jnp.where(many.mask, 1.0, 0.0)[..., None]]
        columns += [linear.columns[..., 4 + k : 5 + k] for k in varying]
        r, J, away = linear.residual / scale, -jnp.concatenate(columns, -1) / scale[..., None], (y - middle) / width
        if many.reading_weight is not None:
            root = jnp.sqrt(many.reading_weight)
            r, J = root * r, root[..., None] * J
        H = jnp.einsum("nkp,nkq->npq", J, J) + jnp.eye(size)[None] / width[..., None] ** 2
        g = jnp.einsum("nkp,nk->np", J, r) + away / width
        loss = 0.5 * (jnp.sum(r**2, 1) + jnp.sum(away**2, 1))
        return jnp.where(jnp.isfinite(loss), loss, jnp.inf), g, H

    def step(carry):
        y, loss, g, H, damping, count, _ = carry
        diagonal = jnp.diagonal(H, axis1=1, axis2=2)
        move = -Cholesky(H + jnp.eye(size)[None] * (damping[:, None] * diagonal)[:, None, :]).solve(g)
        # No logarithm moves by more than a factor of e, nothing else by more than its prior's width, at a time.
        most = jnp.max(jnp.abs(move) / jnp.concatenate([jnp.ones_like(move[:, :4]), width[:, 4:]], 1), 1)
        tried = y + move / jnp.maximum(most, 1.0)[:, None]
        new_loss, new_g, new_H = normal_equations(tried)
        better = new_loss < loss
        # What a step would still gain, in units of the scatter that there is: where the law does not describe the
        # curve, that is many times the noise.
        scatter = 1 + 2 * jnp.where(jnp.isfinite(loss), loss, 0.0) / points
        done = (jnp.abs(jnp.einsum("np,np->n", move, g)) < FIT.gain * scatter) | (damping > 1e8)

        def choose(new, old):
            return jnp.where(better.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        damping = jnp.where(done, damping, jnp.where(better, jnp.maximum(damping / 8, 1e-9), damping * 4))
        return (*map(choose, (tried, new_loss, new_g, new_H), (y, loss, g, H)), damping, count + 1, done)

    y = starts.reshape(-1, size)
    unfinished = jnp.zeros(len(y), bool)
    # The first pass evaluates the start: an infinite loss accepts whatever comes, and no force moves it.
    carry = (y, jnp.full(len(y), jnp.inf), jnp.zeros_like(y), jnp.broadcast_to(jnp.eye(size), (len(y), size, size)))
    carry = (*carry, jnp.full(len(y), 1e-3), 0, unfinished)
    going = lambda c: (c[5] < 2) | ((c[5] < most_steps) & ~jnp.all(c[6]))  # noqa: E731  # a condition, no function
    y, loss, _, _, _, _, done = jax.lax.while_loop(going, step, carry)
    y, loss, done = (v.reshape(count, len(tests), *v.shape[1:]) for v in (y, loss, done))
    # A snap-through below the first load that counts is no part of the test: nothing shows it. A sharp rise from
    # nothing is fitted so if it may be, and the fit then presses the snap-through against that first load for good.
    first = jnp.min(jnp.where(many.mask & many.loading, many.force, jnp.inf), 1)
    unseen = jax.vmap(snap)(y.reshape(-1, size)[:, :4], many.particle) < jnp.log(first)
    seen = jnp.where(unseen.reshape(loss.shape), jnp.inf, loss)
    # Unless nothing else comes near the data: then the particle has snapped through before anybody looked.
    near = jnp.min(seen, axis=0) < FIT.unseen * jnp.min(loss, axis=0) + FIT.unseen
    best = jnp.argmin(jnp.where(near[None], seen, loss), axis=0)

    def take(values):
        return jnp.take_along_axis(values, best.reshape(1, -1, *[1] * (values.ndim - 2)), axis=0)[0]

    found = take(y)
    point = Point(found[:, :4], found[:, 4], at(jnp.tile(found, (count, 1))).theta[: len(tests)])
    rms = noise * jnp.sqrt(2 * take(loss) / points[: len(tests)])
    return ParticleFits(point, rms, take(done), jnp.moveaxis(y, 0, 1), jnp.all(done, 0))
