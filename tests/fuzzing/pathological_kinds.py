"""A catalogue of campaigns that somebody may well bring: each a kind of damage or unusual instrument, and a seed."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mcc_jax import Campaign, Curve, Instrument, Programme, Ramp, paper_campaign

POINTS, PARTICLES = 100, 4
MODULUS_MPA = 16_000.0


@dataclass(frozen=True)
class Kind:
    """One kind of campaign.

    Attributes:
        name: for the table.
        make: the campaign of a random generator.
        reads: valid data: the joint methods must give an answer, with the modulus near 16 GPa where `modulus` says so.
        refused: nothing that could be calibrated: every method must refuse it.
        slip: an error of unit, sign or column, which the check of plausibility must report.
        suspect: an answer, if there is one, must come with a warning or as not converged.
        modulus: factor within which the modulus must be right; None if it need not be.
        says: what an error, or a particle's reason, must contain.
    """

    name: str
    make: Callable[[np.random.Generator], Campaign]
    reads: bool = False
    refused: bool = False
    slip: bool = False
    suspect: bool = False
    modulus: float | None = None
    says: str = ""


# ---- what the kinds are made of --------------------------------------------------------------------------------------


@functools.lru_cache(64)
def _simulated(seed: int, programme: Programme, noise_um: float, noise_mN: float) -> Campaign:
    instrument = Instrument(displacement_noise_um=noise_um, force_noise_mN=noise_mN)
    return paper_campaign(seed, programme=programme, instrument=instrument)


def plain(rng, programme: Programme | None = None, *, count=PARTICLES, noise_um=0.02, noise_mN=0.05) -> Campaign:
    """A few particles of one of three campaigns."""
    programme = Programme.cycles(points=POINTS) if programme is None else programme
    whole = _simulated(int(rng.integers(3)), programme, noise_um, noise_mN)
    keep = np.zeros(len(whole), bool)
    keep[rng.choice(len(whole), count, replace=False)] = True
    return whole.select(keep)


def cycles(rng, levels: Sequence[float] = (1.0,), *, count=PARTICLES, **settings) -> Campaign:
    return plain(rng, Programme.cycles(levels=tuple(np.asarray(levels).tolist()), **settings), count=count)


def ramps(rng, *forces: float, points: int) -> Campaign:
    return plain(rng, Programme("load", tuple(Ramp(force, 2.0) for force in forces), points=points))


def each(campaign: Campaign, change: Callable[[Curve], Curve]) -> Campaign:
    return replace(campaign, curves=tuple(change(curve) for curve in campaign.curves))


def rows(campaign: Campaign, choose: Callable[[Curve], np.ndarray]) -> Campaign:
    def chosen(c: Curve) -> Curve:
        keep = choose(c)
        return Curve(c.time_s[keep], c.force_mN[keep], c.displacement_um[keep])

    return each(campaign, chosen)


def changed(campaign: Campaign, rng, **changes: Callable) -> Campaign:
    """One channel of every test changed after the other."""
    for name, change in changes.items():
        campaign = each(campaign, lambda c: replace(c, **{name: change(getattr(c, name), rng)}))  # noqa: B023
    return campaign


def first_of(one: Campaign, others: Campaign) -> Campaign:
    return replace(others, curves=(one.curves[0], *others.curves[1:]))


def first_changed(**changes: Callable) -> Callable:
    return lambda campaign, rng: first_of(changed(campaign, rng, **changes), campaign)


def scaled(campaign: Campaign, size: float, stress: float = 1.0) -> Campaign:
    """The same tests of a body some times larger and stiffer."""
    larger = each(campaign, lambda c: Curve(c.time_s, c.force_mN * size**2 * stress, c.displacement_um * size))
    return replace(larger, diameters_um=campaign.diameters_um * size)


def top(curve: Curve) -> int:
    return int(np.argmax(curve.force_mN))


def from_top(curve: Curve) -> np.ndarray:
    return np.arange(top(curve), len(curve))


def every(stride: int) -> Callable[[Curve], np.ndarray]:
    return lambda c: np.unique(np.r_[np.arange(0, len(c), stride), top(c), len(c) - 1])


def spiked(values: np.ndarray, rng, size: float, count: int = 1) -> np.ndarray:
    values = values.copy()
    values[rng.integers(5, len(values) - 5, count)] += size
    return values


def stuck(values: np.ndarray, _) -> np.ndarray:
    place = np.arange(len(values))
    return np.where((place >= 20) & (place < 45), values[20], values)


def instead(number: float) -> Callable:
    """The 34th reading is another number."""
    return lambda values, _: np.where(np.arange(len(values)) == 33, number, values)


def constant(number: float) -> Callable:
    return lambda values, _: np.full(len(values), number)


def steps(size: float) -> Callable:
    return lambda values, _: np.round(values / size) * size


def times(factor: float) -> Callable:
    return lambda values, _: values * factor


def noise(values: np.ndarray, rng, sd: float, mean: float = 0.0) -> np.ndarray:
    return mean + rng.normal(0, sd, len(values))


# ---- campaigns that take more than a line ----------------------------------------------------------------------------


def approach(rng) -> Campaign:
    def longer(c: Curve) -> Curve:
        air, scatter = np.linspace(-30, 0, 200, endpoint=False), rng.normal(0, 0.05, 200)
        time = np.concatenate([np.arange(200) * 0.1, 20 + c.time_s])
        return Curve(time, np.concatenate([scatter, c.force_mN]), np.concatenate([air, c.displacement_um]))

    return each(plain(rng), longer)


def many_rows(rng) -> Campaign:
    def finer(c: Curve) -> Curve:
        t = np.linspace(c.time_s[0], c.time_s[-1], 100_000)
        f = np.interp(t, c.time_s, c.force_mN) + rng.normal(0, 0.05, len(t))
        return Curve(t, f, np.interp(t, c.time_s, c.displacement_um) + rng.normal(0, 0.02, len(t)))

    return each(plain(rng), finer)


def few_rows(rng) -> Campaign:
    stride = int(rng.integers(5, 9))
    return rows(plain(rng), every(stride))


def mixed_control(rng) -> Campaign:
    one, two = plain(rng, count=2), cycles(rng, **CONTROLLED, count=2)
    return Campaign(tuple("abcd"), np.concatenate([one.diameters_um, two.diameters_um]), one.curves + two.curves)


def far_origin(rng) -> Campaign:
    offset, campaign = float(10 ** rng.uniform(2, 5)), plain(rng)
    return each(campaign, lambda c: replace(c, displacement_um=c.displacement_um + offset))


def pebble(rng, *, count: int = PARTICLES) -> Campaign:
    """A ceramic pebble of 1 mm that takes 100 N."""
    campaign, size, stress = plain(rng, count=count), float(rng.uniform(4, 7)), float(rng.uniform(10, 25))
    true = replace(campaign.metadata, other={"simulation": {"effective_modulus_MPa": MODULUS_MPA * stress}})
    return replace(scaled(campaign, size, stress), metadata=true)


def identical(rng) -> Campaign:
    one = plain(rng, count=1)
    return Campaign(tuple("abcd"), np.repeat(one.diameters_um, 4, axis=0), one.curves * 4)


def snaps(d: np.ndarray, rng) -> np.ndarray:
    start = int(rng.integers(10, 40))
    return d + np.where(np.arange(len(d)) >= start, 0.2 * d.max(), 0.0)


def approach_alone(c: Curve, rng) -> Curve:
    return Curve(c.time_s, noise(c.time_s, rng, 0.05), np.linspace(-20, 0, len(c)) + rng.normal(0, 0.02))


def hold_alone(c: Curve, rng) -> Curve:
    return Curve(c.time_s, noise(c.time_s, rng, 0.05, 100), noise(c.time_s, rng, 0.02, 20))


def shuffled(c: Curve, rng) -> Curve:
    order = rng.permutation(len(c))
    return Curve(c.time_s, c.force_mN[order], c.displacement_um[order])


def drowned(values: np.ndarray, rng) -> np.ndarray:
    return values + noise(values, rng, 2 * np.ptp(values))


CONTROLLED = {"control": "displacement", "rate": 0.5, "points": POINTS}
ODD = ("a,b", 'say "x"', "№ 5 µm – ü", "=1+1;\t'")
RANDOM = np.random.default_rng(0).uniform(0.2, 1, 300)
RISING, FALLING = np.linspace(0.3, 1, 500), (1.0, 0.95)

# ---- the catalogue ---------------------------------------------------------------------------------------------------

ANY, READS, SUSPECT, SLIP, REFUSED = {}, {"reads": True}, {"suspect": True}, {"slip": True}, {"refused": True}
NEAR, ROUGHLY = READS | {"modulus": 1.5}, READS | {"modulus": 2}
UNLOADS = {"says": "begins at its largest force"}
WEAK, SHORT = {"says": "where the others reach"}, {"says": "of its size where the others"}
WHOLE = {
    "plain": (NEAR, plain),
    "500 cycles to rising levels": (ROUGHLY, lambda rng: cycles(rng, RISING, unload_to=0.1, points=6000)),
    "500 cycles to one level": (ROUGHLY, lambda rng: cycles(rng, np.ones(500), unload_to=0.1, points=30_000)),
    "500 cycles of two samples each": (READS, lambda rng: cycles(rng, np.linspace(0.05, 1, 500), unload_to=0.0)),
    "300 cycles to random levels": (ROUGHLY, lambda rng: cycles(rng, RANDOM, unload_to=0.1, points=9000)),
    "100 cycles, ten samples each": (
        ROUGHLY,
        lambda rng: cycles(rng, np.linspace(0.2, 1, 100), unload_to=0.3, points=1000),
    ),
    "displacement from a far origin": (NEAR, far_origin),
    "an approach of 200 samples": (NEAR, approach),
    "100,000 rows": (NEAR, many_rows),
    "12 to 20 rows": (ANY, few_rows),
    "one particle": (ANY, lambda rng: plain(rng, count=1)),
    "two particles": (READS, lambda rng: plain(rng, count=2)),
    "holds": (ROUGHLY, lambda rng: cycles(rng, (0.4, 0.7, 1.0), hold_s=30.0, unload_to=0.2, points=300)),
    "displacement control": (ROUGHLY, lambda rng: cycles(rng, **CONTROLLED)),
    "tests under load and displacement mixed": (ROUGHLY, mixed_control),
    "partial unloading only": (READS, lambda rng: ramps(rng, 1.0, 0.6, points=POINTS)),
    "reload beyond the first peak": (ROUGHLY, lambda rng: ramps(rng, 0.5, 0.1, 0.9, 0.1, 1.0, 0.0, points=160)),
    "perfect readings": (NEAR, lambda rng: plain(rng, noise_um=0.0, noise_mN=0.0)),
    "odd names and texts": (READS, lambda rng: replace(plain(rng), particles=ODD, columns={})),
    "ceramic pebbles of 1 mm and 100 N": (NEAR, pebble),
    "tablets of 10 mm": (NEAR, lambda rng: scaled(plain(rng), 50)),
    "identical particles": (SUSPECT, identical),
    "unloading and a reload to the same force": (
        REFUSED | UNLOADS,
        lambda rng: rows(cycles(rng, FALLING, unload_to=0.1, points=160), from_top),
    ),
    "no particle": (REFUSED | {"says": "no particle"}, lambda _: Campaign((), np.empty((0, 3)), ())),
    "one name twice": (REFUSED | {"says": "times"}, lambda rng: replace(plain(rng), particles=tuple("aabc"))),
}
"""Campaigns as a whole."""
SIZES = {
    "all spheres": (ANY, lambda d: np.repeat(d[:, :1], 3, axis=1)),
    "same size and shape": (READS, lambda d: np.repeat(d[:1], len(d), axis=0)),
    "one particle a thousand times larger": (ANY, lambda d: d * np.c_[1e3, 1, 1, 1].T),
    "one particle a thousand times smaller": (ANY, lambda d: d * np.c_[1e-3, 1, 1, 1].T),
    "needles and flakes": (ANY, lambda d: d * np.array([[1, 1, 0.05], [1, 0.05, 1], [0.05, 1, 1], [1, 1, 20]])),
    **{f"diameters times 1e{p}": (SLIP, lambda d, p=p: d * 10.0**p) for p in (-3, 3, 9)},
    "a diameter that is not a number": (REFUSED | {"says": "diameters"}, lambda d: d * np.c_[np.nan, 1, 1, 1].T),
    "a negative diameter": (REFUSED | {"says": "diameters"}, lambda d: d * np.c_[-1, 1, 1, 1].T),
}
"""Plain campaigns whose diameters are changed."""
ROWS = {
    "no approach, begins in contact": (READS, lambda c: np.arange(4, len(c))),
    "30 rows": (READS, every(3)),
    "every row twice": (ROUGHLY, lambda c: np.repeat(np.arange(len(c)), 2)),
    "unloading only": (REFUSED | UNLOADS, from_top),
    "loading only": (SUSPECT, lambda c: np.arange(top(c) + 1)),
    "two points each": (REFUSED, lambda c: np.r_[0, top(c)]),
    "loads below the threshold only": (REFUSED | {"says": "threshold"}, lambda c: np.flatnonzero(c.force_mN < 3.0)),
    "begins in the middle of loading": (ANY, lambda c: np.arange(top(c) // 2, len(c))),
    "begins in the middle of unloading": (REFUSED | UNLOADS, lambda c: np.arange((top(c) + len(c)) // 2, len(c))),
    "one row each": (REFUSED | {"says": "row"}, lambda c: np.r_[top(c)]),
}
"""Plain campaigns of which rows are left out, or come twice."""
CURVES = {
    "force and displacement swapped": (SLIP, lambda c, _: Curve(c.time_s, c.displacement_um, c.force_mN)),
    "approach only": (REFUSED, approach_alone),
    "hold only": (REFUSED, hold_alone),
    "readings in random order": (SUSPECT, shuffled),
}
"""Plain campaigns whose tests become others."""
FORCES = {
    "force in steps of a tenth of the peak": (READS, lambda f, _: np.round(f / (s := f.max() / 10.4)) * s),
    "force in steps of 200 mN": (ANY, steps(200)),
    "soft spheres, stresses of kPa, no threshold reached": (SUSPECT, times(1e-3)),
    **{f"force times 1e{p}": (SLIP, times(10.0**p)) for p in (-14, -9, -6, -3, 3, 6, 9, 14)},
    "force of the other sign": (SLIP, times(-1.0)),
    "constant force": (REFUSED, constant(50.0)),
    "force of two levels": (ANY, lambda f, _: np.where(f > f.max() / 2, f.max(), 0.0)),
    "zero of force drifts": (ANY, lambda f, rng: f + np.linspace(0, rng.uniform(-0.3, 0.3) * f.max(), len(f))),
    "force nothing but noise": (SUSPECT, lambda f, rng: noise(f, rng, 1)),
    "loading that goes up and down": (ANY, lambda f, _: np.abs(f * (1 + 0.3 * np.sin(np.arange(len(f)))))),
    "one spike of force, 1e6 mN": (ANY, lambda f, rng: spiked(f, rng, 1e6)),
    "one spike of force, -1e4 mN": (ANY, lambda f, rng: spiked(f, rng, -1e4)),
    "force stuck for a while": (ANY, stuck),
    "force saturated at 80 %": (ANY, lambda f, _: np.minimum(f, 0.8 * f.max())),
    "particle breaks": (ANY, lambda f, _: np.where(np.arange(len(f)) >= int(0.35 * len(f)), 0.1 * f, f)),
    "not a number in force": (REFUSED | {"says": "nan"}, instead(np.nan)),
    "all forces zero": (REFUSED | {"says": "zero"}, constant(0.0)),
    "force and displacement of unlike lengths": (REFUSED | {"says": "entries"}, lambda f, _: f[:-3]),
}
DISPLACEMENTS = {
    "displacement in steps of 1 um": (READS, steps(1.0)),
    "all displacements below zero": (NEAR, lambda d, _: d - d.max() - 5),
    "displacement from a far origin below zero": (NEAR, lambda d, _: d - 12_345.0),
    "particle that snaps through": (ANY, snaps),
    **{f"displacement times 1e{p}": (SLIP, times(10.0**p)) for p in (-14, -9, -6, -3, 3, 6, 9, 14)},
    "displacement of the other sign": (SLIP, times(-1.0)),
    "constant displacement": (REFUSED, constant(10.0)),
    "zero of displacement drifts": (ANY, lambda d, rng: d + np.linspace(0, rng.uniform(-0.5, 0.5) * np.ptp(d), len(d))),
    "displacement nothing but noise": (SUSPECT, lambda d, rng: noise(d, rng, 1)),
    "displacement noise of a tenth of the range": (ANY, lambda d, rng: d + noise(d, rng, 0.1 * np.ptp(d))),
    "one spike of displacement, 1e6 um": (ANY, lambda d, rng: spiked(d, rng, 1e6)),
    "one spike of displacement, -1e6 um": (ANY, lambda d, rng: spiked(d, rng, -1e6)),
    "ten spikes of twice the range": (ANY, lambda d, rng: spiked(d, rng, 2 * float(np.ptp(d)), 10)),
    "displacement stuck for a while": (ANY, stuck),
    "not a number in displacement": (REFUSED | {"says": "nan"}, instead(np.nan)),
    "infinite displacement": (REFUSED | {"says": "inf"}, instead(np.inf)),
}
TIMES = {
    "time in hours and starting late": (NEAR, lambda t, _: t / 3600 + 1e6),
    "every time stamp twice": (NEAR, lambda t, _: np.repeat(t[::2], 2)[: len(t)]),
    "one time stamp": (READS, constant(3.0)),
    "a pause of a year": (NEAR, lambda t, _: t + np.where(np.arange(len(t)) > 60, 3e7, 0.0)),
    **{f"time times 1e{p}": (READS, times(10.0**p)) for p in (-14, -6, 6, 9)},
    "time that jumps once": (READS, lambda t, rng: np.sort(spiked(t, rng, 1e6))),
    "time that starts again": (REFUSED | {"says": "time"}, lambda t, _: np.where(np.arange(len(t)) > 50, t - t[50], t)),
}
"""Plain campaigns of which one channel is changed."""
BOTH = {
    "force and displacement coarse": (READS, steps(5), steps(0.5)),
    "both of the other sign": (SLIP, times(-1.0), times(-1.0)),
    "constant force and displacement": (REFUSED, constant(5.0), constant(5.0)),
    "noise larger than the signal": (SUSPECT, drowned, drowned),
}
"""Plain campaigns whose forces and displacements are changed."""
FIRST = {
    "force of the first particle times 1e6": (WEAK, first_changed(force_mN=times(1e6))),
    "displacement of the first particle times 1e6": (SHORT, first_changed(displacement_um=times(1e6))),
    "one test of two points": (READS, lambda c, _: first_of(rows(c, lambda one: np.r_[0, top(one)]), c)),
    "one test of constant force": (READS, first_changed(force_mN=constant(50.0))),
    "one test of constant displacement": (READS, first_changed(displacement_um=constant(10.0))),
    "three particles of four unloading only": (UNLOADS, lambda c, _: first_of(c, rows(c, from_top))),
    "all but one below the threshold": (ANY, lambda c, rng: first_of(c, changed(c, rng, force_mN=times(1e-3)))),
}
"""Plain campaigns whose first test is not like the others."""


def _kinds(table: dict, make: Callable[..., Campaign]) -> list[Kind]:
    """The kinds of a table whose changes are made to a plain campaign by `make`."""
    return [
        Kind(name, lambda rng, changes=changes: make(plain(rng), rng, *changes), **facts)
        for name, (facts, *changes) in table.items()
    ]


KINDS = [
    *(Kind(name, make, **facts) for name, (facts, make) in WHOLE.items()),
    *_kinds(SIZES, lambda c, _, change: replace(c, diameters_um=change(c.diameters_um))),
    *_kinds(ROWS, lambda c, _, choose: rows(c, choose)),
    *_kinds(CURVES, lambda c, rng, change: each(c, lambda one: change(one, rng))),
    *_kinds(FORCES, lambda c, rng, change: changed(c, rng, force_mN=change)),
    *_kinds(DISPLACEMENTS, lambda c, rng, change: changed(c, rng, displacement_um=change)),
    *_kinds(TIMES, lambda c, rng, change: changed(c, rng, time_s=change)),
    *_kinds(BOTH, lambda c, rng, first, second: changed(c, rng, displacement_um=second, force_mN=first)),
    *_kinds(FIRST, lambda c, rng, change: change(c, rng)),
]
"""The catalogue, in order."""
