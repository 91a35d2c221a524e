r"""A campaign as one linear system: residuals, what the base law can still take up, and what each effect would add.

Around the base fit the residual of particle i is, to first order and whitened by its noise,

.. math:: r_i = J_i S \xi_i + j_i z_i + J_i \frac{\partial m_i}{\partial\beta}\,\beta - \sum_k g_{ik}\theta_k + w_i,
    \qquad \xi_i, w_i \sim N(0, 1)

with the population's parameters :math:`\beta` (a, modulus, means of log C1, C3, C5), the particle's own deviations
:math:`\xi_i`, its zero :math:`z_i` and the effects' amplitudes :math:`\theta`. Particles and zeros are integrated out.
What remains are small Gram matrices per particle, from which tests, estimates, folds and bootstrap follow by linear
algebra alone, without another look at the curves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..calibrate import JointModel
from ..calibrate.joint._compile import compiled
from ..calibrate.joint._data import Selection, Tests
from ..calibrate.joint._fit import population_at, prepare
from ..calibrate.joint._forward import law_of, snap
from ..calibrate.joint._linearised import linear_data
from ..calibrate.joint._model import JointFit
from ..calibrate.joint._population import Population, Scatter, moments
from ..campaign import Campaign, campaign_segments
from ..effects import Context, ExtendedLaw, Mechanism, Record, record_batch, signatures
from ..geometry import Particle
from ._candidates import Candidate, candidates_of
from ._features import Feature, map_features, words

GLOBALS = ("a", "log modulus", "mu C1", "mu C3", "mu C5")


@dataclass(frozen=True)
class System:
    """The linear system of a campaign.

    Columns are ordered: the residual, the population's parameters, the candidates, the map, the words.

    Attributes:
        gram: X^T M X of every particle, its own parameters integrated out, shape (N, Q, Q).
        points: number of compared points of every particle.
        candidates: the formulas looked for.
        places: the map's features.
        words: the features of formulas.
        prior: precision of the population's parameters.
        usable: which particles are close enough to linear to take part.
        at: amplitudes around which the candidates' columns are taken, in their units: zero but where the law has been
            extended (`_refit`).
        shift: of the population's parameters from the base fit's, likewise.
    """

    gram: np.ndarray
    points: np.ndarray
    candidates: tuple[Candidate, ...]
    places: tuple[Feature, ...]
    words: tuple[Feature, ...]
    prior: np.ndarray
    usable: np.ndarray
    at: np.ndarray
    shift: np.ndarray

    @property
    def globals(self) -> np.ndarray:
        """Columns of the population's parameters."""
        return np.arange(1, 1 + len(GLOBALS))

    def column(self, candidate: int) -> int:
        """Column of a candidate."""
        return 1 + len(GLOBALS) + candidate

    @property
    def candidate_columns(self) -> np.ndarray:
        """Columns of all candidates."""
        return 1 + len(GLOBALS) + np.arange(len(self.candidates))

    @property
    def place_columns(self) -> np.ndarray:
        """Columns of the map."""
        return 1 + len(GLOBALS) + len(self.candidates) + np.arange(len(self.places))

    @property
    def word_columns(self) -> np.ndarray:
        """Columns of the words."""
        return 1 + len(GLOBALS) + len(self.candidates) + len(self.places) + np.arange(len(self.words))

    def absorbing(self, columns: np.ndarray) -> System:
        """The system in which every particle may have its own amount of some columns."""
        at = np.asarray(columns)
        inner = self.gram[:, at][:, :, at] + np.eye(len(at))
        border = self.gram[:, at]
        return replace(self, gram=self.gram - np.swapaxes(border, 1, 2) @ np.linalg.solve(inner, border))


@dataclass(frozen=True)
class Base:
    """The base fit of a campaign and what goes with it.

    Attributes:
        campaign: the tests.
        selection: which particles and points took part.
        model: what was assumed.
        fit: the joint fit.
        records: what the tester did, by particle, the rows of the selection.
    """

    campaign: Campaign
    selection: Selection
    model: JointModel
    fit: JointFit
    records: Record

    @property
    def tests(self) -> Tests:
        """The arrays of the tests."""
        return self.selection.tests


def base_fit(
    campaign: Campaign, model: JointModel, *, threshold_MPa: float, tell: Callable[[str], None] = lambda _: None
) -> Base:
    """Fit the base law with everything natural free: every particle's coefficients and modulus, and the noise."""
    selection, _, fit, _ = prepare(campaign, model, threshold_MPa, tell=tell)
    return Base(campaign, selection, model, fit.first(len(selection.kept)), records_of(campaign, selection))


def records_of(campaign: Campaign, selection: Selection) -> Record:
    """What the tester did, by particle, at the rows of the selection."""
    whole = record_batch(campaign, campaign_segments(campaign))
    length = selection.tests.force.shape[1]
    index = np.stack([np.pad(rows, (0, length - len(rows)), mode="edge") for rows in selection.rows])
    kept = np.asarray(selection.kept)

    def rows(leaf: Array) -> Array:
        values = np.asarray(leaf)[kept]
        return jnp.asarray(np.take_along_axis(values, index, axis=1) if values.ndim == 2 else values)

    return jax.tree.map(rows, whole)


