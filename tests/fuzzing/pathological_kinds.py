"""A catalogue of campaigns that somebody may well bring: each a kind of damage or unusual instrument, and a seed."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

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
        slip: a slip of unit, sign or column, of which the check of plausibility must say something.
        suspect: an answer, if there is one, must come with a warning or as not converged.
        modulus: factor within which the modulus must be right; None if it need not be.
        says: what an error, or a particle's reason, must contain.
        damage: what is done to the files after the campaign was written, for the command only; what the one line of the
            error must then name is in `says`.
    """

    name: str
    make: Callable[[np.random.Generator], Campaign]
    reads: bool = False
    refused: bool = False
    slip: bool = False
    suspect: bool = False
    modulus: float | None = None
    says: str = ""
    damage: Callable[[np.random.Generator, Path], None] | None = None


KINDS: list[Kind] = []
"""The catalogue, in order."""

Maker = Callable[[np.random.Generator], Campaign]


def kind(name: str, **facts) -> Callable[[Maker], Maker]:
    def add(make: Maker) -> Maker:
        KINDS.append(Kind(name, make, **facts))
        return make

    return add


# ---- what the kinds are made of --------------------------------------------------------------------------------------


@functools.lru_cache(64)
def _simulated(seed: int, programme: Programme, noise_um: float, noise_mN: float) -> Campaign:
    instrument = Instrument(displacement_noise_um=noise_um, force_noise_mN=noise_mN)
    return paper_campaign(seed, programme=programme, instrument=instrument)


ONE_CYCLE = Programme.cycles(points=POINTS)


def plain(
    rng: np.random.Generator,
    programme: Programme = ONE_CYCLE,
    *,
    count: int = PARTICLES,
    noise_um: float = 0.02,
    noise_mN: float = 0.05,
) -> Campaign:
    """A few particles of one of three campaigns."""
    whole = _simulated(int(rng.integers(3)), programme, noise_um, noise_mN)
    keep = np.zeros(len(whole), bool)
    keep[rng.choice(len(whole), count, replace=False)] = True
    return whole.select(keep)


def each(campaign: Campaign, change: Callable[[Curve], Curve]) -> Campaign:
    return replace(campaign, curves=tuple(change(curve) for curve in campaign.curves))


def force(campaign: Campaign, change: Callable[[np.ndarray], np.ndarray]) -> Campaign:
    return each(campaign, lambda c: replace(c, force_mN=change(c.force_mN)))


def displacement(campaign: Campaign, change: Callable[[np.ndarray], np.ndarray]) -> Campaign:
    return each(campaign, lambda c: replace(c, displacement_um=change(c.displacement_um)))


def clock(campaign: Campaign, change: Callable[[np.ndarray], np.ndarray]) -> Campaign:
    return each(campaign, lambda c: replace(c, time_s=change(c.time_s)))


def rows(campaign: Campaign, choose: Callable[[Curve], np.ndarray]) -> Campaign:
    def one(curve: Curve) -> Curve:
        keep = choose(curve)
        return Curve(curve.time_s[keep], curve.force_mN[keep], curve.displacement_um[keep])

    return each(campaign, one)


def top(curve: Curve) -> int:
    return int(np.argmax(curve.force_mN))


def first_only(campaign: Campaign, change: Callable[[Campaign], Campaign]) -> Campaign:
    """The change made to the first particle alone."""
    changed = change(campaign)
    return replace(campaign, curves=(changed.curves[0], *campaign.curves[1:]))


def spiked(values: np.ndarray, rng: np.random.Generator, size: float, count: int = 1) -> np.ndarray:
    values = values.copy()
    values[rng.integers(5, len(values) - 5, count)] += size
    return values


# ---- valid data ------------------------------------------------------------------------------------------------------


@kind("plain", reads=True, modulus=1.5)
def _(rng):
    return plain(rng)


@kind("500 cycles to rising levels", reads=True, modulus=2)
def _(rng):
    levels = tuple(np.linspace(0.3, 1, 500).tolist())
    return plain(rng, Programme.cycles(levels=levels, unload_to=0.1, points=6000))


@kind("500 cycles to one level", reads=True, modulus=2)
def _(rng):
    return plain(rng, Programme.cycles(levels=(1.0,) * 500, unload_to=0.1, points=30_000))


@kind("500 cycles to rising levels, two samples each", reads=True)
def _(rng):
    return plain(rng, Programme.cycles(levels=tuple(np.linspace(0.05, 1, 500).tolist()), unload_to=0.0))


