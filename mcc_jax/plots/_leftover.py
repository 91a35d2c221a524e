"""What a law leaves of every test, without and with what a discovery added."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..calibrate.joint._fit import population_at
from ..calibrate.joint._linearised import linear_data
from ..calibrate.joint._population import moments
from ..discover import Discovery
from ..discover._score import project
from ..discover._system import Base, System, signals_of
from ..effects import Mechanism


@dataclass(frozen=True)
class Leftover:
    """Measured less predicted displacement, every particle's own parameters fitted again in both cases.

    Attributes:
        time_s: shape (N, points).
        kind: kind of segment of every point, codes of `mcc_jax.effects.Record`.
        used: which points count.
        before, after: residuals [um] without and with the additions, first order around the base fit.
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


def added_columns(found: Discovery) -> np.ndarray:
    """Columns of the system that a discovery put into the law: those of its effects, or the words of its formula."""
    if found.system is None:
        return np.array([], int)
    index = []
    for effect in found.effects:
        for k, candidate in enumerate(found.system.candidates):
            if candidate.variant == effect.variant and dict(candidate.nuisance) == effect.nuisance:
                index.append(found.system.column(k))
                break
    words = found.closure.words if found.closure is not None else []
    return np.array([*index, *words], int)


def leftover(found: Discovery) -> Leftover:
    """Residuals of every test before and after, by the linear system of the discovery.

    Raises:
        ValueError: if the base fit did not converge, so that there is no linear system.
    """
    base, system = found.base, found.system
    if base is None or system is None:
        raise ValueError("the base law was not fitted well enough; there is nothing to compare")
    none = np.array([], int)
    inside = added_columns(found)
    before = project(system, none)
    after = project(system, none, inside=inside)
    signals = _signals(base, system, inside)
    count = len(system.globals)
    one, white_one = _remain(base, before.theta[:count], jnp.zeros_like(signals))
    two, white_two = _remain(base, after.theta[:count], signals * after.theta[count:][None, :, None])
    weight = np.asarray(base.fit.filters.weight)
    return Leftover(
        np.asarray(base.records.time),
        np.asarray(base.records.kind),
        np.asarray(base.tests.mask),
        np.asarray(one),
        np.asarray(two),
        np.asarray(white_one),
        np.asarray(white_two),
        1 / np.maximum(weight, 1e-300),
        tuple(base.selection.kept),
    )


def _signals(base: Base, system: System, columns: np.ndarray) -> jax.Array:
    """Change of the residual per unit of some columns, shape (N, columns, points)."""
    if not len(columns):
        return jnp.zeros((len(system.points), 0, base.tests.force.shape[1]))
    # Only what was added is computed again; the columns of features come after all candidates.
    total = len(system.candidates)
    listed = [int(c) - system.column(0) for c in columns]
    chosen = [k for k in listed if k < total]
    library = {
        str(n): Mechanism(c.variant.mechanism, "", (c.variant,))
        for n, c in enumerate(system.candidates[k] for k in dict.fromkeys(chosen))
    }
    signals = signals_of(base, library)
    at = []
    for k in listed:
        if k >= total:
            at.append(k - total + len(signals.candidates))
            continue
        wanted = system.candidates[k]
        same = [
            j
            for j, c in enumerate(signals.candidates)
            if c.variant == wanted.variant and dict(c.nuisance) == dict(wanted.nuisance)
        ]
        at.append(same[0])
    return signals.of(np.array(at) + system.column(0))


def _remain(base: Base, theta: np.ndarray, extra: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Residuals with the population at `theta` and something added, particles' deviations and zeros fitted."""
    fit, tests, scatter = base.fit, base.tests, base.model.scatter
    population = population_at(fit.mode, fit.numbers, scatter)
    step = jnp.asarray(theta)
    moved = eqx.tree_at(
        lambda p: (p.a, p.log_modulus, p.mu),
        population,
        (population.a + step[0], population.log_modulus + step[1], population.mu + step[2:]),
    )
    data = linear_data(fit.latent, fit.zero, tests, base.model.zero_sd, base.model.unloading)
    mean, factor = moments(moved, tests.flatness, scatter)

    def one(residual, jacobian, mask, white, S, away, zero_away, added):
        own, zero = jacobian[:, :4], jacobian[:, 4]
        r = residual + own @ away - zero * zero_away + jnp.where(mask, added, 0.0)
        columns = jnp.concatenate([own @ S, zero[:, None]], 1)
        X = jax.vmap(white, in_axes=1, out_axes=1)(columns)
        y = white(r)
        prior = jnp.concatenate([jnp.ones(S.shape[-1]), 1 / base.model.zero_sd[None] ** 2])
        own_part = -jnp.linalg.solve(X.T @ X + jnp.diag(prior), X.T @ y)
        return r + columns @ own_part, y + X @ own_part

    with jax.numpy_rank_promotion("allow"):
        return jax.jit(jax.vmap(one))(
            data.residual,
            data.jacobian,
            tests.mask,
            fit.filters,
            factor,
            mean - fit.latent,
            fit.zero - tests.contact,
            extra.sum(1),
        )
