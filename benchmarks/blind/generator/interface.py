"""What the bench calls of this generator."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ..settings import SETTINGS
from ..world import Hidden, Shift, Sized, World
from . import designs
from .effects import BY_NAME, HUMIDITY, LISTED, RELOAD, UNLISTED, Effect
from .law import EFFECTIVE_MODULUS_MPA, LOG_C, SHAPE_PARAMETER, Particles, monotone_means, response, simulate

if TYPE_CHECKING:
    from ..plan import Case


def formulas(mechanism: str) -> tuple[str, ...]:
    """Names of a mechanism's formulas, the exact one first."""
    return tuple(form.form for form in LISTED if form.mechanism == mechanism)


def unlisted() -> tuple[str, ...]:
    """Names of the formulas on no list."""
    return tuple(form.form for form in UNLISTED)


def protocols(mechanism: str, formula: str) -> tuple[str, ...]:
    """Protocols that can show a formula."""
    if mechanism == "rate_dependence":
        return ("P2",)
    if mechanism == "unlisted" or RELOAD in BY_NAME[mechanism, formula].needs:
        return ("P1", "P2")
    return designs.PROTOCOLS


def _hidden(effect: Effect) -> Hidden:
    form = effect.form
    return Hidden(
        form.mechanism, form.form, form.equation, form.parameter, form.unit, form.largest, len(form.signs) > 1, effect
    )


def draw(rng: np.random.Generator, case: Case) -> World:
    """A campaign before noise, with the effects that the case asks for."""
    forms = [BY_NAME[mechanism, formula] for mechanism, formula, _ in case.effects]
    humid = case.humidity or any(HUMIDITY in form.needs for form in forms)
    scatter = {name: sd if case.noise == name else 0.0 for name, sd in SETTINGS.testers.scatter.items()}
    particles = designs.population(
        rng,
        designs.sizes(rng, case.particles, any(form.mechanism == "size_effect" for form in forms)),
        scatter["modulus"],
        scatter["shape"],
        humid,
    )
    path = designs.programme(rng, particles, case.protocol)
    asked = [Effect(form, form.draw(rng, case.particles), int(rng.choice(form.signs))) for form in forms]
    size = path.time.shape[1]
    means = dict(zip(LOG_C, monotone_means(designs.MARGIN).tolist(), strict=True))
    truth = {"a": SHAPE_PARAMETER, "effective_modulus_MPa": EFFECTIVE_MODULUS_MPA}
    truth |= {f"log_{name}": mean for name, mean in means.items()}
    return World(
        {"D1_um": particles.D1, "D2_um": particles.D2, "D3_um": particles.D3, **particles.columns},
        path.time.ravel(),
        path.force.ravel(),
        tuple(slice(i * size, (i + 1) * size) for i in range(case.particles)),
        particles.De,
        np.array([sd for _, sd in LOG_C.values()]),
        np.stack(
            [
                *(np.log(getattr(particles, name)) - mean for name, (mean, _) in LOG_C.items()),
                np.log(particles.modulus / EFFECTIVE_MODULUS_MPA),
            ]
        ),
        truth,
        tuple(map(_hidden, asked)),
        lambda sized, shift: _curves(particles, path, sized, shift),
        lambda sized: response(particles, path, _active(sized), SHAPE_PARAMETER).modulus.ravel(),
        lambda: _listed(case, humid),
    )


def _active(sized: Sized) -> list[Any]:
    return [pair for hidden, amplitude in sized for pair in hidden.effect(amplitude)]


def _curves(particles: Particles, path: designs.Path, sized: Sized, shift: Shift | None) -> np.ndarray:
    a = SHAPE_PARAMETER
    if shift is not None:
        logs = {name: getattr(particles, name) * np.exp(shift.log_C[k]) for k, name in enumerate(LOG_C)}
        particles = particles.with_(**logs, modulus=particles.modulus * np.exp(shift.log_modulus))
        a = a + shift.a
    return simulate(particles, path, _active(sized), a).ravel()


def _listed(case: Case, humid: bool) -> Iterator[Hidden]:
    rng = np.random.default_rng(7)
    for form in LISTED:
        if form.mechanism == "pop_in" or (RELOAD in form.needs and case.protocol == "P0"):
            continue
        if HUMIDITY in form.needs and not humid:
            continue
        yield _hidden(Effect(form, form.draw(rng, case.particles)))
