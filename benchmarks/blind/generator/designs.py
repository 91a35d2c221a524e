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
LOAD_RATE_MN_PER_S = 2.0
POINTS = 260
PROTOCOLS = ("P0", "P1", "P2")
HUMIDITY_PERCENT = (10.0, 40.0, 75.0)
HOLD_S = 60.0
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


def sizes(rng, count, resample):
    """Rows of Table 1: as they stand, or resampled with 6 % of scatter on each diameter."""
    if not resample and count == len(TABLE_1):
        return TABLE_1.copy()
    rows = TABLE_1[rng.integers(0, len(TABLE_1), count)]
    rows = rows * np.exp(0.06 * rng.standard_normal(rows.shape))
    # A flat particle lies flat: D3 stays below the geometric mean of the others, as in the table.
    rows[:, 2] = np.minimum(rows[:, 2], 0.985 * np.sqrt(rows[:, 0] * rows[:, 1]))
    return np.round(rows, 2)


def population(rng, diameters, modulus_spread=0.0, snap_through=False, humidity=False):
    """Particles with the log-normal coefficients of Table 2.

    Draws whose loading curve is nearly not monotone are replaced, unless `snap_through`, which forces one or two of
    them.
    """
    count = len(diameters)

    def draw(wanted, accept):
        kept = np.empty((0, 3))
        while len(kept) < wanted:
            trial = np.exp(
                np.stack([mean + sd * rng.standard_normal(400) for mean, sd in LOG_C.values()], axis=1),
            )
            kept = np.concatenate([kept, trial[accept(*trial.T)]])
        return kept[:wanted]

    C = draw(count, lambda C1, C3, C5: is_monotone(C1, C3, C5, margin=MARGIN))
    if snap_through:
        jumping = int(rng.integers(1, 3))
        C[rng.choice(count, jumping, replace=False)] = draw(jumping, lambda *c: ~is_monotone(*c))
    columns = {}
    if humidity:
        columns["batch"] = np.resize([1.0, 2.0, 3.0], count)
        columns["relative_humidity_percent"] = np.resize(HUMIDITY_PERCENT, count)
    return Particles(
        *diameters.T,
        *C.T,
        modulus=EFFECTIVE_MODULUS_MPA * np.exp(modulus_spread * rng.standard_normal(count)),
        zero=rng.normal(0.0, 2.0, count),
        columns=columns,
    )


def _legs(protocol):
    """(from, to, seconds of hold or None) in fractions of the peak load."""
    if protocol == "P0":
        return [(_TOUCH, 1.0, None), (1.0, _TOUCH, None)]
    return [
        (_TOUCH, 0.5, None),
        (0.5, 0.02, None),
        (0.02, 1.0, None),
        (1.0, 1.0, HOLD_S),
        (1.0, 0.25, None),
        (0.25, 1.0, None),
        (1.0, _TOUCH, None),
    ]


def programme(rng, particles, protocol, points=POINTS):
    """Path of each particle: peak stress uniform in 7-16 MPa, samples shared out by duration.

    P0 one cycle at 2 mN/s; P1 half-load cycle, full load, hold of 60 s, partial unloading, reload, unloading; P2 the
    same, with ten times the rate on every second particle.
    """
    if protocol not in PROTOCOLS:
        raise ValueError(f"no protocol {protocol!r}")
    count = len(particles.D1)
    peak = rng.uniform(*PEAK_MPA, count) * np.pi * particles.De**2 / 4.0 * MN_PER_MPA_UM2
    rate = np.full(count, LOAD_RATE_MN_PER_S)
    if protocol == "P2":
        rate[1::2] *= 10.0
    legs = _legs(protocol)
    rows = [_sample(legs, peak[i], rate[i], points) for i in range(count)]
    return Path(*(np.stack(column) for column in zip(*rows, strict=True)))


def _sample(legs, peak, rate, points):
    seconds = np.array([hold if hold is not None else abs(stop - start) * peak / rate for start, stop, hold in legs])
    share = np.maximum(10, np.floor(seconds / seconds.sum() * (points - 1))).astype(int)
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
    join = np.concatenate
    return (
        join(time) * 1.0,
        join(force) * peak,
        join(rates) * 1.0,
        join(reload).astype(bool),
        join(turn) * 1.0,
        join(reloads) * 1.0,
        join(since) * 1.0,
        join(unloading).astype(bool),
    )
