r"""The posterior of the law with effects: the joint calibration once more, with what was found missing in the law.

Around the fit of the law with effects (`gauss_newton`) the tests are linear in the effects' free numbers
:math:`\theta`. In the quadratic summary of test i, whose zero is integrated out by :math:`M_i`, they move nothing but
score and squares,

.. math:: g_i(\theta) = g_i - J_i^T M_i C_i \delta, \qquad
    R_i(\theta) = R_i + 2 \delta^T C_i^T M_i r_i + \delta^T C_i^T M_i C_i \delta, \qquad
    \delta = \theta - \hat\theta

so the population and :math:`\theta` are sampled together with the particles integrated out, as without effects
(`legacy.sampling`); the particles are drawn back, and the weights that make the draws exact come from the
extended law itself.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..calibrate.estimates import finite
from ..effects import Record
from .gauss_newton import Formula, Refit, effects_of, slices
from .legacy.compiling import compiled
from .legacy.diagnostics import ESS_LEAST, RHAT_MOST, population_json, unmixed
from .legacy.draws import Length, draw_around
from .legacy.fit import population_at
from .legacy.forward import law_of
from .legacy.linearise import careful_enough, linear_data, summarise
from .legacy.noise import Whitening
from .legacy.population import Population, Summary, marginal_likelihood
from .legacy.sampling import ExactLikelihood
from .legacy.sharding import count_of
from .legacy.transforms import LogPosterior, constrain, most_probable, unconstrain
from .legacy.weights import PARETO_K_MOST
from .linear_model import Base

LENGTH = Length(4, 300, 1000)


class Movable(eqx.Module):
    """Summaries of the tests as functions of the effects' free numbers.

    Attributes:
        summary: at `theta`.
        theta: where they were taken.
        by_squares, by_squares_twice: half the derivative of `squares`, and its second derivative.
        by_score: derivative of `score`.
        by_zero: derivative of `zero`.
    """

    summary: Summary
    theta: Float[Array, " size"]
    by_squares: Float[Array, "particles size"]
    by_squares_twice: Float[Array, "particles size size"]
    by_score: Float[Array, "particles 4 size"]
    by_zero: Float[Array, "particles size"]

    def at(self, theta: Float[Array, " size"]) -> Summary:
        """The summaries at other numbers."""
        moved = theta - self.theta
        squares = self.summary.squares + 2 * self.by_squares @ moved
        squares += jnp.einsum("nab,a,b->n", self.by_squares_twice, moved, moved)
        return eqx.tree_at(
            lambda s: (s.squares, s.score, s.zero),
            self.summary,
            (squares, self.summary.score + self.by_score @ moved, self.summary.zero + self.by_zero @ moved),
        )


class ExtendedPopulation(Population):
    """What all particles share, effects included.

    Attributes:
        theta: the effects' free numbers (`Formula`).
    """

    theta: Float[Array, " size"]

    def further(self) -> dict[str, Array]:
        """The free numbers, by position."""
        return {f"theta_{i}": jnp.asarray(self.theta)[..., i] for i in range(self.theta.shape[-1])}


class ExtendedTarget(LogPosterior):
    """The density of population and effects given all tests; the last coordinates are the free numbers.

    Attributes:
        movable: the tests.
        precision: of the free numbers' prior, around zero.
        scale: unit of their coordinates.
    """

    movable: Movable
    precision: Float[Array, " size"]
    scale: Float[Array, " size"]

    def population(self, free: Float[Array, " d"]) -> Population:
        """Population and effects at unbounded coordinates."""
        return self._split(free)[0]

    def log_density(self, free: Float[Array, " d"]) -> Float[Array, ""]:
        """Log density given all tests, up to a constant."""
        population, prior = self._split(free)
        tests = self.movable.at(population.theta)
        prior += -0.5 * jnp.sum(self.precision * population.theta**2)
        return prior + jnp.sum(marginal_likelihood(population, tests, self.flatness, self.scatter))

    def _split(self, free: Float[Array, " d"]) -> tuple[ExtendedPopulation, Float[Array, ""]]:
        size = len(self.scale)
        base, prior = constrain(free[:-size], self.numbers, self.scatter)
        theta = self.movable.theta + self.scale * free[-size:]
        return ExtendedPopulation(**vars(base), theta=theta), prior


class ExtendedExact(ExactLikelihood):
    """Tests with their exact likelihood under the law with effects.

    Attributes:
        records: what the tester did.
        movable: the summaries.
        formulas: the effects.
    """

    records: Record
    movable: Movable
    formulas: tuple[Formula, ...]

    def by_test(self) -> tuple[PyTree, ...]:
        """The fields with one row per test."""
        m = self.movable
        inner = (m.summary, m.by_squares, m.by_squares_twice, m.by_score, m.by_zero)
        return (*super().by_test(), self.records, *inner)

    def summary_at(self, population: Population) -> Summary:
        """The summaries at the population's effects."""
        assert isinstance(population, ExtendedPopulation)
        return self.movable.at(population.theta)

    def predicted(
        self, population: Population, latent: Float[Array, "particles 4"]
    ) -> Float[Array, "particles points"]:
        """Displacement [um] of every particle from its own zero."""
        assert isinstance(population, ExtendedPopulation)
        effects = effects_of(self.formulas, population.theta)
        return jax.vmap(lambda w, p, r: law_of(w, self.unloading, effects).respond(p, r))(
            latent, self.tests.particle, self.records
        )


