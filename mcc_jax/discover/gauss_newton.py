r"""Effects fitted as they are, not to first order: Gauss-Newton's method through the law with effects.

The linear system (`linear_model`) holds what an effect would add if it were small. A large one is not: its signature at
the strength it has differs from the one at zero, and so does what the base law can still take up. So the few formulas
that matter are fitted in the law with effects itself, with the population, every particle's deviations and zero, the
effects' amplitudes and their further numbers free together,

.. math:: D = \sum_i \lVert W_i (d_i - z_i - \gamma(F_i; w_i, \theta)) \rVert^2 + \lVert\xi_i\rVert^2
    + (z_i - z_{i0})^2/s_z^2 + \beta^T P \beta + \phi^T Q \phi + 2 c^T (\beta, \theta),
    \qquad w_i = m_i(\beta) + S \xi_i

with the noise filters W of the refined fit and c what curvature adds (`laplace_correction`, taken at the base law).
Every step is the linear system once more, around the latest values.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..effects import AbstractEffect, Nuisance, Record, Variant
from ..geometry import Particle
from ..law import Unloading
from .candidates import Candidate
from .legacy.compiling import compiled
from .legacy.fit import population_at
from .legacy.forward import law_of
from .legacy.noise import Whitening
from .legacy.population import Population, Scatter, moments
from .linear_model import Base, Signals, System, first_loaded, mean_by_globals, steps_of, turning_of
from .normal_equations import gram_matrices, in_batches

STEPS = 12
ENOUGH = 0.02
"""Drop of D below which another step is not worth it."""

HALVINGS = 6

RATIO = 0.7
"""Standard deviation of the logarithm of a further number around the grid's value (of its range / 4 where it has no
logarithm): grids are spaced by factors of two to five."""

SLOTS = 6
"""Columns of free numbers in the equations, always as many, so that they are compiled once."""


class Formula(eqx.Module):
    """A candidate's formula with all its numbers free.

    The free numbers are the amplitude in the candidate's unit, then for every further number that all tests share the
    logarithm of its ratio to the grid's value, or where it may be zero its distance from it in quarters of its range.

    Attributes:
        variant: the formula.
        grid: the further numbers' values at which the formula was looked for.
    """

    variant: Variant = eqx.field(static=True)
    grid: dict[str, Float[Array, ""]]

    @classmethod
    def of(cls, candidate: Candidate) -> Formula:
        """The formula of a candidate."""
        return cls(candidate.variant, {name: jnp.asarray(float(v)) for name, v in candidate.nuisance.items()})

    @property
    def free_nuisances(self) -> tuple[Nuisance, ...]:
        """Further numbers that are fitted."""
        return tuple(n for n in self.variant.nuisances if not n.random_per_test and n.plausible[0] < n.plausible[1])

    @property
    def size(self) -> int:
        """How many numbers are free."""
        return 1 + len(self.free_nuisances)

    @property
    def precision(self) -> np.ndarray:
        """Precision of the free numbers around zero: none of the amplitude."""
        return np.array([1e-12] + [1.0 / RATIO**2 if _by_ratio(n) else 1.0 for n in self.free_nuisances])

    def nuisance(self, theta: np.ndarray) -> dict[str, float]:
        """Values of all further numbers."""
        return {name: float(value) for name, value in self.nuisances(jnp.asarray(theta)).items()}

    def nuisances(self, theta: Float[Array, " size"]) -> dict[str, Array]:
        """Values of all further numbers, traceable."""
        values = dict(self.grid)
        for n, moved in zip(self.free_nuisances, theta[1:], strict=True):
            start, (low, high) = values[n.name], n.plausible
            value = start * jnp.exp(moved) if _by_ratio(n) else start + moved * (high - low) / 4
            values[n.name] = jnp.clip(value, low, high)
        return values

    def build(self, theta: Float[Array, " size"]) -> AbstractEffect:
        """The effect."""
        return self.variant.build(theta[0] * self.variant.plausible[1], **self.nuisances(theta))


def _by_ratio(nuisance: Nuisance) -> bool:
    return nuisance.plausible[0] > 0


def slices(formulas: Sequence[Formula]) -> tuple[slice, ...]:
    """Where each formula's own numbers stand among the free numbers of all."""
    ends = list(itertools.accumulate((f.size for f in formulas), initial=0))
    return tuple(itertools.starmap(slice, itertools.pairwise(ends)))


def effects_of(formulas: Sequence[Formula], theta: Float[Array, " size"]) -> tuple[AbstractEffect, ...]:
    """The effects at the free numbers of all formulas."""
    return tuple(f.build(theta[own]) for f, own in zip(formulas, slices(formulas), strict=True))


