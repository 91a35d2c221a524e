"""What a discovery shows besides numbers: every test's residuals before and after, and mechanisms that look alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .evidence import Ranking
from .gauss_newton import Refit
from .legacy.compiling import compiled
from .legacy.fit import population_at
from .legacy.population import moments
from .linear_model import GLOBALS, Base, Signals, System, feature_values, mean_by_globals, whitened
from .normal_equations import common_rows, in_batches, own_rows
from .score import project


@dataclass(frozen=True)
class Residuals:
    """Measured less predicted displacement, every particle's own parameters fitted without and with what was added.

    Attributes:
        time_s: shape (N, points).
        kind: kind of segment of every point, codes of `mcc_jax.effects.Record`.
        used: which points count.
        before: residuals of the base law [um].
        after: of the law with what was added [um]; both of its fit, or to first order around the base fit if that is
            all there is.
        white_before, white_after: the same in units of the noise, independent from point to point.
        noise: standard deviation of what the points before do not foretell [um].
        particles: positions of the tests in the campaign.
    """

    time_s: np.ndarray
    kind: np.ndarray
    used: np.ndarray
    before: np.ndarray
    after: np.ndarray
    white_before: np.ndarray
    white_after: np.ndarray
    noise: np.ndarray
    particles: tuple[int, ...]


@dataclass(frozen=True)
class Likeness:
    """How alike mechanisms look once the law has taken up what it can.

    Attributes:
        names: members of the sets first, then the ranking from the top; shape (K,).
        correlation: of their projected best formulas, each with its physical sign: 1 means that these data cannot tell
            the two apart, -1 that one would look like the other with the impossible sign; shape (K, K).
    """

    names: tuple[str, ...]
    correlation: np.ndarray


def residuals(
    base: Base,
    system: System,
    signals: Signals,
    inside: np.ndarray,
    words: np.ndarray,
    fits: tuple[Refit, Refit] | None,
) -> Residuals:
    """Residuals of every test before and after.

    Args:
        base: the base fit.
        system: its linear system, with the formula if there is one.
        signals: what effects and features add.
        inside: columns of the effects that were added.
        words: columns of the words of the formula that was added.
        fits: the base law and the law with these effects, both fitted by the same equations; None if the effects were
            added to first order.
    """
    if fits is not None:
        before, after = (fit.residual for fit in fits)
    else:
        before, after = (_to_first_order(base, system, signals, *some) for some in ((inside[:0],) * 2, (inside, words)))
    white_before, white_after = (in_batches(whitened, (r, base.fit.filters)) for r in (before, after))
    return Residuals(
        np.asarray(base.records.time),
        np.asarray(base.records.kind),
        np.asarray(base.tests.mask),
        np.asarray(before),
        np.asarray(after),
        np.asarray(white_before),
        np.asarray(white_after),
        1 / np.maximum(np.asarray(base.fit.filters.weight), 1e-300),
        tuple(base.selection.kept),
    )


def _to_first_order(base: Base, system: System, signals: Signals, inside: np.ndarray, words: np.ndarray) -> Array:
    """Residuals with the population moved and columns added as the linear system says, every particle fitted anew."""
    fit, tests, scatter = base.fit, base.tests, base.legacy_model.scatter
    theta = project(system, inside[:0], inside=np.concatenate([inside, words]).astype(int)).theta
    shift, effects, formula = np.split(theta, np.cumsum([len(GLOBALS), len(inside)]))
    extra = jnp.einsum("k,nkp->np", effects, signals.of(inside))
    if len(words):
        values = feature_values(base, tuple(system.word(int(column)) for column in words))
        extra = extra - jnp.einsum("k,nkp->np", formula, values)
    data, population = base.linear(), population_at(fit.mode, fit.numbers, scatter)
    mean, factor = moments(population, tests.flatness, scatter)
    rows = (data.residual, data.jacobian, fit.filters, mean - fit.latent, fit.zero - tests.contact)
    slope = mean_by_globals(population, tests.flatness, scatter)
    moved, zero_sd = np.tile(shift, (len(tests), 1)), np.full(len(tests), float(base.legacy_model.zero_sd))
    return in_batches(_fitted, (*rows, slope, factor, moved, jnp.where(tests.mask, extra, 0.0), zero_sd))


@compiled
def _fitted(
    residual, jacobian, filters, away, zero_away, slope, factor, shift, extra, zero_sd
) -> Float[Array, "particles points"]:
    def one(r, J, white, offset, z, by_globals, S, beta, added, sd):
        own = own_rows(J, S)
        common = common_rows(r, J, offset, z, by_globals)
        y = common[0] + beta @ common[1:] + added
        X = jax.vmap(white)(own)
        prior = jnp.concatenate([jnp.ones(S.shape[-1]), 1 / sd[None] ** 2])
        return y - jnp.linalg.solve(X @ X.T + jnp.diag(prior), X @ white(y)) @ own

    rows = (residual, jacobian, filters, away, zero_away, slope, factor, shift, extra, zero_sd)
    return jax.vmap(one)(*rows)


def likeness(system: System, ranking: Ranking, sets: Sequence[Sequence[str]], chosen: Sequence[int]) -> Likeness:
    """How alike the mechanisms of a ranking look, each by its best formula, or by the one that was added."""
    names = tuple(dict.fromkeys([name for names in sets for name in names] + list(ranking.names)))
    best = dict(zip(ranking.names, ranking.best, strict=True)) | {system.candidates[k].mechanism: k for k in chosen}
    index = np.array([int(best[name]) for name in names])
    view = project(system, system.candidate_columns[index])
    sign = np.where(view.estimate < 0, -1.0, 1.0)
    sign = np.where(system.signs[index] == 0, sign, system.signs[index])
    return Likeness(names, view.similarity() * sign * sign[:, None])
