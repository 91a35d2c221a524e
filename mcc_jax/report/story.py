"""The first screen: what was found in one sentence, the test that shows it best, and the numbers that matter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._format import listed, number, percent, plain, probability, with_sd
from ..calibrate.curves import FittedCurve
from ..discovery import Discovery
from ..discovery.sentences import headline
from ..plots.style import is_simulated
from .pictures import Example, example_pictures
from .read import Results
from .sentences import quantity, simulated


@dataclass(frozen=True)
class Story:
    """The top of the page.

    Attributes:
        verdict: the answer in one sentence.
        pictures: of the most telling particle: source, and in words what it shows.
        caption: what all of them show.
        tiles: a heading, an answer and a line of meaning each.
    """

    verdict: str
    pictures: list[tuple[str, str]]
    caption: str
    tiles: list[tuple[str, str, str]]


def story(results: Results, shown: Sequence[FittedCurve]) -> Story:
    """The first screen of what a folder holds."""
    found = results.discovery
    if found is not None:
        example = most_informative_test(results.found) if results.found is not None else None
        example = example or _of_fit(shown)
        tests = "simulated tests" if simulated(results) else "tests"
        return Story(headline(found, tests), *_drawn(example), _gap_tiles(found))
    if results.calibration is not None:
        content = results.calibration
        used = sum(entry["kept"] for entry in content["particles"])
        state = f"The law was calibrated on {used} of {len(content['particles'])} particles"
        verdict = f"{state}." if content["converged"] else f"{state}; the calibration did not converge."
        return Story(verdict, *_drawn(_of_fit(shown)), [])
    count = 0 if results.campaign is None else len(results.campaign)
    return Story(f"{count} particles were measured; nothing has been calibrated on them yet.", [], "", [])


def _drawn(example: Example | None) -> tuple[list[tuple[str, str]], str]:
    return ([], "") if example is None else (example_pictures(example), example.caption)


def most_informative_test(found: Discovery) -> Example | None:
    """The test whose gap closes most, or where nothing was added the one that the law fits worst."""
    left, base = found.residuals, found.base
    if left is None or base is None:
        return None
    added = bool(found.effects) or found.closure is not None
    before, after, source = left.before, left.after, ""
    name = listed([plain(effect.mechanism) for effect in found.effects]) if found.effects else "the formula found"
    if added and found.held_out is not None and found.held_out.residual_um is not None:
        before, after = found.held_out.residual_um[0], found.held_out.residual_um[-1]
        source = (
            f" Here {name} is as estimated from the other particles; only what belongs to each particle (curve of "
            "loading, modulus, zero) is fitted to its test."
        )
    count = np.maximum(left.used.sum(1), 1)
    rms = [np.sqrt(np.sum(np.where(left.used, one, 0.0) ** 2, axis=1) / count) for one in (before, after)]
    j = int(np.argmax(rms[0] - rms[1] if added else rms[0]))
    i, rows = base.selection.kept[j], base.selection.rows[j]
    curve, used = base.campaign.curves[i], left.used[j, : len(rows)]
    rows = np.asarray(rows)[used]
    off, which = f"{number(float(rms[0][j]), 2)} µm", "fits worst"
    if added:
        middle = [f"{number(float(np.median(one)), 2)} µm" for one in rms]
        off += f" before and {number(float(rms[1][j]), 2)} µm after {name} was added"
        off += f" (median of all: {middle[0]} and {middle[1]})"
        which = "gains most"
    shown = f"particle {base.campaign.particles[i]}, which of {len(before)} particles {which}"
    caption = f"Shown: {shown}. On average the law is off by {off}.{source}"
    columns = (column[j, : len(used)][used] for column in (before, after, left.noise))
    one, two, noise = columns
    return Example(
        curve.time_s[rows], curve.force_mN[rows], curve.displacement_um[rows], one, two if added else None, noise,
        f"law with {name}" if added else "", caption, is_simulated(base.campaign.metadata),
    )  # fmt: skip


def _of_fit(shown: Sequence[FittedCurve]) -> Example | None:
    """The calibrated test that the law misses most."""
    known = [one for one in shown if one.rms_um is not None]
    if not known:
        return None
    one = max(known, key=lambda one: one.rms_um or 0.0)
    use = one.used
    caption = (
        f"Particle {one.name} with its own curve of loading: of all particles the one that the law misses most, by "
        f"{number(one.rms_um, 2)} µm on average."
    )
    away = one.displacement_um - one.own_um
    return Example(
        one.time_s[use], one.force_mN[use], one.displacement_um[use], away[use], None, None, "", caption
    )  # fmt: skip


def _gap_tiles(found: dict[str, Any]) -> list[tuple[str, str, str]]:
    """The share of the gap that is closed, what it did to the modulus, and the amplitude."""
    tiles = []
    gap = found["gap"]
    if gap["closed_fraction"] is not None:
        before, after = (number(gap["steps"][i]["chi2_per_dof"], 3) for i in (0, -1))
        meaning = (
            "of what the law alone missed on particles that were held out, each predicted from others: χ² "
            f"per point (misfit in units of the noise) falls from {before} to {after}; 1 is noise alone."
        )
        tiles.append(("Gap closed", percent(gap["closed_fraction"], 3), meaning))
    sides = found["parameters_before"], found["parameters_after"]
    pair = [side.get("modulus_at_peaks_MPa", side.get("effective_modulus_MPa")) for side in sides]
    if all(one is not None and one["value"] is not None for one in pair) and found["parameters_after"]:
        before, after = pair
        change = 100 * (after["value"] / before["value"] - 1)
        way = "higher" if change > 0 else "lower"
        meaning = (
            f"at the peaks of these tests; {number(abs(change), 2)} % {way} than by the law alone, which gives "
            f"{with_sd(before, 1e-3)} GPa."
        )
        tiles.append(("Effective modulus", f"{with_sd(after, 1e-3)} GPa", meaning))
    for effect in found["effects"]:
        parameters = list(effect["parameters"].items())
        if not parameters:
            continue
        (name, first), *others = parameters
        more = "".join(f"; {quantity(other)} {with_sd(value)}" for other, value in others)
        meaning = (
            f"{quantity(name)}, ± one standard deviation{more}. That it is this one, of {len(found['ranking'])} "
            f"effects that these tests could show, has probability {probability(effect['probability'])}."
        )
        tiles.append((plain(effect["mechanism"]).capitalize(), with_sd(first), meaning))
    if found["verdict"] == "NO_GAP":
        chance = found.get("p_anything_missing")
        meaning = "that tests of a law that lacks nothing disagree with it at least so much."
        if chance is not None:
            tiles.append(("Disagreement by chance", f"probability {probability(chance)}", meaning))
        seen = [e for e in found["ranking"] if e["detection_limit"] is not None][:3]
        if seen:
            names = "; ".join(
                f"{plain(e['mechanism'])} from {number(e['detection_limit'], 2)}"
                f"{'' if e['unit'] == '-' else ' ' + e['unit'].replace('um', 'µm')}"
                for e in seen
            )
            tiles.append(("What would have shown", f"{len(found['ranking'])} effects", f"For example {names}."))
    return tiles
