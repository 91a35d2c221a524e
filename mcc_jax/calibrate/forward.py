r"""The forward model of every calibration: displacement at measured force, and its derivatives.

The test machine controls force and noise is in displacement, so a test of particle i is

.. math:: d_{ik} = z_i + \gamma(F_{i1} \dots F_{ik};\, b_i, e_i, \theta_i) + \text{noise}

with its zero z, and the law's displacement under load control. The law knows the coefficients only through products
with the shape factor: :math:`b_j = \log(C_j \eta_p)`, and the modulus through :math:`e = \log(\bar E \eta_p^p)` with
the power p of the strain scaling (half of it in the punch forms, where the modulus is squared). So the data of one
particle never contain the shape parameter `a`: it enters through what particles of different shapes have in common
(`population`). :math:`\theta_i` are the numbers of the effects, amplitudes first.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Path, Scalar, Values
from ..arguments import is_traced
from ..effects import AbstractEffect, Record, Variant
from ..geometry import Particle
from ..law import MccLaw, Plastic, StrainScaling, Unloading
from ..law.derivatives import Formula, Numbers, along, padded
from .data import Tests
from .running import Blocks

Latent = Float[Array, " 4"]  # b1, b3, b5 and e of one particle


@functools.cache
def _formula(variant: Variant) -> Formula:
    return Formula(replace(variant.build(1.0), label=""), ("amplitude", *(n.name for n in variant.nuisances)))


class Forms(eqx.Module):
    """What does not change while a law is fitted: its form of unloading and the formulas of its effects."""

    unloading: Unloading = eqx.field(static=True)
    effects: tuple[Variant, ...] = eqx.field(static=True, default=())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects' numbers: every mechanism's amplitude, then their further numbers."""
        further = (f"{v.mechanism}.{n.name}" for v in self.effects for n in v.nuisances)
        return (*(v.mechanism for v in self.effects), *further)

    @property
    def positive(self) -> np.ndarray:
        """Which of the further numbers must be positive, and are fitted by their logarithm."""
        return np.array([n.plausible[0] > 0 for v in self.effects for n in v.nuisances], bool)

    @property
    def formulas(self) -> tuple[Formula, ...]:
        """The effects without their numbers."""
        return tuple(map(_formula, self.effects))

    @property
    def places(self) -> tuple[tuple[int, ...], ...]:
        """Where the numbers of each effect are among all: its amplitude, then its further numbers."""
        ends = np.cumsum([len(self.effects), *(len(v.nuisances) for v in self.effects)]).tolist()
        return tuple((k, *range(ends[k], ends[k + 1])) for k in range(len(self.effects)))

    def build(self, theta: Float[Array, " numbers"]) -> tuple[AbstractEffect, ...]:
        """The effects with these numbers, in the order of `names`."""
        built = []
        for variant, (amplitude, *places) in zip(self.effects, self.places, strict=True):
            further = {n.name: theta[place] for n, place in zip(variant.nuisances, places, strict=True)}
            built.append(variant.build(theta[amplitude], **further))
        return tuple(built)

    def law(self, latent: Latent, theta: Float[Array, " numbers"]) -> MccLaw:
        """The law that has taken in its particle's shape: a = 0, coefficients times the shape factor."""
        b1, b3, b5, e = latent
        plastic = Plastic(jnp.exp(b1), jnp.exp(b3), jnp.exp(b5))
        return MccLaw(plastic, 0.0, jnp.exp(e), self.unloading, effects=self.build(theta))

    def displacement(self, latent: Latent, theta: Float[Array, " numbers"], particle: Particle, record: Record) -> Path:
        """Displacement [um] of a virgin particle along its test, from its own zero."""
        return self.law(latent, theta).respond(particle, record)


class Point(eqx.Module):
    """Where tests are linearised."""

    latent: Float[Array, "particles 4"]  # b1, b3, b5, e of every particle
    zero: Float[Array, " particles"]  # zeros of displacement [um]
    # numbers of the effects of every particle, in the order of `Forms.names`; amplitudes may differ from particle to
    # particle, the others are the same for all
    theta: Float[Array, "particles numbers"]


