"""From a case to a campaign: particles, strengths, noise, files, and the answer."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from . import noise as noise_
from .noise import Noise, Readings
from .plan import Case
from .settings import SETTINGS, Drawing
from .strength import Projection, Refit, amplitude_for, cosine, resemblances
from .world import World, generators

FILES = ("particles.csv", "curves.csv", "campaign.toml")
TOLD = 3
"""How many of the most similar mechanisms an answer names."""


@dataclass(frozen=True)
class Made:
    """A campaign, its answer, and at every reading what of the effect no base law takes up, and the effect, um."""

    world: World
    readings: Readings
    answer: dict[str, Any]
    left_um: np.ndarray
    effect_um: np.ndarray


def drawn(case: Case, master: int, attempt: int) -> tuple[np.random.Generator, World, Noise]:
    """The campaign of an attempt before any strength is known, its noise, and the random numbers that follow."""
    rng = case.rng(master, attempt)
    generator = generators()[case.generator]
    if case.effects and attempt:  # more particles show more
        sizes = sorted(set(SETTINGS.drawing.particles))
        more = sizes[min(sizes.index(case.particles) + 2 * attempt, len(sizes) - 1)]
        case = replace(case, particles=more)
    if case.kind == "pair" and attempt:  # another formula may reach what the first cannot
        case = replace(case, effects=tuple((m, _next(generator, m, f, attempt), v) for m, f, v in case.effects))
    world = generator.draw(rng, case)
    return rng, world, noise_.draw(rng, case.noise, world.count)


def _next(generator: ModuleType, mechanism: str, formula: str, steps: int) -> str:
    """The formula so many places further among those of its mechanism."""
    known = generator.formulas(mechanism)
    return known[(known.index(formula) + steps) % len(known)]


def make(case: Case, master: int, drawing: Drawing = SETTINGS.drawing) -> Made:
    """Make a case; drawn again while a loading curve snaps through, or the effect cannot reach its strength."""
    attempt = -1
    for attempt in range(drawing.attempts):
        rng, world, noise = drawn(case, master, attempt)
        projection = Projection(world, noise, case.noise) if case.effects else None
        sized = [_sized(projection, k, case, drawing) for k in range(len(case.effects))] if projection else []
        hidden = [(h, theta) for h, (theta, *_) in zip(world.hidden, sized, strict=True)]
        curves = world.curves(hidden, None)
        weak = any(found.strength < drawing.reached * target for _, found, target, _ in sized)
        snaps = bool(hidden) and "pop_in" not in [m for m, *_ in case.effects] and _snaps(world, curves, drawing)
        if not snaps and (not weak or attempt + 1 >= drawing.weak_attempts):
            break
    answer: dict[str, Any] = {"case": case.record(), "master": master, "attempt": attempt, "snaps": snaps}
    answer |= {"truth": world.truth, "noise": noise.record(), "points": len(world.force), "particles": world.count}
    answer["effects"] = [
        {
            "mechanism": h.mechanism, "formula": h.formula, "equation": h.equation, "amplitude": theta, "unit": h.unit,
            "lambda": found.strength, "lambda_target": target, **more,
        }
        for h, (theta, found, target, more) in zip(world.hidden, sized, strict=True)
    ]  # fmt: skip
    left = np.zeros(len(world.force))
    if len(sized) == 1:
        left = sized[0][1].left_um
    elif len(sized) == 2:
        answer["correlation"] = cosine(sized[0][1].white, sized[1][1].white)
        left = projection.refit(curves).left_um
    on_displacement, on_force = noise_.sample(rng, noise, world)
    readings = Readings(world.owner, world.time, world.force + on_force, curves + on_displacement)
    if case.fault:
        readings, told = noise_.with_fault(rng, case.fault, world, readings)
        answer["fault"] = {"kind": case.fault, **told}
    if not np.all(np.isfinite(readings.displacement)):
        raise ArithmeticError(f"a curve that is not finite in {case}")
    return Made(world, readings, answer, left, curves - world.base)


def _sized(
    projection: Projection, place: int, case: Case, drawing: Drawing
) -> tuple[float, Refit, float, dict[str, Any]]:
    """Amplitude, base law refitted, the lambda aimed at, and which listed mechanisms are most alike."""
    hidden, target = projection.world.hidden[place], case.effects[place][2]
    theta, found = amplitude_for(projection, hidden, target)
    if case.kind == "pair":
        return float(theta), found, target, {}
    alike = resemblances(projection, found.white, hidden.mechanism)
    share = np.sqrt(max(1.0 - alike[0][2] ** 2, 1e-6)) if alike else 1.0
    if case.kind == "unlisted":
        target = float(min(drawing.largest_unlisted, target / share))
        theta, found = amplitude_for(projection, hidden, target)
        alike = resemblances(projection, found.white)
        share = np.sqrt(max(1.0 - alike[0][2] ** 2, 1e-6)) if alike else 1.0
    told = [{"mechanism": m, "formula": f, "correlation": rho} for m, f, rho in alike[:TOLD]]
    return float(theta), found, target, {"alike": told, "lambda_residual": found.strength * float(share)}


def _snaps(world: World, curves: np.ndarray, drawing: Drawing) -> bool:
    """Whether a curve jumps between two readings, far beyond any step of the base law."""
    for i, s in enumerate(world.slices):
        usual = np.abs(np.diff(world.base[s])).max()
        step = np.abs(np.diff(curves[s])).max()
        if step > drawing.snap_ratio * usual and step > drawing.snap_strain * world.diameter[i]:
            return True
    return False


def write(made: Made, folder: Path) -> None:
    """Write the campaign's three files."""
    folder.mkdir(parents=True, exist_ok=True)
    columns, readings = made.world.columns, made.readings
    rows = [
        ",".join([str(i + 1), *(f"{column[i]:.10g}" for column in columns.values())]) for i in range(made.world.count)
    ]
    (folder / FILES[0]).write_text("\n".join([",".join(["particle", *columns]), *rows]) + "\n")
    values = zip(readings.owner, readings.time, readings.force, readings.displacement, strict=True)
    lines = [f"{i + 1},{t:.4f},{F:.5f},{g:.5f}" for i, t, F, g in values]
    (folder / FILES[1]).write_text("\n".join(["particle,time_s,force_mN,displacement_um", *lines]) + "\n")
    (folder / FILES[2]).write_text(
        'control = "load"\nprovenance = "synthetic"\ncorrections = []\npunch_diameter_um = 500.0\n'
        "force_resolution_mN = 0.00001\ndisplacement_resolution_um = 0.00001\n"
    )


def digest_of(folder: Path) -> str:
    """SHA-256 of a campaign's three files."""
    digest = hashlib.sha256()
    for name in FILES:
        digest.update((folder / name).read_bytes())
    return digest.hexdigest()