@kind("300 cycles to random levels", reads=True, modulus=2)
def _(rng):
    levels = tuple(np.random.default_rng(0).uniform(0.2, 1, 300).tolist())
    return plain(rng, Programme.cycles(levels=levels, unload_to=0.1, points=9000))


@kind("100 cycles, ten samples each", reads=True, modulus=2)
def _(rng):
    return plain(rng, Programme.cycles(levels=tuple(np.linspace(0.2, 1, 100).tolist()), unload_to=0.3, points=1000))


@kind("force in steps of a tenth of the peak", reads=True)
def _(rng):
    return each(plain(rng), lambda c: replace(c, force_mN=np.round(c.force_mN / (s := c.force_mN.max() / 10.4)) * s))


@kind("force in steps of 200 mN", reads=False)
def _(rng):
    return force(plain(rng), lambda f: np.round(f / 200) * 200)


@kind("displacement in steps of 1 um", reads=True)
def _(rng):
    return displacement(plain(rng), np.round)


@kind("force and displacement coarse", reads=True)
def _(rng):
    return displacement(force(plain(rng), lambda f: np.round(f / 5) * 5), lambda d: np.round(d / 0.5) * 0.5)


@kind("all displacements below zero", reads=True, modulus=1.5)
def _(rng):
    return displacement(plain(rng), lambda d: d - d.max() - 5)


@kind("displacement from a far origin", reads=True, modulus=1.5)
def _(rng):
    offset = float(10 ** rng.uniform(2, 5))
    return displacement(plain(rng), lambda d: d + offset)


@kind("displacement from a far origin below zero", reads=True, modulus=1.5)
def _(rng):
    return displacement(plain(rng), lambda d: d - 12_345.0)


@kind("no approach, begins in contact", reads=True)
def _(rng):
    return rows(plain(rng), lambda c: np.arange(4, len(c)))


@kind("an approach of 200 samples", reads=True, modulus=1.5)
def _(rng):
    def one(c: Curve) -> Curve:
        air = np.linspace(-30, 0, 200, endpoint=False)
        noise = rng.normal(0, 0.05, 200)
        return Curve(
            np.concatenate([np.arange(200) * 0.1, 20 + c.time_s]),
            np.concatenate([noise, c.force_mN]),
            np.concatenate([air, c.displacement_um]),
        )

    return each(plain(rng), one)


@kind("100,000 rows", reads=True, modulus=1.5)
def _(rng):
    def one(c: Curve) -> Curve:
        t = np.linspace(c.time_s[0], c.time_s[-1], 100_000)
        f = np.interp(t, c.time_s, c.force_mN) + rng.normal(0, 0.05, len(t))
        return Curve(t, f, np.interp(t, c.time_s, c.displacement_um) + rng.normal(0, 0.02, len(t)))

    return each(plain(rng), one)


@kind("12 to 20 rows")
def _(rng):
    stride = int(rng.integers(5, 9))
    return rows(plain(rng), lambda c: np.unique(np.r_[np.arange(0, len(c), stride), top(c), len(c) - 1]))


@kind("30 rows", reads=True)
def _(rng):
    return rows(plain(rng), lambda c: np.unique(np.r_[np.arange(0, len(c), 3), top(c), len(c) - 1]))


@kind("one particle")
def _(rng):
    return plain(rng, count=1)


@kind("two particles", reads=True)
def _(rng):
    return plain(rng, count=2)


@kind("a hold at every level", reads=True, modulus=2)
def _(rng):
    return plain(rng, Programme.cycles(levels=(0.4, 0.7, 1.0), hold_s=30.0, unload_to=0.2, points=300))


@kind("displacement control", reads=True, modulus=2)
def _(rng):
    return plain(rng, Programme.cycles(control="displacement", rate=0.5, points=POINTS))


@kind("tests under load and displacement mixed", reads=True, modulus=2)
def _(rng):
    one = plain(rng, count=2)
    two = plain(rng, Programme.cycles(control="displacement", rate=0.5, points=POINTS), count=2)
    return Campaign(("a", "b", "c", "d"), np.concatenate([one.diameters_um, two.diameters_um]), one.curves + two.curves)


@kind("partial unloading only", reads=True)
def _(rng):
    return plain(rng, Programme("load", (Ramp(1.0, 2.0), Ramp(0.6, 2.0)), points=POINTS))


