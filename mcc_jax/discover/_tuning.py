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

from ..calibrate.joint._compile import compiled
from ..calibrate.joint._fit import population_at
from ..calibrate.joint._noise import Whitening
from ..calibrate.joint._population import moments
from ..effects import Context, ExtendedLaw
from ..law import Unloading
from ._features import Feature, Form, further_words, words
from ._pursuit import MOST_WORDS
from ._system import Base, System, feature_values, in_batches, law_of, mean_by_globals

MOST_NUMBERS = 3
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

MOST_PARTICLES = 100
"""Of larger campaigns so many particles, evenly spread, tell the numbers."""

MODEST = 1e-3
"""What the base law takes up of a formula is not seen, so that nothing keeps it small: this share of its chi2 does."""

EXACT = 1e-5
STEPS = 25

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

    def __init__(self, base: Base, system: System) -> None:
        fit, tests, scatter = base.fit, base.tests, base.model.scatter
        population = population_at(fit.mode, fit.numbers, scatter)
        flat, data = tests.flatness, base.linear()
        mean, factor = moments(population, flat, scatter)
        by_globals = mean_by_globals(population, flat, scatter)
        contexts = partial(_contexts, unloading=base.model.unloading)
        self._tests = in_batches(contexts, (fit.latent, tests.particle, base.records)), tests.mask
        self._space = data.jacobian, fit.filters, factor
        self._zero_sd, self._prior, self._usable = base.model.zero_sd, system.prior, np.flatnonzero(system.usable)
        away = mean - fit.latent, fit.zero - tests.contact
        fixed = in_batches(_fixed, (data.residual, data.jacobian, *away, by_globals))
        self._residual, _ = self._reduced(fixed)
        self._listed = (*words(), *further_words())
        values = feature_values(base, self._listed)
        parts = [self._reduced(values[:, i : i + WIDTH])[0] for i in range(0, len(self._listed), WIDTH)]
        self._values = np.concatenate(parts, 1)

    def values(self, formula: Words) -> Float[Array, "particles words points"]:
        """Displacement that words add, per unit of coefficient [um]."""
        return jnp.stack([self._word(word)[:, 0] for word in formula], 1)

    def cosines(self, formula: Words, particles: np.ndarray) -> np.ndarray:
        """Cosines of words among themselves, as far as the base law cannot take them up."""
        space = _Space(self._residual[particles], self._prior)
        parts = [self._reduced(self.values(formula[i : i + WIDTH]))[0] for i in range(0, len(formula), WIDTH)]
        columns = space.off(_stacked(np.concatenate(parts, 1)[particles]))
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        return columns.T @ columns

    def search(self, particles: np.ndarray) -> Fitted:
        """The formula for the gap of some particles: words one after the other, each time with all numbers fitted."""
        some = particles[np.linspace(0, len(particles) - 1, min(len(particles), MOST_PARTICLES)).astype(int)]
        space = _Space(self._residual[some], self._prior)
        listed = space.off(_stacked(self._values[some]))
        found = Fitted()
        for starts in STARTS:
            left, basis = (space.y, listed[:, :0]) if not found.words else self._left(space, found.words, some)
            free = listed - basis @ (basis.T @ listed)
            size = np.sum(free**2, 0)
            drop = np.where(size > 1e-4 * np.sum(listed**2, 0), (left @ free) ** 2 / np.maximum(size, 1e-300), 0.0)
            best = [self._listed[i] for i in np.argsort(-drop, kind="stable")]
            forms = [word.form for word in best]
            several = [word for i, word in enumerate(best) if forms[:i].count(word.form) < OF_A_FORM]
            tried = [self._fit(space, (*found.words, word), some) for word in several[:starts]]
            further = max(tried, key=lambda one: one.worth)
            if further.worth - found.worth < WORTH:
                break
            found = self._pruned(space, further, some)
        return found

    def _pruned(self, space: _Space, formula: Fitted, particles: np.ndarray) -> Fitted:
        """Without words that others have made worthless: the first one is chosen when it stands alone."""
        while len(formula.words) > 1:
            fewer = [formula.words[:i] + formula.words[i + 1 :] for i in range(len(formula.words))]
            best = max((self._fit(space, words, particles) for words in fewer), key=lambda one: one.worth)
            if formula.worth - best.worth >= WORTH:
                break
            formula = best
        return formula

    def _fit(self, space: _Space, start: Words, particles: np.ndarray) -> Fitted:
        """Words with the numbers that explain most."""
        from scipy.optimize import least_squares

        numbers = np.concatenate([np.asarray(word.numbers) for word in start])
        known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

        def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            if x.tobytes() not in known:
                known.clear()
                known[x.tobytes()] = self._solve(space, _with(start, x), particles)[:2]
            return known[x.tobytes()]

        formula = start
        if len(numbers):
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
            formula = _with(start, found.x)
        left = self._solve(space, formula, particles)[0]
        return Fitted(formula, float(space.y @ space.y - left @ left))

    def _left(self, space: _Space, formula: Words, particles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What a formula leaves of the residual, and an orthonormal basis of its words."""
        left, _, basis = self._solve(space, formula, particles)
        return left[: len(space.y)], basis[: len(space.y)]

    def _solve(self, space: _Space, formula: Words, particles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What is left of the residual with the best coefficients, its derivatives by the numbers, and a basis of the
        words; behind the points a row for every word that keeps its coefficient modest."""
        columns = [self._word(word) for word in formula]
        reduced, squares = self._reduced(jnp.concatenate(columns, 1))
        reduced = space.off(_stacked(reduced[particles]))
        ends = np.cumsum([c.shape[1] for c in columns])
        values = ends - [c.shape[1] for c in columns]
        modest = np.diag(np.sqrt(MODEST * squares[particles][:, values].sum(0)))
        F = np.concatenate([reduced[:, values], modest])
        y = np.concatenate([space.y, np.zeros(len(modest))])
        basis, triangle = np.linalg.qr(F)
        coefficients = np.linalg.lstsq(triangle, basis.T @ y, rcond=1e-10)[0]
        left = y - F @ coefficients
        several = zip(coefficients, values, ends, strict=True)
        slopes = np.concatenate([-c * reduced[:, first + 1 : end] for c, first, end in several], 1)
        slopes = np.concatenate([slopes, np.zeros((len(modest), slopes.shape[1]))])
        return left, slopes - basis @ (basis.T @ slopes), basis

    def _word(self, word: Feature) -> Float[Array, "particles columns points"]:
        numbers = jnp.asarray(np.asarray(word.numbers, float))
        return in_batches(partial(_word, form=word.form, numbers=numbers), self._tests)

    def _reduced(self, columns: Float[Array, "particles W points"]) -> tuple[np.ndarray, np.ndarray]:
        """Columns whitened, with every particle's own parameters projected off, shape (N, W, R); and their squares
        before that, shape (N, W)."""
        count = columns.shape[1]
        wide = jnp.pad(columns, ((0, 0), (0, WIDTH - count), (0, 0)))
        found, squares = in_batches(partial(_reduce, zero_sd=self._zero_sd), (wide, *self._space))
        return np.asarray(found)[:, :count], np.asarray(squares)[:, :count]


class _Space:
    """Rows of some particles, with the population's parameters projected off.

    Attributes:
        y: the residual.
    """

    def __init__(self, fixed: np.ndarray, prior: np.ndarray) -> None:
        """Args: residual and the population's columns, shape (N, 1 + globals, R), and the precision of the latter."""
        self._more = len(prior)
        rows = np.concatenate([_stacked(fixed), np.column_stack([np.zeros(len(prior)), np.diag(np.sqrt(prior))])])
        self._basis, _ = np.linalg.qr(rows[:, 1:])
        self.y = rows[:, 0] - self._basis @ (self._basis.T @ rows[:, 0])

    def off(self, columns: np.ndarray) -> np.ndarray:
        """Some columns likewise."""
        wide = np.concatenate([columns, np.zeros((self._more, columns.shape[1]))])
        return wide - self._basis @ (self._basis.T @ wide)


WIDTH = MOST_WORDS * (1 + MOST_NUMBERS)


def _with(words: Words, numbers: np.ndarray) -> Words:
    ends = np.cumsum([len(w.numbers) for w in words])[:-1]
    return tuple(w.form.at(*part) for w, part in zip(words, np.split(numbers, ends), strict=True))


def _stacked(columns: np.ndarray) -> np.ndarray:
    """All particles' rows one under the other, shape (N R, W)."""
    return np.moveaxis(columns, 1, -1).reshape(-1, columns.shape[1])


@compiled
def _contexts(latent, particles, records, unloading: Unloading) -> Context:
    def one(w, particle, record):
        return ExtendedLaw(law_of(w, unloading), ()).context(particle, record)

    return eqx.filter_vmap(one)(latent, particles, records)


@compiled
def _fixed(residual, jacobian, offset, zero_away, by_globals) -> Float[Array, "particles columns points"]:
    """The residual and the population's columns, as in `_system`."""
    own, zero = jacobian[..., :4], jacobian[..., 4]
    first = residual + jnp.einsum("npk,nk->np", own, offset) - zero * zero_away[:, None]
    return jnp.concatenate([first[:, None], jnp.einsum("npk,nkg->ngp", own, by_globals)], 1)


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
        own = jnp.concatenate([(J[:, :4] @ S).T, J[:, 4][None]])
        Z = jnp.concatenate([jax.vmap(white)(own), jnp.diag(jnp.append(jnp.ones(k), 1 / zero_sd))], 1).T
        y = jnp.concatenate([jax.vmap(white)(x), jnp.zeros((len(x), k + 1))], 1)
        Q, _ = jnp.linalg.qr(Z)
        return y - (y @ Q) @ Q.T, jnp.sum(y**2, 1)

    return jax.vmap(one)(columns, jacobian, filters, factor)
