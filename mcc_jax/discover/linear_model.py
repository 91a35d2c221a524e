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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..calibrate import Model
from ..campaign import Campaign, campaign_segments, record_batch
from ..effects import LIBRARY, Context, Mechanism, Record
from ..geometry import Particle
from ..law import Unloading, signatures
from .candidates import Candidate, candidates_of
from .dictionary import GAUGE, ROOM, Feature, map_features, values_of, words
from .laplace_correction import Turned, by_latent, turning
from .legacy.compiling import compiled
from .legacy.data import Selection, Tests, longer
from .legacy.fit import population_at, prepare
from .legacy.forward import law_of, snap
from .legacy.linearise import linear_data
from .legacy.model import JointFit
from .legacy.model import Model as LegacyModel
from .legacy.noise import Linear, Whitening
from .legacy.population import Population, Scatter, moments
from .legacy.settings import legacy_model
from .legacy.sharding import Blocks, block_size, filled_up
from .normal_equations import gram_matrices, in_batches
from .pop_in import Steps, is_step

GLOBALS = ("a", "log modulus", "mu C1", "mu C3", "mu C5")


@dataclass(frozen=True)
class System:
    """The linear system of a campaign.

    Columns are ordered: the residual, the population's parameters, the candidates, the map, the words, the formula.

    Attributes:
        gram: X^T M X of every particle, its own parameters integrated out, shape (N, Q, Q).
        points: number of compared points of every particle.
        candidates: the formulas looked for.
        places: the map's features.
        words: the features of formulas.
        prior: precision of the population's parameters.
        usable: which particles are close enough to linear to take part.
        at: amplitudes around which the candidates' columns are taken, in their units: zero but where the law has been
            extended (`gauss_newton`).
        shift: of the population's parameters from the base fit's, likewise.
        turned: what curvature has added to every column's product with the residual, shape (N, Q)
            (`laplace_correction`).
        tails: degrees of freedom of Student's distribution whose tails are those of the noise; infinite where it is
            normal.
        formula: words with fitted numbers, of the formula that was found and of those without some particles.
        steps: sudden steps at every point; None where nobody looks for them.
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
    tails: float = np.inf
    turned: np.ndarray | None = None
    formula: tuple[Feature, ...] = ()
    steps: Steps | None = None

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
    def _features_from(self) -> int:
        return 1 + len(GLOBALS) + len(self.candidates)

    @property
    def place_columns(self) -> np.ndarray:
        """Columns of the map."""
        return self._features_from + np.arange(len(self.places))

    @property
    def word_columns(self) -> np.ndarray:
        """Columns of the words."""
        return self._features_from + len(self.places) + np.arange(len(self.words))

    @property
    def formula_columns(self) -> np.ndarray:
        """Columns of the formula."""
        return self._features_from + len(self.places) + len(self.words) + np.arange(len(self.formula))

    def word(self, column: int) -> Feature:
        """The word or part of the formula of a column."""
        return (*self.words, *self.formula)[column - self.word_columns[0]]

    @cached_property
    def _usable_total(self) -> np.ndarray:
        return self.gram[self.usable].sum(0)

    def total(self, particles: np.ndarray | None = None) -> np.ndarray:
        """Sum of the Gram matrices of some particles, or of all usable ones, shape (Q, Q)."""
        if particles is None:
            return self._usable_total
        others = np.setdiff1d(np.flatnonzero(self.usable), particles)
        if len(others) < len(particles) and self.usable[particles].all():
            return self._usable_total - self.gram[others].sum(0)
        return self.gram[particles].sum(0)

    def curved(self, chosen: Sequence[int]) -> np.ndarray | None:
        """What curvature has added for the population's parameters and some candidates, all particles together."""
        if self.turned is None:
            return None
        columns = [*self.globals.tolist(), *(self.column(k) for k in chosen)]
        return self.turned[self.usable][:, columns].sum(0)

    @property
    def signs(self) -> np.ndarray:
        """The sign that each candidate's amplitude must have; 0 where both are possible."""
        return np.array([c.variant.sign for c in self.candidates])

    @property
    def waves(self) -> np.ndarray:
        """Columns of words that are waves in time or displacement, of those in the formula, too."""
        several = (*self.words, *self.formula)
        waves = [i for i, word in enumerate(several) if word.form in (ROOM, GAUGE)]
        return self._features_from + len(self.places) + np.array(waves, int)

    @property
    def quadratures(self) -> np.ndarray:
        """Columns of sine and cosine of the same wave in time or displacement, shape (W, 2): its phase may be any."""
        found: dict[tuple, list[int]] = {}
        for column in np.intersect1d(self.waves, self.word_columns).tolist():
            word = self.word(column)
            found.setdefault((word.form, word.numbers[0]), []).append(column)
        return np.array([both for both in found.values() if len(both) == 2], int).reshape(-1, 2)

    def looked_at(self) -> tuple[np.ndarray, np.ndarray]:
        """Columns of candidates, map and words, and the sign that each one's coefficient must have."""
        columns = np.concatenate([self.candidate_columns, self.place_columns, self.word_columns])
        return columns, np.concatenate([self.signs, np.zeros(len(columns) - len(self.candidates))])

    def absorbing(self, columns: np.ndarray) -> System:
        """The system in which every particle may have its own amount of some columns.

        Without what curvature adds: that is another where a particle has more parameters of its own.
        """
        at, whole = np.asarray(columns), self.gram
        if self.turned is not None:
            whole = whole.copy()
            whole[:, 0] -= self.turned
            whole[:, :, 0] -= self.turned
        inner = whole[:, at][:, :, at] + np.eye(len(at))
        border = whole[:, at]
        gram = whole - np.swapaxes(border, 1, 2) @ np.linalg.solve(inner, border)
        return replace(self, gram=gram, steps=None, turned=None)


