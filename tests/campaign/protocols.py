"""Made-up tests with known segments: any number of cycles, holds, pauses, sampling, noise, rounding, offsets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mcc_jax.campaign import Curve


@dataclass(frozen=True)
class Protocol:
    """A made-up test and the truth about it: kinds, the first sample of each, and how sharp each boundary can be."""

    curve: Curve
    kinds: list[str]
    starts: list[int]
    tolerances: list[float]
    control: str


def make_protocol(
    seed: int,
    *,
    cycles: int,
    noise: float,
    control: str = "load",
    resolution: float = 0.0,
    holds: bool = True,
    approach: bool = True,
    gaps: bool = False,
    ramp: tuple[int, int] = (40, 120),
) -> Protocol:
    """Random turning levels and lengths; ramps are at least a quarter of the range deep."""
    rng = np.random.default_rng(seed)
    pieces: list[tuple[str, np.ndarray, np.ndarray, float]] = []  # kind, drive, creep or relaxation, pace of the drive

    def go(kind: str, start: float, stop: float) -> None:
        steps = int(rng.integers(*ramp))
        drive = start + (stop - start) * np.arange(1, steps + 1) / steps
        pieces.append((kind, drive, np.zeros(steps), abs(stop - start) / steps))

    def hold(level: float) -> None:
        count = int(rng.integers(1, 4) * dwell) + 12
        creep = 0.02 * np.log1p(20 * np.arange(1, count + 1) / count) / np.log(21.0)
        pieces.append(("hold", np.full(count, level), creep, 0.0))

    # A hold must outlast what the noise blurs: `dwell` bands on the slowest ramp that is possible here.
    width = max(0.0025, 4 * np.hypot(noise, resolution / 2))
    slowest = (0.25 if control == "load" else 0.09) / ramp[1]
    dwell = 8 * width / slowest
    waits = int(rng.integers(1, 4) * 12 * width / slowest + 30) if approach else 0
    if approach:
        pieces.append(("approach", np.zeros(waits), np.zeros(waits), 0.0))
    bottom, peak = 0.0, 0.0
    for cycle in range(cycles):
        last = cycle == cycles - 1
        lowest = max(bottom + 0.25, 0.4) if control == "load" else max(0.95 * peak, 0.7)
        top = 1.0 if last else rng.uniform(lowest, 1.0)
        if cycle and top <= peak + 6 * width:
            top = peak
        go("load", bottom, top)
        peak = max(peak, top)
        if holds and rng.random() < 0.6:
            hold(top)
        if control == "load":
            bottom = rng.uniform(0.0, top - 0.25)
        else:  # never out of contact: the force is zero at three quarters of the peak
            bottom = 0.75 * peak + (top - 0.75 * peak) * rng.uniform(0.05, 0.3)
        go("unload", top, bottom)
        if holds and bottom > 0.1 and not last and rng.random() < 0.3:
            hold(bottom)
    kinds, drive, creep, rates = (list(column) for column in zip(*pieces, strict=True))
    if control == "displacement":
        # What relaxed in a hold comes back on the ramp that follows.
        for i in range(1, len(kinds)):
            if kinds[i - 1] == "hold":
                creep[i] = np.linspace(creep[i - 1][-1], 0.0, len(creep[i]))
        slip = np.concatenate(creep)
    else:
        slip = np.cumsum(np.concatenate([np.diff(s, prepend=0.0) for s in creep]))
    signal = np.concatenate(drive)
    count = len(signal)
    time = np.cumsum(rng.uniform(0.5, 1.5, count))
    if gaps:
        time += np.cumsum(np.where(rng.random(count) < 0.01, 300.0, 0.0))
    away = np.concatenate([-np.linspace(0.3, 0.0, waits), np.zeros(count - waits)])
    highest = np.maximum.accumulate(signal)
    if control == "load":
        force = signal
        displacement = 0.9 * highest**0.7 - 0.15 * (highest - signal) ** 0.9 + slip + away
    else:  # elastic unloading, four times steeper
        elastic = (signal - 0.75 * highest) / np.where(highest > 0, 0.25 * highest, 1.0)
        force, displacement = highest * np.clip(elastic, -0.02, 1) - slip, signal + away
    starts = np.cumsum([0, *(len(d) for d in drive)]).tolist()
    kinds, starts, rates = _virgin(kinds, starts, rates, force, 3 * width * np.ptp(force))
    force, displacement = (_measure(rng, x, noise, resolution) for x in (force, displacement))
    tolerances = [0.0, *(_tolerance(rates[i - 1], rates[i], width, kinds[i]) for i in range(1, len(kinds)))]
    curve = Curve(time, 300.0 * force + rng.uniform(-20, 20), 80.0 * displacement + rng.uniform(-30, 30))
    return Protocol(curve, kinds, starts, tolerances, control)


def _virgin(
    kinds: list[str], starts: list[int], rates: list[float], force: np.ndarray, clear: float
) -> tuple[list[str], list[int], list[float]]:
    """Name as reload what does not exceed the force reached before, cutting where it does."""
    found: list[tuple[str, int, float]] = []
    reached, unloaded = -np.inf, False
    for kind, rate, a, b in zip(kinds, rates, starts, starts[1:], strict=False):
        part = force[a:b]
        if kind == "load" and unloaded:
            found.append(("reload", a, rate))
            cut = int(np.argmax(part > reached)) if part.max() > reached + clear else len(part)
            if cut < len(part) - 1:
                found.append(("load", a + cut, rate))
        else:
            found.append((kind, a, rate))
        unloaded = unloaded or kind == "unload"
        reached = max(reached, part.max())
    new_kinds, new_starts, new_rates = (list(column) for column in zip(*found, strict=True))
    return new_kinds, new_starts, new_rates


def _measure(rng: np.random.Generator, values: np.ndarray, noise: float, resolution: float) -> np.ndarray:
    span = np.ptp(values)
    measured = values + noise * span * rng.standard_normal(len(values))
    return np.round(measured / (resolution * span)) * resolution * span if resolution else measured


def _tolerance(before: float, after: float, width: float, kind: str) -> float:
    """Samples by which a boundary may be off: what one band (four noise deviations) is on the slower ramp."""
    slow = min(rate for rate in (before, after) if rate > 0)
    return 4.0 + (3.0 if kind == "load" else 2.0) * width / slow