@dataclass(frozen=True)
class ExtendedPosterior:
    """The posterior of the law with the effects that were found missing.

    Draws have the axes (chain, draw, ...).

    Attributes:
        formulas: the effects.
        population: draws of the population; `theta` holds the effects' free numbers.
        C: draws of every particle's C1, C3, C5.
        modulus_MPa, zero_um: draws of every particle's modulus and zero.
        log_likelihood: of every particle's test, the particle integrated out.
        particles: their names.
        pareto_k: of every particle's importance weights.
        pareto_k_joint: of the weights of all particles together; None where they were not formed.
        divergences: number of divergent trajectories.
        rhat, ess_bulk: by parameter.
        notes: what a reader must know.
    """

    formulas: tuple[Formula, ...]
    population: Population
    C: np.ndarray
    modulus_MPa: np.ndarray
    zero_um: np.ndarray
    log_likelihood: np.ndarray
    particles: tuple[str, ...]
    pareto_k: np.ndarray
    pareto_k_joint: float | None
    divergences: int
    rhat: dict[str, float]
    ess_bulk: dict[str, float]
    notes: tuple[str, ...] = ()

    def effect_draws(self, which: int) -> dict[str, np.ndarray]:
        """Draws of an effect's amplitude and further numbers, by name, each of shape (chains, draws)."""
        formula = self.formulas[which]
        assert isinstance(self.population, ExtendedPopulation)
        theta = np.asarray(self.population.theta)[..., slices(self.formulas)[which]]
        draws = {formula.variant.parameter: theta[..., 0] * formula.variant.plausible[1]}
        moved = jax.vmap(jax.vmap(lambda t: formula.nuisances(t)))(jnp.asarray(theta))
        return draws | {n.name: np.asarray(moved[n.name]) for n in formula.free_nuisances}

    def parameters(self) -> dict[str, Any]:
        """The population's parameters as in `discovery.json`."""
        return population_json(self.population)

    def failures(self) -> list[str]:
        """Why it must not be called converged; empty if all gates of the joint calibration are passed."""
        found = []
        rhat, ess = unmixed(self.rhat, self.ess_bulk)
        if rhat is not None:
            found.append(f"R-hat is {rhat.value:.3f}, above {RHAT_MOST}")
        if ess is not None:
            found.append(f"bulk ESS is {ess.value:.0f}, below {ESS_LEAST:.0f}")
        if self.divergences:
            found.append(f"{self.divergences} trajectories diverged")
        k = float(np.max(self.pareto_k)) if self.pareto_k_joint is None else self.pareto_k_joint
        if not k <= PARETO_K_MOST:
            found.append(f"Pareto k is {k:.2f}, above {PARETO_K_MOST}: the tests are not quadratic enough")
        return found

    def to_json(self) -> dict[str, Any]:
        """Diagnostics, as in `discovery.json`."""
        return {
            "converged": not self.failures(),
            "failures": self.failures(),
            "rhat_max": finite(max(self.rhat.values())),
            "ess_bulk_min": finite(min(self.ess_bulk.values())),
            "divergences": self.divergences,
            "pareto_k_max": finite(float(np.max(self.pareto_k))),
            "pareto_k_joint": None if self.pareto_k_joint is None else finite(self.pareto_k_joint),
        }


