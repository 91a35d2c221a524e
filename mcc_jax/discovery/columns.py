"""The design matrix of a hypothesis, and its whitening.

Of a hypothesis's evidence only the noise's filter is compiled: for a few columns at a time, so that one program serves
all hypotheses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..calibrate.compiling import compiled
from ..calibrate.data import Tests
from ..calibrate.forward import Linear
from ..calibrate.model import Model
from ..calibrate.noise import Along, Correlation, Noise, whitening

LOG_2PI = float(np.log(2 * np.pi))

AT_ONCE = 6, 18  # columns that are whitened in one call, at least and at most
ENTRIES = 270_000  # numbers that these hold together, about, so that they stay in a processor's own memory


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
    kinds: Kinds

    @cached_property
    def columns(self) -> Columns:
        """All columns, the data last."""
        return Columns(np.concatenate([self.own, self.common, self.amplitude, self.data[..., None]], -1), self)

    @property
    def of_misfits(self) -> np.ndarray:
        """Which of the common columns are those of misfits."""
        return np.flatnonzero(self.group)


@dataclass(frozen=True)
class Kinds:
    """Of what kind noise and spreads are."""

    spreads: tuple[Any, ...]  # priors of the spreads of b1, b3, b5, e, and of further own numbers
    correlation: Correlation
    along: Along


def with_noise(design: Design, model: Model) -> Design:
    """The design with the noise of a model."""
    kinds = replace(design.kinds, correlation=model.correlation, along=model.along)
    return replace(design, noise=prior_of_noise(model), kinds=kinds)


def prior_of_noise(model: Model) -> np.ndarray:
    """As `Design.noise` has it."""
    prior = model.chosen_priors.noise
    return np.stack([np.log(np.asarray(prior.median)), np.asarray(prior.log_sd)])


def with_amplitudes(design: Design, columns: np.ndarray) -> Design:
    """The design with other amplitudes, of either sign, whose priors are not used."""
    count = columns.shape[-1]
    return replace(design, amplitude=np.asarray(columns), sign=np.zeros(count), largest=np.ones(count))


def without_further(design: Design) -> Design:
    """The design without numbers of every test's own beyond b1, b3, b5, e and the zero."""
    return replace(design, own=design.own[..., :5], kinds=replace(design.kinds, spreads=design.kinds.spreads[:4]))


def without_misfits(design: Design) -> Design:
    """The design without its misfits, linear where it is."""
    fixed = design.group == 0
    return replace(design, common=design.common[..., fixed], group=design.group[fixed], misfits=design.misfits[:0])


class White(NamedTuple):
    """Whitened columns: their noise is independent from point to point and of variance 1."""

    columns: Any
    log_density: Any  # of the noise at 0
    reading: Any  # sum of squares that reading a display alone brings about
    sd: Any  # of each point given those before it


@compiled
def white_of(
    logs: Float[Array, " 4"],
    scale: Array,
    tests: Tests,
    linear: Linear,
    columns: Float[Array, "particles points few"],
    correlation: Correlation,
) -> White:
    """Whiten columns of all tests, at the logarithms of the noise's four numbers."""
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


@dataclass(frozen=True)
class Whitened:
    """Whitened columns with padding: the first of them are `some` of `count` columns, the others are zero."""

    white: White
    some: np.ndarray
    count: int

    @cached_property
    def gram(self) -> np.ndarray:
        """Gram matrices of all columns, the readings' squares with the data's."""
        columns, k = self.white.columns, len(self.some)
        gram = np.zeros((len(columns), self.count, self.count))
        gram[:, self.some[:, None], self.some] = (np.swapaxes(columns, 1, 2) @ columns)[:, :k, :k]
        gram[:, -1, -1] += self.white.reading
        return gram


class Columns:
    """Columns of a design cut into pieces of one shape; columns of zeros are left out."""

    def __init__(self, columns: np.ndarray, design: Design) -> None:
        self.shape = columns.shape
        self._last: tuple[bytes, Whitened] | None = None
        self.some = np.flatnonzero(np.any(columns != 0, axis=(0, 1)))
        least, most = AT_ONCE
        size = min(max(ENTRIES // (self.shape[0] * self.shape[1]), least), most)
        count = -(-max(len(self.some), 1) // size)
        padded = np.zeros((*self.shape[:2], count * size))
        padded[..., : len(self.some)] = columns[..., self.some]
        self.pieces = [jnp.asarray(piece) for piece in np.split(padded, count, -1)]
        tests, kinds = design.tests, design.kinds
        if kinds.along is Along.TIME:  # one program for both
            tests = replace(tests, path=tests.record.time)
        self.arrays, self.correlation = (jnp.asarray(design.scale), tests, design.linear), kinds.correlation

    def _given(self, hyper: np.ndarray, piece: Array) -> tuple[Any, ...]:
        return jnp.asarray(hyper[:4]), *self.arrays, piece, self.correlation

    def _whitened(self, hyper: np.ndarray) -> Whitened:
        """At the hyperparameters; those of the last call are kept, since most are asked for more than once."""
        noise = np.asarray(hyper[:4], float).tobytes()
        last = self._last  # another thread may put its own in place meanwhile
        if last is not None and last[0] == noise:
            return last[1]
        found = [jax.tree.map(np.asarray, white_of(*self._given(hyper, piece))) for piece in self.pieces]
        columns = found[0].columns if len(found) == 1 else np.concatenate([one.columns for one in found], -1)
        white = Whitened(found[0]._replace(columns=columns), self.some, self.shape[2])
        self._last = noise, white
        return white

    def white(self, hyper: np.ndarray) -> White:
        """Whitened at the hyperparameters."""
        white = self._whitened(hyper).white
        columns = np.zeros(self.shape)
        columns[..., self.some] = white.columns[..., : len(self.some)]
        return white._replace(columns=columns)

    def gram(self, hyper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gram matrix of every particle's whitened columns, the readings' squares with the data's; log density of the
        noise at 0."""
        white = self._whitened(hyper)
        return white.gram, white.white.log_density

    def slope(self, hyper: np.ndarray, of_gram: np.ndarray) -> np.ndarray:
        """Derivatives of something by the noise's numbers, from those by the Gram matrices; the noise's log density is
        part of it."""
        white, k = self._whitened(hyper).white.columns, len(self.some)
        padded = np.zeros((self.shape[0], white.shape[-1], white.shape[-1]))
        padded[:, :k, :k] = 2 * of_gram[:, self.some[:, None], self.some]
        weights, ones, total = np.split(white @ padded, len(self.pieces), -1), np.ones(self.shape[0]), np.zeros(4)
        for piece, weight in zip(self.pieces, weights, strict=True):
            of_white = (jnp.asarray(weight), jnp.asarray(ones), jnp.asarray(of_gram[:, -1, -1] * ones))
            total += np.asarray(slope_of(of_white, *self._given(hyper, piece)))
            ones = 0.0 * ones  # density and readings count once
        return total
