"""Where the numbers of effects are looked for: the values of their grids that explain most, to first order."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..effects import AbstractEffect
from ..law import signatures
from .compiling import compiled
from .data import Tests
from .forward import Forms, Linear, Point
from .model import Model
from .noise import Along, Correlation, Noise, whitening
from .sharding import Blocks, Parts, count_of
from .small_matrices import eliminate


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


class Start(NamedTuple):
    """Where to begin.

    Attributes:
        sites: values of the effects' sites.
        theta: numbers around which tests are linearised first: amplitudes of zero, further numbers as in `sites`.
    """

    sites: dict[str, float]
    theta: np.ndarray


def start_of_effects(point: Point, tests: Tests, linear: Parts, noise: Noise, model: Model, blocks: Blocks) -> Start:
    """Values of the effects' sites to start from.

    Of every formula the values of its grid are taken whose amplitude, to first order, explains most of the residuals
    that particles' own numbers leave.

    Args:
        point: the fit without effects.
        tests: the measurements.
        linear: the tests linearised there.
        noise: a small one: what effects explain must not have gone into it.
        model: the model.
        blocks: how the particles are cut.
    """
    candidates = [(v, further) for v in model.effects for further in v.grid()]
    effects = tuple(v.build(0.0, **further) for v, further in candidates)
    kinds = effects, model.forms, model.zero_prior[1], model.correlation, model.along
    cut = blocks.cut
    found = blocks.whole(blocks.each(score_of_effects, cut(point), cut(tests), linear, cut(noise), *kinds))
    score, information = np.asarray(found)[: count_of(tests)].sum(0).T
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
    return Start(start, theta)
