r"""All tests of a campaign linearised, with effects in coordinates in which the prediction is nearly linear.

Tests may leave a number of an effect open over a decade: of logarithmic creep whose time is far beyond the record they
show the amplitude over the time, and of the time by itself almost nothing. A quadratic in amplitude and time, or in
their logarithms, does not hold that far. Of an amplitude A and a further, positive number :math:`\theta`, where tests
are linearised at :math:`\hat A, \hat\theta`, the coordinates are

.. math:: v = \hat\theta\, \frac{e^{q x} - 1}{q}, \qquad u = A\, e^{p x} - \hat A, \qquad x = \log(\theta/\hat\theta)

The shear p takes from what :math:`\theta` does that part which the amplitude does as well. The power q makes the rest
as large on one side of the point as on the other. With p = q = 0 they are the amplitude and the logarithm.

References:
    Bates and Watts (1980), Relative curvature measures of nonlinearity: parameter-effects curvature.
    Box and Cox (1964), An analysis of transformations. Cox and Reid (1987), Parameter orthogonality.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar, Values
from .data import Tests
from .forward import Forms, Linear, Point, linearise
from .sharding import Blocks

Places = tuple[tuple[int, int], ...]
"""Of each further number that must be positive its place among the effects' numbers, and its amplitude's."""

FARTHEST = 20.0  # exponents are cut here: a number e^20 times that of the point is nowhere near any test
STEEPEST = 3.0  # largest shear or power; found by trial


class Straight(eqx.Module):
    """Shear p and power q of every number of the effects; 0 of amplitudes, and of numbers that may be 0."""

    shear: Float[Array, "particles numbers"]
    power: Float[Array, "particles numbers"]

    @classmethod
    def of(cls, count: int, shear: np.ndarray, power: np.ndarray) -> Straight:
        """The same for so many particles."""
        return cls(*(jnp.asarray(np.broadcast_to(x, (count, len(x)))) for x in (shear, power)))


def coordinates(
    theta: Float[Array, " numbers"], at: Float[Array, " numbers"], straight: Straight, places: Places
) -> tuple[Float[Array, " numbers"], Float[Array, " numbers"]]:
    """Coordinates of one particle's numbers, and the factor that each amplitude has in its own.

    All without an axis of particles; `at` are the numbers where the test is linearised.
    """
    away, factor = theta - at, jnp.ones_like(theta)
    for k, amplitude in places:
        x, q = jnp.log(theta[k] / at[k]), straight.power[k]
        away = away.at[k].set(at[k] * box_cox(x, q))
        factor = factor.at[amplitude].multiply(jnp.exp(jnp.clip(straight.shear[k] * x, -FARTHEST, FARTHEST)))
    for k in sorted({amplitude for _, amplitude in places}):
        away = away.at[k].set(theta[k] * factor[k] - at[k])
    return away, factor


def box_cox(x: Values, power: Scalar) -> Values:
    """How far v goes, per unit of the number, where it changes by the factor e^x: (e^(q x) - 1) / q."""
    linear = jnp.abs(power) < 1e-6
    safe = jnp.where(linear, 1.0, power)
    return jnp.where(linear, x, jnp.expm1(jnp.clip(safe * x, -FARTHEST, FARTHEST)) / safe)


def moved(away: np.ndarray, at: np.ndarray, straight: Straight, places: Places) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of all particles, shape (N, numbers), at coordinates that all share, and derivatives by the coordinates,
    shape (N, numbers, numbers): the inverse of `coordinates`."""
    theta, slope = at + away, np.broadcast_to(np.eye(len(away)), (len(at), len(away), len(away))).copy()
    shear, power = np.asarray(straight.shear), np.asarray(straight.power)
    for k, amplitude in places:
        linear = np.abs(power[:, k]) < 1e-6
        safe, ratio = np.where(linear, 1.0, power[:, k]), away[k] / at[:, k]
        x = np.where(linear, ratio, np.log1p(safe * ratio) / safe)
        by_v = 1 / np.where(linear, at[:, k], at[:, k] + safe * away[k])  # derivative of x
        theta[:, k] = at[:, k] * np.exp(x)
        slope[:, k, k] = theta[:, k] * by_v
        shrunk = np.exp(-shear[:, k] * x)
        theta[:, amplitude] *= shrunk
        slope[:, amplitude] *= shrunk[:, None]
        slope[:, amplitude, k] = -shear[:, k] * theta[:, amplitude] * by_v
    return theta, slope


