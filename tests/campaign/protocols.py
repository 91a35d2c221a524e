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
    drive: list[np.ndarray] = []
    creep: list[np.ndarray] = []
    kinds: list[str] = []
    rates: list[float] = []
    level, peak = 0.0, 0.0

    def add(kind: str, values: np.ndarray, slip: np.ndarray, rate: float) -> None:
        drive.append(values)
        creep.append(slip)
        kinds.append(kind)
        rates.append(rate)

    def hold(least: float) -> None:
        count = int(rng.integers(1, 4) * least) + 12
        at = np.arange(1, count + 1) / count
        add("hold", np.full(count, level), 0.02 * np.log1p(20 * at) / np.log(21.0), 0.0)

    # A hold must outlast what the noise blurs: `dwell` bands on the slowest ramp that is possible here.
    width = max(0.0025, 4 * np.hypot(noise, resolution / 2))
    slowest = (0.25 if control == "load" else 0.09) / ramp[1]
    dwell = 8 * width / slowest
    if approach:
        count = int(rng.integers(1, 4) * 12 * width / slowest + 30)
        add("approach", np.zeros(count), np.zeros(count), 0.0)
    for cycle in range(cycles):
        last = cycle == cycles - 1
        lowest = max(level + 0.25, 0.4) if control == "load" else max(0.95 * peak, 0.7)
        top = 1.0 if last else rng.uniform(lowest, 1.0)
        if cycle and top <= peak + 6 * width:
            top = peak
        steps = int(rng.integers(*ramp))
        values = level + (top - level) * np.arange(1, steps + 1) / steps
        rate = (top - level) / steps
        add("load", values, np.zeros(steps), rate)
        level, peak = top, max(peak, top)
        if holds and rng.random() < 0.6:
            hold(dwell)
        if control == "load":
            bottom = rng.uniform(0.0, level - 0.25)
        else:  # never out of contact: the force is zero at three quarters of the peak
            bottom = 0.75 * peak + (level - 0.75 * peak) * rng.uniform(0.05, 0.3)
        steps = int(rng.integers(*ramp))
        add(
            "unload",
            level + (bottom - level) * np.arange(1, steps + 1) / steps,
            np.zeros(steps),
            (level - bottom) / steps,
        )
        level = bottom
        if holds and level > 0.1 and not last and rng.random() < 0.3:
            hold(dwell)
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
    top_so_far = np.maximum.accumulate(signal)
    away = _approach_path(kinds, drive)
    if control == "load":
        force = signal
        displacement = 0.9 * top_so_far**0.7 - 0.15 * (top_so_far - signal) ** 0.9 + slip + away
    else:
        displacement = signal + away
        force = _elastic_plastic(signal) - slip
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
    new_kinds, new_starts, new_rates = [], [], []
    reached, unloaded = -np.inf, False
    for kind, rate, a, b in zip(kinds, rates, starts, starts[1:], strict=False):
        part = force[a:b]
        if kind == "load" and unloaded:
            cut = int(np.argmax(part > reached)) if part.max() > reached + clear else len(part)
            pieces = [("reload", a)] + ([("load", a + cut)] if cut < len(part) - 1 else [])
        else:
            pieces = [(kind, a)]
        for name, start in pieces:
            new_kinds.append(name)
            new_starts.append(start)
            new_rates.append(rate)
        unloaded = unloaded or kind == "unload"
        reached = max(reached, part.max())
    return new_kinds, new_starts, new_rates


def _approach_path(kinds: list[str], drive: list[np.ndarray]) -> np.ndarray:
    path = np.zeros(sum(map(len, drive)))
    if kinds[0] == "approach":
        path[: len(drive[0])] = -np.linspace(0.3, 0.0, len(drive[0]))
    return path


def _elastic_plastic(displacement: np.ndarray) -> np.ndarray:
    """Force of a test under displacement control whose unloading is elastic and four times steeper."""
    rest = 0.75 * np.maximum.accumulate(displacement)
    top = np.maximum.accumulate(displacement)
    return np.where(top > 0, top * np.clip((displacement - rest) / np.where(top > 0, top - rest, 1.0), -0.02, 1), 0.0)


def _measure(rng: np.random.Generator, values: np.ndarray, noise: float, resolution: float) -> np.ndarray:
    span = np.ptp(values)
    measured = values + noise * span * rng.standard_normal(len(values))
    return np.round(measured / (resolution * span)) * resolution * span if resolution else measured


def _tolerance(before: float, after: float, width: float, kind: str) -> float:
    """Samples by which a boundary may be off: what one band (four noise deviations) is on the slower ramp."""
    slow = min(rate for rate in (before, after) if rate > 0)
    return 4.0 + (3.0 if kind == "load" else 2.0) * width / slow