def extended_posterior(base: Base, found: Refit, *, length: Length = LENGTH, seed: int = 0) -> ExtendedPosterior:
    """Sample the posterior of the law with effects around its fit.

    Args:
        base: the base fit, of which noise and priors are taken.
        found: the fit of the law with effects.
        length: chains, warm-up and draws.
        seed: random seed.
    """
    fit, tests, model, state = base.fit, base.tests, base.legacy_model, found.state
    zero_sd = model.zero_sd
    data = linear_data(fit.latent, fit.zero, tests, zero_sd, model.unloading)
    data = eqx.tree_at(lambda d: (d.residual, d.jacobian), data, (found.residual, found.jacobian))
    at, filters, _ = summarise(state.latent, state.zero, tests, data, fit.noise, zero_sd)
    away = state.zero - tests.contact
    movable = _movable(at, state.theta, found.residual, found.jacobian, found.columns, filters, away, zero_sd)
    scatter = careful_enough(fit.mode, LogPosterior(fit.numbers, fit.summary, model.scatter), count_of(tests))
    precision = np.concatenate([f.precision for f in found.formulas])
    width = np.sqrt(np.maximum(np.diagonal(found.covariance), 1e-300))
    target = ExtendedTarget(fit.numbers, at, scatter, movable, jnp.asarray(precision), jnp.asarray(width))
    # Where the fit ended, with the spreads of the base fit.
    there, shift = population_at(fit.mode, fit.numbers, model.scatter), np.asarray(state.shift)
    start = unconstrain(
        float(there.a) + shift[0],
        float(there.log_modulus) + shift[1],
        np.asarray(there.mu) + shift[2:],
        np.asarray(there.tau),
        fit.numbers,
        model.scatter,
    )
    start = jnp.concatenate([start.at[5].set(fit.mode[5]).at[6:].set(fit.mode[6:]), jnp.zeros(len(width))])
    mode, covariance, reached = most_probable(start, target)
    exact = ExtendedExact(tests, filters, at, scatter, zero_sd, model.unloading, base.records, movable, found.formulas)
    parts = draw_around(jax.random.key(seed), mode, covariance, target, exact, model, length)
    names = tuple(base.campaign.particles[i] for i in base.selection.kept)
    kept = {f.name for f in dataclasses.fields(ExtendedPosterior)} & set(parts)
    notes = (*parts["notes"], *(() if reached else ("the optimiser for the population did not meet its tolerances",)))
    return ExtendedPosterior(
        formulas=found.formulas, particles=names, **{k: parts[k] for k in kept - {"notes"}}, notes=notes
    )


@compiled
def _movable(
    at: Summary,
    theta: Float[Array, " size"],
    residual: Float[Array, "particles points"],
    jacobian: Float[Array, "particles points 5"],
    columns: Float[Array, "particles size points"],
    filters: Whitening,
    away: Float[Array, " particles"],
    zero_sd: Float[Array, ""],
) -> Movable:
    r = jax.vmap(lambda f, x: f(x))(filters, residual)
    J = jax.vmap(lambda f, x: jax.vmap(f, in_axes=1, out_axes=1)(x))(filters, jacobian)
    C = jax.vmap(lambda f, x: jax.vmap(f)(x))(filters, columns)
    by_zero = J[..., 4]
    width = 1 / (jnp.sum(by_zero**2, 1) + 1 / zero_sd**2)
    pull = -jnp.sum(by_zero * r, 1) - away / zero_sd**2
    border = jnp.einsum("npk,np->nk", J[..., :4], by_zero)
    own = jnp.einsum("nsp,np->ns", C, by_zero)
    moved = width[:, None] * own
    return Movable(
        summary=at,
        theta=theta,
        by_squares=jnp.einsum("nsp,np->ns", C, r) + pull[:, None] * moved,
        by_squares_twice=jnp.einsum("nsp,ntp->nst", C, C) - own[:, :, None] * moved[:, None, :],
        by_score=border[:, :, None] * moved[:, None, :] - jnp.einsum("npk,nsp->nks", J[..., :4], C),
        by_zero=-moved,
    )