class State(eqx.Module):
    """Where the law stands.

    Attributes:
        latent: b1, b3, b5, e of every particle.
        zero: zeros of displacement [um].
        deviations: of every particle from the population.
        shift: of the population's parameters from the base fit's.
        theta: free numbers of the effects.
    """

    latent: Float[Array, "particles 4"]
    zero: Float[Array, " particles"]
    deviations: Float[Array, "particles k"]
    shift: Float[Array, " globals"]
    theta: Float[Array, " size"]


@dataclass(frozen=True)
class Refit:
    """A law with effects fitted to a campaign.

    Attributes:
        formulas: the effects.
        state: where it stands.
        deviance: D there.
        residual: measured less predicted displacement [um].
        jacobian: derivatives of the residual by b1, b3, b5, e and the zero.
        columns: derivatives of the residual by the effects' free numbers, shape (N, size, points).
        mean, by_globals, factor: of the particles' latent vectors under the moved population.
        covariance: of the effects' free numbers.
        converged: whether the last step was small.
    """

    formulas: tuple[Formula, ...]
    state: State
    deviance: float
    residual: Float[Array, "particles points"]
    jacobian: Float[Array, "particles points 5"]
    columns: Float[Array, "particles size points"]
    mean: Float[Array, "particles 4"]
    by_globals: Float[Array, "particles 4 globals"]
    factor: Float[Array, "particles 4 k"]
    covariance: np.ndarray
    converged: bool

    def own(self, which: int) -> np.ndarray:
        """Free numbers of one of the formulas."""
        return np.asarray(self.state.theta)[slices(self.formulas)[which]]

    def spread(self, which: int) -> np.ndarray:
        """Standard deviations of the free numbers of one of the formulas."""
        return np.sqrt(np.diagonal(self.covariance)[slices(self.formulas)[which]])

    @property
    def physical(self) -> bool:
        """Whether every amplitude has the sign it must have."""
        amplitudes = [self.own(i)[0] * f.variant.sign for i, f in enumerate(self.formulas)]
        return all(a > 0 or f.variant.sign == 0 for a, f in zip(amplitudes, self.formulas, strict=True))


def refit(base: Base, candidates: tuple[Candidate, ...], prior: np.ndarray, curved: np.ndarray | None = None) -> Refit:
    """Fit the law with these effects to a campaign, beginning at the base law.

    There the particles fit; the first step moves them and the amplitudes together.

    Args:
        base: the base fit, of which noise, spreads and priors are taken.
        candidates: the formulas; none for the base law itself.
        prior: precision of the population's parameters around the base fit's.
        curved: what curvature adds to the derivative of D / 2 by the population's parameters and each formula's
            amplitude (`System.curved`); nothing if None.
    """
    formulas = tuple(Formula.of(c) for c in candidates)
    own = np.concatenate([np.zeros(0), *(f.precision for f in formulas)])
    if len(own) > SLOTS:
        raise ValueError(f"{len(own)} free numbers, at most {SLOTS} can be fitted together")
    push = np.zeros(len(prior) + len(own))
    if curved is not None:
        amplitudes = [len(prior) + one.start for one in slices(formulas)]
        push[[*range(len(prior)), *amplitudes]] = curved
    problem = _Problem(base, formulas, np.asarray(prior, float), own, push)
    state = State(
        base.fit.latent,
        base.fit.zero,
        jnp.zeros((len(base.tests), base.legacy_model.scatter.size)),
        jnp.zeros(len(prior)),
        jnp.zeros(len(own)),
    )
    # The fitted latent vectors are none of this population's to the last digit: a step makes them so.
    state = problem.move(state, problem.step(state, problem.linearise(state), hold=True), 1.0)
    view = problem.linearise(state)
    deviance = problem.deviance(state, view)
    converged = False
    for _ in range(STEPS):
        change = problem.step(state, view)
        share = 1.0
        for _ in range(HALVINGS):
            tried = problem.move(state, change, share)
            there = problem.linearise(tried)
            value = problem.deviance(tried, there)
            if value <= deviance + 1e-9 * abs(deviance):
                break
            share /= 2
        else:
            break
        drop = deviance - value
        state, view, deviance = tried, there, value
        if drop < ENOUGH and share == 1.0:
            converged = True
            break
    mean, slope, factor = problem.population(state)
    covariance = problem.covariance(state, view)
    return Refit(formulas, state, deviance, *view, mean, slope, factor, covariance, converged)