@kind("reload beyond the first peak", reads=True, modulus=2)
def _(rng):
    return plain(rng, Programme("load", tuple(Ramp(v, 2.0) for v in (0.5, 0.1, 0.9, 0.1, 1.0, 0.0)), points=160))


@kind("perfect readings", reads=True, modulus=1.5)
def _(rng):
    return plain(rng, noise_um=0.0, noise_mN=0.0)


@kind("odd names and texts", reads=True)
def _(rng):
    campaign = plain(rng)
    return replace(campaign, particles=("a,b", 'say "x"', "№ 5 µm – ü", "=1+1;\t'"), columns={})


@kind("time in hours and starting late", reads=True, modulus=1.5)
def _(rng):
    return clock(plain(rng), lambda t: t / 3600 + 1e6)


@kind("every time stamp twice", reads=True, modulus=1.5)
def _(rng):
    return clock(plain(rng), lambda t: np.repeat(t[::2], 2)[: len(t)])


@kind("one time stamp", reads=True)
def _(rng):
    return clock(plain(rng), lambda t: np.full(len(t), 3.0))


@kind("a pause of a year", reads=True, modulus=1.5)
def _(rng):
    return clock(plain(rng), lambda t: t + np.where(np.arange(len(t)) > 60, 3e7, 0.0))


@kind("every row twice", reads=True, modulus=2)
def _(rng):
    return rows(plain(rng), lambda c: np.repeat(np.arange(len(c)), 2))


def pebble(rng: np.random.Generator, *, count: int = PARTICLES) -> Campaign:
    """The same tests of a body some times larger and stiffer: a ceramic pebble of 1 mm that takes 100 N."""
    campaign, size, stress = plain(rng, count=count), float(rng.uniform(4, 7)), float(rng.uniform(10, 25))
    scaled = force(displacement(campaign, lambda d: d * size), lambda f: f * size**2 * stress)
    true = replace(campaign.metadata, other={"simulation": {"effective_modulus_MPa": MODULUS_MPA * stress}})
    return replace(scaled, diameters_um=campaign.diameters_um * size, metadata=true)


@kind("ceramic pebbles of 1 mm and 100 N", reads=True, modulus=1.5)
def _(rng):
    return pebble(rng)


@kind("tablets of 10 mm", reads=True, modulus=1.5)
def _(rng):
    campaign = plain(rng)
    scaled = force(displacement(campaign, lambda d: d * 50), lambda f: f * 2500)
    return replace(scaled, diameters_um=campaign.diameters_um * 50)


@kind("soft spheres, stresses of kPa, no threshold reached", suspect=True)
def _(rng):
    return force(plain(rng), lambda f: f * 1e-3)


@kind("one particle tested, all others below the threshold")
def _(rng):
    campaign = plain(rng)
    return replace(
        campaign,
        curves=(campaign.curves[0], *(replace(c, force_mN=c.force_mN * 1e-3) for c in campaign.curves[1:])),
    )


# ---- unusual particles -----------------------------------------------------------------------------------------------


@kind("all spheres")
def _(rng):
    campaign = plain(rng)
    return replace(campaign, diameters_um=np.repeat(campaign.diameters_um[:, :1], 3, axis=1))


@kind("identical particles", suspect=True)
def _(rng):
    one = plain(rng, count=1)
    return Campaign(("a", "b", "c", "d"), np.repeat(one.diameters_um, 4, axis=0), one.curves * 4)


@kind("same size and shape", reads=True)
def _(rng):
    campaign = plain(rng)
    return replace(campaign, diameters_um=np.repeat(campaign.diameters_um[:1], len(campaign), axis=0))


@kind("one particle a thousand times larger")
def _(rng):
    campaign = plain(rng)
    return replace(campaign, diameters_um=campaign.diameters_um * np.r_[1e3, 1, 1, 1][:, None])


@kind("one particle a thousand times smaller")
def _(rng):
    campaign = plain(rng)
    return replace(campaign, diameters_um=campaign.diameters_um * np.r_[1e-3, 1, 1, 1][:, None])


@kind("needles and flakes")
def _(rng):
    campaign = plain(rng)
    shapes = np.array([[1, 1, 0.05], [1, 0.05, 1], [0.05, 1, 1], [1, 1, 20.0]])
    return replace(campaign, diameters_um=campaign.diameters_um * shapes)


