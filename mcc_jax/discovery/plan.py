"""What a planned campaign could show before it is measured, and which further tests would show more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr

from .. import arguments
from .._errors import InputError
from .._format import described, number, table
from .._types import Progress
from ..calibrate import Model
from ..calibrate.data import select
from ..calibrate.estimates import finite
from ..calibrate.fitting import checked_settings
from ..calibrate.forward import Point
from ..campaign import Campaign, Metadata, available_data, check_campaign, particle_batch
from ..effects import LIBRARY, Mechanism
from ..simulate import Programme, simulate_campaign
from .base import Base, State, base_fit
from .design import particle_means
from .screen import Screen, first_order, untestable
from .search import Search
from .settings import DECISIONS, DETECTABLE, ENOUGH

ALIKE = 0.9  # correlation of projected signatures from which on two mechanisms look alike

COPIES = 0.5, 1, 2, 3, 5, 10  # further particles that are tried, over those of the campaign
MOST_PARTICLES = 200  # further ones, at most
TURNS = 16  # points that turning points may add to a programme's own
EVEN = 0.5  # the least power with which a test is proposed: particles are too dear for less than an even chance


@dataclass(frozen=True)
class Plan:
    """A test programme, perhaps another one for every second particle.

    Attributes:
        name: what to do, in words.
        programmes: taken in turn by the particles.

    Raises:
        InputError: if there is none.
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