@dataclass(frozen=True)
class Base:
    """The base fit of a campaign and what goes with it.

    Attributes:
        campaign: the tests.
        selection: which particles and points took part.
        model: what was assumed.
        fit: the joint fit.
        records: what the tester did, by particle, the rows of the selection.
        threshold_MPa: stress below which points of loading do not count.
    """

    campaign: Campaign
    selection: Selection
    model: Model
    fit: JointFit
    records: Record
    threshold_MPa: float

    @property
    def tests(self) -> Tests:
        """The arrays of the tests."""
        return self.selection.tests

    @property
    def legacy_model(self) -> LegacyModel:
        """What was assumed, as the fit takes it."""
        return legacy_model(self.model)

    def name_of(self, row: int) -> str:
        """Name of a particle that took part, by its row."""
        return self.campaign.particles[self.selection.kept[row]]

    def filled(self) -> tuple[Tests, Blocks]:
        """The tests filled up with copies to whole blocks, as for the joint fit."""
        size = block_size(len(self.tests))
        tests = filled_up(self.tests, size)
        return tests, Blocks(len(tests), size)

    def linear(self, latent: Float[Array, "particles 4"] | None = None) -> Linear:
        """Residuals at the fit, and their derivatives by every particle's own parameters; at other latent vectors, if
        given."""
        tests, blocks = self.filled()
        own = self.fit.latent if latent is None else latent
        at = (blocks.cut(v) for v in longer((own, self.fit.zero), len(tests)))
        data = blocks.each(linear_data, *at, blocks.cut(tests), self.legacy_model.zero_sd, self.model.unloading)
        return jax.tree.map(lambda x: x[: len(self.tests)], blocks.whole(data))


def base_fit(
    campaign: Campaign, model: Model, *, threshold_MPa: float, tell: Callable[[str], None] = lambda _: None
) -> Base:
    """Fit the base law with everything natural free: every particle's coefficients and modulus, and the noise."""
    selection, _, fit, _ = prepare(campaign, legacy_model(model), threshold_MPa, tell=tell)
    own = fit.first(len(selection.kept))
    return Base(campaign, selection, model, own, records_of(campaign, selection), threshold_MPa)


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
        formula: the features behind map and words.
        turned: how all of them, and the residual's own derivatives, change with the latent vectors; None where no
            residual is looked at.
    """

    candidates: tuple[Candidate, ...]
    added: Float[Array, "particles K points"]
    seen: Float[Array, "particles F points"]
    formula: tuple[Feature, ...] = ()
    turned: Turned | None = None

    def with_formula(
        self, base: Base, formula: tuple[Feature, ...], values: Float[Array, "particles F points"]
    ) -> Signals:
        """The same, and words with fitted numbers behind the others, with their values [um]."""
        turned = self.turned
        if turned is not None:
            more = by_latent(lambda at: -feature_values(base, formula, at), base.fit.latent, -values)
            turned = replace(turned, signals=np.concatenate([turned.signals, more], 2))
        return replace(self, seen=jnp.concatenate([self.seen, -values], 1), formula=formula, turned=turned)

    def of(self, columns: np.ndarray) -> Float[Array, "particles columns points"]:
        """Change of the residual per unit of some of the system's columns."""
        at = jnp.asarray(np.asarray(columns) - 1 - len(GLOBALS))
        return jnp.concatenate([self.added, self.seen], 1)[:, at]