@dataclass(frozen=True)
class Signals:
    """What every formula and feature adds to a residual, before whitening.

    Attributes:
        candidates: the formulas.
        added: shape (N, K, points), [um] per unit amplitude.
        seen: of the features, shape (N, F, points).
    """

    candidates: tuple[Candidate, ...]
    added: Float[Array, "particles K points"]
    seen: Float[Array, "particles F points"]

    def of(self, columns: np.ndarray) -> Float[Array, "particles columns points"]:
        """Change of the residual per unit of some of the system's columns."""
        at = jnp.asarray(np.asarray(columns) - 1 - len(GLOBALS))
        return jnp.concatenate([self.added, self.seen], 1)[:, at]


def signals_of(base: Base, library: Mapping[str, Mechanism]) -> Signals:
    """All formulas of a library and all features along the tests of a fitted campaign."""
    candidates = candidates_of(library)
    effects = tuple(c.effect for c in candidates)
    units = jnp.asarray([c.unit_amplitude for c in candidates])
    latent, tests = base.fit.latent, base.tests
    added = _added(latent, tests, base.records, effects, base.model)
    seen = _features(latent, tests, base.records, base.model, (*map_features(), *words()))
    return Signals(candidates, -added * units[None, :, None], -seen)


def build_system(base: Base, signals: Signals) -> System:
    """The linear system of a fitted campaign."""
    candidates, places, some = signals.candidates, map_features(), words()
    fit, tests = base.fit, base.tests
    scatter = base.model.scatter
    population = population_at(fit.mode, fit.numbers, scatter)
    data = linear_data(fit.latent, fit.zero, tests, base.model.zero_sd, base.model.unloading)
    flat = tests.flatness
    mean, factor = moments(population, flat, scatter)

    by_globals = mean_by_globals(population, flat, scatter)
    gram = gram_matrices(
        data.residual,
        data.jacobian,
        tests.mask,
        fit.filters,
        signals.added,
        signals.seen,
        mean - fit.latent,
        by_globals,
        factor,
        base.model.zero_sd,
        fit.zero - tests.contact,
    )
    top = jnp.max(tests.force, axis=1)
    jump = np.asarray(_jumps(fit.latent, tests.particle))
    usable = ~(jump < np.log(1.15 * np.asarray(top)))
    numbers = fit.numbers
    width = np.array([numbers.a[1], numbers.log_modulus[1], numbers.mu_1[1], 0.5, numbers.mu_5[1]])
    points = np.asarray(jnp.sum(tests.mask, 1))
    still, none = np.zeros(len(GLOBALS)), np.zeros(len(candidates))
    return System(np.asarray(gram), points, candidates, places, some, 1 / width**2, usable, none, still)


@compiled
def mean_by_globals(
    population: Population, flat: Float[Array, " particles"], scatter: Scatter
) -> Float[Array, "particles 4 globals"]:
    """Derivatives of the particles' expected latent vectors by the population's parameters, in the order of GLOBALS."""

    def mean_of(a: Array, rest: Array) -> Array:
        moved = eqx.tree_at(lambda p: (p.a, p.log_modulus, p.mu), population, (a, rest[0], rest[1:]))
        return moments(moved, flat, scatter)[0]

    rest = jnp.concatenate([population.log_modulus[None], population.mu])
    by_a, by_rest = jax.jacfwd(mean_of, argnums=(0, 1))(population.a, rest)
    return jnp.concatenate([by_a[..., None], by_rest], -1)


@compiled
def _jumps(latent: Float[Array, "particles 4"], particles: Particle) -> Float[Array, " particles"]:
    """Logarithm of the force at which each particle snaps through."""
    return jax.vmap(snap)(latent, particles)


@compiled
def _added(
    latent, tests: Tests, records: Record, effects, model: JointModel
) -> Float[Array, "particles effects points"]:
    def one(w, particle, record):
        return signatures(law_of(w, model.unloading), particle, record, effects)

    return eqx.filter_vmap(one)(latent, tests.particle, records)


@compiled
def _features(latent, tests: Tests, records: Record, model: JointModel, features) -> Float[Array, "particles f points"]:
    def one(w, particle, record):
        context: Context = ExtendedLaw(law_of(w, model.unloading), ()).context(particle, record)
        columns = [jnp.broadcast_to(f.value(context), context.force.shape) for f in features]
        empty = jnp.zeros((0, *context.force.shape))
        return particle.effective_diameter * jnp.stack(columns) if columns else empty

    return eqx.filter_vmap(one)(latent, tests.particle, records)


@compiled
def gram_matrices(residual, jacobian, mask, filters, added, seen, away, by_globals, factor, zero_sd, zero_away):
    """Gram matrices of all columns, particles' deviations and zeros integrated out."""
    k = factor.shape[-1]

    def one(r, J, used, white, extra, words, offset, slope, S, z):
        own, zero = J[:, :4], J[:, 4]
        columns = jnp.concatenate(
            [
                (own @ S).T,
                zero[None],
                (r + own @ offset - zero * z)[None],
                (own @ slope).T,
                jnp.where(used[None], extra, 0.0),
                jnp.where(used[None], words, 0.0),
            ]
        )
        X = jax.vmap(white)(columns)
        A = X @ X.T
        prior = jnp.concatenate([jnp.ones(k), 1 / zero_sd[None] ** 2])
        inner, border = A[: k + 1, : k + 1] + jnp.diag(prior), A[: k + 1, k + 1 :]
        return A[k + 1 :, k + 1 :] - border.T @ jnp.linalg.solve(inner, border)

    return jax.vmap(one)(residual, jacobian, mask, filters, added, seen, away, by_globals, factor, zero_away)
