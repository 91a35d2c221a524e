"""All tests of a campaign linearised, with effects in coordinates in which they bend least."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .compiling import compiled
from .data import Tests
from .forward import Forms, Linear, Point, linearise
from .model import Model
from .settings import FIT
from .sharding import Blocks, Parts, count_of
from .straightening import Straight, box_cox, moved, products


@compiled
def linear_data(point: Point, tests: Tests, forms: Forms) -> Linear:
    """All tests linearised, how noise of force moves them included."""
    return linearise(point, tests, forms)


@compiled
def _sheared(linear: Linear, slope: Float[Array, "particles numbers numbers"]) -> Linear:
    """The same by coordinates of the effects' numbers, from the derivatives of these by them."""
    own = jnp.einsum("npk,nkl->npl", linear.columns[..., 4:], slope)
    return replace(linear, columns=jnp.concatenate([linear.columns[..., :4], own], -1))


class Linearisation:
    """How the tests of a fit are linearised.

    Attributes:
        straight: coordinates of the effects' numbers.
    """

    def __init__(self, tests: Tests, model: Model, blocks: Blocks) -> None:
        self._tests, self._model, self._blocks = tests, model, blocks
        self._count, self._own = count_of(tests), blocks.cut(tests)
        still = np.zeros(len(model.forms.names))
        self.straight = Straight.of(len(tests), still, still)

    def at(self, point: Point, sd: np.ndarray | None = None) -> Parts:
        """All tests linearised; with effects and how they bend over a standard deviation of each number, if given.

        Args:
            point: around what.
            sd: standard deviations of the effects' numbers, of the logarithms of positive ones; with them their
                coordinates are straightened, too.
        """
        if sd is not None:
            self.straight = self._straightened(point, sd)
        numbers = point.theta.shape[1]
        if not numbers:
            return self._blocks.each(linear_data, self._blocks.cut(point), self._own, self._model.forms)
        found = self._moved(point, np.zeros(numbers))
        bends = [self._bend(point, k, 0.0 if sd is None else float(sd[k])) for k in range(numbers)]
        waves = (replace(w, bends=jnp.concatenate(each, -1)) for w, *each in zip(found.waves, *bends, strict=True))
        return Parts(tuple(waves), found.axis)

    def _straightened(self, point: Point, sd: np.ndarray) -> Straight:
        """Coordinates in which the prediction bends least (`straightening`), over these standard deviations."""
        still = np.zeros(point.theta.shape[1])
        shear, power = still.copy(), still.copy()
        start, weight = np.asarray(point.theta), np.ones(len(self._tests))
        weight[self._count :] = 0.0
        self.straight = Straight.of(len(self._tests), still, still)

        def gram(away: np.ndarray) -> np.ndarray:
            linear = self._moved(point, away)
            return np.asarray(
                self._blocks.whole(self._blocks.each(products, Parts(tuple(w.columns for w in linear.waves))))
            )

        here = gram(still)
        for k, owner in self._model.scatter.positive:
            size = weight @ (start[:, owner] ** 2 * here[:, owner, owner])
            shear[k] = start[0, k] * (weight @ (start[:, owner] * here[:, owner, k])) / size if size > 0 else 0.0
        shear = np.clip(shear, -FIT.steepest, FIT.steepest)
        self.straight = Straight.of(len(self._tests), shear, power)
        for k, _ in self._model.scatter.positive:
            step = np.where(np.arange(len(still)) == k, start[0, k] * sd[k], 0.0)
            up, down = (weight @ gram(by)[:, k, k] for by in (step, -step))
            power[k] = np.log(up / down) / (4 * sd[k]) if min(up, down) > 0 else 0.0
        return Straight.of(len(self._tests), shear, np.clip(power, -FIT.steepest, FIT.steepest))

    def _moved(self, point: Point, away: np.ndarray) -> Parts:
        """All tests linearised where the effects' numbers have these coordinates, by these coordinates."""
        theta, slope = moved(jnp.asarray(away), point.theta, self.straight, self._model.scatter.positive)
        there = self._blocks.cut((replace(point, theta=theta), slope))
        found = self._blocks.each(linear_data, Parts(tuple(p for p, _ in there.waves)), self._own, self._model.forms)
        waves = (_sheared(linear, by) for linear, (_, by) in zip(found.waves, there.waves, strict=True))
        return Parts(tuple(waves), found.axis)

    def _bend(self, point: Point, number: int, step: float) -> list[Array]:
        """Derivative of all columns by one of the effects' numbers, as in `Marginal`, by differences over a step; 0 for
        a step of 0."""
        size = point.theta.shape[1]
        if not step:
            return [jnp.zeros((*wave.mask.shape, 4 + size)) for wave in self._own.waves]
        ends = np.array([step, -step])
        if number in dict(self._model.scatter.positive):
            ends = np.asarray(point.theta[0, number] * box_cox(jnp.asarray(ends), self.straight.power[0, number]))
        up, down = (self._moved(point, np.where(np.arange(size) == number, end, 0.0)).waves for end in ends)
        return [(a.columns - b.columns) / (ends[0] - ends[1]) for a, b in zip(up, down, strict=True)]
