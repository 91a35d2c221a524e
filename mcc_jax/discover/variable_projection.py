r"""The numbers within a formula's words: where a bump is and how wide, how long a wave, which power.

Words come from a list with fixed numbers. With the formula's words chosen, their numbers :math:`\phi` are fitted
together with the coefficients :math:`c`,

.. math:: \min_{\phi, c}\; \Bigl\| y - \sum_w c_w f_w(\phi_w) \Bigr\|^2,

in the whitened space in which everything that the base law can take up is projected off, with the coefficients
eliminated (Golub and Pereyra 1973; the derivatives by Kaufman 1975). Of formulas with few words and with more, the one
is taken whose words and numbers are worth what they cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects import Context
from ..law import Unloading
from .dictionary import Feature, Form, further_words
from .forward_selection import MAX_WORDS
from .legacy.compiling import compiled
from .legacy.fit import population_at
from .legacy.noise import Whitening
from .legacy.population import moments
from .linear_model import Base, Signals, System, feature_values, law_of, mean_by_globals
from .normal_equations import common_rows, in_batches, own_rows

MAX_NUMBERS = 3
"""Most numbers that a form has."""

NUMBER_WORTH = 2.0
"""Least drop of chi2 for which a word may have another number: AIC's."""

WORTH = 20.0
"""Least drop of chi2, numbers paid for, for which a formula gets another word: of some 260 words with fitted numbers
one takes away as much by chance in one campaign out of a hundred."""

STARTS = (10, 5, 5)
"""How many words are tried as first, second and third one."""

OF_A_FORM = 2
"""How many of these may differ in their numbers alone: fitted, they often become the same."""

MAX_PARTICLES = 100
"""Of larger campaigns so many particles, evenly spread, tell the numbers."""

MODEST = 1e-3
"""What the base law takes up of a formula is not seen, so that nothing keeps it small: this share of its chi2 does."""

MIN_LEFT = 1e-4
"""Share of a word that the words before it must leave."""

EXACT, STEPS = 1e-5, 25
"""Relative tolerances of a fit and its most evaluations: a chi2 of some thousands is exact to a few hundredths."""

Words = tuple[Feature, ...]


@dataclass(frozen=True)
class Fitted:
    """A formula fitted to some particles.

    Attributes:
        words: its words.
        gain: drop of chi2 by it, less what its size costs.
    """

    words: Words = ()
    gain: float = 0.0

    @property
    def worth(self) -> float:
        """The gain less what the numbers cost."""
        return self.gain - NUMBER_WORTH * sum(len(word.numbers) for word in self.words)


class Tuner:
    """Formulas with fitted numbers for the gap of a campaign.

    Columns are compared whitened, with what the base law can take up projected off: for each particle its own
    parameters, for all of them the population's.
    """

    def __init__(self, base: Base, signals: Signals, system: System) -> None:
        """Bring residual and listed words into that space.

        Args:
            base: the fitted campaign.
            signals: what effects and features add in it.
            system: its linear system.
        """
        fit, tests, scatter = base.fit, base.tests, base.legacy_model.scatter
        population = population_at(fit.mode, fit.numbers, scatter)
        flat, data = tests.flatness, base.linear()
        mean, factor = moments(population, flat, scatter)
        by_globals = mean_by_globals(population, flat, scatter)
        contexts = partial(_contexts, unloading=base.model.unloading)
        seen = in_batches(contexts, (fit.latent, tests.particle, base.records)), tests.mask
        self._rows = _Rows(seen, (data.jacobian, fit.filters, factor), base.legacy_model.zero_sd)
        self._prior = system.prior
        away = mean - fit.latent, fit.zero - tests.contact
        self._fixed = self._rows.reduced(in_batches(_fixed, (data.residual, data.jacobian, *away, by_globals)))[0]
        self._listed = (*system.words, *further_words())
        values = (-signals.of(system.word_columns), feature_values(base, further_words()))
        self._values = np.concatenate([self._rows.reduced(part)[0] for part in values], 1)

    def values(self, formula: Words) -> Float[Array, "particles words points"]:
        """Displacement that words add, per unit of coefficient [um]."""
        return jnp.stack([self._rows.word(word)[:, 0] for word in formula], 1)

    def cosines(self, formula: Words, particles: np.ndarray) -> np.ndarray:
        """Cosines of words among themselves, as far as the base law cannot take them up."""
        gap = self._gap(particles)
        columns = gap.off(self._rows.reduced(self.values(formula))[0][particles])
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        return columns.T @ columns

    def search(self, particles: np.ndarray) -> Fitted:
        """The formula for the gap of some particles: words one after the other, each time with all numbers fitted."""
        some = particles[np.linspace(0, len(particles) - 1, min(len(particles), MAX_PARTICLES)).astype(int)]
        gap = self._gap(some)
        listed = gap.off(self._values[some])
        found = Fitted()
        for starts in STARTS:
            left, basis = gap.beside(found.words)
            free = listed - basis @ (basis.T @ listed)
            size = np.sum(free**2, 0)
            alive = size > MIN_LEFT * np.sum(listed**2, 0)
            drop = np.where(alive, (left @ free) ** 2 / np.maximum(size, 1e-300), 0.0)
            best = [self._listed[i] for i in np.argsort(-drop, kind="stable")]
            forms = [word.form for word in best]
            several = [word for i, word in enumerate(best) if forms[:i].count(word.form) < OF_A_FORM]
            further = max((gap.fit((*found.words, word)) for word in several[:starts]), key=lambda one: one.worth)
            if further.worth - found.worth < WORTH:
                break
            found = _pruned(gap, further)
        return found

    def _gap(self, particles: np.ndarray) -> _Gap:
        return _Gap(self._rows.some(particles), self._fixed[particles], self._prior)