class Linear(eqx.Module):
    """Tests linear in everything the prediction depends on, 0 where masked: residuals [um], and derivatives of the
    prediction, by forces in um/mN."""

    residual: Float[Array, "particles points"]
    columns: Float[Array, "particles points numbers"]  # by b1, b3, b5, e and the effects' numbers
    by_force: Float[Array, "particles points"]  # by a point's own reading
    by_peak: Float[Array, "particles points"]  # by the force from which its branch starts
    by_offset: Float[Array, "particles points"]  # by an error that all forces of a test share
    # derivatives of the columns by each of the effects' numbers, one after the other; None for a law without effects
    bends: Float[Array, "particles points bends"] | None = None


def residuals(point: Point, tests: Tests, forms: Forms) -> Float[Array, "particles points"]:
    """Measured less predicted displacement [um], 0 where masked."""
    assert tests.displacement is not None
    predicted = jax.vmap(forms.displacement)(point.latent, point.theta, tests.particle, tests.record)
    return jnp.where(tests.mask, tests.displacement - predicted - point.zero[:, None], 0.0)


def linearise(point: Point, tests: Tests, forms: Forms, *, with_numbers: bool = True) -> Linear:
    """Linearise all tests, by forward derivatives in as many directions as one particle has numbers, if these are asked
    for. Not to be compiled: then one program would hold the law and the formula of an effect."""
    found = derivatives(point.latent, point.zero, point.theta, tests, forms, with_numbers)
    _, _, by_force, by_peak = found
    return Linear(*map(jnp.asarray, (*found, by_force + by_peak)))


def derivatives(
    latent: Any, zero: Any, theta: Any, tests: Tests, forms: Forms, with_numbers: bool = True
) -> tuple[Any, Any, Any, Any]:
    """Residual, columns, and derivatives by force and peak as in `Linear`: of NumPy, where nothing is traced."""
    record = tests.record
    assert record.peak is not None
    traced = any(is_traced(x) for x in jax.tree.leaves((latent, zero, theta, tests)))
    xp: Any = jnp if traced else np
    latent, zero, theta, mask = (xp.asarray(x) for x in (latent, zero, theta, tests.mask))
    (count, points), size = record.force.shape, (4 + theta.shape[1]) * with_numbers
    law = xp.insert(xp.exp(latent), 3, 0.0, axis=1)  # a = 0: the shape is taken in
    # Every number of a particle has a direction of its own; those of the law are logarithms.
    unit = np.zeros((padded(size + 2) if forms.effects else size + 2, 4 + theta.shape[1]))
    unit[range(size), range(size)] = 1.0
    d_law = unit[:, None, [0, 1, 2, 0, 3]] * law[None]
    d_theta = np.broadcast_to(unit[:, None, 4:], (len(unit), count, theta.shape[1]))
    own = xp.where(xp.asarray(tests.reading), 1.0, 0.0)
    elastic = xp.where(xp.asarray(tests.peak_error) > 0, 1.0, 0.0)
    before, after = xp.zeros((size, count, points)), xp.zeros((len(unit) - size - 2, count, points))
    # A reading on virgin loading is its own peak; where an estimate replaces readings, both move together.
    d_force = xp.concatenate([before, xp.stack([own, 1 - own]), after])
    d_peak = xp.concatenate([before, xp.stack([1 - elastic, elastic]), after])

    def of_effects(numbers: Any) -> tuple[Any, ...]:
        return tuple(numbers[..., list(each)] for each in forms.places)

    there = Numbers(law, record.force, record.peak, of_effects(theta))
    directions = Numbers(d_law, d_force, d_peak, of_effects(d_theta))
    kinds = forms.unloading, StrainScaling.RAW
    value, slopes = map(xp.asarray, along(kinds, forms.formulas, tests.particle, record, there, directions))
    slopes = xp.where(mask[None], slopes[: size + 2], 0.0)
    residual = xp.zeros((count, points))
    if tests.displacement is not None:
        residual = xp.where(mask, xp.asarray(tests.displacement) - value - zero[:, None], 0.0)
    return residual, xp.moveaxis(slopes[:size], 0, -1), slopes[size], slopes[size + 1]


