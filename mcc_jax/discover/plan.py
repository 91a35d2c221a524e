"""What a planned campaign could show, before it is measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .. import arguments
from .._errors import InputError
from ..calibrate import Model
from ..calibrate.estimates import finite
from ..campaign import Campaign, Curve, Metadata, available_data, check_campaign
from ..effects import LIBRARY, Mechanism
from ..effects.library import checked_library
from ..simulate import Programme, simulate_campaign
from .candidates import untestable
from .legacy.data import Tests, select_tests
from .legacy.forward import law_of
from .legacy.linearise import linear_data, summarise
from .legacy.noise import Noise
from .legacy.settings import checked_settings
from .linear_model import Base, System, base_fit, build_system, records_of, signals_of
from .score import DETECTABLE, project

ALIKE = 0.9
_A_PROGRAMME = "Take mcc_jax.Programme.cycles()."


@dataclass(frozen=True)
class Plan:
    """A test programme, perhaps another one for every second particle.

    Attributes:
        name: what to do, in words.
        programmes: taken in turn by the particles.

    Raises:
        InputError: if there is none, or what is given is none.
    """

    name: str
    programmes: Sequence[Programme]

    def __post_init__(self) -> None:
        arguments.instance(self.name, str, "name", "Say in words what is done.")
        given = arguments.instance(self.programmes, Sequence, "programmes", _A_PROGRAMME)
        if not given:
            raise InputError("a plan needs at least one programme", remedy=_A_PROGRAMME)
        for one in given:
            arguments.instance(one, Programme, "every one of programmes", _A_PROGRAMME)
        object.__setattr__(self, "programmes", tuple(given))


def planned_campaign(laws, diameters_um: np.ndarray, peaks_mN: np.ndarray, plan: Plan) -> Campaign:
    """The campaign that a plan would give without noise and without any missing effect."""
    parts = [simulate_campaign(laws, diameters_um, peaks_mN, programme) for programme in plan.programmes]
    curves: list[Curve] = [parts[i % len(parts)].curves[i] for i in range(len(diameters_um))]
    return Campaign(parts[0].particles, parts[0].diameters_um, tuple(curves), {}, Metadata(control="load"))


def planned_base(base: Base, plan: Plan) -> Base:
    """A base fit as it would be if the same particles were tested by a plan, with the same noise."""
    arguments.instance(base, Base, "base", "Take the base of a discovery.")
    arguments.instance(plan, Plan, "plan", "Make one with mcc_jax.Plan(name, [programme]).")
    fit = base.fit
    kept = list(base.selection.kept)
    laws = eqx.filter_vmap(lambda w: law_of(w, base.model.unloading))(fit.latent)
    peaks = np.asarray(jnp.max(base.tests.force, axis=1))
    campaign = planned_campaign(laws, base.campaign.diameters_um[kept], peaks, plan)
    return _expected(campaign, base, fit.latent, fit.noise)


def _expected(campaign: Campaign, base: Base, latent, noise: Noise) -> Base:
    fit, model = base.fit, base.legacy_model
    selection = select_tests(campaign, threshold_MPa=base.threshold_MPa)
    kept = np.asarray(selection.kept)
    tests: Tests = selection.tests
    latent = latent[kept]
    zero = jnp.zeros(len(kept))
    noise = eqx.tree_at(lambda n: n.scale, noise, noise.scale[kept])
    data = linear_data(latent, zero, tests, model.zero_sd, model.unloading)
    data = eqx.tree_at(lambda d: d.residual, data, jnp.zeros_like(data.residual))
    summary, filters, _ = summarise(latent, zero, tests, data, noise, model.zero_sd)
    numbers = eqx.tree_at(lambda n: n.flatness, fit.numbers, tests.flatness)
    new = eqx.tree_at(
        lambda f: (f.noise, f.filters, f.latent, f.zero, f.residual, f.summary, f.numbers),
        fit,
        (noise, filters, latent, zero, data.residual, summary, numbers),
    )
    return Base(campaign, selection, base.model, new, records_of(campaign, selection), base.threshold_MPa)


def planned_system(base: Base, plan: Plan, library: Mapping[str, Mechanism]) -> System:
    """The linear system of the same particles under another plan."""
    planned = planned_base(base, plan)
    return build_system(planned, signals_of(planned, library))


@dataclass(frozen=True)
class Power:
    """What a planned campaign can show.

    Attributes:
        mechanisms: names.
        limits: smallest amplitude of each mechanism's most visible formula that is found with 95 % probability.
        units, plausible: its unit and the range one would believe.
        inseparable: pairs whose projected signatures are so alike that these data cannot tell them apart.
        untestable: mechanisms that need what the campaign does not hold.
    """

    mechanisms: tuple[str, ...]
    limits: dict[str, float]
    units: dict[str, str]
    plausible: dict[str, tuple[float, float]]
    inseparable: tuple[tuple[str, str, float], ...]
    untestable: tuple[dict[str, str], ...]

    def to_json(self) -> dict[str, Any]:
        """The contents of `power.json`."""
        return {
            "schema": 1,
            "mechanisms": [
                {
                    "mechanism": name,
                    "detection_limit": finite(self.limits[name]),
                    "unit": self.units[name],
                    "plausible": [float(v) for v in self.plausible[name]],
                    "visible": bool(self.limits[name] <= self.plausible[name][1]),
                }
                for name in self.mechanisms
            ],
            "inseparable": [{"pair": [a, b], "similarity": finite(value)} for a, b, value in self.inseparable],
            "untestable": list(self.untestable),
        }


def power_of(system: System, missing: Sequence[dict[str, str]]) -> Power:
    """Detection limits and inseparable pairs of a linear system; residuals play no part."""
    view = project(system, system.candidate_columns)
    both = view.similarity()
    limits, units, plausible = {}, {}, {}
    strength = view.total * view.alive
    members: dict[str, list[int]] = {}
    for k, candidate in enumerate(system.candidates):
        if strength[k] > 0:
            members.setdefault(candidate.mechanism, []).append(k)
    for name, ks in members.items():
        # The first formula is the common one; the limit is that of the family's first formula that leaves a trace.
        k = ks[0]
        unit = system.candidates[k].unit_amplitude
        limits[name] = float(DETECTABLE / np.sqrt(strength[k]) * unit)
        units[name] = system.candidates[k].variant.unit
        plausible[name] = system.candidates[k].variant.plausible
    alike = []
    names = list(members)
    signs = system.signs
    for a, one in enumerate(names):
        for other in names[a + 1 :]:
            block = both[np.ix_(members[one], members[other])]
            product = signs[members[one]][:, None] * signs[members[other]][None]
            value = float(np.max(np.where(product == 0, np.abs(block), block * product)))
            if value >= ALIKE:
                alike.append((one, other, value))
    alike.sort(key=lambda item: -item[2])
    return Power(tuple(names), limits, units, plausible, tuple(alike), tuple(missing))


def power(
    diameters_um: Any,
    peaks_mN: Any,
    plan: Plan,
    *,
    base: Base,
    library: Mapping[str, Mechanism] = LIBRARY,
) -> Power:
    """Power of a planned campaign of particles of given sizes, with material and noise as in a fitted one.

    Args:
        diameters_um: D1, D2, D3 of the particles to be tested, shape (N, 3).
        peaks_mN: their largest forces.
        plan: what is done to them.
        base: a fitted campaign, of which material and noise are taken.
        library: the mechanisms.
    """
    from ..campaign import particle_batch
    from .legacy.fit import population_at
    from .legacy.population import moments

    diameters_um = arguments.diameters(diameters_um)
    peaks_mN = arguments.floats(peaks_mN, "peaks_mN", shape="the largest force of every particle, shape (N,)")
    arguments.same_length(diameters_um=diameters_um, peaks_mN=np.atleast_1d(peaks_mN))
    arguments.positive(peaks_mN, "peaks_mN")
    arguments.instance(plan, Plan, "plan", "Make one with mcc_jax.Plan(name, [programme]).")
    arguments.instance(base, Base, "base", "Take the base of a discovery.")
    checked_library(library)
    particles = particle_batch(diameters_um)
    flat = eqx.filter_vmap(lambda particle: particle.flatness)(particles)
    population = population_at(base.fit.mode, base.fit.numbers, base.legacy_model.scatter)
    latent, _ = moments(population, flat, base.legacy_model.scatter)
    laws = eqx.filter_vmap(lambda w: law_of(w, base.model.unloading))(latent)
    campaign = planned_campaign(laws, np.asarray(diameters_um, float), np.asarray(peaks_mN, float), plan)
    noise = eqx.tree_at(lambda n: n.scale, base.fit.noise, jnp.ones(len(diameters_um)))
    planned = _expected(campaign, base, latent, noise)
    system, missing = _testable(planned, library)
    return power_of(replace(system, usable=np.ones(len(system.points), bool)), missing)


def power_of_campaign(
    campaign: Campaign,
    *,
    library: Mapping[str, Mechanism] = LIBRARY,
    model: Model | None = None,
    threshold_MPa: float = 0.0,
    progress: Callable[[str], None] | None = None,
) -> Power:
    """What a campaign can show: one that was simulated as planned, with the tester's noise, or one that was measured.

    Args:
        campaign: the tests.
        library: the mechanisms.
        model: form of unloading and priors; the modulus may always scatter between particles.
        threshold_MPa: points below this stress do not count [MPa].
        progress: called with the name of each step.

    Raises:
        InputError: if no particle can be used.
    """
    check_campaign(campaign)
    checked_library(library)
    tell, assumed, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    assumed = replace(assumed, modulus_scatter=True)
    base = base_fit(campaign, assumed, threshold_MPa=threshold_MPa, tell=tell)
    tell("signatures of all effects")
    return power_of(*_testable(base, library))


def _testable(base: Base, library: Mapping[str, Mechanism]) -> tuple[System, Sequence[dict[str, str]]]:
    """The linear system with all formulas that the campaign can be searched for, and what the others need."""
    testable, missing = untestable(library, available_data(base.campaign))
    return build_system(base, signals_of(base, testable)), missing
