"""Who is tested and how: sizes, population, programmes of load."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .law import EFFECTIVE_MODULUS_MPA, LOG_C, MN_PER_MPA_UM2, Particles, is_monotone

# D1, D2, D3 in um: Table 1 of the paper.
TABLE_1 = np.array(
    [
        (213.54, 196.07, 186.33), (155.32, 217.51, 136.87), (168.74, 171.64, 125.15), (97.56, 100.98, 69.09),
        (238.47, 249.24, 237.81), (93.80, 76.46, 52.85), (160.44, 167.70, 151.30), (114.10, 114.54, 80.98),
        (168.31, 144.54, 131.27), (133.80, 117.12, 103.38), (122.69, 131.73, 109.91), (121.04, 205.93, 133.08),
        (185.10, 206.98, 146.91), (180.35, 173.88, 139.81), (173.26, 157.30, 147.79), (296.34, 267.76, 219.78),
        (219.50, 281.94, 225.55), (194.97, 167.95, 151.23), (105.57, 109.25, 86.46), (154.12, 182.82, 166.13),
    ]
)  # fmt: skip

PEAK_MPA = (7.0, 16.0)
MARGIN = 0.9  # of a loading curve that is not replaced, from falling
RATE_MN_PER_S = (0.8, 4.0)
RATE_RATIO = (5.0, 20.0)
POINTS = 260
PROTOCOLS = ("P0", "P1", "P2")
HUMIDITY_PERCENT = (10.0, 40.0, 75.0)
HOLD_S = (20.0, 120.0)
SIZE_SCATTER = 0.06
WIDE = (0.5, 2.0)
_TOUCH = 0.004  # of the peak: where records begin and end


@dataclass(frozen=True)
class Path:
    """Time in s, force in mN, rate of the segment in mN/s (positive); (particles, samples).

    `reload` is True on every sample of a reloading segment below the largest load so far, `turn` is u = F / F_P where
    that segment began, `reloads` the number of reloads begun, `since_turn` the time since the last reversal of the
    loading.
    """

    time: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    reload: np.ndarray
    turn: np.ndarray
    reloads: np.ndarray
    since_turn: np.ndarray
    unloading: np.ndarray


def sizes(rng: np.random.Generator, count: int, wide: bool = False) -> np.ndarray:
    """Rows of Table 1: as they stand, or resampled with some scatter on each diameter; `wide` over a factor of four."""
    if count == len(TABLE_1) and not wide and rng.random() < 0.5:
        return TABLE_1.copy()
    rows = TABLE_1[rng.integers(0, len(TABLE_1), count)]
    if wide:
        rows = rows * np.exp(rng.uniform(*np.log(WIDE), (count, 1)))
    rows = rows * np.exp(SIZE_SCATTER * rng.standard_normal(rows.shape))
    # A flat particle lies flat: D3 stays below the geometric mean of the others, as in the table.
    rows[:, 2] = np.minimum(rows[:, 2], 0.985 * np.sqrt(rows[:, 0] * rows[:, 1]))
    return np.round(rows, 2)


def population(
    rng: np.random.Generator,
    diameters: np.ndarray,
    modulus_scatter: float = 0.0,
    shape_scatter: float = 0.0,
    humidity: bool = False,
) -> Particles:
    """Particles with the log-normal coefficients of Table 2, those whose loading curve nearly falls drawn again.

    The scatters are standard deviations of logarithms: of the modulus, and of a factor of the strain (of C1, C3 and C5
    alike).
    """
    count = len(diameters)
    C = np.empty((0, 3))
    while len(C) < count:
        trial = np.exp(np.stack([mean + sd * rng.standard_normal(400) for mean, sd in LOG_C.values()], axis=1))
        C = np.concatenate([C, trial[is_monotone(*trial.T, margin=MARGIN)]])
    C = C[:count] * np.exp(shape_scatter * rng.standard_normal((count, 1)))
    columns = {}
    if humidity:
        columns["batch"] = np.resize([1.0, 2.0, 3.0], count)
        columns["relative_humidity_percent"] = np.resize(HUMIDITY_PERCENT, count)
    modulus = EFFECTIVE_MODULUS_MPA * np.exp(modulus_scatter * rng.standard_normal(count))
    return Particles(*diameters.T, *C.T, modulus=modulus, columns=columns)


Leg = tuple[float, float, float | None]
"""From, to (shares of the peak load), seconds of hold or None."""


def _legs(rng: np.random.Generator, protocol: str) -> list[Leg]:
    if protocol == "P0":
        return [(_TOUCH, 1.0, None), (1.0, _TOUCH, None)]
    turn, low, second = rng.uniform(0.4, 0.65), rng.uniform(0.015, 0.12), rng.uniform(0.15, 0.4)
    return [
        (_TOUCH, turn, None),
        (turn, low, None),
        (low, 1.0, None),
        (1.0, 1.0, float(rng.uniform(*HOLD_S))),
        (1.0, second, None),
        (second, 1.0, None),
        (1.0, _TOUCH, None),
    ]


def programme(rng: np.random.Generator, particles: Particles, protocol: str, points: int = POINTS) -> Path:
    """Path of each particle: peak stress uniform in a range, samples shared out by duration.

    P0 one cycle; P1 a cycle on the way, full load, a hold, partial unloading, reload, unloading; P2 the same, every
    second particle several times as fast.
    """
    if protocol not in PROTOCOLS:
        raise ValueError(f"no protocol {protocol!r}")
    count = len(particles.D1)
    peak = rng.uniform(*PEAK_MPA, count) * np.pi * particles.De**2 / 4.0 * MN_PER_MPA_UM2
    rate = np.full(count, np.exp(rng.uniform(*np.log(RATE_MN_PER_S))))
    if protocol == "P2":
        rate[1::2] *= rng.uniform(*RATE_RATIO)
    legs = _legs(rng, protocol)
    rows = [_sample(legs, peak[i], rate[i], points) for i in range(count)]
    return Path(*(np.stack(column) for column in zip(*rows, strict=True)))


def _sample(legs: list[Leg], peak: float, rate: float, points: int) -> tuple[np.ndarray, ...]:
    seconds = np.array([hold if hold is not None else abs(stop - start) * peak / rate for start, stop, hold in legs])
    weight = seconds / seconds.sum()
    held = np.array([hold is not None for *_, hold in legs])
    if held.any():  # a slow logger in holds: they take a fifth of the samples at most
        share = min(0.2, weight[held].sum())
        weight = np.where(held, share * weight / weight[held].sum(), (1.0 - share) * weight / weight[~held].sum())
    share = np.maximum(8, np.floor(weight * (points - 1))).astype(int)
    share[np.argmax(share)] += points - 1 - share.sum()
    time, force, rates, reload, turn, reloads, since, unloading = (
        [np.array([v])] for v in (0, _TOUCH, rate, 0, 1, 0, 0, 0)
    )
    clock, largest, begun, last_turn = 0.0, 0.0, 0, 0.0
    for (start, stop, hold), duration, n in zip(legs, seconds, share, strict=True):
        part = np.linspace(0.0, 1.0, n + 1)[1:]
        u = start + (stop - start) * part
        again = stop > start and start < largest
        begun += int(again)
        if stop < start or again:
            last_turn = clock
        largest = max(largest, start)
        time.append(clock + duration * part)
        force.append(u)
        rates.append(np.full(n, 0.0 if hold is not None else rate))
        reload.append((u < largest) & again)
        turn.append(np.full(n, start / largest if again else 1.0))
        reloads.append(np.full(n, begun))
        since.append(clock + duration * part - last_turn)
        unloading.append(np.full(n, stop < start))
        clock, largest = clock + duration, max(largest, stop)
    columns = [np.concatenate(parts) for parts in (time, force, rates, reload, turn, reloads, since, unloading)]
    columns[1] = columns[1] * peak
    kinds = (float, float, float, bool, float, float, float, bool)
    return tuple(column.astype(kind) for column, kind in zip(columns, kinds, strict=True))
