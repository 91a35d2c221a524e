"""What a planned campaign could show before it is measured, and which further tests would show more."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr

from .._format import number, table
from .._types import Progress
from ..calibrate import Model
from ..calibrate.data import select
from ..calibrate.estimates import finite
from ..calibrate.fitting import checked_settings
from ..calibrate.forward import Point
from ..campaign import Campaign, Metadata, available_data, check_campaign
from ..effects import LIBRARY, Mechanism
from ..simulate import Programme, simulate_campaign
from .base import Base, State, base_fit
from .screen import Screen, first_order, untestable
from .search import Search
from .settings import DECISIONS, DETECTABLE, ENOUGH

ALIKE = 0.9  # correlation of projected signatures from which on two mechanisms look alike

COPIES = 0.5, 1, 2, 3, 5, 10  # further particles that are tried, over those of the campaign
MOST_PARTICLES = 200  # further ones, at most
TURNS = 16  # points that turning points may add to a programme's own
EVEN = 0.5  # the least power with which a test is proposed: particles are too dear for less than an even chance


@dataclass(frozen=True)
class Power:
    """What a planned campaign can show.

    Attributes:
        mechanisms: of each, as in `power.json`, the smallest amplitude of its most visible formula that is found with
            95 % probability (`detection_limit`), its `unit`, and the `plausible` range.
        inseparable: pairs whose projected signatures are so alike that these data cannot separate them.
        untestable: mechanisms that need what the campaign does not hold.
    """

    mechanisms: tuple[dict[str, Any], ...]
    inseparable: tuple[dict[str, Any], ...]
    untestable: tuple[dict[str, str], ...]

    def __repr__(self) -> str:
        rows = []
        for one in self.mechanisms:
            limit, (low, high) = number(one["detection_limit"], 2), map(number, one["plausible"])
            unit = "" if one["unit"] == "-" else f" {one['unit']}"
            rows.append((one["mechanism"], f"found from {limit}{unit} on; plausible {low} to {high}"))
        title = f"Power: {len(rows)} mechanisms can be seen, {len(self.untestable)} cannot"
        return table(f"{title}, {len(self.inseparable)} pairs look alike", rows)

    def to_json(self) -> dict[str, Any]:
        """The contents of `power.json`."""
        return {"schema": 1, **{name: list(entries) for name, entries in vars(self).items()}}


def power_of_campaign(
    campaign: Campaign,
    *,
    library: Mapping[str, Mechanism] = LIBRARY,
    model: Model | None = None,
    threshold_MPa: float = 0.0,
    progress: Progress | None = None,
) -> Power:
    """What a campaign can show: one that was simulated as planned, noise included, or one that was measured.

    Detection limits and inseparable pairs are to first order; residuals play no part. Args are those of `discover`.
    Raises `InputError` if no particle can be used.
    """
    check_campaign(campaign)
    progress, assumed, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    base = base_fit(campaign, without_effects(assumed), threshold_MPa=threshold_MPa, progress=progress)
    progress("signatures of all effects")
    testable, missing = untestable(library, available_data(base.campaign))
    found = first_order(base, library, testable)
    candidates, strength = found.candidates, found.information
    rows = {name: np.flatnonzero((candidates.mechanisms == name) & (strength > 0)) for name in testable}
    rows = {name: ks for name, ks in rows.items() if len(ks)}
    entries = []
    for name, ks in rows.items():
        # The first formula is the common one; the limit is that of the family's first formula that leaves a trace.
        variant = candidates.each[ks[0]].variant
        limit, most = float(DETECTABLE / np.sqrt(strength[ks[0]]) * variant.plausible[0]), variant.plausible[1]
        entry = {"mechanism": name, "detection_limit": finite(limit), "unit": variant.unit}
        entries.append(entry | {"plausible": [float(v) for v in variant.plausible], "visible": bool(limit <= most)})
    sign = np.outer(candidates.signs, candidates.signs)
    alike = np.where(sign == 0, np.abs(found.similarity), found.similarity * sign)
    pairs = []
    for one, other in itertools.combinations(rows, 2):
        similarity = float(np.max(alike[np.ix_(rows[one], rows[other])]))
        if similarity >= ALIKE:
            pairs.append({"pair": [one, other], "similarity": similarity})
    pairs.sort(key=lambda one: -one["similarity"])
    return Power(tuple(entries), tuple(pairs), tuple(missing))


def without_effects(model: Model) -> Model:
    """The model without effects, its modulus free to scatter."""
    return replace(model, modulus_scatter=True, effects=(), varying=(), robust=False)


def menu(points: int) -> dict[str, tuple[Programme, ...]]:
    """Further tests that every instrument can do, of about so many points: what to do, and programmes taken in turn."""
    cycles: dict[str, Any] = {"levels": (0.5, 1.0, 1.0), "unload_to": 0.3, "hold_s": 60.0, "points": points}
    one, fast = Programme.cycles(**cycles), Programme.cycles(rate=20.0, **cycles)
    return {
        "a hold of 60 s at the largest load": (Programme.cycles(hold_s=60.0, points=points),),
        "a cycle at half load, a hold of 60 s at the largest load, and a reload": (one,),
        "two loading rates, every second particle ten times faster, with a cycle and a hold": (one, fast),
    }


def planned(base: Base, programmes: Sequence[Programme]) -> Base:
    """A base fit as if the same particles had been tested by a plan, with the same noise and nothing missing."""
    diameters, peaks = base.campaign.diameters_um[list(base.selection.kept)], np.max(np.asarray(base.tests.force), 1)
    latent = base.state.point.latent
    laws = eqx.filter_vmap(lambda w: base.model.forms.law(w, jnp.zeros(0)))(latent)
    parts = [simulate_campaign(laws, diameters, peaks, programme) for programme in programmes]
    curves = tuple(parts[i % len(parts)].curves[i] for i in range(len(diameters)))
    campaign = Campaign(parts[0].particles, parts[0].diameters_um, curves, {}, Metadata(control="load"))
    selection = select(campaign, threshold_MPa=base.threshold_MPa)
    kept = np.asarray(selection.kept)
    state = State(Point(latent[kept], jnp.zeros(len(kept)), jnp.zeros((len(kept), 0))), base.state.population)
    rest: dict[str, Any] = {"tests": selection.tests, "scale": base.scale[kept], "rms_um": np.zeros(len(kept))}
    return replace(base, campaign=campaign, selection=selection, state=state, **rest)


def next_experiments(search: Search, names: tuple[str, ...]) -> list[dict[str, Any]]:
    """Further tests by the probability that with them the right one of several names is left alone, best first.

    Each name is taken for true in turn, as it was fitted. The log Bayes factor over a rival, whose amplitude is fitted
    again, is normal with mean m/2 and variance m, m the squared signature that the rival's leaves; these tests and the
    further ones add up. `power` is the probability, for the worst rival, that it exceeds the odds a single name needs.
    """
    members = [n for n in names if n in search.shared and search.found[(n,)].at is not None]
    if len(members) < 2:
        return []
    base = search.base
    options = [("more particles, tested in the same way", search.screen, len(base.tests))]
    library = {name: search.library[name] for name in members}
    for text, programmes in menu(max(base.tests.force.shape[1] - TURNS, 32)).items():
        other = planned(base, programmes)
        options.append((text, first_order(other, library, library), len(other.tests)))
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
    each = search.screen.candidates.each
    at: dict[str, int] = {}
    amplitude: dict[str, float] = {}
    for name in members:
        best = search.found[(name,)].fitted
        variant = best.variants[0]
        rows = [k for k, c in enumerate(each) if c.variant == variant]
        candidate = each[max(rows, key=lambda k: search.screen.information[k])]
        if candidate not in other.candidates.each:
            return 0.0
        at[name] = other.candidates.each.index(candidate)
        amplitude[name] = float(best.theta[0]) / variant.plausible[0]
    worst = 1.0
    for name, rival in itertools.permutations(members, 2):
        lead = search.found[(name,)].log_evidence - search.found[(rival,)].log_evidence
        rows = [at[name], at[rival]]
        (own, both), (_, its) = copies * other.gram[0][np.ix_(rows, rows)]
        squares = float(amplitude[name] ** 2 * max(own - both**2 / max(its, 1e-300), 0.0))
        worst = min(worst, float(ndtr((squares / 2 + lead - needed) / np.sqrt(max(squares, 1e-12)))))
    return worst
