"""What an answer states: effects with their amplitudes, detection limits, the population's parameters."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..calibrate.estimates import summary
from .candidates import Candidate
from .evidence import Ranking, jumps
from .gauss_newton import Refit
from .linear_model import GLOBALS, Base, System
from .pop_in import Jump, is_step
from .result import Effect
from .score import DETECTABLE, Projection, project


def estimated_effects(
    system: System, fit: Refit | None, chosen: list[int], steps: list[Ranking], p_any: float
) -> tuple[Effect, ...]:
    """The chosen effects, in the linear system around the law with them, if they were fitted as they are."""
    if not chosen:
        return ()
    inside = np.array([system.column(k) for k in chosen])
    fitted = project(system, inside[:0], inside=inside)
    start = len(system.globals)
    found = []
    for row, (k, step) in enumerate(zip(chosen, steps, strict=True)):
        candidate = system.candidates[k]
        unit = candidate.unit_amplitude
        position = step.names.index(candidate.mechanism)
        others = inside[inside != inside[row]]
        alone = project(system, inside[row : row + 1], inside=others)
        own = alone.scores[:, 0] / np.maximum(alone.information[:, 0, 0], 1e-300)
        own = own + system.at[k]
        broken = jumps(system, alone) if step.at_random[position] and is_step(candidate) else ()
        if broken:
            found.append(_of_jumps(candidate, broken, float(step.probability[position]), p_any, alone.particles))
            continue
        variance = fitted.covariance[start + row, start + row]
        if fit is not None:
            # With the further numbers free, an amplitude is less certain.
            variance = max(variance, fit.spread(row)[0] ** 2)
        found.append(
            Effect(
                candidate.variant,
                dict(candidate.nuisance),
                float((fitted.theta[start + row] + system.at[k]) * unit),
                float(np.sqrt(variance) * unit),
                float(step.probability[position]),
                p_any,
                step.at_random[position],
                own * unit,
            )
        )
    return tuple(found)


def _of_jumps(
    candidate: Candidate, broken: tuple[Jump, ...], probability: float, p_any: float, particles: np.ndarray
) -> Effect:
    """Sudden steps in some tests: the amplitude is their mean size, and each test has its own."""
    unit = candidate.unit_amplitude
    size = unit * np.array([jump.size for jump in broken])
    known = unit * np.array([jump.sd for jump in broken])
    own = np.zeros(len(particles))
    own[np.searchsorted(particles, [jump.particle for jump in broken])] = size
    spread = np.var(size, ddof=1) if len(size) > 1 else 0.0
    where = {"location_MPa": float(np.median([jump.stress_MPa for jump in broken]))}
    several = tuple(dataclasses.replace(j, size=unit * j.size, sd=unit * j.sd) for j in broken)
    sd = float(np.sqrt(max(spread, np.mean(known**2)) / len(size)))
    return Effect(candidate.variant, where, float(size.mean()), sd, probability, p_any, True, own, jumps=several)


def with_draws(effect: Effect, draws: dict[str, np.ndarray]) -> Effect:
    """The effect with its numbers from the posterior."""
    own = draws[effect.variant.parameter]
    return dataclasses.replace(
        effect,
        amplitude=float(own.mean()),
        sd=float(own.std()),
        nuisance=effect.nuisance | {name: float(draws[name].mean()) for name in draws if name in effect.nuisance},
        estimates={name: summary(values) for name, values in draws.items()},
    )


def detection_limits(system: System, view: Projection, ranking: Ranking) -> dict[str, tuple[float, float, float]]:
    """Statistic, estimate and detection limit of every mechanism's best formula, in its unit."""
    found = {}
    for name, k in zip(ranking.names, ranking.best, strict=True):
        unit = system.candidates[k].unit_amplitude
        information = max(float(view.total[k]), 1e-300)
        found[name] = (
            float(view.gaussian[k]),
            float(view.estimate[k] * unit),
            DETECTABLE / np.sqrt(information) * unit,
        )
    return found


def population_parameters(base: Base, view: Projection | None, shift: np.ndarray | None = None) -> dict[str, Any]:
    """The population's parameters, moved as a linear system says, which itself may stand a shift away."""
    from .legacy.fit import population_at

    population = population_at(base.fit.mode, base.fit.numbers, base.legacy_model.scatter)
    values = np.array([float(population.a), float(population.log_modulus), *np.asarray(population.mu)])
    sd = np.full(len(GLOBALS), np.nan)
    if shift is not None:
        values = values + shift
    if view is not None:
        values = values + view.theta[: len(GLOBALS)]
        sd = np.sqrt(np.diagonal(view.covariance)[: len(GLOBALS)])

    def entry(value: float, width: float) -> dict[str, Any]:
        if not np.isfinite(width):
            return {"value": float(value), "sd": None, "interval_95": None}
        return {"value": float(value), "sd": float(width), "interval_95": [value - 1.96 * width, value + 1.96 * width]}

    modulus = float(np.exp(values[1]))
    tau = np.asarray(population.tau)
    return {
        "a": entry(values[0], sd[0]),
        "effective_modulus_MPa": entry(modulus, modulus * sd[1]),
        **{
            f"log_{name}": {"mean": entry(values[2 + j], sd[2 + j]), "sd": entry(float(tau[j]), float("nan"))}
            for j, name in enumerate(("C1", "C3", "C5"))
        },
    }