def signals_of(base: Base, library: Mapping[str, Mechanism], *, turned: bool = False) -> Signals:
    """All formulas of a library and all features along the tests of a fitted campaign.

    Args:
        base: the base fit.
        library: the mechanisms.
        turned: how they change with the particles' own parameters, too.
    """
    candidates = candidates_of(library)
    units = jnp.asarray([c.unit_amplitude for c in candidates])
    features = (*map_features(), *words())

    def at(latent: Array) -> Array:
        added = _added_by(base, candidates, latent) * units[None, :, None]
        return -jnp.concatenate([added, feature_values(base, features, latent)], 1)

    both = at(base.fit.latent)
    slopes = None
    if turned:
        own = by_latent(lambda latent: base.linear(latent).jacobian, base.fit.latent, base.linear().jacobian)
        slopes = Turned(own, by_latent(at, base.fit.latent, both))
    return Signals(candidates, both[:, : len(candidates)], both[:, len(candidates) :], turned=slopes)


def _added_by(base: Base, candidates: tuple[Candidate, ...], latent: Array) -> Float[Array, "particles K points"]:
    """What candidates add to displacement, per unit of amplitude.

    Most of the library is computed as the whole of it, so that all campaigns share what is compiled.
    """
    batch = (latent, base.tests.particle, base.records)

    def added_by(some: Sequence[Candidate]) -> Array:
        effects = tuple(c.effect for c in some)
        return in_batches(partial(_added, effects=effects, unloading=base.model.unloading), batch)

    whole = candidates_of(LIBRARY)
    known = {_identity(c) for c in whole} & {_identity(c) for c in candidates}
    if 2 * len(known) <= len(whole):
        return added_by(candidates)
    strangers = tuple(c for c in candidates if _identity(c) not in known)
    place = {_identity(c): i for i, c in enumerate((*whole, *strangers))}
    parts = [added_by(some) for some in (whole, strangers) if some]
    return jnp.concatenate(parts, 1)[:, np.array([place[_identity(c)] for c in candidates])]


def feature_values(
    base: Base, features: tuple[Feature, ...], latent: Float[Array, "particles 4"] | None = None
) -> Float[Array, "particles features points"]:
    """Features along the tests of a fitted campaign, displacement [um] per unit of coefficient; at other latent vectors
    than the fit's, if given."""
    rows = (base.fit.latent if latent is None else latent, base.tests.particle, base.records)
    return in_batches(partial(_features, unloading=base.model.unloading, features=features), rows)


def _identity(candidate: Candidate) -> tuple[Any, ...]:
    return candidate.variant, *sorted(candidate.nuisance.items())