def snap(latent: Latent, particle: Particle) -> Scalar:
    """Logarithm of the force [mN] at which loading snaps through; infinite if the law is monotone."""
    b1, b3, b5, _ = latent
    K1, K3, K5 = Plastic(jnp.exp(b1), jnp.exp(b3), jnp.exp(b5)).polynomial
    falls = 9 * K3 * K3 > 20 * K1 * K5
    root = jnp.sqrt(jnp.where(falls, 9 * K3 * K3 - 20 * K1 * K5, 1.0))
    square = 2 * K1 / (3 * K3 + root)  # of the scaled strain at the peak
    force = particle.force(jnp.sqrt(square) * (K1 - square * (K3 - square * K5)))
    return jnp.where(falls, jnp.log(jnp.where(falls, force, 1.0)), jnp.inf)


# ---- all tests linearised, in coordinates in which the prediction is nearly linear -----------------------------------

Places = tuple[tuple[int, int], ...]
"""Of each further number that must be positive its place among the effects' numbers, and its amplitude's."""

FARTHEST = 20.0  # exponents are cut here: a number e^20 times that of the point is nowhere near any test
STEEPEST = 3.0  # largest shear or power; found by trial


class Straight(eqx.Module):
    r"""Shear p and power q of every number of the effects; 0 of amplitudes, and of numbers that may be 0.

    Tests may leave a number of an effect open over a decade: of logarithmic creep whose time is far beyond the record
    they show the amplitude over the time, and of the time by itself almost nothing. A quadratic in amplitude and time,
    or in their logarithms, does not hold that far. Of an amplitude A and a further, positive number :math:`\theta`,
    where tests are linearised at :math:`\hat A, \hat\theta`, the coordinates are

    .. math:: x = \log(\theta/\hat\theta), \qquad v = \hat\theta \frac{e^{q x} - 1}{q}, \qquad u = A e^{p x} - \hat A

    The shear p takes from what :math:`\theta` does that part which the amplitude does as well. The power q makes the
    rest as large on one side of the point as on the other. With p = q = 0 they are the amplitude and the logarithm.

    References:
        Bates and Watts (1980), Relative curvature measures of nonlinearity: parameter-effects curvature.
        Box and Cox (1964), An analysis of transformations. Cox and Reid (1987), Parameter orthogonality.
    """

    shear: Float[Array, "particles numbers"]
    power: Float[Array, "particles numbers"]

    @classmethod
    def of(cls, count: int, shear: np.ndarray, power: np.ndarray) -> Straight:
        """The same for so many particles."""
        return cls(*(jnp.asarray(np.broadcast_to(x, (count, len(x)))) for x in (shear, power)))


def coordinates(
    theta: Float[Array, " numbers"], at: Float[Array, " numbers"], straight: Straight, places: Places
) -> tuple[Float[Array, " numbers"], Float[Array, " numbers"]]:
    """Coordinates of a particle's numbers, linearised `at` others, and the factor of each amplitude in its own."""
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
        """All tests linearised around a point. With standard deviations of the effects' numbers (of the logarithm of
        positive ones) in straightened coordinates, and with how they bend over these."""
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
        """Derivative of all columns by an effect's number, as in `Marginal`, by differences; 0 for a step of 0."""
        size = point.theta.shape[1]
        if not step:
            return np.zeros((*self._tests.mask.shape, 4 + size))
        ends = np.array([step, -step])
        if number in dict(self._positive):
            ends = np.asarray(point.theta[0, number] * box_cox(jnp.asarray(ends), self.straight.power[0, number]))
        places = np.where(np.arange(size) == number, ends[:, None], 0.0)
        up, down = (np.asarray(self._moved(point, away).columns) for away in places)
        return (up - down) / (ends[0] - ends[1])