def _pruned(gap: _Gap, formula: Fitted) -> Fitted:
    """Without words that others have made worthless: the first one is chosen when it stands alone."""
    while len(formula.words) > 1:
        fewer = (formula.words[:i] + formula.words[i + 1 :] for i in range(len(formula.words)))
        best = max(map(gap.fit, fewer), key=lambda one: one.worth)
        if formula.worth - best.worth >= WORTH:
            break
        formula = best
    return formula


@dataclass(frozen=True)
class _Rows:
    """Tests of some particles, and the space in which they are compared.

    Attributes:
        seen: what words are told, and which points count.
        space: derivatives by every particle's own parameters, whitening filters, spread of the particles.
        zero_sd: spread of the zeros.
    """

    seen: tuple[Context, Array]
    space: tuple[Array, Whitening, Array]
    zero_sd: Array

    def some(self, particles: np.ndarray) -> _Rows:
        """Those of some particles."""
        seen, space = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[particles]), (self.seen, self.space))
        return _Rows(seen, space, self.zero_sd)

    def word(self, word: Feature) -> Float[Array, "particles columns points"]:
        """A word and its derivatives by its numbers."""
        numbers = jnp.asarray(np.asarray(word.numbers, float))
        return in_batches(partial(_word, form=word.form, numbers=numbers), self.seen)

    def reduced(self, columns: Float[Array, "particles W points"]) -> tuple[np.ndarray, np.ndarray]:
        """Columns whitened, with every particle's own parameters projected off, shape (N, W, R); and their squares
        before that, shape (N, W)."""
        found, squares = [], []
        for first in range(0, columns.shape[1], WIDTH):
            part = columns[:, first : first + WIDTH]
            wide = jnp.pad(part, ((0, 0), (0, WIDTH - part.shape[1]), (0, 0)))
            left, square = in_batches(partial(_reduce, zero_sd=self.zero_sd), (wide, *self.space))
            found.append(np.asarray(left)[:, : part.shape[1]])
            squares.append(np.asarray(square)[:, : part.shape[1]])
        return np.concatenate(found, 1), np.concatenate(squares, 1)