def system_at(base: Base, system: System, signals: Signals, chosen: list[int], found: Refit) -> System:
    """The linear system around a law with effects: its residuals, its derivatives, its effects' further numbers."""
    amplitudes = np.array([own.start for own in slices(found.formulas)], int)
    added = signals.added.at[:, np.array(chosen)].set(found.columns[:, amplitudes])
    tests, state = base.tests, found.state
    gram, turned, *of_steps = gram_matrices(
        turning_of(base, signals, found.jacobian, found.by_globals, found.factor),
        found.residual,
        found.jacobian,
        tests.mask,
        first_loaded(tests),
        base.fit.filters,
        added,
        signals.seen,
        found.mean - state.latent,
        found.by_globals,
        found.factor,
        base.legacy_model.zero_sd,
        state.zero - tests.contact,
    )
    candidates, at = list(system.candidates), np.zeros(len(system.candidates))
    for i, (k, formula) in enumerate(zip(chosen, found.formulas, strict=True)):
        candidates[k] = Candidate(formula.variant, {**candidates[k].nuisance, **formula.nuisance(found.own(i))})
        at[k] = found.own(i)[0]
    steps = steps_of(tests, system.candidates, *of_steps)
    shift = np.asarray(state.shift)
    return replace(system, gram=gram, turned=turned, steps=steps, candidates=tuple(candidates), at=at, shift=shift)


class _Step(eqx.Module):
    """New deviations and zeros, and changes of shift and theta."""

    deviations: Float[Array, "particles k"]
    zero: Float[Array, " particles"]
    shift: Float[Array, " globals"]
    theta: Float[Array, " size"]


class _Problem:
    """The equations of one law with effects and one campaign."""

    def __init__(
        self, base: Base, formulas: tuple[Formula, ...], prior: np.ndarray, own: np.ndarray, push: np.ndarray
    ) -> None:
        self.base, self.formulas = base, formulas
        self.push = push
        self.prior = jnp.asarray(prior)
        self.size = len(own)
        self.own = jnp.asarray(own)
        # Slots that are not used are held at zero.
        self.slots = jnp.asarray(np.pad(own, (0, SLOTS - len(own)), constant_values=1.0))
        self.start = population_at(base.fit.mode, base.fit.numbers, base.legacy_model.scatter)

    def population(self, state: State) -> tuple[Array, Array, Array]:
        """Mean of the latent vectors, its derivatives, and the factor of their covariance."""
        flat, scatter = self.base.tests.flatness, self.base.legacy_model.scatter
        there, mean, factor = _moved(self.start, state.shift, flat, scatter)
        return mean, mean_by_globals(there, flat, scatter), factor

    def linearise(self, state: State) -> tuple[Array, Array, Array]:
        """Residuals and their derivatives."""
        base = self.base
        tests, unloading = base.tests, base.model.unloading
        rows = (state.latent, state.zero, tests.particle, base.records, tests.displacement, tests.mask)
        return in_batches(partial(_linearise, theta=state.theta, formulas=self.formulas, unloading=unloading), rows)

    def deviance(self, state: State, view: tuple[Array, Array, Array]) -> float:
        """D."""
        base = self.base
        away = (np.asarray(state.zero) - np.asarray(base.tests.contact)) / float(base.legacy_model.zero_sd)
        value = float(_squares(view[0], base.fit.filters)) + float(np.sum(np.asarray(state.deviations) ** 2))
        value += float(np.sum(away**2)) + float(np.sum(np.asarray(self.prior) * np.asarray(state.shift) ** 2))
        value += float(np.sum(np.asarray(self.own) * np.asarray(state.theta) ** 2))
        moved = np.concatenate([np.asarray(state.shift), np.asarray(state.theta)])
        value += 2 * float(self.push @ moved)
        return value if np.isfinite(value) else np.inf

    def step(self, state: State, view: tuple[Array, Array, Array], *, hold: bool = False) -> _Step:
        """Best deviations, zeros and changes of the linear problem; `hold` leaves the effects as they are."""
        deviations, zero, shift, moved, _ = self._solved(state, view, jnp.full(SLOTS, 1e30) if hold else self.slots)
        return _Step(deviations, state.zero + zero, shift, jnp.zeros(self.size) if hold else moved[: self.size])

    def covariance(self, state: State, view: tuple[Array, Array, Array]) -> np.ndarray:
        """Covariance of the effects' free numbers, everything else free, too."""
        return np.asarray(self._solved(state, view, self.slots)[4])[: self.size, : self.size]

    def _solved(self, state: State, view: tuple[Array, Array, Array], own: Array) -> tuple[Array, ...]:
        base = self.base
        mean, slope, factor = self.population(state)
        residual, jacobian, columns = view
        wide = jnp.pad(columns, ((0, 0), (0, SLOTS - self.size), (0, 0)))
        return _solve(
            residual,
            jacobian,
            wide,
            base.tests.mask,
            base.fit.filters,
            mean - state.latent,
            slope,
            factor,
            base.legacy_model.zero_sd,
            state.zero - base.tests.contact,
            state.shift,
            self.prior,
            jnp.pad(state.theta, (0, SLOTS - self.size)),
            own,
            jnp.asarray(np.pad(self.push, (0, SLOTS - self.size))),
        )

    def move(self, state: State, step: _Step, share: float) -> State:
        """The state a share of the step away."""
        shift = state.shift + share * step.shift
        theta = state.theta + share * step.theta
        deviations = state.deviations + share * (step.deviations - state.deviations)
        zero = state.zero + share * (step.zero - state.zero)
        moved = State(state.latent, zero, deviations, shift, theta)
        mean, _, factor = self.population(moved)
        return eqx.tree_at(lambda s: s.latent, moved, mean + jnp.einsum("npk,nk->np", factor, deviations))