class Linearisation:
    """How the tests of a fit are linearised, in the coordinates `straight` of the effects' numbers."""

    def __init__(self, tests: Tests, forms: Forms, positive: Places, blocks: Blocks) -> None:
        self._tests, self._forms, self._positive, self._blocks = tests, forms, positive, blocks
        zeros = np.zeros(len(forms.names))
        self.straight = Straight.of(len(tests), zeros, zeros)

    def at(self, point: Point, sd: np.ndarray | None = None) -> Linear:
        """All tests linearised around a point; with effects and how they bend over a standard deviation of each number.

        `sd` are standard deviations of the effects' numbers, of the logarithms of positive ones; with them the
        coordinates of these numbers are straightened, too.
        """
        numbers = point.theta.shape[1]
        if not numbers:
            return self._blocks.all(linearise, (point, self._tests), self._forms)
        if sd is None:
            sd = np.zeros(numbers)
        else:
            self._straighten(point, sd)
        bends = [self._bend(point, k, float(sd[k])) for k in range(numbers)]
        return replace(self._moved(point, np.zeros(numbers)), bends=jnp.asarray(np.concatenate(bends, -1)))

    def _straighten(self, point: Point, sd: np.ndarray) -> None:
        """Coordinates in which the prediction bends least, over these standard deviations."""
        zeros = np.zeros(point.theta.shape[1])
        shear, power, start = zeros.copy(), zeros.copy(), np.asarray(point.theta)
        self.straight = Straight.of(len(start), zeros, zeros)

        def gram(away: np.ndarray) -> np.ndarray:
            columns = np.asarray(self._moved(point, away).columns)[..., 4:]
            return columns.mT @ columns

        here = gram(zeros)
        for k, owner in self._positive:
            size = np.sum(start[:, owner] ** 2 * here[:, owner, owner])
            shear[k] = start[0, k] * np.sum(start[:, owner] * here[:, owner, k]) / size if size > 0 else 0.0
        shear = np.clip(shear, -STEEPEST, STEEPEST)
        self.straight = Straight.of(len(start), shear, power)
        for k, _ in self._positive:
            step = np.where(np.arange(len(zeros)) == k, start[0, k] * sd[k], 0.0)
            up, down = (np.sum(gram(by)[:, k, k]) for by in (step, -step))
            power[k] = np.log(up / down) / (4 * sd[k]) if min(up, down) > 0 else 0.0
        self.straight = Straight.of(len(start), shear, np.clip(power, -STEEPEST, STEEPEST))

    def _moved(self, point: Point, away: np.ndarray) -> Linear:
        """All tests linearised where the effects' numbers have these coordinates, by these coordinates."""
        theta, slope = moved(away, np.asarray(point.theta), self.straight, self._positive)
        there = replace(point, theta=jnp.asarray(theta))
        linear = self._blocks.all(linearise, (there, self._tests), self._forms)
        columns = np.asarray(linear.columns)
        columns = np.concatenate([columns[..., :4], columns[..., 4:] @ slope], -1)
        return replace(linear, columns=jnp.asarray(columns))

    def _bend(self, point: Point, number: int, step: float) -> np.ndarray:
        """Derivative of all columns by one of the effects' numbers, as in `Marginal`, by differences over a step; 0 for
        a step of 0."""
        size = point.theta.shape[1]
        if not step:
            return np.zeros((*self._tests.mask.shape, 4 + size))
        ends = np.array([step, -step])
        if number in dict(self._positive):
            ends = np.asarray(point.theta[0, number] * box_cox(jnp.asarray(ends), self.straight.power[0, number]))
        places = np.where(np.arange(size) == number, ends[:, None], 0.0)
        up, down = (np.asarray(self._moved(point, away).columns) for away in places)
        return (up - down) / (ends[0] - ends[1])