@kind("particle that snaps through")
def _(rng):
    def snap(d: np.ndarray) -> np.ndarray:
        at = int(rng.integers(10, 40))
        return d + np.where(np.arange(len(d)) >= at, 0.2 * d.max(), 0.0)

    return displacement(plain(rng), snap)


# ---- scales ----------------------------------------------------------------------------------------------------------

for power in (-14, -9, -6, -3, 3, 6, 9, 14):

    @kind(f"force times 1e{power}", slip=True)
    def _(rng, power=power):
        return force(plain(rng), lambda f: f * 10.0**power)

    @kind(f"displacement times 1e{power}", slip=True)
    def _(rng, power=power):
        return displacement(plain(rng), lambda d: d * 10.0**power)


for power in (-14, -6, 6, 9):

    @kind(f"time times 1e{power}", reads=True)
    def _(rng, power=power):
        return clock(plain(rng), lambda t: t * 10.0**power)


for power in (-3, 3, 9):

    @kind(f"diameters times 1e{power}", slip=True)
    def _(rng, power=power):
        campaign = plain(rng)
        return replace(campaign, diameters_um=campaign.diameters_um * 10.0**power)


@kind("force of the first particle times 1e6", says="where the others reach")
def _(rng):
    return first_only(plain(rng), lambda c: force(c, lambda f: f * 1e6))


@kind("displacement of the first particle times 1e6", says="of its size where the others")
def _(rng):
    return first_only(plain(rng), lambda c: displacement(c, lambda d: d * 1e6))


# ---- signs -----------------------------------------------------------------------------------------------------------


@kind("displacement of the other sign", slip=True)
def _(rng):
    return displacement(plain(rng), np.negative)


@kind("force of the other sign", slip=True)
def _(rng):
    return force(plain(rng), np.negative)


@kind("both of the other sign", slip=True)
def _(rng):
    return displacement(force(plain(rng), np.negative), np.negative)


@kind("force and displacement swapped", slip=True)
def _(rng):
    return each(plain(rng), lambda c: Curve(c.time_s, c.displacement_um, c.force_mN))


# ---- parts of a test -------------------------------------------------------------------------------------------------


@kind("unloading only", refused=True, says="begins at its largest force")
def _(rng):
    return rows(plain(rng), lambda c: np.arange(top(c), len(c)))


@kind("unloading and a reload to the same force", refused=True, says="begins at its largest force")
def _(rng):
    whole = plain(rng, Programme.cycles(levels=(1.0, 0.95), unload_to=0.1, points=160))
    return rows(whole, lambda c: np.arange(top(c), len(c)))


@kind("approach only", refused=True)
def _(rng):
    return each(
        plain(rng),
        lambda c: Curve(c.time_s, rng.normal(0, 0.05, len(c)), np.linspace(-20, 0, len(c)) + rng.normal(0, 0.02)),
    )


@kind("hold only", refused=True)
def _(rng):
    return each(
        plain(rng),
        lambda c: Curve(c.time_s, 100 + rng.normal(0, 0.05, len(c)), 20 + rng.normal(0, 0.02, len(c))),
    )


@kind("loading only", suspect=True)
def _(rng):
    return rows(plain(rng), lambda c: np.arange(top(c) + 1))


@kind("two points each", refused=True)
def _(rng):
    return rows(plain(rng), lambda c: np.r_[0, top(c)])


@kind("one test of two points", reads=True)
def _(rng):
    return first_only(plain(rng), lambda c: rows(c, lambda one: np.r_[0, top(one)]))


@kind("loads below the threshold only", refused=True, says="threshold")
def _(rng):
    return rows(plain(rng), lambda c: np.flatnonzero(c.force_mN < 3.0))


