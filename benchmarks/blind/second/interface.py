"""What the bench calls of this generator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..settings import SETTINGS
from ..world import Hidden, Shift, Sized, World
from . import campaign as campaign_
from . import effects, particles
from .campaign import Campaign
from .effects import Effect, Formula
from .law import Shift as LawShift
from .law import response, simulate

if TYPE_CHECKING:
    from ..plan import Case

FURTHER_RELOAD = 0.3
"""Share of campaigns with partial unloading that get a further reload though no effect asks for it."""


def _formulas(mechanism: str) -> tuple[Formula, ...]:
    return effects.UNLISTED if mechanism == "unlisted" else effects.LISTED[mechanism]


def formulas(mechanism: str) -> tuple[str, ...]:
    """Names of a mechanism's formulas, the specification's first."""
    return tuple(formula.name for formula in _formulas(mechanism))


def unlisted() -> tuple[str, ...]:
    """Names of the formulas on no list."""
    return formulas("unlisted")


def _find(mechanism: str, name: str) -> Formula:
    return next(formula for formula in _formulas(mechanism) if formula.name == name)


def protocols(mechanism: str, formula: str) -> tuple[str, ...]:
    """Protocols that can show a formula."""
    return _find(mechanism, formula).protocols


def _hidden(effect: Effect) -> Hidden:
    f = effect.formula
    return Hidden(f.mechanism, f.name, effect.describe(), f.unit, f.start, f.largest, f.signed, effect)


def draw(rng: np.random.Generator, case: Case) -> World:
    """A campaign before noise, with the effects that the case asks for."""
    asked = [_find(mechanism, formula)(rng) for mechanism, formula, _ in case.effects]
    reloads = 0
    if case.protocol != "P0":
        reloads = max([effect.formula.reloads for effect in asked], default=0)
        if not reloads and rng.random() < FURTHER_RELOAD:
            reloads = 1
    humid = case.humidity or any(effect.formula.humidity for effect in asked)
    scatter = {name: sd if case.noise == name else 0.0 for name, sd in SETTINGS.testers.scatter.items()}
    campaign = campaign_.draw(
        rng,
        case.particles,
        case.protocol,
        humidity=particles.humidity_levels(rng, case.particles) if humid else None,
        reloads=reloads,
        wide=any(effect.formula.wide for effect in asked),
        low_turn=any(effect.formula.low_turn for effect in asked),
        modulus_scatter=scatter["modulus"],
        shape_scatter=scatter["shape"],
    )
    tested = campaign.particles
    columns = {name: tested.D[:, k] for k, name in enumerate(("D1_um", "D2_um", "D3_um"))}
    if humid:
        columns["relative_humidity_percent"] = tested.humidity
    truth = {"a": tested.a, "effective_modulus_MPa": tested.mean_modulus}
    truth |= {f"log_{name}": float(v) for name, v in zip(("C1", "C3", "C5"), particles.population_means(), strict=True)}
    return World(
        columns,
        campaign.path.time,
        campaign.path.force,
        campaign.path.slices,
        tested.De,
        particles.LOG_C_SD,
        np.vstack([np.log(tested.C).T - particles.LOG_C_MEAN[:, None], np.log(tested.modulus / tested.mean_modulus)]),
        truth,
        tuple(map(_hidden, asked)),
        lambda sized, shift: _curves(campaign, sized, shift),
        lambda sized: response(campaign, _active(sized)).modulus,
        lambda: _listed(campaign),
    )


def _active(sized: Sized) -> list[tuple[Effect, float]]:
    return [(hidden.effect, theta) for hidden, theta in sized]


def _curves(campaign: Campaign, sized: Sized, shift: Shift | None) -> np.ndarray:
    moved = LawShift() if shift is None else LawShift(shift.log_C, shift.a, 0.0)
    if shift is not None and np.any(shift.log_modulus):
        tested = campaign.particles
        tested = replace(tested, modulus=tested.modulus * np.exp(shift.log_modulus))
        campaign = Campaign(tested, campaign.path, campaign.memory)
    return simulate(campaign, _active(sized), moved)


def _listed(campaign: Campaign) -> Iterator[Hidden]:
    """Formulas with other random numbers than the hidden ones have."""
    for name, known in effects.LISTED.items():
        if name == "pop_in" or (name == "humidity" and campaign.particles.humidity is None):
            continue
        for formula in known:
            yield _hidden(formula(np.random.default_rng(7)))
