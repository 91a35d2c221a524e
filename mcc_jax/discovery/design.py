"""The design matrix of a hypothesis around a state, and its whitening.

Of a hypothesis's evidence only the noise's filter is compiled: for a few columns at a time, so that one program serves
all hypotheses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..calibrate.data import Tests
from ..calibrate.forward import Forms, Linear, linearise
from ..calibrate.noise import Along, Correlation, Noise, whitening
from ..calibrate.numpyro_model import Model
from ..calibrate.priors import nuisance_moments
from ..calibrate.running import compiled
from ..effects import Variant
from .base import Base, State

Variants = tuple[Variant, ...]  # the formulas of a hypothesis
LOG_2PI = float(np.log(2 * np.pi))

AT_ONCE = 6, 18  # columns that are whitened in one call, at least and at most
ENTRIES = 270_000  # numbers that these hold together, about, so that they stay in a processor's own memory


class White(NamedTuple):
    """Whitened columns: their noise is independent from point to point and of variance 1."""

    columns: Any
    log_density: Any  # of the noise at 0
    reading: Any  # sum of squares that reading a display alone brings about
    sd: Any  # of each point given those before it


@compiled
def white_of(
    logs: Array, scale: Array, tests: Tests, linear: Linear, columns: Array, correlation: Correlation
) -> White:
    """Whiten columns of all tests, shape (N, points, few), at the logarithms of the noise's four numbers."""
    noise = Noise.from_logs(logs, scale)

    def one(scale: Array, tests: Tests, linear: Linear, columns: Array) -> White:
        filtered = whitening(noise, scale, tests, linear, correlation, Along.LOAD)
        constant = filtered.log_det + jnp.sum(jnp.where(tests.mask, LOG_2PI, 0.0))
        return White(filtered(columns), -0.5 * constant, filtered.reading, filtered.solver.factor.diag.d)

    return jax.vmap(one)(scale, tests, linear, columns)


@compiled
def slope_of(weights: tuple[Array, Array, Array], logs: Float[Array, " 4"], *given: Any) -> Float[Array, " 4"]:
    """Derivatives of a weighted sum of what `white_of` gives by the logarithms of the noise's four numbers."""
    _, back = jax.vjp(lambda at: white_of(at, *given)[:3], logs)
    return back(weights)[0]


