"""All tests of a campaign linearised, with effects in coordinates in which they bend least."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..effects import AbstractEffect
from ..law import signatures
from .compiling import compiled
from .data import Tests
from .forward import Forms, Linear, Point, linearise
from .model import Model
from .noise import Along, Correlation, Noise, whitening
from .sharding import Blocks, Parts
from .small_matrices import eliminate
from .straightening import Straight, box_cox, moved, products

STEEPEST = 3.0  # largest shear or power of the coordinates of an effect's numbers (`straightening`); found by trial


@compiled
def _sheared(linear: Linear, slope: Float[Array, "particles numbers numbers"]) -> Linear:
    """The same by coordinates of the effects' numbers, from the derivatives of these by them."""
    own = jnp.einsum("npk,nkl->npl", linear.columns[..., 4:], slope)
    return replace(linear, columns=jnp.concatenate([linear.columns[..., :4], own], -1))


class Linearisation:
    """How the tests of a fit are linearised, in the coordinates `straight` of the effects' numbers."""

    def __init__(self, own: Parts, count: int, model: Model, blocks: Blocks) -> None:
        """Keep this process's own tests, and the number of all, without padding."""
        self._own, self._count, self._model, self._blocks = own, count, model, blocks
        zeros = np.zeros(len(model.forms.names))
        self.straight = Straight.of(blocks.count, zeros, zeros)

    def at(self, point: Point, sd: np.ndarray | None = None) -> Parts:
        """All tests linearised around a point; with effects and how they bend over a standard deviation of each number.

        `sd` are standard deviations of the effects' numbers, of the logarithms of positive ones; with them the
        coordinates of these numbers are straightened, too.
        """
        if sd is not None:
            self.straight = self._straightened(point, sd)
        numbers = point.theta.shape[1]
        if not numbers:
            return self._blocks.each(linearise, self._blocks.cut(point), self._own, self._model.forms)
        found = self._moved(point, np.zeros(numbers))
        bends = [self._bend(point, k, 0.0 if sd is None else float(sd[k])) for k in range(numbers)]
        return found.map(lambda linear, *each: replace(linear, bends=jnp.concatenate(each, -1)), *bends)

    def _straightened(self, point: Point, sd: np.ndarray) -> Straight:
        """Coordinates in which the prediction bends least (`straightening`), over these standard deviations."""
        zeros = np.zeros(point.theta.shape[1])
        shear, power = zeros.copy(), zeros.copy()
        start, weight = np.asarray(point.theta), np.ones(self._blocks.count)
        weight[self._count :] = 0.0
        self.straight = Straight.of(self._blocks.count, zeros, zeros)

        def gram(away: np.ndarray) -> np.ndarray:
            columns = self._moved(point, away).map(lambda linear: linear.columns)
            return np.asarray(self._blocks.all(products, columns))

        here = gram(zeros)
        for k, owner in self._model.scatter.positive:
            size = weight @ (start[:, owner] ** 2 * here[:, owner, owner])
            shear[k] = start[0, k] * (weight @ (start[:, owner] * here[:, owner, k])) / size if size > 0 else 0.0
        shear = np.clip(shear, -STEEPEST, STEEPEST)
        self.straight = Straight.of(self._blocks.count, shear, power)
        for k, _ in self._model.scatter.positive:
            step = np.where(np.arange(len(zeros)) == k, start[0, k] * sd[k], 0.0)
            up, down = (weight @ gram(by)[:, k, k] for by in (step, -step))
            power[k] = np.log(up / down) / (4 * sd[k]) if min(up, down) > 0 else 0.0
        return Straight.of(self._blocks.count, shear, np.clip(power, -STEEPEST, STEEPEST))

    def _moved(self, point: Point, away: np.ndarray) -> Parts:
        """All tests linearised where the effects' numbers have these coordinates, by these coordinates."""
        theta, slope = moved(jnp.asarray(away), point.theta, self.straight, self._model.scatter.positive)
        cut = self._blocks.cut
        found = self._blocks.each(linearise, cut(replace(point, theta=theta)), self._own, self._model.forms)
        return found.map(_sheared, cut(slope))

    def _bend(self, point: Point, number: int, step: float) -> Parts:
        """Derivative of all columns by one of the effects' numbers, as in `Marginal`, by differences over a step; 0 for
        a step of 0."""
        size = point.theta.shape[1]
        if not step:
            return self._own.map(lambda own: jnp.zeros((*own.mask.shape, 4 + size)))
        ends = np.array([step, -step])
        if number in dict(self._model.scatter.positive):
            ends = np.asarray(point.theta[0, number] * box_cox(jnp.asarray(ends), self.straight.power[0, number]))
        up, down = (self._moved(point, np.where(np.arange(size) == number, end, 0.0)) for end in ends)
        return up.map(lambda a, b: (a.columns - b.columns) / (ends[0] - ends[1]), down)