@kind("begins in the middle of loading", suspect=False)
def _(rng):
    return rows(plain(rng), lambda c: np.arange(top(c) // 2, len(c)))


@kind("begins in the middle of unloading", refused=True, says="begins at its largest force")
def _(rng):
    return rows(plain(rng), lambda c: np.arange((top(c) + len(c)) // 2, len(c)))


@kind("three particles of four unloading only", says="begins at its largest force")
def _(rng):
    campaign = plain(rng)
    cut = rows(campaign, lambda c: np.arange(top(c), len(c)))
    return replace(campaign, curves=(campaign.curves[0], *cut.curves[1:]))


# ---- broken sensors --------------------------------------------------------------------------------------------------


@kind("constant force", refused=True)
def _(rng):
    return force(plain(rng), lambda f: np.full(len(f), 50.0))


@kind("constant displacement", refused=True)
def _(rng):
    return displacement(plain(rng), lambda d: np.full(len(d), 10.0))


@kind("constant force and displacement", refused=True)
def _(rng):
    return displacement(force(plain(rng), lambda f: np.full(len(f), 5.0)), lambda d: np.full(len(d), 5.0))


@kind("one test of constant force", reads=True)
def _(rng):
    return first_only(plain(rng), lambda c: force(c, lambda f: np.full(len(f), 50.0)))


@kind("one test of constant displacement", reads=True)
def _(rng):
    return first_only(plain(rng), lambda c: displacement(c, lambda d: np.full(len(d), 10.0)))


@kind("force of two levels")
def _(rng):
    return force(plain(rng), lambda f: np.where(f > f.max() / 2, f.max(), 0.0))


@kind("zero of force drifts")
def _(rng):
    return force(plain(rng), lambda f: f + np.linspace(0, rng.uniform(-0.3, 0.3) * f.max(), len(f)))


@kind("zero of displacement drifts", suspect=False)
def _(rng):
    return displacement(plain(rng), lambda d: d + np.linspace(0, rng.uniform(-0.5, 0.5) * np.ptp(d), len(d)))


@kind("noise larger than the signal", suspect=True)
def _(rng):
    return force(
        displacement(plain(rng), lambda d: d + rng.normal(0, 2 * np.ptp(d), len(d))),
        lambda f: f + rng.normal(0, 2 * np.ptp(f), len(f)),
    )


@kind("displacement nothing but noise", suspect=True)
def _(rng):
    return displacement(plain(rng), lambda d: rng.normal(0, 1, len(d)))


@kind("force nothing but noise", suspect=True)
def _(rng):
    return force(plain(rng), lambda f: rng.normal(0, 1, len(f)))


@kind("displacement noise of a tenth of the range")
def _(rng):
    return displacement(plain(rng), lambda d: d + rng.normal(0, 0.1 * np.ptp(d), len(d)))


@kind("loading that goes up and down", suspect=False)
def _(rng):
    return force(plain(rng), lambda f: np.abs(f * (1 + 0.3 * np.sin(np.arange(len(f))))))


@kind("readings in random order", suspect=True)
def _(rng):
    def one(c: Curve) -> Curve:
        order = rng.permutation(len(c))
        return Curve(c.time_s, c.force_mN[order], c.displacement_um[order])

    return each(plain(rng), one)


@kind("one spike of displacement, 1e6 um")
def _(rng):
    return displacement(plain(rng), lambda d: spiked(d, rng, 1e6))


@kind("one spike of displacement, -1e6 um")
def _(rng):
    return displacement(plain(rng), lambda d: spiked(d, rng, -1e6))


@kind("one spike of force, 1e6 mN")
def _(rng):
    return force(plain(rng), lambda f: spiked(f, rng, 1e6))


@kind("one spike of force, -1e4 mN")
def _(rng):
    return force(plain(rng), lambda f: spiked(f, rng, -1e4))


@kind("ten spikes of twice the range")
def _(rng):
    return displacement(plain(rng), lambda d: spiked(d, rng, 2 * float(np.ptp(d)), 10))


@kind("time that jumps once", reads=True)
def _(rng):
    return clock(plain(rng), lambda t: np.sort(spiked(t, rng, 1e6)))


@kind("force stuck for a while")
def _(rng):
    def stuck(f: np.ndarray) -> np.ndarray:
        f = f.copy()
        f[20:45] = f[20]
        return f

    return force(plain(rng), stuck)


@kind("displacement stuck for a while")
def _(rng):
    def stuck(d: np.ndarray) -> np.ndarray:
        d = d.copy()
        d[20:45] = d[20]
        return d

    return displacement(plain(rng), stuck)


@kind("force saturated at 80 %")
def _(rng):
    return force(plain(rng), lambda f: np.minimum(f, 0.8 * f.max()))


@kind("particle breaks: the force is gone")
def _(rng):
    def broken(f: np.ndarray) -> np.ndarray:
        at = int(0.35 * len(f))
        return np.where(np.arange(len(f)) >= at, 0.1 * f, f)

    return force(plain(rng), broken)


# ---- what no campaign may hold ---------------------------------------------------------------------------------------


@kind("not a number in displacement", refused=True, says="nan")
def _(rng):
    return displacement(plain(rng), lambda d: np.where(np.arange(len(d)) == 33, np.nan, d))


@kind("not a number in force", refused=True, says="nan")
def _(rng):
    return force(plain(rng), lambda f: np.where(np.arange(len(f)) == 33, np.nan, f))


@kind("infinite displacement", refused=True, says="inf")
def _(rng):
    return displacement(plain(rng), lambda d: np.where(np.arange(len(d)) == 33, np.inf, d))


@kind("a diameter that is not a number", refused=True, says="diameters")
def _(rng):
    campaign = plain(rng)
    return replace(campaign, diameters_um=campaign.diameters_um * np.r_[np.nan, 1, 1, 1][:, None])


@kind("a negative diameter", refused=True, says="diameters")
def _(rng):
    campaign = plain(rng)
    return replace(campaign, diameters_um=campaign.diameters_um * np.r_[-1, 1, 1, 1][:, None])


@kind("time that starts again", refused=True, says="time")
def _(rng):
    return clock(plain(rng), lambda t: np.where(np.arange(len(t)) > 50, t - t[50], t))


@kind("no particle", refused=True, says="no particle")
def _(rng):
    return Campaign((), np.empty((0, 3)), ())


@kind("all forces zero", refused=True, says="zero")
def _(rng):
    return force(plain(rng), np.zeros_like)


@kind("one row each", refused=True, says="row")
def _(rng):
    return rows(plain(rng), lambda c: np.r_[top(c)])


@kind("one name twice", refused=True, says="times")
def _(rng):
    return replace(plain(rng), particles=("a", "a", "b", "c"))


@kind("force and displacement of unlike lengths", refused=True, says="entries")
def _(rng):
    return force(plain(rng), lambda f: f[:-3])


# ---- files damaged after they were written ---------------------------------------------------------------------------


def lines_of(file: Path) -> list[str]:
    return file.read_text(encoding="utf-8").splitlines()


def damaged(name: str, file: str, says: str) -> Callable:
    """A kind whose `file` is damaged: the function changes its lines."""

    def add(change: Callable[[np.random.Generator, list[str]], list[str]]):
        def damage(rng: np.random.Generator, folder: Path) -> None:
            place = folder / file
            place.write_text("\n".join(change(rng, lines_of(place))) + "\n", encoding="utf-8")

        KINDS.append(Kind(f"file: {name}", plain, refused=True, says=says, damage=damage))
        return change

    return add


def _with(lines: list[str], row: int, cell: int, text: str) -> list[str]:
    cells = lines[row].split(",")
    cells[cell] = text
    return [*lines[:row], ",".join(cells), *lines[row + 1 :]]


@damaged("a force that is text", "curves.csv", "row")
def _(rng, lines):
    return _with(lines, int(rng.integers(1, len(lines))), 2, "overload")


@damaged("a displacement of 1e300", "curves.csv", "row")
def _(rng, lines):
    return _with(lines, int(rng.integers(1, len(lines))), 3, "1e300")


@damaged("a cell too few", "curves.csv", "row")
def _(rng, lines):
    row = int(rng.integers(1, len(lines)))
    return [*lines[:row], lines[row].rsplit(",", 1)[0], *lines[row + 1 :]]


@damaged("cut off in the middle of a row", "curves.csv", "row")
def _(rng, lines):
    row = int(rng.integers(20, len(lines)))
    return [*lines[:row], lines[row][:8]]


@damaged("the header is gone", "curves.csv", "row 1")
def _(rng, lines):
    return lines[1:]


@damaged("no rows", "curves.csv", "curves.csv")
def _(rng, lines):
    return lines[:1]


@damaged("a particle without sizes", "particles.csv", "particles.csv")
def _(rng, lines):
    return lines[:-1]


@damaged("a diameter of zero", "particles.csv", "row")
def _(rng, lines):
    return _with(lines, 2, 1, "0")


@damaged("an unknown unit", "curves.csv", "column")
def _(rng, lines):
    return [lines[0].replace("force_mN", "force_kN3"), *lines[1:]]


@damaged("rows of two tests mixed up", "curves.csv", "time")
def _(rng, lines):
    return [lines[0], *np.array(lines[1:])[rng.permutation(len(lines) - 1)].tolist()]


@damaged("nonsense beside it", "campaign.toml", "campaign.toml")
def _(rng, lines):
    return [*lines, "control = ["]