class Columns:
    """Columns of a design, whitened in pieces of one shape; columns of zeros are left out."""

    def __init__(self, columns: np.ndarray, design: Design) -> None:
        self.shape = columns.shape
        self.some = np.flatnonzero(np.any(columns != 0, axis=(0, 1)))
        least, most = AT_ONCE
        size = min(max(ENTRIES // (self.shape[0] * self.shape[1]), least), most)
        count = -(-max(len(self.some), 1) // size)
        padded = np.zeros((*self.shape[:2], count * size))
        padded[..., : len(self.some)] = columns[..., self.some]
        self.pieces = [jnp.asarray(piece) for piece in np.split(padded, count, -1)]
        tests = design.tests
        if design.along is Along.TIME:  # one program for both
            tests = replace(tests, path=tests.record.time)
        self.arrays, self.correlation = (jnp.asarray(design.scale), tests, design.linear), design.correlation
        self._white: tuple[bytes, White] | None = None
        self._gram: tuple[White, np.ndarray] | None = None

    def _given(self, hyper: np.ndarray, piece: Array) -> tuple[Any, ...]:
        return jnp.asarray(hyper[:4]), *self.arrays, piece, self.correlation

    def white(self, hyper: np.ndarray) -> White:
        """The columns that are not zero, whitened and padded; those of the last call are kept."""
        noise = np.asarray(hyper[:4], float).tobytes()
        last = self._white  # another thread may put its own in place meanwhile
        if last is not None and last[0] == noise:
            return last[1]
        found = [jax.tree.map(np.asarray, white_of(*self._given(hyper, piece))) for piece in self.pieces]
        white = found[0]._replace(columns=np.concatenate([one.columns for one in found], -1))
        self._white = noise, white
        return white

    def gram(self, hyper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gram matrix of every particle's whitened columns, and log density of the noise at 0."""
        white, last = self.white(hyper), self._gram
        if last is not None and last[0] is white:
            return last[1], white.log_density
        k, gram = len(self.some), np.zeros((self.shape[0], self.shape[2], self.shape[2]))
        gram[:, self.some[:, None], self.some] = (np.swapaxes(white.columns, 1, 2) @ white.columns)[:, :k, :k]
        gram[:, -1, -1] += white.reading
        self._gram = white, gram
        return gram, white.log_density

    def slope(self, hyper: np.ndarray, of_gram: np.ndarray) -> np.ndarray:
        """Derivatives by the noise's numbers of its log density plus something, from those of that by the `gram`."""
        white, k = self.white(hyper).columns, len(self.some)
        padded = np.zeros((self.shape[0], white.shape[-1], white.shape[-1]))
        padded[:, :k, :k] = 2 * of_gram[:, self.some[:, None], self.some]
        weights, ones, total = np.split(white @ padded, len(self.pieces), -1), np.ones(self.shape[0]), np.zeros(4)
        for piece, weight in zip(self.pieces, weights, strict=True):
            of_white = (jnp.asarray(weight), jnp.asarray(ones), jnp.asarray(of_gram[:, -1, -1] * ones))
            total += np.asarray(slope_of(of_white, *self._given(hyper, piece)))
            ones = 0.0 * ones  # density and readings count once
        return total


@dataclass(frozen=True)
class Design:
    """The design matrix of a hypothesis around a state, every number in units of its prior's standard deviation."""

    tests: Tests
    linear: Linear  # how noise of force moves the tests
    own: Float[np.ndarray, "particles points o"]  # of random effects: b1, b3, b5, e (per unit), the zero, further ones
    common: Float[np.ndarray, "particles points c"]  # of the population's five, further numbers of effects, misfits
    amplitude: Float[np.ndarray, "particles points k"]  # of effects, per smallest plausible amplitude
    data: Float[np.ndarray, "particles points"]  # what is explained [um]
    scale: Float[np.ndarray, " particles"]  # each particle's own factor on the noise
    group: np.ndarray  # which scale a common column has: 0 where it is fixed at 1, else its place among `misfits`
    noise: Float[np.ndarray, "2 4"]  # prior of the noise's four numbers: means and sds of their logarithms
    largest: Float[np.ndarray, " k"]  # largest scale of each amplitude's prior over the smallest, which is the unit
    sign: Float[np.ndarray, " k"]
    misfits: Float[np.ndarray, "g 3"]  # of the logarithm of each misfit's scale: median, sd, and the most it can be
    spreads: tuple[Any, ...]  # priors of the spreads of b1, b3, b5, e, and of further own numbers
    correlation: Correlation
    along: Along

    @cached_property
    def columns(self) -> Columns:
        """All columns, the data last."""
        return Columns(np.concatenate([self.own, self.common, self.amplitude, self.data[..., None]], -1), self)

    def with_noise(self, model: Model) -> Design:
        """With the noise of a model."""
        noise = _prior_of_noise(model)
        return replace(self, noise=noise, correlation=model.correlation, along=model.along)

    def with_amplitudes(self, columns: np.ndarray) -> Design:
        """With other amplitudes, of either sign, whose priors are not used."""
        count = columns.shape[-1]
        return replace(self, amplitude=np.asarray(columns), sign=np.zeros(count), largest=np.ones(count))


@dataclass(frozen=True)
class ExtraColumns:
    """Columns of a hypothesis in addition to those of its formulas."""

    own: tuple[np.ndarray, ...] = ()  # of random effects of every test
    own_spreads: tuple[Any, ...] = ()  # the priors of their standard deviations
    amplitude: tuple[np.ndarray, ...] = ()  # of amplitudes of either sign in units of the smallest plausible one
    largest: tuple[float, ...] = ()  # plausible amplitude of each in that unit
    misfits: tuple[np.ndarray, ...] = ()  # of every misfit
    sizes: Sequence[tuple[float, float, float]] = ()  # of the logarithm of each one's size: median, sd, the most


NO_EXTRA = ExtraColumns()


def design_of(
    base: Base, state: State, variants: Variants = (), more: ExtraColumns = NO_EXTRA, linear: Linear | None = None
) -> Design:
    """The design of a hypothesis around a state, from the tests linearised there if they are already."""
    tests, point, (middle, factor) = base.tests, state.point, base.population_prior
    linear = linear_at(base, state, variants) if linear is None else linear
    names, theta = len(variants), np.asarray(point.theta)
    of_law, amplitude, further = np.split(np.asarray(linear.columns), [4, 4 + names], -1)
    means, slope = particle_means(state.population, base.flatness, base.model.shape_power)
    # The data less what the priors' means predict.
    away = means + slope @ (middle - np.asarray(state.population)) - np.asarray(point.latent)
    zero_prior = base.model.chosen_priors.zero_um
    ones = np.where(tests.mask, 1.0, 0.0)
    data = np.asarray(linear.residual) - np.einsum("npk,nk->np", of_law, away)
    data = data - (np.asarray(tests.contact) + zero_prior.mean - np.asarray(point.zero))[:, None] * ones
    data = data + np.einsum("npk,nk->np", amplitude, theta[:, :names])
    mean, sd, positive = further_priors(variants)
    now = theta[0, names:]
    further = further * np.where(positive, now, 1.0)
    data = data - further @ (mean - np.where(positive, np.log(np.where(positive, now, 1.0)), now))
    common = np.concatenate([of_law @ (slope @ factor), sd * further, *more.misfits], -1)
    fixed = common.shape[-1] - sum(columns.shape[-1] for columns in more.misfits)
    group = [0] * fixed + [k for k, columns in enumerate(more.misfits, 1) for _ in range(columns.shape[-1])]
    units = np.array([v.plausible[0] for v in variants])
    return Design(
        tests=tests,
        linear=replace(linear, columns=linear.columns[..., :0]),  # part of the design: one shape for all formulas
        own=np.concatenate([of_law, (zero_prior.sd * ones)[..., None], *more.own], -1),
        common=common,
        amplitude=np.concatenate([amplitude * units, *more.amplitude], -1),
        data=data,
        scale=base.scale,
        group=np.array(group, int),
        noise=_prior_of_noise(base.model),
        largest=np.array([*(v.plausible[1] / v.plausible[0] for v in variants), *more.largest], float),
        sign=np.array([*(v.sign for v in variants), *(0 for _ in more.largest)], float),
        misfits=np.array(more.sizes, float).reshape(-1, 3),
        spreads=(*base.spreads, *more.own_spreads),
        correlation=base.model.correlation,
        along=base.model.along,
    )


def linear_at(base: Base, state: State, variants: Variants) -> Linear:
    """The tests linearised at a state."""
    return base.each(linearise, state.point, Forms(base.model.unloading, variants))


def further_priors(variants: Sequence[Variant]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Prior means and sds of the formulas' further numbers, of the logarithm of positive ones; and which these are."""
    each = [n for v in variants for n in v.nuisances]
    mean, sd = np.array([nuisance_moments(n) for n in each]).reshape(-1, 2).T
    return mean, sd, np.array([n.plausible[0] > 0 for n in each], bool)


def _prior_of_noise(model: Model) -> np.ndarray:
    prior = model.chosen_priors.noise
    return np.stack([np.log(np.asarray(prior.median)), np.asarray(prior.log_sd)])


def particle_means(population: Any, flatness: np.ndarray, power: float) -> tuple[np.ndarray, np.ndarray]:
    """Means of the particles' b1, b3, b5, e under a population at the average shape, and their derivatives by it."""
    a, log_modulus, *b = np.asarray(population)
    log_eta = np.log1p(np.maximum(a * flatness, -0.99))
    by_a = np.where(a * flatness > -0.99, flatness / np.exp(log_eta), 0.0)
    means = np.column_stack([*(one + log_eta - log_eta.mean() for one in b), log_modulus + power * log_eta])
    slope = np.zeros((*means.shape, 5))
    slope[..., 0] = np.column_stack([*3 * [by_a - by_a.mean()], power * by_a])
    slope[:, range(4), [2, 3, 4, 1]] = 1.0
    return means, slope