@compiled
def _moved(
    population: Population, shift: Float[Array, " globals"], flat: Float[Array, " particles"], scatter: Scatter
) -> tuple[Population, Array, Array]:
    there = eqx.tree_at(
        lambda p: (p.a, p.log_modulus, p.mu),
        population,
        (population.a + shift[0], population.log_modulus + shift[1], population.mu + shift[2:]),
    )
    return there, *moments(there, flat, scatter)


@compiled
def _linearise(
    latent: Float[Array, "particles 4"],
    zero: Float[Array, " particles"],
    particles: Particle,
    records: Record,
    displacement: Float[Array, "particles points"],
    mask: Bool[Array, "particles points"],
    theta: Float[Array, " size"],
    formulas: tuple[Formula, ...],
    unloading: Unloading,
) -> tuple[Array, Array, Array]:
    def one(w, z, particle, record, measured, mask):
        def predicted(w, theta):
            return law_of(w, unloading, effects_of(formulas, theta)).respond(particle, record)

        value, push = jax.linearize(predicted, w, theta)
        by_latent = jax.vmap(lambda d: push(d, jnp.zeros_like(theta)))(jnp.eye(4))
        by_theta = jax.vmap(lambda d: push(jnp.zeros_like(w), d))(jnp.eye(len(theta)))
        used = mask[None]
        J = jnp.concatenate([-by_latent, -jnp.ones((1, len(value)))])
        residual = jnp.where(mask, measured - value - z, 0.0)
        return residual, jnp.where(used, J, 0.0).T, jnp.where(used, -by_theta, 0.0)

    return jax.vmap(one)(latent, zero, particles, records, displacement, mask)


@compiled
def _squares(residual: Float[Array, "particles points"], filters: Whitening) -> Float[Array, ""]:
    return jnp.sum(jax.vmap(lambda white, r: white(r))(filters, residual) ** 2)


@compiled
def _solve(
    residual,
    jacobian,
    columns,
    mask,
    filters,
    away,
    by_globals,
    factor,
    zero_sd,
    zero_away,
    shift,
    prior,
    theta,
    own,
    push,
):
    """Deviations, zeros' changes, changes of the population and of the effects that minimise the linear problem."""
    k = factor.shape[-1]

    def one(r, J, C, used, white, offset, slope, S, z):
        by_latent, by_zero = J[:, :4], J[:, 4]
        rows = jnp.concatenate(
            [(by_latent @ S).T, by_zero[None], (r + by_latent @ offset)[None], (by_latent @ slope).T, C]
        )
        X = jax.vmap(white)(jnp.where(used[None], rows, 0.0))
        A = X @ X.T
        inner = A[: k + 1, : k + 1] + jnp.diag(jnp.concatenate([jnp.ones(k), 1 / zero_sd[None] ** 2]))
        # The zero's prior pulls towards the recorded contact.
        pull = jnp.concatenate([jnp.zeros(k), z[None] / zero_sd**2])
        border = A[: k + 1, k + 1 :].at[:, 0].add(pull)
        solved = jnp.linalg.solve(inner, border)
        return A[k + 1 :, k + 1 :] - border.T @ solved, solved

    left, solved = jax.vmap(one)(residual, jacobian, columns, mask, filters, away, by_globals, factor, zero_away)
    total = left.sum(0)
    weight = jnp.concatenate([prior, own])
    H = total[1:, 1:] + jnp.diag(weight)
    g = total[1:, 0] + weight * jnp.concatenate([shift, theta]) + push
    scale = 1 / jnp.sqrt(jnp.diagonal(H))
    change = -scale * jnp.linalg.solve(H * scale[None] * scale[:, None], scale * g)
    inverse = jnp.linalg.inv(H * scale[None] * scale[:, None]) * scale[None] * scale[:, None]
    inside = -(solved[:, :, 0] + jnp.einsum("nkq,q->nk", solved[:, :, 1:], change))
    cut = by_globals.shape[-1]
    return inside[:, :k], inside[:, k], change[:cut], change[cut:], inverse[cut:, cut:]