class _Gap:
    """What the base law leaves of some particles' tests, the population's parameters projected off.

    Attributes:
        y: the residual.
    """

    def __init__(self, rows: _Rows, fixed: np.ndarray, prior: np.ndarray) -> None:
        """Project off.

        Args:
            rows: the tests.
            fixed: residual and the population's columns, shape (N, 1 + globals, R).
            prior: precision of the population's parameters.
        """
        self._rows, self._more = rows, len(prior)
        whole = np.concatenate([_stacked(fixed), np.column_stack([np.zeros(len(prior)), np.diag(np.sqrt(prior))])])
        self._basis, _ = np.linalg.qr(whole[:, 1:])
        self.y = whole[:, 0] - self._basis @ (self._basis.T @ whole[:, 0])

    def off(self, columns: np.ndarray) -> np.ndarray:
        """Columns of the same particles likewise, as rows one under the other."""
        wide = np.concatenate([_stacked(columns), np.zeros((self._more, columns.shape[1]))])
        return wide - self._basis @ (self._basis.T @ wide)

    def beside(self, formula: Words) -> tuple[np.ndarray, np.ndarray]:
        """What a formula leaves of the residual, and an orthonormal basis of its words."""
        if not formula:
            return self.y, np.zeros((len(self.y), 0))
        left, _, basis = self._solve(formula)
        return left[: len(self.y)], basis[: len(self.y)]

    def fit(self, start: Words) -> Fitted:
        """Words with the numbers that explain most."""
        from scipy.optimize import least_squares

        numbers = np.concatenate([np.asarray(word.numbers) for word in start])
        known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

        def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            if x.tobytes() not in known:
                known.clear()
                known[x.tobytes()] = self._solve(_with(start, x))[:2]
            return known[x.tobytes()]

        def fitted(formula: Words, left: np.ndarray) -> Fitted:
            return Fitted(formula, float(self.y @ self.y - left @ left))

        if not len(numbers):
            return fitted(start, self._solve(start)[0])
        low, high = (np.concatenate([np.asarray(getattr(w.form, end)) for w in start]) for end in ("low", "high"))
        found = least_squares(
            lambda x: at(x)[0],
            np.clip(numbers, low, high),
            jac=cast(Any, lambda x: at(x)[1]),  # its stub knows texts only
            bounds=(low, high),
            x_scale=np.maximum(np.abs(numbers), 0.05 * (high - low)),
            ftol=EXACT,
            xtol=EXACT,
            gtol=EXACT,
            max_nfev=STEPS,
        )
        return fitted(_with(start, found.x), found.fun)

    def _solve(self, formula: Words) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What is left of the residual with the best coefficients, its derivatives by the numbers, and a basis of the
        words; behind the points a row for every word that keeps its coefficient modest."""
        columns = [self._rows.word(word) for word in formula]
        reduced, squares = self._rows.reduced(jnp.concatenate(columns, 1))
        reduced = self.off(reduced)
        ends = np.cumsum([c.shape[1] for c in columns])
        values = ends - [c.shape[1] for c in columns]
        modest = np.diag(np.sqrt(MODEST * squares[:, values].sum(0)))
        F = np.concatenate([reduced[:, values], modest])
        y = np.concatenate([self.y, np.zeros(len(modest))])
        basis, triangle = np.linalg.qr(F)
        coefficients = np.linalg.lstsq(triangle, basis.T @ y, rcond=1e-10)[0]
        left = y - F @ coefficients
        several = zip(coefficients, values, ends, strict=True)
        slopes = np.concatenate([-c * reduced[:, first + 1 : end] for c, first, end in several], 1)
        slopes = np.concatenate([slopes, np.zeros((len(modest), slopes.shape[1]))])
        return left, slopes - basis @ (basis.T @ slopes), basis


WIDTH = MAX_WORDS * (1 + MAX_NUMBERS)


def _with(words: Words, numbers: np.ndarray) -> Words:
    ends = np.cumsum([len(w.numbers) for w in words])[:-1]
    return tuple(w.form.at(*part) for w, part in zip(words, np.split(numbers, ends), strict=True))


def _stacked(columns: np.ndarray) -> np.ndarray:
    """All particles' rows one under the other, shape (N R, W)."""
    return np.moveaxis(columns, 1, -1).reshape(-1, columns.shape[1])


@compiled
def _contexts(latent, particles, records, unloading: Unloading) -> Context:
    def one(w, particle, record):
        return law_of(w, unloading).context(particle, record)

    return eqx.filter_vmap(one)(latent, particles, records)


@compiled
def _fixed(residual, jacobian, offset, zero_away, by_globals) -> Float[Array, "particles columns points"]:
    """The residual and the population's columns, as in `linear_model`."""
    return jax.vmap(common_rows)(residual, jacobian, offset, zero_away, by_globals)


@compiled
def _word(contexts: Context, mask, form: Form, numbers) -> Float[Array, "particles W points"]:
    """A word and its derivatives by its numbers, [um] per unit of coefficient."""

    def one(context: Context, used):
        def value(own):
            return jnp.broadcast_to(form.value(context, own), context.force.shape)

        rows = jnp.concatenate([value(numbers)[None], jnp.moveaxis(jax.jacfwd(value)(numbers), -1, 0)])
        return jnp.where(used[None], context.particle.effective_diameter * rows, 0.0)

    return eqx.filter_vmap(one)(contexts, mask)


@compiled
def _reduce(columns, jacobian, filters: Whitening, factor, zero_sd):
    k = factor.shape[-1]

    def one(x, J, white, S):
        Z = jnp.concatenate([jax.vmap(white)(own_rows(J, S)), jnp.diag(jnp.append(jnp.ones(k), 1 / zero_sd))], 1).T
        y = jnp.concatenate([jax.vmap(white)(x), jnp.zeros((len(x), k + 1))], 1)
        Q, _ = jnp.linalg.qr(Z)
        return y - (y @ Q) @ Q.T, jnp.sum(y**2, 1)

    return jax.vmap(one)(columns, jacobian, filters, factor)
