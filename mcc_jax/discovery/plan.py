"""What a planned campaign could show, before it is measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import arguments
from .._errors import InputError
from .._format import described, number, table
from .._types import Progress
from ..calibrate import Model
from ..calibrate.data import select
from ..calibrate.estimates import finite
from ..calibrate.fitting import checked_settings
from ..calibrate.forward import Point
from ..campaign import Campaign, Curve, Metadata, available_data, check_campaign, particle_batch
from ..effects import LIBRARY, Mechanism
from ..simulate import Programme, simulate_campaign
from .base import Base, State, base_fit
from .candidates import untestable
from .design import particle_means
from .screen import Screen, first_order
from .settings import DETECTABLE

ALIKE = 0.9  # correlation of projected signatures from which on two mechanisms look alike


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

    __repr__ = described()

    def __post_init__(self) -> None:
        if not self.programmes:
            raise InputError("a plan needs at least one programme", remedy="Take mcc_jax.Programme.cycles().")
        object.__setattr__(self, "programmes", tuple(self.programmes))


def planned_base(base: Base, plan: Plan) -> Base:
    """A base fit as it would be if the same particles were tested by a plan, with the same noise."""
    peaks = np.asarray(jnp.max(base.tests.force, axis=1))
    diameters = base.campaign.diameters_um[list(base.selection.kept)]
    return _expected(base, plan, diameters, peaks, base.state.point.latent, base.scale)


def _expected(base: Base, plan: Plan, diameters: np.ndarray, peaks: np.ndarray, latent: Array, scale: Any) -> Base:
    """The base of a campaign by a plan, of particles with these numbers, without noise or any missing effect."""
    laws = eqx.filter_vmap(lambda w: base.forms.law(w, jnp.zeros(0)))(latent)
    parts = [simulate_campaign(laws, diameters, peaks, programme) for programme in plan.programmes]
    curves: list[Curve] = [parts[i % len(parts)].curves[i] for i in range(len(diameters))]
    campaign = Campaign(parts[0].particles, parts[0].diameters_um, tuple(curves), {}, Metadata(control="load"))
    selection = select(campaign, threshold_MPa=base.threshold_MPa)
    kept, tests = np.asarray(selection.kept), selection.tests
    point = Point(latent[kept], jnp.zeros(len(kept)), jnp.zeros((len(kept), 0)))
    state = State(point, base.state.population)
    zeros = np.zeros(len(kept))
    return replace(
        base,
        campaign=campaign,
        selection=selection,
        tests=tests,
        scale=np.asarray(scale)[kept],
        state=state,
        rms_um=zeros,
        range_um=zeros,
    )


@dataclass(frozen=True)
class Power:
    """What a planned campaign can show.

    Attributes:
        mechanisms: names.
        limits: smallest amplitude of each mechanism's most visible formula that is found with 95 % probability.
        units, plausible: its unit and the range one would believe.
        inseparable: pairs whose projected signatures are so alike that these data cannot separate them.
        untestable: mechanisms that need what the campaign does not hold.
    """

    mechanisms: tuple[str, ...]
    limits: dict[str, float]
    units: dict[str, str]
    plausible: dict[str, tuple[float, float]]
    inseparable: tuple[tuple[str, str, float], ...]
    untestable: tuple[dict[str, str], ...]

    def __repr__(self) -> str:
        rows = []
        for name in self.mechanisms:
            unit = "" if self.units[name] == "-" else f" {self.units[name]}"
            low, high = (number(value) for value in self.plausible[name])
            rows.append((name, f"found from {number(self.limits[name], 2)}{unit} on; plausible {low} to {high}"))
        title = f"Power: {len(rows)} mechanisms can be seen, {len(self.untestable)} cannot"
        return table(f"{title}, {len(self.inseparable)} pairs look alike", rows)

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


def power_of(found: Screen, missing: Sequence[dict[str, str]]) -> Power:
    """Detection limits and inseparable pairs of what was screened; residuals play no part."""
    both, strength = found.similarity, found.information
    limits, units, plausible = {}, {}, {}
    members: dict[str, list[int]] = {}
    for k, candidate in enumerate(found.candidates):
        if strength[k] > 0:
            members.setdefault(candidate.mechanism, []).append(k)
    for name, ks in members.items():
        # The first formula is the common one; the limit is that of the family's first formula that leaves a trace.
        variant = found.candidates[ks[0]].variant
        limits[name] = float(DETECTABLE / np.sqrt(strength[ks[0]]) * variant.plausible[0])
        units[name] = variant.unit
        plausible[name] = variant.plausible
    alike = []
    names = list(members)
    for a, one in enumerate(names):
        for other in names[a + 1 :]:
            block = both[np.ix_(members[one], members[other])]
            product = found.signs[members[one]][:, None] * found.signs[members[other]][None]
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
    diameters_um = arguments.diameters(diameters_um)
    peaks_mN = np.atleast_1d(arguments.floats(peaks_mN, "peaks_mN", shape="the largest force of each, shape (N,)"))
    arguments.same_length(diameters_um=diameters_um, peaks_mN=peaks_mN)
    arguments.positive(peaks_mN, "peaks_mN")
    flat = eqx.filter_vmap(lambda particle: particle.flatness)(particle_batch(diameters_um))
    latent = particle_means(base.state.population, flat, base.model.shape_power)
    planned = _expected(base, plan, np.asarray(diameters_um, float), peaks_mN, latent, np.ones(len(diameters_um)))
    return power_of(*screened(planned, library))


def power_of_campaign(
    campaign: Campaign,
    *,
    library: Mapping[str, Mechanism] = LIBRARY,
    model: Model | None = None,
    threshold_MPa: float = 0.0,
    progress: Progress | None = None,
) -> Power:
    """What a campaign can show: one that was simulated as planned, noise included, or one that was measured.

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
    progress, assumed, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    base = base_fit(campaign, without_effects(assumed), threshold_MPa=threshold_MPa, progress=progress)
    progress("signatures of all effects")
    return power_of(*screened(base, library))


def without_effects(model: Model) -> Model:
    """The model without effects, its modulus free to scatter."""
    return replace(model, modulus_scatter=True, effects=(), varying=(), robust=False)


def screened(base: Base, library: Mapping[str, Mechanism]) -> tuple[Screen, Sequence[dict[str, str]]]:
    """All formulas that the campaign can be searched for, to first order, and what the others need."""
    testable, missing = untestable(library, available_data(base.campaign))
    return first_order(base, library, testable), missing
