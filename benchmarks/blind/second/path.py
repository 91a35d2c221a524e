"""How each particle is loaded, and where on its history every sample lies."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from .particles import Particles

VIRGIN, UNLOAD, RELOAD, HOLD = 0, 1, 2, 3
HOLD_S, HOLD_POINTS = (15.0, 90.0), 14
RATES_MN_S = (1.0, 2.0, 4.0)
RATE_PAIRS = ((2.0, 20.0), (1.0, 10.0), (0.5, 8.0))
FIRST, LAST = 0.005, 0.015
"""First and last force over the largest."""

_STILL, _SAME = 1e-9, 1e-9


@dataclass(frozen=True)
class Path:
    """All samples of a campaign one after the other; `owner` is the particle of each, `slices` the samples of each.

    rate: loading rate of each particle, mN/s. largest_stress, largest_force: of each particle, MPa and mN. peak:
    largest stress so far, MPa. turn_stress: stress at the last trough, MPa. reload_share: way back from trough to peak,
    0 to 1. unloadings, turns: number so far. since_turn: s since the drive changed direction. travelled: load path,
    MPa. reloads: (particle, first sample of the reload, first sample after it, end of the particle's samples).
    """

    time: np.ndarray
    force: np.ndarray
    owner: np.ndarray
    slices: tuple[slice, ...]
    rate: np.ndarray
    rates: tuple[float, ...]
    largest_stress: np.ndarray
    largest_force: np.ndarray
    stress: np.ndarray
    peak: np.ndarray
    branch: np.ndarray
    turn_stress: np.ndarray
    reload_share: np.ndarray
    unloadings: np.ndarray
    turns: np.ndarray
    since_turn: np.ndarray
    travelled: np.ndarray
    reloads: tuple[tuple[int, int, int, int], ...]

    def __len__(self) -> int:
        return len(self.time)


def draw(
    rng: np.random.Generator, particles: Particles, protocol: str, reloads: int = 0, low_turn: bool = False
) -> Path:
    """P0: up and down. P1: a partial unloading on the way, a hold, `reloads` further cycles. P2: P1 at two rates.

    low_turn: the partial unloading starts at a quarter of the peak and goes nearly to zero.
    """
    count = len(particles)
    largest_stress = rng.uniform(7, 16, count)
    largest_force = largest_stress * particles.area
    rates = (float(rng.choice(RATES_MN_S)),)
    rate = np.full(count, rates[0])
    hold = float(rng.uniform(*HOLD_S))
    if protocol == "P2":
        rates = RATE_PAIRS[rng.integers(len(RATE_PAIRS))]
        rate = np.array(rates)[rng.permutation(count) % 2]
    if low_turn:
        turn = (rng.uniform(0.2, 0.3), rng.uniform(0.02, 0.05))
    else:
        turn = (rng.uniform(0.45, 0.6), rng.uniform(0.08, 0.18))
    legs = [
        _programme(protocol, largest_force[i], rate[i], int(rng.integers(200, 256)), reloads, turn, hold)
        for i in range(count)
    ]
    ends = np.cumsum([0, *(len(time) for time, _ in legs)])
    slices = tuple(slice(int(a), int(b)) for a, b in pairwise(ends))
    owner = np.repeat(np.arange(count), np.diff(ends))
    time = np.concatenate([np.round(time, 4) for time, _ in legs])
    force = np.concatenate([np.round(force, 5) for _, force in legs])
    stress = force / particles.area[owner]
    histories = [_history(time[samples], stress[samples]) for samples in slices]
    joined = {
        name: np.concatenate([history[name] for history in histories]) for name in histories[0] if name != "reloads"
    }
    events = tuple(
        (i, samples.start + begin, samples.start + end, samples.stop)
        for i, (samples, history) in enumerate(zip(slices, histories, strict=True))
        for begin, end in history["reloads"]
    )
    return Path(
        time, force, owner, slices, rate, rates, largest_stress, largest_force, stress, reloads=events, **joined
    )


def _programme(
    protocol: str, largest: float, rate: float, points: int, reloads: int, turn: tuple[float, float], hold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Time in s and force in mN of one test: ramps at `rate` in mN/s, samples shared out by the way of the force."""
    last = LAST * largest
    if protocol == "P0":
        goals = [largest, last]
    else:
        goals = [turn[0] * largest, turn[1] * largest, largest, None, last, *([largest, last] * reloads)]
    now = FIRST * largest
    force, time = [now], [now / rate]
    ramps, way = [], 0.0
    for goal in goals:
        if goal is None:
            ramps.append((now, now, hold, True))
            continue
        ramps.append((now, goal, abs(goal - now) / rate, False))
        way += abs(goal - now)
        now = goal
    left = points - HOLD_POINTS * sum(held for *_, held in ramps)
    for begin, end, duration, held in ramps:
        number = HOLD_POINTS if held else max(6, round(left * abs(end - begin) / way))
        share = np.arange(1, number + 1) / number
        force += list(begin + (end - begin) * share)
        time += list(time[-1] + duration * share)
    return np.array(time), np.array(force)


def _history(time: np.ndarray, stress: np.ndarray) -> dict[str, Any]:
    """Branch, last trough and counters at each sample of one particle."""
    number = len(stress)
    peak = np.maximum.accumulate(stress)
    rise = np.diff(stress, prepend=stress[0] - 1)
    branch, unloadings, turns = np.zeros(number, int), np.zeros(number), np.zeros(number)
    turn_stress, since_turn = np.zeros(number), np.zeros(number)
    reloads, reload_began = [], None
    before, direction_before = VIRGIN, 1
    trough, turned_at, turned, unloaded = stress[0], time[0], 0, 0
    for j in range(number):
        direction = 1 if rise[j] > _STILL else (-1 if rise[j] < -_STILL else 0)
        if direction != direction_before and j > 0:
            turned_at, direction_before = time[j - 1], direction
            turned += 1
        since_turn[j], turns[j] = time[j] - turned_at, turned
        if direction == 0:
            now = HOLD
        elif direction < 0:
            now = UNLOAD
        elif stress[j] < peak[j] * (1 - _SAME) or (j > 0 and peak[j] <= peak[j - 1] * (1 + _SAME)):
            now = RELOAD
        else:
            now = VIRGIN
        if now == UNLOAD:
            unloaded += before != UNLOAD
            trough = stress[j]
        if now == RELOAD and before == UNLOAD:
            reload_began = j
        if now != RELOAD and before == RELOAD and reload_began is not None:
            reloads.append((reload_began, j))
            reload_began = None
        branch[j], turn_stress[j], unloadings[j] = now, trough, unloaded
        before = now
    back = (stress - turn_stress) / np.maximum(peak - turn_stress, 1e-9)
    return {
        "peak": peak,
        "branch": branch,
        "turn_stress": turn_stress,
        "reload_share": np.where(branch == RELOAD, back, 0),
        "unloadings": unloadings,
        "turns": turns,
        "since_turn": since_turn,
        "travelled": np.cumsum(np.abs(np.diff(stress, prepend=stress[0]))),
        "reloads": reloads,
    }
