"""What a law leaves of every test, without and with what a discovery added."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._errors import InputError
from ..calibrate.fit import population_at
from ..calibrate.linearise import linear_data
from ..calibrate.population import moments
from ..discover import Discovery
from ..discover.linear_model import Base, Candidate, System, build_system, feature_values, signals_of
from ..discover.score import project
from ..effects import Mechanism, Variant


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
    """Columns of the system that a discovery put into the law: those of its effects, or the words of its formula.

    An effect whose further numbers were fitted has moved away from its column; then it is the nearest one.
    """
    system = found.system
    if system is None:
        return np.array([], int)
    index = []
    for effect in found.effects:
        alike = [system.column(k) for k, c in enumerate(system.candidates) if c.variant == effect.variant]
        index.append(min(alike, key=lambda column: _apart(_candidate(system, column).nuisance, effect.nuisance)))
    words = found.closure.words if found.closure is not None else []
    return np.array([*index, *words], int)


def _apart(one: Mapping[str, float], other: Mapping[str, float]) -> float:
    """Relative distance of two sets of further numbers; 0 only where they are equal."""
    pairs = [(float(one[name]), float(value)) for name, value in other.items() if name in one]
    return sum((abs(a - b) / (abs(a) + abs(b)) for a, b in pairs if a != b), 0.0)


def leftover(found: Discovery) -> Leftover:
    """Residuals of every test before and after, by the linear system of the discovery.

    Raises:
        ValueError: if the base fit did not converge, so that there is no linear system.
    """
    base, system = found.base, found.system
    if base is None or system is None:
        raise InputError("the base law was not fitted well enough; there is nothing to compare")
    system, inside, changes = _as_found(base, system, found)
    before = project(system, np.array([], int))
    after = project(system, np.array([], int), inside=inside)
    count = len(system.globals)
    one, white_one = _remain(base, before.theta[:count], jnp.zeros_like(changes))
    two, white_two = _remain(base, after.theta[:count], changes * after.theta[count:][None, :, None])
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


def _as_found(base: Base, system: System, found: Discovery) -> tuple[System, np.ndarray, jax.Array]:
    """A linear system that holds what was added with the further numbers it was found with, and where.

    Returns:
        The system, the columns of the additions, and their change of the residual per unit, shape (N, columns, points).
    """
    inside = added_columns(found)
    if not len(inside):
        return system, inside, jnp.zeros((len(system.points), 0, base.tests.force.shape[1]))
    formulas = [_fixed_at(effect.variant, effect.nuisance) for effect in found.effects]
    library = {str(i): Mechanism(v.mechanism, "", (v,)) for i, v in enumerate(formulas)}
    signals = signals_of(base, library, turned=True)
    if found.closure is not None:
        words = tuple(system.word(int(column)) for column in found.closure.words)
        signals = signals.with_formula(base, words, feature_values(base, words))
    # Columns of features stand behind those of all candidates, so they move with the number of these.
    moved = len(signals.candidates) - len(system.candidates)
    columns = np.array([*(system.column(i) for i in range(len(formulas))), *(inside[len(formulas) :] + moved)], int)
    if all(
        _apart(_candidate(system, int(c)).nuisance, e.nuisance) == 0
        for c, e in zip(inside, found.effects, strict=False)
    ):
        return system, inside, signals.of(columns)
    return replace(build_system(base, signals), usable=system.usable), columns, signals.of(columns)


def _candidate(system: System, column: int) -> Candidate:
    return system.candidates[column - system.column(0)]


def _fixed_at(variant: Variant, numbers: Mapping[str, float]) -> Variant:
    """The formula with its further numbers where they were found, and nowhere else."""
    fixed = [(n, float(numbers.get(n.name, n.middle))) for n in variant.nuisances]
    return replace(
        variant,
        nuisances=tuple(
            replace(n, grid=(value,), plausible=(min(n.plausible[0], value), max(n.plausible[1], value)))
            for n, value in fixed
        ),
    )


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