def build_system(base: Base, signals: Signals) -> System:
    """The linear system of a fitted campaign."""
    candidates, places, some = signals.candidates, map_features(), words()
    fit, tests = base.fit, base.tests
    scatter = base.legacy_model.scatter
    population = population_at(fit.mode, fit.numbers, scatter)
    data = base.linear()
    flat = tests.flatness
    mean, factor = moments(population, flat, scatter)

    by_globals = mean_by_globals(population, flat, scatter)
    gram, turned, *of_steps = gram_matrices(
        turning_of(base, signals, data.jacobian, by_globals, factor),
        data.residual,
        data.jacobian,
        tests.mask,
        first_loaded(tests),
        fit.filters,
        signals.added,
        signals.seen,
        mean - fit.latent,
        by_globals,
        factor,
        base.legacy_model.zero_sd,
        fit.zero - tests.contact,
    )
    top = jnp.max(tests.force, axis=1)
    jump = np.asarray(_jumps(fit.latent, tests.particle))
    usable = ~(jump < np.log(1.15 * np.asarray(top)))
    numbers = fit.numbers
    width = np.array([numbers.a[1], numbers.log_modulus[1], numbers.mu_1[1], 0.5, numbers.mu_5[1]])
    points = np.asarray(jnp.sum(tests.mask, 1))
    still, none = np.zeros(len(GLOBALS)), np.zeros(len(candidates))
    white = np.asarray(in_batches(whitened, (data.residual, fit.filters)))[np.asarray(tests.mask)]
    return System(
        gram,
        points,
        candidates,
        places,
        some,
        1 / width**2,
        usable,
        none,
        still,
        tails_of(white),
        turned,
        signals.formula,
        steps_of(tests, candidates, *of_steps),
    )


def turning_of(base: Base, signals: Signals, jacobian: Array, by_globals: Array, factor: Array) -> np.ndarray:
    """What curvature adds to every column's product with the residual; zero where nobody looks at it."""
    count = factor.shape[-1] + 1 + 1 + by_globals.shape[-1] + signals.added.shape[1] + signals.seen.shape[1]
    if signals.turned is None:
        return np.zeros((len(base.tests), count))
    own = (base.tests.mask, base.fit.filters, factor, by_globals, base.legacy_model.zero_sd)
    return turning(jacobian, signals.turned, *own)


def first_loaded(tests: Tests) -> Bool[Array, "particles points"]:
    """Points at which force is larger than ever before in the test."""
    force = jnp.where(tests.mask, tests.force, -jnp.inf)
    before = jax.lax.cummax(force, axis=1)[:, :-1]
    return jnp.concatenate([jnp.zeros_like(tests.mask[:, :1]), force[:, 1:] > before], 1)


def steps_of(tests: Tests, candidates: Sequence[Candidate], cross: np.ndarray, among: np.ndarray) -> Steps | None:
    """Sudden steps as large as one would believe, from those of 1 um; None where nobody looks for them."""
    unit = next((c.unit_amplitude for c in candidates if is_step(c)), None)
    if unit is None:
        return None
    stress = np.asarray(tests.force) / (np.pi / 4 * np.asarray(tests.effective_diameter)[:, None] ** 2) * 1e3
    return Steps(unit * cross, unit**2 * among, np.where(first_loaded(tests), stress, np.nan))


OFTEN = 0.98
"""Share of the points up to which the tails of the noise are looked at: a rare jump of a particle is no noise."""


def tails_of(white: np.ndarray) -> float:
    """Degrees of freedom of Student's distribution with the ratio of the points' `OFTEN` quantile to their median."""
    from scipy.optimize import brentq
    from scipy.stats import t as student

    size, far = np.quantile(np.abs(white), [0.5, OFTEN])

    def excess(freedom: float) -> float:
        return float(student.ppf((1 + OFTEN) / 2, freedom) / student.ppf(0.75, freedom)) * size - far

    if excess(MAX_TAILS) >= 0:
        return np.inf
    return cast(float, brentq(excess, MIN_TAILS, MAX_TAILS)) if excess(MIN_TAILS) > 0 else MIN_TAILS


MIN_TAILS, MAX_TAILS = 2.5, 100.0


@compiled
def whitened(residual: Float[Array, "particles points"], filters: Whitening) -> Float[Array, "particles points"]:
    """Residuals in units of the noise, independent from point to point."""
    return jax.vmap(lambda white, r: white(r))(filters, residual)


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
    latent, particles: Particle, records: Record, effects, unloading: Unloading
) -> Float[Array, "particles effects points"]:
    def one(w, particle, record):
        return signatures(law_of(w, unloading), particle, record, effects)

    return eqx.filter_vmap(one)(latent, particles, records)


@compiled
def _features(
    latent, particles: Particle, records: Record, unloading: Unloading, features
) -> Float[Array, "particles f points"]:
    def one(w, particle, record):
        context: Context = law_of(w, unloading).context(particle, record)
        return particle.effective_diameter * values_of(features, context)

    return eqx.filter_vmap(one)(latent, particles, records)