# ---- where effects are looked for ------------------------------------------------------------------------------------


@compiled
def score_of_effects(
    point: Point,
    tests: Tests,
    linear: Linear,
    noise: Noise,
    effects: tuple[AbstractEffect, ...],
    forms: Forms,
    zero_sd: Scalar,
    correlation: Correlation,
    along: Along,
) -> Float[Array, "particles effects 2"]:
    """Score and information of each effect's amplitude at zero, every particle's own numbers integrated out."""
    base = Forms(forms.unloading)

    def one(latent: Array, scale: Scalar, tests: Tests, linear: Linear) -> Array:
        columns = signatures(base.law(latent, jnp.zeros(0)), tests.particle, tests.record, effects)
        columns = jnp.where(tests.mask[None], columns, 0.0).T
        own = [linear.columns[:, :4], jnp.where(tests.mask, zero_sd, 0.0)[:, None]]
        filtered = whitening(noise, scale, tests, linear, correlation, along)
        white = filtered(jnp.concatenate([*own, columns, linear.residual[:, None]], 1))
        left, _ = eliminate(white.T @ white, tuple(range(5)), jnp.ones(5))
        return jnp.stack([left[:-1, -1], jnp.diagonal(left)[:-1]], -1)

    return jax.vmap(one)(point.latent, noise.scale, tests, linear)


def start_of_effects(
    point: Point, own: Parts, count: int, linear: Parts, noise: Noise, model: Model, blocks: Blocks
) -> tuple[dict[str, float], np.ndarray]:
    """Values of the effects' sites to start from, and numbers to linearise around first: there, amplitudes are 0.

    Of every formula the values of its grid are taken whose amplitude, to first order, explains most of the residuals
    that particles' own numbers leave.

    The noise has to be a small one: what effects explain must not have gone into it.
    """
    candidates = [(v, further) for v in model.effects for further in v.grid()]
    effects = tuple(v.build(0.0, **further) for v, further in candidates)
    kinds = effects, model.forms, model.zero_prior[1], model.correlation, model.along
    cut = blocks.cut
    found = blocks.all(score_of_effects, cut(point), own, linear, cut(noise), *kinds)
    score, information = np.asarray(found)[:count].sum(0).T
    start: dict[str, float] = {}
    values: dict[str, float] = {}
    best: dict[str, float] = {}
    for (v, further), s, i in zip(candidates, score, information, strict=True):
        amplitude = s / max(i, 1e-300)
        gain = s * amplitude if v.sign * amplitude >= 0 else 0.0
        if gain > best.get(v.mechanism, -1.0):
            best[v.mechanism] = gain
            size = (v.sign or 1) * amplitude / v.plausible[0]
            size = float(np.clip(size, 0.3, v.plausible[1] / v.plausible[0])) if v.sign else float(size)
            start[f"{v.mechanism}_size"] = size
            for n in v.nuisances:
                low, high = n.plausible
                value = further[n.name]
                inside = value if low > 0 else np.clip(value, low + 0.01 * (high - low), high - 0.01 * (high - low))
                start[f"{v.mechanism}.{n.name}"] = values[f"{v.mechanism}.{n.name}"] = float(inside)
            start[f"tau_{v.mechanism}_coordinate"] = 1.0
    theta = np.array([values.get(name, 0.0) for name in model.forms.names])
    return start, theta