def _expected(base: Base, plan: Plan, diameters: np.ndarray, peaks: np.ndarray, latent: Any, scale: Any) -> Base:
    """The base of a campaign by a plan, of particles with these numbers, without noise or any missing effect."""
    latent = jnp.asarray(latent)
    laws = eqx.filter_vmap(lambda w: base.forms.law(w, jnp.zeros(0)))(latent)
    parts = [simulate_campaign(laws, diameters, peaks, programme) for programme in plan.programmes]
    curves = tuple(parts[i % len(parts)].curves[i] for i in range(len(diameters)))
    campaign = Campaign(parts[0].particles, parts[0].diameters_um, curves, {}, Metadata(control="load"))
    selection = select(campaign, threshold_MPa=base.threshold_MPa)
    kept, zeros = np.asarray(selection.kept), np.zeros(len(selection.kept))
    point = Point(latent[kept], jnp.asarray(zeros), jnp.zeros((len(kept), 0)))
    return replace(
        base,
        campaign=campaign,
        selection=selection,
        tests=selection.tests,
        scale=np.asarray(scale)[kept],
        state=State(point, base.state.population),
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


def power(
    diameters_um: Any, peaks_mN: Any, plan: Plan, *, base: Base, library: Mapping[str, Mechanism] = LIBRARY
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
    flatness = eqx.filter_vmap(lambda particle: particle.flatness)(particle_batch(diameters_um))
    latent, _ = particle_means(base.state.population, flatness, base.model.shape_power)
    planned = _expected(base, plan, np.asarray(diameters_um, float), peaks_mN, latent, np.ones(len(diameters_um)))
    return _power_at(planned, library)


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
    return _power_at(base, library)


def without_effects(model: Model) -> Model:
    """The model without effects, its modulus free to scatter."""
    return replace(model, modulus_scatter=True, effects=(), varying=(), robust=False)


def _power_at(base: Base, library: Mapping[str, Mechanism]) -> Power:
    """Detection limits and inseparable pairs, to first order; residuals play no part."""
    testable, missing = untestable(library, available_data(base.campaign))
    found = first_order(base, library, testable)
    candidates, strength = found.candidates, found.information
    members = {name: np.flatnonzero((candidates.mechanisms == name) & (strength > 0)) for name in testable}
    members = {name: ks for name, ks in members.items() if len(ks)}
    # The first formula is the common one; the limit is that of the family's first formula that leaves a trace.
    firsts = {name: (ks[0], candidates.each[ks[0]].variant) for name, ks in members.items()}
    sign = np.outer(candidates.signs, candidates.signs)
    alike = np.where(sign == 0, np.abs(found.similarity), found.similarity * sign)
    names = list(members)
    pairs = [
        (one, other, float(np.max(alike[np.ix_(members[one], members[other])])))
        for a, one in enumerate(names)
        for other in names[a + 1 :]
    ]
    return Power(
        mechanisms=tuple(names),
        limits={n: float(DETECTABLE / np.sqrt(strength[k]) * v.plausible[0]) for n, (k, v) in firsts.items()},
        units={name: variant.unit for name, (_, variant) in firsts.items()},
        plausible={name: variant.plausible for name, (_, variant) in firsts.items()},
        inseparable=tuple(sorted((pair for pair in pairs if pair[2] >= ALIKE), key=lambda pair: -pair[2])),
        untestable=tuple(missing),
    )


def menu(points: int) -> tuple[Plan, ...]:
    """Further tests that every instrument can do, sampled into about so many points."""
    cycles: dict[str, Any] = {"levels": (0.5, 1.0, 1.0), "unload_to": 0.3, "hold_s": 60.0, "points": points}
    return (
        Plan("a hold of 60 s at the largest load", (Programme.cycles(hold_s=60.0, points=points),)),
        Plan("a cycle at half load, a hold of 60 s at the largest load, and a reload", (Programme.cycles(**cycles),)),
        Plan(
            "two loading rates, every second particle ten times faster, with a cycle and a hold",
            (Programme.cycles(**cycles), Programme.cycles(rate=20.0, **cycles)),
        ),
    )


def next_experiments(search: Search, names: tuple[str, ...]) -> list[dict[str, Any]]:
    """Further tests by the probability that with them the right one of several names is left alone, best first.

    Each name is taken for true in turn, in the formula and as large as it was fitted. The log Bayes factor of the true
    one over a rival, whose amplitude is fitted again, is normal with mean m/2 and variance m, m the squared signature
    that the rival's leaves; these tests and the further ones add up. `power` is the probability that it exceeds the
    odds which a single name needs, for the rival that is worst.
    """
    members = [n for n in names if n in search.shared and search.found[(n,)].at is not None]
    if len(members) < 2:
        return []
    base = search.base
    options = [("more particles, tested in the same way", search.screen, len(base.tests))]
    library = {name: search.library[name] for name in members}
    for plan in menu(max(base.tests.force.shape[1] - TURNS, 32)):
        planned = planned_base(base, plan)
        options.append((plan.name, first_order(planned, library, library), len(planned.tests)))
    found = []
    for text, other, count in options:
        tried = [n for n in (round(c * count) for c in COPIES) if 0 < n <= MOST_PARTICLES] or [count]
        powers = [_separation(search, members, other, n / count) for n in tried]
        k = next((k for k, p in enumerate(powers) if p >= ENOUGH), len(tried) - 1)
        if powers[k] >= EVEN:
            found.append({"experiment": text, "separates": members, "particles": tried[k], "power": powers[k]})
    return sorted(found, key=lambda one: (-min(one["power"], ENOUGH), one["particles"]))


def _separation(search: Search, members: Sequence[str], other: Screen, copies: float) -> float:
    """Least probability over the true names that further tests leave it alone."""
    needed = np.log(DECISIONS.set_mass / (1 - DECISIONS.set_mass))
    at: dict[str, int] = {}
    amplitude: dict[str, float] = {}
    for name in members:
        best = search.found[(name,)].at
        assert best is not None
        variant = best.variants[0]
        rows = [k for k, c in enumerate(search.screen.candidates.each) if c.variant == variant]
        candidate = search.screen.candidates.each[max(rows, key=lambda k: search.screen.information[k])]
        if candidate not in other.candidates.each:
            return 0.0
        at[name] = other.candidates.each.index(candidate)
        amplitude[name] = float(best.theta[0]) / variant.plausible[0]
    worst = 1.0
    for name in members:
        for rival in members:
            if rival != name:
                lead = search.found[(name,)].log_evidence - search.found[(rival,)].log_evidence
                rows = [at[name], at[rival]]
                (own, both), (_, its) = copies * other.gram[0][np.ix_(rows, rows)]
                squares = float(amplitude[name] ** 2 * max(own - both**2 / max(its, 1e-300), 0.0))
                worst = min(worst, float(ndtr((squares / 2 + lead - needed) / np.sqrt(max(squares, 1e-12)))))
    return worst
